"""The frames of the next steps formed beside the training of this one: other threads,
the same numbers.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, Self, TypeVar

import torch

from metalens.core.executor import usable_cores

Made = TypeVar("Made")


class Prefetcher(Generic[Made]):
    """``work(step)`` of the step that is asked for, while that of the next ones begins,
    each on a thread of its own.

    For work that depends on the step alone. It takes as many of torch's threads from
    the steps (:meth:`beside`) and is
    done on one thread always; without workers, or where torch has only one thread, it
    is done when it is asked for, on
    all of them. So the bytes of both depend on how many threads there are, never on
    what was ready when.
    """

    def __init__(
        self, work: Callable[[int], Made], *, end: int, workers: int = 1
    ) -> None:
        """``end``: the first step that is not wanted any more. ``workers``: steps begun
        beside the one, or 0.
        """
        self.work, self.end, self.threads, self.workers = (
            work,
            end,
            torch.get_num_threads(),
            workers,
        )
        self._pool: ThreadPoolExecutor | None = None
        self._begun: dict[int, Future[Made]] = {}

    def __enter__(self) -> Self:
        if self.threads > 1 and self.workers:
            self._pool = ThreadPoolExecutor(
                self.workers, "ahead", torch.set_num_threads, (1,)
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            torch.set_num_threads(
                self.threads
            )  # also of threads that begin later: the worker's 1 was for all of them

    @contextlib.contextmanager
    def beside(self) -> Iterator[None]:
        """The threads that the work leaves, and all of them again after."""
        torch.set_num_threads(max(1, self.threads - self.workers))
        try:
            yield
        finally:
            torch.set_num_threads(self.threads)

    def take(self, step: int) -> Made:
        """What the work makes of a step."""
        if self._pool is None:
            return self.work(step)
        for one in range(step, step + 1 + self.workers):
            if one not in self._begun and one < max(self.end, step + 1):
                self._begun[one] = self._pool.submit(self.work, one)
        return self._begun.pop(step).result()


def renderer_threads(device: torch.device) -> int:
    """Threads that render for a process that trains on ``device``: beside a GPU half of
    the processor's cores, eight at
    most, shared by the processes of ``torchrun`` on this machine. None beside a
    processor: what a network is trained on
    takes a sixth to a third of its work there, and a thread of its own would wait for
    most of the step."""
    if device.type == "cpu":
        return 0
    return max(
        1, min(8, usable_cores() // (2 * int(os.environ.get("LOCAL_WORLD_SIZE", "1"))))
    )
