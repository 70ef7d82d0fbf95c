"""Integrals over height of the products of two fields: what a change of P and Q at a height weighs in an amplitude.

For an amplitude with the rate i ∫ (u~^T dQ u - w~^T dP w) dz a :class:`Weight` holds matrices with the rate
sum(of_Q * dQ) + sum(of_P * dP), for a change of the cross-section at one share of the height. Between two modes there
are only divided differences of exponentials, so that equal propagation constants need no care.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from metalens.ground.arrays import Array
from metalens.rcwa import made
from metalens.rcwa.rates.regions import Fields, Modes, Region
from metalens.rcwa.wall import Panel

_NEAR = 0.3  # of the half phase between two modes: below it a series


@dataclass(frozen=True, eq=False, slots=True)
class Weight:
    """share: of the height. of_P, of_Q: (n, n)."""

    share: float
    of_P: Array
    of_Q: Array


@dataclass(frozen=True, eq=False, slots=True)
class Between:
    """What all amplitudes of one pair of symmetry classes share in a region.

    plain, sloped: (same, opposite) integrals between modes of changes alike at every height, and of those that grow
    from -1/2 at the foot to 1/2 at the top; none for tilted walls, and for the latter where nobody asks.
    """

    rows: Region
    columns: Region
    plain: tuple[Array, Array] | None = None
    sloped: tuple[Array, Array] | None = None

    def weights(self, back: Fields, light: Fields) -> list[Weight]:
        """Of an amplitude, from the fields of its wave sent back (rows) and of the light (columns)."""
        rows, columns = self.rows.transposed, self.columns.plain
        if self.plain is None or not (isinstance(rows, Modes) and isinstance(columns, Modes)):
            return _of_wall(self.rows, self.columns, back, light)
        whole = _of_modes(rows, columns, self.plain, 1, back, light)
        if self.sloped is None:
            return [Weight(0.5, *whole)]
        slope = _of_modes(rows, columns, self.sloped, -1, back, light)
        foot, top = ([w / 2 + sign * s for w, s in zip(whole, slope, strict=True)] for sign in (-1, 1))
        return [Weight(0.0, *foot), Weight(1.0, *top)]


def between(rows: Region, columns: Region, *, sloped: bool) -> Between:
    """sloped: also tell changes of foot and top of an upright section apart."""
    if isinstance(rows.transposed, Modes) and isinstance(columns.plain, Modes):
        pair = rows.transposed, columns.plain
        return Between(rows, columns, _plain(*pair), _sloped(*pair) if sloped else None)
    return Between(rows, columns)


def stretch(region: Region, back: Fields, light: Fields) -> complex:
    """Rate of an amplitude for each unit of reduced height: i (u~^T Q u - w~^T P w)."""
    if isinstance(region.plain, Modes) and isinstance(region.transposed, Modes):
        part = region.plain.part
        (u, w), (u_back, w_back) = _at_foot(region.plain, light), _at_foot(region.transposed, back)
        return complex(1j * (u_back @ part.Q @ u - w_back @ part.P @ w))
    total = 0j
    for step, (u, w), (u_back, w_back) in _stages(region, region, back, light):
        each = np.einsum("ki,kij,kj->k", u_back, step.Q, u) - np.einsum("ki,kij,kj->k", w_back, step.P, w)
        total -= step.step * (step.weights @ each) / region.height
    return complex(total)


def _at_foot(side: Modes, fields: Fields) -> tuple[Array, Array]:
    part, down = side.part, fields.down * np.exp(1j * side.part.q * side.height)
    return part.W @ (fields.up + down), part.V @ (fields.up - down)


def _of_modes(
    rows: Modes, columns: Modes, integrals: tuple[Array, Array], sign: int, back: Fields, light: Fields
) -> tuple[Array, Array]:
    """(P, Q) from the integrals over modes that go the same way and opposite ways; sign: of those that go down."""
    even = integrals[0] * (np.outer(back.up, light.up) + sign * np.outer(back.down, light.down))
    odd = integrals[1] * (np.outer(back.up, light.down) + sign * np.outer(back.down, light.up))
    first, second = rows.part, columns.part
    turned = (even - odd) / (first.q[:, None] * second.q)  # V = Q W / q
    of_P = times(times(first.Q @ first.W, turned), (second.Q @ second.W).T)
    return -1j * of_P, 1j * times(times(first.W, even + odd), second.W.T)


def times(a: Array, b: Array) -> Array:
    """Matrix product; of a real and a complex matrix by two real ones, which is twice as fast."""
    if np.iscomplexobj(a) == np.iscomplexobj(b):
        return np.asarray(a @ b)
    return np.asarray(a @ b.real + 1j * (a @ b.imag) if np.iscomplexobj(b) else a.real @ b + 1j * (a.imag @ b))


def _plain(rows: Modes, columns: Modes) -> tuple[Array, Array]:
    """∫ exp(i (q + p) z) dz and ∫ exp(i q z + i p (h - z)) dz for every pair of modes."""
    q, p, h = rows.part.q[:, None], columns.part.q, columns.height
    same = np.expm1(1j * (q + p) * h) / (1j * (q + p))
    near = np.abs(q - p) * h / 2 < _NEAR
    x = np.where(near, q - p, 0) * h / 2
    middle = np.exp(1j * np.where(near, q + p, 0) * h / 2) * h * np.sinc(x / np.pi)
    return same, np.where(near, middle, (np.exp(1j * q * h) - np.exp(1j * p * h)) / np.where(near, 1, 1j * (q - p)))


def _sloped(rows: Modes, columns: Modes) -> tuple[Array, Array]:
    """The same with z / h - 1/2 as a factor: i h / 2 j1(y) exp(i (q + p) h / 2), y = (q +- p) h / 2."""
    q, p, h = rows.part.q[:, None], columns.part.q, columns.height
    middle = np.exp(1j * (q + p) * h / 2)

    def moment(y: Array, high: Array, low: Array) -> Array:
        near = np.abs(y) < _NEAR
        small, safe = np.where(near, y, 0), np.where(near, 1, y)
        series = small / 3 - small**3 / 30 + small**5 / 840 - small**7 / 45360
        far = (high - low) / (2j * safe**2) - (high + low) / (2 * safe)
        return np.asarray(0.5j * h * np.where(near, middle * series, far))

    return moment((q + p) * h / 2, middle**2, np.ones(1)), moment(
        (q - p) * h / 2, np.exp(1j * q * h), np.exp(1j * p * h)
    )


def _of_wall(rows: Region, columns: Region, back: Fields, light: Fields) -> list[Weight]:
    """Of the cross-sections whose polynomial in z the wall is."""
    of_P, of_Q = [0j] * len(made.nodes()), [0j] * len(made.nodes())
    for step, (u, w), (u_back, w_back) in _stages(rows, columns, back, light):
        shares = -step.step * step.weights[:, None] * made.weights(step.share)
        for node, share in enumerate(shares.T):
            of_Q[node] = of_Q[node] + u_back.T @ (share[:, None] * u)
            of_P[node] = of_P[node] - w_back.T @ (share[:, None] * w)
    return [Weight(float(s), P, Q) for s, P, Q in zip(made.nodes(), of_P, of_Q, strict=True)]


def _stages(
    rows: Region, columns: Region, back: Fields, light: Fields
) -> Iterator[tuple[Panel, tuple[Array, Array], tuple[Array, Array]]]:
    """Every panel with the (m, n) fields (u, w) of the light and of the wave sent back at its Gauss points."""
    for i, (step, other) in enumerate(zip(columns.panels, rows.panels_transposed, strict=True)):
        count = len(step.share)
        here = [(part @ light.ends[i + 1]).reshape(count, -1) for part in (step.u, step.w)]
        sent = [(part @ back.ends[i + 1]).reshape(count, -1) for part in (other.u, other.w)]
        yield step, (here[0], here[1]), (sent[0], sent[1])
