"""Image policies for TD3BC: the convolutional encoders and the random-shift augmentation.

- ``ConvEncoder``: the small convolutional network that is the default.
- ``ResNet18Encoder``: ResNet-18 with group normalisation, by name, for the paper preset.
- ``random_shift``: the augmentation of DrQ (https://arxiv.org/abs/2004.13649).
- ``ImagePolicy``: TD3's policy on images, one encoder for actor and critic each, or shared.
- ``average_in``: the running average of an actor's weights, while cloning alone trains it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from regil_sb3.arguments import check_number

_DTYPES = {"float32": th.float32, "bfloat16": th.bfloat16}
_AVERAGED = 10  # of the first updates: the average takes in about a tenth of those done


def random_shift(images: th.Tensor, pad: int) -> th.Tensor:
    """Shift each image by up to ``pad`` pixels in x and y, repeating the border.

    All channels of an image (its stacked frames too) shift together.

    Args:
        images: (B, C, H, W), any dtype.
        pad: largest shift in pixels; 0 returns the images unchanged.

    Returns:
        (B, C, H, W), the same dtype. Draws from torch's global CPU generator.
    """
    if pad == 0:
        return images
    n, channels, height, width = images.shape
    size = channels * height * width
    shifted = th.empty(images.shape, dtype=images.dtype)
    pairs = zip(images.cpu().reshape(n, size).numpy(), shifted.numpy(), strict=True)
    corners = th.randint(0, 2 * pad + 1, (n, 2)) - pad
    for (old, new), (y, x) in zip(pairs, corners.tolist(), strict=True):
        # One block of memory moves; what wraps around is then overwritten by the border.
        offset = y * width + x
        start, stop = max(-offset, 0), size - max(offset, 0)
        new.reshape(size)[start:stop] = old[start + offset : stop + offset]
        top, bottom, left, right = max(-y, 0), height - max(y, 0), max(-x, 0), width - max(x, 0)
        new[..., :left] = new[..., left : left + 1]
        new[..., right:] = new[..., right - 1 : right]
        new[:, :top] = new[:, top : top + 1]
        new[:, bottom:] = new[:, bottom - 1 : bottom]
    return shifted.to(images.device)


class _Encoder(BaseFeaturesExtractor):
    """Convolutions, then in float32 Linear, LayerNorm and Tanh."""

    convolutions: nn.Sequential
    head: nn.Sequential

    def __init__(self, observation_space: spaces.Box, features_dim: int, dtype: str) -> None:
        if dtype not in _DTYPES:
            raise ValueError(f"dtype is {dtype!r}: use one of {', '.join(_DTYPES)}")
        super().__init__(observation_space, features_dim)
        self.dtype = _DTYPES[dtype]

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(B, C, H, W) float in [0, 1] -> (B, features_dim) float32 in (-1, 1)."""
        device = observations.device.type
        with th.autocast(device, self.dtype, enabled=self.dtype != th.float32):
            features = self.convolutions(observations)
        return th.tanh(self.head(features.float()))


class ConvEncoder(_Encoder):
    """Three convolutions (8/4-16, 4/2-32, 3/1-32), then Linear, LayerNorm and Tanh.

    Args:
        observation_space: images, channels first, at least 36 pixels high and wide.
        features_dim: length of the feature vector.
        dtype: "float32", or "bfloat16" for the convolutions alone; weights stay float32. Faster on
            a CPU that has instructions for it, several times slower on one that has not.
    """

    def __init__(
        self, observation_space: spaces.Box, features_dim: int = 64, dtype: str = "float32"
    ) -> None:
        super().__init__(observation_space, features_dim, dtype)
        channels, height, width = observation_space.shape
        if min(height, width) < 36:
            raise ValueError(
                f"ConvEncoder needs images of at least 36x36 pixels, not {height}x{width}: "
                "use a larger size, or another features_extractor_class"
            )
        self.convolutions = nn.Sequential(
            nn.Conv2d(channels, 16, 8, stride=4),
            nn.ReLU(),
            nn.Conv2d(16, 32, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3),
            nn.ReLU(),
            nn.Flatten(),
        )
        with th.no_grad():
            n_flat = self.convolutions(th.zeros(1, channels, height, width)).shape[1]
        self.head = nn.Sequential(nn.Linear(n_flat, features_dim), nn.LayerNorm(features_dim))


class _ResidualBlock(nn.Module):
    """Basic block of ResNet (https://arxiv.org/abs/1512.03385) with group normalisation."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
            nn.GroupNorm(outputs // 16, outputs),
            nn.ReLU(),
            nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False),
            nn.GroupNorm(outputs // 16, outputs),
        )
        self.skip: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.skip = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False),
                nn.GroupNorm(outputs // 16, outputs),
            )

    def forward(self, x: th.Tensor) -> th.Tensor:
        return th.relu(self.body(x) + self.skip(x))


class ResNet18Encoder(_Encoder):
    """ResNet-18, trained from scratch, with group instead of batch normalisation.

    Args:
        observation_space: images, channels first.
        features_dim: length of the feature vector.
        dtype: "float32", or "bfloat16" for the convolutions alone; weights stay float32. Faster on
            a CPU that has instructions for it, several times slower on one that has not.
    """

    def __init__(
        self, observation_space: spaces.Box, features_dim: int = 64, dtype: str = "float32"
    ) -> None:
        super().__init__(observation_space, features_dim, dtype)
        layers: list[nn.Module] = [
            nn.Conv2d(observation_space.shape[0], 64, 7, 2, 3, bias=False),
            nn.GroupNorm(4, 64),
            nn.ReLU(),
            nn.MaxPool2d(3, 2, 1),
        ]
        inputs = 64
        for outputs, stride in ((64, 1), (128, 2), (256, 2), (512, 2)):
            layers += [_ResidualBlock(inputs, outputs, stride), _ResidualBlock(outputs, outputs, 1)]
            inputs = outputs
        layers += [nn.AdaptiveAvgPool2d(1), nn.Flatten()]
        self.convolutions = nn.Sequential(*layers)
        self.head = nn.Sequential(nn.Linear(512, features_dim), nn.LayerNorm(features_dim))


_ENCODERS: dict[str, type[BaseFeaturesExtractor]] = {
    "conv": ConvEncoder,
    "resnet18": ResNet18Encoder,
}
OWN_ENCODERS = tuple(_ENCODERS.values())


def encoder_class(name: str | type[BaseFeaturesExtractor]) -> type[BaseFeaturesExtractor]:
    """The encoder that a name stands for; a class stands for itself.

    Raises:
        ValueError: no encoder has that name.
    """
    if not isinstance(name, str):
        return name
    if name not in _ENCODERS:
        raise ValueError(
            f"features_extractor_class {name!r} is unknown: "
            f"use one of {', '.join(sorted(_ENCODERS))}, or a class"
        )
    return _ENCODERS[name]


def orthogonal(module: nn.Module) -> None:
    """Orthogonal weights, zero biases, as the image-based TD3 of DrQ-v2 starts."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.orthogonal_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def average_in(actor: nn.Module, average: nn.Module, updates: int, tau: float) -> None:
    """Take an actor's weights into their running average after an update by cloning alone.

    The average spans about the last tenth of the updates done, and 1 / ``tau`` at most, so that
    little of the weights it began with is left early on. Buffers (a BatchNorm's statistics) are
    copied.

    Args:
        actor: as it is now.
        average: the same network, changed in place.
        updates: done so far, this one included.
        tau: the least share of the new weights, in (0, 1].
    """
    share = max(tau, _AVERAGED / (updates + _AVERAGED))
    polyak_update(actor.parameters(), average.parameters(), share)
    copy_tensors(actor.buffers(), average.buffers())


def copy_tensors(of: Iterable[th.Tensor], to: Iterable[th.Tensor]) -> None:
    """Copy values, one after the other, in place."""
    with th.no_grad():
        for new, old in zip(of, to, strict=True):
            old.copy_(new)


class ImagePolicy(TD3Policy):
    """TD3's policy on images, as TD3BC trains it.

    Args:
        observation_space: images, channels first (SB3 transposes them by itself).
        action_space: a bounded Box.
        lr_schedule: learning rate of actor and critic.
        net_arch: hidden layers of both heads.
        features_extractor_class: "conv" (``ConvEncoder``), "resnet18", or a class.
        shared_encoder: one encoder for actor and critic, trained by the critic's and the BC term's
            gradients, while the actor's Q-term sees its features detached. Otherwise each has its
            own. (SB3's ``share_features_extractor`` trains a shared encoder by the actor's loss
            alone, and is refused here.)
        q_trains_encoder: whether the actor's Q-term trains an encoder of the actor's own; if not,
            behaviour cloning alone does.
        averaged: whether the target actor, a running average of the actor's weights, is what acts
            and is evaluated: an actor's success jumps from one update to the next.
        random_shift: largest shift of the augmentation, in pixels; 0 turns it off.
        optimizer_kwargs: None is torch's fused Adam, three times faster on a CPU.
        **kwargs: the other arguments of SB3's ``TD3Policy``.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        features_extractor_class: str | type[BaseFeaturesExtractor] = "conv",
        shared_encoder: bool = True,
        q_trains_encoder: bool = True,
        averaged: bool = True,
        random_shift: int = 4,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if kwargs.pop("share_features_extractor", False):
            raise ValueError(
                "share_features_extractor=True trains the encoder by the actor's loss alone: "
                "use shared_encoder=True"
            )
        if not is_image_space(observation_space):
            raise ValueError(
                f"CnnPolicy needs image observations (uint8, 0 to 255), not {observation_space}: "
                "use MlpPolicy or MultiInputPolicy"
            )
        check_number("random_shift", random_shift, (int,), 0, th.inf)
        features_extractor_class = encoder_class(features_extractor_class)
        if optimizer_kwargs is None and "optimizer_class" not in kwargs:
            optimizer_kwargs = {"fused": True}
        self.shared_encoder = shared_encoder
        self.q_trains_encoder = q_trains_encoder
        self.averaged = averaged
        self.random_shift = random_shift
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=[256, 256] if net_arch is None else net_arch,
            features_extractor_class=features_extractor_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        for network in (self.actor, self.critic):
            for name, module in network.named_children():
                # an extractor class of the user's own may come with weights of its own
                if name != "features_extractor" or self.features_extractor_class in OWN_ENCODERS:
                    module.apply(orthogonal)
        if self.shared_encoder:
            # The critic keeps gradients through the encoder, and its optimizer steps it.
            self.critic.features_extractor = self.actor.features_extractor
            self.critic.optimizer = self.optimizer_class(
                self.critic.parameters(),
                lr=lr_schedule(1),  # type: ignore[call-arg]
                **self.optimizer_kwargs,
            )
            self.critic_target.features_extractor = self.actor_target.features_extractor
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.critic_target.load_state_dict(self.critic.state_dict())

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        del data["share_features_extractor"]
        data.update(
            shared_encoder=self.shared_encoder,
            q_trains_encoder=self.q_trains_encoder,
            averaged=self.averaged,
            random_shift=self.random_shift,
        )
        return data

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        acts: th.Tensor = (self.actor_target if self.averaged else self.actor)(observation)
        return acts

    def augment(self, observations: th.Tensor) -> th.Tensor:
        """Random shift of a batch of image observations (B, C, H, W)."""
        return random_shift(observations, self.random_shift)
