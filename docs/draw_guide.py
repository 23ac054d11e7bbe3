"""Draw docs/images/guide.png: what the corrected guide sees and does, at one unseen goal a task.

python docs/draw_guide.py
"""

from pathlib import Path

import gymnasium as gym
import matplotlib as mpl

mpl.use("Agg")

from matplotlib import pyplot as plt
from regil_wrappers import RetrievalGuideWrapper

import regil_sb3  # registers the environments  # noqa: F401
from regil_sb3.recording import EVALUATION_SEEDS, record_expert
from regil_sb3.report.guide_view import guide_view

TASKS = ("button-press", "hammer", "plate-slide")
ORANGE, BLUE = "#ff9c5a", "#6cabff"


def main() -> None:
    """Two rows: the demonstration's first picture, and an unseen episode's."""
    figure, axes = plt.subplots(2, len(TASKS), figsize=(9, 6.2), layout="constrained")
    for column, task in enumerate(TASKS):
        env_id = f"regil/metaworld-{task}-v0"
        demo = record_expert(env_id)
        env = RetrievalGuideWrapper(gym.make(env_id), demo, correction="servo")
        env.reset(seed=1)
        while env.calibration() is None:
            *_, terminated, truncated, _ = env.step(env.guide_action())
            if terminated or truncated:
                env.reset()
        first, _ = env.reset(seed=EVALUATION_SEEDS)
        view = guide_view(demo, first, env.calibration())
        env.close()
        for axis, picture in zip(axes[:, column], (demo.frames[0], first), strict=True):
            axis.imshow(picture, interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_xlim(-0.5, 83.5)
            axis.set_ylim(83.5, -0.5)
        axes[0, column].set_title(task, fontsize=10)
        if view is None:
            continue
        axes[0, column].plot(*view.path.T, color=ORANGE, linewidth=1.5)
        axes[1, column].plot(*view.corrected.T, color=BLUE, linewidth=1.5)
        axes[1, column].annotate(
            "", view.moved[1], view.moved[0], arrowprops={"color": "w", "arrowstyle": "->"}
        )
        for axis, pixel, colour in (
            (axes[0, column], view.moved[0], ORANGE),
            (axes[1, column], view.believed, BLUE),
        ):
            axis.plot(*pixel, "o", markersize=16, markerfacecolor="none", markeredgecolor=colour)
    axes[0, 0].set_ylabel("the demonstration's first picture")
    axes[1, 0].set_ylabel("an unseen episode's")
    figure.savefig(Path(__file__).parent / "images" / "guide.png", dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    main()
