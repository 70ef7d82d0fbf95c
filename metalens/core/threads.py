"""Threads for compiled loops that release the interpreter lock: torch's number where it
runs; safe after a fork.
"""

import contextlib
import functools
import importlib
import itertools
import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")
_CONCURRENT = threading.local()  # inside: of a thread of run_each


def run_each(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """``work`` of every item, in their order, one thread per item; :func:`run_split`
    within an item stays in its thread.

    For work of calls that release the interpreter lock, and that changes nothing
    shared. After an interrupt or the first failure no further item begins.

    Args:
        work: called with each item.
        items: what is computed in parallel.
    """
    items = list(items)
    count = min(thread_count(), len(items), 16)  # each has memory of its own
    if count <= 1:
        return [work(item) for item in items]

    def begin() -> None:
        _CONCURRENT.inside = True

    with ThreadPoolExecutor(count, initializer=begin) as pool, one_blas_thread():
        return list(pool.map(work, items))


def run_split(count: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(start, stop)`` over [0, count) in as many parts as there are threads
    (see :func:`thread_count`).
    """
    _run_parts(count, min(thread_count(), count), work)


def run_concurrently(*works: Callable[[], Any]) -> list[Any]:
    """Results of several calls in parallel threads, in the order of ``works``; see
    :func:`run_split`.
    """
    results: list[Any] = [None] * len(works)

    def run_range(start: int, stop: int) -> None:
        results[start:stop] = [work() for work in works[start:stop]]

    run_split(len(works), run_range)
    return results


def run_split_torch(count: int, work: Callable[[int, int], object]) -> None:
    """As :func:`run_split`, for many small calls of torch: each part runs with one
    torch thread.

    With more they would wait for each other at every call. ``work`` may carry no
    derivatives: torch records them in the calling thread only.

    Args:
        count: length of the range that is split.
        work: called with (start, stop).
    """
    torch = sys.modules["torch"]
    torch_threads = int(torch.get_num_threads())

    def work_single_threaded(start: int, stop: int) -> None:
        torch.set_num_threads(1)
        work(start, stop)

    try:
        _run_parts(count, min(torch_threads, count), work_single_threaded)
    finally:
        torch.set_num_threads(torch_threads)


def _run_parts(count: int, parts: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(start, stop)`` over [0, count) in ``parts``, the first in this
    thread.
    """
    if parts <= 1:
        work(0, count)
        return
    edges = [count * i // parts for i in range(parts + 1)]
    jobs = [
        _pool(os.getpid(), parts).submit(work, start, stop)
        for start, stop in itertools.pairwise(edges[1:])
    ]
    work(edges[0], edges[1])
    for job in jobs:
        job.result()


def usable_cores() -> int:
    """Number of cores that this process may use; macOS and Windows state all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_count() -> int:
    """Threads for parallel loops: torch's where it is loaded, else OMP_NUM_THREADS,
    else the cores of this process; one within :func:`run_each`.
    """
    if getattr(_CONCURRENT, "inside", False):
        return 1
    torch = sys.modules.get("torch")
    if torch is not None:
        return int(torch.get_num_threads())
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return int(stated) or 1 if stated.isdigit() else usable_cores()


@functools.lru_cache(maxsize=2)
def _pool(process: int, parts: int) -> ThreadPoolExecutor:
    """Pool of threads, a new one after a fork: ``process`` is the process number."""
    return ThreadPoolExecutor(parts, thread_name_prefix=f"metalens-{process}")


def one_blas_thread() -> contextlib.AbstractContextManager[object]:
    """Context in which the BLAS of numpy and scipy runs on one thread; idle BLAS
    threads would spin on cores that torch uses.
    """
    limit: contextlib.AbstractContextManager[object] = _blas().limit(limits=1)
    return limit


@functools.lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    """Controller of the BLAS libraries of numpy and scipy."""
    # scipy has a BLAS of its own, which the controller finds only when it is loaded
    importlib.import_module("scipy.linalg")
    return ThreadpoolController().select(user_api="blas")
