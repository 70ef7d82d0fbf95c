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
Done = Iterator[tuple[int, Any]]
Place = Callable[
    [Callable[[Any, Any], Any], Any, Sequence[Any]], Done
]  # (work, common, tasks): (index, result)
_PLACE: ContextVar[Place | None] = ContextVar("_PLACE", default=None)
_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
# safe path: what lies in the current folder is never imported, whatever its name
_ENVIRONMENT = {"PYTHONSAFEPATH": "1"} | dict.fromkeys(_VARIABLES, "1")
_ENVIRONMENT["LOKY_MAX_MEMORY_LEAK_SIZE"] = (
    "1e15"  # what a large lens takes is no leak to end a worker for
)


def usable_cores() -> int:
    """Cores that this process may use."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )


@contextlib.contextmanager
def run_on(processes: int | None = None) -> Iterator[None]:
    """Do the tasks of the block in so many processes of this machine.

    Args:
        processes: None: each verb has its own way, :func:`run_parallel` a process a
            core,
            :func:`gather_parallel` threads of this process.

    Raises:
        ConfigError: no such number of processes.
    """
    if processes is None:
        yield
        return
    if not 1 <= processes <= 1024:
        raise ConfigError(f"{processes} workers: need 1 to 1024")
    with _pool(processes) as pool:
        token = _PLACE.set(functools.partial(_here, pool))
        try:
            yield
        finally:
            _PLACE.reset(token)


def run_parallel(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    processes: int | None = None,
) -> Iterator[tuple[int, Result]]:
    """(index, result) of every task as it is done.

    Args:
        tasks: what is computed in parallel.
        work: a function of a module (workers import it by name).
        processes: where :func:`run_on` says nothing; by default one a core.

    Raises:
        WorkerError: a worker process died, with its cause. Whatever ``work`` raises.
    """
    if not tasks:
        return
    place = _PLACE.get()
    if place is not None:
        yield from place(_plain, work, tasks)
        return
    with _pool(min(processes or usable_cores(), len(tasks))) as pool:
        yield from _here(pool, _plain, work, tasks)


def gather_parallel(
    work: Callable[[Common, Task], Result],
    common: Common,
    tasks: Sequence[Task],
    *,
    beside: bool = True,
) -> list[Result]:
    """``work(common, task)`` of every task, in their order, each with one BLAS thread.

    Args:
        work: a function of a module. common: what all tasks need.
        beside: where :func:`run_on` names no workers, side by side in threads of this
            process, for work that mostly
            consists of calls which release the interpreter lock; else one after the
            other, each with all threads.

    Raises:
        WorkerError: as :func:`run_parallel`. Whatever ``work`` raises.
    """
    place = _PLACE.get()
    if place is not None and tasks:
        found: dict[int, Result] = dict(place(work, common, tasks))
        return [found[i] for i in range(len(tasks))]
    alone = functools.partial(work, common)
    with threads.one_blas_thread():
        return (
            threads.run_each(alone, tasks)
            if beside
            else [alone(task) for task in tasks]
        )


def _plain(work: Callable[[Task], Result], task: Task) -> Result:
    return work(task)


@contextlib.contextmanager
def _pool(count: int) -> Iterator[Any]:
    """Processes that start with the first task and end with the block."""
    from loky import ProcessPoolExecutor

    with _environment():  # of loky's own helper too, which is started like a worker
        pool = ProcessPoolExecutor(
            count, initializer=_settle, initargs=(os.getpid(),), env=_ENVIRONMENT
        )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, kill_workers=True)


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _here(
    pool: Any, work: Callable[[Any, Any], Any], common: Any, tasks: Sequence[Any]
) -> Done:
    from concurrent.futures import as_completed
    from concurrent.futures.process import BrokenProcessPool

    try:
        with _environment():
            waiting = {
                pool.submit(work, common, task): i for i, task in enumerate(tasks)
            }
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    except BrokenProcessPool as error:
        cause = " ".join(str(error).split())
        raise WorkerError(
            f"a worker process ended early ({cause}); often the memory ran out: start again with fewer --workers"
        ) from None


def _settle(parent: int) -> None:
    """Begin a worker: what it prints is a message, not a result; it ends with whoever
    started it.
    """
    os.dup2(2, 1)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
