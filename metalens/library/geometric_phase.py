"""Circular light on pillars that are turned one by one: the geometric phase, and what
the lattice adds to it.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa import SAFETY, jones


@dataclass(frozen=True, eq=False, slots=True)
class GeometricPhase:
    """Solved cells of one pillar, turned in its lattice.

    size_um: of the pillar.
    wavelength_um: in vacuum.
    angle_rad: (n,) turns over one period of the lattice.
    t: (n, 2, 2) Jones matrices in x and y.
    t_error: (n,) error bars of the solver.
    earlier: (n, k, 2, 2) t of coarser truncations. The error bar of a share of the
        light is ``rcwa.SAFETY`` times its largest change over them.
    """

    size_um: float
    wavelength_um: float
    angle_rad: Array
    t: Array
    t_error: Array
    earlier: Array

    def converted(self, hand: float) -> Array:
        """(n,) amplitude that leaves with the other hand, with its geometric phase
        removed: times exp(-2i hand angle).

        Args:
            hand: +1 where x + iy comes, -1 where x - iy does.
        """
        return np.asarray(
            to_circular_basis(self.t, hand)[1] * np.exp(-2j * hand * self.angle_rad)
        )

    def _share(self, of: Callable[["GeometricPhase"], float]) -> tuple[float, float]:
        """A quantity of t, and its error bar: SAFETY times its largest change over the
        coarser truncations, or SAFETY where there are none.

        Args:
            of: the quantity, as a function of solved cells.
        """
        present = of(self)
        coarser = [
            of(dataclasses.replace(self, t=self.earlier[:, k]))
            for k in range(self.earlier.shape[1])
        ]
        return present, SAFETY * max(
            (abs(value - present) for value in coarser), default=1.0
        )

    def efficiency(self, hand: float) -> tuple[float, float]:
        """Share of the light in the converted wave, and its error bar: |mean over the
        turns of the converted amplitude without geometric phase|².

        What the spread over the turns scatters is not included.
        """
        return self._share(lambda cells: float(abs(cells.converted(hand).mean()) ** 2))

    def unconverted(self, hand: float) -> tuple[float, float]:
        """Share of the light that keeps its hand, the mean over all turns, and its
        error bar.
        """
        return self._share(
            lambda cells: float(
                (np.abs(to_circular_basis(cells.t, hand)[0]) ** 2).mean()
            )
        )

    @property
    def model_error(self) -> float:
        """Largest |solved - model| of the converted amplitude, over all turns and both
        hands; the model turns the pillar solved at angle 0.
        """
        return max(
            float(
                np.abs(
                    self.converted(hand) - to_circular_basis(self.t[0], hand)[1]
                ).max()
            )
            for hand in (1.0, -1.0)
        )


def to_circular_basis(t: Array, hand: float) -> tuple[Array, Array]:
    """(kept, converted) amplitudes of the circular wave x + iy (hand +1) or x - iy (-1)
    through Jones matrices.

    With c = (1, i hand)/sqrt(2): kept = t c . conj(c), converted = t c . c.

    Args:
        t: (..., 2, 2) Jones matrices in x and y.
    """
    incoming = np.array([1.0, 1j * hand]) / math.sqrt(2)
    outgoing = t @ incoming
    return np.asarray(outgoing @ incoming.conj()), np.asarray(outgoing @ incoming)


def mirror_jones(t: Array) -> Array:
    """Jones matrices of the mirror image (y to -y), which is the pillar turned the
    other way: the cross terms change sign.

    Args:
        t: (..., 2, 2) Jones matrices in x and y.
    """
    return np.asarray(t * np.array([[1.0, -1.0], [-1.0, 1.0]]))


def period_rad(cell: Cell) -> float:
    """Turn of the pillar in its lattice after which the Jones matrix repeats, in the
    pillar's axes, rad: pi/2 (square), pi/3 (hexagonal), else pi.

    Args:
        cell: unit cell with its materials, shape and lattice.
    """
    return {"square": math.pi / 2, "hexagonal": math.pi / 3}.get(
        cell.lattice.kind, math.pi
    )


def check_geometric_phase(cell: Cell, size_um: float) -> None:
    """Refuse pillars that carry no geometric phase, and those whose mirrors do not lie
    along x and y.

    Args:
        cell: unit cell with its materials, shape and lattice.
        size_um: of the pillar, um.

    Raises:
        CellError: the shape is the same along both axes, is turned already, or has no
            such mirrors.
    """
    outline = cell.outline(size_um)
    if not (outline.keeps(-1, 1) and outline.keeps(1, -1)):
        raise CellError(
            f"circular light: a {cell.shape.name} without mirrors along x and y; need angle_rad = 0"
        )
    elongated = getattr(cell.shape, "ratio", 1.0) != 1.0 and cell.shape.kind in (
        "rectangle",
        "ellipse",
    )
    if not elongated and cell.shape.kind != "polygon":
        raise CellError(
            f"circular light: a {cell.shape.name} responds equally to x and y and gives no geometric phase; "
            "need a rectangle, an ellipse or an own polygon that is longer along one axis"
        )


def solve_rotations(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    *,
    tolerance: float,
    steps: int = 3,
) -> GeometricPhase:
    """Solve the pillar at turns over one period of its lattice; the negative turns
    follow from the mirror image.

    Args:
        cell: unit cell with its materials, shape and lattice.
        size_um: of the pillar, um.
        wavelength_um: vacuum wavelength, um.
        tolerance: error of t that is asked for.
        steps: even ones up to half the angle after which the lattice repeats.

    Raises:
        CellError: a shape that cannot be turned (see :func:`check_geometric_phase`), or
            that meets its neighbours when turned.
    """
    check_geometric_phase(cell, size_um)
    period = period_rad(cell)
    angles = np.arange(steps + 1) / (2 * steps) * period
    shapes = [dataclasses.replace(cell.shape, angle_rad=a) for a in angles.tolist()]
    solutions = [
        jones(
            dataclasses.replace(cell, shape=shape),
            size_um,
            wavelength_um,
            tolerance=tolerance,
        )
        for shape in shapes
    ]
    t, error, earlier = (
        np.array([getattr(solution, name) for solution in solutions])
        for name in ("t", "t_error", "earlier")
    )
    mirrored = slice(steps - 1, 0, -1)  # neither 0 nor half the period again
    return GeometricPhase(
        size_um,
        wavelength_um,
        np.concatenate([angles, -angles[mirrored]]),
        np.concatenate([t, mirror_jones(t[mirrored])]),
        np.concatenate([error, error[mirrored]]),
        np.concatenate([earlier, mirror_jones(earlier[mirrored])]),
    )
