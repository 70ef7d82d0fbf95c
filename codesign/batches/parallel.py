"""Training and search under ``torchrun``: every process takes its part of each batch,
and all take the same steps.
"""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch import distributed as dist

from codesign.batches.surface_frames import FrameBatch
from codesign.eye.population import select_rows
from metalens.core.errors import TrainingError


def join_processes(device: torch.device | None = None) -> None:
    """Join the process group of ``torchrun``, if it started this process.

    Args:
        device: where this process computes; a GPU uses NCCL.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not dist.is_initialized():
        if device is not None and device.type == "cuda":
            torch.cuda.set_device(device)
            dist.init_process_group("cpu:gloo,cuda:nccl", device_id=device)
        else:
            dist.init_process_group("gloo")


def leave_processes() -> None:
    """Leave the process group: process 0 continues alone."""
    if dist.is_initialized():
        dist.barrier()
        dist.destroy_process_group()


_alone = False


@contextlib.contextmanager
def single_process() -> Iterator[None]:
    """Context in which this process works alone, though others train with it."""
    global _alone
    before, _alone = _alone, True
    try:
        yield
    finally:
        _alone = before


def process_rank() -> int:
    """Number of this process."""
    return dist.get_rank() if dist.is_initialized() and not _alone else 0


def process_count() -> int:
    """Processes that train together."""
    return dist.get_world_size() if dist.is_initialized() and not _alone else 1


def wait_for_all() -> None:
    """Barrier: returns when every process has reached it."""
    if process_count() > 1:
        dist.barrier()


def batch_share(batch: FrameBatch) -> FrameBatch:
    """The frames of a batch that this process trains on: an equal, contiguous part.

    Raises:
        TrainingError: the number of processes does not divide the batch.
    """
    if process_count() == 1:
        return batch
    size, remainder = divmod(len(batch.slip_mm), process_count())
    if remainder:
        raise TrainingError(
            f"a batch of {len(batch.slip_mm)} frames on {process_count()} processes: need a multiple of them"
        )
    rows = slice(process_rank() * size, (process_rank() + 1) * size)
    return FrameBatch(
        select_rows(batch.frames, rows),
        batch.mask[rows],
        batch.slip_mm[rows],
        None if batch.pose is None else select_rows(batch.pose, rows),
    )


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace every gradient by its mean over the processes, in place.

    Args:
        parameters: with gradients, in the same order in every process.
    """
    for parameter in parameters if process_count() > 1 else ():
        if parameter.grad is not None:
            total = _sum_in_place(parameter.grad.contiguous())
            parameter.grad.copy_(total / process_count())


def shared_rows(count: int) -> Tensor:
    """Rows out of ``count`` that this process computes."""
    return torch.arange(process_rank(), count, process_count())


def gather_rows(part: Tensor, rows: Tensor, count: int) -> Tensor:
    """(count, ...) rows of all processes from those of each (:func:`shared_rows`).

    Differentiable: every process's loss depends on every process's rows.

    Args:
        part: (rows, ...) of this process. rows: their numbers. count: of all rows.
    """
    if process_count() == 1:
        return part
    whole = part.new_zeros((count, *part.shape[1:]))
    return _differentiable_sum(whole.index_copy(0, rows.to(part.device), part))


def mean_of(values: Tensor) -> Tensor:
    """Mean of numbers over the processes.

    Args:
        values: of this process, of any shape.
    """
    return _sum_in_place(values.clone()) / process_count()


def share_work(work: Callable[[Any], float], items: Sequence[Any]) -> list[float]:
    """``work`` of every item, each computed by one process; all processes get all
    results.

    Args:
        work: of one item. items: to work on.
    """
    results = torch.zeros(len(items), dtype=torch.float64)
    for i in range(process_rank(), len(items), process_count()):
        results[i] = work(items[i])
    return _sum_in_place(results).tolist()


def batch_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Batch normalisation with the statistics of all processes' frames; differentiable.

    Args:
        x: (batch, channels, y, x) features. weight: (channels,) scale.
        bias: (channels,) offset.
    """
    count = x.numel() // x.shape[1] * process_count()
    mean = _differentiable_sum(x.sum((0, 2, 3))) / count
    centred = x - mean[:, None, None]
    variance = _differentiable_sum(centred.square().sum((0, 2, 3))) / count
    scale = weight * torch.rsqrt(variance + 1e-5)
    return centred * scale[:, None, None] + bias[:, None, None]


class _SumOverProcesses(torch.autograd.Function):
    """Sum over processes; every process's loss depends on every process's part, so
    gradients are summed too.
    """

    @staticmethod
    def forward(context: Any, value: Tensor) -> Tensor:
        return _sum_in_place(value.clone())

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        return _sum_in_place(gradients[0].clone())


def _differentiable_sum(value: Tensor) -> Tensor:
    """Sum over processes, differentiable."""
    total: Tensor = _SumOverProcesses.apply(value)  # type: ignore[no-untyped-call]
    return total


def _sum_in_place(value: Tensor) -> Tensor:
    """Sum a tensor over processes in place."""
    try:
        if process_count() > 1:
            dist.all_reduce(value)
    except RuntimeError as error:
        raise TrainingError(
            f"another process of this run was lost ({error}); start it again with --resume to go on from the checkpoint"
        ) from error
    return value
