"""TD3BC: TD3, warmed up by a guide, with a decaying behaviour-cloning term on a success buffer."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedIOBase
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from regil_wrappers import Demonstration
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    Schedule,
    TrainFreq,
)
from stable_baselines3.common.utils import polyak_update, safe_mean
from stable_baselines3.common.vec_env import VecFrameStack, unwrap_vec_wrapper
from stable_baselines3.td3.policies import MlpPolicy, MultiInputPolicy, TD3Policy
from torch.nn import functional as F  # noqa: N812

from regil_sb3.arguments import check_action_space, check_arguments
from regil_sb3.as_seen import as_seen
from regil_sb3.bc_schedule import BySuccess, by_time
from regil_sb3.callbacks import close_callbacks
from regil_sb3.collection import Collection
from regil_sb3.guided import guide_actions
from regil_sb3.model_file import SafeLoad
from regil_sb3.policies import ImagePolicy, average_in
from regil_sb3.relabelling import EpisodeRewards, episode_reward_class, rewards_come_late
from regil_sb3.replay_buffer import FrameReplayBuffer, truncate_newest
from regil_sb3.success_buffer import SuccessBuffer

SelfTD3BC = TypeVar("SelfTD3BC", bound="TD3BC")


class TD3BC(SafeLoad, TD3):
    """TD3 that starts from one demonstration.

    The guide (``regil_wrappers.RetrievalGuideWrapper``) acts for the first ``warmup_steps``;
    episodes that succeed fill a success buffer, which holds the demonstration from the start; then
    the policy acts. Its actor minimises Eq. 4 of ReGIL,
    ``-Q(o, pi(o)) + lambda(t) * BC(success buffer)``, with
    ``lambda(t) = bc_coef * max(1 - t / bc_steps, bc_floor)``.

    This is ReGIL's *online* TD3 with a decaying BC term. It is not the offline TD3+BC of Fujimoto
    and Gu (2021). With ``bc_coef=0, warmup_steps=0, actor_q="q1", normalize_q=False,
    reward_scale=1.0, exploration_std=0.0`` and TD3's own values for the arguments they share, it is
    SB3's TD3 to the last bit.

    Paper: ReGIL, https://regil2026.github.io/

    Args:
        policy: "CnnPolicy" (``ImagePolicy``), "MlpPolicy", "MultiInputPolicy", or a class.
        env: the environment, wrapped by the guide (for the warm-up) and a reward.
        demo: the demonstration, or its file. May be None only without a BC term.
        learning_rate: of actor and critic.
        buffer_size: transitions in the replay buffer, all environments together.
        learning_starts: steps before the first update. No random actions are taken for it while
            the guide acts.
        batch_size: transitions, and as many steps of the success buffer, in an update.
        tau: soft update of the target networks.
        gamma: discount factor.
        train_freq: environment steps (of all environments at once) between updates.
        gradient_steps: updates each time; a float is updates per *transition*, all environments
            counted: 0.5 makes one update for every two transitions; it needs a ``train_freq`` in
            steps.
        action_noise: SB3's own; replaces ``exploration_std``.
        replay_buffer_class: None chooses ``FrameReplayBuffer`` for images, else SB3's; their twins
            of ``regil_sb3.relabelling`` where rewards come at the episode's end.
        replay_buffer_kwargs: for ``replay_buffer_class``.
        optimize_memory_usage: SB3's own; images never need it.
        n_steps: length of n-step returns; dict observations need 1.
        policy_delay: critic updates for one actor update.
        target_policy_noise: std of the target's smoothing noise.
        target_noise_clip: its limit.
        warmup_steps: steps in which the guide acts. An episode begun in warm-up is finished in it;
            environments that are done before others go on with the guide until all are.
        guide_again: share of the episodes after the warm-up that the guide acts in, from beginning
            to end, as long as the policy succeeds less often than the guide did.
        bc_coef: lambda at the start; 0 for no BC term.
        bc_floor: lambda's floor as a share of ``bc_coef``.
        bc_steps: steps until lambda would reach 0; None is the whole of ``learn``.
        bc_schedule: "time" as above; "success": lambda falls only while the policy's own recent
            episodes succeed about as often as ever, and rises where they do not; Q comes in as
            lambda falls, so that the actor begins, and where it got worse goes on, by behaviour
            cloning alone.
        bc_loss: "mse" sums squared errors over action dimensions; "nll" is the Gaussian negative
            log likelihood with ``bc_std``, up to a constant.
        bc_std: std of that Gaussian, in actions scaled to [-1, 1].
        bc_pretrain_steps: updates of the actor by the BC term alone when the warm-up ends.
        success_buffer_size: steps in the success buffer, the demonstration's included.
        keep_own_successes: whether the policy's own successful episodes go there too.
        actor_q: "min" of both critics in the actor's loss, or TD3's "q1".
        normalize_q: divide the actor's Q by the batch's mean absolute Q.
        actor_in_warmup: whether the actor is updated while the guide still acts; if not, the critic
            learns alone until then, and ``bc_pretrain_steps`` are the actor's first updates.
        q_coef: weight of Q in the actor's loss; 0 is behaviour cloning on the success buffer alone,
            and no critic gradient reaches the actor's encoder.
        reward_scale: factor on rewards when they are sampled (the replay buffer keeps them raw);
            "auto" asks the environment's ``reward_scale`` (1 / its unit) and makes one unit a step
            for ever worth 10 in Q; it is 1 where the environment does not say.
        exploration_std: std of Gaussian exploration noise on scaled actions, clipped at
            ``exploration_clip``.
        exploration_clip: see there.
        bootstrap_success: do not treat success as an end (Eq. 6 of the paper has no mask).
        stats_window_size: episodes in the logged means.
        tensorboard_log: folder, or None.
        policy_kwargs: for the policy.
        verbose: 0, 1 or 2.
        seed: of all random generators.
        device: "auto", "cpu", "cuda".
        _init_setup_model: build the networks now.

    Raises:
        ValueError: an argument, or the demonstration, does not fit; said before anything is
            allocated.
        MemoryError: the replay buffer would not fit into memory.
        FloatingPointError: from ``learn``: a reward, observation or loss is not finite.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": ImagePolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }

    def __init__(
        self,
        policy: str | type[TD3Policy],
        env: GymEnv | str,
        demo: Demonstration | str | PathLike[str] | None = None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 500,
        batch_size: int = 64,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int | float = 0.5,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 3,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.3,
        warmup_steps: int = 5_000,
        guide_again: float = 0.0,
        bc_coef: float = 2.0,
        bc_floor: float = 0.1,
        bc_steps: int | None = None,
        bc_schedule: Literal["time", "success"] = "time",
        bc_loss: Literal["mse", "nll"] = "mse",
        bc_std: float = 0.1,
        bc_pretrain_steps: int = 1_000,
        success_buffer_size: int = 5_000,
        keep_own_successes: bool = False,
        actor_q: Literal["min", "q1"] = "min",
        normalize_q: bool = True,
        actor_in_warmup: bool = True,
        q_coef: float = 1.0,
        reward_scale: float | Literal["auto"] = "auto",
        exploration_std: float = 0.1,
        exploration_clip: float = 0.3,
        bootstrap_success: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_arguments(locals())
        check_action_space("TD3BC", env)
        self.demo = Demonstration.load(demo) if isinstance(demo, str | PathLike) else demo
        train_freq = tuple(train_freq) if isinstance(train_freq, list) else train_freq
        self.warmup_steps, self.guide_again = warmup_steps, guide_again
        self.bc_coef, self.bc_floor, self.bc_steps = bc_coef, bc_floor, bc_steps
        self.bc_schedule = bc_schedule
        self.keep_own_successes, self.actor_in_warmup = keep_own_successes, actor_in_warmup
        self._by_success = BySuccess(bc_floor)
        self.bc_loss, self.bc_std, self.bc_pretrain_steps = bc_loss, bc_std, bc_pretrain_steps
        self.success_buffer_size = success_buffer_size
        self.actor_q, self.normalize_q, self.q_coef = actor_q, normalize_q, q_coef
        self.reward_scale = reward_scale
        self.exploration_std, self.exploration_clip = exploration_std, exploration_clip
        self.bootstrap_success = bootstrap_success
        self.used_reward_scale = 1.0  # what "auto" turned out to be
        self.pretrained = False  # whether the BC updates at the end of warm-up are done
        self.n_stack = 1
        self._updates_due = 0.0
        self._in_step = False  # between an environment's step and its place in the replay buffer
        if _init_setup_model:
            self._check_demo()
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,  # type: ignore[arg-type]
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_delay=policy_delay,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _setup_model(self) -> None:
        space = self.observation_space
        takes_dicts = issubclass(self.policy_class, MultiInputPolicy)
        if takes_dicts != isinstance(space, spaces.Dict):
            right = "CnnPolicy or MlpPolicy" if takes_dicts else "MultiInputPolicy"
            raise ValueError(
                f"{self.policy_class.__name__} does not fit the observations {space}: use {right}"
            )
        if self.policy_kwargs.get("share_features_extractor"):
            raise ValueError(
                "policy_kwargs.share_features_extractor=True trains the encoder by the actor's "
                "loss alone: leave it out (CnnPolicy has shared_encoder)"
            )
        if isinstance(self.demo, str | PathLike):  # as load(..., demo=PATH) hands it over
            self.demo = Demonstration.load(self.demo)
        if self.env is not None:  # without one, what was saved with the model holds
            stacking = unwrap_vec_wrapper(self.env, VecFrameStack)
            self.n_stack = (
                stacking.stacked_obs.n_stack if isinstance(stacking, VecFrameStack) else 1
            )
        if self.bc_coef > 0 and self._vec_normalize_env is not None:
            raise ValueError(
                "the success buffer keeps observations as they are: leave out VecNormalize, "
                "or set bc_coef=0"
            )
        if isinstance(space, spaces.Dict) and self.n_steps > 1:
            raise ValueError(
                f"n_steps={self.n_steps} with dict observations is not supported by SB3's replay "
                "buffer: set n_steps=1"
            )
        chosen = self.replay_buffer_class
        late = self.env is not None and rewards_come_late(self.env)
        if chosen is None and (late or is_image_space(space)):
            buffer = episode_reward_class(space, self.n_steps) if late else FrameReplayBuffer
            own: dict[str, Any] = (
                {"n_stack": self.n_stack}
                if is_image_space(space)
                else {"optimize_memory_usage": self.optimize_memory_usage}
            )
            if is_image_space(space) or self.n_steps > 1:
                own |= {"n_steps": self.n_steps, "gamma": self.gamma}
            # TD3's set-up would warn that n_steps is ignored for a class of one's own
            with _that_fits():
                self.replay_buffer = buffer(  # type: ignore[assignment]
                    self.buffer_size,
                    space,
                    self.action_space,
                    self.device,
                    self.n_envs,
                    **(own | self.replay_buffer_kwargs),
                )
        self.success_buffer = SuccessBuffer(
            self.success_buffer_size, self.n_stack if is_image_space(space) else 1
        )
        if self.demo is not None and self.demo.actions is not None:
            self._add_demonstration(self.demo)
        given = dict(self.replay_buffer_kwargs)
        with _that_fits():
            super()._setup_model()
        # What set-up added would be saved, and hold against what `load` replaces
        self.replay_buffer_class, self.replay_buffer_kwargs = chosen, given
        self._by_success.floor = self.bc_floor
        self._returns: dict[str, list[float]] = {}
        assert self.action_space.shape is not None
        self._collection = Collection(self.n_envs, self.action_space.shape, self.keep_own_successes)

    def _check_demo(self) -> None:
        if not isinstance(self.demo, Demonstration | None):
            raise ValueError(f"demo is {self.demo!r:.60}: it takes one Demonstration, or its file")
        if self.bc_coef == 0:
            return
        if self.demo is None:
            raise ValueError(f"bc_coef={self.bc_coef} needs demo=: give its file, or set bc_coef=0")
        if self.demo.actions is None:
            raise ValueError(
                "the demonstration has no actions, which the BC term needs: set bc_coef=0"
            )

    def _add_demonstration(self, demo: Demonstration) -> None:
        assert isinstance(self.action_space, spaces.Box)
        seen = as_seen(demo, self.observation_space, self.action_space, self.n_stack)
        self.success_buffer.add(*seen, pinned=True)

    # -- collecting ------------------------------------------------------------------------------

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "TD3BC",
        progress_bar: bool = False,
    ) -> Any:
        assert self.env is not None, "You must set the environment before calling learn()"
        self._check_demo()
        if self.bc_coef > 0 and not self.success_buffer.steps:
            assert self.demo is not None
            self._add_demonstration(self.demo)
        if self.warmup_steps > 0 and not self.env.has_attr("guide_action"):
            raise ValueError(
                f"warmup_steps={self.warmup_steps} needs a guide: wrap the environment in "
                "regil_wrappers.RetrievalGuideWrapper, or set warmup_steps=0"
            )
        if self.reward_scale == "auto":
            self.used_reward_scale = 1.0
            if self.env.has_attr("reward_scale"):
                # Q of one unit a step for ever is 10: a critic that starts near 0 gets there soon
                own = float(self.env.get_attr("reward_scale")[0])
                self.used_reward_scale = own * 10.0 * (1.0 - self.gamma)
        else:
            self.used_reward_scale = float(self.reward_scale)
        if rewards_come_late(self.env) and not isinstance(self.replay_buffer, EpisodeRewards):
            raise ValueError(
                "the environment's rewards come at the episode's end, and this replay buffer would "
                "serve placeholders: use one of regil_sb3.relabelling"
            )
        if self._in_step:  # interrupted there: the environment is ahead of the replay buffer
            self._last_obs, self._in_step = None, False
        begins_anew = reset_num_timesteps or self._last_obs is None
        result = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if reset_num_timesteps:
            self.pretrained = False
            self._by_success = BySuccess(self.bc_floor)
        if begins_anew:  # the environments were reset, whatever they were doing
            self._collection.restart(self.num_timesteps < self.warmup_steps)
            if isinstance(self.replay_buffer, FrameReplayBuffer):
                self.replay_buffer.close_episodes()
            elif isinstance(self.replay_buffer, ReplayBuffer):
                truncate_newest(self.replay_buffer)
        return result

    @property
    def in_warmup(self) -> bool:
        """Whether an episode of the warm-up is still under way in some environment."""
        return bool(self._collection.warmup.any())

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None = None,
        n_envs: int = 1,
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        assert isinstance(self.action_space, spaces.Box)
        assert self.env is not None
        guided = self._collection.guided
        if guided.all():
            action = np.zeros((n_envs, *self.action_space.shape), self.action_space.dtype)
            buffer_action = action.astype(np.float32)
        else:
            action, buffer_action = super()._sample_action(learning_starts, action_noise, n_envs)
            if self.exploration_std > 0 and action_noise is None:
                noise = np.random.normal(0, self.exploration_std, buffer_action.shape)
                noise = noise.clip(-self.exploration_clip, self.exploration_clip)
                buffer_action = (buffer_action + noise).clip(-1, 1).astype(np.float32)
                # float32 may put an unscaled bound outside by its last bit
                action = self.policy.unscale_action(buffer_action)
                action = action.clip(self.action_space.low, self.action_space.high)
        if guided.any():
            indices = np.flatnonzero(guided)
            suggested = guide_actions(self.env, indices)
            self._collection.note_guide(indices, self.policy.scale_action(suggested))
            if self.env.has_attr("disturbed_action"):
                suggested = guide_actions(self.env, indices, "disturbed_action")
            action[indices] = suggested
            buffer_action[indices] = self.policy.scale_action(suggested)
        self._in_step = True
        return action, buffer_action

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: npt.NDArray[Any] | None = None
    ) -> None:
        # SB3 reads is_success at the episode's end alone: a success on the way counts too
        for i, info in enumerate(infos):
            self._collection.succeeded[i] |= bool(info.get("is_success", False))
            if dones is not None and dones[i] and "is_success" in info:
                info["is_success"] = bool(self._collection.succeeded[i])
        super()._update_info_buffer(infos, dones)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: npt.NDArray[Any],
        new_obs: Any,
        reward: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        self._check_finite(reward, new_obs)
        before = self._last_obs
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        # The policy is trained by the BC term only when all environments are through the warm-up
        waits = bool((self._collection.warmup & ~dones).any())
        for i, info in enumerate(infos):
            self._collection.step(i, before, buffer_action[i], float(reward[i]), info)
            if dones[i]:
                self._end_episode(i, waits)
        self._in_step = False

    def _end_episode(self, env: int, waits: bool) -> None:
        episodes = self._collection
        success = bool(episodes.succeeded[env])
        if not episodes.guided[env]:
            part = episodes.lengths[env] / max(self._total_timesteps - self.warmup_steps, 1)
            self._by_success.episode(success, part)
        elif not episodes.calibrating(env):
            self._by_success.guided_episode(success)
        shown = episodes.demonstration(env)
        if shown is not None and not self.success_buffer.add(*shown):
            warnings.warn(
                f"a successful episode of {len(shown[1])} steps does not fit beside the "
                f"demonstration into success_buffer_size={self.success_buffer_size}: it is not "
                "kept",
                stacklevel=2,
            )
        for name, value in episodes.returns(env).items():
            self._returns.setdefault(name, []).append(value)
            del self._returns[name][: -self._stats_window_size]
        behind = self.guide_again > 0 and self._by_success.behind_guide
        again = behind and np.random.random() < self.guide_again
        episodes.begin(env, self.num_timesteps < self.warmup_steps, again or waits)

    def _check_finite(self, reward: npt.NDArray[Any], new_obs: Any) -> None:
        values = new_obs if isinstance(new_obs, dict) else {"observation": new_obs}
        for name, value in {**values, "reward": reward}.items():
            bad = ~np.isfinite(value).reshape(self.n_envs, -1).all(axis=1)
            if bad.any():
                raise FloatingPointError(
                    f"{name} of environment {int(bad.argmax())} is not finite at step "
                    f"{self.num_timesteps}: training stopped, the model saved last is untouched"
                )

    def dump_logs(self) -> None:
        """Write log data, under fixed names wherever SB3's Monitor sits."""
        for name, values in self._returns.items():
            if values:
                self.logger.record(f"rollout/{name}", safe_mean(values))
        self.logger.record("success_buffer/steps", self.success_buffer.steps)
        self.logger.record("success_buffer/episodes", self.success_buffer.episodes)
        self.logger.record("time/guided", int(self._collection.guided.any()))
        self.logger.record("train/reward_scale", self.used_reward_scale)
        super().dump_logs()

    # -- learning --------------------------------------------------------------------------------

    def bc_coef_now(self) -> float:
        """lambda(t) at the present step."""
        if self.bc_schedule == "success":
            return self.bc_coef * self._by_success.share
        steps = self.bc_steps if self.bc_steps is not None else max(self._total_timesteps, 1)
        return self.bc_coef * by_time(self.num_timesteps, steps, self.bc_floor)

    def q_coef_now(self) -> float:
        """Weight of Q in the actor's loss at the present step."""
        if self.bc_schedule == "success" and self.bc_coef > 0:
            return self.q_coef * (1.0 - self._by_success.share)
        return self.q_coef

    def _bc_term(self) -> th.Tensor:
        """Behaviour-cloning loss of a batch of the success buffer, a scalar."""
        seen, actions = self.success_buffer.sample(self.batch_size)
        observations = (
            {k: th.as_tensor(v, device=self.device) for k, v in seen.items()}
            if isinstance(seen, dict)
            else th.as_tensor(seen, device=self.device)
        )
        predicted = self.actor.mu(encode(self.actor, self._preprocessed(observations)))
        error = F.mse_loss(predicted, th.as_tensor(actions, device=self.device), reduction="none")
        loss = error.sum(dim=1).mean()
        return loss if self.bc_loss == "mse" else loss / (2.0 * self.bc_std**2)

    def _preprocessed(self, observations: Any) -> Any:
        """As SB3 hands them to an encoder, images augmented; once for all networks."""
        if isinstance(self.policy, ImagePolicy):
            images = self.policy.augment(observations).float()
            return images.div_(255) if self.policy.normalize_images else images
        return preprocess_obs(observations, self.observation_space, self.policy.normalize_images)

    def pretrain_bc(
        self, steps: int, progress: Callable[[int], None] | None = None, before: int = 0
    ) -> float:
        """Train the actor by the BC term alone; its target averages over the last updates.

        Args:
            steps: updates.
            progress: called with the number of updates done after each.
            before: updates that were done in earlier calls, which this one goes on from.

        Returns:
            The last update's loss; nan without any.
        """
        if steps < 1:
            return np.nan
        self.policy.set_training_mode(True)
        for done in range(before + 1, before + steps + 1):
            loss = self._bc_term()
            self._require_finite("BC loss", loss.item())
            self.actor.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._require_finite_gradient("actor", self.actor)
            self.actor.optimizer.step()
            average_in(self.actor, self.actor_target, done, self.tau)
            if progress is not None:
                progress(done)
        self.logger.record("train/bc_loss", loss.item())
        return loss.item()

    def _require_finite(self, name: str, value: float) -> None:
        if not np.isfinite(value):
            raise FloatingPointError(
                f"{name} is {value} at step {self.num_timesteps}, update {self._n_updates}: "
                "training stopped, the model saved last is untouched; a lower learning_rate or "
                f"reward_scale (now {self.used_reward_scale:g}) may help"
            )

    def _require_finite_gradient(self, name: str, network: th.nn.Module) -> None:
        sums = [p.grad.sum() for p in network.parameters() if p.grad is not None]
        self._require_finite(f"{name}'s gradient", th.stack(sums).sum().item())

    def _number_of_updates(self, gradient_steps: int | float) -> int:
        """Turn updates per transition (a float) into whole updates, keeping the remainder."""
        if not isinstance(gradient_steps, float):
            return gradient_steps
        assert isinstance(self.train_freq, TrainFreq)
        self._updates_due += gradient_steps * self.train_freq.frequency * self.n_envs
        whole = int(self._updates_due)
        self._updates_due -= whole
        return whole

    def train(self, gradient_steps: int | float, batch_size: int = 64) -> None:
        """Update critic and actor; a diff of ``TD3.train`` with Eq. 4 as the actor's loss."""
        if not self.pretrained and not self.in_warmup and self.num_timesteps >= self.warmup_steps:
            if self.bc_coef > 0:
                self.pretrain_bc(self.bc_pretrain_steps)
            self.pretrained = True

        assert self.replay_buffer is not None
        if not self.replay_buffer.size():  # no episode has ended, whose rewards come then
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        shared = self.critic.features_extractor is self.actor.features_extractor
        trains_actor = self.actor_in_warmup or not self.in_warmup

        actor_losses, critic_losses, bc_losses = [], [], []
        for _ in range(self._number_of_updates(gradient_steps)):
            self._n_updates += 1
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma
            observations = self._preprocessed(replay_data.observations)
            next_observations = self._preprocessed(replay_data.next_observations)
            dones = (
                th.zeros_like(replay_data.dones) if self.bootstrap_success else replay_data.dones
            )

            with th.no_grad():
                # Target: smoothed target action, min of the target critics
                noise = replay_data.actions.clone().data.normal_(0, self.target_policy_noise)
                noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
                next_features = encode(self.critic_target, next_observations)
                next_actions = self.actor_target.mu(
                    next_features if shared else encode(self.actor_target, next_observations)
                )
                next_actions = (next_actions + noise).clamp(-1, 1)
                next_q_values = th.cat(
                    q_values(self.critic_target, next_features, next_actions), dim=1
                )
                next_q_values, _ = th.min(next_q_values, dim=1, keepdim=True)
                rewards = replay_data.rewards * self.used_reward_scale
                target_q_values = rewards + (1 - dones) * discounts * next_q_values

            # Critic
            features = encode(self.critic, observations)
            if shared and self.q_coef == 0:
                features = features.detach()
            current_q_values = q_values(self.critic, features, replay_data.actions)
            critic_loss = sum(F.mse_loss(q, target_q_values) for q in current_q_values)
            assert isinstance(critic_loss, th.Tensor)
            critic_losses.append(critic_loss.item())
            self._require_finite("critic loss", critic_losses[-1])
            self.critic.optimizer.zero_grad()
            critic_loss.backward()  # type: ignore[no-untyped-call]
            self._require_finite_gradient("critic", self.critic)
            self.critic.optimizer.step()

            # Delayed actor, Eq. 4
            if self._n_updates % self.policy_delay == 0 and trains_actor:
                actor_loss = th.zeros((), device=self.device)
                self._before_actor(observations, features.detach())
                q_coef = self.q_coef_now()
                if q_coef > 0:
                    # Critic and BC term alone train an image policy's encoders; another policy's
                    # features are taken anew, as TD3 does
                    with th.no_grad():
                        features = (
                            features.detach()
                            if isinstance(self.policy, ImagePolicy)
                            else encode(self.critic, observations)
                        )
                    with th.set_grad_enabled(getattr(self.policy, "q_trains_encoder", True)):
                        seen = features if shared else encode(self.actor, observations)
                    actions = self.actor.mu(seen)
                    q = self._actor_q(features, actions)
                    scale = q.abs().mean().detach().clamp(min=1e-8) if self.normalize_q else 1.0
                    actor_loss = -q_coef * q.mean() / scale
                if self.bc_coef > 0:
                    bc_term = self._bc_term()
                    bc_losses.append(bc_term.item())
                    actor_loss = actor_loss + self.bc_coef_now() * bc_term
                actor_losses.append(actor_loss.item())
                self._require_finite("actor loss", actor_losses[-1])
                self.actor.optimizer.zero_grad()
                actor_loss.backward()  # type: ignore[no-untyped-call]
                self._require_finite_gradient("actor", self.actor)
                self.actor.optimizer.step()

            if self._n_updates % self.policy_delay == 0:
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                # A shared target encoder has moved with the critic's
                own = self.actor.mu if shared else self.actor
                own_target = self.actor_target.mu if shared else self.actor_target
                polyak_update(own.parameters(), own_target.parameters(), self.tau)
                polyak_update(
                    self.critic_batch_norm_stats, self.critic_batch_norm_stats_target, 1.0
                )
                polyak_update(self.actor_batch_norm_stats, self.actor_batch_norm_stats_target, 1.0)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/bc_coef", self.bc_coef_now())
        self.logger.record("train/q_coef", self.q_coef_now())
        if actor_losses:
            self.logger.record("train/actor_loss", np.mean(actor_losses))
        if bc_losses:
            self.logger.record("train/bc_loss", np.mean(bc_losses))
        if critic_losses:
            self.logger.record("train/critic_loss", np.mean(critic_losses))
            self.logger.record("train/q", current_q_values[0].mean().item())

    def _before_actor(self, observations: Any, features: th.Tensor) -> None:
        """See an actor update's batch, preprocessed, and the critic's features (B, F) of it."""

    def _actor_q(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        if self.actor_q == "q1":
            q: th.Tensor = self.critic.q_networks[0](th.cat([features, actions], dim=1))
            return q
        return th.cat(q_values(self.critic, features, actions), dim=1).min(dim=1).values

    def learn(
        self: SelfTD3BC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "TD3BC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfTD3BC:
        """Learn for ``total_timesteps`` transitions, all environments and the warm-up counted.

        However it ends, callbacks that have a ``close`` are closed.
        """
        try:
            return super().learn(
                total_timesteps=total_timesteps,
                callback=callback,
                log_interval=log_interval,
                tb_log_name=tb_log_name,
                reset_num_timesteps=reset_num_timesteps,
                progress_bar=progress_bar,
            )
        finally:
            close_callbacks(callback)

    # -- the replay buffer on disk ---------------------------------------------------------------

    def save_replay_buffer(self, path: str | Path | BufferedIOBase) -> None:
        """Save the replay buffer: a ``FrameReplayBuffer`` as plain arrays, SB3's as SB3 does.

        ``regil_sb3.checkpoint.CheckpointCallback`` keeps all else that a run needs to go on, too.

        Args:
            path: the file (".npz", for SB3's ".pkl", is added where it has no suffix), or an open
                one.
        """
        if not isinstance(self.replay_buffer, FrameReplayBuffer):
            super().save_replay_buffer(path)
            return
        file = open_path(path, "w", self.verbose, "npz")
        np.savez(file, **self.replay_buffer.state())
        if file is not path:
            file.close()

    def load_replay_buffer(
        self, path: str | Path | BufferedIOBase, truncate_last_traj: bool = True
    ) -> None:
        """Load what `save_replay_buffer` saved; plain arrays run no code, SB3's pickles may.

        Args:
            path: the file, or an open one.
            truncate_last_traj: of a ``FrameReplayBuffer``, whether ``learn`` begins with a new
                episode; False goes on in the open one, where nothing was done since it was saved.

        Raises:
            ValueError: of a ``FrameReplayBuffer``, the file is no such buffer, or of another size.
            OSError: it cannot be read.
        """
        if not isinstance(self.replay_buffer, FrameReplayBuffer):
            super().load_replay_buffer(path, truncate_last_traj)
            return
        file = open_path(path, "r", self.verbose, "npz")
        try:
            self.replay_buffer.load_state(dict(np.load(file, allow_pickle=False)))
        except (ValueError, TypeError, KeyError, EOFError, BadZipFile) as error:
            raise ValueError(f"{path} is no replay buffer for this model: {error}") from error
        finally:
            if file is not path:
                file.close()
        if truncate_last_traj:
            self._last_obs = None

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "_last_obs",  # load() resets the environment
            "_last_original_obs",
            "demo",
            "success_buffer",
            "_in_step",
            "_collection",
            "_returns",
        ]


@contextmanager
def _that_fits() -> Iterator[None]:
    """SB3's buffers warn of too little memory, and let the machine run out of it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*enough memory to store the complete")
        try:
            yield
        except UserWarning as warning:
            if "enough memory" not in str(warning):
                raise
            raise MemoryError(f"{str(warning).strip()}: set buffer_size lower") from None


def encode(network: Any, preprocessed: Any) -> th.Tensor:
    """Features (B, F) of an actor or a critic of SB3's."""
    features: th.Tensor = network.features_extractor(preprocessed)
    return features


def q_values(critic: Any, features: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
    """Q of every critic, (B, 1) each."""
    inputs = th.cat([features, actions], dim=1)
    return tuple(q(inputs) for q in critic.q_networks)
