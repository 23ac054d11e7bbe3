"""Threads, and the allocator's setting, by the page faults that it is there to save."""

import platform
import resource

import pytest
import torch as th

from regil_sb3.process import keep_freed_memory, set_threads


def _page_faults() -> int:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    tensors = [th.ones(1 << 20) for _ in range(16)]  # 4 MiB each
    del tensors
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the setting is glibc's")
def test_freed_tensors_are_used_again():
    keep_freed_memory()
    # otherwise the system clears all 16,384 pages anew each time
    assert min(_page_faults() for _ in range(5)) < 100


@pytest.mark.parametrize(
    ("said", "threads"), [("3", 3), ("3,2", 3), (" 3 ", 3), ("", 1), ("0", 1), ("many", 1)]
)
def test_threads_are_what_openmp_reads(said, threads, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", said)
    th.set_num_threads(1)
    try:
        set_threads()
        assert th.get_num_threads() == threads
    finally:
        th.set_num_threads(1)
