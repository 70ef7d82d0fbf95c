"""The sites of a lattice inside a round aperture, and the map of pillars that stand on
them.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Lattice
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.lens import DiameterMap

# (x,) and (y,) positions in um to (y, x) phase in rad
PhaseOf = Callable[[Array, Array], Array]
_BLOCK_SITES = 1 << 21  # sites of one block, so that memory does not grow with the lens


@dataclass(frozen=True, slots=True)
class LatticeSites:
    """Sites of a lattice that may hold pillars: centres half a pitch inside an
    aperture.

    pitch_um: lattice constant.
    lattice: square or hexagonal.
    shape: (y, x) of the map.
    steps_um: (x, y) from site to site of the map. On a hexagonal lattice every other
        site of the map is one of the lattice, the middle one included.
    aperture_um: diameter of the aperture.
    """

    pitch_um: float
    lattice: Lattice
    shape: tuple[int, int]
    steps_um: tuple[float, float]
    aperture_um: float

    def blocks(
        self, phases: Sequence[PhaseOf], pistons_rad: Array | None = None
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Blocks of rows with the mask of their pillars and the target phases there.

        Args:
            phases: function of position for every channel.
            pistons_rad: (channels,) added to the target phases.

        Yields:
            The rows, (rows, columns) whether a pillar stands, (channels, sites) phase
            in rad.

        Raises:
            LensError: a phase of another shape than (rows, columns).
        """
        x, y = (
            (np.arange(n) - (n - 1) / 2) * s
            for n, s in zip(self.shape[::-1], self.steps_um, strict=True)
        )
        reach = (self.aperture_um - self.pitch_um) / 2 if self.shape != (1, 1) else 0.0
        size = max(1, _BLOCK_SITES // self.shape[1])
        for start in range(0, self.shape[0], size):
            rows = slice(start, start + size)
            inside = y[rows, None] ** 2 + x**2 <= reach**2 * (1 + 1e-12)
            if self.lattice.centred:
                row, column = np.ogrid[start : start + len(inside), : len(x)]
                inside &= (row + column) % 2 == 0
            targets = []
            for phase in phases:
                block = phase(x, y[rows])
                if np.shape(block) != inside.shape:
                    raise LensError(
                        f"phase of shape {np.shape(block)} for x of {x.shape} and y of "
                        f"{y[rows].shape}: need {inside.shape}, as "
                        "phase(x, y[:, None]) of a function of one point gives"
                    )
                targets.append(block[inside])
            pistons = np.zeros(len(phases)) if pistons_rad is None else pistons_rad
            yield rows, inside, np.stack(targets) + pistons[:, None]

    def sample(self, phases: Sequence[PhaseOf], count: int = 1500) -> Array:
        """(channels, sites) target phases in rad at evenly picked sites.

        Args:
            phases: function of position for every channel.
            count: most sites.
        """
        targets = np.concatenate([block for *_, block in self.blocks(phases)], axis=1)
        pick = np.linspace(0, targets.shape[1] - 1, count).astype(int)
        return np.asarray(targets[:, np.unique(pick)])

    def map(
        self,
        diameter_um: Array,
        angle_rad: Array | None = None,
        length_um: Array | None = None,
    ) -> DiameterMap:
        """The map of pillars on these sites.

        Args:
            diameter_um: (y, x) sizes, 0 without a pillar.
            angle_rad: (y, x) rotations; None for none.
            length_um: (y, x) second sizes; None for one size.
        """
        row_um = 0.0 if self.lattice.kind == "square" else self.steps_um[1]
        return DiameterMap(
            diameter_um, self.pitch_um, self.lattice, row_um, angle_rad, length_um
        )


def lattice_sites(cell: Cell, aperture_um: float, *, grid_nm: float) -> LatticeSites:
    """The sites of the cell's lattice inside a round aperture.

    Rows of a hexagonal lattice are sqrt(3)/2 pitches apart, rounded to the mask grid.

    Args:
        cell: unit cell with its pitch and lattice.
        aperture_um: diameter of the aperture, um.
        grid_nm: of the mask.

    Raises:
        LensError: the aperture holds no pillar.
    """
    if not (math.isfinite(aperture_um) and aperture_um >= cell.pitch_um):
        raise LensError(
            f"empty aperture: {aperture_um} um holds no cell of pitch {cell.pitch_um} um"
        )
    period = cell.lattice.periods_um(cell.pitch_um)
    if not cell.lattice.centred:
        counts = tuple(max(1, int(aperture_um / step)) for step in period[::-1])
        return LatticeSites(
            cell.pitch_um, cell.lattice, (counts[0], counts[1]), period, aperture_um
        )
    grid = grid_nm * 1e-3
    steps = cell.pitch_um / 2, max(1, round(period[1] / 2 / grid)) * grid
    half_x, half_y = (int((aperture_um - cell.pitch_um) / 2 / step) for step in steps)
    half_x += (half_x + half_y) % 2  # the middle of the map is a site
    return LatticeSites(
        cell.pitch_um,
        cell.lattice,
        (2 * half_y + 1, 2 * half_x + 1),
        steps,
        aperture_um,
    )


def least_period_um(cell: Cell) -> float:
    """Twice the Nyquist step of a phase on the lattice, um: 2 pi / least reciprocal
    vector.

    The pitch on a square lattice, sqrt(3)/2 of it on a hexagonal one. A phase may
    change by half a turn over half of this, in any direction.

    Args:
        cell: unit cell of the lens.
    """
    return cell.pitch_um / cell.lattice.least_order
