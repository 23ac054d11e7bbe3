"""What `regil doctor` says of a run's memory and time."""

from __future__ import annotations

import dataclasses
import re

import gymnasium as gym
import pytest
import toy_camera

from regil_sb3.doctor import cost
from regil_sb3.settings import make_settings

ENV = "ToyCamera-v0"
STATE = ["policy=MlpPolicy", "policy_kwargs={}", "frame_stack=1", "env_kwargs.obs=state"]
FRAME = 84 * 84 * 3


@pytest.fixture(scope="module")
def demo():
    return toy_camera.record()


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(cost, "_ENOUGH", 0.1)


def checked(demo, overrides=(), preset=None, seconds=0.006, longest=70):
    settings = make_settings(ENV, preset, overrides=list(overrides))
    env = gym.make(ENV, **settings.env_kwargs)
    return {f.check: f for f in cost.check_cost(env, demo, settings, seconds, longest)}


def milliseconds(found):
    return float(re.search(r"(?:learner|updates) ([\d.]+) ms a step", found["time"].line)[1])


def gigabytes(found, what):
    return float(re.search(what + r" (?:up to )?([\d.]+)", found["memory"].line)[1])


def test_all_parts_are_counted(demo):
    assert {f.verdict for f in checked(demo).values()} == {"ok"}
    learning = cost._Learning(0.02, 0.002, 0.9, offline=False, first=0.01, firsts=4_000)
    line = cost._time(learning, make_settings(ENV), 0.006, 70, []).line
    assert re.match(r"15,000 steps take [\d.]+ min to [\d.]+ min: ", line)
    assert "environment and retrieval 6.0 ms a step (1.5 min)" in line
    assert "4,000 updates by behaviour cloning before" in line
    assert "70 episodes that the policy is evaluated in, up to 70 steps each" in line
    assert "not counted: the evaluation after it" in line
    least, most = (
        float(x) for x in re.match(r"15,000 steps take (\S+) min to (\S+)", line).groups()
    )
    parts = [float(x) for x in re.findall(r"\((?:up to )?([\d.]+) min\)", line)]
    assert parts == [1.5, 5.0, 0.7, 0.7]
    assert (least, most) == (7.2, 7.8)


def test_memory_is_that_of_process_and_buffers(demo):
    found = checked(demo, ["buffer_size=200000", "success_buffer_size=50000"])
    assert gigabytes(found, "replay buffer") == pytest.approx(15_000 * FRAME / 1e9, rel=0.05)
    later = float(re.search(r"\(([\d.]+) at 200,000\)", found["memory"].line)[1])
    assert later == pytest.approx(200_000 * FRAME / 1e9, rel=0.02)
    assert gigabytes(found, "success buffer") == pytest.approx(50_000 * FRAME / 1e9, rel=0.02)
    assert gigabytes(found, "learner") > 0.1
    parts = [gigabytes(found, name) for name in ("learner", "replay buffer", "success buffer")]
    total = float(re.match(r"([\d.]+) GB after 15,000 steps", found["memory"].line)[1])
    assert total == pytest.approx(sum(parts), abs=0.02)
    # Successors are stored too where observations are no images
    state = checked(demo, [*STATE, "buffer_size=10000000", "n_timesteps=10000000"])
    assert 0.48 <= gigabytes(state, "replay buffer") <= 0.9  # 2 x 24 bytes and action, reward, end


def test_a_replay_buffer_that_does_not_fit(demo):
    found = checked(demo, ["buffer_size=900000000"])
    assert found["memory"].verdict == "wrong"
    assert (
        int(re.search(r"set buffer_size to at most (\d+)", found["memory"].line)[1]) < 900_000_000
    )


def test_a_success_buffer_that_does_not_fit(demo):
    found = checked(demo, ["success_buffer_size=900000000"])
    assert found["memory"].verdict == "wrong"
    assert "set success_buffer_size to at most " in found["memory"].line


def test_more_updates_take_longer(demo):
    few, many = (checked(demo, [f"gradient_steps={n}"]) for n in ("0", "4.0"))
    assert milliseconds(many) > 3 * milliseconds(few)


@pytest.mark.parametrize("preset", ["rot", "rfcl", "ablation-rl", "plain"])
def test_presets(demo, preset):
    found = checked(demo, preset=preset)
    assert found["time"].verdict == "ok"
    assert ("behaviour cloning" in found["time"].line) == (preset != "ablation-rl")
    assert ("at an episode's end" in found["time"].line) == (preset == "rot")


@pytest.mark.parametrize("preset", ["bc", "baku"])
def test_learning_from_the_demonstration_alone_asks_no_environment(demo, preset):
    found = checked(demo, preset=preset)
    assert re.match(r"5,000 steps take \S+ min to \S+ min: updates ", found["time"].line)
    assert "environment and retrieval" not in found["time"].line
    assert "replay buffer" not in found["memory"].line


def test_several_environments(demo):
    found = checked(demo, ["n_envs=3"])
    assert "3 more environments, as training has 4" in found["memory"].line
    assert gigabytes(found, "replay buffer") == pytest.approx(15_000 * FRAME / 1e9, rel=0.05)


def test_a_robot_is_evaluated_when_all_is_learned(demo):
    found = checked(demo, ["eval_episodes=0"])
    assert "evaluated in" not in found["time"].line
    assert re.match(r"15,000 steps take \S+ min: ", found["time"].line)
    assert "more environment" not in found["memory"].line


def test_a_policy_without_camera(demo):
    found = checked(demo, STATE)
    assert found["time"].verdict == "ok"
    assert (
        "not counted: behaviour cloning (" in found["time"].line
    )  # the demonstration has no state


def test_without_actions(demo):
    found = checked(dataclasses.replace(demo, actions=None))
    assert "behaviour cloning (the demonstration has no actions" in found["time"].line
    assert "learner" in found["time"].line
    assert "success buffer" not in found["memory"].line


@pytest.mark.parametrize(
    ("overrides", "why"),
    [
        (["env_kwargs.obs=dict"], "MultiInputPolicy"),
        (["policy=MlpPolicy", "policy_kwargs.shared_encoder=true"], "shared_encoder"),
        (["batch_size=0"], "batch_size is 0"),
        (["learning_rate=1000000.0"], "training stopped"),
    ],
)
def test_a_learner_that_cannot_begin_is_warned_of(demo, overrides, why):
    found = checked(demo, overrides)
    assert list(found) == ["time"]
    assert found["time"].verdict == "warning"
    assert why in found["time"].line
    assert "6 ms each, take 1.5 min" in found["time"].line


@pytest.mark.parametrize(("share", "said"), [(0.25, True), (0.95, False)])
def test_a_busy_machine_is_said(demo, share, said):
    learning = cost._Learning(0.02, 0.002, share, offline=False, first=0.01, firsts=6_000)
    line = cost._time(learning, make_settings(ENV), 0.006, 70, []).line
    # A quarter of 15,000 x 20 ms and 6,000 x 10 ms
    assert ("25% of a core, and with one to itself would need 1.5 min of this" in line) == said
