"""Parallel tasks in worker processes of this machine (loky)."""

import contextlib
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any, TypeVar

from metalens.core import threads
from metalens.core.errors import ConfigError, WorkerError

Common = TypeVar("Common")
Task = TypeVar("Task")
Result = TypeVar("Result")
_POOL: ContextVar[Any] = ContextVar("_POOL", default=None)
_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
# safe path: files in the current folder are never imported
_ENVIRONMENT = {"PYTHONSAFEPATH": "1"} | dict.fromkeys(_VARIABLES, "1")
# a worker whose memory grows with a large lens is not restarted
_ENVIRONMENT["LOKY_MAX_MEMORY_LEAK_SIZE"] = "1e15"


@contextlib.contextmanager
def run_on(processes: int | None = None) -> Iterator[None]:
    """Context whose tasks run in a given number of processes of this machine.

    Args:
        processes: number of processes. None: :func:`run_parallel` takes one per core,
            :func:`gather_parallel` threads of this process.

    Raises:
        ConfigError: no such number of processes.
    """
    if processes is None:
        yield
        return
    if not 1 <= processes <= 1024:
        raise ConfigError(f"{processes} workers: need 1 to 1024")
    with _worker_pool(processes) as pool:
        token = _POOL.set(pool)
        try:
            yield
        finally:
            _POOL.reset(token)


def run_parallel(
    work: Callable[[Task], Result], tasks: Sequence[Task]
) -> Iterator[tuple[int, Result]]:
    """(index, result) of every task, in the order in which they finish.

    Args:
        work: a function of a module (workers import it by name).
        tasks: its arguments.

    Raises:
        WorkerError: a worker process died, with its cause. Whatever ``work`` raises.
    """
    if not tasks:
        return
    pool = _POOL.get()
    if pool is not None:
        yield from _run_in_pool(pool, work, tasks)
        return
    with _worker_pool(min(threads.usable_cores(), len(tasks))) as pool:
        yield from _run_in_pool(pool, work, tasks)


def gather_parallel(
    work: Callable[[Common, Task], Result], common: Common, tasks: Sequence[Task]
) -> list[Result]:
    """``work(common, task)`` of every task, in their order, each with one BLAS thread.

    Without workers of :func:`run_on` tasks run in parallel threads of this process.

    Args:
        work: a function of a module that mostly releases the interpreter lock.
        common: what all tasks need.
        tasks: the second arguments.

    Raises:
        WorkerError: as :func:`run_parallel`. Whatever ``work`` raises.
    """
    work_on = functools.partial(work, common)
    pool = _POOL.get()
    if pool is not None:
        results = dict(_run_in_pool(pool, work_on, tasks))
        return [results[i] for i in range(len(tasks))]
    with threads.one_blas_thread():
        return threads.run_each(work_on, tasks)


@contextlib.contextmanager
def _worker_pool(count: int) -> Iterator[Any]:
    """Context of worker processes, which start with the first task."""
    from loky import ProcessPoolExecutor

    # loky's own helper, too, imports no files of the current folder
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    pool = ProcessPoolExecutor(
        count, initializer=_begin_worker, initargs=(os.getpid(),), env=_ENVIRONMENT
    )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, kill_workers=True)


def _run_in_pool(
    pool: Any, work: Callable[[Task], Result], tasks: Sequence[Task]
) -> Iterator[tuple[int, Result]]:
    """(index, result) of every task as a pool of processes finishes it.

    Args:
        pool: of processes.
        work: called with a task.
        tasks: arguments.

    Raises:
        WorkerError: a worker process died.
    """
    from concurrent.futures import as_completed
    from concurrent.futures.process import BrokenProcessPool

    try:
        indices = {pool.submit(work, task): i for i, task in enumerate(tasks)}
        for future in as_completed(indices):
            yield indices[future], future.result()
    except BrokenProcessPool as error:
        cause = " ".join(str(error).split())
        raise WorkerError(
            f"a worker process ended early ({cause}); often the memory ran out: start again with fewer --workers"
        ) from None


def _begin_worker(parent: int) -> None:
    """Send the standard output of a worker to standard error, and end it when its
    parent ends.

    Args:
        parent: process number.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    os.dup2(2, 1)
    threading.Thread(target=watch, daemon=True).start()
