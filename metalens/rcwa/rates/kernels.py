"""Rates of amplitudes, i ∫ (u~^T dQ u - w~^T dP w) dz, from the fields of the light and
of the waves sent back.

Between two modes there are only divided differences of exponentials, so that equal
propagation constants need no care.
Rows belong to the waves sent back, columns to the light: (b, k) of b and k of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa import made
from metalens.rcwa.rates.regions import LayerRegion, RegionFields, RegionModes
from metalens.rcwa.rates.tables import Change

_NEAR = 0.3  # of the half phase between two modes: below it a series
Integrals = tuple[Array, Array]  # between modes that go the same way, and opposite ways


def in_modes(
    rows: RegionModes, columns: RegionModes, z: tuple[slice, slice], change: Change
) -> tuple[Array, Array]:
    """V~^T dP V and W~^T dQ W; z: where among the waves those of dP stand."""
    first, second = rows.part, columns.part
    left, right = (first.Q @ first.W)[z[0]], (second.Q @ second.W)[z[1]]
    of_P = left.T @ change[0] @ right / (first.q[:, None] * second.q)  # V = Q W / q
    return of_P, first.W.T @ change[1] @ second.W


def upright_rates(
    change: tuple[Array, Array],
    integrals: Integrals,
    sign: int,
    back: RegionFields,
    light: RegionFields,
) -> Array:
    """(b, k) rates for a change :func:`in_modes`; sign: of the integrals between modes
    that go down.
    """
    of_P, of_Q = change
    same, opposite = (of_Q - of_P) * integrals[0], (of_Q + of_P) * integrals[1]
    ups = same @ light.up + opposite @ light.down
    downs = same @ light.down + opposite @ light.up
    return np.asarray(1j * (back.up.T @ ups + sign * back.down.T @ downs))


def mode_integrals(rows: RegionModes, columns: RegionModes) -> Integrals:
    """∫ exp(i (q + p) z) dz and ∫ exp(i q z + i p (h - z)) dz for every pair of modes."""
    q, p, h = rows.part.q[:, None], columns.part.q, columns.height
    same = np.expm1(1j * (q + p) * h) / (1j * (q + p))
    near = np.abs(q - p) * h / 2 < _NEAR
    x = np.where(near, q - p, 0) * h / 2
    middle = np.exp(1j * np.where(near, q + p, 0) * h / 2) * h * np.sinc(x / np.pi)
    return same, np.where(
        near,
        middle,
        (np.exp(1j * q * h) - np.exp(1j * p * h)) / np.where(near, 1, 1j * (q - p)),
    )


def weighted_mode_integrals(rows: RegionModes, columns: RegionModes) -> Integrals:
    """The same with z / h - 1/2 as a factor, i h / 2 j1(y) exp(i (q + p) h / 2), y = (q
    +- p) h / 2: of changes that
    grow from -1/2 at the foot to 1/2 at the top. Between modes that go down it is the
    negative."""
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


@dataclass(frozen=True, eq=False, slots=True)
class GaussStages:
    """All Gauss points of a tilted wall. share: (m, nodes) what a change of each of the
    cross-sections whose polynomial
    the wall is counts there; u, w, u_back, w_back: (m, n, k) and (m, n, b) fields."""

    share: Array
    u: Array
    w: Array
    u_back: Array
    w_back: Array


def gauss_stages(
    rows: LayerRegion, columns: LayerRegion, back: RegionFields, light: RegionFields
) -> GaussStages:
    """Of one wall in two symmetry classes."""
    share, parts = [], []
    for i, (step, other) in enumerate(
        zip(columns.panels, rows.panels_transposed, strict=True)
    ):
        m, n = step.P.shape[:2]
        share.append(
            -step.step * step.weights[:, None] * made.interpolation_weights(step.share)
        )
        here = [
            (part @ light.ends[i + 1]).reshape(m, n, -1) for part in (step.u, step.w)
        ]
        sent = [
            (part @ back.ends[i + 1]).reshape(m, len(other.P[0]), -1)
            for part in (other.u, other.w)
        ]
        parts.append(here + sent)
    u, w, u_back, w_back = (np.concatenate(part) for part in zip(*parts, strict=True))
    return GaussStages(np.concatenate(share), u, w, u_back, w_back)


def tilted_rates(
    this: GaussStages, z: tuple[slice, slice], changes: Sequence[Change | None]
) -> Array:
    """(b, k) rates for a change of every cross-section."""
    total = np.zeros((this.u_back.shape[2], this.u.shape[2]), complex)
    for share, change in zip(this.share.T, changes, strict=True):
        if change is not None:
            total += np.einsum("m,mib,mik->bk", share, this.u_back, change[1] @ this.u)
            total -= np.einsum(
                "m,mib,mik->bk",
                share,
                this.w_back[:, z[0]],
                change[0] @ this.w[:, z[1]],
            )
    return total


def height_rates(this: LayerRegion, back: RegionFields, light: RegionFields) -> Array:
    """(b, k) rates for each unit of reduced height: i (u~^T Q u - w~^T P w)."""
    if isinstance(this.plain, RegionModes) and isinstance(this.transposed, RegionModes):
        part = this.plain.part
        (u, w), (u_back, w_back) = (
            _at_foot(this.plain, light),
            _at_foot(this.transposed, back),
        )
        return np.asarray(1j * (u_back.T @ part.Q @ u - w_back.T @ part.P @ w))
    found, start = gauss_stages(this, this, back, light), 0
    total = np.zeros((found.u_back.shape[2], found.u.shape[2]), complex)
    for step in this.panels:
        at = slice(start, start + len(step.share))
        each = np.einsum(
            "mib,mij,mjk->mbk", found.u_back[at], step.Q, found.u[at], optimize=True
        )
        each = each - np.einsum(
            "mib,mij,mjk->mbk", found.w_back[at], step.P, found.w[at], optimize=True
        )
        total -= step.step / this.height * np.tensordot(step.weights, each, 1)
        start = at.stop
    return total


def _at_foot(side: RegionModes, fields: RegionFields) -> tuple[Array, Array]:
    down = fields.down * np.exp(1j * side.part.q * side.height)[:, None]
    return side.part.W @ (fields.up + down), side.part.V @ (fields.up - down)
