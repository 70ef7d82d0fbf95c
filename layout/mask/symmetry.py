"""A lens that looks the same under all turns and mirrors of the square is stored once,
as an eighth, and placed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import PillarLattice
from metalens.core.arrays import Array

ALL_EIGHT = tuple((quarter, flip) for flip in (False, True) for quarter in range(4))
FOUR_TURNS = tuple((quarter, False) for quarter in range(4))


@dataclass(frozen=True, eq=False, slots=True)
class LatticePiece:
    """Part of a lattice, and how it is placed at (0, 0): (quarter turns
    counter-clockwise, mirrored at x first).
    """

    lattice: PillarLattice
    placed: Sequence[tuple[int, bool]]


def is_square_symmetric(lattice: PillarLattice) -> bool:
    """Whether the lattice, centred at (0, 0), is the same under the eight symmetries of
    the square.
    """
    a = lattice.array
    if (
        a is None
        or not lattice.square
        or lattice.rows != lattice.columns
        or lattice.rows < 4
    ):
        return False
    span = (lattice.columns - 1) * lattice.pitch
    if (2 * lattice.x0, 2 * lattice.y0) != (-span, span):
        return False
    return (
        np.array_equal(a, a[::-1])
        and np.array_equal(a, a[:, ::-1])
        and np.array_equal(a, a.T)
    )


def least_of_images(values: Array) -> Array:
    """(n, n) the least of the values at a site and its seven images, which makes all
    eighths alike.
    """
    up = np.minimum(values, values[::-1])
    quarters = np.minimum(up, up[:, ::-1])
    return np.minimum(quarters, quarters.T)


def symmetry_pieces(lattice: PillarLattice) -> list[LatticePiece]:
    """The open eighth between the +x axis and the diagonal, the diagonal, and (odd
    counts) axis and centre.
    """
    quarter = _upper_right(lattice)
    n = len(
        quarter
    )  # row n - 1 is the one nearest to the x axis, column 0 nearest to the y axis
    row, column = np.indices((n, n), sparse=True)
    height = n - 1 - row
    odd = lattice.rows % 2
    masks = [
        ("8", (column > height) & (height >= odd), ALL_EIGHT),
        ("D", (column == height) & (column >= odd), FOUR_TURNS),
        ("A", (height < odd) & (column >= odd), FOUR_TURNS),
        ("C", (height < odd) & (column < odd), FOUR_TURNS[:1]),
    ]
    made = []
    for letter, mask, placed in masks:
        part = np.where(mask, quarter, 0).astype(quarter.dtype)
        if part.any():
            made.append(LatticePiece(_lattice(lattice, part, letter), placed))
    return made


def _upper_right(lattice: PillarLattice) -> Array:
    half = (lattice.rows + 1) // 2
    return lattice.whole()[:half, lattice.columns - half :]


def _lattice(lattice: PillarLattice, part: Array, letter: str) -> PillarLattice:
    x0 = lattice.x0 + (lattice.columns - part.shape[1]) * lattice.pitch
    return PillarLattice.of(
        f"{lattice.name[:29]}_{letter}", part, pitch=lattice.pitch, x0=x0, y0=lattice.y0
    )
