"""What a measured figure depends on: the machine, the versions, the commit."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

__all__ = ["SIMULATORS", "commit", "describe", "hardware", "together"]

SIMULATORS = ("metaworld", "hf-libero", "robosuite", "mujoco")
"""Distributions that tasks are simulated with."""
_CODE = [f":/{folder}" for folder in ("regil_sb3", "wrappers", "zoo_configs")]


def describe(packages: Sequence[str]) -> str:
    """One line to stand below a table: processor, memory, GPU, threads, versions, commit.

    Args:
        packages: distributions whose versions matter; those that are not installed are left out.
    """
    parts = [
        hardware(),
        f"{psutil.virtual_memory().total / 1024**3:.0f} GiB",
        *_gpus(),
        f"OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'unset')}",
        f"Python {platform.python_version()}",
    ]
    for name in packages:
        try:
            parts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join([*parts, f"commit {commit()}"])


def hardware() -> str:
    """Processor and cores."""
    return f"{_processor()}, {os.cpu_count()} cores"


def together(described: Iterable[str]) -> str:
    """Descriptions as one line: what differs by the commit alone is said once."""
    commits: dict[str, list[str]] = {}
    for line in dict.fromkeys(described):
        machine, _, commit = line.partition(", commit ")
        commits.setdefault(machine, []).append(commit)
    return "; ".join(
        f"{machine}, commit {', '.join(of)}" if any(of) else machine
        for machine, of in commits.items()
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _gpus() -> list[str]:
    """Name and driver of each kind of NVIDIA GPU that this process may use."""
    if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return []
    asked = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        told = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return []
    return [line.replace(", ", " (driver ") + ")" for line in dict.fromkeys(told.splitlines())]


def commit() -> str:
    """Of the checkout that this file is of, with a + where its code or presets were changed."""
    here = Path(__file__).parent
    asked = (
        ("rev-parse", "--short", "HEAD"),
        ("status", "--porcelain", "-uno", "--", *_CODE),
        ("ls-files", "--error-unmatch", Path(__file__).name),  # not in somebody else's
    )
    try:
        commit, changed, _ = (
            subprocess.run(["git", "-C", here, *words], capture_output=True, text=True, check=True)
            for words in asked
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.stdout.strip() + ("+" if changed.stdout.strip() else "")
