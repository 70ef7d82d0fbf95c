"""Unlike neighbours: PSFs with the factor of rows of a lens's own pillars, against a
cut through the lens solved whole.

The lens is that of ``examples/lenses/tio2_532.toml``, TiO2 of NA 0.8 and 20 um for 532
nm, and one of NA 0.4: the 62
pillars along a diameter, repeated across, are one cell of RCWA (a cylinder lens), for
light along the cut and across
it. The predicted light is that of the maps that ``psf_stack`` takes
(:mod:`metalens.psf.neighbour_coupling`), pillar by pillar. No
times to quote: rows and cut are solved at the same two orders per pillar, where
truncation all but cancels.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks import Row
from metalens import design, library
from metalens.cell import Cell
from metalens.commands.library import CellFile
from metalens.core import config
from metalens.core.arrays import Array
from metalens.design.neighbours import drawn_diameter_range, estimate_neighbour_coupling
from metalens.lens import Lens, NeighbourRows
from metalens.psf import neighbour_coupling
from metalens.rcwa import solve_row

FILE = Path(__file__).parents[2] / "examples" / "cells" / "tio2_532.toml"
WAVELENGTH_UM, APERTURE_UM = 0.532, 20.0
LENSES = (
    (0.8, 7.5, (2, 3, 4)),
    (0.4, 22.9, (4, 6, 8)),
)  # NA, sensor distance, pillars in the rows
HARMONICS = 2


def rows() -> Iterator[Row]:
    """Both lenses and polarisations: light in the focus and the PSF, with the factor
    and without.
    """
    for na, distance, counts in LENSES:
        lens = lens_at(distance)
        found = estimate_neighbour_coupling(lens, counts=counts, harmonics=HARMONICS)
        for place, (polarization, along) in enumerate(
            (("x", "along"), ("y", "across"))
        ):
            start = time.perf_counter()
            cut = solved_whole(lens, polarization)
            told, power, plain = judged(lens, cut, factor(lens, found, place))
            yield Row(
                f"TiO2, NA {na}, 20 um, 62 pillars, light {along} the cut: {told} "
                f"(efficiency {abs(cut.one_by_one) ** 2:.3f})",
                f"rows of {', '.join(map(str, counts))} pillars",
                time.perf_counter() - start,
                power,
                f"power in the focus, over that of pillars one by one; the cut solved whole (without: {plain:.3f})",
                goal="below the error that `design --own-cell` states: 0.2 of what is lost, and more",
            )


def _words(ratio: complex) -> str:
    return f"x{abs(ratio):.3f}, {math.atan2(ratio.imag, ratio.real):+.3f} rad"


def lens_at(distance_um: float) -> Lens:
    """The lens of the example, from its cell file, for this sensor distance."""
    file = config.load(FILE, CellFile)
    proxy = library.proxy_of(library.sweep(file.cell, file.sweep))
    focus = design.Focus(WAVELENGTH_UM, distance_um)
    limits = design.Limits(84, 80)
    phase = design.phase_of(None, focus, radius_um=APERTURE_UM / 2)
    about = {"limits": limits}
    cell: Cell = file.cell
    return design.make(
        phase,
        focus,
        aperture_um=APERTURE_UM,
        cell=cell,
        proxy=proxy,
        accept_partial_turn=True,
        **about,
    )[0]


def _places(lens: Lens) -> tuple[Array, Array]:
    """Where the pillars of the cut stand, in pitches from its middle and in um."""
    count = int(APERTURE_UM / lens.cell.pitch_um)
    place = np.arange(count) - (count - 1) / 2
    return place, place * lens.cell.pitch_um


@dataclass(frozen=True, eq=False, slots=True)
class Cut:
    """Light of a cut in its orders, amplitudes whose squares are power: solved whole,
    of pillars one by one, and of an
    ideal lens. alone: t of every pillar. sines: of the orders. distance_um: to the
    focus."""

    solved: Array
    apart: Array
    ideal: Array
    alone: Array
    sines: Array
    to_orders: Array
    distance_um: float

    @property
    def one_by_one(self) -> complex:
        """Amplitude in the focus of pillars one by one."""
        return self.focus(self.apart)

    def focus(self, light: Array) -> complex:
        """Amplitude of light in the focus, 1 for an ideal lens."""
        return complex(self.ideal.conj() @ light / (np.abs(self.ideal) ** 2).sum())

    def psf(self, light: Array) -> Array:
        """Light along a line through the focus, ten times the width of the spot, of sum
        1.
        """
        x = (
            np.linspace(-5, 5, 201)
            * WAVELENGTH_UM
            / 2
            / float(self.sines[self.ideal != 0].max())
        )
        waves = np.exp(2j * np.pi / WAVELENGTH_UM * np.outer(x, self.sines))
        runs = np.abs(self.sines) < 1
        along = np.sqrt(np.where(runs, 1 - self.sines**2, 0)) * self.distance_um
        spot = (
            np.abs(waves @ (light * runs * np.exp(2j * np.pi / WAVELENGTH_UM * along)))
            ** 2
        )
        return np.asarray(spot / spot.sum())


def judged(lens: Lens, cut: Cut, factor: Array) -> tuple[str, float, float]:
    """In words; error of the power in the focus over that of pillars one by one with
    the factor of every pillar, and
    without."""
    predicted = cut.to_orders @ (cut.alone * factor)
    solved, said = (
        cut.focus(light) / cut.one_by_one for light in (cut.solved, predicted)
    )
    psfs = [cut.psf(light) for light in (predicted, cut.apart, cut.solved)]
    with_, without = (
        float(np.linalg.norm(one - psfs[2]) / np.linalg.norm(psfs[2]))
        for one in psfs[:2]
    )
    words = f"solved {_words(solved)}, predicted {_words(said)} of what pillars one by one give"
    words += f"; PSF {with_:.3f} off, {without:.3f} without"
    return words, abs(abs(solved) ** 2 - abs(said) ** 2), abs(abs(solved) ** 2 - 1)


def solved_whole(lens: Lens, polarization: str) -> Cut:
    """The cut solved as one cell of RCWA."""
    cell, wave = lens.cell, lens.wavelength_um
    place, x = _places(lens)
    count, width = len(x), len(x) * cell.pitch_um
    phase = _phase(lens)
    sizes = np.asarray(
        lens.proxy.diameter_um(
            phase, wave, within_um=drawn_diameter_range(lens), gap="nearest"
        )
    )
    about = {"polarization": polarization, "harmonics": HARMONICS}
    row = solve_row(cell, sizes, wave, **about)
    known = {
        d: solve_row(cell, [d], wave, **about).order(0) for d in set(sizes.tolist())
    }
    alone = np.array([known[d] for d in sizes.tolist()])
    to_orders = np.exp(-2j * np.pi * np.outer(row.orders, place) / count) / count
    sine = row.orders * wave / width
    cosine = np.sqrt(np.maximum(1 - sine**2, 1e-9))
    rim = math.sin(math.atan(APERTURE_UM / 2 / lens.sensor_distance_um))
    ideal = np.where(np.abs(sine) < rim, to_orders @ np.exp(1j * phase), 0)
    power = cosine ** (-0.5 if polarization == "x" else 0.5)
    return Cut(
        row.t * power,
        to_orders @ alone,
        ideal,
        alone,
        sine,
        to_orders,
        lens.sensor_distance_um,
    )


def _phase(lens: Lens) -> Array:
    """Of a cylinder lens at the pillars of the cut."""
    x, distance = _places(lens)[1], lens.sensor_distance_um
    return np.asarray(
        -2 * np.pi / lens.wavelength_um * (np.hypot(x, distance) - distance)
    )


def factor(lens: Lens, found: NeighbourRows, place: int) -> Array:
    """C at every pillar as PSFs take it from maps, of the field along (0) or across (1)
    the cut.
    """
    phase = torch.as_tensor(np.tile(_phase(lens), (9, 1)))
    made = neighbour_coupling.apply_jones_coupling(
        phase, torch.ones_like(phase), found, lens.cell.pitch_um
    )
    return np.asarray((made.xx if place == 0 else made.yy)[4].numpy())
