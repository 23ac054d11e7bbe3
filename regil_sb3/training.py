"""One run, from settings to ``evaluation.json``.

- ``make_env``: an environment with the retrieval wrappers, vectorised and stacked.
- ``TrainingCallback``: progress, evaluation on the selection seeds, the models on disk.
- ``train``, ``resume``: learn in a run folder.
- ``evaluate_run``: policy, guided replay and behaviour cloning on the same unseen seeds.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Collection
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from regil_wrappers import Demonstration
from regil_wrappers.frames import stated
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack
from tqdm import tqdm

from regil_sb3.background import at_rest
from regil_sb3.baselines import BAKU, BC, Offline, vinn_act
from regil_sb3.checkpoint import CheckpointCallback, ReplayableEpisode
from regil_sb3.envs import exists_once
from regil_sb3.evaluation import (
    EVALUATION_SEED,
    METHODS,
    SELECTION_SEED,
    Act,
    Evaluation,
    ResetWhenAsked,
    evaluate,
    guide_act,
    policy_act,
)
from regil_sb3.files import replacing
from regil_sb3.logs import AppendingCSV, Forgiving
from regil_sb3.recording import action_limits
from regil_sb3.report.success_films import save_films
from regil_sb3.run_folder import (
    best_so_far,
    checkpoints_of,
    forget_checkpoints,
    has_checkpoint,
    load_calibration,
    locked,
    refuse_finished,
    refuse_removed,
    refuse_unwritable,
    save_calibration,
    save_model,
    steps_learned,
)
from regil_sb3.settings import ALGOS, OURS, Settings
from regil_sb3.td3bc import TD3BC
from regil_sb3.watch import Watch

Learner = TD3BC | BAKU

BC_UPDATES = 5_000  # of the "BC" that tables compare with: the demonstration alone


def make_env(
    settings: Settings, demo: Path, n_envs: int | None = None, evaluates: bool = False
) -> VecEnv:
    """The environment of a run, as SB3 wants it.

    Args:
        settings: of the run.
        demo: the demonstration's file, given to the retrieval wrappers.
        n_envs: instead of the run's own number.
        evaluates: whether it is for `evaluate` alone (`ResetWhenAsked`).

    Raises:
        ValueError: the environment, its arguments or the demonstration do not fit.
    """
    wrappers = settings.wrappers(str(demo))
    n_envs = n_envs or settings.n_envs

    def wrap(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        once = exists_once(env)
        if once and n_envs > 1:
            env.close()
            raise ValueError(f"{settings.env} exists once: n_envs is {n_envs}, take 1")
        for wrapper, arguments in wrappers:
            env = wrapper(env, **arguments)
        if once:
            return ResetWhenAsked(env, evaluates)
        return ReplayableEpisode(env)

    try:
        env: VecEnv = make_vec_env(
            settings.env,
            n_envs=n_envs,
            seed=settings.seed,
            wrapper_class=wrap,
            env_kwargs=settings.env_kwargs,
        )
    except TypeError as error:  # an argument that the environment or a wrapper does not have
        raise ValueError(f"{settings.env} cannot be made with these settings: {error}") from error
    if settings.frame_stack > 1:
        env = VecFrameStack(env, settings.frame_stack)
    return env


def action_repeat(env: VecEnv) -> int:
    """Frames that pass in one agent step, as far as the environment says."""
    return int(stated(env.get_attr("metadata")[0]).get("action_repeat", 1))


class TrainingCallback(BaseCallback):
    """Shows progress, evaluates the policy as it learns, and keeps the models on disk.

    The policy is evaluated for the first time when the warm-up has ended and its BC updates are
    done, then every ``every`` steps. ``model.zip`` is the last, ``best_model.zip`` the best on the
    selection seeds; each replaces the old file at once, so that a failed save loses nothing.
    Without an environment to evaluate in there is no best.
    """

    def __init__(
        self, run: Path, env: VecEnv | None, every: int, episodes: int, watch: Watch
    ) -> None:
        super().__init__()
        self.run, self.watch = run, watch
        self.eval_env = env
        self.every, self.episodes = every, episodes
        self.best = best_so_far(run / "progress.csv")
        self._next = every
        self._first = True
        self._bar = tqdm(unit="step", dynamic_ncols=True)

    def _on_training_start(self) -> None:
        self._repeat = action_repeat(self.training_env)
        self._next = (self.num_timesteps // self.every + 1) * self.every
        self._first = self.best < 0
        self._bar.reset(self._learner._total_timesteps)
        self._bar.initial = self._bar.n = self._bar.last_print_n = self.num_timesteps
        self._bar.refresh()

    @property
    def _learner(self) -> Learner:
        assert isinstance(self.model, TD3BC | BAKU)
        return self.model

    def _on_rollout_start(self) -> None:
        refuse_removed(self.run, self.num_timesteps)
        if self._first and getattr(self.model, "pretrained", False):
            self._keep(self.eval_env)
            self._first = False

    def _on_step(self) -> bool:
        model = self._learner
        self._bar.update(self.num_timesteps - self._bar.n)
        online = model if isinstance(model, TD3BC) and not isinstance(model, Offline) else None
        if online is not None:
            if self._bar.n % 50 < model.n_envs:
                self._describe(online)
            self.logger.record("time/frames", self.num_timesteps * self._repeat)
        if self.num_timesteps >= self._next:
            self._keep(None if online is not None and online.in_warmup else self.eval_env)
            self._next += self.every
        return True

    def _describe(self, model: TD3BC) -> None:
        recent = model.ep_success_buffer
        success = f"{np.mean(recent):.2f}" if recent else "-"
        phase = "guide acts" if model.in_warmup else "policy acts"
        best = f", best {self.best:.2f}" if self.best >= 0 else ""
        warned = f", warned of {', '.join(self.watch.said)}" if self.watch.said else ""
        self._bar.set_description_str(phase, refresh=False)
        self._bar.set_postfix_str(
            f"success {success}{best}, {model.success_buffer.episodes} episodes kept{warned}"
        )

    def _keep(self, eval_env: VecEnv | None) -> None:
        """Save what is learned, once it is evaluated where there is an environment for it."""
        save_calibration(self.training_env, self.run / "calibration.json")
        with at_rest(self.model):
            if eval_env is None:
                save_model(self._learner, self.run / "model.zip")
            else:
                self._evaluate(eval_env)

    def _evaluate(self, env: VecEnv) -> None:
        self._bar.set_description_str("evaluating")
        result = evaluate(policy_act(self.model), env, self.episodes, SELECTION_SEED)
        success = float(np.mean(result.successes))
        self.logger.record("eval/success_rate", success)
        self.logger.record("eval/retrieval_reward", float(np.mean(result.returns)))
        self._learner.dump_logs()
        save_model(self._learner, self.run / "model.zip")
        if success > self.best:
            self.best = success
            save_model(self._learner, self.run / "best_model.zip")

    def _on_training_end(self) -> None:
        self.close()

    def close(self) -> None:
        """End the progress bar."""
        self._bar.close()


def _to_evaluate_in(settings: Settings, demo: Path) -> AbstractContextManager[VecEnv | None]:
    """A second environment, for the policy as it learns; none where it is not to be evaluated."""
    if not settings.eval_episodes:
        return nullcontext()
    return closing(make_env(settings, demo, n_envs=1))


def train(settings: Settings, demo: Demonstration, run: Path) -> None:
    """Learn, and leave a run folder with config, demonstration, logs and models.

    From a demonstration without actions `TD3BC` learns by the reward alone, and where there is no
    second environment the policy is not evaluated as it learns; a line says so.

    Raises:
        ValueError: the folder holds a run already, or the settings do not fit.
        KeyboardInterrupt: passed on after everything is saved.
    """
    refuse_finished(run)
    if demo.actions is None and settings.algo in OURS:
        settings = settings.without_guide()
        print(
            "the demonstration has no actions: no guide, no warm-up and no behaviour cloning, "
            "the reward alone is learned from",
            file=sys.stderr,
        )
    run.mkdir(parents=True, exist_ok=True)
    with locked(run):
        demo.save(run / "demo.hdf5")
        with closing(make_env(settings, run / "demo.hdf5")) as env:
            if settings.eval_episodes and exists_once(env.get_attr("unwrapped")[0]):
                settings = replace(settings, eval_episodes=0)
                print(
                    f"{settings.env} exists once: the policy is evaluated when all is learned",
                    file=sys.stderr,
                )
            with _to_evaluate_in(settings, run / "demo.hdf5") as eval_env:
                model = _new_model(settings, demo, env)
                if isinstance(model, TD3BC) and settings.steps <= model.warmup_steps:
                    raise ValueError(
                        f"{settings.steps} steps end before the warm-up of {model.warmup_steps} "
                        "does: take more --steps, or a smaller --set warmup_steps=N"
                    )
                env.reset()  # where the retrieval wrappers compare first frames
                settings.save(
                    run / "config.yaml",
                    encoder=settings.retrieval("encoder"),
                    k=settings.retrieval("k"),
                    horizon=settings.retrieval("horizon"),
                    action_repeat=action_repeat(env),
                    demo_actions=None if demo.actions is None else len(demo.actions),
                    defaults=settings.defaults(),
                )
                _learn(model, settings, run, eval_env)


def has_learned(run: Path, settings: Settings) -> bool:
    """Whether a run has made all its steps, evaluated or not."""
    if not (run / "model.zip").exists() or has_checkpoint(run):
        return False
    return steps_learned(run / "model.zip") >= settings.steps


def resume(run: Path) -> Settings:
    """Go on with a run that was interrupted, wherever it was, as if it had not been.

    One that learns from the demonstration alone has no checkpoints: it goes on from the model that
    Ctrl-C or an evaluation saved last, or begins anew. A run is one's own: an encoder that its
    config names as code is run. Of one that was stopped in its evaluation nothing is left to learn.

    Raises:
        ValueError: no run, or one that has ended already.
    """
    settings = Settings.load(run / "config.yaml", trust=True)
    demo = Demonstration.load(run / "demo.hdf5")
    offline = issubclass(ALGOS[settings.algo], Offline)
    with locked(run):
        if has_learned(run, settings):
            if not (run / "evaluation.json").exists():
                return settings
            raise ValueError(
                f"{run} has learned all its steps: start a new run, or use `regil evaluate` on "
                "this one"
            )
        with (
            closing(make_env(settings, run / "demo.hdf5")) as env,
            _to_evaluate_in(settings, run / "demo.hdf5") as eval_env,
        ):
            if offline and (run / "model.zip").exists():
                model = ALGOS[settings.algo].load(run / "model.zip", env=env, demo=demo)
            else:
                model = _new_model(settings, demo, env)
                if not has_checkpoint(run):
                    env.reset()  # as a new run does: it was killed before one
            _learn(model, settings, run, eval_env)
    return settings


def _learn(model: Learner, settings: Settings, run: Path, eval_env: VecEnv | None) -> None:
    log = run / "progress.csv"
    checkpoints = None
    if isinstance(model, TD3BC) and not isinstance(model, Offline):
        checkpoints = CheckpointCallback(checkpoints_of(run), log=log)
        checkpoints.restore(model)
    done = model.num_timesteps
    anew = not done and not (checkpoints is not None and checkpoints.restored)
    if anew:
        if checkpoints is not None and log.exists() and log.stat().st_size:
            warnings.warn(
                f"{run} has no checkpoint to go on from: it begins anew at step 0", stacklevel=3
            )
        log.unlink(missing_ok=True)
        (run / "warnings.jsonl").unlink(missing_ok=True)
    # The callback reads the log before it is reopened
    watch = Watch(run / "warnings.jsonl")
    callback = TrainingCallback(run, eval_env, settings.eval_every, settings.eval_episodes, watch)
    formats: list[KVWriter] = [
        Forgiving(log.name, lambda: AppendingCSV(log)),
        Forgiving("TensorBoard's log", lambda: TensorBoardOutputFormat(str(run))),
    ]
    model.set_logger(Logger(str(run), formats))
    callbacks: list[BaseCallback] = [watch, callback]
    callbacks += [] if checkpoints is None else [checkpoints]
    try:
        model.learn(settings.steps - done, callbacks, reset_num_timesteps=anew)
        save_model(model, run / "model.zip")
        forget_checkpoints(run)
    except KeyboardInterrupt:
        if checkpoints is None:
            save_model(model, run / "model.zip")
        raise
    finally:
        if checkpoints is not None:
            checkpoints.close()
        watch.close()
        callback.close()
        model.logger.close()
        if isinstance(model, TD3BC):
            try:
                save_films(model.success_buffer, run / "success_buffer.npz")
            except OSError as error:  # not worth more than the error that is under way
                print(f"success_buffer.npz is not saved: {error}", file=sys.stderr)


def _new_model(settings: Settings, demo: Demonstration, env: VecEnv) -> Learner:
    algorithm: Any = ALGOS[settings.algo]
    try:
        model: Learner = algorithm(
            settings.policy, env, demo=demo, seed=settings.seed, **settings.hyperparams
        )
    except (TypeError, AssertionError, AttributeError) as error:  # of the policy's arguments
        name = algorithm.__name__
        raise ValueError(f"the settings do not fit {name} or its policy: {error}") from error
    return model


def train_bc(settings: Settings, demo: Demonstration, env: VecEnv, updates: int) -> BC:
    """The "BC" of tables: the run's network, augmentation and batch, on the demonstration alone."""
    changes = {"buffer_size": 1, "warmup_steps": 0, "bc_coef": 1.0, "q_coef": 0.0}
    hyperparams = {**settings.hyperparams, **changes}
    model = _new_model(replace(settings, algo="bc", hyperparams=hyperparams), demo, env)
    assert isinstance(model, BC)
    model.set_logger(Logger(None, []))
    with tqdm(total=updates, desc="behaviour cloning", unit="update", dynamic_ncols=True) as bar:

        def show(*_: Any) -> bool:
            bar.update(1)
            return True

        model.learn(updates, show)
    return model


def _bc_model(settings: Settings, demo: Demonstration, env: VecEnv, run: Path, trust: bool) -> BC:
    """A run's "BC", from its folder or trained now."""
    if (run / "bc_model.zip").exists():
        return BC.load(run / "bc_model.zip", trust=trust, buffer_size=1)
    bc = train_bc(settings, demo, env, BC_UPDATES)
    try:
        save_model(bc, run / "bc_model.zip")
    except OSError as error:  # the next evaluation trains it again
        print(f"bc_model.zip is not saved: {error}", file=sys.stderr)
    return bc


class UnsavedError(OSError):
    """An evaluation is done, and ``evaluation.json`` could not be written.

    Attributes:
        results: what would be in it.
    """

    def __init__(self, why: str, results: dict[str, Any]) -> None:
        super().__init__(why)
        self.results = results


def evaluate_run(
    run: Path, episodes: int, trust: bool = False, only: Collection[str] = tuple(METHODS)
) -> dict[str, Any]:
    """Evaluate a run's last and best model, both guides and BC, and write ``evaluation.json``.

    BC is trained here when the folder has no ``bc_model.zip`` yet. Beside a model that was cloned
    from the demonstration alone, VINN-style replay is evaluated instead. Without a demonstration's
    actions there is neither guide nor BC.

    Args:
        run: the folder.
        episodes: unseen episodes, the same for each method.
        trust: whether config and models may name anything, and so run code (``Settings.load``,
            ``TD3BC.load``).
        only: which of `METHODS`; BC, which has to be trained, is not where it is not asked for.

    Returns:
        What was written; of what was ``asked``, what the run has: a guide that was never calibrated
        is not corrected.

    Raises:
        ValueError: no run folder, one without a model, or one in which nothing can be written; or
            its config names code, and is not trusted.
        UnsavedError: what was found, which could not be written.
    """
    settings = Settings.load(run / "config.yaml", trust)
    if not (run / "model.zip").exists():
        raise ValueError(f"{run} has no model.zip yet: train it first")
    refuse_unwritable(run)
    demo = Demonstration.load(run / "demo.hdf5")
    results: dict[str, Any] = {}
    filmed: Evaluation | None = None

    def play(name: str, act: Act, env: VecEnv) -> None:
        nonlocal filmed
        if name not in only:
            return
        with tqdm(total=episodes, desc=f"evaluating {name}", dynamic_ncols=True) as bar:

            def show(result: Evaluation) -> None:
                bar.set_postfix_str(f"success {np.mean(result.successes):.2f}", refresh=False)
                bar.update(1)

            result = evaluate(act, env, episodes, EVALUATION_SEED, show)
        results[name] = result.as_dict()
        if name == "policy":
            filmed = result

    # One after the other: of a robot there are not two
    with closing(make_env(settings, run / "demo.hdf5", 1, evaluates=True)) as env:
        algorithm = ALGOS[settings.algo]
        model = algorithm.load(run / "model.zip", trust=trust, buffer_size=1)
        offline = isinstance(model, Offline)
        results["steps"] = model.num_timesteps
        results["frames"] = 0 if offline else model.num_timesteps * action_repeat(env)
        play("policy", policy_act(model), env)
        if (run / "best_model.zip").exists():
            best = algorithm.load(run / "best_model.zip", trust=trust, buffer_size=1)
            play("best_policy", policy_act(best), env)
        if load_calibration(env, run / "calibration.json"):
            play("corrected_guide", guide_act, env)
        if not offline and "bc" in only and demo.actions is not None:
            play("bc", policy_act(_bc_model(settings, demo, env, run, trust)), env)
    if not {"guide", "vinn"}.isdisjoint(only):
        with closing(make_env(settings.plain(), run / "demo.hdf5", 1, evaluates=True)) as env:
            if env.has_attr("guide_action"):
                play("guide", guide_act, env)
            if offline and env.has_attr("retriever"):
                play("vinn", vinn_act(demo, settings.retrieval("k")), env)
    results["seeds"] = list(range(EVALUATION_SEED, EVALUATION_SEED + episodes))
    results["asked"] = [name for name in METHODS if name in only]
    try:
        with replacing(run / "evaluation.json") as file:
            file.write(json.dumps(results, indent=1).encode())
    except OSError as error:
        raise UnsavedError(f"{run}/evaluation.json is not saved: {error}", results) from error
    if filmed is not None:
        _save_film(filmed, demo, env.action_space, run / "episode.hdf5")
    return results


def _save_film(
    result: Evaluation, demo: Demonstration, space: spaces.Space[Any], path: Path
) -> None:
    """Keep an evaluation's first episode as a demonstration; what is none costs the film alone."""
    assert isinstance(space, spaces.Box)
    own = {
        **action_limits(space),
        "image_size": None,  # what the policy sees may be of another than what is compared
        "seed": EVALUATION_SEED,
    }
    try:
        episode = result.first_episode({**demo.metadata, **own})
        if episode is not None:
            episode.save(path)
    except (ValueError, OSError) as error:
        print(f"{path.name} is not saved: {error}", file=sys.stderr)
