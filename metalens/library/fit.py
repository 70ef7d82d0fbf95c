"""Fit the proxy of Eq. 2 to a library: the longest domain without resonances that
polynomials follow within the tolerances.
"""

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library import polynomial
from metalens.library.proxy import Proxy
from metalens.library.record import PillarLibrary

TURN = 2 * math.pi
LEAST_ENTRIES = 12  # diameters in a domain
REACH = 2.0  # half-widths on either side of a narrow resonance that are excluded
UNKNOWN = 0.5  # largest error bar of a usable entry, as a share of |t|
# default tolerances: an absolute deviation, and a share of the entries' error bars
FOLLOWED, KNOWN_SHARE = 1e-3, 0.5
HEADROOM = 2e-6  # |T| stays this far below 1: a few roundings of float32
TURNS_BACK = "the phase of the proxy turns back, which the library's does not: sweep with more samples"


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

    @property
    def tolerances(self) -> tuple[float, float]:
        """Tolerances of phase (rad) and |T|; 1e-3 where none is set."""
        return (
            self.phase_tolerance_rad or FOLLOWED,
            self.transmission_tolerance or FOLLOWED,
        )

    def with_defaults(self, entry_error: float) -> "ProxyTolerances":
        """Tolerances with missing values filled in: 1e-3, or half the error of the
        entries where that is more.

        Args:
            entry_error: root-mean-square error bar of t, relative to |t|.
        """
        default = max(FOLLOWED, KNOWN_SHARE * entry_error)
        phase = self.phase_tolerance_rad or default
        level = self.transmission_tolerance or default
        return dataclasses.replace(
            self, phase_tolerance_rad=phase, transmission_tolerance=level
        )


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
        return float(abs(self.phase[..., -1] - self.phase[..., 0]).min() / TURN)


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
    """Slices of the runs of consecutive True values."""
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

    Every other diameter is fitted (least largest deviation, by Lawson's weights); the
    errors are taken over all of them. The phase is monotone, as the library's is. |T|
    is scaled until its certified bound lies below 1. Where the entries are too few for
    the tolerances, ``shortfall`` says so.

    Args:
        tolerances: tolerances and limits of the fit.

    Raises:
        DomainError: no run of diameters without resonance holds enough entries.
    """
    limits = tolerances or ProxyTolerances()
    if library.sweep.light == "circular":
        return _fit_branch(library, limits, _converted_branch(library, limits))
    branch = longest_monotonic_branch(library, limits)
    one_side = _fit_branch(library, limits, branch)
    if any(width < limits.least_half_width_um for *_, width in library.resonances):
        with contextlib.suppress(DomainError):
            branch = longest_monotonic_branch(library, limits, across_resonances=True)
            crossing = _fit_branch(library, limits, branch)
            crosses = bool(crossing.proxy.gaps_um) and not crossing.shortfall
            if crosses and crossing.turns > one_side.turns:
                return crossing
    return one_side


def _fit_branch(
    library: PillarLibrary, limits: ProxyTolerances, branch: MonotonicBranch
) -> ProxyFit:
    """Proxy of the longest domain of a branch.

    Args:
        library: the swept cell.
        limits: tolerances and limits of the fit.
        branch: of the library.
    """
    limits = limits.with_defaults(entry_error(library, branch.diameter_um))
    domain, proxy, terms = _choose_coefficients(branch, limits)
    low, high = proxy.domain_um
    proxy = dataclasses.replace(
        proxy,
        entry_error=entry_error(library, domain.diameter_um),
        gaps_um=tuple((a, b) for a, b in branch.gaps_um if low < a and b < high),
    )
    notes = branch.notes
    if branch.monotonic and len(domain.diameter_um) < len(branch.diameter_um):
        notes += (
            f"cut at {domain.diameter_um[-1]:.4f} um: up to {branch.diameter_um[-1]:.4f} um the phase is smooth, but "
            f"{2 * terms} coefficients do not describe it within the tolerances",
        )
    turns_back = branch.monotonic and not _is_monotone(proxy)
    shortfall = TURNS_BACK if turns_back else tolerance_shortfall(proxy, limits)
    spread = branch.polarization_spread
    return ProxyFit(proxy, notes, domain.turns, spread, shortfall, branch.turns)


def entry_error(library: PillarLibrary, diameter_um: Array) -> float:
    """Root-mean-square error bar of t, relative to |t|, over the entries at some
    diameters of a library.

    Args:
        library: the swept cell.
        diameter_um: of the entries, um.
    """
    selected = np.isin(library.diameter_um, diameter_um)
    relative = (library.t_error / np.abs(library.t))[..., selected]
    return float(np.sqrt(np.mean(relative**2)))


def _choose_coefficients(
    branch: MonotonicBranch, limits: ProxyTolerances
) -> tuple[MonotonicBranch, Proxy, int]:
    """(domain, proxy, terms): the domain that a proxy follows, and its number of
    coefficients for phase and for |T| each.

    Starts from half of ``limits.coefficients``. Takes more where a full turn needs
    them, fewer where the polynomial oscillates between too few entries. Where the
    tolerances are still missed, cuts the last diameters, next to the fault that ends
    the branch: at most a tenth of the phase, and none where that is not enough.
    """
    terms = more = min(max(2, limits.coefficients // 2), len(branch.diameter_um) // 3)
    cost, domain, proxy = _longest_domain(branch, limits, terms)
    while more < 24 and domain.turns < 1 <= branch.turns:
        more += 2
        # so many coefficients may take |T| below 0: then the last result stands
        with contextlib.suppress(DomainError):
            new_cost, longer, candidate = _longest_domain(branch, limits, more)
            gain = len(longer.diameter_um) - len(domain.diameter_um)
            if new_cost <= 1 and gain > 0:
                cost, domain, proxy, terms = new_cost, longer, candidate, more
    if cost <= 1 or not branch.monotonic:
        return domain, proxy, terms
    for fewer in range(terms - 1, 1, -1):
        new_cost, fit_of_fewer = _best_power(domain, limits, fewer)
        if fit_of_fewer is not None and new_cost < cost:
            cost, proxy, terms = new_cost, fit_of_fewer, fewer
    for reach in range(len(domain.diameter_um) - 2, LEAST_ENTRIES - 2, -1):
        shorter = domain.within(reach)
        if cost <= 1 or shorter.turns < 0.9 * domain.turns:
            break
        new_cost, shorter_fit = _best_power(shorter, limits, terms)
        if shorter_fit is not None and new_cost <= 1:
            return shorter, shorter_fit, min(terms, (reach + 1) // 3)
    return domain, proxy, terms


def fit_proxy(
    library: PillarLibrary, tolerances: ProxyTolerances | None = None
) -> Proxy:
    """The proxy of a library alone; :func:`fit` gives its table of error against
    coefficients too.

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


def _longest_domain(
    branch: MonotonicBranch, limits: ProxyTolerances, terms: int
) -> tuple[float, MonotonicBranch, Proxy]:
    """(cost, domain, proxy) of the longest domain on which ``terms`` coefficients meet
    the tolerances, by bisection in the number of diameters.

    The shortest has 3 ``terms`` of them; for circular light 12, with fewer terms.

    Raises:
        DomainError: no polynomial stays between 0 and 1 even on the shortest domain.
    """
    most = max(branch.middle, len(branch.diameter_um) - 1 - branch.middle)
    reach = min(most, 3 * terms - 1 if branch.monotonic else LEAST_ENTRIES // 2)
    domain, too_far = branch.within(reach), most + 1
    cost, proxy = _best_power(domain, limits, terms)
    if proxy is None:
        raise DomainError(
            f"no polynomial of {terms} coefficients follows the library between 0 and 1 even up to "
            f"{domain.diameter_um[-1]:.4g} um: sweep with more samples, or fewer wavelengths and angles"
        )
    while too_far - reach > 1:
        middle = (reach + too_far + (too_far > most)) // 2
        longer = branch.within(middle)
        longer_cost, candidate = _best_power(longer, limits, terms)
        if candidate is not None and longer_cost <= 1:
            reach, cost, domain, proxy = middle, longer_cost, longer, candidate
        else:
            too_far = middle
    return cost, domain, proxy


def tolerance_shortfall(proxy: Proxy, tolerances: ProxyTolerances) -> str:
    """Message on how far a proxy misses its tolerances; empty where it meets them.

    Args:
        proxy: phase and |T| over the diameter.
        tolerances: tolerances and limits of the fit.
    """
    if tolerance_ratio(proxy, tolerances) <= 1:
        return ""
    phase, level = tolerances.tolerances
    return (
        f"the proxy follows the phase within {proxy.max_phase_error_rad:.3g} rad and |T| within "
        f"{proxy.max_transmission_error:.3g}, where {phase:.3g} and {level:.3g} are wanted: sweep with more samples, "
        "or loosen phase_tolerance_rad and transmission_tolerance"
    )


def tolerance_ratio(proxy: Proxy, tolerances: ProxyTolerances) -> float:
    """The larger of phase error and |T| error, each over its tolerance.

    Args:
        proxy: phase and |T| over the diameter.
        tolerances: tolerances and limits of the fit.
    """
    phase, level = tolerances.tolerances
    return max(proxy.max_phase_error_rad / phase, proxy.max_transmission_error / level)


def _best_power(
    branch: MonotonicBranch, limits: ProxyTolerances, terms: int
) -> tuple[float, Proxy | None]:
    """(cost, proxy) in diameter, its square or its cube, whichever has the least error
    in units of the tolerances; None where each takes |T| below 0 between the entries.

    The cost of a phase that turns back, where the library's does not, is infinite.
    """
    best: tuple[float, Proxy | None] = (math.inf, None)
    for power in (3, 2, 1):
        with contextlib.suppress(DomainError):
            count = len(branch.diameter_um) // 3
            proxy = fit_terms(branch, power, min(terms, count))
            turns_back = branch.monotonic and not _is_monotone(proxy)
            cost = math.inf if turns_back else tolerance_ratio(proxy, limits)
            if best[1] is None or cost < best[0]:
                best = cost, proxy
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


def fit_terms(data: MonotonicBranch, power: int, terms: int) -> Proxy:
    """Proxy with ``terms`` coefficients in diameter^power for the phase, and as many
    for |T|, by minimax fits to every other diameter.

    Args:
        data: phase and |T| of the entries; the errors are the largest over all of them.
    """
    axes = _axes(data, power)
    phase = _minimax(axes, data.phase, terms)
    level = _minimax(axes, data.level, terms)
    points = 64 if level.size > terms else 512
    _, upper_bound = polynomial.certified_bounds(level, points=points)
    if upper_bound > 1 - HEADROOM:
        level = level * ((1 - HEADROOM) / upper_bound)
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
        _map_to_unit(sine_squared, 0.0),
        _map_to_unit(branch.wavelength_um, branch.wavelength_um[0]),
        _map_to_unit(branch.diameter_um**power, branch.diameter_um[0] ** power),
    )


def _map_to_unit(values: Array, least: float) -> Array:
    """Rising values mapped linearly from [least, largest] to [-1, 1]; 0 where there is
    one value alone.
    """
    if len(values) == 1:
        return np.zeros(1)
    return np.asarray((2 * values - least - values[-1]) / (values[-1] - least))


def _minimax(axes: tuple[Array, Array, Array], values: Array, terms: int) -> Array:
    """([angle, wavelength, diameter] degree + 1) Chebyshev coefficients of least
    largest deviation in the diameter.

    Each curve is fitted by itself in the diameter, then its coefficients in wavelength
    and angle: up to five values of those are met exactly, more by least squares.

    Args:
        axes: angle, wavelength and diameter in [-1, 1].
        values: (angle, wavelength, diameter) that are fitted, at every other diameter.
        terms: coefficients in the diameter.
    """
    curves = _lawson(chebyshev.chebvander(axes[2][::2], terms - 1), values[:, :, ::2])
    for axis in (0, 1):
        basis = chebyshev.chebvander(axes[axis], min(len(axes[axis]), 5) - 1)
        curves = np.moveaxis(
            np.tensordot(np.linalg.pinv(basis), curves, (1, axis)), 0, axis
        )
    return curves


def _lawson(basis: Array, values: Array) -> Array:
    """(..., terms) coefficients of least largest deviation, by Lawson's iteration
    (1961): weighted least squares, with weights multiplied by the deviations in each
    round.

    Args:
        basis: (n, terms) basis functions at the points.
        values: (..., n) that are fitted.
    """
    weight = np.ones(values.shape)
    best = np.zeros((*values.shape[:-1], basis.shape[1]))
    least_deviation = np.full(values.shape[:-1], np.inf)
    for _ in range(40):  # the best of these rounds is returned
        root = np.sqrt(weight)[..., None]
        q, r = np.linalg.qr(basis * root)
        projected = np.swapaxes(q, -1, -2) @ (values[..., None] * root)
        coefficients = np.linalg.solve(r, projected)[..., 0]
        deviation = np.abs(np.einsum("nk,...k->...n", basis, coefficients) - values)
        largest = deviation.max(axis=-1)
        better = largest < least_deviation
        best[better] = coefficients[better]
        least_deviation[better] = largest[better]
        weight *= deviation / np.maximum(largest, 1e-300)[..., None] + 1e-9
        weight /= weight.sum(axis=-1, keepdims=True)
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
