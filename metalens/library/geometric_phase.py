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

# turns that are solved, evenly up to half the angle after which the lattice repeats
STEPS = 3


@dataclass(frozen=True, eq=False, slots=True)
class GeometricPhase:
    """Solved cells of one pillar, turned in its lattice.

    size_um: of the pillar; wavelength_um: in vacuum. angle_rad: (n,) turns over one
        period of the lattice.
    t: (n, 2, 2) Jones matrices in x and y. t_error: (n,) error bars of the solver.
    earlier: (n, k, 2, 2) t of coarser
    truncations: shares of the light have ``rcwa.SAFETY`` times their farthest change
        over them as error bar.
    """

    size_um: float
    wavelength_um: float
    angle_rad: Array
    t: Array
    t_error: Array
    earlier: Array

    def converted(self, hand: float) -> Array:
        """(n,) amplitude that leaves with the other hand, without the geometric phase;
        hand +1: x + iy comes.
        """
        return np.asarray(
            to_circular_basis(self.t, hand)[1] * np.exp(-2j * hand * self.angle_rad)
        )

    def _share(self, of: Callable[["GeometricPhase"], float]) -> tuple[float, float]:
        """A number that follows from t, and its error bar."""
        here = of(self)
        before = [
            of(dataclasses.replace(self, t=self.earlier[:, k]))
            for k in range(self.earlier.shape[1])
        ]
        return here, SAFETY * max((abs(value - here) for value in before), default=1.0)

    def efficiency(self, hand: float) -> tuple[float, float]:
        """Share of the light in the converted wave, averaged over all turns, and the
        error bar of it.

        |mean over the turns of the converted amplitude, its geometric phase taken
        off|²: what its spread over the turns
        scatters is no part of it.
        """
        return self._share(lambda one: float(abs(one.converted(hand).mean()) ** 2))

    def unconverted(self, hand: float) -> tuple[float, float]:
        """Share of the light that keeps its hand, the mean over all turns, and its
        error bar.
        """
        return self._share(
            lambda one: float((np.abs(to_circular_basis(one.t, hand)[0]) ** 2).mean())
        )

    @property
    def model_error(self) -> float:
        """Largest |solved - isolated| of the converted amplitude: the isolated pillar
        is that at angle 0, turned.
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

    Args:
        t: (..., 2, 2) Jones matrices in x and y.
    """
    come = np.array([1.0, 1j * hand]) / math.sqrt(2)
    leave = t @ come
    return np.asarray(leave @ come.conj()), np.asarray(leave @ come)


def mirror_jones(t: Array) -> Array:
    """Jones matrices of the mirror image (y to -y): those of the pillar turned the
    other way.

    Args:
        t: (..., 2, 2) Jones matrices in x and y.
    """
    return np.asarray(t * np.array([[1.0, -1.0], [-1.0, 1.0]]))


def period_rad(cell: Cell) -> float:
    """Turn after which lattice and pillar are those of angle 0, turned as a whole, but for
    the axes of the pillar.

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
    quarter = getattr(cell.shape, "ratio", 1.0) != 1.0 and cell.shape.kind in (
        "rectangle",
        "ellipse",
    )
    if not quarter and cell.shape.kind != "polygon":
        raise CellError(
            f"circular light: a {cell.shape.name} responds equally to x and y and gives no geometric phase; "
            "need a rectangle, an ellipse or an own polygon that is longer along one axis"
        )


def solve_rotations(
    cell: Cell, size_um: float, wavelength_um: float, *, tolerance: float
) -> GeometricPhase:
    """Solve the pillar turned in its lattice, over one period; half of it follows from
    the mirror of the lattice.

    Args:
        cell: unit cell with its materials, shape and lattice.
        size_um: of the pillar, um.
        wavelength_um: vacuum wavelength, um.
        tolerance: error of t that is asked for.

    Raises:
        CellError: a shape that cannot be turned (see :func:`check_geometric_phase`), or
            that meets its neighbours when turned.
    """
    check_geometric_phase(cell, size_um)
    period = period_rad(cell)
    angles = np.arange(STEPS + 1) / (2 * STEPS) * period
    found = []
    for angle in angles.tolist():
        shape = dataclasses.replace(cell.shape, angle_rad=angle)
        found.append(
            jones(
                dataclasses.replace(cell, shape=shape),
                size_um,
                wavelength_um,
                tolerance=tolerance,
            )
        )
    t = np.array([one.t for one in found])
    error = np.array([one.t_error for one in found])
    earlier = np.array([one.earlier for one in found])
    back = slice(STEPS - 1, 0, -1)  # neither 0 nor half the period again
    return GeometricPhase(
        size_um,
        wavelength_um,
        np.concatenate([angles, -angles[back]]),
        np.concatenate([t, mirror_jones(t[back])]),
        np.concatenate([error, error[back]]),
        np.concatenate([earlier, mirror_jones(earlier[back])]),
    )
