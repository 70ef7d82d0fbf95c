"""Fit the proxy of Eq. 2 to a library: the longest domain without resonances that
polynomials follow within the tolerances.
"""

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library import polynomial
from metalens.library.proxy import Proxy
from metalens.library.record import PillarLibrary

TURN = 2 * math.pi
LEAST_ENTRIES = 12  # of a domain
REACH = 2.0  # half-widths from a narrow resonance that are cut with it
UNKNOWN = 0.5  # of |t|: an entry whose error bar is larger is not known
# deviation from entries where none is stated, and that of the entries' own bars
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
        """Of phase (rad) and |T|."""
        return (
            self.phase_tolerance_rad or FOLLOWED,
            self.transmission_tolerance or FOLLOWED,
        )

    def with_defaults(self, entry_error: float) -> "ProxyTolerances":
        """What is left out, by the errors of the entries themselves: no curve need
        follow what is not known.
        """
        usual = max(FOLLOWED, KNOWN_SHARE * entry_error)
        phase = self.phase_tolerance_rad or usual
        level = self.transmission_tolerance or usual
        return dataclasses.replace(
            self, phase_tolerance_rad=phase, transmission_tolerance=level
        )


@dataclass(frozen=True, slots=True)
class FitTrial:
    """One line of the table of error against coefficients."""

    coefficients: int
    power: int
    phase_error_rad: float
    transmission_error: float


@dataclass(frozen=True, eq=False, slots=True)
class ProxyFit:
    """A proxy and why it is as it is.

    notes: where its domain was cut, and why. table: error against the number of
        coefficients on that domain.
    turns: covered by the domain, the least over wavelengths and angles.
    polarization_spread: largest |t_s - t_p| / 2 on the domain; the proxy holds their
        mean.
    shortfall: by how much the proxy misses the tolerances that were wanted, for a
        person; empty where it meets them.
    smooth_turns: covered by the diameters without resonance, as far as the proxy or
        not.
    """

    proxy: Proxy
    notes: tuple[str, ...]
    table: tuple[FitTrial, ...]
    turns: float
    polarization_spread: float
    shortfall: str
    smooth_turns: float


@dataclass(frozen=True, eq=False, slots=True)
class MonotonicBranch:
    """Consecutive diameters without resonance.

    phase: (angle, wavelength, diameter) rad, unwrapped along every axis.
    level: |t|, as phase.
    diameter_um, wavelength_um, angle_rad: the axes.
    notes: what bounds the stretch. polarization_spread: largest |t_s - t_p| / 2; t is
        their mean.
    gaps_um: (least, largest) diameters inside the stretch around narrow resonances,
        which no pillar of a lens should have.
    """

    phase: Array
    level: Array
    diameter_um: Array
    wavelength_um: Array
    angle_rad: Array
    notes: tuple[str, ...] = ()
    polarization_spread: float = 0.0
    gaps_um: tuple[tuple[float, float], ...] = ()

    def part(self, some: slice) -> "MonotonicBranch":
        """The same of some diameters."""
        return dataclasses.replace(
            self,
            phase=self.phase[..., some],
            level=self.level[..., some],
            diameter_um=self.diameter_um[some],
        )

    @property
    def turns(self) -> float:
        """Covered at every wavelength and angle."""
        return float(abs(self.phase[..., -1] - self.phase[..., 0]).min() / TURN)


def longest_monotonic_branch(
    library: PillarLibrary, wanted: ProxyTolerances, *, across_resonances: bool = False
) -> MonotonicBranch:
    """The stretch of most phase over which, at all wavelengths, angles and
    polarisations, |t| stays above ``least_transmission``, the phase rises (of openings,
    which leave less film the wider they are, falls), and no resonance is narrower than
    ``least_half_width_um`` and no error bar above half of |t|.

    Args:
        library: the swept cell.
        wanted: limits of the stretch.
        across_resonances: it goes on behind narrow resonances, without the entries
            nearer to one than ``least_half_width_um`` or two half-widths.

    Raises:
        DomainError: fewer than 12 entries in any such stretch; the message says what is
            in the way.
    """
    low, high = wanted.within_um or (0.0, np.inf)
    d = library.diameter_um
    inside = (d >= low - 1e-9) & (d <= high + 1e-9)
    sharp = [
        (angle, wavelength, centre, width)
        for _, angle, wavelength, centre, width in library.resonances.tolist()
        if width < wanted.least_half_width_um
        and inside.any()
        and d[inside][0] <= centre <= d[inside][-1]
    ]
    gaps = _gaps(sharp, wanted.least_half_width_um) if across_resonances else ()
    for least, largest in gaps:
        inside &= (d < least) | (d > largest)
    d = d[inside]
    t = library.t[..., inside]
    bars = library.t_error[..., inside]
    faults = _faults(library, d, t, bars, wanted.least_transmission)
    faults += [] if gaps else [_near_resonance(d, *one) for one in sharp]
    bad = np.any([mask for mask, _ in faults], axis=0)
    runs = [run for run in find_runs(~bad) if run.stop - run.start >= LEAST_ENTRIES]
    if not runs:
        reasons = "; ".join(text for mask, text in faults if mask.any())
        raise DomainError(
            f"no {LEAST_ENTRIES} diameters in a row are free of resonances ({reasons}): choose another pitch, height "
            "or material, fewer wavelengths or angles, or sweep with more samples"
        )
    phase = np.unwrap(np.angle(t), axis=-1)

    def covered(run: slice) -> float:
        return float(abs(phase[..., run.stop - 1] - phase[..., run.start]).min())

    best = max(runs, key=covered)
    mean = t.mean(axis=0)[..., best]
    words = [
        f"passes over a narrow resonance between {a:.4f} and {b:.4f} um"
        for a, b in gaps
    ]
    return MonotonicBranch(
        _unwrapped(np.angle(mean)),
        np.abs(mean),
        d[best],
        library.wavelength_um,
        library.angle_rad,
        (*_ends(best, d, faults), *words),
        float(np.abs(t[0] - t[-1])[..., best].max()) / 2,
        tuple((a, b) for a, b in gaps if a < d[best][-1] and b > d[best][0]),
    )


def _gaps(
    sharp: Sequence[tuple[float, ...]], half_width: float
) -> tuple[tuple[float, float], ...]:
    """Diameters too near to a narrow resonance, joined where they overlap."""
    gaps: list[tuple[float, float]] = []
    for _, _, centre, width in sorted(sharp, key=lambda one: one[2]):
        reach = max(half_width, REACH * width)
        low, high = centre - reach, centre + reach
        if gaps and low <= gaps[-1][1]:
            low, high = gaps[-1][0], max(high, gaps.pop()[1])
        gaps.append((low, high))
    return tuple(gaps)


def _faults(
    library: PillarLibrary, d: Array, t: Array, bars: Array, least: float
) -> list[tuple[Array, str]]:
    """(mask over the diameters, what is wrong there)."""
    level, phase = np.abs(t), np.unwrap(np.angle(t), axis=-1)
    hole = library.cell.shape.hole
    dark = np.asarray((level < least).any(axis=(0, 1, 2)))
    unknown = np.asarray((bars > UNKNOWN * level).any(axis=(0, 1, 2)))
    turns = (np.diff(phase, axis=-1) * (-1 if hole else 1) < 0).any(axis=(0, 1, 2))
    back = np.zeros(len(d), bool)
    back[1:] |= turns
    back[:-1] |= turns
    wrong = (
        "the phase rises with the size of the opening"
        if hole
        else "the phase falls with the diameter"
    )
    return [
        (dark, f"|t| falls to {level.min():.2f}, below {least:g}"),
        (unknown, f"error bars reach {bars.max():.2g}, above half of |t|"),
        (back, wrong),
    ]


def _near_resonance(
    d: Array, angle: float, wavelength: float, centre: float, width: float
) -> tuple[Array, str]:
    """As :func:`_faults`, of a narrow resonance: the diameters near it, and those on
    either side.
    """
    near = np.abs(d - centre) <= REACH * width
    after = int(np.searchsorted(d, centre))
    near[[max(0, after - 1), after]] = True
    text = f"resonance at {centre:.4f} um, half-width {1e3 * width:.2g} nm ({wavelength:g} um"
    return near, text + (f", {np.degrees(angle):.3g} deg)" if angle else ")")


def find_runs(good: Array) -> list[slice]:
    """Places of the runs of True."""
    edges = np.flatnonzero(np.diff(good.astype(int), prepend=0, append=0))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _ends(run: slice, d: Array, faults: list[tuple[Array, str]]) -> tuple[str, ...]:
    notes = []
    for place, edge in ((run.start - 1, run.start), (run.stop, run.stop - 1)):
        if 0 <= place < len(d):
            why = "; ".join(text for mask, text in faults if mask[place])
            notes.append(f"cut at {d[edge]:.4f} um: {why}")
    return tuple(notes)


def _unwrapped(phase: Array) -> Array:
    """Unwrapped along the diameter, then neighbouring wavelengths and angles at the
    thinnest pillar.
    """
    phase = np.unwrap(phase, axis=-1)
    for axis in (1, 0):
        start = phase[..., :1]
        phase = phase + (np.unwrap(start, axis=axis) - start)
    return phase


def fit(library: PillarLibrary, wanted: ProxyTolerances | None = None) -> ProxyFit:
    """The proxy of a library.

    Every other diameter is fitted (least largest deviation, by Lawson's weights), all
    are judged: half of them the fit never saw. The phase is monotone, as the library's
    is. Phase and |T| have their own polynomials in diameter^power; |T| is scaled until
    its certified bound lies below 1. Where so few entries allow only a domain that
    misses the tolerances, ``shortfall`` says so.

    Args:
        wanted: tolerances and limits of the fit.

    Raises:
        DomainError: no stretch of diameters without resonance holds enough entries.
    """
    wanted = wanted or ProxyTolerances()
    if library.sweep.light == "circular":
        return _fit_converted(library, wanted)
    found = _fit_branch(library, wanted, across_resonances=False)
    if any(width < wanted.least_half_width_um for *_, width in library.resonances):
        with contextlib.suppress(DomainError):
            across = _fit_branch(library, wanted, across_resonances=True)
            crosses = bool(across.proxy.gaps_um) and not across.shortfall
            if crosses and across.turns > found.turns:
                return across
    return found


def _fit_branch(
    library: PillarLibrary, wanted: ProxyTolerances, *, across_resonances: bool
) -> ProxyFit:
    """The proxy on one side of all narrow resonances, or across them."""
    data = longest_monotonic_branch(
        library, wanted, across_resonances=across_resonances
    )
    wanted = wanted.with_defaults(entry_error(library, data.diameter_um))
    kept, proxy, terms = _choose_coefficients(data, wanted)
    low, high = proxy.domain_um
    proxy = dataclasses.replace(
        proxy,
        entry_error=entry_error(library, kept.diameter_um),
        gaps_um=tuple((a, b) for a, b in data.gaps_um if low < a and b < high),
    )
    counts = range(4, max(18, 2 * terms + 5), 2)
    trials = (
        _trial(kept, proxy.power, count)
        for count in counts
        if count // 2 < len(kept.diameter_um) // 3
    )
    notes = data.notes
    if len(kept.diameter_um) < len(data.diameter_um):
        notes += (
            f"cut at {kept.diameter_um[-1]:.4f} um: up to {data.diameter_um[-1]:.4f} um the phase is smooth, but "
            f"{2 * terms} coefficients do not describe it within the tolerances",
        )
    short = (
        TURNS_BACK
        if math.isinf(_cost(proxy, wanted))
        else tolerance_shortfall(proxy, wanted)
    )
    return ProxyFit(
        proxy,
        notes,
        tuple(trial for trial in trials if trial is not None),
        kept.turns,
        data.polarization_spread,
        short,
        data.turns,
    )


def entry_error(library: PillarLibrary, diameter_um: Array) -> float:
    """Root mean square of the error bars of t, relative to |t|, of the entries at some
    of a library's diameters.

    Args:
        diameter_um: of the entries, um.
    """
    some = np.isin(library.diameter_um, diameter_um)
    return float(
        np.sqrt(np.mean((library.t_error / np.abs(library.t))[..., some] ** 2))
    )


def _choose_coefficients(
    data: MonotonicBranch, wanted: ProxyTolerances
) -> tuple[MonotonicBranch, Proxy, int]:
    """The domain that a proxy follows, and its number of coefficients: those wanted;
    more where a full turn takes them; fewer where so few entries let those wanted swing
    between them.
    """
    terms = more = min(max(2, wanted.coefficients // 2), len(data.diameter_um) // 3)
    kept, proxy = _longest_domain(data, wanted, terms)
    while more < 24 and kept.turns < 1 <= data.turns:
        more += 2
        with contextlib.suppress(
            DomainError
        ):  # more coefficients than so few entries bear: those before stand
            longer, better = _longest_domain(data, wanted, more)
            if _cost(better, wanted) <= 1 and len(longer.diameter_um) > len(
                kept.diameter_um
            ):
                kept, proxy, terms = longer, better, more
    for fewer in range(terms - 1, 1, -1) if _cost(proxy, wanted) > 1 else ():
        other = _best_power(kept, wanted, fewer)
        if other is not None and _cost(other, wanted) < _cost(proxy, wanted):
            proxy, terms = other, fewer
    shorter = (
        _cut_last_diameters(kept, wanted, terms) if _cost(proxy, wanted) > 1 else None
    )
    return shorter or (kept, proxy, terms)


def _cut_last_diameters(
    data: MonotonicBranch, wanted: ProxyTolerances, terms: int
) -> tuple[MonotonicBranch, Proxy, int] | None:
    """Without the last diameters, next to what bounds the domain, where the tolerances
    are met so; they are excluded as the resonance is, up to a tenth of the phase. None
    where that is not enough.
    """
    for count in range(len(data.diameter_um) - 1, LEAST_ENTRIES - 1, -1):
        some = data.part(slice(count))
        if some.turns < 0.9 * data.turns:
            return None
        fewer = min(terms, count // 3)
        other = _best_power(some, wanted, fewer)
        if other is not None and _cost(other, wanted) <= 1:
            return some, other, fewer
    return None


def fit_proxy(library: PillarLibrary, wanted: ProxyTolerances | None = None) -> Proxy:
    """The proxy of a library alone; :func:`fit` gives its table of error against
    coefficients too.

    Args:
        wanted: tolerances and limits of the fit.
    """
    return fit(library, wanted).proxy


def proxy_of(library: PillarLibrary) -> Proxy:
    """The proxy that a library holds, fitted now where it holds none.

    Raises:
        DomainError: no proxy fits.
    """
    return library.proxy if library.proxy is not None else fit_proxy(library)


def _longest_domain(
    data: MonotonicBranch, wanted: ProxyTolerances, terms: int
) -> tuple[MonotonicBranch, Proxy]:
    """The longest sub-domain from the thin end on which ``terms`` coefficients meet the
    tolerances.
    """
    good = min(len(data.diameter_um), 3 * terms)
    bad = len(data.diameter_um) + 1
    best = _best_power(data.part(slice(good)), wanted, terms)
    if best is None:
        raise DomainError(
            f"no polynomial of {terms} coefficients follows the library between 0 and 1 even up to "
            f"{data.diameter_um[good - 1]:.4g} um: sweep with more samples, or fewer wavelengths and angles"
        )
    while bad - good > 1:
        middle = (
            (good + bad + 1) // 2 if bad > len(data.diameter_um) else (good + bad) // 2
        )
        trial = _best_power(data.part(slice(middle)), wanted, terms)
        if trial is not None and _cost(trial, wanted) <= 1:
            good, best = middle, trial
        else:
            bad = middle
    return data.part(slice(good)), best


def tolerance_shortfall(proxy: Proxy, wanted: ProxyTolerances) -> str:
    """By how much a proxy misses its tolerances, for a person; empty where it meets
    them.

    Args:
        wanted: tolerances and limits of the fit.
    """
    if tolerance_ratio(proxy, wanted) <= 1:
        return ""
    phase, level = wanted.tolerances
    return (
        f"the proxy follows the phase within {proxy.max_phase_error_rad:.3g} rad and |T| within "
        f"{proxy.max_transmission_error:.3g}, where {phase:.3g} and {level:.3g} are wanted: sweep with more samples, "
        "or loosen phase_tolerance_rad and transmission_tolerance"
    )


def tolerance_ratio(proxy: Proxy, wanted: ProxyTolerances) -> float:
    """The larger error in units of its tolerance.

    Args:
        proxy: phase and |T| over the diameter.
        wanted: tolerances and limits of the fit.
    """
    phase, level = wanted.tolerances
    return max(proxy.max_phase_error_rad / phase, proxy.max_transmission_error / level)


def _best_power(
    data: MonotonicBranch, wanted: ProxyTolerances, terms: int
) -> Proxy | None:
    """Of the powers of the diameter, the one with the least error in units of the
    tolerances; None where each takes |T| below 0 between the entries.
    """
    found = []
    for power in (3, 2, 1):
        with contextlib.suppress(DomainError):
            found.append(fit_terms(data, power, terms))
    return min(found, key=lambda proxy: _cost(proxy, wanted), default=None)


def _cost(proxy: Proxy, wanted: ProxyTolerances) -> float:
    """As :func:`tolerance_ratio`; infinite where the phase turns back (the library's
    does not).
    """
    middles = [sum(proxy.wavelengths_um) / 2, *proxy.wavelengths_um]
    monotone = all(
        proxy.monotone(w, a) for w in middles for a in {0.0, proxy.max_angle_rad}
    )
    return tolerance_ratio(proxy, wanted) if monotone else math.inf


def fit_terms(data: MonotonicBranch, power: int, terms: int) -> Proxy:
    """The proxy with ``terms`` coefficients in diameter^power for the phase, and as
    many for |T|.

    Args:
        data: phase and |T| of the entries.
    """
    axes = _axes(data, power)
    phase = _minimax(axes, data.phase, terms)
    level = _minimax(axes, data.level, terms)
    high = polynomial.certified_bounds(level, points=64 if level.size > terms else 512)[
        1
    ]
    if high > 1 - HEADROOM:
        level = level * ((1 - HEADROOM) / high)
    errors = [
        float(np.abs(_evaluate(axes, c) - values).max())
        for c, values in ((phase, data.phase), (level, data.level))
    ]
    flat = len(data.angle_rad) == 1
    return Proxy(
        phase[0] if flat else phase,
        level[0] if flat else level,
        (float(data.diameter_um[0]), float(data.diameter_um[-1])),
        (float(data.wavelength_um[0]), float(data.wavelength_um[-1])),
        errors[0],
        errors[1],
        power,
        0.0 if flat else float(data.angle_rad[-1]),
    )


def _axes(data: MonotonicBranch, power: int) -> tuple[Array, Array, Array]:
    """Angle, wavelength and diameter mapped to [-1, 1] as :class:`Proxy` does."""
    sine = np.sin(data.angle_rad) ** 2
    return (
        2 * sine / sine[-1] - 1 if len(sine) > 1 else np.zeros(1),
        _unit(data.wavelength_um) if len(data.wavelength_um) > 1 else np.zeros(1),
        _unit(data.diameter_um**power),
    )


def _unit(values: Array) -> Array:
    return np.asarray((2 * values - values[0] - values[-1]) / (values[-1] - values[0]))


def _evaluate(axes: tuple[Array, Array, Array], coefficients: Array) -> Array:
    a, w, d = (
        chebyshev.chebvander(x, n - 1)
        for x, n in zip(axes, coefficients.shape, strict=True)
    )
    return np.asarray(
        np.einsum("ai,wj,dk,ijk->awd", a, w, d, coefficients, optimize=True)
    )


def _minimax(axes: tuple[Array, Array, Array], values: Array, terms: int) -> Array:
    """Tensor coefficients: every curve by itself in the diameter, then its coefficients
    in wavelength and angle.

    Up to five wavelengths or angles are met exactly by polynomials of them, more by
    least squares.
    """
    curves = _lawson(chebyshev.chebvander(axes[2][::2], terms - 1), values[:, :, ::2])
    for axis in (0, 1):
        basis = chebyshev.chebvander(axes[axis], min(len(axes[axis]), 5) - 1)
        curves = np.moveaxis(
            np.tensordot(np.linalg.pinv(basis), curves, (1, axis)), 0, axis
        )
    return curves


def _lawson(basis: Array, values: Array, *, rounds: int = 40) -> Array:
    """(..., terms) coefficients of least largest deviation from (..., n) values (Lawson
    1961: weights times deviation).
    """
    weight = np.ones(values.shape)
    best = np.zeros((*values.shape[:-1], basis.shape[1]))
    least = np.full(values.shape[:-1], np.inf)
    for _ in range(rounds):
        root = np.sqrt(weight)[..., None]
        q, r = np.linalg.qr(basis * root)
        c = np.linalg.solve(r, np.swapaxes(q, -1, -2) @ (values[..., None] * root))[
            ..., 0
        ]
        off = np.abs(np.einsum("nk,...k->...n", basis, c) - values)
        worst = off.max(axis=-1)
        better = worst < least
        best[better], least[better] = c[better], worst[better]
        weight *= off / np.maximum(worst, 1e-300)[..., None] + 1e-9
        weight /= weight.sum(axis=-1, keepdims=True)
    return best


def _trial(data: MonotonicBranch, power: int, coefficients: int) -> FitTrial | None:
    """One line of the table; None where |T| falls below 0 between the entries."""
    try:
        proxy = fit_terms(data, power, coefficients // 2)
    except DomainError:
        return None
    return FitTrial(
        coefficients, power, proxy.max_phase_error_rad, proxy.max_transmission_error
    )


def _fit_converted(library: PillarLibrary, wanted: ProxyTolerances) -> ProxyFit:
    """The proxy of the light converted to the other hand, (t_x - t_y)/2, on the widest
    run of sizes around the best one that meets the tolerances.

    Pillars of such a lens may all have one size: their turn carries the phase, and the
    proxy tells what another size does (bias, tolerance).

    Raises:
        DomainError: fewer than 12 sizes without resonance around the best one.
    """
    t, d = library.cross_polarized, library.diameter_um
    middle = int(np.searchsorted(d, library.best_converting_um))
    least = 0.85 * np.abs(t[:, middle]).min()  # of the largest conversion
    good = (np.abs(t).min(axis=0) >= least) & ~_sharp(
        library, wanted.least_half_width_um
    )
    if wanted.within_um is not None:
        good &= (d >= wanted.within_um[0]) & (d <= wanted.within_um[1])
    around = (run for run in find_runs(good) if run.start <= middle < run.stop)
    run = next(around, slice(0, 0))
    if run.stop - run.start < LEAST_ENTRIES:
        raise DomainError(
            f"fewer than {LEAST_ENTRIES} sizes around {d[middle]:.4g} um, where most light is converted "
            f"({np.abs(t[:, middle]).min() ** 2:.0%}), are free of resonances: sweep with more samples, or another cell"
        )
    phase = np.unwrap(np.angle(t[:, run]), axis=-1)
    phase += (np.unwrap(phase[:, middle - run.start]) - phase[:, middle - run.start])[
        :, None
    ]
    kept = MonotonicBranch(
        phase[None],
        np.abs(t[:, run])[None],
        d[run],
        library.wavelength_um,
        library.angle_rad,
    )
    wanted = wanted.with_defaults(entry_error(library, kept.diameter_um))
    proxy = _widest_domain(kept, middle - run.start, wanted)
    inside = (d >= proxy.domain_um[0]) & (d <= proxy.domain_um[1])
    proxy = dataclasses.replace(proxy, entry_error=entry_error(library, d[inside]))
    notes = (
        f"converted light: at {d[middle]:.4f} um {np.abs(t[:, middle]).min() ** 2:.3f} of it changes hand",
    )
    return ProxyFit(
        proxy, notes, (), math.nan, 0.0, tolerance_shortfall(proxy, wanted), math.nan
    )


def _sharp(library: PillarLibrary, least_half_width_um: float) -> Array:
    """(size,) whether a narrow resonance lies there."""
    near = np.zeros(len(library.diameter_um), bool)
    for *_, centre, width in library.resonances:
        if width < least_half_width_um:
            near |= np.abs(library.diameter_um - centre) <= 2 * width
    return near


def _widest_domain(
    data: MonotonicBranch, middle: int, wanted: ProxyTolerances
) -> Proxy:
    """The widest run about ``middle`` on which as many coefficients as are wanted meet
    the tolerances.
    """
    reach = max(middle, len(data.diameter_um) - 1 - middle)
    while True:
        part = slice(max(0, middle - reach), middle + reach + 1)
        some = data.part(part)
        count = len(some.diameter_um)
        proxy = fit_terms(some, 1, min(max(2, wanted.coefficients // 2), count // 3))
        if tolerance_ratio(proxy, wanted) <= 1 or count <= LEAST_ENTRIES:
            return proxy
        nearer = max(LEAST_ENTRIES // 2, int(0.9 * reach))
        if nearer >= reach:
            return proxy
        reach = nearer
