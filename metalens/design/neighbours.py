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

LONG = 6  # pillars: of shorter rows several are solved
# sine in the cover of the light of a row; that of steeper ones runs along the lens, or
# nowhere
STEEPEST = 0.95


def estimate_neighbour_coupling(
    lens: Lens,
    *,
    counts: tuple[int, ...] = (6, 5),
    harmonics: int = 3,
    diagonal: bool = True,
) -> NeighbourRows:
    """Coupling of non-identical neighbours in this lens: supercell RCWA of blazed rows
    of its own pillars, both polarisations.

    A row of N pillars whose phases rise by 2 pi / N turns light by s = wavelength / (N
    pitch), as the lens does where
    its phase has that slope. Of short rows several are solved, whose phases begin
    elsewhere, and their mean is taken.

    Args:
        counts: pillars of the rows along the lattice. harmonics: of :func:`solve_row`;
            one less for ``coarse``.
        diagonal: also solve rows along the diagonal, of the even numbers next to √2 of
            those.

    Raises:
        CellError: the cell has films or tilted walls, or is no round pillar on a square
            lattice.
    """
    cover = materials.index(lens.cell.cover, lens.wavelength_um).real
    diagonal_counts = (
        sorted({2 * max(1, round(count / math.sqrt(2))) for count in counts})
        if diagonal
        else []
    )
    rows = [(count, False) for count in counts] + [
        (count, True) for count in diagonal_counts
    ]
    sines = [
        lens.wavelength_um / (n * block_of(lens.cell.pitch_um, turned).spacing_um)
        for n, turned in rows
    ]
    propagating = [
        (row, sine)
        for row, sine in zip(rows, sines, strict=True)
        if sine < STEEPEST * cover
    ]
    found = [
        [_mean(lens, *row, reach) for row, _ in propagating]
        for reach in (harmonics, harmonics - 1)
    ]
    fine, coarse = ([factor for factor, _ in one] for one in found)
    return NeighbourRows(
        np.array([sine for _, sine in propagating]),
        np.array([turned for (_, turned), _ in propagating], bool),
        np.array(fine).reshape(-1, 2).T,
        np.array(coarse).reshape(-1, 2).T,
        np.array([lost for _, lost in found[0]]),
        lens.wavelength_um,
        cover,
    )


def _mean(
    lens: Lens, count: int, diagonal: bool, harmonics: int
) -> tuple[Array, float]:
    """(2,) factor and the power that went elsewhere, mean over rows of ``count`` whose
    phases begin elsewhere.
    """
    begins = max(1, round(LONG / count))
    found = []
    for begin in range(begins):
        wanted = 2 * np.pi * (np.arange(count) + 0.25 + begin / begins) / count
        diameters = lens.proxy.diameter_um(
            wanted,
            lens.wavelength_um,
            within_um=drawn_diameter_range(lens),
            gap="nearest",
        )
        found.append(_blazed(lens, np.asarray(diameters), harmonics, diagonal))
    return np.mean([ratio for ratio, _ in found], axis=0), float(
        np.mean([lost for _, lost in found])
    )


def _blazed(
    lens: Lens, diameters_um: Array, harmonics: int, diagonal: bool
) -> tuple[Array, float]:
    """Amplitude in the wanted order against pillars one by one, of light along and
    across the row, and power that went
    elsewhere, the mean of both."""
    count = len(diameters_um)
    block = block_of(lens.cell.pitch_um, diagonal)
    place = np.arange(count) - (count - 1) / 2
    about: dict[str, Any] = {"harmonics": harmonics, "diagonal": diagonal}
    ratios, lost = [], []
    for polarization in ("x", "y"):
        whole = solve_row(
            lens.cell,
            diameters_um,
            lens.wavelength_um,
            polarization=polarization,
            **about,
        )
        alone = np.array(
            [
                solve_row(
                    lens.cell,
                    [d] * block.pillars,
                    lens.wavelength_um,
                    polarization=polarization,
                    **about,
                ).order(0)
                for d in diameters_um
            ]
        )
        want = (alone * np.exp(-2j * np.pi * place / count)).mean()
        got = whole.order(1)
        ratios.append(got / want)
        travels = np.abs(whole.orders) * lens.wavelength_um < count * block.spacing_um
        total = float((np.abs(whole.t[travels]) ** 2).sum())
        lost.append(
            1
            - abs(got) ** 2 / total
            - (1 - abs(want) ** 2 / float((np.abs(alone) ** 2).mean()))
        )
    return np.array(ratios), float(np.mean(lost))


def drawn_diameter_range(lens: Lens) -> tuple[float, float]:
    """(least, largest) diameter of the lens's pillars, within its proxy's domain."""
    built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = lens.proxy.domain_um
    return max(float(built.min()), low), min(float(built.max()), high)
