"""Harmonics chosen per entry from the tolerance, with an error estimate from how the
result still moves.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from metalens.cell import Response
from metalens.core.arrays import Array
from metalens.rcwa import wall
from metalens.rcwa.conditions import DiscCase, case_waves, taper_um
from metalens.rcwa.layer import disc_operators, solve_eigenmodes
from metalens.rcwa.orders.waves import PlaneWaves
from metalens.rcwa.stack import ScatteredAmplitudes, scatter_zero_order

Moved = Callable[[Array], Array]
_ROUNDING = 1e-13
# of a matrix of all diameters that are solved together: below 0.5 GB with all its
# companions
_ENTRIES = 1_500_000


@dataclass(frozen=True, eq=False, slots=True)
class TruncatedResponse:
    """Results at one truncation, each (d,): transmission, reflection and power of all
    orders.
    """

    t: Array
    r: Array
    energy: Array

    @property
    def both(self) -> Array:
        """(2, d) t and r."""
        return np.stack([self.t, self.r])


def solve_truncated(
    this: DiscCase,
    diameter_um: Array,
    harmonics: int,
    stages: int = 0,
    *,
    moved: Moved | None = None,
) -> TruncatedResponse:
    """Zero-order amplitudes for (d,) diameters with the orders within ``harmonics``.

    stages: of the collocation of a tilted wall, see :mod:`metalens.rcwa.wall`; 0:
    upright.
    moved: diameter of a cross-section to the one that is taken for it.
    """
    ways, zero = case_waves(this, harmonics)
    size = 1 if stages else max(1, _ENTRIES // len(ways.kappa) ** 2)
    found = []
    for start in range(0, len(diameter_um), size):
        some = diameter_um[start : start + size]
        if stages:
            found.append(_tilted(this, ways, zero, float(some[0]), stages, moved))
            continue
        media = dataclasses.replace(
            this.media, heights=(this.cell.height_um * this.k0,)
        )
        wide = moved(some) if moved else some
        part = solve_eigenmodes(
            *disc_operators(ways, wide, this.cell.pitch_um, this.pillar, this.between)
        )
        found.append(scatter_zero_order(ways, media, [part], zero))
    t, r = (
        np.concatenate([np.atleast_2d(getattr(part, name)) for part in found])
        for name in ("t", "r")
    )
    energy = (np.abs(t) ** 2).sum(axis=-1) + (np.abs(r) ** 2).sum(axis=-1)
    return TruncatedResponse(t[:, zero], r[:, zero], energy)


def _tilted(
    this: DiscCase,
    ways: PlaneWaves,
    zero: int,
    diameter_um: float,
    stages: int,
    moved: Moved | None,
) -> ScatteredAmplitudes:
    """One pillar with a tilted wall."""

    def sample(share: float) -> tuple[Array, Array]:
        wide = np.array([diameter_um + (share - 0.5) * taper_um(this.cell)])
        here = disc_operators(
            ways,
            moved(wide) if moved else wide,
            this.cell.pitch_um,
            this.pillar,
            this.between,
        )
        return here[0][0], here[1][0]

    whole = [wall.TiltedWall(sample, this.cell.height_um * this.k0)]
    between = functools.partial(wall.match_walls, whole, stages=stages)
    return scatter_zero_order(ways, this.media, [], zero, between=between)


def film_response(this: DiscCase, index: complex) -> TruncatedResponse:
    """The exact response of a cell whose pillar layer is a film, for one entry."""
    ways, zero = case_waves(this, 0)
    whole = (index, this.cell.height_um * this.k0)
    media = dataclasses.replace(this.media, over=(whole, *this.media.over), heights=())
    result = scatter_zero_order(ways, media, [], zero)
    energy = np.abs(result.t[zero]) ** 2 + np.abs(result.r[zero]) ** 2
    return TruncatedResponse(
        result.t[zero : zero + 1], result.r[zero : zero + 1], np.array([energy])
    )


def solve_case(
    this: DiscCase, diameter_um: Array, *, tolerance: float, harmonics: int | None
) -> list[Response]:
    """Responses for (d,) diameters, each at the least truncation that meets the
    tolerance.
    """
    empty = film_response(this, this.between)
    rounding = _ROUNDING * (1 + this.k0 * this.cell.height_um)  # of the phase
    done = {
        int(i): _exact(empty, rounding)
        for i in np.flatnonzero(is_homogeneous(this, diameter_um))
    }
    left = np.array([i for i in range(len(diameter_um)) if i not in done], int)
    stages, cut = wall_stages(this, diameter_um[left], tolerance)
    share = diameter_um / this.cell.pitch_um
    lags = compared_truncations(np.minimum(share, 1 - share))
    before = int(lags[left].max(initial=_COMPARED))
    ladder = _ladder(this, harmonics, before)
    history: list[Array] = []
    for reach in ladder:
        if not len(left):
            break
        wide = diameter_um[left]
        found = solve_truncated(this, wide, reach, stages)
        history.append(found.both)
        if len(history) <= before and reach != ladder[-1]:
            continue
        change = np.maximum(np.abs(found.t - empty.t), np.abs(found.r - empty.r))
        crowded = gap_factor(this.cell.pitch_um - wide, this.cell.pitch_um)
        estimate = crowded * _estimate(np.array(history), reach, lags[left])
        error = np.minimum(
            _blur(this, wide, reach, change, estimate) + cut, largest_error(found.both)
        )
        settled = (error <= tolerance) | (reach == ladder[-1])
        chosen = np.flatnonzero(settled)
        found = TruncatedResponse(
            found.t[chosen], found.r[chosen], found.energy[chosen]
        )
        for row, place in enumerate(chosen):
            done[int(left[place])] = _response(
                found, row, reach, float(error[place]), tolerance
            )
        history = [both[:, ~settled] for both in history]
        left = left[~settled]
    return [done[i] for i in range(len(diameter_um))]


def largest_error(both: Array) -> Array:
    """Most that t and r along the first axis may be wrong by: the true ones of a
    passive cell are 1 at most.
    """
    return np.asarray(1 + np.maximum(1.0, np.abs(both).max(0)))


_FIRST = 4  # orders of the first truncation, too few for any use but to see t move
_LAST = {"x": 16, "p": 12, "s": 12, "none": 8}  # about a second a solve
_COMPARED, MOST_COMPARED = 4, 6  # truncations before, that an error looks at
_SWING = (
    0.75  # of the swing of truncations with the number of orders in the narrowest width
)
_SAFETY = 3.0  # from _ENOUGH orders on
_MORE, _ENOUGH = 0.6, 13  # and so much more for each order below
_CUSPS, NARROWEST = (
    5.0,
    0.02,
)  # more for pillars that touch, and the share of the pitch below which gaps count
_COARSE = 4  # orders that suffice to see what the collocation of a tilted wall leaves


def _ladder(this: DiscCase, harmonics: int | None, before: int) -> range:
    """Truncations to try; the first that may be the last one has ``before`` below it."""
    if harmonics is None:
        return range(_FIRST + _COMPARED - before, _LAST[this.symmetry] + 1)
    return range(max(harmonics - before, 1), harmonics + 1)


def compared_truncations(width: float | Array) -> Array:
    """How many truncations before the last are looked at, by the narrower of pillar and
    gap (in pitches): 4 to 6.

    Errors swing with the orders that fit into it, once in 1 / width of them. Of discs
    of 0.1 to 0.2 pitches, and of
    gaps so narrow, four truncations see a part of a swing alone: at 8 to 11 orders the
    error was up to 8.5 times the
    farthest of four (5 of 380 above its bar), and up to twice the farthest of so many.
    Below a fiftieth of the pitch
    :func:`gap_factor` stands for it, and discs so thin are not resolved.
    """
    width = np.asarray(width)
    swing = np.clip(
        np.ceil(_SWING / np.maximum(width, NARROWEST)), _COMPARED, MOST_COMPARED
    )
    return np.where(width < NARROWEST, _COMPARED, swing).astype(int)


def safety_factor(reach: int) -> float:
    """How many times the farthest of the truncations before an error may be, at this
    many orders.
    """
    return _SAFETY + _MORE * max(0, _ENOUGH - reach)


def gap_factor(gap_um: float | Array, pitch_um: float) -> Array:
    """Factor on :func:`safety_factor` for pillars that all but touch: fields between
    them are
    seen late by any order.

    Gaps of 40 pm in a pitch of 0.4 um: at 14 orders the error is 15 times the farthest
    truncation. The factor is 1
    from a fiftieth of the pitch on.
    """
    return np.asarray(
        1 + _CUSPS * np.clip(1 - np.asarray(gap_um) / (NARROWEST * pitch_um), 0, 1)
    )


def _estimate(t: Array, reach: int, lags: Array) -> Array:
    """Error of the last of the results, t and r (rungs, 2, d): some times the farthest
    of the truncations before.

    lags: (d,) how many, see :func:`compared_truncations`. Truncation errors fall as
    reach^-2 and
    swing with the number of orders
    that fit across the disc; a swing takes up to four rungs where nothing is narrow.
    For 52 diameters in three cells
    at 8 to 16 orders, and for 86 random cells (pitch, height, index, absorption,
    wavelength, diameter), the true error
    was 0.4 of the farthest distance in the median and 2.7 of it at most. With few
    orders it is more: up to 4.8 of it
    below 8, and with a factor of 3 at 8 to 10 orders 3 of 200 cells (``python -m
    benchmarks engines``) lay apart from
    the modal method by up to 1.5 times both bars. Hence :func:`safety_factor`: 6 at 8
    orders,
    3 from 13 on.
    """
    if len(t) < 2:
        return np.full(t.shape[2], np.inf)
    moved = np.abs(t[-1] - t[:-1]).max(axis=1)
    age = np.arange(len(moved), 0, -1)[:, None]
    return np.asarray(
        safety_factor(reach) * np.where(age <= lags, moved, 0.0).max(axis=0) + _ROUNDING
    )


def _blur(
    this: DiscCase, diameter_um: Array, reach: int, change: Array, error: Array
) -> Array:
    """Where the orders do not resolve the pillar, none of its effect (d,) is believed."""
    return np.where(
        reach * diameter_um < this.cell.pitch_um, np.maximum(error, change), error
    )


def wall_stages(
    this: DiscCase, diameter_um: Array, tolerance: float
) -> tuple[int, float]:
    """Stages of a tilted wall and the error they leave, the same at all orders; (0, 0)
    where it is upright.
    """
    if not (len(diameter_um) and this.cell.sidewall_rad):
        return 0, 0.0
    return wall.choose_stage_count(
        lambda stages: solve_truncated(this, diameter_um, _COARSE, stages).both,
        tolerance,
    )


def is_homogeneous(this: DiscCase, diameter_um: Array) -> Array:
    """Where the pillar layer is a film to rounding: (d,) truth values."""
    share = math.pi / 4 * (diameter_um / this.cell.pitch_um) ** 2
    effect = (
        share * abs(this.pillar**2 - this.between**2) * this.k0 * this.cell.height_um
    )
    return np.asarray(effect < _ROUNDING)


def _exact(exact: TruncatedResponse, rounding: float) -> Response:
    reason = "a homogeneous layer: exact"
    return Response(
        complex(exact.t[0]),
        complex(exact.r[0]),
        rounding,
        1,
        float(exact.energy[0]),
        "film",
        True,
        reason,
    )


def _response(
    result: TruncatedResponse, place: int, reach: int, error: float, tolerance: float
) -> Response:
    met = error <= tolerance
    reason = f"orders within {reach}: estimate {'meets' if met else 'above'} the tolerance {tolerance:.3g}"
    t, r, energy = result.t[place], result.r[place], result.energy[place]
    return Response(
        complex(t),
        complex(r),
        error,
        _disc_orders(reach),
        float(energy),
        "rcwa",
        met,
        reason,
    )


def _disc_orders(reach: int) -> int:
    m = np.arange(-reach, reach + 1)
    return int(np.count_nonzero(m[:, None] ** 2 + m**2 <= reach**2))
