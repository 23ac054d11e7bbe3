"""rl_zoo3's commands with TD3BC: ``python -m regil_sb3.zoo train | enjoy | record_video | plot``.

Options are rl_zoo3's own. What is different, for TD3BC:

* ``-optimize`` has a search space (`sample_td3bc`)
* evaluations and trials compare the reward that is learned from, and training's successes are
  kept for ``plot -y success``
* ``--save-replay-buffer`` keeps the success buffer and what the guide has learned, too, and ``-i``
  goes on where the run stopped, without a second warm-up
* no text of a YAML file is evaluated as code

and for all algorithms: evaluation environments get the ``env_kwargs`` of a YAML file.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from regil_sb3.files import replacing
from regil_sb3.replay_buffer import FrameReplayBuffer
from regil_sb3.run_folder import load_calibration, save_calibration
from regil_sb3.td3bc import TD3BC

try:
    from optuna import Trial
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from rl_zoo3.utils import ALGOS
except ImportError as error:
    raise ImportError(f"rl_zoo3 is not installed ({error}): pip install 'regil-sb3[zoo]'") from None

__all__ = [
    "COMMANDS",
    "EVALUATED",
    "Experiment",
    "GoingOn",
    "convert_td3bc",
    "main",
    "sample_td3bc",
]

COMMANDS = {
    "train": "rl_zoo3.train",
    "enjoy": "rl_zoo3.enjoy",
    "record_video": "rl_zoo3.record_video",
    "plot": "rl_zoo3.plots.plot_train",
    "plot_train": "rl_zoo3.plots.plot_train",
    "plot_from_file": "rl_zoo3.plots.plot_from_file",
    "all_plots": "rl_zoo3.plots.all_plots",
}
"""Names of commands, and rl_zoo3's modules that they run."""

# rl_zoo3 evaluates these as Python where they are text
EVALUATED = (
    "normalize",
    "policy_kwargs",
    "replay_buffer_class",
    "replay_buffer_kwargs",
    "monitor_kwargs",
)


class GoingOn(TD3BC):
    """TD3BC for rl_zoo3, whose continued runs count from 0: a second warm-up would follow."""

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "TD3BC",
        reset_num_timesteps: bool | None = None,
        progress_bar: bool = False,
    ) -> GoingOn:
        """Learn for so many transitions more; counters go on unless they are to be reset."""
        fresh = self.num_timesteps == 0 if reset_num_timesteps is None else reset_num_timesteps
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, fresh, progress_bar
        )


class _KeepCalibration(BaseCallback):
    """Keeps what a correcting guide has learned, before rl_zoo3 closes the environment."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if hasattr(self, "model"):  # rl_zoo3 calls this even where nothing was learned
            save_calibration(self.training_env, self.path)


class Experiment(ExperimentManager):
    """rl_zoo3's experiment, with what the module's docstring names."""

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        if self.n_timesteps <= 0 and "n_timesteps" not in hyperparams:
            raise ValueError(
                f"{self.env_name.gym_id}: its section of the YAML file has no n_timesteps: add it, "
                "or say -n STEPS"
            )
        if self.algo == "td3bc":
            for name in EVALUATED:
                if isinstance(hyperparams.get(name), str):
                    raise ValueError(
                        f"{name}: {hyperparams[name]!r} would be evaluated as Python: write plain "
                        "YAML, {key: value}"
                    )
            # As tuples they could not stand in YAML
            success = {"info_keywords": ["is_success"], "reset_keywords": []}
            hyperparams.setdefault("monitor_kwargs", success)
            # rl_zoo3's own Monitor stands inside the wrappers, and reports another reward
            outside = "stable_baselines3.common.monitor.Monitor"
            wrappers = hyperparams.get("env_wrapper") or []  # one may stand there without a list
            wrappers = wrappers if isinstance(wrappers, list) else [wrappers]
            hyperparams["env_wrapper"] = [*wrappers, outside]
        processed = super()._preprocess_hyperparams(hyperparams)
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.env_kwargs
        return processed

    def create_callbacks(self) -> None:
        """rl_zoo3's own, after one that it ends even when a run is interrupted."""
        super().create_callbacks()  # type: ignore[no-untyped-call]
        if self.algo == "td3bc":
            self.callbacks.insert(0, _KeepCalibration(Path(self.save_path) / "calibration.json"))

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """Save the model, and with ``--save-replay-buffer`` what it needs to go on."""
        keeps = self.save_replay_buffer
        if isinstance(getattr(model, "replay_buffer", None), FrameReplayBuffer):
            self.save_replay_buffer = False  # it is kept below
        super().save_trained_model(model)
        if keeps and isinstance(model, TD3BC):
            for name, buffer in _buffers(model).items():
                with replacing(Path(self.save_path) / name) as file:
                    np.savez(file, **buffer.state())

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        model: BaseAlgorithm = super()._load_pretrained_agent(hyperparams, env)
        if isinstance(model, TD3BC):
            folder = Path(self.trained_agent).parent
            load_calibration(env, folder / "calibration.json")
            kept = _buffers(model)
            for name, buffer in kept.items():
                if (folder / name).exists():
                    with np.load(folder / name, allow_pickle=False) as state:
                        buffer.load_state(dict(state))
            rl_zoo3s = [] if "replay_buffer.npz" in kept else ["replay_buffer.pkl"]
            _say_what_is_missing(folder, [*kept, *rl_zoo3s])
        return model


def _say_what_is_missing(folder: Path, needed: Iterable[str]) -> None:
    """Name the buffers that a run did not save, on stderr."""
    if missing := [name for name in needed if not (folder / name).exists()]:
        print(
            f"regil_sb3.zoo: {folder} has no {' and no '.join(missing)}: learning goes on from "
            "empty buffers, with no second warm-up; train with --save-replay-buffer to keep them",
            file=sys.stderr,
        )


def _buffers(model: TD3BC) -> dict[str, Any]:
    """By file: those that save themselves as plain arrays; rl_zoo3 keeps others as it does."""
    found: dict[str, Any] = {"success_buffer.npz": model.success_buffer}
    if isinstance(model.replay_buffer, FrameReplayBuffer):
        found["replay_buffer.npz"] = model.replay_buffer
    return found


def sample_td3bc(
    trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Hyperparameters of a trial: those of TD3BC that decide how it learns.

    What makes a task easier or a run longer is not searched: demonstration, wrappers, encoder,
    warm-up and steps stay as the YAML file has them.

    Args:
        trial: Optuna's.
        n_actions: not used.
        n_envs: not used.
        additional_args: not used.
    """
    sampled = {
        "learning_rate": trial.suggest_float("learning_rate", 3e-5, 1e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 8),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.1, log=True),
        "tau": trial.suggest_float("tau", 0.001, 0.05, log=True),
        "gradient_steps": trial.suggest_categorical("gradient_steps", [0.25, 0.5, 1.0]),
        "policy_delay": trial.suggest_int("policy_delay", 1, 3),
        "bc_coef": trial.suggest_float("bc_coef", 0.1, 10.0, log=True),
        "bc_floor": trial.suggest_float("bc_floor", 0.0, 0.7),
        "bc_schedule": trial.suggest_categorical("bc_schedule", ["time", "success"]),
        "bc_pretrain_steps": trial.suggest_int("bc_pretrain_steps", 0, 4_000, step=500),
        "exploration_std": trial.suggest_float("exploration_std", 0.02, 0.3, log=True),
    }
    converted = convert_td3bc(sampled)
    for name in ("batch_size", "gamma"):
        trial.set_user_attr(name, converted[name])
    return converted


def convert_td3bc(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """TD3BC's arguments from what `sample_td3bc` suggests to Optuna."""
    out = dict(sampled_params)
    out["batch_size"] = 2 ** out.pop("batch_size_pow")
    out["gamma"] = 1.0 - out.pop("one_minus_gamma")
    return out


def register() -> None:
    """Make rl_zoo3 know TD3BC."""
    ALGOS["td3bc"] = GoingOn
    HYPERPARAMS_SAMPLER["td3bc"] = sample_td3bc
    HYPERPARAMS_CONVERTER["td3bc"] = convert_td3bc
    import_module("rl_zoo3.train").ExperimentManager = Experiment  # type: ignore[attr-defined]


def main(argv: list[str]) -> int:
    """Run a command of rl_zoo3's; 2 for bad input, which one line names.

    Args:
        argv: its name, and its options.
    """
    if not argv or argv[0] not in COMMANDS:
        given = f"{argv[0]!r} is no command: " if argv else ""
        print(f"regil_sb3.zoo: {given}use one of {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    register()
    own, sys.argv = sys.argv, [f"regil_sb3.zoo {argv[0]}", *argv[1:]]
    try:
        home = COMMANDS[argv[0]]
        if argv[0] == "record_video":  # no function, only what stands under __main__
            runpy.run_module(home, run_name="__main__")
        else:
            getattr(import_module(home), home.rpartition(".")[2])()
    except (ValueError, TypeError, OSError, MemoryError, AssertionError, ImportError) as error:
        print(f"regil_sb3.zoo: {error}", file=sys.stderr)
        return 2
    finally:
        sys.argv = own
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
