"""Threads for compiled loops that release the interpreter lock: torch's number where it
runs; safe after a fork.

And memory that a process keeps between the steps of a long run.
"""

import contextlib
import ctypes
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
_CONCURRENT = threading.local()  # stop: set for a thread that works with others


class WorkStopped(Exception):  # no error: nobody waits for what is stopped any more
    """Raised within an item of :func:`run_each` that is no longer wanted."""


def run_each(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """``work`` of every item, in their order: side by side, one thread each,
    :func:`run_split` within them included.

    For work that consists of calls which release the interpreter lock, and that shares
    nothing it changes. An
    interrupt or the first failure stops the others at their next :func:`run_split`, and
    is
    raised when they have ended.

    Args:
        items: what is computed one by one.
    """
    items = list(items)
    count = min(thread_count(), len(items), 16)  # each has memory of its own
    if count <= 1:
        return [work(item) for item in items]
    stop = threading.Event()

    def alone(item: Item) -> Result:
        _CONCURRENT.stop = stop
        return work(item)

    with (
        ThreadPoolExecutor(count, thread_name_prefix="metalens-concurrent") as pool,
        one_blas_thread(),
    ):
        try:
            jobs = [pool.submit(alone, item) for item in items]
            return [job.result() for job in jobs]
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def run_split(count: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(start, stop)`` over [0, count) in as many parts as there are threads
    (see :func:`thread_count`).
    """
    stop = getattr(_CONCURRENT, "stop", None)
    if stop is not None and stop.is_set():
        raise WorkStopped
    _shared(count, min(thread_count(), count), work)


def run_concurrently(*works: Callable[[], Any]) -> list[Any]:
    """Results of several calls, side by side where there are threads; see
    :func:`run_split`.
    """
    out = dict[int, Any]()

    def some(start: int, stop: int) -> None:
        for i in range(start, stop):
            out[i] = works[i]()

    run_split(len(works), some)
    return [out[i] for i in range(len(works))]


def run_split_torch(count: int, work: Callable[[int, int], object]) -> None:
    """As :func:`run_split`, for work of many small calls of torch: each part has one of
    its
    threads to itself.

    Together they would wait for each other at every call. ``work`` may carry no
    derivatives: what torch knows of them
    is of the calling thread.

    Args:
        count: how many.
    """
    torch = sys.modules["torch"]
    own = int(torch.get_num_threads())

    def alone(start: int, stop: int) -> None:
        torch.set_num_threads(1)
        work(start, stop)

    try:
        _shared(count, min(own, count), alone)
    finally:
        torch.set_num_threads(own)


def _shared(count: int, parts: int, work: Callable[[int, int], object]) -> None:
    """``work`` in so many parts, the first in this thread."""
    if parts <= 1:
        work(0, count)
        return
    edges = [count * i // parts for i in range(parts + 1)]
    jobs = [
        _pool(os.getpid(), parts).submit(work, a, b)
        for a, b in itertools.pairwise(edges[1:])
    ]
    work(edges[0], edges[1])
    for job in jobs:
        job.result()


def thread_count() -> int:
    """Threads of torch where it is loaded, else OMP_NUM_THREADS, else the cores of this
    process; one within `each`.
    """
    if getattr(_CONCURRENT, "stop", None) is not None:
        return 1
    torch = sys.modules.get("torch")
    if torch is not None:
        return int(torch.get_num_threads())
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(stated)) if stated.isdigit() else len(os.sched_getaffinity(0))


@functools.lru_cache(maxsize=2)
def _pool(process: int, parts: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(parts, thread_name_prefix=f"metalens-{process}")


def one_blas_thread() -> contextlib.AbstractContextManager[object]:
    """Run numpy's and scipy's BLAS on one thread: its idle threads spin for a while and
    take torch's cores.
    """
    limit: contextlib.AbstractContextManager[object] = _blas().limit(limits=1)
    return limit


@functools.lru_cache(maxsize=1)
def keep_memory() -> bool:
    """From here on what is freed stays with the process, for arrays to come; False
    where the C library is not glibc.

    For runs whose steps all make arrays of the same sizes. Left to itself glibc gives
    blocks of over 32 MB, and the end
    of its heap, back to the system after every step, and gets them as new pages, which
    the system clears one by one.
    """
    tune = (
        getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    )
    own_pages, trimmed = (
        -3,
        -1,
    )  # M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of malloc.h; either one alone makes it worse
    return tune is not None and bool(
        tune(own_pages, 1 << 30) and tune(trimmed, (1 << 31) - 1)
    )


@functools.lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    importlib.import_module(
        "scipy.linalg"
    )  # its BLAS is another one than numpy's, and must be there to be found
    return ThreadpoolController().select(user_api="blas")
