"""Frames of the next steps, rendered while this one trains: the same numbers."""

import collections
import itertools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

from metalens.core.executor import usable_cores

Made = TypeVar("Made")


def prefetch(
    work: Callable[[int], Made], steps: range, *, workers: int
) -> Iterator[Made]:
    """``work`` of every step in order, up to ``workers`` steps ahead on threads.

    Args:
        work: depends on the step alone. steps: their numbers. workers: threads; 0 works
            when a step is asked for.
    """
    if not workers:
        yield from map(work, steps)
        return
    with ThreadPoolExecutor(workers, "ahead") as pool:
        left = iter(steps)
        begun: collections.deque[Future[Made]] = collections.deque(
            pool.submit(work, step) for step in itertools.islice(left, workers)
        )
        while begun:
            made = begun.popleft().result()
            begun.extend(pool.submit(work, step) for step in itertools.islice(left, 1))
            yield made


def renderer_threads(device: torch.device) -> int:
    """Threads that render for a process that trains on ``device``.

    Beside a GPU half of the processor's cores, eight at most, shared by the processes of
    ``torchrun`` on this machine; none beside a processor, which trains itself.
    """
    if device.type == "cpu":
        return 0
    shared = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return max(1, min(8, usable_cores() // (2 * shared)))
