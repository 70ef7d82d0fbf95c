"""Cubic B-splines through values at equal steps: twice continuously differentiable.

de Boor, "A Practical Guide to Splines" (2001). An axis has one node (constant) or at
least four ("not-a-knot" ends).
"""

import torch
from torch import Tensor

TAPS = 4  # coefficients of a cubic B-spline that a position touches


def spline_taps(unit: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """First coefficient and the values (…, 4) of the B-splines at positions 0 … 1.

    The nodes lie at equal steps from 0 to 1, with one coefficient more at each end.

    Args:
        unit: places between the nodes, in steps.
    """
    place = unit * (nodes - 1)
    first = place.detach().floor().clamp(0, max(nodes - 2, 0))
    t = place - first
    u = 1 - t
    values = [u**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * u**2 + 3 * u**3, t**3]
    return first.long(), torch.stack(values, -1) / 6


def depth_position(depth_um: Tensor, vergence: tuple[float, float]) -> Tensor:
    """(…) places of depths between nodes: 0 at the nearest, 1 at the farthest, linear
    in 1/z.

    Args:
        depth_um: (…) depths; those beyond the nodes lie on the outermost.
        vergence: (nearest, farthest) 1/z of the nodes.
    """
    nearest, farthest = vergence
    return ((nearest - 1 / depth_um) / max(nearest - farthest, 1e-30)).clamp(0, 1)


def spline_coefficients(nodes: int) -> Tensor:
    """(coefficients, nodes) B-spline coefficients of the spline through node values."""
    if nodes == 1:
        return torch.ones(TAPS, 1, dtype=torch.float64)
    if nodes < TAPS:
        raise ValueError(f"{nodes} nodes of an axis: need 1 or at least {TAPS}")
    equations = torch.zeros(nodes + 2, nodes + 2, dtype=torch.float64)
    for i in range(nodes):
        equations[i, i : i + 3] = torch.tensor([1.0, 4.0, 1.0]) / 6
    fourth_difference = torch.tensor([1.0, -4.0, 6.0, -4.0, 1.0])
    equations[nodes, :5] = fourth_difference
    equations[nodes + 1, -5:] = fourth_difference
    inverse: Tensor = torch.linalg.inv(equations)
    return inverse[:, :nodes]


def spline_basis(unit: Tensor, nodes: int) -> Tensor:
    """(…, coefficients) value of each B-spline of an axis.

    Args:
        unit: (…) positions from the first node, 0, to the last, 1.
        nodes: number of nodes.
    """
    first, taps = spline_taps(unit, nodes)
    number = first[..., None] + torch.arange(TAPS, device=first.device)
    basis = taps.new_zeros(*unit.shape, max(nodes + 2, TAPS))
    return basis.scatter_(-1, number, taps)


def spline_matrix(unit: Tensor, nodes: int) -> Tensor:
    """(positions, nodes) interpolation at positions 0 … 1 of an axis, float64.

    Args:
        unit: (positions,) from the first node, 0, to the last, 1.
    """
    return spline_basis(unit.double(), nodes) @ spline_coefficients(nodes)
