"""Models open without running what they hold."""

from __future__ import annotations

import io
import os
import pickle
import zipfile

import numpy as np
import pytest
from stable_baselines3.common.noise import NormalActionNoise
from test_td3bc import small
from toy import demonstration, stacked

from regil_sb3 import TD3BC
from regil_sb3.bench.hostile import KEYS, Call, pickles, with_pickle


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.zip"
    model = small(stacked())
    model.learn(30)
    model.save(path)
    return path


NAMES = [name for name, _ in pickles("x")]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("key", KEYS)
def test_what_a_model_does_not_need_is_refused_in_one_line(saved, tmp_path, name, key):
    marker = tmp_path / "executed"
    path = with_pickle(saved, tmp_path / "hostile.zip", dict(pickles(marker))[name], key)
    with pytest.raises(ValueError, match=key) as refused:
        TD3BC.load(path)
    assert "\n" not in str(refused.value)
    assert not marker.exists()


def test_trusted_files_run_what_they_say(saved, tmp_path):
    """Else the test above could not fail."""
    marker = tmp_path / "executed"
    path = with_pickle(
        saved, tmp_path / "own.zip", dict(pickles(marker))["os.system"], "ep_info_buffer"
    )
    TD3BC.load(path, trust=True)
    assert marker.exists()


def test_the_command_line_has_trust(saved, tmp_path, capsys):
    from regil_sb3.cli import _parser

    assert _parser().parse_args(["evaluate", "run", "--trust"]).trust


@pytest.mark.parametrize("policy", ["CnnPolicy", "MultiInputPolicy"])
def test_own_models_need_no_trust(tmp_path, policy):
    if policy == "CnnPolicy":
        model = small(stacked(), policy_kwargs={"features_extractor_class": "resnet18"})
    else:
        demo = demonstration()
        states = {"x": np.zeros((len(demo), 1), np.float32)}
        from regil_wrappers import Demonstration

        demo = Demonstration(frames=demo.frames, actions=demo.actions, observations=states)
        env = stacked(n_stack=1, dict_obs=True)
        model = small(env, policy, demo=demo, n_steps=1)
    model.learn(30)
    model.ep_success_buffer.append(np.bool_(True))  # as a user's environment may say
    model.save(tmp_path / "model")
    loaded = TD3BC.load(tmp_path / "model")  # without its suffix, as SB3
    assert loaded.num_timesteps == 30
    with (tmp_path / "model.zip").open("rb") as file:
        assert TD3BC.load(file).num_timesteps == 30


@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noise_needs_no_trust(tmp_path, n_envs):
    noise = NormalActionNoise(np.zeros(2), np.array([0.1, 0.2]))
    model = small(stacked(n_envs), action_noise=noise)
    model.learn(30)
    model.save(tmp_path / "model")
    loaded = TD3BC.load(tmp_path / "model", env=stacked(n_envs), demo=demonstration())
    drawn = []
    for one in (model, loaded):
        np.random.seed(0)
        drawn.append(one.action_noise())
    assert drawn[1].shape == ((2,) if n_envs == 1 else (2, 2))
    assert np.array_equal(*drawn)
    loaded.learn(4, reset_num_timesteps=False)


def test_a_number_type_is_named_and_not_called(saved, tmp_path):
    path = with_pickle(saved, tmp_path / "model.zip", pickle.dumps(Call(np.float32, 1)))
    with pytest.raises(ValueError, match=r"a call of <class 'numpy\.float32'>"):
        TD3BC.load(path)


def test_damaged_files_are_refused_in_one_line(saved, tmp_path):
    rng = np.random.default_rng(0)
    whole = saved.read_bytes()
    path = tmp_path / "damaged.zip"
    for i in range(60):
        content = bytearray(whole)
        if i % 3 == 0:
            content = content[: rng.integers(0, len(content))]
        else:
            for at in rng.integers(0, len(content), 20):
                content[at] ^= int(rng.integers(1, 256))
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"damaged\.zip") as refused:
            TD3BC.load(path)
        assert "\n" not in str(refused.value)


def test_a_part_that_grows_is_refused(saved, tmp_path):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", b" " * 50_000_000)
    assert path.stat().st_size < 100_000
    with pytest.raises(ValueError, match="50000000 bytes"):
        TD3BC.load(path)


@pytest.mark.parametrize(
    "pickled",
    [
        pickle.PROTO + b"\x05" + pickle.BYTEARRAY8 + (2**40).to_bytes(8, "little") + b".",
        pickle.PROTO + b"\x02N" + pickle.LONG_BINPUT + (4 * 10**7).to_bytes(4, "little") + b".",
        pickle.PROTO + b"\x02Np40000000\n.",
        pickle.PROTO
        + b"\x02]q\x00("
        + b"N" * 1_000
        + b"e0ccollections\ndeque\nq\x01"
        + b"h\x01h\x00\x85R0" * 1_000
        + b"N.",
        pickle.PROTO
        + b"\x02}q\x00("
        + b"".join(b"K%cN" % i for i in range(200))
        + b"ucstable_baselines3.common.utils\nConstantSchedule\nq\x01"
        + b"h\x01)\x81h\x00b0" * 1_000
        + b"N.",
        # An array's own state, and a type whose numbers would be addresses
        pickle.PROTO
        + b"\x03cnumpy._core.numeric\n_frombuffer\n"
        + b"(C\x00cnumpy\ndtype\nX\x02\x00\x00\x00f4\x89\x88\x87RK\x00\x85X\x01\x00\x00\x00CtR"
        + b"(K\x01K\x01\x85cnumpy\ndtype\nX\x02\x00\x00\x00O8\x89\x88\x87R\x89]tb.",
        pickle.PROTO
        + b"\x02cnumpy\ndtype\nX\x02\x00\x00\x00O8\x89\x88\x87R"
        + b"(K\x03X\x01\x00\x00\x00|NNNK\x08K\x08K\x00tb.",
    ],
    ids=["bytearray", "long_binput", "put", "deques", "dicts", "an array", "a type"],
)
def test_pickles_that_claim_memory_are_refused(saved, tmp_path, pickled):
    path = with_pickle(saved, tmp_path / "hostile.zip", pickled, "ep_info_buffer")
    with pytest.raises(ValueError, match=r"ep_info_buffer' names .* which a model does not need"):
        TD3BC.load(path)


def test_weights_that_grow_are_refused(saved, tmp_path):
    path, inside = tmp_path / "bomb.zip", io.BytesIO()
    with zipfile.ZipFile(inside, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(50_000_000))
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = inside.getvalue() if name == "policy.pth" else old.read(name)
            new.writestr(name, content)
    with pytest.raises(ValueError, match=r"policy\.pth claims 50000000 bytes"):
        TD3BC.load(path)


def test_weights_are_tensors_or_nothing(saved, tmp_path):
    marker, path = tmp_path / "executed", tmp_path / "model.zip"
    hostile = io.BytesIO()
    import torch as th

    th.save({"mu": Call(os.system, f"touch {marker}")}, hostile)
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, hostile.getvalue() if name == "policy.pth" else old.read(name))
    with pytest.raises(ValueError, match=r"model\.zip"):
        TD3BC.load(path)
    assert not marker.exists()


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip"):
        TD3BC.load(tmp_path / "nowhere")
