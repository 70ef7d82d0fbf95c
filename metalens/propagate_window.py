"""Windowed propagation: only the field on the sensor window, from Legendre moments of the lens."""

import functools
from dataclasses import dataclass

import numpy as np
import torch

from metalens import legendre
from metalens.propagate_case import Case
from metalens.propagate_pillars import Moments, moments, reduce
from metalens.propagate_plan import Operators, operators, sizes
from metalens.store import Array

BUDGET_BYTES = 32e6


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """Everything that depends on the geometry alone, ready for many lenses.

    operators hold the float64 arrays; tensors the same in the dtype and on the device of the calculation.
    """

    case: Case
    tolerance: float
    operators: Operators
    moments: Moments
    tensors: dict[str, torch.Tensor]


@functools.lru_cache(maxsize=12)
def plan(case: Case, tolerance: float, dtype: torch.dtype, device: torch.device) -> Plan:
    """Plan a windowed propagation; the last few are kept.

    Raises:
        PropagationError: the window is too large for the method.
    """
    found = operators(case, sizes(case, tolerance), tolerance)
    pillars = moments(case, found.reference, found.sizes.nodes, dtype)
    pillars = Moments(
        case, pillars.reference, pillars.rows.to(device), (pillars.folds[0].to(device), pillars.folds[1].to(device))
    )
    return Plan(case, tolerance, found, pillars, _tensors(found, dtype, device))


def _tensors(found: Operators, dtype: torch.dtype, device: torch.device) -> dict[str, torch.Tensor]:
    complex_dtype = torch.complex64 if dtype == torch.float32 else torch.complex128
    names = ("basis", "coefficients", "along_y", "along_x", "lens_terms", "window_terms")
    out = {name: torch.tensor(getattr(found, name), dtype=complex_dtype, device=device) for name in names}
    out["to_directions"] = torch.tensor(found.to_directions, dtype=dtype, device=device)
    ny, nx = found.sizes.nodes
    out["rows_to_nodes"] = torch.tensor(legendre.to_nodes(ny), dtype=complex_dtype, device=device)
    out["columns_to_nodes"] = torch.tensor(legendre.to_nodes(nx), dtype=complex_dtype, device=device)
    return out


def field_windowed(phase_rad: torch.Tensor, transmission: torch.Tensor, plan: Plan) -> torch.Tensor:
    """Field on the window, (depth, y, x) complex; differentiable in phase and transmission (y, x)."""
    at_nodes = nodes(phase_rad, transmission, plan)
    fields = zoom(at_nodes * plan.tensors["basis"], plan.tensors)
    return (plan.tensors["coefficients"] @ fields.flatten(1)).view(-1, *plan.case.samples)


def nodes(phase_rad: torch.Tensor, transmission: torch.Tensor, plan: Plan) -> torch.Tensor:
    """(e, x) the lens gathered on its Legendre nodes, carrier removed."""
    gathered = reduce(phase_rad, transmission, plan.moments)
    return plan.tensors["rows_to_nodes"].T @ gathered @ plan.tensors["columns_to_nodes"]


def zoom(light: torch.Tensor, t: dict[str, torch.Tensor]) -> torch.Tensor:
    """Light on lens nodes (b, e, x) to the window (b, Y, X)."""
    directions, rows, _ = t["along_y"].shape
    rank = t["lens_terms"].shape[0]
    each = directions * rows * rank * light.element_size()
    count = max(1, int(BUDGET_BYTES / each))
    return torch.cat([_zoom(part, t) for part in torch.split(light, count)])


def _zoom(light: torch.Tensor, t: dict[str, torch.Tensor]) -> torch.Tensor:
    b, e, _ = light.shape
    rank, p, _ = t["lens_terms"].shape
    _, Y, X = t["window_terms"].shape
    real = torch.view_as_real(light).permute(1, 0, 3, 2).reshape(e, 2 * b, -1)
    cosines = torch.bmm(real, t["to_directions"]).view(e, b, 2, p).permute(3, 0, 1, 2).contiguous()
    terms = t["lens_terms"].permute(1, 2, 0)[:, :, :, None] * torch.view_as_complex(cosines)[:, :, None, :]
    columns = torch.bmm(t["along_y"], terms.reshape(p, e, rank * b))
    window = (t["along_x"] @ columns.reshape(p, -1)).view(X, Y, rank, b)
    return torch.einsum("xyrb,ryx->byx", window, t["window_terms"])


def node_positions(found: Operators, case: Case) -> tuple[Array, Array]:
    """(e,), (x,) positions of the lens nodes, um."""
    (hy, hx), (ny, nx) = case.half_size_um, found.sizes.nodes
    return np.asarray(legendre.mapped(ny, -hy, hy)), np.asarray(legendre.mapped(nx, -hx, hx))
