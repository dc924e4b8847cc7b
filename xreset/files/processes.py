"""Independent pieces of work on all cores."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar, cast

import numpy as np

from xreset.errors import XResetError

_IDLE = 10.0
"""[s] after which a process without work ends: five minutes by default, for which a child of multiprocessing would wait
at its own end."""
_QUIET = "ignore:resource_tracker:UserWarning"
"""Warning of joblib's resource tracker after a kill: it comes when the command has ended, and names what the
tracker then removes."""
_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


def batches(jobs: np.ndarray, *, small: int, most: int) -> list[np.ndarray]:
    """Split jobs into batches of about equal length, whatever the machine: an even number of them, for two cores.

    Args:
        jobs: [N, ...]
        small: number of jobs up to which one batch takes less time than a second process takes to start.
        most: most jobs of a batch.
    """
    count = 2 * -(-len(jobs) // (2 * most)) if len(jobs) > small else 1
    return np.array_split(jobs, count) if len(jobs) else []


def in_processes(function: Callable[[_Job], _Result], jobs: Sequence[_Job]) -> Iterator[_Result]:
    """Yield ``function(job)`` for each job, in their order, computed in one process for each core.

    One job, or one core, is computed in this process. Each process uses one thread: for tensors of this size a second
    thread gains nothing, and waits in a busy loop.

    Args:
        function: of a module, so that other processes can import it; job and result are pickled.
        jobs: of about equal length.

    Raises:
        XResetError: a process was killed. Errors of ``function`` are raised as they are.
    """
    import joblib  # when it is needed, because its import takes a while

    count = min(joblib.cpu_count(), len(jobs))
    if count <= 1:
        yield from map(function, jobs)
        return
    # a process that was idle ends while jobs come, on a busy machine: another one starts
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1, idle_worker_timeout=_IDLE):
        pool = joblib.Parallel(n_jobs=count, return_as="generator")
        with _quiet_tracker():
            results = pool(joblib.delayed(function)(job) for job in jobs)
        try:
            yield from cast("Iterator[_Result]", results)
        except BrokenProcessPool as error:
            raise XResetError(
                "A process of this command was killed, perhaps because the memory is full. Close other programs, or "
                "use fewer processes (LOKY_MAX_CPU_COUNT=1), and repeat the command."
            ) from error


@contextmanager
def _quiet_tracker() -> Iterator[None]:
    """Let the resource tracker, a process that starts with the first jobs, print no warnings after a kill."""
    earlier = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = f"{earlier},{_QUIET}" if earlier else _QUIET
    try:
        yield
    finally:
        if earlier is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = earlier
