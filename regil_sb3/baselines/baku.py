"""BAKU: a transformer over observation and action tokens that clones chunks of actions.

* ``BAKUNetwork`` - what it learns
* ``BAKUPolicy`` - how its chunks become actions, and the average of its weights
* ``BAKU`` - trains it on the demonstration
"""

from __future__ import annotations

from copy import deepcopy
from os import PathLike
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from regil_wrappers import Demonstration
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.vec_env import VecFrameStack, unwrap_vec_wrapper
from torch import nn
from torch.nn import functional as F  # noqa: N812

from regil_sb3.arguments import check_action_space, check_device, check_number
from regil_sb3.as_seen import as_seen
from regil_sb3.baselines.offline import Offline
from regil_sb3.model_file import SafeLoad
from regil_sb3.policies import (
    OWN_ENCODERS,
    average_in,
    encoder_class,
    orthogonal,
    random_shift,
)

_LOG_STD = (-3.0, 1.0)  # limits of the Gaussian head's
_TAU = 0.005  # TD3's own: how fast the average follows the weights


class BAKUNetwork(nn.Module):
    """Encoder, transformer over [observation, action token], and a head for a chunk of actions.

    Args:
        features_extractor: makes the observation's token, (B, C, H, W) -> (B, width).
        actions: dimensions of an action.
        chunk: actions predicted at once.
        layers: of the transformer.
        heads: of its attention.
        dropout: in the transformer.
        gaussian: whether the head says deviations, too.
    """

    def __init__(
        self,
        features_extractor: BaseFeaturesExtractor,
        actions: int,
        chunk: int,
        layers: int,
        heads: int,
        dropout: float,
        gaussian: bool,
    ) -> None:
        super().__init__()
        self.chunk, self.actions, self.gaussian = chunk, actions, gaussian
        width = features_extractor.features_dim
        self.features_extractor = features_extractor
        if type(features_extractor) in OWN_ENCODERS:  # another may come with weights of its own
            features_extractor.apply(orthogonal)
        self.action_token = nn.Parameter(0.02 * th.randn(1, 1, width))
        self.positions = nn.Parameter(0.02 * th.randn(1, 2, width))
        layer = nn.TransformerEncoderLayer(
            width, heads, 4 * width, dropout, F.gelu, batch_first=True, norm_first=True
        )
        # With a causal mask an "encoder" is a decoder of GPT's kind
        self.trunk = nn.TransformerEncoder(
            layer, layers, nn.LayerNorm(width), enable_nested_tensor=False
        )
        self.register_buffer("mask", nn.Transformer.generate_square_subsequent_mask(2))
        self.head = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, chunk * actions * (2 if gaussian else 1)),
        )  # fmt: skip

    def forward(self, images: th.Tensor) -> tuple[th.Tensor, th.Tensor | None]:
        """Means (B, chunk, A) in [-1, 1], and logarithms of deviations where the head has them."""
        seen = self.features_extractor(images)
        tokens = th.stack([seen, self.action_token[:, 0].expand_as(seen)], dim=1)
        out = self.head(self.trunk(tokens + self.positions, mask=self.mask, is_causal=True)[:, -1])
        out = out.reshape(len(seen), -1, self.chunk, self.actions)
        log_std = out[:, 1].clamp(*_LOG_STD) if self.gaussian else None
        return th.tanh(out[:, 0]), log_std


class BAKUPolicy(BasePolicy):
    """Acts by what a ``BAKUNetwork`` said of the present step, now and before.

    The action token is learned; what the transformer makes of it, having seen the observation, goes
    through the head to ``chunk`` actions at once. Acting averages what the last ``chunk``
    observations said of the present step, with weight exp(-smoothing * i) for the i-th oldest
    (temporal ensembling, https://arxiv.org/abs/2304.13705); the state that ``predict`` takes and
    returns holds these chunks. Without it only the newest chunk counts. ``actor`` is the network
    that is trained, ``actor_target`` the running average of its weights.

    Args:
        observation_space: images, channels first.
        action_space: a bounded Box.
        lr_schedule: learning rate.
        chunk: actions predicted at once.
        width: of tokens and hidden layers.
        layers: of the transformer.
        heads: of its attention.
        dropout: in the transformer.
        head: "mse" (squared error) or "gaussian" (negative log likelihood, the deviation learned).
        smoothing: see above; 0 weighs all chunks alike.
        averaged: whether ``actor_target`` acts, as in ``ImagePolicy``, or ``actor``.
        features_extractor_class: "conv", "resnet18", or a class that takes ``features_dim``.
        features_extractor_kwargs: for it, beside ``features_dim``.
        random_shift: largest shift of the augmentation, in pixels.
        optimizer_class: torch's Adam.
        optimizer_kwargs: None is ``fused=True``.

    Raises:
        ValueError: observations are no images, or a name or number does not fit.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        chunk: int = 10,
        width: int = 256,
        layers: int = 8,
        heads: int = 4,
        dropout: float = 0.1,
        head: Literal["mse", "gaussian"] = "mse",
        smoothing: float = 0.01,
        averaged: bool = True,
        features_extractor_class: str | type[BaseFeaturesExtractor] = "conv",
        features_extractor_kwargs: dict[str, Any] | None = None,
        random_shift: int = 4,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        if not is_image_space(observation_space):
            raise ValueError(f"BAKU needs image observations (uint8), not {observation_space}")
        if head not in ("mse", "gaussian"):
            raise ValueError(f"head is {head!r}: use one of mse, gaussian")
        for name, value in (("chunk", chunk), ("layers", layers), ("heads", heads)):
            check_number(name, value, (int,), 1, np.inf)
        check_number("random_shift", random_shift, (int,), 0, np.inf)
        check_number("width", width, (int,), heads, np.inf)
        check_number("dropout", dropout, (int, float), 0.0, 1.0)
        check_number("smoothing", smoothing, (int, float), -np.inf, np.inf)
        if width % heads:
            raise ValueError(f"width is {width}: it must be a multiple of heads={heads}")
        super().__init__(
            observation_space,
            action_space,
            encoder_class(features_extractor_class),
            {**(features_extractor_kwargs or {}), "features_dim": width},
            optimizer_class=optimizer_class,
            optimizer_kwargs={"fused": True} if optimizer_kwargs is None else optimizer_kwargs,
            squash_output=True,
        )
        self.chunk, self.width, self.layers, self.heads = chunk, width, layers, heads
        self.dropout, self.head_kind, self.smoothing = dropout, head, smoothing
        self.averaged, self.random_shift = averaged, random_shift
        assert action_space.shape is not None
        actions = int(np.prod(action_space.shape))
        self.actor = BAKUNetwork(
            self.make_features_extractor(), actions, chunk, layers, heads, dropout, head != "mse"
        )
        self.actor_target = deepcopy(self.actor).requires_grad_(False)
        self.optimizer = self.optimizer_class(
            self.actor.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def forward(
        self, observations: PyTorchObs, actor: BAKUNetwork
    ) -> tuple[th.Tensor, th.Tensor | None]:
        """What a network says of observations as SB3 keeps them; see ``BAKUNetwork.forward``."""
        said: tuple[th.Tensor, th.Tensor | None] = actor(
            preprocess_obs(observations, self.observation_space, self.normalize_images)
        )
        return said

    def loss(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Of a batch: observations (B, C, H, W), and the actions (B, chunk, A) that followed."""
        mean, log_std = self(random_shift(observations, self.random_shift), self.actor)
        error = F.mse_loss(mean, actions, reduction="none")
        if log_std is not None:
            error = error / (2.0 * th.exp(2.0 * log_std)) + log_std
        loss: th.Tensor = error.sum(dim=2).mean()
        return loss

    def _chunks(self, observation: PyTorchObs, deterministic: bool) -> th.Tensor:
        mean, log_std = self(observation, self.actor_target if self.averaged else self.actor)
        if log_std is not None and not deterministic:
            mean = (mean + th.exp(log_std) * th.randn_like(mean)).clamp(-1, 1)
        chunks: th.Tensor = mean
        return chunks

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._chunks(observation, deterministic)[:, 0]

    def predict(
        self,
        observation: npt.NDArray[Any] | dict[str, npt.NDArray[Any]],
        state: tuple[npt.NDArray[Any], ...] | None = None,
        episode_start: npt.NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[Any], tuple[npt.NDArray[Any], ...] | None]:
        """The smoothed action.

        Args:
            observation: of one environment, or of several.
            state: what the last call returned; None begins anew.
            episode_start: (n,) which environments begin an episode, and forget.
            deterministic: the Gaussian head's mean instead of a sample.

        Returns:
            actions (n, A), or (A,) where one observation was given, and the new state.
        """
        self.set_training_mode(False)
        seen, vectorized = self.obs_to_tensor(observation)
        with th.no_grad():
            chunks = self._chunks(seen, deterministic).cpu().numpy()
        # (n, age, ahead, A): what was said `age` steps ago of the step `ahead` of then
        said = np.full((len(chunks), self.chunk, *chunks.shape[1:]), np.nan, np.float32)
        if state is not None:
            said[:, 1:] = state[0][:, :-1]
            if episode_start is not None:
                said[np.asarray(episode_start, bool)] = np.nan
        said[:, 0] = chunks
        ages = np.arange(self.chunk)
        now = said[:, ages, ages]  # (n, age, A): of the present step
        weights = np.exp(self.smoothing * ages)[None, :, None] * np.isfinite(now)
        scaled = (weights * np.nan_to_num(now)).sum(axis=1) / weights.sum(axis=1)
        assert isinstance(self.action_space, spaces.Box)
        actions = self.unscale_action(scaled.reshape(-1, *self.action_space.shape))
        actions = actions.clip(self.action_space.low, self.action_space.high)
        return (actions if vectorized else actions[0]).astype(np.float32), (said,)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        del data["normalize_images"]
        names = ("chunk", "width", "layers", "heads", "dropout", "smoothing", "averaged")
        data.update({name: getattr(self, name) for name in names}, head=self.head_kind)
        data.update(
            random_shift=self.random_shift,
            lr_schedule=self._dummy_schedule,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
        )
        return data


class BAKU(SafeLoad, Offline):
    """BAKU for one task and one camera, without language: what is left of it with pictures alone.

    It minimises the squared error (or the negative log likelihood) of the next ``chunk`` actions
    over the demonstration's steps; beyond its end its last action goes on. With the encoder "conv"
    at 84x84, two frames stacked and four action dimensions it has 6,887,032 parameters, 6.3 million
    of them in the trunk.

    Paper: Haldar, Peng and Pinto, BAKU: An Efficient Transformer for Multi-Task Policy Learning,
    NeurIPS 2024, https://arxiv.org/abs/2406.07539

    Args:
        policy: "CnnPolicy" (``BAKUPolicy``), or a class.
        env: the environment that it will act in; nothing is learned from it.
        demo: the demonstration with actions, or its file.
        learning_rate: of Adam; by default the authors'. At 3e-4 a run may learn nothing for
            thousands of updates.
        batch_size: steps of the demonstration in an update.
        stats_window_size: SB3's own.
        tensorboard_log: folder, or None.
        policy_kwargs: for ``BAKUPolicy``.
        verbose: 0, 1 or 2.
        seed: of all random generators.
        device: "auto", "cpu", "cuda".
        _init_setup_model: build the network now.

    Raises:
        ValueError: an argument, or the demonstration, does not fit.
        FloatingPointError: from ``learn``: a loss is not finite.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": BAKUPolicy}
    policy: BAKUPolicy

    def __init__(
        self,
        policy: str | type[BAKUPolicy],
        env: GymEnv | str,
        demo: Demonstration | str | PathLike[str] | None = None,
        learning_rate: float | Schedule = 1e-4,
        batch_size: int = 64,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_number("batch_size", batch_size, (int,), 1, np.inf)
        if not callable(learning_rate):
            check_number("learning_rate", learning_rate, (int, float), 0.0, np.inf)
        check_device(device)
        check_action_space("BAKU", env)
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_kwargs,
            stats_window_size,
            tensorboard_log,
            verbose,
            device,
            support_multi_env=True,
            seed=seed,
            supported_action_spaces=(spaces.Box,),
        )
        self.demo = Demonstration.load(demo) if isinstance(demo, str | PathLike) else demo
        self.batch_size = batch_size
        if _init_setup_model:
            if self.demo is None or self.demo.actions is None:
                raise ValueError("BAKU needs demo=: a demonstration with actions, or its file")
            self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        assert isinstance(self.action_space, spaces.Box)
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
        ).to(self.device)
        if self.demo is None or self.env is None:
            return  # a model that was loaded to act
        if isinstance(self.demo, str | PathLike):  # as load(..., demo=PATH) hands it over
            self.demo = Demonstration.load(self.demo)
        stacking = unwrap_vec_wrapper(self.env, VecFrameStack)
        n_stack = stacking.stacked_obs.n_stack if isinstance(stacking, VecFrameStack) else 1
        seen, actions = as_seen(self.demo, self.observation_space, self.action_space, n_stack)
        assert isinstance(seen, np.ndarray)
        steps = np.arange(len(actions))[:, None] + np.arange(self.policy.chunk)
        self._seen = seen
        self._chunks = actions[np.minimum(steps, len(actions) - 1)]  # (T, chunk, A)

    def update(self) -> float:
        """One update; see ``Offline.update``."""
        if self.demo is None:
            raise ValueError("BAKU needs demo= to learn: a demonstration with actions, or its file")
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        drawn = np.random.randint(0, len(self._seen), size=self.batch_size)
        loss = self.policy.loss(
            th.as_tensor(self._seen[drawn], device=self.device),
            th.as_tensor(self._chunks[drawn], device=self.device),
        )
        if not th.isfinite(loss):
            raise FloatingPointError(
                f"BC loss is {loss.item()} at update {self.num_timesteps}: training stopped, the "
                "model saved last is untouched; a lower learning_rate may help"
            )
        self.policy.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.policy.optimizer.step()
        average_in(self.policy.actor, self.policy.actor_target, self.num_timesteps + 1, _TAU)
        return loss.item()

    def _excluded_save_params(self) -> list[str]:
        ours = ("demo", "_seen", "_chunks", "_last_obs", "_last_original_obs")
        return [*super()._excluded_save_params(), *ours]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
