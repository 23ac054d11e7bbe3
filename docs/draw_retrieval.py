"""Draw docs/images/retrieval.png: one step of retrieval, at an unseen goal.

python docs/draw_retrieval.py
"""

from pathlib import Path

import gymnasium as gym
import matplotlib as mpl
import numpy as np

mpl.use("Agg")

from matplotlib import pyplot as plt
from regil_wrappers import Retriever

import regil_sb3  # registers the environments  # noqa: F401
from regil_sb3.recording import EVALUATION_SEEDS, record_expert

ENV = "regil/metaworld-drawer-open-v0"
STEP = 14  # of the episode, drawn
ORANGE, BLUE = "#ff9c5a", "#6cabff"


def main() -> None:
    """Recent frames above, their distances to the demonstration's in the middle, it below."""
    demo = record_expert(ENV)
    retriever = Retriever(demo)
    env = gym.make(ENV)
    frame, _ = env.reset(seed=EVALUATION_SEEDS)
    frames, rows = [], []
    for _ in range(STEP + 1):
        retriever.step(frame)
        frames.append(frame)
        rows.append(retriever.distances)
        frame, *_ = env.step(env.unwrapped.expert_action())
    env.close()
    found = retriever.alignment
    costs = np.stack(rows[-found.window :])

    figure = plt.figure(figsize=(9, 6), layout="constrained")
    grid = figure.add_gridspec(3, found.window, height_ratios=(1, 1.1, 1))
    pairs = dict(retriever.path())  # of each recent frame, the last match
    for row in range(found.window):
        for line, picture, title in (
            (
                0,
                frames[STEP - found.window + 1 + row],
                f"episode, frame {STEP - found.window + 1 + row}",
            ),
            (2, demo.frames[pairs[row]], f"demonstration, frame {pairs[row]}"),
        ):
            axis = figure.add_subplot(grid[line, row])
            axis.imshow(picture, interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(title, fontsize=8)

    axis = figure.add_subplot(grid[1, :])
    axis.imshow(np.sqrt(costs), cmap="Greys", aspect="auto", interpolation="nearest")
    axis.axvspan(found.q_star + 0.5, costs.shape[1] - 0.5, color="w", alpha=0.75, linewidth=0)
    axis.axvline(found.q_star + 0.5, color="k", linestyle="--", linewidth=1)
    last = found.window - 1
    axis.plot(found.candidates, [last] * len(found.candidates), "s", color=BLUE, label="candidates")
    axis.plot(found.q_star, last, "s", color=BLUE, markeredgecolor="k", label="q*, the last")
    columns = [j for _, j in retriever.path()]
    axis.plot(columns, [i for i, _ in retriever.path()], "o-", color=ORANGE, label="S-DTW's path")
    axis.plot(found.end, last, "*", color=ORANGE, markersize=16, markeredgecolor="k", label="end")
    axis.set_yticks(range(found.window), range(STEP - last, STEP + 1))
    axis.set_ylabel("episode")
    axis.set_xlabel("demonstration")
    axis.legend(fontsize=8, loc="lower right")
    figure.savefig(Path(__file__).parent / "images" / "retrieval.png", dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    main()
