"""The paper preset (docs/paper.md), and what is left of it in the defaults."""

from __future__ import annotations

import inspect

import pytest
import torch as th
from toy import demonstration, stacked

from regil_sb3 import TD3BC
from regil_sb3.policies import ResNet18Encoder
from regil_sb3.settings import make_settings

PAPER = make_settings("regil/metaworld-hammer-v0", "paper")


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
