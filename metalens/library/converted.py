"""The proxy of a library for circular light: the wave that a pillar converts to the
other hand, around the best size.

Pillars of such a lens may all have one size: their turn carries the phase. The
polynomial of Eq. 2 holds (t_x - t_y)/2
around the size that converts most, so that everything downstream knows what another
size does (bias, tolerance).
"""

import dataclasses
import math

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library import circular
from metalens.library.fit import (
    FitData,
    ProxyFit,
    ProxyTolerances,
    entry_error,
    fit_terms,
    tolerance_ratio,
    tolerance_shortfall,
)
from metalens.library.proxy import Proxy
from metalens.library.record import PillarLibrary

LEAST_ENTRIES = 12
# of the largest conversion, to which the domain reaches unless the tolerance ends it
NEAREST_SHARE = 0.85


def cross_polarized_amplitude(library: PillarLibrary) -> Array:
    """(wavelength, size) amplitude (t_x - t_y)/2 that leaves with the other hand, of
    pillars that are not turned.
    """
    return np.asarray(library.t[0, 0] - library.t[1, 0]) / 2


def best_size_um(library: PillarLibrary) -> float:
    """The size whose least conversion over the wavelengths is largest, off resonances
    (bars within the tolerance).
    """
    least = np.abs(cross_polarized_amplitude(library)).min(axis=0)
    sure = (library.t_error <= library.sweep.bar).all(axis=(0, 1, 2))
    return float(
        library.diameter_um[int(np.where(sure | ~sure.any(), least, -1.0).argmax())]
    )


def fit_converted(library: PillarLibrary, wanted: ProxyTolerances) -> ProxyFit:
    """The proxy of the converted light on the widest run of sizes around the best one
    that meets the tolerances.

    Raises:
        DomainError: fewer than 12 sizes without resonance around the best one.
    """
    t, d = cross_polarized_amplitude(library), library.diameter_um
    middle = int(np.searchsorted(d, best_size_um(library)))
    least = NEAREST_SHARE * np.abs(t[:, middle]).min()
    good = (np.abs(t).min(axis=0) >= least) & ~_sharp(
        library, wanted.least_half_width_um
    )
    if wanted.within_um is not None:
        good &= (d >= wanted.within_um[0]) & (d <= wanted.within_um[1])
    low = (
        middle - int(np.argmin(good[middle::-1]))
        if not good[: middle + 1].all()
        else -1
    )
    high = middle + int(np.argmin(good[middle:])) if not good[middle:].all() else len(d)
    run = slice(low + 1, high)
    if not good[middle] or run.stop - run.start < LEAST_ENTRIES:
        raise DomainError(
            f"fewer than {LEAST_ENTRIES} sizes around {d[middle]:.4g} um, where most light is converted "
            f"({np.abs(t[:, middle]).min() ** 2:.0%}), are free of resonances: sweep with more samples, or another cell"
        )
    phase = np.unwrap(np.angle(t[:, run]), axis=-1)
    phase += (np.unwrap(phase[:, middle - run.start]) - phase[:, middle - run.start])[
        :, None
    ]
    kept = FitData(
        phase[None],
        np.abs(t[:, run])[None],
        d[run],
        library.wavelength_um,
        library.angle_rad,
    )
    wanted = wanted.settled(entry_error(library, kept.diameter))
    proxy = _widest(kept, middle - run.start, wanted)
    inside = (d >= proxy.domain_um[0]) & (d <= proxy.domain_um[1])
    proxy = dataclasses.replace(proxy, entry_error=entry_error(library, d[inside]))
    notes = (
        f"converted light: at {d[middle]:.4f} um {np.abs(t[:, middle]).min() ** 2:.3f} of it changes hand",
    )
    return ProxyFit(
        proxy, notes, (), math.nan, 0.0, tolerance_shortfall(proxy, wanted), math.nan
    )


def with_rotations(library: PillarLibrary) -> PillarLibrary:
    """With the best pillar solved at several turns, at the middle wavelength."""
    wavelength = float(library.wavelength_um[len(library.wavelength_um) // 2])
    turned = circular.solve_rotations(
        library.cell, best_size_um(library), wavelength, tolerance=library.sweep.bar
    )
    return dataclasses.replace(library, turned=turned)


def _sharp(library: PillarLibrary, least_half_width_um: float) -> Array:
    """(size,) whether a narrow resonance lies there."""
    near = np.zeros(len(library.diameter_um), bool)
    for *_, centre, width in library.resonances:
        if width < least_half_width_um:
            near |= np.abs(library.diameter_um - centre) <= 2 * width
    return near


def _widest(data: FitData, middle: int, wanted: ProxyTolerances) -> Proxy:
    """The widest run about ``middle`` on which as many coefficients as are wanted meet
    the tolerances.
    """
    reach = max(middle, len(data.diameter) - 1 - middle)
    while True:
        part = slice(max(0, middle - reach), middle + reach + 1)
        some = FitData(
            data.phase[..., part],
            data.level[..., part],
            data.diameter[part],
            data.wavelength,
            data.angle,
        )
        count = len(some.diameter)
        proxy = fit_terms(some, 1, min(max(2, wanted.coefficients // 2), count // 3))
        if tolerance_ratio(proxy, wanted) <= 1 or count <= LEAST_ENTRIES:
            return proxy
        nearer = max(LEAST_ENTRIES // 2, int(0.9 * reach))
        if nearer >= reach:
            return proxy
        reach = nearer
