"""PSF stacks over several processes: each computes a share of depths, angles or wavelengths, then all gather.

Start with ``torchrun --nproc-per-node N script.py`` and call :func:`join` first; without torchrun there is one process
and every function does its work alone. The gather knows its gradient: the data-parallel AllGather scheme of the paper,
Sec. 3.1.
"""

import dataclasses
import itertools
import os
from typing import Any, Literal

import numpy as np
import torch
import torch.distributed as dist

from metalens.ground.errors import PropagationError
from metalens.psf.budget import Budget
from metalens.psf.record import PsfStack
from metalens.psf.stack import psf_stack

Axis = Literal["depth", "angle", "wavelength"]


def join(backend: str | None = None) -> tuple[int, int]:
    """(rank, processes) of the torchrun group, started here if it is not yet; (0, 1) outside torchrun.

    Args:
        backend: by default ``nccl`` where there are GPUs, else ``gloo``.
    """
    if "RANK" not in os.environ:
        return 0, 1
    if not dist.is_initialized():
        dist.init_process_group(backend or ("nccl" if torch.cuda.is_available() else "gloo"))
    return dist.get_rank(), dist.get_world_size()


def leave() -> None:
    """End the group."""
    if dist.is_initialized():
        dist.destroy_process_group()


def share(count: int) -> slice:
    """The part of ``count`` items that is this process's: equal to within one item."""
    rank, size = _place()
    return slice(count * rank // size, count * (rank + 1) // size)


def gather(part: torch.Tensor, count: int) -> torch.Tensor:
    """All parts of :func:`share` as one tensor along axis 0, in order, on every process; differentiable.

    The gradient of a part is the sum over processes of what each sends back to it, divided by their number: the same
    loss computed on every process gives the gradient of that loss, once.
    """
    if _place()[1] == 1:
        return part
    out: torch.Tensor = _Gather.apply(part, count)  # type: ignore[no-untyped-call]
    return out


def add(tensor: torch.Tensor) -> torch.Tensor:
    """Sum over processes; differentiable under the same rule as :func:`gather`."""
    if _place()[1] == 1:
        return tensor
    out: torch.Tensor = _Add.apply(tensor)  # type: ignore[no-untyped-call]
    return out


def share_gradients(*tensors: torch.Tensor) -> None:
    """Sum the gradients of the parameters over processes: each process's graph holds only its own share."""
    if _place()[1] == 1:
        return
    for tensor in tensors:
        if tensor.grad is None:
            tensor.grad = torch.zeros_like(tensor)
        dist.all_reduce(tensor.grad)


def _place() -> tuple[int, int]:
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, part: torch.Tensor, count: int) -> torch.Tensor:
        _, size = _place()
        edges = [count * i // size for i in range(size + 1)]
        most = max(b - a for a, b in itertools.pairwise(edges))
        padded = part.new_zeros((most, *part.shape[1:]))
        padded[: len(part)] = part
        pieces = [torch.empty_like(padded) for _ in range(size)]
        dist.all_gather(pieces, padded)
        ctx.mine = share(count)
        return torch.cat([piece[: b - a] for piece, a, b in zip(pieces, edges[:-1], edges[1:], strict=True)])

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        total = grads[0].contiguous().clone()
        dist.all_reduce(total)
        return total[ctx.mine] / _place()[1], None


class _Add(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: torch.Tensor) -> torch.Tensor:
        total = tensor.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> torch.Tensor:
        total = grads[0].contiguous().clone()
        dist.all_reduce(total)
        return total / _place()[1]


def psf_stack_shared(
    phase_rad: torch.Tensor, transmission: torch.Tensor, *, axis: Axis = "depth", **arguments: Any
) -> PsfStack:
    """:func:`psf_stack` with the work split over the processes along ``axis``; every process gets the whole stack.

    Phase and transmission must be the same on every process. After ``backward`` of the same loss everywhere, call
    :func:`share_gradients` on them.

    Args:
        axis: what is split; ``angle`` needs (n, 2) angles, ``wavelength`` several wavelengths, each at least as many
            as processes.
        arguments: as :func:`psf_stack`.

    Raises:
        PropagationError: fewer items along the axis than processes; otherwise as :func:`psf_stack`.
    """
    key = {"depth": "depths_um", "angle": "angle_rad", "wavelength": "wavelength_um"}[axis]
    items = arguments[key] if isinstance(arguments[key], torch.Tensor) else np.atleast_1d(arguments[key])
    count, (_, size) = len(items), _place()
    if count < size or (axis == "angle" and np.ndim(items) != 2):
        raise PropagationError(f"{size} processes, but {key} holds {count} items to split; need one or more for each")
    if size == 1:
        return psf_stack(phase_rad, transmission, **arguments)
    mine = share(count)
    if axis == "wavelength":
        return _by_wavelength(phase_rad, transmission, mine, count, arguments)
    stack = psf_stack(phase_rad, transmission, **arguments | {key: items[mine]})
    place = -3 if axis == "depth" else -4
    light = gather(stack.intensity.movedim(place, 0), count).movedim(0, place)
    energy = gather(stack.energy_um2.movedim(place + 2, 0), count).movedim(0, place + 2)
    return _completed(stack, {"intensity": light, "energy_um2": energy}, axis, arguments)


def _by_wavelength(
    phase: torch.Tensor, level: torch.Tensor, mine: slice, count: int, arguments: dict[str, Any]
) -> PsfStack:
    given = arguments.get("weights")
    weights = np.full(count, 1 / count) if given is None else np.asarray(given, float) / np.sum(given)
    waves = np.asarray(arguments["wavelength_um"], float)
    part = arguments | {"wavelength_um": waves[mine].tolist(), "weights": weights[mine].tolist()}
    stack = psf_stack(phase[..., mine, :, :], level.expand(phase.shape)[..., mine, :, :], **part)
    scale = float(weights[mine].sum())
    light = add(stack.intensity * (stack.energy_um2 * scale)[..., None, None])
    energy = light.sum((-1, -2))
    found = {"intensity": light / energy[..., None, None], "energy_um2": energy}
    return _completed(stack, found | {"wavelengths_um": waves, "weights": weights}, "wavelength", arguments)


def _completed(stack: PsfStack, found: dict[str, Any], axis: Axis, arguments: dict[str, Any]) -> PsfStack:
    """The record of the whole stack: all axes, and the worst error of any process."""
    worst = torch.tensor([stack.error], dtype=torch.float64, device=stack.intensity.device)
    dist.all_reduce(worst, op=dist.ReduceOp.MAX)
    if axis == "depth":
        depths = arguments["depths_um"]
        value = depths.detach().cpu().numpy() if isinstance(depths, torch.Tensor) else np.asarray(depths, float)
        found["depths_um"] = value
    if axis == "angle":
        for name in ("angles_rad", "centres_um"):
            part = torch.as_tensor(getattr(stack, name), device=stack.intensity.device)
            found[name] = gather(part, len(arguments["angle_rad"])).cpu().numpy()
    budget = dataclasses.replace(stack.budget or Budget(float(worst)), numerical=float(worst))
    return dataclasses.replace(stack, **found, error=float(worst), budget=budget)
