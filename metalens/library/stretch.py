"""The stretch of a library's diameters without resonances: where the phase goes one way
and the light passes.
"""

from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library.record import PillarLibrary

LEAST_ENTRIES = 12
REACH = 2.0  # half-widths from a narrow resonance that are cut with it
UNKNOWN = 0.5  # of |t|: an entry whose error bar is larger is not known


@dataclass(frozen=True, eq=False, slots=True)
class MonotonicBranch:
    """Consecutive diameters without resonance.

    diameter_um: (d,). phase: (angle, wavelength, d) rad, unwrapped along every axis.
    level: |t|, as phase.
    notes: what bounds the stretch. polarization_spread: largest |t_s - t_p| / 2; t is
        their mean.
    gaps_um: (least, largest) diameters inside the stretch around narrow resonances,
        which no pillar of a lens should have.
    """

    diameter_um: Array
    phase: Array
    level: Array
    notes: tuple[str, ...]
    polarization_spread: float
    gaps_um: tuple[tuple[float, float], ...] = ()


def longest_monotonic_branch(
    library: PillarLibrary,
    *,
    least_transmission: float,
    least_half_width_um: float,
    within_um: tuple[float, float] | None = None,
    across_resonances: bool = False,
) -> MonotonicBranch:
    """The stretch of most phase over which, at all wavelengths, angles and
    polarisations, |t| stays above ``least_transmission``, the phase rises (of openings,
    which leave less film the wider they are, falls), and no resonance is narrower than
    ``least_half_width_um`` and no error bar above half of |t|. With
    ``across_resonances`` it goes on behind narrow resonances, without the entries
    nearer to one than ``least_half_width_um`` or two half-widths.

    Args:
        library: the swept cell.
        within_um: (least, largest) diameter that is considered, um.

    Raises:
        DomainError: fewer than 12 entries in any such stretch; the message says what is
            in the way.
    """
    low, high = within_um or (0.0, np.inf)
    inside = (library.diameter_um >= low - 1e-9) & (library.diameter_um <= high + 1e-9)
    d = library.diameter_um[inside]
    t = library.t[..., inside]
    phase = np.unwrap(np.angle(t), axis=-1)
    gaps = _gaps(library, d, least_half_width_um) if across_resonances else ()
    away = ~np.any([(d >= a) & (d <= b) for a, b in (*gaps, (1.0, 0.0))], axis=0)
    d, t, phase = d[away], t[..., away], np.unwrap(np.angle(t[..., away]), axis=-1)
    faults = _faults(
        library, d, t, phase, least_transmission, 0 if gaps else least_half_width_um
    )
    bad = np.any([mask for mask, _ in faults], axis=0)
    runs = [run for run in _runs(~bad) if run.stop - run.start >= LEAST_ENTRIES]
    if not runs:
        reasons = "; ".join(text for mask, text in faults if mask.any())
        raise DomainError(
            f"no {LEAST_ENTRIES} diameters in a row are free of resonances ({reasons}): choose another pitch, height "
            "or material, fewer wavelengths or angles, or sweep with more samples"
        )
    best = max(
        runs,
        key=lambda run: float(
            abs(phase[..., run.stop - 1] - phase[..., run.start]).min()
        ),
    )
    mean = t.mean(axis=0)[..., best]
    spread = float(np.abs(t[0] - t[-1])[..., best].max()) / 2
    return MonotonicBranch(
        d[best],
        _unwrapped(np.angle(mean)),
        np.abs(mean),
        _notes(best, d, faults) + tuple(f"passes over {_words(a, b)}" for a, b in gaps),
        spread,
        tuple((a, b) for a, b in gaps if a < d[best][-1] and b > d[best][0]),
    )


def _words(low: float, high: float) -> str:
    return f"a narrow resonance between {low:.4f} and {high:.4f} um"


def _gaps(
    library: PillarLibrary, d: Array, half_width: float
) -> tuple[tuple[float, float], ...]:
    """Diameters too near to a narrow resonance, joined where they overlap."""
    gaps: list[tuple[float, float]] = []
    for _, _, _, centre, width in sorted(
        library.resonances.tolist(), key=lambda r: r[3]
    ):
        if width < half_width and len(d) and d[0] < centre < d[-1]:
            reach = max(half_width, REACH * width)
            low, high = centre - reach, centre + reach
            if gaps and low <= gaps[-1][1]:
                low, high = gaps[-1][0], max(high, gaps.pop()[1])
            gaps.append((low, high))
    return tuple(gaps)


def _faults(
    library: PillarLibrary,
    d: Array,
    t: Array,
    phase: Array,
    least: float,
    half_width: float,
) -> list[tuple[Array, str]]:
    """(mask over the diameters, what is wrong there)."""
    faults: list[tuple[Array, str]] = []
    level = np.abs(t)
    dark = np.asarray((level < least).any(axis=(0, 1, 2)))
    faults.append((dark, f"|t| falls to {level.min():.2f}, below {least:g}"))
    bars = library.t_error[..., np.isin(library.diameter_um, d)]
    unknown = np.asarray((bars > UNKNOWN * level).any(axis=(0, 1, 2)))
    faults.append((unknown, f"error bars reach {bars.max():.2g}, above half of |t|"))
    hole = library.cell.shape.hole
    turns = (np.diff(phase, axis=-1) * (-1 if hole else 1) < 0).any(axis=(0, 1, 2))
    back = np.zeros(len(d), bool)
    back[1:] |= turns
    back[:-1] |= turns
    faults.append(
        (
            back,
            "the phase rises with the size of the opening"
            if hole
            else "the phase falls with the diameter",
        )
    )
    for _, angle, wavelength, centre, width in library.resonances:
        if width < half_width and len(d) and d[0] <= centre <= d[-1]:
            near = np.abs(d - centre) <= REACH * width
            after = int(np.searchsorted(d, centre))
            near[[max(0, after - 1), after]] = True
            text = f"resonance at {centre:.4f} um, half-width {1e3 * width:.2g} nm ({wavelength:g} um"
            faults.append(
                (near, text + (f", {np.degrees(angle):.3g} deg)" if angle else ")"))
            )
    return faults


def _runs(good: Array) -> list[slice]:
    """Runs of True."""
    edges = np.flatnonzero(
        np.diff(np.concatenate([[False], good, [False]]).astype(int))
    )
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _notes(run: slice, d: Array, faults: list[tuple[Array, str]]) -> tuple[str, ...]:
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
