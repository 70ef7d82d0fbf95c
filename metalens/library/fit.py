"""Fit the proxy of Eq. 2 to a library: the longest domain without resonances that
polynomials follow within the tolerances.
"""

import bisect
import contextlib
import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library import polynomial
from metalens.library.proxy import MOST_ERROR, Proxy, map_to_unit
from metalens.library.record import PillarLibrary

LEAST_ENTRIES = 12  # diameters in a domain
REACH = 2.0  # half-widths on either side of a narrow resonance that are excluded
UNKNOWN = 0.5  # largest error bar of a usable entry, as a share of |t|
# default tolerances: an absolute deviation, and a share of the entries' error bars
FOLLOWED, KNOWN_SHARE = 1e-3, 0.5


@dataclass(frozen=True, slots=True)
class ProxyTolerances:
    """What a proxy must meet.

    phase_tolerance_rad, transmission_tolerance: largest deviation from the library
        entries; left out, 1e-3, or half of what the entries' own error bars say on the
        domain where that is more.
    coefficients: real ones, of phase and |T| together at one wavelength and angle; more
        are taken only where fewer would leave less than a full turn.
    least_transmission: a domain ends where |t| falls below.
    least_half_width_um: a domain ends at resonances narrower than this: a pillar so
        little off would jump.
    within_um: (least, largest) diameter to consider; all entries without it.
    """

    phase_tolerance_rad: float | None = field(default=None, metadata={"above": 0})
    transmission_tolerance: float | None = field(default=None, metadata={"above": 0})
    coefficients: int = field(default=24, metadata={"above": 0})
    least_transmission: float = 0.7
    least_half_width_um: float = 0.005
    within_um: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False, slots=True)
class ProxyFit:
    """A proxy with the limits of its domain and its errors.

    proxy: the polynomials.
    notes: where the domain was cut, and the reasons.
    turns: phase range of the domain, the least over wavelengths and angles; nan for
        circular light, whose phase is the turn of the pillars.
    polarization_spread: largest |t_s - t_p| / 2 on the domain; the proxy describes
        their mean.
    shortfall: message on tolerances that the proxy misses; empty where it meets them.
    smooth_turns: phase range of all diameters without resonance, also outside the
        domain.
    """

    proxy: Proxy
    notes: tuple[str, ...]
    turns: float
    polarization_spread: float
    shortfall: str
    smooth_turns: float


@dataclass(frozen=True, eq=False, slots=True)
class MonotonicBranch:
    """Consecutive diameters without resonance that a proxy may follow.

    phase: (angle, wavelength, diameter) rad, unwrapped along every axis.
    level: |t|, as phase.
    diameter_um, wavelength_um, angle_rad: the axes.
    notes: what bounds the diameters.
    polarization_spread: largest |t_s - t_p| / 2; phase and level are of their mean.
    gaps_um: (least, largest) diameters around narrow resonances inside the branch,
        which no pillar of a lens should have.
    middle: index of the diameter around which a domain lies; 0 for domains from the
        least diameter on.
    monotonic: whether the phase rises or falls throughout.
    """

    phase: Array
    level: Array
    diameter_um: Array
    wavelength_um: Array
    angle_rad: Array
    notes: tuple[str, ...] = ()
    polarization_spread: float = 0.0
    gaps_um: tuple[tuple[float, float], ...] = ()
    middle: int = 0
    monotonic: bool = True

    def within(self, reach: int) -> "MonotonicBranch":
        """The branch restricted to ``reach`` diameters on either side of its middle."""
        some = slice(max(0, self.middle - reach), self.middle + reach + 1)
        return dataclasses.replace(
            self,
            phase=self.phase[..., some],
            level=self.level[..., some],
            diameter_um=self.diameter_um[some],
            middle=min(self.middle, reach),
        )

    @property
    def turns(self) -> float:
        """Phase range over the diameters in turns, the least over wavelengths and
        angles; nan where the phase may turn back.
        """
        if not self.monotonic:
            return math.nan
        return float(abs(self.phase[..., -1] - self.phase[..., 0]).min() / math.tau)


def longest_monotonic_branch(
    library: PillarLibrary,
    tolerances: ProxyTolerances,
    *,
    across_resonances: bool = False,
) -> MonotonicBranch:
    """The run of diameters that covers most phase without a fault.

    Faults are those of :func:`find_faults`.

    Args:
        library: the swept cell.
        tolerances: limits of the run.
        across_resonances: the run may cross narrow resonances. Entries closer to one
            than ``least_half_width_um`` or two half-widths are then left out.

    Raises:
        DomainError: no such run holds 12 entries; the message states the faults.
    """
    d = library.diameter_um
    inside, narrow = _usable(library, tolerances)
    gaps = _gaps(narrow, tolerances.least_half_width_um) if across_resonances else ()
    for start, end in gaps:
        inside &= (d < start) | (d > end)
    d = d[inside]
    t = library.t[..., inside]
    faults = find_faults(
        d,
        t,
        library.t_error[..., inside],
        least_transmission=tolerances.least_transmission,
        hole=library.cell.shape.hole,
        resonances=() if gaps else narrow,
    )
    faulty = np.any([fault.mask for fault in faults], axis=0)
    runs = [run for run in find_runs(~faulty) if run.stop - run.start >= LEAST_ENTRIES]
    if not runs:
        reasons = "; ".join(fault.text for fault in faults if fault.mask.any())
        raise DomainError(
            f"no {LEAST_ENTRIES} diameters in a row are free of resonances ({reasons}): choose another pitch, height "
            "or material, fewer wavelengths or angles, or sweep with more samples"
        )
    phase = np.unwrap(np.angle(t), axis=-1)

    def covered(run: slice) -> float:
        return float(abs(phase[..., run.stop - 1] - phase[..., run.start]).min())

    best = max(runs, key=covered)
    mean_t = t.mean(axis=0)[..., best]  # over the polarisations
    gap_notes = [
        f"passes over a narrow resonance between {a:.4f} and {b:.4f} um"
        for a, b in gaps
    ]
    return MonotonicBranch(
        _unwrapped(np.angle(mean_t)),
        np.abs(mean_t),
        d[best],
        library.wavelength_um,
        library.angle_rad,
        (*_ends(best, d, faults), *gap_notes),
        float(np.abs(t[0] - t[-1])[..., best].max()) / 2,
        tuple((a, b) for a, b in gaps if a < d[best][-1] and b > d[best][0]),
    )


def _usable(
    library: PillarLibrary, tolerances: ProxyTolerances
) -> tuple[Array, list[list[float]]]:
    """(mask of the diameters to consider, narrow resonances among them)."""
    low, high = tolerances.within_um or (0.0, np.inf)
    d = library.diameter_um
    inside = (d >= low - 1e-9) & (d <= high + 1e-9)
    low, high = d[inside][[0, -1]] if inside.any() else (np.inf, -np.inf)
    narrow = [
        [centre, width, wavelength, angle]
        for _, angle, wavelength, centre, width in library.resonances.tolist()
        if width < tolerances.least_half_width_um and low <= centre <= high
    ]
    return inside, narrow


def _gaps(
    narrow: Sequence[Sequence[float]], half_width: float
) -> tuple[tuple[float, float], ...]:
    """(least, largest) diameters excluded around narrow resonances, um; overlapping
    intervals are merged.

    Args:
        narrow: (centre, half-width, …) of each resonance, um.
        half_width: least half-width of an interval, um.
    """
    gaps: list[tuple[float, float]] = []
    for centre, width, *_ in sorted(map(list, narrow)):
        reach = max(half_width, REACH * width)
        low, high = centre - reach, centre + reach
        if gaps and low <= gaps[-1][1]:
            low, high = gaps[-1][0], max(high, gaps.pop()[1])
        gaps.append((low, high))
    return tuple(gaps)


class LibraryFault(NamedTuple):
    """Diameters that no lens should have: (n,) mask, reason, and its numbers."""

    mask: Array
    reason: str
    detail: str

    @property
    def text(self) -> str:
        """The reason with its numbers."""
        return self.reason + self.detail


def find_faults(
    d: Array,
    t: Array,
    bars: Array,
    *,
    least_transmission: float,
    hole: bool,
    resonances: Sequence[Sequence[float]],
) -> list[LibraryFault]:
    """Faults of pillars over the diameter, at any wavelength, angle or polarisation.

    They are: |t| below a limit; a phase that falls with the diameter (for openings,
    which leave less film the wider they are, one that rises); an error bar above half
    of |t|; and narrow resonances, with the entries next to them on either side.

    Args:
        d: (n,) rising diameters, um.
        t: (…, n) complex amplitudes.
        bars: (…, n) error bars of t.
        least_transmission: smallest |t| that is accepted.
        hole: whether the diameters are of openings.
        resonances: (diameter, half-width, wavelength, angle in rad) of narrow ones, um.
    """
    t, bars = t.reshape(-1, len(d)), bars.reshape(-1, len(d))
    level = np.abs(t)
    weak = np.asarray((level < least_transmission).any(axis=0))
    step = np.diff(np.unwrap(np.angle(t), axis=-1), axis=-1) * (-1 if hole else 1)
    reversal = np.pad((step < 0).any(axis=0), 1)
    faults = [
        LibraryFault(
            weak, "|t| falls", f" to {level.min():.2f}, below {least_transmission:g}"
        ),
        LibraryFault(
            reversal[1:] | reversal[:-1],
            "the phase rises" if hole else "the phase falls",
            " with the size of the opening" if hole else " with the diameter",
        ),
        LibraryFault(
            np.asarray((bars > UNKNOWN * level).any(axis=0)),
            "an error bar above half of |t|",
            f" ({bars.max():.2g})",
        ),
    ]
    for centre, width, wavelength, angle in resonances:
        near = np.abs(d - centre) <= REACH * width
        above = int(np.searchsorted(d, centre))  # first entry not below the resonance
        near[max(0, above - 1) : above + 1] = True
        light = f"{wavelength:g} um" + (
            f", {np.degrees(angle):.3g} deg" if angle else ""
        )
        place = f" at {centre:.4f} um, half-width {1e3 * width:.2g} nm ({light})"
        faults.append(LibraryFault(near, "a narrow resonance", place))
    return faults


def find_runs(good: Array) -> list[slice]:
    """Slices of the runs of consecutive True values in ``good``."""
    edges = np.flatnonzero(np.diff(good.astype(int), prepend=0, append=0))
    return [slice(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _ends(run: slice, d: Array, faults: list[LibraryFault]) -> tuple[str, ...]:
    """What bounds a run on either side, in words.

    Args:
        run: places of its diameters.
        d: (n,) all diameters, um.
        faults: of the diameters.
    """
    notes = []
    for outside, edge in ((run.start - 1, run.start), (run.stop, run.stop - 1)):
        if 0 <= outside < len(d):
            reasons = "; ".join(fault.text for fault in faults if fault.mask[outside])
            notes.append(f"cut at {d[edge]:.4f} um: {reasons}")
    return tuple(notes)


def _unwrapped(phase: Array) -> Array:
    """Phase unwrapped along the diameter, then along wavelength and angle at the least
    diameter, rad.
    """
    phase = np.unwrap(phase, axis=-1)
    for axis in (1, 0):
        first = phase[..., :1]
        phase = phase + (np.unwrap(first, axis=axis) - first)
    return phase


def fit(library: PillarLibrary, tolerances: ProxyTolerances | None = None) -> ProxyFit:
    """Polynomial proxy of a library, by minimax fits of phase and |T| in
    diameter^power.

    Half of the diameters is fitted, both ends among them; the errors are taken over all
    of them. The phase is monotone, as the library's is. |T| is scaled until its
    certified bound lies below 1. Where the entries are too few for the tolerances,
    ``shortfall`` says so.

    Args:
        tolerances: tolerances and limits of the fit.

    Raises:
        DomainError: no run of diameters without resonance holds enough entries, or no
            polynomial follows it.
    """
    limits = tolerances or ProxyTolerances()
    if library.sweep.light == "circular":
        return _fit_branch(library, limits, _converted_branch(library, limits))
    one_side = _fit_branch(library, limits, longest_monotonic_branch(library, limits))
    if any(width < limits.least_half_width_um for *_, width in library.resonances):
        with contextlib.suppress(DomainError):
            branch = longest_monotonic_branch(library, limits, across_resonances=True)
            crossing = _fit_branch(library, limits, branch)
            crosses = bool(crossing.proxy.gaps_um) and not crossing.shortfall
            if crosses and crossing.turns > one_side.turns:
                return crossing
    return one_side


def fit_proxy(
    library: PillarLibrary, tolerances: ProxyTolerances | None = None
) -> Proxy:
    """The proxy of a library alone; :func:`fit` gives its limits and errors too.

    Args:
        tolerances: tolerances and limits of the fit.
    """
    return fit(library, tolerances).proxy


def proxy_of(library: PillarLibrary) -> Proxy:
    """The stored proxy of a library, or a newly fitted one where none is stored.

    Raises:
        DomainError: no proxy fits.
    """
    return library.proxy if library.proxy is not None else fit_proxy(library)


def _fit_branch(
    library: PillarLibrary, limits: ProxyTolerances, branch: MonotonicBranch
) -> ProxyFit:
    """Proxy of the longest domain of a branch that meets the tolerances.

    Args:
        library: the swept cell.
        limits: tolerances and limits of the fit.
        branch: of the library.
    """
    default = max(FOLLOWED, KNOWN_SHARE * _entry_error(library, branch.diameter_um))
    phase = limits.phase_tolerance_rad or default
    level = limits.transmission_tolerance or default
    domain, proxy = _choose_domain(branch, limits.coefficients // 2, (phase, level))
    low, high = proxy.domain_um
    proxy = dataclasses.replace(
        proxy,
        entry_error=_entry_error(library, domain.diameter_um),
        gaps_um=tuple((a, b) for a, b in branch.gaps_um if low < a and b < high),
    )
    notes = branch.notes
    if branch.monotonic and len(domain.diameter_um) < len(branch.diameter_um):
        terms = proxy.phase_coefficients.shape[-1]
        notes += (
            f"cut at {high:.4f} um: up to {branch.diameter_um[-1]:.4f} um the phase is smooth, but "
            f"{2 * terms} coefficients do not describe it within the tolerances",
        )
    shortfall = ""
    if _cost(proxy, (phase, level)) > 1:
        shortfall = (
            f"the proxy follows the phase within {proxy.max_phase_error_rad:.3g} rad and |T| within "
            f"{proxy.max_transmission_error:.3g}, where {phase:.3g} and {level:.3g} are wanted: sweep with more "
            "samples, or loosen phase_tolerance_rad and transmission_tolerance"
        )
    spread = branch.polarization_spread
    return ProxyFit(proxy, notes, domain.turns, spread, shortfall, branch.turns)


def _entry_error(library: PillarLibrary, diameter_um: Array) -> float:
    """Root-mean-square error bar of t, relative to |t|, over the entries at some
    diameters of a library.
    """
    selected = np.isin(library.diameter_um, diameter_um)
    relative = (library.t_error / np.abs(library.t))[..., selected]
    return float(np.sqrt(np.mean(relative**2)))


def _choose_domain(
    branch: MonotonicBranch, terms: int, tolerances: tuple[float, float]
) -> tuple[MonotonicBranch, Proxy]:
    """(domain, proxy): the longest domain on which ``terms`` coefficients meet the
    tolerances, or more of them where a full turn needs them.

    The shortest domain has 3 ``terms`` diameters (for circular light 13). Where its
    proxy misses the tolerances, it takes the number of coefficients of least error.

    Raises:
        DomainError: no polynomial follows the shortest domain within 0.1.
    """

    @functools.cache
    def attempt(reach: int, count: int) -> tuple[float, Proxy | None]:
        return _fit_terms(branch.within(reach), count, tolerances)

    most = max(branch.middle, len(branch.diameter_um) - 1 - branch.middle)
    terms = min(max(2, terms), len(branch.diameter_um) // 3)
    least = min(most, 3 * terms - 1 if branch.monotonic else LEAST_ENTRIES // 2)
    longest, best = least - 1, None
    for count in range(terms, 26, 2):
        reach = most
        if attempt(most, count)[0] > 1:
            cost = lambda tried, count=count: attempt(tried, count)[0]  # noqa: E731
            reach = least - 1 + bisect.bisect(range(least, most), 1.0, key=cost)
        if reach > longest:
            longest, best = reach, attempt(reach, count)[1]
        if not branch.turns >= 1 or (best and branch.within(longest).turns >= 1):
            break
    if best is not None:
        return branch.within(longest), best
    shortest = branch.within(least)
    attempts = [_fit_terms(shortest, n, tolerances) for n in range(2, terms + 1)]
    _, best = min(attempts, key=itemgetter(0))
    if best is None or _cost(best, [max(MOST_ERROR, t) for t in tolerances]) > 1:
        raise DomainError(
            f"no polynomial of {terms} coefficients follows the library, with |T| "
            "between 0 and 1 and a phase that does not turn back, even up to "
            f"{shortest.diameter_um[-1]:.4g} um: sweep with more samples, or fewer "
            "wavelengths and angles"
        )
    return shortest, best


def _cost(proxy: Proxy, tolerances: Sequence[float]) -> float:
    """The larger of phase error and |T| error, each over its tolerance."""
    phase, level = tolerances
    return max(proxy.max_phase_error_rad / phase, proxy.max_transmission_error / level)


def _fit_terms(
    branch: MonotonicBranch, terms: int, tolerances: tuple[float, float]
) -> tuple[float, Proxy | None]:
    """(cost, proxy) of ``terms`` coefficients in diameter, its square or its cube,
    whichever has the least error in units of the tolerances.

    (inf, None) where each takes |T| below 0 between the entries, or turns the phase
    back where the library's does not.
    """
    best: tuple[float, Proxy | None] = (math.inf, None)
    for power in (3, 2, 1):
        with contextlib.suppress(DomainError):
            proxy = _fit_power(branch, power, min(terms, len(branch.diameter_um) // 3))
            if not branch.monotonic or _is_monotone(proxy):
                best = min(best, (_cost(proxy, tolerances), proxy), key=itemgetter(0))
    return best


def _is_monotone(proxy: Proxy) -> bool:
    """Whether the phase rises or falls throughout, at the ends and the middle of the
    wavelengths and at both end angles.
    """
    wavelengths_um = [sum(proxy.wavelengths_um) / 2, *proxy.wavelengths_um]
    return all(
        proxy.monotone(wavelength, angle)
        for wavelength in wavelengths_um
        for angle in {0.0, proxy.max_angle_rad}
    )


def _fit_power(data: MonotonicBranch, power: int, terms: int) -> Proxy:
    """Proxy with ``terms`` coefficients in diameter^power for the phase, and as many
    for |T|, by minimax fits to half of the diameters.

    Args:
        data: phase and |T| of the entries; the errors are the largest over all of them.
    """
    axes = _axes(data, power)
    phase = _fit_chebyshev(axes, data.phase, terms)
    level = _fit_chebyshev(axes, data.level, terms)
    points = 64 if level.size > terms else 512
    _, upper_bound = polynomial.certified_bounds(level, points=points)
    if upper_bound > 1:
        level = level / upper_bound
    errors = [
        float(np.abs(chebyshev.chebgrid3d(*axes, coefficients) - values).max())
        for coefficients, values in ((phase, data.phase), (level, data.level))
    ]
    one_angle = len(data.angle_rad) == 1
    return Proxy(
        phase[0] if one_angle else phase,
        level[0] if one_angle else level,
        (float(data.diameter_um[0]), float(data.diameter_um[-1])),
        (float(data.wavelength_um[0]), float(data.wavelength_um[-1])),
        errors[0],
        errors[1],
        power,
        0.0 if one_angle else float(data.angle_rad[-1]),
    )


def _axes(branch: MonotonicBranch, power: int) -> tuple[Array, Array, Array]:
    """Angle, wavelength and diameter mapped to [-1, 1] as :class:`Proxy` does: linear
    in sin² angle, wavelength and diameter^power.
    """
    sine_squared = np.sin(branch.angle_rad) ** 2
    return (
        map_to_unit(sine_squared, 0.0, sine_squared[-1]),
        map_to_unit(branch.wavelength_um, *branch.wavelength_um[[0, -1]]),
        map_to_unit(branch.diameter_um**power, *branch.diameter_um[[0, -1]] ** power),
    )


def _fit_chebyshev(
    axes: tuple[Array, Array, Array], values: Array, terms: int
) -> Array:
    """([angle, wavelength, diameter] degree + 1) Chebyshev coefficients of least
    largest deviation in the diameter.

    Half of the diameters is fitted, evenly spread, with both ends. The coefficients are
    then fitted in wavelength and angle: up to five values of those are met exactly,
    more by least squares.

    Args:
        axes: angle, wavelength and diameter in [-1, 1].
        values: (angle, wavelength, diameter) that are fitted.
        terms: coefficients in the diameter.
    """
    last = values.shape[-1] - 1
    half = np.rint(np.linspace(0, last, last // 2 + 1 + last % 2)).astype(int)
    curves = values[..., half].reshape(-1, len(half)).T
    curves = _fit_minimax(axes[2][half], curves, terms).T.reshape(
        *values.shape[:2], terms
    )
    for axis in (0, 1):
        basis = chebyshev.chebvander(axes[axis], min(len(axes[axis]), 5) - 1)
        curves = np.moveaxis(
            np.tensordot(np.linalg.pinv(basis), curves, (1, axis)), 0, axis
        )
    return curves


def _fit_minimax(x: Array, values: Array, terms: int) -> Array:
    """(terms, curves) Chebyshev coefficients of least largest deviation, by Lawson's
    iteration (1961): weighted least squares, with weights multiplied by the deviations
    in each round.

    Args:
        x: (n,) places in [-1, 1].
        values: (n, curves) that are fitted, with common weights.
    """
    basis = chebyshev.chebvander(x, terms - 1)
    weight = np.ones(len(x))
    best, least = np.zeros((terms, values.shape[1])), math.inf
    for _ in range(40):  # the best of these rounds is returned
        root = np.sqrt(weight)[:, None]
        fitted = np.linalg.lstsq(root * basis, root * values, rcond=None)[0]
        deviation = np.abs(basis @ fitted - values).max(axis=1)
        if deviation.max() < least:
            best, least = fitted, deviation.max()
        weight *= deviation / max(deviation.max(), 1e-300) + 1e-9
        weight /= weight.sum()
    return best


def _converted_branch(
    library: PillarLibrary, limits: ProxyTolerances
) -> MonotonicBranch:
    """Light converted to the other hand, (t_x - t_y)/2, around the size that converts
    most.

    Pillars of such a lens may all have one size: their turn carries the phase. The
    proxy describes what another size does (bias, tolerance).

    Raises:
        DomainError: fewer than 12 sizes without resonance around the best one.
    """
    t = library.cross_polarized
    d = library.diameter_um
    middle = int(np.searchsorted(d, library.best_converting_um))
    conversion = np.abs(t[:, middle]).min()
    good, narrow = _usable(library, limits)
    good &= np.abs(t).min(axis=0) >= 0.85 * conversion
    for centre, width, *_ in narrow:
        good &= np.abs(d - centre) > REACH * width
    runs = (run for run in find_runs(good) if run.start <= middle < run.stop)
    run = next(runs, slice(0, 0))  # empty where the best size itself is excluded
    if run.stop - run.start < LEAST_ENTRIES:
        raise DomainError(
            f"fewer than {LEAST_ENTRIES} sizes around {d[middle]:.4g} um, where most light is converted "
            f"({conversion**2:.0%}), are free of resonances: sweep with more samples, or another cell"
        )
    return MonotonicBranch(
        _unwrapped(np.angle(t[None, :, run])),
        np.abs(t[None, :, run]),
        d[run],
        library.wavelength_um,
        library.angle_rad,
        (
            f"converted light: at {d[middle]:.4f} um {conversion**2:.3f} of it changes hand",
        ),
        middle=middle - run.start,
        monotonic=False,
    )
