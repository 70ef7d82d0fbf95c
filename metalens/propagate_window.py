"""Windowed propagation: only the field on the sensor window, from Legendre moments of the lens."""

import functools
from dataclasses import dataclass

import numpy as np
import torch

from metalens import legendre
from metalens.propagate_case import Case, chief_path
from metalens.propagate_estimate import MORE
from metalens.propagate_pillars import Moments, moments, reduce
from metalens.propagate_plan import Operators, depth_factors, operators, sizes
from metalens.store import Array

BUDGET_BYTES = 48e6


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """Everything that depends on the geometry alone, ready for many lenses.

    operators hold the float64 arrays; tensors the same in the dtype and on the device in use. The moments go
    ``MORE`` orders beyond what the method uses, for the error estimate.
    """

    case: Case
    tolerance: float
    operators: Operators
    moments: Moments
    tensors: dict[str, torch.Tensor]


@dataclass(frozen=True, eq=False, slots=True)
class Moving:
    """Geometry that carries gradients, float64 tensors: tangents (2,), inverse depths (depth,), sensor distance (),
    window centre (2,). Values must be those of the plan's case."""

    tangents: torch.Tensor
    inverse_depths: torch.Tensor
    distance: torch.Tensor
    centre: torch.Tensor


@functools.lru_cache(maxsize=12)
def plan(case: Case, tolerance: float, dtype: torch.dtype, device: torch.device, moving: bool = False) -> Plan:
    """Plan a windowed propagation; the last few are kept. ``moving``: for use with :class:`Moving`.

    Raises:
        PropagationError: the window is too large for the method.
    """
    found = operators(case, sizes(case, tolerance), tolerance, moving=moving)
    ny, nx = found.sizes.nodes
    pillars = moments(case, found.reference, (ny + MORE, nx + MORE), dtype)
    folds = pillars.folds[0].to(device), pillars.folds[1].to(device)
    pillars = Moments(pillars.carrier, pillars.table, pillars.rows.to(device), folds)
    return Plan(case, tolerance, found, pillars, _tensors(found, dtype, device))


@functools.lru_cache(maxsize=12)
def _slope(plan: Plan, axis: int) -> dict[str, torch.Tensor]:
    """Tensors of the derivative in sensor distance, window centre x, y (axis 0, 1, 2)."""
    found = operators(plan.case, plan.operators.sizes, plan.tolerance, slope=axis, moving=True)
    return _tensors(found, plan.moments.rows.dtype, plan.moments.rows.device)


def _tensors(found: Operators, dtype: torch.dtype, device: torch.device) -> dict[str, torch.Tensor]:
    complex_dtype = torch.complex64 if dtype == torch.float32 else torch.complex128
    names = ("basis", "coefficients", "along_y", "along_x", "lens_terms", "window_terms")
    out = {name: torch.tensor(getattr(found, name), dtype=complex_dtype, device=device) for name in names}
    out["pairs"] = torch.tensor(found.pairs, device=device)
    out["to_directions"] = torch.tensor(found.to_directions, dtype=dtype, device=device)
    ny, nx = found.sizes.nodes
    out["rows_to_nodes"] = torch.tensor(legendre.to_nodes(ny), dtype=complex_dtype, device=device)
    out["columns_to_nodes"] = torch.tensor(legendre.to_nodes(nx), dtype=complex_dtype, device=device)
    return out


def field_windowed(
    phase_rad: torch.Tensor, transmission: torch.Tensor, plan: Plan, moving: Moving | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Field on the window, (depth, y, x) complex, and the moments of the lens that :mod:`propagate_estimate` needs.

    Differentiable in phase and transmission (y, x), and in ``moving`` where given (first derivatives).
    """
    gathered = reduce(phase_rad, transmission, plan.moments)
    t = plan.tensors
    ny, nx = plan.operators.sizes.nodes
    light = t["rows_to_nodes"].T @ gathered[:ny, :nx] @ t["columns_to_nodes"] * t["basis"]
    coefficients = t["coefficients"] if moving is None else _coefficients(plan, moving)
    field = coefficients @ zoom(light, t).flatten(1)
    if moving is not None:
        for axis, value in enumerate((moving.distance, moving.centre[0], moving.centre[1])):
            if value.requires_grad:
                rate = coefficients @ zoom(light, _slope(plan, axis)).flatten(1)
                field = field + (value - value.detach()) * rate  # adds nothing but the derivative
    return field.view(-1, *plan.case.samples), gathered.detach()


def _coefficients(plan: Plan, moving: Moving) -> torch.Tensor:
    """(depth, b) of the depth basis, differentiable in the source's position."""
    device = moving.tangents.device
    e, x = (torch.tensor(v, device=device) for v in node_positions(plan.operators, plan.case))
    ny, nx = plan.operators.sizes.nodes
    inverse = moving.inverse_depths[:, None, None]
    angle = depth_factors(plan.case, e[:, None], x, (moving.tangents[0], moving.tangents[1]), inverse)
    weight = torch.tensor(np.outer(legendre.nodes(ny)[1], legendre.nodes(nx)[1]), device=device)
    basis = torch.tensor(plan.operators.basis, device=device)
    fields = torch.exp(1j * angle) * weight
    found = fields.flatten(1) @ basis.flatten(1).conj().T
    turn = np.exp(1j * plan.case.wavenumber * chief_path(plan.case))
    return (found * complex(turn)).to(plan.tensors["coefficients"].dtype)


def zoom(light: torch.Tensor, t: dict[str, torch.Tensor]) -> torch.Tensor:
    """Light on lens nodes, one field per basis function (b, e, x), to the window (b, Y, X)."""
    b, e, _ = light.shape
    p = t["to_directions"].shape[2]
    real = torch.view_as_real(light).permute(1, 0, 3, 2).reshape(e, 2 * b, -1)
    cosines = torch.bmm(real, t["to_directions"]).view(e, b, 2, p).permute(3, 0, 1, 2).contiguous()
    spread = torch.view_as_complex(cosines)
    _, Y, X = t["window_terms"].shape
    out = light.new_zeros((X * Y, b))
    count = max(1, int(BUDGET_BYTES / (p * (Y + e) * light.element_size())))
    for r, i in zip(*(torch.split(index, count) for index in t["pairs"]), strict=True):
        terms = t["lens_terms"][r].permute(1, 2, 0) * spread[:, :, i]
        columns = torch.bmm(t["along_y"], terms)
        window = (t["along_x"] @ columns.view(p, -1)).view(X * Y, -1)
        out = out.index_add(1, i, window * t["window_terms"][r].permute(2, 1, 0).reshape(X * Y, -1))
    return out.view(X, Y, b).permute(2, 1, 0)


def node_positions(found: Operators, case: Case) -> tuple[Array, Array]:
    """(e,), (x,) positions of the lens nodes, um."""
    (hy, hx), (ny, nx) = case.half_size_um, found.sizes.nodes
    return np.asarray(legendre.mapped(ny, -hy, hy)), np.asarray(legendre.mapped(nx, -hx, hx))
