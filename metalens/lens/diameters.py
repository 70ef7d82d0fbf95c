"""Sizes of pillars on the sites of a lattice."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from metalens.cell import Lattice
from metalens.core.arrays import Array
from metalens.core.errors import LensError

_BLOCK_ROWS = 256


class SiteSpacing(NamedTuple):
    """Distances of columns and rows, and the area of a pillar's cell; 0: as on a square
    lattice.
    """

    pitch_um: float
    row_um: float = 0.0
    site_um2: float = 0.0


@dataclass(frozen=True, eq=False, slots=True)
class DiameterMap:
    """Pillar sizes on a lattice; the lens axis sits at index ((ny-1)/2, (nx-1)/2).

    A hexagonal lattice is every other site of a grid of half a pitch along x and
    ``row_um`` along y: those with row + column odd hold no pillar.

    Attributes:
        diameter_um: (y, x) size of every pillar (its diameter where it is round), 0
            where there is no pillar and no light passes; +x right, +y down. An array,
            or an HDF5 data set that is read in blocks of rows.
        pitch_um: lattice constant.
        lattice: square, rectangular or hexagonal.
        row_um: distance of the rows; 0 for that of the lattice (a mask on a grid may
            need another, by a fraction).
        angle_rad: (y, x) turn of every pillar in the plane, from +x to +y, on top of
            that of the shape; None for none.
        length_um: (y, x) size along y where pillars have two; ``diameter_um`` is then
            that along x. None: by the shape.
        pillars: how many sites hold a pillar.

    Raises:
        LensError: not 2-D, non-finite, negative, or as wide as the pitch (row and
            column named); no pillar; a pillar between the sites of the lattice; turns
            that do not fit the map.
    """

    diameter_um: Array
    pitch_um: float
    lattice: Lattice = field(default_factory=Lattice)
    row_um: float = 0.0
    angle_rad: Array | None = None
    length_um: Array | None = None
    pillars: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        d = self.diameter_um
        if d.ndim != 2:
            raise LensError(f"diameter map has shape {d.shape}, need (y, x)")
        if (
            not 0.9 * self.lattice_row_um
            <= (self.row_um or self.lattice_row_um)
            <= 1.1 * self.lattice_row_um
        ):
            raise LensError(
                f"row_um = {self.row_um}: rows of this {self.lattice.kind} lattice lie {self.lattice_row_um:.6g} um "
                "apart; need 0, or that within 10 %"
            )
        count = 0
        for first, block in _blocks(d):
            wrong = np.argwhere(~((block >= 0) & (block < self.pitch_um)))
            for row, column in wrong[:1].tolist():
                raise LensError(
                    f"diameter at row {first + row}, column {column} is "
                    f"{block[row, column]} um, "
                    f"need 0 (no pillar) or 0 < diameter < pitch {self.pitch_um} um"
                )
            count += int(np.count_nonzero(block))
        object.__setattr__(self, "pillars", count)
        if count == 0:
            raise LensError(
                "empty aperture: the map holds no pillar; check the aperture and the profile"
            )
        turn = self.angle_rad
        if turn is not None and not (turn.shape == d.shape and np.isfinite(turn).all()):
            raise LensError(
                f"angle_rad of shape {turn.shape}: need finite turns of the {d.shape} map of diameters"
            )
        length = self.length_um
        if length is not None and not (
            length.shape == d.shape and np.isfinite(length).all() and length.min() >= 0
        ):
            raise LensError(
                f"length_um of shape {length.shape}: need lengths >= 0 of the {d.shape} map of diameters"
            )
        if self.lattice.centred:
            for row in range(min(2, len(d))):
                if np.asarray(d[row::2])[:, 1 - row :: 2].any():
                    raise LensError(
                        "a pillar between the sites of the hexagonal lattice: row + column is odd there"
                    )

    @property
    def lattice_row_um(self) -> float:
        """Distance of the rows of an exact lattice."""
        return self.lattice.periods_um(self.pitch_um)[1] / (
            2 if self.lattice.centred else 1
        )

    @property
    def steps_um(self) -> tuple[float, float]:
        """(x, y) distance of neighbouring columns and rows of the map."""
        return self.pitch_um / (
            2 if self.lattice.centred else 1
        ), self.row_um or self.lattice_row_um

    @property
    def site_um2(self) -> float:
        """Area of the cell of one pillar."""
        x, y = self.steps_um
        return x * y * (2 if self.lattice.centred else 1)

    @property
    def grid(self) -> "SiteSpacing":
        """The map's sites as :func:`metalens.propagate.make_case` takes them; zeros on
        a square lattice.
        """
        square = self.lattice.kind == "square" and not self.row_um
        column, row = self.steps_um
        return (
            SiteSpacing(column) if square else SiteSpacing(column, row, self.site_um2)
        )

    @property
    def plain(self) -> bool:
        """Whether it is a square lattice of pillars of one size that are not turned."""
        return (
            self.lattice.kind == "square"
            and not self.row_um
            and self.angle_rad is None
            and self.length_um is None
        )

    @property
    def x_um(self) -> Array:
        """(x,) positions of the columns."""
        return _axis(self.diameter_um.shape[1], self.steps_um[0])

    @property
    def y_um(self) -> Array:
        """(y,) positions of the rows."""
        return _axis(self.diameter_um.shape[0], self.steps_um[1])

    @property
    def radius_um(self) -> float:
        """Distance from the axis to the outermost pillar centre; memory of a few rows."""
        farthest = 0.0
        for start, block in _blocks(self.diameter_um):
            there = block > 0
            held = there.any(axis=1)
            if held.any():
                first, last = (
                    there.argmax(axis=1),
                    there.shape[1] - 1 - there[:, ::-1].argmax(axis=1),
                )
                outer = np.maximum(np.abs(self.x_um[first]), np.abs(self.x_um[last]))
                y = self.y_um[start : start + len(block)]
                farthest = max(farthest, float(np.hypot(outer, y)[held].max()))
        return farthest


def _blocks(d: Array) -> Iterator[tuple[int, Array]]:
    """(first row, rows) of a map, block by block."""
    for first in range(0, len(d), _BLOCK_ROWS):
        yield first, np.asarray(d[first : first + _BLOCK_ROWS])


def _axis(count: int, pitch_um: float) -> Array:
    return (np.arange(count) - (count - 1) / 2) * pitch_um
