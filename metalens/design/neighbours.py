"""What the locally periodic approximation leaves out: rows of a lens's own pillars,
solved as one supercell, against the pillars one by one.
"""

import math
from typing import Any

import numpy as np

from metalens.cell import materials
from metalens.core.arrays import Array
from metalens.lens import Lens, NeighbourRows
from metalens.rcwa import block_of, solve_row

LONG = 6  # pillars; of shorter rows several with shifted phases are solved
STEEPEST = 0.95  # largest sine in the cover of a row's deflected light


def estimate_neighbour_coupling(
    lens: Lens,
    *,
    counts: tuple[int, ...] = (6, 5),
    harmonics: int = 3,
    diagonal: bool = True,
) -> NeighbourRows:
    """Coupling factor of non-identical neighbours in this lens, over the deflection
    sine.

    Supercell RCWA of blazed rows of the lens's own pillars, both polarisations. A row
    of N pillars whose phases rise by 2 pi / N turns light by s = wavelength / (N
    pitch), as the lens does where its phase has that slope. Of short rows several with
    shifted phases are solved and averaged.

    Args:
        lens: the lens.
        counts: pillars of the rows along the lattice.
        harmonics: of :func:`solve_row`; ``coarse`` has one less.
        diagonal: also solve rows along the diagonal, of the even numbers next to √2 of
            those.

    Raises:
        CellError: the cell has films or tilted walls, or is no round pillar on a square
            lattice.
    """
    cover = materials.index(lens.cell.cover, lens.wavelength_um).real
    rows = [(count, False) for count in counts]
    if diagonal:
        even = {2 * max(1, round(count / math.sqrt(2))) for count in counts}
        rows += [(count, True) for count in sorted(even)]
    sines = [
        lens.wavelength_um / (n * block_of(lens.cell.pitch_um, turned).spacing_um)
        for n, turned in rows
    ]
    propagating = [
        (row, sine)
        for row, sine in zip(rows, sines, strict=True)
        if sine < STEEPEST * cover
    ]
    solutions = [
        [_mean(lens, *row, truncation) for row, _ in propagating]
        for truncation in (harmonics, harmonics - 1)
    ]
    fine, coarse = ([factor for factor, _ in solution] for solution in solutions)
    return NeighbourRows(
        np.array([sine for _, sine in propagating]),
        np.array([turned for (_, turned), _ in propagating], bool),
        np.array(fine).reshape(-1, 2).T,
        np.array(coarse).reshape(-1, 2).T,
        np.array([lost for _, lost in solutions[0]]),
        lens.wavelength_um,
        cover,
    )


def _mean(
    lens: Lens, count: int, diagonal: bool, harmonics: int
) -> tuple[Array, float]:
    """Mean factor (2,) and power lost to other orders, over rows with shifted phases.

    Args:
        lens: the lens.
        count: pillars of the row.
        diagonal: along the diagonal of the lattice.
        harmonics: truncation of the solver.
    """
    shifts = max(1, round(LONG / count))
    rows = []
    for shift in range(shifts):
        phases = 2 * np.pi * (np.arange(count) + 0.25 + shift / shifts) / count
        diameters = lens.proxy.diameter_um(
            phases,
            lens.wavelength_um,
            within_um=drawn_diameter_range(lens),
            gap="nearest",
        )
        rows.append(_blazed(lens, np.asarray(diameters), harmonics, diagonal))
    ratios, lost = zip(*rows, strict=True)
    return np.mean(ratios, axis=0), float(np.mean(lost))


def _blazed(
    lens: Lens, diameters_um: Array, harmonics: int, diagonal: bool
) -> tuple[Array, float]:
    """Amplitude of the deflected order over that of pillars solved one by one.

    Args:
        lens: the lens.
        diameters_um: (n,) pillars of the row.
        harmonics: truncation of the solver.
        diagonal: along the diagonal of the lattice.

    Returns:
        (2,) complex ratios for light along and across the row, and the power lost to
        other orders beyond that of the pillars one by one, the mean of both.
    """
    count = len(diameters_um)
    block = block_of(lens.cell.pitch_um, diagonal)
    place = np.arange(count) - (count - 1) / 2
    options: dict[str, Any] = {"harmonics": harmonics, "diagonal": diagonal}
    ratios, lost = [], []
    for polarization in ("x", "y"):
        whole = solve_row(
            lens.cell,
            diameters_um,
            lens.wavelength_um,
            polarization=polarization,
            **options,
        )
        alone = np.array(
            [
                solve_row(
                    lens.cell,
                    [d] * block.pillars,
                    lens.wavelength_um,
                    polarization=polarization,
                    **options,
                ).order(0)
                for d in diameters_um
            ]
        )
        expected = (alone * np.exp(-2j * np.pi * place / count)).mean()
        deflected = whole.order(1)
        ratios.append(deflected / expected)
        travels = np.abs(whole.orders) * lens.wavelength_um < count * block.spacing_um
        total = float((np.abs(whole.t[travels]) ** 2).sum())
        lost.append(
            1
            - abs(deflected) ** 2 / total
            - (1 - abs(expected) ** 2 / float((np.abs(alone) ** 2).mean()))
        )
    return np.array(ratios), float(np.mean(lost))


def drawn_diameter_range(lens: Lens) -> tuple[float, float]:
    """(least, largest) diameter of the lens's pillars, within its proxy's domain."""
    built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = lens.proxy.domain_um
    return max(float(built.min()), low), min(float(built.max()), high)
