"""The paper preset (docs/paper.md), and what is left of it in the defaults."""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch as th
from toy import demonstration, stacked

from regil_sb3 import TD3BC
from regil_sb3.cli import _parser
from regil_sb3.envs import REHEARSAL_TASKS
from regil_sb3.envs.libero import LiberoEnv
from regil_sb3.envs.metaworld import MetaWorldEnv
from regil_sb3.envs.rehearsal import RehearsalEnv
from regil_sb3.evaluation import EVALUATION_SEED, SELECTION_SEED
from regil_sb3.policies import ImagePolicy, ResNet18Encoder
from regil_sb3.robots.rehearsal_scene import TASKS
from regil_sb3.settings import RETRIEVAL, Settings, make_settings, pairs, presets

HAMMER = "regil/metaworld-hammer-v0"
PAPER, PLAIN, DEFAULT = (make_settings(HAMMER, name) for name in ("paper", "plain", "default"))
PAGE = (Path(__file__).parents[2] / "docs/paper.md").read_text("utf-8")


def test_values_that_the_paper_gives():
    h = PAPER.hyperparams
    assert h["learning_rate"] == 5e-5
    assert h["gamma"] == 0.99
    assert h["policy_delay"] == 2
    assert h["batch_size"] == 64
    assert h["warmup_steps"] == h["success_buffer_size"] == 5_000
    assert PAPER.steps * 2 == 300_000  # frames, with action repeat 2
    for _, arguments in PAPER.wrappers("demo.hdf5"):
        assert (arguments["k"], arguments["horizon"]) == (5, 4)
        assert arguments["encoder"] == "dinov3"
    assert PAPER.retrieval("encoder") == "dinov3"
    assert PAPER.wrappers("demo.hdf5")[1][1]["divisor"] == "horizon"


# Arguments of TD3BC whose default is what the paper says, or that are no matter of the method.
AS_THE_PAPER = {
    "batch_size", "gamma", "tau", "policy_delay", "train_freq", "warmup_steps", "guide_again",
    "success_buffer_size", "keep_own_successes", "bc_schedule", "actor_in_warmup",
    "actor_q", "q_coef", "exploration_std", "bc_std", "target_noise_clip",
}  # fmt: skip
NO_METHOD = {
    "policy", "env", "demo", "seed", "device", "verbose", "tensorboard_log", "stats_window_size",
    "action_noise", "replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage",
    "_init_setup_model", "buffer_size",
}  # fmt: skip


def test_every_argument_is_said_in_the_preset_or_as_the_paper():
    """A new argument, or a default that moves away from the paper, must be looked at here."""
    defaults = {n: p.default for n, p in inspect.signature(TD3BC).parameters.items()}
    for name in defaults.keys() - NO_METHOD:
        if name in AS_THE_PAPER:
            assert PAPER.hyperparams.get(name, defaults[name]) == defaults[name], name
        else:
            assert PAPER.hyperparams[name] != defaults[name], name


def test_paper_preset_learns():
    changes = {"buffer_size": 500, "warmup_steps": 30, "batch_size": 4, "device": "cpu", "seed": 0}
    settings = {**PAPER.hyperparams, **changes}
    model = TD3BC("CnnPolicy", stacked(n_stack=PAPER.frame_stack), demo=demonstration(), **settings)
    assert isinstance(model.actor.features_extractor, ResNet18Encoder)
    assert model.critic.features_extractor is not model.actor.features_extractor
    before = [p.clone() for p in model.actor.parameters()]
    model.learn(34)
    assert model._n_updates == 34  # from the first step, one each
    assert any(not th.equal(a, b) for a, b in zip(before, model.actor.parameters(), strict=True))


def test_lambda_of_the_paper_reaches_zero():
    model = TD3BC("CnnPolicy", stacked(), demo=demonstration(), bc_coef=0.03, bc_steps=20_000,
                  bc_floor=0.0, buffer_size=100)  # fmt: skip
    model._total_timesteps = 300_000
    for step, expected in ((0, 0.03), (10_000, 0.015), (20_000, 0.0), (250_000, 0.0)):
        model.num_timesteps = step
        assert model.bc_coef_now() == pytest.approx(expected)


def test_gaussian_likelihood_is_the_squared_error_up_to_a_factor():
    kwargs = {"demo": demonstration(), "buffer_size": 100, "seed": 0}
    losses = []
    for loss in ("mse", "nll"):
        model = TD3BC("CnnPolicy", stacked(), bc_loss=loss, bc_std=0.1, **kwargs)
        losses.append(model._bc_term().item())
    assert losses[1] == pytest.approx(losses[0] / (2 * 0.1**2), rel=1e-5)


Values = dict[str, Any]
ENVIRONMENTS = {"Meta-World": MetaWorldEnv, "LIBERO": LiberoEnv, "real robot": RehearsalEnv}
OF_SETTINGS = {
    "n_timesteps": "steps",
    "frame_stack": "frame_stack",
    "eval_episodes": "eval_episodes",
}


def _rows(heading: str) -> Iterator[list[str]]:
    """Cells of a table's lines, its head and the rule below left out."""
    table = PAGE[PAGE.index(heading) :].split("\n\n")[0]
    for line in table.splitlines()[2:]:
        yield [cell.strip() for cell in line.strip("|").split("|")]


def _named(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def _said(cell: str, parameters: list[str]) -> Values:
    """The values in a cell, by the last part of their parameter's name."""
    names = [name.rpartition(".")[2] for name in parameters]
    values = {}
    for word in _named(cell):
        if "=" not in word:
            assert len(names) == 1, f"{word!r} in {cell!r} could be any of {names}"
            word = f"{names[0]}={word}"
        values |= pairs([word])
    assert values.keys() <= set(names), f"{cell!r} has values of more than {names}"
    return values


def _default_of(function: Any, name: str) -> Any:
    return inspect.signature(function).parameters[name].default


def _of_code(settings: Settings | None, parameter: str, question: str) -> Any:
    """What a preset makes of a parameter; without one, what the constructors do."""
    home, _, name = parameter.rpartition(".")
    if home == "env_kwargs":
        own = {} if settings is None else settings.env_kwargs
        return own.get(name, _default_of(ENVIRONMENTS[question.partition("'")[0]], name))
    if home == "policy_kwargs":
        own = {} if settings is None else settings.hyperparams.get(home, {})
        return own.get(name, _default_of(ImagePolicy, name))
    if name in OF_SETTINGS:
        return getattr(settings or Settings, OF_SETTINGS[name])
    if name in inspect.signature(TD3BC).parameters:
        own = {} if settings is None else settings.hyperparams
        return own.get(name, _default_of(TD3BC, name))
    values = []  # of those retrieval wrappers that have it, which must agree
    for home, wrapper in RETRIEVAL.items():
        if name in inspect.signature(wrapper).parameters:
            listed = [] if settings is None else settings.env_wrapper
            own = next((entry[home] for entry in listed if home in entry), {})
            values.append(own.get(name, _default_of(wrapper, name)))
    assert values, f"{parameter} is no parameter"
    assert all(value == values[0] for value in values), (parameter, values)
    return values[0]


RULINGS = {row[0]: row[1:] for row in _rows("| question |")}


@pytest.mark.parametrize("question", [name for name, row in RULINGS.items() if row[2]])
def test_a_line_of_the_table_is_what_the_code_does(question):
    paper, ours, last = RULINGS[question]
    parameters = _named(last)
    constructor, _, default = ours.partition("->")
    columns = [_said(cell, parameters) for cell in (paper, constructor, default)]
    for parameter in parameters:
        name = parameter.rpartition(".")[2]
        given = [column[name] for column in columns if name in column]
        assert given, f"{parameter} has no value"
        if name in columns[0]:
            assert _of_code(PAPER, parameter, question) == columns[0][name], parameter
        said = {**columns[0], **columns[1]}[name]
        assert _of_code(None, parameter, question) == said, parameter
        assert _of_code(PLAIN, parameter, question) == said, f"--preset plain: {parameter}"
        assert _of_code(DEFAULT, parameter, question) == columns[2].get(name, said), parameter


def test_the_table_leaves_nothing_out():
    """Whatever the presets set is a line of it."""
    named = {name for row in RULINGS.values() for name in _named(row[2])}
    for settings in (PAPER, PLAIN, DEFAULT):
        wanted = settings.hyperparams.keys() - {"policy_kwargs"}
        wanted |= {
            f"policy_kwargs.{name}" for name in settings.hyperparams.get("policy_kwargs", {})
        }
        for entry in settings.env_wrapper:
            wanted |= {name for arguments in entry.values() for name in arguments}
        assert wanted <= named
    assert len(named) > 50


def test_numbers_in_words():
    robot, evaluation = RULINGS["real robot's episode"][0], RULINGS["evaluation"][1]
    steps = ", ".join(f"{task.capitalize()} {TASKS[task].max_steps}" for task in REHEARSAL_TASKS)
    assert f"{steps} steps" in robot
    assert f"{EVALUATION_SEED:,} + i" in evaluation
    assert f"{SELECTION_SEED:,} + i" in evaluation
    low, high = map(int, re.findall(r"from (\d+) to (\d+)", RULINGS["LIBERO's episode"][1])[0])
    limits = [
        section["env_kwargs"]["max_steps"]
        for name, section in presets().items()
        if name.startswith("regil/libero-")
    ]
    assert len(limits) == 6
    assert low <= min(limits) <= max(limits) <= high == _default_of(LiberoEnv, "max_steps")


def test_other_values_than_on_meta_world():
    """The second table: the preset's, the command's for LIBERO, those of the robot's sections."""
    command = re.search(r"^regil train.*?(?<!\\)$", PAGE, re.DOTALL | re.MULTILINE)
    assert command
    args = _parser().parse_args(shlex.split(command[0].replace("\\\n", " "))[1:])
    libero = make_settings(args.env, args.preset, args.seed, args.steps, args.set)
    own = make_settings(args.env)
    assert libero.env_kwargs == own.env_kwargs
    robot = [make_settings(f"regil/rehearsal-{task}-v0") for task in REHEARSAL_TASKS]
    parameters = []
    for question, meta_world, on_libero, on_robot, parameter in _rows("| | Meta-World |"):
        (name,) = _named(parameter)
        parameters.append(name)
        read = [
            [int(number.replace(",", "")) for number in re.findall(r"\d[\d,]*\b", cell)]
            for cell in (meta_world, on_libero, on_robot)
        ]
        assert read[0] == [_of_code(PAPER, name, question)]
        assert read[1] == [_of_code(libero, name, question)]
        if name in ("warmup_steps", "n_timesteps"):
            assert read[2] == [_of_code(settings, name, question) for settings in robot]
    changed = {word.partition("=")[0] for word in args.set} - {"env_kwargs.max_steps"}
    assert changed | {"n_timesteps"} == set(parameters)
