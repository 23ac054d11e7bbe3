"""Is what has moved found better in a network's features than in the pixels themselves?

    python docs/try_features.py [--episodes N] TASK [TASK ...]

Registers the first pictures of unseen episodes with the demonstration's twice: as the guide does,
on pixels, and on the features of EfficientNet-Lite0: of pictures four times as large, at a stride
of 8, so half the pictures' own resolution. Printed for each of these tasks of Meta-World and two
demonstrations: the error of the displacement that follows, and how often replay that is corrected
by it succeeds; and by both, where successes decide which is believed (Thompson sampling, its
failures included).
"""

import argparse
from itertools import product

import cv2
import numpy as np
import torch
from regil_wrappers import RetrievalGuideWrapper, episode
from regil_wrappers.encoders.timm_networks import efficientnet_lite0
from regil_wrappers.matching import comparable, square
from regil_wrappers.pinhole import Pinhole, nearest_to_path, solve_displacement
from regil_wrappers.registration import Displacement, register

from regil_sb3.bench import guide
from regil_sb3.bench.replay import demonstration, guides, play
from regil_sb3.envs import EVALUATION_SEEDS

LARGER, STAGE = 4, 2  # times as large a picture; the network's stage, at a stride of 8 of that
TRUNCATION, EXPLAINED = 1.5, 0.9  # a feature vector's own length is 1 in the mean
HULL_WEIGHT, PULL = 0.2, 0.0015  # as for pixels; in error a pixel of shift
REACH = 28  # px
GROWTH = (0.75, 1.35)
torch.set_num_threads(1)


class Features:
    """Registers two pictures on a network's features."""

    def __init__(self):
        self.network = efficientnet_lite0()._network

    def map(self, picture):
        """(C, H, W): channels of mean 0, whose squares sum to 1 in the mean."""
        x = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None].float()
        size = x.shape[-2:]
        x = torch.nn.functional.interpolate(x, scale_factor=LARGER, mode="bicubic")
        with torch.inference_mode():
            (seen,) = self.network.forward_intermediates(
                (x - 127) / 128, indices=[STAGE], intermediates_only=True, stop_early=True
            )
        seen = torch.nn.functional.interpolate(seen, size=size, mode="bilinear")[0]
        seen = seen - seen.mean((1, 2), keepdim=True)
        return seen / seen.std((1, 2), keepdim=True).clamp(min=1e-6) / len(seen) ** 0.5

    def __call__(self, reference, picture, among=None):
        """What `registration.register` gives."""
        pair = comparable(reference, picture, among)
        if pair.changed is None:
            return None
        maps = self.map(pair.a), self.map(pair.b)
        weights = np.maximum(
            cv2.dilate(pair.changed, square(3, pair.unit)), pair.hull * HULL_WEIGHT
        )
        ys, xs = np.nonzero(pair.hull)
        centre = np.array([xs.min() + xs.max(), ys.min() + ys.max()]) / 2
        sparse = np.zeros_like(weights)
        sparse[::2, ::2] = weights[::2, ::2]
        grid = np.arange(-REACH, REACH + 1, 2) * pair.unit
        shift = min(
            (np.array(s) for s in product(grid, grid)),
            key=lambda s: error(maps, (sparse, sparse), centre, s, 1.0) + PULL * np.hypot(*s),
        )
        growth, masks, seen = 1.0, (weights, weights), pair.changed
        for _ in range(3):
            shift, growth = refine(maps, masks, centre, shift, growth, pair.unit)
            off = errors(maps, [np.ones_like(weights)] * 2, centre, shift, growth)
            explained = [pair.changed * (one.reshape(weights.shape) < EXPLAINED) for one in off]
            if min(one.sum() for one in explained) < 8 * pair.unit**2:
                break
            seen = explained[0]
            masks = tuple(
                cv2.morphologyEx(
                    cv2.dilate(one, square(3, pair.unit)), cv2.MORPH_CLOSE, square(5, pair.unit)
                )
                for one in explained
            )
        left = error(maps, (weights, weights), centre, shift, growth)
        still = error(maps, (weights, weights), centre, np.zeros(2), 1.0)
        ys, xs = np.nonzero(seen)
        point = np.array([xs.mean(), ys.mean()])
        moved = centre + shift + growth * (point - centre) - point
        camera = tuple(map(float, pair.camera))
        return Displacement(
            tuple(point.tolist()), tuple(moved.tolist()), growth, left / still, pair.share, camera
        )


def errors(maps, masks, centre, shift, growth):
    """How far features are off at the masks' pixels, once moved back and once moved on."""
    off = []
    for i, mask in enumerate(masks):
        moving, still = maps[1 - i], maps[i]
        ys, xs = np.nonzero(mask)
        off_centre = np.stack([xs, ys], 1) - centre
        at = centre + (shift + growth * off_centre if i == 0 else (off_centre - shift) / growth)
        size = np.array(still.shape[:0:-1]) - 1
        grid = torch.from_numpy((2 * at / size - 1).astype(np.float32))[None, None]
        found = torch.nn.functional.grid_sample(
            moving[None], grid, padding_mode="border", align_corners=True
        )[0, :, 0]
        off.append((found - still[:, ys, xs]).norm(dim=0).clamp(max=TRUNCATION).numpy())
    return off


def error(maps, masks, centre, shift, growth):
    """Weighted means of these, added."""
    off = errors(maps, masks, centre, shift, growth)
    return sum(
        float(np.average(one, weights=mask[mask > 0])) for one, mask in zip(off, masks, strict=True)
    )


def refine(maps, masks, centre, shift, growth, unit):
    """Coordinate descent with ever smaller steps, as for pixels."""

    def cost(shift, growth):
        if not GROWTH[0] < growth < GROWTH[1]:
            return np.inf
        return error(maps, masks, centre, shift, growth) + 0.05 * abs(np.log(growth))

    least = cost(shift, growth)
    for step, ratio in ((1.0, 1.04), (0.5, 1.02), (0.25, 1.01), (0.1, 1.005)):
        for _ in range(8):
            ways = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]) * step * unit
            near = [(shift + way, growth) for way in ways]
            near += [(shift, growth * ratio), (shift, growth / ratio)]
            costs = [cost(*one) for one in near]
            best = int(np.argmin(costs))
            if costs[best] >= least - 1e-6:
                break
            least, (shift, growth) = costs[best], near[best]
    return shift, growth


class Voted:
    """Two ways of registering; successes decide which is believed."""

    def __init__(self, ways, seed=0):
        self.ways, self.rng = ways, np.random.default_rng(seed)
        self.seen = np.ones((len(ways), 2))

    def __call__(self, *pictures):
        self.chosen = int(self.rng.beta(*self.seen.T).argmax())
        return self.ways[self.chosen](*pictures)

    def tell(self, success):
        self.seen[self.chosen, int(not success)] += 1


def replayed(task, demo, way, episodes):
    """(successes, errors in cm) of corrected replay with this way of registering."""
    reference = guide._make(task, "none")
    reference.reset(seed=int(demo.metadata["seed"]))
    home = guide._targets(reference)[0]
    episode.register = way  # what the wrapper's episodes register with
    own = {**guides()["corrected"], "disturbance": 0.0}
    env = RetrievalGuideWrapper(guide._make(task, "none"), demo, **own)
    guide._calibrate(env, int(demo.metadata["seed"]) + 1)
    won, off = [], []
    for goal in range(EVALUATION_SEEDS, EVALUATION_SEEDS + episodes):
        won.append(play(env, goal))
        if isinstance(way, Voted):
            way.tell(won[-1])
        off.append(np.linalg.norm((solved(env) - 100 * (guide._targets(env)[0] - home))[:2]))
    env.close()
    return won, off


def solved(env):
    """(3,) cm: the displacement that what was registered stands for."""
    found, state = env.displacement, env.calibration()
    if found is None:
        return np.zeros(3)
    camera = Pinhole.from_dict(state["cameras"][0])
    place = nearest_to_path(camera, found.point, env._guide.servo.demonstrated_path())
    plane = np.array(state["plane"])
    shift, _ = solve_displacement(camera, place, found.shift, found.growth, plane)
    return shift * env.unwrapped.metadata["regil"]["step_cm"]


def main(tasks, episodes):
    """Print the table."""
    features = Features()
    heads = [f"error with {name}, median / 90 % (cm)" for name in ("pixels", "features")]
    heads += ["success with pixels", "features", "voted"]
    print(f"| task | demonstration | {' | '.join(heads)} |")
    print(f"|---|---|{'---|' * len(heads)}", flush=True)
    rows = []
    for task, seed in product(tasks, (0, 1)):
        demo = demonstration(task, seed)
        ways = register, features, Voted([register, features])
        won, off = zip(*(replayed(task, demo, way, episodes) for way in ways), strict=True)
        rows.append([f(e) for e in off[:2] for f in (np.median, ninety)] + [*map(np.mean, won)])
        print(f"| {task} | {seed} | {shown(rows[-1])} |", flush=True)
    print(f"| **mean** | | {shown(np.mean(rows, axis=0))} |")


def ninety(values):
    """Their 90th percentile."""
    return np.quantile(values, 0.9)


def shown(row):
    """A row's cells."""
    errors = [f"{row[i]:.2f} / {row[i + 1]:.1f}" for i in (0, 2)]
    return " | ".join([*errors, *(f"{share:.2f}" for share in row[4:])])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="+")
    parser.add_argument("--episodes", type=int, default=20)
    asked = parser.parse_args()
    main(asked.tasks, asked.episodes)
