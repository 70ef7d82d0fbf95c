"""Threads for compiled loops that release the interpreter lock: as many as torch uses, safe after a fork."""

import contextlib
import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from threadpoolctl import ThreadpoolController


def split(count: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(start, stop)`` over [0, count) in as many parts as torch has threads."""
    import torch

    parts = min(torch.get_num_threads(), count)
    if parts <= 1:
        work(0, count)
        return
    edges = [count * i // parts for i in range(parts + 1)]
    jobs = [_pool(os.getpid(), parts).submit(work, a, b) for a, b in itertools.pairwise(edges[1:])]
    work(edges[0], edges[1])
    for job in jobs:
        job.result()


@functools.lru_cache(maxsize=2)
def _pool(process: int, parts: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(parts, thread_name_prefix=f"metalens-{process}")


def one_blas_thread() -> contextlib.AbstractContextManager[object]:
    """Run numpy's and scipy's BLAS on one thread: its idle threads spin for a while and take torch's cores."""
    limit: contextlib.AbstractContextManager[object] = _blas().limit(limits=1)
    return limit


@functools.lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")
