"""Decides how the encoder's convolutions are computed.

    python docs/measure_update.py

Forward and forward + backward of the default encoder on a batch of 64 observations of 84x84x6, one
thread, medians in ms; the variants of the network take turns.
"""

import time

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from regil_sb3.policies import ConvEncoder

SPACE = spaces.Box(0, 255, (6, 84, 84), np.uint8)
ROUNDS = 30


class SpaceToDepth(ConvEncoder):
    """The first convolution as 4x4 blocks of pixels, then a 2x2 convolution."""

    def __init__(self, space):
        super().__init__(space)
        self.convolutions[0] = nn.Sequential(nn.PixelUnshuffle(4), nn.Conv2d(96, 16, 2))


class ChannelsLast(ConvEncoder):
    def __init__(self, space):
        super().__init__(space)
        self.convolutions.to(memory_format=th.channels_last)

    def forward(self, observations):
        return super().forward(observations.contiguous(memory_format=th.channels_last))


def main() -> None:
    th.set_num_threads(1)
    networks = {"plain": ConvEncoder, "channels last": ChannelsLast, "space to depth": SpaceToDepth}
    built = {name: network(SPACE) for name, network in networks.items()}
    optimizers = {name: th.optim.Adam(network.parameters()) for name, network in built.items()}
    batch = th.randint(0, 255, (64, 6, 84, 84), dtype=th.uint8)
    times = {(name, kind): [] for name in built for kind in ("forward", "both")}
    for _ in range(ROUNDS):
        for name, network in built.items():
            start = time.perf_counter()
            with th.no_grad():
                network(batch.float() / 255)
            middle = time.perf_counter()
            loss = network(batch.float() / 255).sum()
            optimizers[name].zero_grad()
            loss.backward()
            optimizers[name].step()
            times[name, "forward"].append(middle - start)
            times[name, "both"].append(time.perf_counter() - middle)
    print("| network | forward (ms) | forward + backward (ms) |\n|---|---|---|")
    for name in built:
        forward, both = (1e3 * np.median(times[name, kind]) for kind in ("forward", "both"))
        print(f"| {name} | {forward:.1f} | {both:.1f} |")


if __name__ == "__main__":
    main()
