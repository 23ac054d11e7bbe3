"""What makes updates on a CPU fast: threads, and memory that stays."""

from __future__ import annotations

import ctypes
import os
import platform

import torch as th


def set_threads() -> None:
    """Let OMP_NUM_THREADS decide, where it is set, over torch's own choice.

    Of a list, "4,2", the first counts: those after it are of nested regions. What is no number of
    threads is left to OpenMP, which warns of it.
    """
    first = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if first.isdecimal() and int(first):
        th.set_num_threads(int(first))


def keep_freed_memory() -> None:
    """Stop glibc from handing freed tensors back to the system and asking for them again.

    An update on a CPU frees and allocates tensors of up to 11 MB many times. Each page that comes
    back from the system costs a page fault, altogether a quarter of the update
    (docs/performance.md). At most 256 MiB of freed memory are kept. Without glibc nothing happens.
    """
    if platform.libc_ver()[0] == "glibc":
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        mallopt(-3, 32 << 20)  # M_MMAP_THRESHOLD: the most that glibc accepts
        mallopt(-1, 256 << 20)  # M_TRIM_THRESHOLD
