"""Harmonics chosen per entry from the tolerance, with an error estimate from how the result still moves."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.rcwa.case import Case, case_waves
from metalens.rcwa.layer import layer
from metalens.rcwa.stack import respond
from metalens.response import Response

Array = np.ndarray[Any, np.dtype[Any]]
_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False, slots=True)
class Truncated:
    """Results at one truncation, each (d,): transmission, reflection and power of all orders."""

    t: Array
    r: Array
    energy: Array


def truncated(this: Case, diameter_um: Array, harmonics: int, slices: int = 1) -> Truncated:
    """Zero-order amplitudes for (d,) diameters with the orders within ``harmonics``, the wall in equal slices."""
    ways, zero = case_waves(this, harmonics)
    height = this.cell.height_um
    lift = (np.arange(slices) + 0.5) / slices - 0.5
    layers = [
        layer(
            ways,
            diameter_um - 2 * math.tan(this.cell.sidewall_rad) * height * z,
            pitch_um=this.cell.pitch_um,
            pillar=this.pillar,
            between=this.between,
        )
        for z in lift
    ]
    media = dataclasses.replace(this.media, heights=(height * this.k0 / slices,) * slices)
    result = respond(ways, media, layers, zero)
    energy = (np.abs(result.t) ** 2).sum(axis=-1) + (np.abs(result.r) ** 2).sum(axis=-1)
    return Truncated(result.t[:, zero], result.r[:, zero], energy)


def film(this: Case, index: complex) -> Truncated:
    """The exact response of a cell whose pillar layer is a film, for one entry."""
    ways, zero = case_waves(this, 0)
    whole = (index, this.cell.height_um * this.k0)
    media = dataclasses.replace(this.media, over=(whole, *this.media.over), heights=())
    result = respond(ways, media, [], zero)
    energy = np.abs(result.t[zero]) ** 2 + np.abs(result.r[zero]) ** 2
    return Truncated(result.t[zero : zero + 1], result.r[zero : zero + 1], np.array([energy]))


def solve_case(this: Case, diameter_um: Array, *, tolerance: float, harmonics: int | None) -> list[Response]:
    """Responses for (d,) diameters, each at the least truncation of the ladder that meets the tolerance."""
    done: dict[int, Response] = {}
    for i, diameter in enumerate(diameter_um):
        uniform = this.between if diameter == 0 or this.cell.height_um == 0 else this.pillar
        if uniform in (this.between, this.pillar) and (uniform == this.between or this.pillar == this.between):
            done[i] = _film_response(film(this, uniform))
    ladder = _ladder(this, harmonics)
    history: list[Truncated] = []
    left = np.array([i for i in range(len(diameter_um)) if i not in done], int)
    for rung, reach in enumerate(ladder):
        if not len(left):
            break
        slices = 1 if this.cell.sidewall_rad == 0 else _SLICES << rung
        history.append(truncated(this, diameter_um[left], reach, slices))
        if rung == 0:
            continue
        error = _estimate(ladder[: rung + 1], np.array([step.t for step in history]))
        last = rung == len(ladder) - 1
        settled = (error <= tolerance) | last
        for place in map(int, np.flatnonzero(settled)):
            done[int(left[place])] = _response(history[-1], place, reach, float(error[place]), tolerance)
        history = [Truncated(step.t[~settled], step.r[~settled], step.energy[~settled]) for step in history]
        left = left[~settled]
    return [done[i] for i in range(len(diameter_um))]


_SLICES = 3  # of a tilted wall on the first rung, doubled on each further one
_LADDER = {"none": (3, 5, 7), "p": (4, 6, 8, 10, 12), "s": (4, 6, 8, 10, 12), "x": (4, 6, 8, 10, 12, 14, 16)}


def _ladder(this: Case, harmonics: int | None) -> tuple[int, ...]:
    if harmonics is not None:
        return tuple(max(harmonics + step, 1) for step in (-4, -2, 0))
    return _LADDER[this.symmetry]


def _estimate(reach: tuple[int, ...], t: Array) -> Array:
    """Error of the last of the results t (rungs, d), were every truncation error to fall as reach^-2 only.

    Between two rungs that differ by |t - t'| such an error is |t - t'| / ((N / N')² - 1). The largest over the last
    three rungs is taken: single differences may vanish by chance.
    """
    size = np.array(reach, float)
    last = size[-1]
    worst = np.zeros(t.shape[1])
    for i in range(max(0, len(size) - 3), len(size) - 1):
        worst = np.maximum(worst, np.abs(t[-1] - t[i]) / ((last / size[i]) ** 2 - 1))
    return np.asarray(_SAFETY * worst + _ROUNDING)


_SAFETY = 2.0


def _film_response(exact: Truncated) -> Response:
    reason = "a homogeneous layer: exact"
    return Response(
        complex(exact.t[0]), complex(exact.r[0]), _ROUNDING, 1, float(exact.energy[0]), "film", True, reason
    )


def _response(result: Truncated, place: int, reach: int, error: float, tolerance: float) -> Response:
    met = error <= tolerance
    reason = f"orders within {reach}: estimate {'meets' if met else 'above'} the tolerance {tolerance:.3g}"
    t, r, energy = result.t[place], result.r[place], result.energy[place]
    return Response(complex(t), complex(r), error, _disc_orders(reach), float(energy), "rcwa", met, reason)


def _disc_orders(reach: int) -> int:
    m = np.arange(-reach, reach + 1)
    return int(np.count_nonzero(m[:, None] ** 2 + m**2 <= reach**2))
