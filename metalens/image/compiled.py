"""Compiled loops: light on the nodes of a pupil, pillars averaged over cells, and
sources weighted for every kernel.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from metalens.core.arrays import Array
from metalens.core.threads import run_split
from metalens.lens import response
from metalens.propagate import sincos_turns32

# compiled loops know names of their own module
PART: int = response.PART
put: Any = response.evaluate_row  # type: ignore[has-type]


def phasors(weight: Array, turns: Array, paths: Array, mix: Array) -> Array:
    """(depths, y, x) complex64 weight exp(2πi (turns + Σ mix paths)).

    Args:
        weight, turns: (y, x) float64. paths: (few, y, x) float64 in turns; mix:
            (depths, few).
    """
    out = np.empty((len(mix), *turns.shape, 2), np.float32)
    light = weight.astype(np.float32)
    run_split(
        turns.shape[0],
        lambda a, b: _phasors(light[a:b], turns[a:b], paths[:, a:b], mix, out[:, a:b]),
    )
    return out.view(np.complex64)[..., 0]


@numba.njit(cache=True, fastmath=True, nogil=True)
def _phasors(weight, turns, paths, mix, out):  # type: ignore[no-untyped-def]
    """Write weight · exp(2πi (turns + mix @ paths)) into ``out``, real and imaginary.

    Row by row, so that the sum of a depth stays in the first cache. Of each row only
    the part from the first to the last open node is computed.

    Args:
        weight, turns: (nodes, nodes) amplitude and phase / 2π.
        paths: (few, nodes, nodes) over the wavelength.
        mix: (depths, few).
        out: (depths, nodes, nodes, 2) float32.
    """
    depths, few = mix.shape
    line = np.empty(turns.shape[1])
    for y in range(turns.shape[0]):
        open_ = np.nonzero(weight[y])[0]
        start, stop = (open_[0], open_[-1] + 1) if len(open_) else (0, 0)
        out[:, y, :start] = 0
        out[:, y, stop:] = 0
        for d in range(depths):
            line[start:stop] = turns[y, start:stop]
            for v in range(few):
                for x in range(start, stop):
                    line[x] += mix[d, v] * paths[v, y, x]
            for x in range(start, stop):
                c, s = sincos_turns32(line[x] - np.rint(line[x]))
                out[d, y, x, 0], out[d, y, x, 1] = weight[y, x] * c, weight[y, x] * s


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


def is_compilable(a: Tensor) -> bool:
    """Whether compiled code may read the values: single precision, in main memory,
    without derivatives.

    Args:
        a: a tensor.
    """
    return a.dtype in (torch.float32, torch.complex64) and is_plain_value(a)


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
