"""Mistakes that users make: each ends with one clear line, before any long work.

A row is what was typed or written, and what the line must say. The environment is a toy of 40x40
pixels; what holds for it holds for the others.
"""

from __future__ import annotations

import gymnasium as gym
import h5py
import numpy as np
import pytest
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from regil_wrappers.vector import RetrievalRewardWrapper as VectorReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import Reach, demonstration, stacked
from toy_registered import Drawn

from regil_sb3 import TD3BC
from regil_sb3.cli import main

TOY = "Mistakes/Reach-v0"
STATES = "Mistakes/ReachStates-v0"


@pytest.fixture(scope="module", autouse=True)
def environments():
    gym.register(TOY, entry_point=Drawn)
    gym.register(STATES, entry_point=Drawn, kwargs={"dict_obs": True})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SDL_VIDEODRIVER", "none")  # recording by hand would open a window
        yield
    del gym.registry[TOY], gym.registry[STATES]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the rows name."""
    root = tmp_path_factory.mktemp("mistakes")
    good = demonstration()
    good.save(root / "good.hdf5")
    frames, actions = good.frames, good.actions
    Demonstration(frames=frames[:, ::-1], actions=actions).save(root / "upside-down.hdf5")
    Demonstration(frames=frames.repeat(2, 1).repeat(2, 2), actions=actions).save(root / "80.hdf5")
    Demonstration(frames=frames).save(root / "no-actions.hdf5")
    wide = np.concatenate([actions, actions], axis=1)
    Demonstration(frames=frames, actions=wide).save(root / "four-actions.hdf5")
    far = Demonstration(frames=frames, actions=30 * actions)
    far.save(root / "other-units.hdf5")
    (root / "text.hdf5").write_text("hello")
    (root / "empty.hdf5").touch()
    with h5py.File(root / "nothing-in-it.hdf5", "w"):
        pass
    with h5py.File(root / "nan.hdf5", "w") as new, h5py.File(root / "good.hdf5") as old:
        for name in old:
            old.copy(name, new)
        new.attrs.update(old.attrs)

        def spoil(name, item):
            if name.endswith("actions"):
                item[0, 0] = np.nan

        new.visititems(spoil)
    (root / "no-demos").mkdir()
    run = root / "run"
    run.mkdir()
    (run / "config.yaml").write_text("env: x\n")
    damaged = root / "damaged-run"
    damaged.mkdir()
    (damaged / "config.yaml").write_text("{")
    (root / "file").touch()
    return root


TRAIN = [
    "train",
    "--env",
    TOY,
    "--demo",
    "good.hdf5",
    "--out",
    "new",
    "--steps",
    "200",
    "--preset",
    "plain",
]


def train(*words):
    return [*TRAIN, *words]


def setting(word):
    return train("--set", "warmup_steps=50", "--set", word)


COMMANDS = [
    # recording
    (["record", "regil/metaworld-buton-press-v0", "-o", "x.hdf5"], "button-press"),
    (["record", "nobody/knows-v0", "-o", "x.hdf5"], "nobody"),
    (["record", "not an id", "-o", "x.hdf5"], "not an id"),
    (["record", TOY, "-o", "x.hdf5"], "no scripted expert"),
    (["record", TOY, "-o", "x.hdf5", "--teleop", "keyboard"], "no window can be opened"),
    (["record", TOY, "-o", "file/x.hdf5", "--teleop", "keyboard"], "file"),
    (["record", TOY, "-o", "good.hdf5"], "exists already"),
    (["record", TOY, "-o", "x.hdf5", "--env-kwargs", "size"], "KEY=VALUE"),
    (["record", TOY, "-o", "x.hdf5", "--env-kwargs", "sice=3"], "sice"),
    (["record", TOY, "-o", "x.hdf5", "--seed", "-1"], "seeds -1"),
    (["record", TOY, "-o", "x.hdf5", "--seed", "1000000"], "evaluation"),
    # converting
    (["convert", "nowhere.npz", "x.hdf5"], "nowhere.npz"),
    (["convert", "good.hdf5", "80.hdf5"], "exists already"),
    (["convert", "text.hdf5", "x.hdf5"], "text.hdf5"),
    (["convert", "good.hdf5", "x.docx"], "docx"),
    (["convert", "good.hdf5", "x.hdf5", "--episode", "7"], "7"),
    (["convert", "good.hdf5", "x.hdf5", "--crop", "0", "0", "100", "100"], "crop"),
    (["convert", "good.hdf5", "x.hdf5", "--size", "0"], "size"),
    (["convert", "good.hdf5", "x.hdf5", "--fps", "-3"], "fps"),
    (["convert", "good.hdf5", "x.hdf5", "--camera", "wrist"], "wrist"),
    # the doctor
    (["doctor", TOY, "nowhere.hdf5"], "nowhere.hdf5"),
    (["doctor", TOY, "text.hdf5"], "text.hdf5"),
    (["doctor", TOY, "good.hdf5", "--episodes", "0"], "episodes"),
    (["doctor", TOY, "good.hdf5", "--preset", "fast"], "fast"),
    (["doctor", TOY, "good.hdf5", "--set", "kk=1"], "kk"),
    # where to, and which
    (["train"], "--env is missing"),
    (["train", "--resume", "new", "--env", TOY], "give it alone"),
    (["train", "--resume", "nowhere"], "nowhere"),
    (["train", "--resume", "damaged-run"], "damaged-run"),
    (["train", "--env", TOY, "--demo", "good.hdf5", "--out", "run"], "holds a run already"),
    (["train", "--env", TOY, "--demo", "good.hdf5", "--out", "file", "--steps", "200"], "file"),
    (["train", "--env", "nobody/knows-v0", "--demo", "good.hdf5", "--out", "new"], "nobody"),
    (train("--preset", "fast"), "fast"),
    (train("--episodes", "0"), "--episodes is 0"),
    (train("--set", "policy_kwargs.net_arch=256"), "do not fit TD3BC or its policy"),
    (train("--set", "policy_kwargs=5"), "write policy_kwargs.NAME=VALUE"),
    (train("--set", "policy_kwargs.random_shift=-1"), "random_shift is -1"),
    (train("--steps", "0"), "steps is 0"),
    (train("--steps", "100", "--set", "warmup_steps=100"), "end before the warm-up"),
    # the demonstration
    (["train", "--env", TOY, "--demo", "nowhere.hdf5", "--out", "new"], "regil record"),
    (["train", "--env", TOY, "--demo", "text.hdf5", "--out", "new"], "text.hdf5"),
    (["train", "--env", TOY, "--demo", "empty.hdf5", "--out", "new"], "empty.hdf5"),
    (["train", "--env", TOY, "--demo", "nothing-in-it.hdf5", "--out", "new"], "nothing-in-it"),
    (["train", "--env", TOY, "--demo", "nan.hdf5", "--out", "new"], "NaN"),
    (["train", "--env", TOY, "--demo", "80.hdf5", "--out", "new"], "80x80"),
    (train("--preset", "bc", "--demo", "no-actions.hdf5"), "no actions"),
    (["train", "--env", TOY, "--demo", "four-actions.hdf5", "--out", "new"], "action"),
    (["train", "--env", TOY, "--demo", "other-units.hdf5", "--out", "new"], "action"),
    (["train", "--env", STATES, "--demo", "good.hdf5", "--out", "new"], "image"),
    # settings
    (setting("warmup_stesp=5"), "warmup_steps"),
    (setting("k"), "KEY=VALUE"),
    (setting("k=[1"), "YAML"),
    (setting("k=0"), "k"),
    (setting("k=many"), "k"),
    (setting("horizon=-1"), "horizon"),
    (setting("encoder=resnet"), "resnet"),
    (setting("encoder=nowhere:encode"), "nowhere"),
    (setting("reward=dense"), "dense"),
    (setting("mode=sum"), "sum"),
    (setting("divisor=steps"), "divisor"),
    (setting("correction=yes please"), "yes please"),
    (setting("image=depth"), "depth"),
    (setting("image=obs:wrist"), "wrist"),
    (setting("step_pattern=dtw"), "dtw"),
    (setting("guide_patience=-1"), "guide_patience"),
    (setting("disturbance=-1"), "disturbance"),
    (setting("policy=CnnPolice"), "CnnPolice"),
    (setting("policy=MultiInputPolicy"), "MultiInputPolicy"),
    (setting("policy_kwargs.random_shft=3"), "random_shft"),
    (setting("policy_kwargs.features_extractor_class=vgg"), "vgg"),
    (setting("learning_rate=fast"), "learning_rate"),
    (setting("learning_rate=-1"), "learning_rate"),
    (setting("train_freq=[1, minute]"), "minute"),
    (setting("batch_size=0"), "batch_size"),
    (setting("buffer_size=1.5"), "buffer_size"),
    (setting("buffer_size=100000000000"), "GB"),
    (setting("success_buffer_size=3"), "success_buffer_size"),
    (setting("gamma=1.5"), "gamma"),
    (setting("tau=2"), "tau"),
    (setting("n_steps=0"), "n_steps"),
    (setting("train_freq=0"), "train_freq"),
    (setting("policy_delay=0"), "policy_delay"),
    (setting("bc_coef=-1"), "bc_coef"),
    (setting("bc_floor=2"), "bc_floor"),
    (setting("bc_schedule=steps"), "bc_schedule"),
    (setting("bc_loss=l1"), "bc_loss"),
    (setting("guide_again=2"), "guide_again"),
    (setting("actor_q=max"), "actor_q"),
    (setting("reward_scale=big"), "reward_scale"),
    (setting("exploration_std=-0.1"), "exploration_std"),
    (setting("device=gpu"), "device"),
    (setting("n_envs=0"), "n_envs"),
    (setting("frame_stack=0"), "frame_stack"),
    (setting("eval_episodes=-1"), "eval_episodes"),
    (setting("eval_freq=0"), "eval_freq"),
    (setting("env_kwargs.colour=red"), "colour"),
    (setting("env_kwargs.action_high=high"), "action_high"),
    (setting("env_kwargs.action_high=.inf"), "Box(-inf, inf, (2,), float32)"),
    # afterwards
    (["evaluate", "nowhere"], "nowhere"),
    (["evaluate", "run"], "run"),
    (["evaluate", "damaged-run"], "damaged-run"),
    (["evaluate", "run", "--episodes", "0"], "--episodes is 0"),
    (["report", "nowhere"], "nowhere"),
    (["bench", "speed"], "speed"),
    (["bench", "guide", "--tasks", "make-tea"], "make-tea"),
    (["bench", "guide", "--frames", "3"], "frames"),
    (["bench", "guide", "--episodes", "0"], "episodes"),
]


@pytest.mark.parametrize(("words", "says"), COMMANDS, ids=[" ".join(w) for w, _ in COMMANDS])
def test_command(words, says, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    assert main(words) == 2
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if line.startswith("regil: ")]
    assert said.err.strip().splitlines() == lines
    assert len(lines) == 1
    assert says in lines[0]
    left = [
        f
        for f in folder.rglob("*")
        if f not in before and f.name not in ("demo.hdf5", "new", ".lock")
    ]
    assert not left
    for file in {f for f in folder.rglob("*")} - set(before):
        if file.is_file():
            file.unlink()


def wrapped(**arguments):
    return RetrievalRewardWrapper(Reach(), demonstration(), **arguments)


def guided(**arguments):
    return RetrievalGuideWrapper(Reach(), demonstration(), **arguments)


IN_CODE = [
    ("no demonstration", lambda: RetrievalRewardWrapper(Reach(), None), "demo=None"),
    ("no file", lambda: RetrievalRewardWrapper(Reach(), "nowhere.hdf5"), "nowhere.hdf5"),
    ("an empty list", lambda: RetrievalRewardWrapper(Reach(), []), "demo="),
    ("an environment's name", lambda: RetrievalRewardWrapper(TOY, demonstration()), "Env"),
    ("no pictures", lambda: RetrievalRewardWrapper(Reach(dict_obs=True), demonstration()), "image"),
    ("nothing to render", lambda: wrapped(image="render"), "render"),
    ("weight", lambda: wrapped(weight=np.nan), "weight"),
    (
        "unequal wrappers",
        lambda: RetrievalGuideWrapper(wrapped(k=3), demonstration(), k=5),
        "k",
    ),
    (
        "a vector environment in the single wrapper",
        lambda: RetrievalRewardWrapper(gym.vector.SyncVectorEnv([Reach]), demonstration()),
        "regil_wrappers.vector",
    ),
    (
        "a single environment in the vector wrapper",
        lambda: VectorReward(Reach(), demonstration()),
        "for one environment",
    ),
    ("a suggestion before reset", lambda: guided().guide_action(), "reset"),
    ("frames as floats", lambda: Demonstration(frames=np.zeros((3, 8, 8, 3))), "uint8"),
    (
        "grey frames",
        lambda: Demonstration(frames=np.zeros((3, 8, 8), np.uint8)),
        "(frames, height, width, 3)",
    ),
    (
        "actions of another length",
        lambda: Demonstration(
            frames=np.zeros((9, 8, 8, 3), np.uint8), actions=np.zeros((3, 2), np.float32)
        ),
        "actions",
    ),
    ("TD3BC without a demonstration", lambda: TD3BC("CnnPolicy", stacked()), "demo="),
    (
        "TD3BC without a guide",
        lambda: TD3BC(
            "CnnPolicy",
            DummyVecEnv([lambda: gym.wrappers.TransformReward(NoGuide(), float)]),
            demo=demonstration(),
        ).learn(10),
        "RetrievalGuideWrapper",
    ),
    (
        "VecNormalize",
        lambda: TD3BC("CnnPolicy", VecNormalize(stacked()), demo=demonstration()),
        "VecNormalize",
    ),
    (
        "both weights off",
        lambda: TD3BC("CnnPolicy", stacked(), demo=demonstration(), q_coef=0.0, bc_coef=0.0),
        "nothing to learn from",
    ),
    ("no model", lambda: TD3BC.load("good.hdf5"), "no model"),
]


class NoGuide(Reach):
    guide_action = property()  # as if it were not there


@pytest.mark.parametrize(
    ("make", "says"), [row[1:] for row in IN_CODE], ids=[r[0] for r in IN_CODE]
)
def test_in_code(make, says, folder, monkeypatch):
    monkeypatch.chdir(folder)
    with pytest.raises((ValueError, OSError, TypeError)) as mistake:
        make()
    assert says in str(mistake.value)
    assert "\n" not in str(mistake.value)


def test_no_gpu(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ValueError, match="'cuda:0' and no GPU is found"):
        TD3BC("CnnPolicy", stacked(), demo=demonstration(), device="cuda:0")


def test_there_are_a_hundred():
    assert len(COMMANDS) + len(IN_CODE) >= 100
