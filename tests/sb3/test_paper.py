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
    assert PAPER.steps == 300_000
    for _, arguments in PAPER.wrappers("demo.hdf5"):
        assert (arguments["k"], arguments["horizon"]) == (5, 4)
        assert arguments["encoder"] == "dinov3"
    assert PAPER.retrieval("encoder") == "dinov3"
    assert PAPER.wrappers("demo.hdf5")[1][1]["divisor"] == "horizon"


def test_every_difference_from_the_defaults_is_said_in_the_preset():
    """An argument whose default differs from Eq. 4 and 6 must be in the preset."""
    deviations = {
        "n_steps", "normalize_q", "bc_loss", "bc_floor", "reward_scale", "target_policy_noise",
        "bootstrap_success", "exploration_clip", "bc_pretrain_steps", "learning_starts",
        "gradient_steps", "learning_rate",
    }  # fmt: skip
    defaults = {n: p.default for n, p in inspect.signature(TD3BC).parameters.items()}
    for name in deviations:
        assert PAPER.hyperparams[name] != defaults[name], name


def test_paper_preset_learns():
    changes = {"buffer_size": 500, "warmup_steps": 30, "batch_size": 4, "device": "cpu", "seed": 0}
    settings = {**PAPER.hyperparams, **changes}
    model = TD3BC("CnnPolicy", stacked(n_stack=PAPER.frame_stack), demo=demonstration(), **settings)
    assert isinstance(model.actor.features_extractor, ResNet18Encoder)
    assert model.critic.features_extractor is not model.actor.features_extractor
    before = [p.clone() for p in model.actor.parameters()]
    model.learn(34)
    assert model._n_updates == 34 - 1
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
