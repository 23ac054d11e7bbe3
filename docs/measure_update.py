"""Decides what makes an update on a CPU fast.

    OMP_NUM_THREADS=1 python docs/measure_update.py

The default encoder, a batch of 64 observations of 84x84x6, one thread. Variants take turns; the
times are those of the processor, in ms: the smallest, and the median in brackets.
"""

import resource
import subprocess
import sys
import time
from shutil import which

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from torch import nn

from regil_sb3 import TD3BC
from regil_sb3.policies import ConvEncoder, random_shift
from regil_sb3.process import keep_freed_memory

SPACE = spaces.Box(0, 255, (6, 84, 84), np.uint8)
ROUNDS = 20


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


class Noise(gym.Env):
    """Frames of noise; an update does not mind."""

    observation_space = spaces.Box(0, 255, (3, 84, 84), np.uint8)
    action_space = spaces.Box(-1, 1, (4,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.t += 1
        return self.observation_space.sample(), -1.0, False, self.t == 125, {}


def padded_shift(images, pad):
    """The shift as slices of a padded batch."""
    height, width = images.shape[2:]
    padded = np.pad(images.numpy(), ((0, 0), (0, 0), (pad, pad), (pad, pad)), mode="edge")
    corners = th.randint(0, 2 * pad + 1, (len(images), 2)).tolist()
    crops = zip(th.from_numpy(padded), corners, strict=True)
    return th.stack([image[:, y : y + height, x : x + width] for image, (y, x) in crops])


def take_turns(variants):
    """Seconds of processor time, (ROUNDS,) for each of the functions."""
    times = {name: np.empty(ROUNDS) for name in variants}
    for i in range(ROUNDS):
        for name, run in variants.items():
            start = time.thread_time()
            run()
            times[name][i] = time.thread_time() - start
    return times


def cell(times):
    return f"{1e3 * times.min():.1f} ({1e3 * np.median(times):.1f})"


def convolutions():
    batch = th.from_numpy(SPACE.sample()).expand(64, *SPACE.shape).contiguous()
    networks = {
        "plain": ConvEncoder(SPACE),
        "channels last": ChannelsLast(SPACE),
        "space to depth": SpaceToDepth(SPACE),
        "bfloat16": ConvEncoder(SPACE, dtype="bfloat16"),
    }
    if which("c++"):
        networks["torch.compile"] = th.compile(ConvEncoder(SPACE))
    forward = {n: lambda e=e: th.no_grad()(e)(batch.float() / 255) for n, e in networks.items()}
    both = {n: lambda e=e: e(batch.float() / 255).sum().backward() for n, e in networks.items()}
    forward, both = take_turns(forward), take_turns(both)
    print("\n| network | forward | forward + backward |\n|---|---|---|")
    for name in networks:
        print(f"| {name} | {cell(forward[name])} | {cell(both[name])} |")


def small_parts(model):
    batch = th.from_numpy(SPACE.sample()).expand(64, *SPACE.shape).contiguous()
    parameters = [nn.Parameter(p.detach().clone()) for p in model.critic.parameters()]
    for parameter in parameters:
        parameter.grad = th.ones_like(parameter)
    adam = {
        f"Adam, {name}": th.optim.Adam(parameters, lr=1e-9, **kwargs).step
        for name, kwargs in {
            "one tensor at a time": {"foreach": False},
            "foreach": {"foreach": True},
            "fused": {"fused": True},
        }.items()
    }
    parts = {
        **adam,
        "random shift, slices of a padded copy": lambda: padded_shift(batch, 4),
        "random shift": lambda: random_shift(batch, 4),
        "sample of the replay buffer": lambda: model.replay_buffer.sample(64),
        "sample of the success buffer": lambda: model.success_buffer.sample(64),
    }
    print("\n| part | time |\n|---|---|")
    for name, times in take_turns(parts).items():
        print(f"| {name} | {cell(times)} |")


def make_model(dtype):
    env = VecFrameStack(DummyVecEnv([Noise]), 2, channels_order="first")
    model = TD3BC(
        "CnnPolicy",
        env,
        bc_coef=0,
        warmup_steps=0,
        bc_pretrain_steps=0,
        gradient_steps=0,
        buffer_size=500,
        policy_kwargs={"features_extractor_kwargs": {"dtype": dtype}},
    )
    model.learn(500)
    for _ in range(5):
        observations = np.random.randint(0, 256, (100, *SPACE.shape), np.uint8)
        actions = np.random.uniform(-1, 1, (100, 4)).astype(np.float32)
        model.success_buffer.add(observations, actions)
    model.bc_coef = 2.0
    return model


def whole_updates(memory):
    """Two updates as ``train`` makes them (one with the actor's), and one by BC alone."""
    if memory == "kept":
        keep_freed_memory()
    for dtype in ("float32", "bfloat16"):
        model = make_model(dtype)
        model.train(4)
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        times = take_turns({"td3bc": lambda: model.train(2), "bc": lambda: model.pretrain_bc(1)})  # noqa: B023
        faults = (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults) / (3 * ROUNDS)
        td3bc, bc = cell(times["td3bc"] / 2), cell(times["bc"])
        print(f"| {memory} | {dtype} | {td3bc} | {bc} | {faults:.0f} |", flush=True)


if __name__ == "__main__":
    th.set_num_threads(1)
    if len(sys.argv) > 1:
        whole_updates(sys.argv[1])
        sys.exit()
    print("| freed memory | convolutions | TD3BC update | BC update | page faults |")
    print("|---|---|---|---|---|", flush=True)
    for memory in ("returned", "kept") * 2:
        subprocess.run([sys.executable, __file__, memory], check=True)
    keep_freed_memory()
    convolutions()
    small_parts(make_model("float32"))
