"""`regil doctor` on a demonstration of Meta-World's button-press, on it spoilt, and on two others.

Prints the table of docs/doctor.md: python docs/doctor_cases.py [EPISODES]
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import numpy as np
from regil_wrappers import Demonstration

from regil_sb3 import doctor
from regil_sb3.doctor.findings import status
from regil_sb3.recording import record_expert

ENV = "regil/metaworld-button-press-v0"


def cases() -> dict[str, Demonstration]:
    """Demonstrations by what they are."""
    right = record_expert(ENV)
    other_camera = record_expert(ENV, env_kwargs={"camera": "corner3"})
    assert right.actions is not None

    def changed(demo: Demonstration = right, **fields: Any) -> Demonstration:
        return dataclasses.replace(demo, **fields)

    n, still = len(right.actions) // 2, np.zeros((40, 4), np.float32)
    still[:, 3] = right.actions[0, 3]
    unsaid = {**other_camera.metadata, "camera": None}
    return {
        "right": right,
        "upside down": changed(frames=right.frames[:, ::-1]),
        "another camera": other_camera,
        "another camera, unsaid": changed(other_camera, metadata=unsaid),
        "red and blue exchanged": changed(frames=right.frames[..., ::-1]),
        "another task (hammer)": record_expert("regil/metaworld-hammer-v0"),
        "half the frame rate": changed(
            frames=right.frames[: 2 * n + 1 : 2], actions=right.actions[: 2 * n : 2], successes=None
        ),
        "40 idle frames at its start": changed(
            frames=np.concatenate([np.repeat(right.frames[:1], 40, axis=0), right.frames]),
            actions=np.concatenate([still, right.actions]),
            successes=None,
        ),
    }


def main() -> None:
    """Examine each."""
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 2
    print("| demonstration | exit status | wrong | warning |\n|---|---|---|---|")
    for name, demo in cases().items():
        found = doctor.examine(ENV, demo, episodes)
        said = {
            verdict: ", ".join(f.check for f in found if f.verdict == verdict)
            for verdict in ("wrong", "warning")
        }
        print(f"| {name} | {status(found)} | {said['wrong']} | {said['warning']} |", flush=True)


if __name__ == "__main__":
    main()
