"""Image policies: augmentation against numpy, fused against plain Adam, bfloat16 encoder."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from regil_sb3.policies import ConvEncoder, ImagePolicy, random_shift

IMAGES = spaces.Box(0, 255, (3, 40, 40), np.uint8)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


@given(
    seed=st.integers(0, 1000),
    pad=st.integers(0, 5),
    shape=st.tuples(*[st.integers(1, 4)] * 2, *[st.integers(6, 12)] * 2),
)
def test_random_shift_is_a_crop_of_the_padded_image(seed, pad, shape):
    images = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    th.manual_seed(seed)
    got = random_shift(th.from_numpy(images), pad)
    th.manual_seed(seed)
    corners = th.randint(0, 2 * pad + 1, (len(images), 2)).tolist()
    padded = np.pad(images, ((0, 0), (0, 0), (pad, pad), (pad, pad)), mode="edge")
    height, width = shape[2:]
    for image, new, (y, x) in zip(padded, got.numpy(), corners, strict=True):
        np.testing.assert_array_equal(new, image[:, y : y + height, x : x + width])


def test_fused_adam_steps_as_plain_adam():
    policies = []
    for kwargs in ({}, {"optimizer_kwargs": {}}):
        th.manual_seed(0)
        policies.append(ImagePolicy(IMAGES, ACTIONS, lambda _: 1e-2, **kwargs))
    batch = th.randint(0, 256, (4, 3, 40, 40), generator=th.Generator().manual_seed(1))
    for policy in policies:
        for _ in range(5):
            policy.actor.optimizer.zero_grad()
            policy.actor(batch.to(th.uint8)).square().sum().backward()
            policy.actor.optimizer.step()
    fused, plain = policies
    assert fused.actor.optimizer.defaults["fused"]
    assert not plain.actor.optimizer.defaults["fused"]
    for a, b in zip(fused.actor.parameters(), plain.actor.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("kwargs", [{}, {"optimizer_kwargs": {"weight_decay": 0.1}}])
def test_another_optimizer_gets_its_own_arguments_alone(kwargs):
    policy = ImagePolicy(IMAGES, ACTIONS, lambda _: 1e-2, optimizer_class=th.optim.SGD, **kwargs)
    assert policy.optimizer_kwargs == kwargs.get("optimizer_kwargs", {})


def test_bfloat16_rounds_features_and_nothing_else():
    th.manual_seed(0)
    plain, rounded = ConvEncoder(IMAGES), ConvEncoder(IMAGES, dtype="bfloat16")
    rounded.load_state_dict(plain.state_dict())
    images = th.rand(4, 3, 40, 40)
    features = rounded(images)
    assert features.dtype == th.float32
    assert not th.equal(features, plain(images))
    th.testing.assert_close(features, plain(images), rtol=0, atol=0.05)
    features.sum().backward()
    assert {p.grad.dtype for p in rounded.parameters()} == {th.float32}


def test_unknown_dtype_is_refused():
    with pytest.raises(ValueError, match="dtype is 'float16': use one of float32, bfloat16"):
        ConvEncoder(IMAGES, dtype="float16")
