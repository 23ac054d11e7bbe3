"""Draw docs/images/learning.png and print its table, from docs/learning.csv.

    python docs/draw_learning.py [RUN...]

Run folders of `regil train` are taken into that file first, each in place of an older one of the
same task and seed. Success is what `progress.csv` holds: the policy on unseen episodes, evaluated
when the warm-up has ended and from time to time after it.
"""

import csv
import sys
from pathlib import Path

import matplotlib as mpl
import pandas as pd
import yaml

mpl.use("Agg")

from matplotlib import pyplot as plt

HERE = Path(__file__).parent
POINTS = HERE / "learning.csv"
AT = (2_500, 7_500, 15_000)  # agent steps
LEVELS = (0.8, 0.95)
COLOURS = ("#d1495b", "#3d7ea6", "#66a182")


def read(run: Path) -> pd.DataFrame:
    """Agent steps and success of each evaluation, and the minutes that training took."""
    config = yaml.safe_load((run / "config.yaml").read_text())
    with (run / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    evaluated = [row for row in rows if row["eval/success_rate"]]
    seconds = max(float(row["time/time_elapsed"] or 0) for row in rows)
    return pd.DataFrame(
        {
            "task": config["env"].removeprefix("regil/metaworld-").removesuffix("-v0"),
            "seed": config["seed"],
            "steps": [int(float(row["time/total_timesteps"])) for row in evaluated],
            "success": [float(row["eval/success_rate"]) for row in evaluated],
            "minutes": round(seconds / 60, 1),
        }
    )


def keep(runs: list[Path]) -> pd.DataFrame:
    """All that is known, once these runs are among it."""
    known = pd.read_csv(POINTS) if POINTS.exists() else pd.DataFrame()
    for run in runs:
        new = read(run)
        if len(known):
            same = (known.task == new.task[0]) & (known.seed == new.seed[0])
            known = known[~same]
        known = pd.concat([known, new])
    known = known.sort_values(["task", "seed", "steps"])
    known.to_csv(POINTS, index=False)
    return known


def main(runs: list[Path]) -> None:
    """A panel a task; its seeds are its lines, and the ring is the end of the warm-up."""
    known = keep(runs)
    print(f"| task | seed | warm-up | {' | '.join(f'{at:,}' for at in AT)} |", end="")
    print(f" {' | '.join(f'steps to {level}' for level in LEVELS)} | minutes |")
    print("|" + "---|" * (4 + len(AT) + len(LEVELS)))
    figure, axes = plt.subplots(2, 4, figsize=(10, 4.6), sharex=True, sharey=True)
    means = []
    for axis, (task, own) in zip(axes.flat, known.groupby("task"), strict=False):
        rates = []
        for seed, points in own.groupby("seed"):
            colour = COLOURS[seed % len(COLOURS)]
            at = points.iloc[1:].set_index("steps").success
            rates.append([points.success.iloc[0], *(at[step] for step in AT)])
            cells = [task, seed, *(f"{rate:.3g}" for rate in rates[-1])]
            for level in LEVELS:
                reached = points.steps[points.success >= level]
                cells.append(f"{reached.iloc[0]:,}" if len(reached) else "-")
            print("| " + " | ".join(map(str, [*cells, points.minutes.iloc[0]])) + " |")
            axis.plot(points.steps, points.success, "-", color=colour, marker=".", label=seed)
            first = points.iloc[0]
            axis.plot(first.steps, first.success, "o", ms=9, color=colour, fillstyle="none")
        means.append([sum(column) / len(column) for column in zip(*rates, strict=True)])
        axis.set_title(task, fontsize=10)
        axis.set_ylim(0, 1.03)
        axis.tick_params(labelbottom=True)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(means) :]:
        axis.axis("off")
    over = [sum(column) / len(column) for column in zip(*means, strict=True)]
    print(f"| mean over tasks | | {' | '.join(f'{mean:.3f}' for mean in over)} | | | |")
    axes.flat[1].legend(title="seed", fontsize=8, loc="lower right")
    figure.supxlabel("agent steps (two frames each)", fontsize=10)
    figure.supylabel("success, 40 unseen goals", fontsize=10)
    figure.tight_layout()
    figure.savefig(HERE / "images" / "learning.png", dpi=80)


if __name__ == "__main__":
    main([Path(run) for run in sys.argv[1:]])
