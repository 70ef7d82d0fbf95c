"""The sections of a pillar as it is made: layers one upon another, their walls tilted,
refused where they overlap.
"""

import functools
import itertools
import math
from collections.abc import Callable

import numpy as np

from metalens.cell import Cell, Layer
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa import pattern
from metalens.rcwa.wall import Sample, TiltedWall

# cross-sections of a tilted wall: coefficients turn by a few radians between foot and
# top
_NODES = 8
Operators = Callable[[pattern.PillarSection], tuple[Array, Array]]


def section_walls(
    cell: Cell, size_um: float, wavelength_um: float, operators: Operators
) -> list[TiltedWall]:
    """Every section, foot first; operators: P and Q of a cross-section."""
    made = [
        _wall(cell, layer, grow, size_um, wavelength_um, operators)
        for layer, grow in sections_with_growth(cell)
    ]
    return (
        [
            TiltedWall(interpolate_operators(part.sample), part.reduced_height)
            for part in made
        ]
        if cell.sidewall_rad
        else made
    )


def height_nodes() -> Array:
    """(k,) shares of the height whose cross-sections stand for a tilted wall: Chebyshev
    points.
    """
    return np.asarray((1 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2)


def interpolation_weights(share: float | Array) -> Array:
    """(*shape, k) of the nodes, in the polynomial through their values."""
    vandermonde = np.linalg.inv(
        np.polynomial.chebyshev.chebvander(2 * height_nodes() - 1, _NODES - 1)
    )
    return np.asarray(
        np.polynomial.chebyshev.chebvander(2 * np.asarray(share) - 1, _NODES - 1)
        @ vandermonde
    )


def interpolate_operators(sample: Sample) -> Sample:
    """P and Q from polynomials through their values at Chebyshev points of the height,
    worked out when first asked.
    """

    @functools.cache
    def values() -> tuple[Array, Array]:
        P, Q = zip(*(sample(float(node)) for node in height_nodes()), strict=True)
        return np.stack(P), np.stack(Q)

    def at(share: float) -> tuple[Array, Array]:
        P, Q = (
            np.tensordot(interpolation_weights(share).ravel(), part, 1)
            for part in values()
        )
        return P, Q

    return at


def _wall(
    cell: Cell,
    layer: Layer,
    grow_um: float,
    size_um: float,
    wavelength_um: float,
    operators: Operators,
) -> TiltedWall:
    def sample(share: float) -> tuple[Array, Array]:
        wide = grow_um + width_change_um(cell, layer, share)
        return operators(
            pattern.pillar_section(cell, layer, size_um, wavelength_um, grow_um=wide)
        )

    return TiltedWall(sample, layer.height_um * 2 * math.pi / wavelength_um)


def check_size(cell: Cell, size_um: float) -> None:
    """Refuse sizes that leave nothing or overlap, for every section.

    Raises:
        CellError: says which section is too wide or too thin.
    """
    if not (math.isfinite(size_um) and size_um > 0):
        raise CellError(f"size = {size_um} um: need a finite length above 0")
    for (layer, grow), end in itertools.product(sections_with_growth(cell), (0.0, 1.0)):
        wide = (
            layer.grow_um + grow + width_change_um(cell, layer, end) + 2 * layer.coat_um
        )
        if cell.gap_um(size_um, grow_um=wide) <= 0:
            raise CellError(
                f"{cell.described}, size {size_um:g} um: a section {wide:+.4g} um wider touches its neighbour on a "
                f"pitch of {cell.pitch_um:g} um; need a smaller size or a larger pitch"
            )


def width_slope(cell: Cell) -> float:
    """Change of width for each um of height above the middle."""
    return -2 * math.tan(cell.sidewall_rad)


def width_change_um(cell: Cell, layer: Layer, share: float) -> float:
    """Change of width from the middle of a section to this share of its height."""
    return (share - 0.5) * width_slope(cell) * layer.height_um


def sections_with_growth(cell: Cell) -> list[tuple[Layer, float]]:
    """(section, widening at its middle by the tilted wall), foot first."""
    found, foot = [], 0.0
    for layer in cell.sections:
        middle = foot + layer.height_um / 2 - cell.height_um / 2
        found.append((layer, width_slope(cell) * middle))
        foot += layer.height_um
    return found
