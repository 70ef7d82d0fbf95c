"""Training and search under ``torchrun``: every process takes its part of each batch,
and all move alike.
"""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch import distributed as dist

from codesign.batches.batch import FrameBatch
from codesign.batches.flat import SingleSurfaceFrames
from metalens.core.errors import TrainingError
from metalens.image import Frames


def join_processes(device: torch.device | None = None) -> None:
    """Join the other processes of ``torchrun``, if it started this one; ``device``:
    where this one computes.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not dist.is_initialized():
        if device is not None and device.type == "cuda":
            torch.cuda.set_device(device)
            dist.init_process_group("cpu:gloo,cuda:nccl", device_id=device)
        else:
            dist.init_process_group("gloo")


def leave_processes() -> None:
    """Part from the others: what follows is done by process 0 alone."""
    if dist.is_initialized():
        dist.barrier()
        dist.destroy_process_group()


_alone = False


@contextlib.contextmanager
def single_process() -> Iterator[None]:
    """Work that this process does by itself, though others train along with it."""
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
    """Until all are here."""
    if process_count() > 1:
        dist.barrier()


def batch_share(batch: FrameBatch) -> FrameBatch:
    """The frames of a batch that this process takes.

    Raises:
        TrainingError: the processes do not share the batch evenly.
    """
    if process_count() == 1:
        return batch
    size, odd = divmod(len(batch.slip_mm), process_count())
    if odd:
        raise TrainingError(
            f"a batch of {len(batch.slip_mm)} frames on {process_count()} processes: need a multiple of them"
        )
    mine = slice(process_rank() * size, (process_rank() + 1) * size)
    frames: Frames | SingleSurfaceFrames = _rows(batch.frames, mine)
    pose = None if batch.pose is None else _rows(batch.pose, mine)
    return replace(
        batch,
        frames=frames,
        mask=batch.mask[mine],
        slip_mm=batch.slip_mm[mine],
        pose=pose,
    )


def _rows(record: Any, rows: slice) -> Any:
    """Some of the frames of a record of tensors."""
    return type(record)(
        *(getattr(record, name)[rows] for name in type(record).__slots__)
    )


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace every gradient by its mean over the processes.

    Args:
        parameters: with gradients.
    """
    if process_count() == 1:
        return
    grads = [p.grad for p in parameters if p.grad is not None]
    for kind in sorted(
        {(g.dtype, g.device) for g in grads}, key=str
    ):  # in the same order everywhere
        mine = [g for g in grads if (g.dtype, g.device) == kind]
        joined = _reduced(torch.cat([g.flatten() for g in mine])) / process_count()
        start = 0
        for grad in mine:
            grad.copy_(joined[start : start + grad.numel()].view_as(grad))
            start += grad.numel()


def shared_rows(count: int) -> Tensor:
    """Rows out of ``count`` that this process computes."""
    return torch.arange(process_rank(), count, process_count())


def gather_rows(part: Tensor, rows: Tensor, count: int) -> Tensor:
    """(count, ...) rows of all processes from those of each (:func:`shared_rows`);
    differentiable: every process's loss depends on every process's rows.

    Args:
        part: (rows, ...) of this process.
    """
    if process_count() == 1:
        return part
    whole = part.new_zeros((count, *part.shape[1:]))
    return _summed(whole.index_copy(0, rows.to(part.device), part))


def mean_of(values: list[float]) -> list[float]:
    """Mean of numbers over the processes.

    Args:
        values: of this process.
    """
    if process_count() == 1:
        return values
    return [
        float(v)
        for v in _reduced(torch.tensor(values, dtype=torch.float64)) / process_count()
    ]


def share_work(work: Callable[[Any], float], items: Sequence[Any]) -> list[float]:
    """``work`` of every item, done by one process each; all get all answers, in order.

    Args:
        items: to work on.
    """
    found = torch.zeros(len(items), dtype=torch.float64)
    for i in range(process_rank(), len(items), process_count()):
        found[i] = work(items[i])
    return [float(v) for v in (_reduced(found) if process_count() > 1 else found)]


def batch_norm(
    x: Tensor, weight: Tensor, bias: Tensor, *, epsilon: float = 1e-5
) -> Tensor:
    """Batch normalisation with the statistics of all processes' frames; differentiable.

    Args:
        x: (batch, channels, y, x) features. weight: (channels,) scale.
        bias: (channels,) offset. epsilon: added to the variance.
    """
    count = x.numel() // x.shape[1] * process_count()
    mean = _summed(x.sum((0, 2, 3))) / count
    centred = x - mean[:, None, None]
    variance = _summed(centred.square().sum((0, 2, 3))) / count
    scale = weight * torch.rsqrt(variance + epsilon)
    return centred * scale[:, None, None] + bias[:, None, None]


class _Sum(torch.autograd.Function):
    """Sum over processes; every process's loss depends on every process's part, so
    gradients are summed too.
    """

    @staticmethod
    def forward(context: Any, value: Tensor) -> Tensor:
        return _reduced(value.clone())

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        return _reduced(gradients[0].clone())


def _summed(value: Tensor) -> Tensor:
    total: Tensor = _Sum.apply(value)  # type: ignore[no-untyped-call]
    return total


def _reduced(value: Tensor) -> Tensor:
    try:
        dist.all_reduce(value)
    except RuntimeError as error:
        raise _lost(error) from error
    return value


def _lost(error: RuntimeError) -> TrainingError:
    return TrainingError(
        f"another process of this run was lost ({error}); start it again with --resume to go on from the checkpoint"
    )
