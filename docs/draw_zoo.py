"""Draw docs/images/zoo.png, the learning curves of the runs that docs/zoo.md shows.

python docs/draw_zoo.py SAC_RUN TD3BC_RUN TD3BC_RESUMED_RUN TQC_MONITOR TRIALS

Runs are folders of rl_zoo3's, TQC_MONITOR the file of SB3's Monitor, TRIALS what
`--optimization-log-path` names.
"""

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")

from matplotlib import pyplot as plt

RECENT = 10  # episodes


def training(monitor: Path, begun: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Steps, and the share of the last episodes that succeeded."""
    rows = np.genfromtxt(monitor, delimiter=",", names=True, skip_header=1, dtype=None)
    success = np.array([str(value) == "True" for value in rows["is_success"]], float)
    mean = [success[max(0, i - RECENT + 1) : i + 1].mean() for i in range(len(success))]
    return begun + np.cumsum(rows["l"]), np.array(mean)


def main(sac: Path, td3bc: Path, resumed: Path, tqc: Path, trials: Path) -> None:
    """A panel each."""
    figure, axes = plt.subplots(1, 4, figsize=(12, 2.8))
    axes[0].plot(*training(sac / "0.monitor.csv"))
    axes[0].set_title("SAC, stock rl_zoo3", fontsize=9)
    stopped = training(td3bc / "0.monitor.csv")
    with np.load(resumed / "evaluations.npz") as evaluated:
        begun = int(evaluated["timesteps"][0]) - 500  # --eval-freq
    axes[1].plot(*stopped)
    axes[1].plot(*training(resumed / "0.monitor.csv", begun))
    axes[1].axvline(begun, color="grey", linestyle=":")
    axes[1].set_title("TD3BC, stopped and resumed", fontsize=9)
    axes[2].plot(*training(tqc))
    axes[2].set_title("TQC, guide for 1,000 steps", fontsize=9)
    for trial in sorted(trials.glob("trial_*/evaluations.npz")):
        with np.load(trial) as evaluated:
            axes[3].plot(
                evaluated["timesteps"], evaluated["results"].mean(axis=1), ".-",
                label=trial.parent.name.replace("_", " "),
            )  # fmt: skip
    axes[3].set_title("TD3BC -optimize", fontsize=9)
    axes[3].set_ylabel("return in evaluation", fontsize=8)
    axes[3].legend(fontsize=7)
    for axis in axes[:3]:
        axis.set_ylim(-0.03, 1.03)
        axis.set_ylabel(f"success, last {RECENT} of training", fontsize=8)
    for axis in axes:
        axis.set_xlabel("steps", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "images" / "zoo.png", dpi=80)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
