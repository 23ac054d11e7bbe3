"""How often would the guide succeed if it saw exactly where everything is?

    python docs/try_true_places.py TASK [EPISODES]

with hammer, or another of Meta-World's tasks, or door (robosuite's). The path is corrected as the
guide corrects it, with displacements from the simulator in place of those seen: the most that
better eyes could win. Door stands up to 14 degrees turned, so there also: the path turned about the
place of the grasp, and the hand turned, too. The same unseen places for each, two demonstrations.
"""

import sys

import gymnasium as gym
import numpy as np
from regil_wrappers.path import Path
from scipy.spatial.transform import Rotation

import regil_sb3  # noqa: F401
from regil_sb3.recording import EVALUATION_SEEDS, record_expert

DOOR = "regil/robosuite-door-panda-v0"
REACHED, AHEAD, RAMP = 0.3, 10, 0.15  # as the guide has them
HOWS = {"shifted": (False, 0.0), "path turned": (True, 0.0), "path and hand turned": (True, 1.0)}


def scene(env):
    """(places (n, 3), hand (3,), turn about the vertical): m and radians."""
    places, sim = env.unwrapped.targets(), env.unwrapped._sim
    if env.spec.id != DOOR:
        return places, np.zeros(3), 0.0  # the hand starts in one place
    w, _, _, z = sim.sim.data.get_body_xquat(sim.door.root_body)
    return places, sim.sim.data.site_xpos[sim.robots[0].eef_site_id].copy(), 2 * np.arctan2(z, w)


def corrected(path, shifts, turned, turning):
    """(T, 3) action units: the path to where the places are now."""
    # What is taken up is brought where it was brought; but the door (and what it turns) stays
    taken, brought = shifts[0], shifts[1] if len(shifts) > 1 else np.zeros(3)
    brought = taken if turned is not None else brought
    places = np.stack([path.corrected(i, taken, brought) for i in range(len(path))])
    if turning:
        off = path.places - path.places[path.grasp]
        places += ramp(len(path)) * (turned.apply(off) - off)
    return places


def ramp(n):
    return np.minimum(1, (np.arange(n) + 1) / (RAMP * n))[:, None]


def replay(env, goal, actions, home, turning, hand_turn):
    """Whether one episode succeeds; hand_turn in action units for each radian."""
    env.reset(seed=goal)
    places, hand, turn = scene(env)
    facts = env.unwrapped.metadata["regil"]
    unit, gripper, rotations = facts["step_cm"] / 100, -1, facts.get("rotation_dims", [])
    path = Path(np.clip(actions[:, :3].astype(float), -1, 1), actions[:, gripper])
    turned = Rotation.from_rotvec([0, 0, turn - home[2]]) if env.spec.id == DOOR else None
    way = corrected(path, (places - home[0]) / unit, turned, turning)
    turns = np.cumsum(actions[:, rotations], axis=0)
    if turning:
        share = ramp(len(path))
        turns = turns + share * (turned.apply(turns) - turns)
        turns = turns + share * [0, 0, hand_turn * (turn - home[2])]
    believed, rotated = (hand - home[1]) / unit, np.zeros(len(rotations))
    at, last = 0, len(path) - 1
    while True:
        i = min(at, last)
        action = actions[i].copy()
        action[:3] = np.clip(way[i] - believed, -1, 1)
        action[rotations] = np.clip(turns[i] - rotated, -1, 1)
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return bool(info["is_success"])
        believed, rotated = believed + action[:3], rotated + action[rotations]
        for j in range(at, min(at + AHEAD, last + 1)):
            if path.gripper_moves(at, j):
                break
            if (np.abs(way[j] - believed) <= REACHED).all():
                at = j + 1
                break


def turn_unit(env):
    """Radians that the hand turns about the vertical in a step of 1, in free air."""

    def turn():
        return Rotation.from_matrix(data.site_xmat[site].reshape(3, 3).copy())

    env.reset(seed=0)
    sim = env.unwrapped._sim
    data, site = sim.sim.data, sim.robots[0].eef_site_id
    before, action = turn(), np.array([0, 0, 0, 0, 0, 0.5, -1], np.float32)
    for i in range(16):
        action[5] *= i < 6
        env.step(action)
    return (turn() * before.inv()).as_rotvec()[2] / 3


def main(task, episodes):
    """Print the table."""
    env = gym.make(DOOR if task == "door" else f"regil/metaworld-{task}-v0", obs="state")
    hows = dict(list(HOWS.items())[: 3 if task == "door" else 1])
    unit = 1.0
    if task == "door":
        env.unwrapped._measure = lambda: np.zeros(env.observation_space.shape)  # nobody looks
        unit = turn_unit(env)
        print(f"one step of 1 turns the hand by {unit:.3f} rad")
    print(f"| task | demonstration | {' | '.join(hows)} |\n|---|---|{'---|' * len(hows)}")
    for seed in (0, 1):
        demo = record_expert(env.spec.id, seed)
        env.reset(seed=int(demo.metadata["seed"]))
        home = scene(env)
        goals = range(EVALUATION_SEEDS, EVALUATION_SEEDS + episodes)
        shares = [
            np.mean([replay(env, g, demo.actions, home, turning, t / unit) for g in goals])
            for turning, t in hows.values()
        ]
        print(f"| {task} | {seed} | " + " | ".join(f"{share:.2f}" for share in shares) + " |")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 20)
