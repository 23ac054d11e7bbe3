"""What decided how `ot`, `tot` and `orca` are computed (docs/rewards.md, "Decisions").

python docs/try_transport.py [ENCODER]    about two minutes

On the episodes of `regil bench ranking`: at how many goals the success is above the failed replay
and standing still, for transport on embeddings as they are and centred, with two entropies; and for
ORCA's last step on registered pictures, with two temperatures. The spread is how many of the
demonstration's frames a row of the plan reaches (exp of its entropy), as a share.
"""

import sys

import numpy as np
from regil_wrappers import make_encoder
from regil_wrappers.alignment import squared_distances
from regil_wrappers.registration import moved_back, register
from regil_wrappers.rewards import demonstration_tau, orca_reward, orca_step
from regil_wrappers.transport import band, context_costs, cosine_costs, transport_plan

from regil_sb3.bench.ranking import _episodes
from regil_sb3.bench.replay import TASKS
from regil_sb3.recording import record_expert


def transported(episode, demo, centred, temporal, entropy):
    """Minus the transport's cost, and the mean spread of its rows."""
    mean = demo.mean(axis=0) if centred else 0.0
    costs, allowed = cosine_costs(episode - mean, demo - mean), None
    if temporal:
        costs, allowed = context_costs(costs), band(len(episode), len(demo))
    plan = transport_plan(costs, entropy, allowed=allowed)
    rows = plan / plan.sum(axis=1, keepdims=True)
    spread = np.exp(-(rows * np.log(np.maximum(rows, 1e-300))).sum(axis=1))
    return -(plan * costs).sum(), spread.mean() / len(demo)


def covered(episode, demo, per_frame):
    """ORCA's reward in the last step."""
    tau, coverage = demonstration_tau(demo) * (len(demo) if per_frame else 1), None
    for frame in episode:
        coverage = orca_step(coverage, squared_distances(frame, demo), tau)
    return orca_reward(coverage)


def main(encoder="pixels"):
    """Print both tables."""
    encode = make_encoder(encoder).encode
    plain, registered = [], []
    for task in TASKS:
        env_id = f"regil/metaworld-{task}-v0"
        frames = record_expert(env_id)
        for _, episodes in _episodes(env_id, frames, 3):
            demo = encode(frames.frames)
            plain.append((demo, [encode(episode) for episode in episodes]))
            moves = [register(frames.frames[0], episode[0]) for episode in episodes]
            moved = [
                encode(np.stack([moved_back(frame, move) for frame in episode]))
                for episode, move in zip(episodes, moves, strict=True)
            ]
            registered.append((demo, moved))
    print(f"{encoder}, {len(plain)} goals\n\n| reward | embeddings | entropy | first | spread |")
    print("|---|---|---|---|---|")
    for temporal in (False, True):
        for centred in (False, True):
            for entropy in (0.01, 0.05):
                found = np.array(
                    [
                        [transported(e, demo, centred, temporal, entropy) for e in episodes]
                        for demo, episodes in plain
                    ]
                )
                first = (found[:, 0, 0] > found[:, 1:, 0].max(axis=1)).sum()
                cells = ("tot" if temporal else "ot", "centred" if centred else "as they are")
                print(f"| {' | '.join(cells)} | {entropy} | {first} | {found[..., 1].mean():.2f} |")
    print("\n| orca's temperature | first by its last step | success, failed, standing (median) |")
    print("|---|---|---|")
    for per_frame in (False, True):
        last = np.array([[covered(e, demo, per_frame) for e in es] for demo, es in registered])
        first = (last[:, 0] > last[:, 1:].max(axis=1)).sum()
        medians = ", ".join(f"{value:.2g}" for value in np.median(last, axis=0))
        print(f"| {'N tau' if per_frame else 'tau'} | {first} | {medians} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
