"""Compiled loop that averages pillars over cells, and which tensors it may read."""

from typing import Any

import numba
import numpy as np
from torch import Tensor
from torch.autograd import forward_ad

from metalens.core.arrays import Array
from metalens.core.threads import run_split
from metalens.lens import response
from metalens.propagate import sincos_turns32

# compiled loops know names of their own module
PART: int = response.PART
put: Any = response.evaluate_row  # type: ignore[has-type]


def cells(
    diameter_um: Array,
    ideal_rad: Array,
    polynomials: response.Polynomials,
    block: tuple[int, int, int],
) -> Array:
    """(3, cells y, cells x) float32 means over square cells of sites.

    Of |T| cos(φ - ideal), of |T| sin(φ - ideal), and of 1 at each pillar.

    Args:
        diameter_um: (y, x) diameters, 0 at sites without a pillar.
        ideal_rad: (y, x) float32 carrier phase.
        polynomials: phase and |T| of the diameters, by
            :func:`metalens.lens.response.response_polynomials`.
        block: sites along a cell, and rows and columns of the first cell that lie
            before the map.
    """
    side, *before = block
    shape = [
        -(-(n + b) // side) for n, b in zip(diameter_um.shape, before, strict=True)
    ]
    out = np.zeros((3, *shape), np.float32)
    run_split(
        shape[0],
        lambda a, b: _cells(diameter_um, ideal_rad, polynomials, block, out[:, a:b], a),
    )
    return out


@numba.njit(cache=True, fastmath=response.FASTMATH, nogil=True, error_model="numpy")
def _cells(d, ideal, polynomials, block, out, first):  # type: ignore[no-untyped-def]
    """Write some rows of cells into ``out``, each summed in float64.

    Args:
        d, ideal: (y, x) diameters and carrier phase.
        polynomials: phase and |T| of the diameters.
        block: sites along a cell, and rows and columns before the map.
        out: (3, rows, cells x) float32.
        first: number of the first row of cells.
    """
    side, top, left = block
    x, phase, level = np.empty(PART), np.empty(PART), np.empty(PART)
    for row in range(out.shape[1]):
        sums = np.zeros((3, out.shape[2]))
        for i in range(
            max((first + row) * side - top, 0),
            min((first + row + 1) * side - top, d.shape[0]),
        ):
            for start in range(0, d.shape[1], PART):
                diameters = d[i, start : start + PART]
                n = diameters.size
                put(diameters, polynomials, x[:n], phase[:n], level[:n])
                for j in range(n):
                    t = (phase[j] - ideal[i, start + j]) / (2 * np.pi)
                    c, s = sincos_turns32(t - np.rint(t))
                    x[j], phase[j] = level[j] * c, level[j] * s
                for j in range(n):
                    if diameters[j] > 0:
                        cell = (start + j + left) // side
                        sums[0, cell] += x[j]
                        sums[1, cell] += phase[j]
                        sums[2, cell] += 1
        out[:, row] = sums / (side * side)


def is_plain_value(a: Tensor) -> bool:
    """Whether a tensor lies in main memory and carries no gradient of either mode.

    Args:
        a: a tensor.
    """
    return a.device.type == "cpu" and has_no_gradient(a)


def has_no_gradient(a: Tensor) -> bool:
    """Whether a tensor carries no gradient, of reverse or of forward mode.

    Args:
        a: a tensor.
    """
    return not a.requires_grad and forward_ad.unpack_dual(a).tangent is None  # type: ignore[no-untyped-call]
