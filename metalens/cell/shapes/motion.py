"""How the Fourier factors of an outline change when its rim moves: ∮ exp(-i g r) v·n
ds, exact for every part.

The numbers of a part are (half_x, half_y, angle) of an ellipse and the corners (x, y)
of a polygon. Edges of a polygon
move as their corners do, linearly between them, so the integral over an edge d with the
middle m is, h = g d / 2,

    dF / d(corner) = (d_y, -d_x) exp(-i g m) (j0(h) -+ i j1(h)) / 2      (- at its end, + at its start).
"""

import math
from collections.abc import Callable

import numpy as np

from metalens.cell.shapes.outline import EllipseArc, Outline, PolygonLoop
from metalens.core.arrays import Array
from metalens.core.errors import CellError

_STENCIL = (
    (1, 45 / 60),
    (2, -9 / 60),
    (3, 1 / 60),
)  # central differences of sixth order


def shape_parameters(outline: Outline) -> Array:
    """(k,) numbers of all parts, one after another."""
    return np.concatenate([_numbers(part) for part in outline.parts])


def fourier_shape_derivative(
    outline: Outline, gx: Array, gy: Array, rates: Array
) -> Array:
    """(n,) derivatives of the Fourier factor at the wave vectors (n,), as the (k,)
    numbers change at these rates.
    """
    g, start = np.stack([gx, gy], axis=-1), 0
    total = np.zeros(len(g), complex)
    for part in outline.parts:
        count = len(_numbers(part))
        of = _conic if isinstance(part, EllipseArc) else _loop
        total += of(part, g, rates[start : start + count].real)  # type: ignore[arg-type]
        start += count
    return total


def sixth_order_difference(of: Callable[[float], Array], step: float) -> Array:
    """Derivative at 0 of elementary functions, by differences of sixth order: 1e-11 of
    their size over the step's.

    Raises:
        CellError: values of another length on either side, as where a hole closes.
    """
    ends = [(weight, of(k * step), of(-k * step)) for k, weight in _STENCIL]
    if len({np.shape(value) for _, *pair in ends for value in pair}) > 1:
        raise CellError(
            "an outline that is just losing or gaining a part has no derivative; need another size or bias"
        )
    return np.asarray(sum(weight * (high - low) for weight, high, low in ends) / step)


def _numbers(part: EllipseArc | PolygonLoop) -> Array:
    if isinstance(part, EllipseArc):
        return np.array([part.half_x_um, part.half_y_um, part.angle_rad])
    return np.array(part.corners_um, float).ravel()


def _conic(part: EllipseArc, g: Array, rates: Array) -> Array:
    """From F = pi a b 2 J1(s) / s, s = |(a X, b Y)|, with d(2 J1(s) / s) / ds = -2
    J2(s) / s.
    """
    from scipy.special import jv

    a, b = part.half_x_um, part.half_y_um
    c, s = math.cos(part.angle_rad), math.sin(part.angle_rad)
    x, y = c * g[:, 0] + s * g[:, 1], c * g[:, 1] - s * g[:, 0]
    reach = np.hypot(a * x, b * y)
    small = reach < 1e-3
    safe = np.where(small, 1.0, reach)
    value = np.where(small, 1 - reach**2 / 8, 2 * jv(1, safe) / safe)
    slope = np.where(
        small, -0.25, -2 * jv(2, safe) / safe**2
    )  # of the value, by s, over s; counts with s²
    along, across = (
        b * (value + slope * (a * x) ** 2),
        a * (value + slope * (b * y) ** 2),
    )
    turn = a * b * slope * (a - b) * (a + b) * x * y
    return np.asarray(
        part.sign * math.pi * (rates[0] * along + rates[1] * across + rates[2] * turn)
    )


def _loop(part: PolygonLoop, g: Array, rates: Array) -> Array:
    points, speed = np.array(part.corners_um, float), rates.reshape(-1, 2)
    after = np.roll(points, -1, axis=0)
    edge = after - points
    turn = part.sign * math.copysign(
        1.0, float((points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]).sum())
    )
    normal = turn * np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    start, end = ((normal * v).sum(axis=1) for v in (speed, np.roll(speed, -1, axis=0)))
    half = g @ edge.T / 2
    moment = np.sinc(half / np.pi) * (start + end) / 2 + 0.5j * _j1(half) * (
        start - end
    )
    return np.asarray((np.exp(-1j * (g @ (points + edge / 2).T)) * moment).sum(axis=1))


def _j1(x: Array) -> Array:
    """Spherical Bessel function sin x / x² - cos x / x."""
    small = np.abs(x) < 0.05
    safe = np.where(small, 1.0, x)
    return np.where(
        small,
        x / 3 - x**3 / 30 + x**5 / 840,
        (np.sin(safe) / safe - np.cos(safe)) / safe,
    )
