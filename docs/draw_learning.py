"""Draw docs/images/learning.png and print its table, from run folders of `regil train`.

python docs/draw_learning.py RUN...

Success is what `progress.csv` holds: the policy on unseen episodes, evaluated when the warm-up has
ended and every sixth of the run after it.
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import yaml

mpl.use("Agg")

from matplotlib import pyplot as plt

AT = (2_500, 7_500, 15_000)  # agent steps
LEVELS = (0.8, 0.95)
COLOURS = ("#d1495b", "#3d7ea6", "#66a182")


def curve(run: Path) -> tuple[list[int], list[float], float]:
    """Agent steps and success of each evaluation, and the seconds that training took."""
    with (run / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    evaluated = [row for row in rows if row["eval/success_rate"]]
    steps = [int(float(row["time/total_timesteps"])) for row in evaluated]
    success = [float(row["eval/success_rate"]) for row in evaluated]
    seconds = max(float(row["time/time_elapsed"] or 0) for row in rows)
    return steps, success, seconds


def main(runs: list[Path]) -> None:
    """A panel a task; its seeds are its lines, and the ring is the end of the warm-up."""
    tasks = defaultdict(list)
    for run in runs:
        config = yaml.safe_load((run / "config.yaml").read_text())
        name = config["env"].removeprefix("regil/metaworld-").removesuffix("-v0")
        tasks[name].append((config["seed"], *curve(run)))
    print(f"| task | seed | warm-up | {' | '.join(f'{at:,}' for at in AT)} |", end="")
    print(f" {' | '.join(f'steps to {level}' for level in LEVELS)} | minutes |")
    print("|" + "---|" * (4 + len(AT) + len(LEVELS)))
    figure, axes = plt.subplots(2, 4, figsize=(10, 4.6), sharex=True, sharey=True)
    means = defaultdict(list)
    for axis, (task, seeds) in zip(axes.flat, sorted(tasks.items()), strict=False):
        for colour, (seed, steps, success, seconds) in zip(COLOURS, sorted(seeds), strict=False):
            at = [dict(zip(steps[1:], success[1:], strict=True))[step] for step in AT]
            reached = [
                next((s for s, rate in zip(steps, success, strict=True) if rate >= level), None)
                for level in LEVELS
            ]
            cells = [task, seed, *(f"{rate:.3g}" for rate in (success[0], *at))]
            cells += ["-" if step is None else f"{step:,}" for step in reached]
            print("| " + " | ".join(map(str, [*cells, f"{seconds / 60:.1f}"])) + " |")
            for column, rate in enumerate((success[0], *at)):
                means[column].append(rate)
            axis.plot(steps, success, "-", color=colour, marker=".", label=f"seed {seed}")
            axis.plot(steps[0], success[0], "o", markersize=9, color=colour, fillstyle="none")
        axis.set_title(task, fontsize=10)
        axis.set_ylim(0, 1.03)
        axis.tick_params(labelbottom=True)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(tasks) :]:
        axis.axis("off")
    print(f"| mean | | {' | '.join(f'{sum(m) / len(m):.3f}' for m in means.values())} | | | |")
    axes.flat[0].legend(fontsize=8, loc="lower right")
    figure.supxlabel("agent steps (two frames each)", fontsize=10)
    figure.supylabel("success, 40 unseen goals", fontsize=10)
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "images" / "learning.png", dpi=80)


if __name__ == "__main__":
    main([Path(run) for run in sys.argv[1:]])
