"""Independent tasks on the nodes of a Ray cluster.

* ``connect`` - to a cluster that has room for a task
* ``call_all`` - one task for each argument; those whose node is lost are begun again elsewhere

Ray is imported when it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

__all__ = ["SHOWN_EVERY", "Shares", "call_all", "connect"]

SHOWN_EVERY = 5.0
"""Seconds between two looks at how far tasks are."""

_AGAIN = 3  # times that a task that was lost is begun again

T = TypeVar("T")


class Shares(NamedTuple):
    """What a task has of a node.

    Attributes:
        cpus: cores; two tasks of .5 share one.
        gpus: likewise.
        memory: GiB; 0 asks for none.
    """

    cpus: float = 1
    gpus: float = 0
    memory: float = 0

    def __str__(self) -> str:
        return f"{self.cpus:g} CPUs, {self.gpus:g} GPUs and {self.memory:.3g} GiB"


def connect(address: str, shares: Shares) -> None:
    """Connect this process, unless it is.

    Args:
        address: of the cluster's head; "auto": the one that runs here, or where none does, one is
            started, and a line says so; "local" starts one.
        shares: a task's.

    Raises:
        ImportError: Ray is not installed.
        ValueError: there is no such cluster, or none of its nodes has room for a task.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ImportError(
            f"Ray is not installed ({error}): pip install 'regil-sb3[bench]'"
        ) from None
    if not ray.is_initialized():
        try:
            try:
                ray.init(address=address, log_to_driver=False)
            except ConnectionError:
                if address != "auto":
                    raise
                print("--ray auto: no cluster runs here, so one of this machine alone is started")
                ray.init(address="local", log_to_driver=False)
        except (ray.exceptions.RayError, RuntimeError, OSError) as error:
            raise ValueError(f"--ray {address}: {' '.join(str(error).split())}") from None
    alive = [node for node in ray.nodes() if node["Alive"]]  # type: ignore[no-untyped-call]
    nodes = [
        Shares(has.get("CPU", 0), has.get("GPU", 0), has.get("memory", 0) / 2**30)
        for has in (node["Resources"] for node in alive)
    ]
    if not any(all(h >= s for h, s in zip(node, shares, strict=True)) for node in nodes):
        raise ValueError(
            f"no node of the Ray cluster has {shares} for a run; there are: "
            f"{'; '.join(map(str, nodes))}"
        )


def call_all(
    function: Callable[[T], None],
    arguments: Sequence[T],
    shares: Shares,
    show: Callable[[], None],
    grace: float,
    again: Sequence[type[Exception]] = (),
) -> list[str]:
    """Call a function with each argument, somewhere on the cluster.

    Args:
        function: of one argument.
        arguments: of the tasks.
        shares: that each has.
        show: called every few seconds.
        grace: s that calls are given to end when this one is interrupted: each is, too.
        again: what a call may raise and is begun again after, as if its node had been lost.

    Returns:
        for each argument "", or in a line why the call failed.

    Raises:
        KeyboardInterrupt: passed on when all have ended, or the grace is over.
    """
    import ray

    options: dict[str, Any] = {
        "num_cpus": shares.cpus,
        "num_gpus": shares.gpus,
        "memory": int(shares.memory * 2**30),
        "max_retries": _AGAIN,
        "retry_exceptions": list(again),
    }
    task: Any = ray.remote(**options)(function)
    pending = references = [task.remote(argument) for argument in arguments]
    try:
        while pending:
            _, pending = ray.wait(pending, num_returns=len(pending), timeout=SHOWN_EVERY)
            show()
    except BaseException:
        for reference in pending:
            ray.cancel(reference)
        ray.wait(pending, num_returns=len(pending), timeout=grace)
        raise
    errors = []
    for reference in references:
        try:
            ray.get(reference)
            errors.append("")
        except ray.exceptions.RayError as error:
            errors.append(str(error).strip().splitlines()[-1])
    return errors
