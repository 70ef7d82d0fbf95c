"""Transverse waves of the homogeneous media, in the orders of one basis; tangential
fields are expanded in them.

With lengths in units of 1/k0 (k0 = 2 pi / wavelength), u = (Ex, Ey) and w = (Hy, -Hx)
obey, in any medium,

    u' = i P w,  P = 1 - K [eps]^-1 K^T,   K = (kx, ky)        (from Ez = -[eps]^-1 K^T w)
    w' = i Q u,  Q = E - R R^T,            R = (-ky, kx)       (from Hz = R^T u)

P and Q are symmetric, also in absorbing media. A p wave has u along k = (kx, ky), an s
wave across it, so that K^T and
R^T become the bare length of k. In a homogeneous medium an outgoing wave of unit
electric amplitude has, with
kz² = eps - |k|²:   p: u = kz / n, w = n;   s: u = 1, w = kz.  No form divides by kz, so kz = 0 needs no care.
"""

from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa.orders.basis import DiscBasis, DiscOrders


@dataclass(frozen=True, eq=False, slots=True)
class PlaneWaves:
    """The waves of a basis at one wavelength and direction: all p waves, then all s
    waves.

    m, n: (n,) orders; kappa: (n,) |k| / k0; along: (2, n) direction of k.
    p_count: number of p waves.
    bare: number of leading p waves that have no Ez at all (the zero order at normal
    incidence, E along x).
    fold: (ex + ey, n) orthogonal matrix from the waves to Ex and Ey.
    zero_p, zero_s: place of the zero order, -1 where the symmetry excludes it.
    """

    space: DiscBasis
    m: Array
    n: Array
    kappa: Array
    along: Array
    p_count: int
    bare: int
    fold: Array
    zero_p: int
    zero_s: int


def plane_waves(
    space: DiscBasis,
    *,
    pitch_um: float,
    wavelength_um: float,
    kx: float,
    ky: float,
    azimuth_rad: float,
) -> PlaneWaves:
    """The waves around the zero order (kx, ky) / k0, whose azimuth gives the direction
    of E where k vanishes.
    """
    step = wavelength_um / pitch_um
    bare = int(space.symmetry == "x")
    ex, ey, ez, hz = space.ex, space.ey, space.ez, space.hz
    m = np.concatenate([np.zeros(bare, int), ez.m, hz.m])
    n = np.concatenate([np.zeros(bare, int), ez.n, hz.n])
    k = np.stack([kx + step * m, ky + step * n])
    kappa = np.hypot(*k)
    straight = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])[:, None]
    along = np.where(kappa > 0, k / np.where(kappa > 0, kappa, 1.0), straight)
    p_count = bare + len(ez.m)
    e = np.where(np.arange(len(m)) < p_count, along, np.stack([-along[1], along[0]]))
    fold = np.concatenate([_place(ex, m, n) * e[0], _place(ey, m, n) * e[1]])
    zero_p, zero_s = _zero(m, n, 0, p_count), _zero(m, n, p_count, len(m))
    return PlaneWaves(space, m, n, kappa, along, p_count, bare, fold, zero_p, zero_s)


def normal_component(kappa: Array, index: complex) -> Array:
    """kz / k0 = sqrt(n² - kappa²) of outgoing or decaying waves: positive real or
    imaginary part.
    """
    square = (index - kappa) * (index + kappa)
    kz = np.sqrt(square.astype(complex))
    return np.asarray(np.where(kz.imag < 0, -kz, kz))


def half_space(basis_waves: PlaneWaves, index: complex) -> tuple[Array, Array]:
    """(u, w) of the outgoing waves of unit electric amplitude; (u, -w) are the incoming
    ones.
    """
    kz = normal_component(basis_waves.kappa, index)
    is_p = np.arange(len(kz)) < basis_waves.p_count
    return np.where(is_p, kz / index, 1.0), np.where(is_p, index, kz)


def _place(rows: DiscOrders, m: Array, n: Array) -> Array:
    return np.asarray((rows.m[:, None] == m) & (rows.n[:, None] == n), float)


def _zero(m: Array, n: Array, start: int, stop: int) -> int:
    found = np.flatnonzero((m[start:stop] == 0) & (n[start:stop] == 0))
    return int(start + found[0]) if len(found) else -1
