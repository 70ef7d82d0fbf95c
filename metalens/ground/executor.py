"""Many tasks at once: on the cores of this machine (loky), or on a cluster named by its address (dask.distributed).

loky, since its workers start without running the caller's script again; a process pool of the standard library does,
and a script without a main guard would start itself over. The answers are the same for any number of workers: a task is
done by one process with one BLAS thread, and knows nothing of the others.
"""

import contextlib
import importlib
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any, TypeVar

from metalens.ground import threads
from metalens.ground.errors import WorkerError

Task = TypeVar("Task")
Result = TypeVar("Result")
_SCHEDULER: ContextVar[str | None] = ContextVar("_SCHEDULER", default=None)
_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# safe path: what lies in the current folder is never imported, whatever its name
_ENVIRONMENT = {"PYTHONSAFEPATH": "1"} | dict.fromkeys(_VARIABLES, "1")
_CONNECT_S = 10


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def on(scheduler: str | None) -> Iterator[None]:
    """Do the tasks of the block on the dask cluster of this address; None for the cores of this machine."""
    token = _SCHEDULER.set(scheduler)
    try:
        yield
    finally:
        _SCHEDULER.reset(token)


def run(
    work: Callable[[Task], Result], tasks: Sequence[Task], *, processes: int | None = None
) -> Iterator[tuple[int, Result]]:
    """(index, result) of every task as it is done.

    Args:
        work: a function of a module (workers import it by name).
        processes: on this machine; by default one a core.

    Raises:
        WorkerError: a worker process died, with its cause; no cluster at the address. Whatever ``work`` raises.
    """
    if not tasks:
        return
    address = _SCHEDULER.get()
    if address is None:
        yield from _here(work, tasks, min(processes or cores(), len(tasks)))
    else:
        yield from _cluster(work, tasks, address)


def _here(work: Callable[[Task], Result], tasks: Sequence[Task], count: int) -> Iterator[tuple[int, Result]]:
    from concurrent.futures import as_completed
    from concurrent.futures.process import BrokenProcessPool

    from loky import ProcessPoolExecutor

    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)  # of loky's own helper too, which is started like a worker
    pool = ProcessPoolExecutor(count, initializer=_settle, initargs=(os.getpid(),))
    try:
        waiting = {pool.submit(work, task): i for i, task in enumerate(tasks)}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    except BrokenProcessPool as error:
        cause = " ".join(str(error).split())
        raise WorkerError(
            f"a worker process ended early ({cause}); often the memory ran out: start again on fewer cores (taskset)"
        ) from None
    finally:
        pool.shutdown(wait=True, kill_workers=True)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _settle(parent: int) -> None:
    """Begin a worker: what it prints is a message, not a result; it ends with whoever started it."""
    os.dup2(2, 1)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _cluster(work: Callable[[Task], Result], tasks: Sequence[Task], address: str) -> Iterator[tuple[int, Result]]:
    """A task of a lost worker is done again by another."""
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise WorkerError("--scheduler needs the extra [cluster]: pip install 'metalens-toolchain[cluster]'") from None
    try:
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkerError(f"no dask scheduler at {address!r} ({error}); start one with `dask scheduler`") from None
    with client:
        waiting = {client.submit(_alone, work, task, pure=False): i for i, task in enumerate(tasks)}
        try:
            for future in distributed.as_completed(waiting, loop=client.loop):
                yield waiting[future], future.result()
        except distributed.KilledWorker as error:
            raise WorkerError(f"workers of the cluster died again and again on one task ({error})") from None
        except distributed.CancelledError as error:
            raise WorkerError(f"the cluster at {address} was lost ({error})") from None
        finally:
            client.cancel(list(waiting))


def _alone(work: Callable[[Any], Result], task: Any) -> Result:
    """A task on one BLAS thread."""
    with threads.one_blas_thread():
        return work(task)
