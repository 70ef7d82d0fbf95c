"""Modes of a layer that holds one round pillar, by RCWA with normal-vector
factorisation.

The tangential field is split at the rim into a normal part, where D is continuous, and
a tangential part, where E is
(Li, J. Opt. Soc. Am. A 13, 1870 (1996); Popov and Neviere, J. Opt. Soc. Am. A 18, 2886
(2001)):

    E = [eps] - (Delta N + N Delta) / 2,   Delta = [eps] - [1/eps]^-1,   N = n n^T of the radial unit field n.
"""

from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa.orders import basis as fourier
from metalens.rcwa.orders.waves import PlaneWaves, normal_component


@dataclass(frozen=True, eq=False, slots=True)
class FourierModes:
    """Operators and modes of pillar layers; leading axes are a batch of diameters.

    P, Q: (*batch, n, n) u' = i P w, w' = i Q u.
    q: (*batch, n) propagation constants over k0, imaginary part >= 0, the longest-lived
    first.
    W, V: (*batch, n, n) columns u and w of the upward modes (u, -w: downward).
    symmetric: whether P and Q are (sections alike under a half turn).
    """

    P: Array
    Q: Array
    q: Array
    W: Array
    V: Array
    symmetric: bool = True


def solve_eigenmodes(P: Array, Q: Array, *, symmetric: bool = True) -> FourierModes:
    """The modes of a layer with these operators. Everything stays real where nothing
    absorbs, but for q and V.
    """
    q2, W = np.linalg.eig(P @ Q)
    q = np.sqrt(q2.astype(complex))
    q = np.where(
        (q.imag < 0) | ((np.abs(q.imag) <= 1e-13 * np.abs(q)) & (q.real < 0)), -q, q
    )
    q = np.where(np.abs(q) < _TINY, _TINY, q)
    order = np.argsort(q.imag, axis=-1, kind="stable")
    q = np.take_along_axis(q, order, axis=-1)
    W = np.take_along_axis(W, order[..., None, :], axis=-1)
    return FourierModes(P, Q, q, W, (Q @ W) / q[..., None, :], symmetric)


_TINY = 1e-9  # a mode exactly at its cut-off: up and down waves may not coincide


def film_layer(
    ways: PlaneWaves, index: complex, *, symmetric: bool = True
) -> FourierModes:
    """A homogeneous layer with its plane waves as modes, the longest-lived first.

    symmetric: whether P and Q of all layers that it is matched with are.
    """
    kz = normal_component(ways.kappa, index)
    kz = np.where(np.abs(kz) < _TINY, _TINY, kz)
    is_p = np.arange(len(kz)) < ways.p_count
    P, Q = np.where(is_p, kz**2 / index**2, 1.0), np.where(is_p, index**2, kz**2)
    order = np.argsort(kz.imag, kind="stable")
    return FourierModes(
        np.diag(P),
        np.diag(Q),
        kz[order],
        np.eye(len(kz))[:, order],
        np.diag(Q / kz)[:, order],
        symmetric,
    )


def disc_operators(
    ways: PlaneWaves,
    diameter_um: Array,
    pitch_um: float,
    pillar: complex,
    between: complex,
) -> tuple[Array, Array]:
    """P and Q of :mod:`metalens.rcwa.orders.waves` for a batch of diameters; real where
    nothing absorbs (exp(-iwt)).
    """
    space = ways.space
    shape = fourier.disc_coefficients(space, diameter_um, pitch_um)
    inside, outside = _real_if_lossless(pillar**2, between**2)
    start = space.shells == 0
    direct = (inside - outside) * shape + outside * start
    inverse = (1 / inside - 1 / outside) * shape + start / outside
    ex, ey = (
        factorised_permittivity(space, direct, inverse, link)
        for link in (fourier.EX, fourier.EY)
    )
    E = join_blocks(
        ways,
        (ex[0], ey[0]),
        (ex[1], ey[1]),
        fourier.disc_normal_matrices(space, diameter_um, pitch_um),
    )
    s = np.arange(ways.p_count, len(ways.kappa))
    E[..., s, s] -= ways.kappa[s] ** 2
    P = np.zeros_like(E)
    P[..., :, :] = np.eye(len(ways.kappa))
    z = slice(ways.bare, ways.p_count)
    kappa = ways.kappa[z]
    P[..., z, z] -= (
        kappa[:, None]
        * np.linalg.inv(fourier.toeplitz_matrix(space, direct, fourier.EZ))
        * kappa
    )
    return P, E


def factorised_permittivity(
    space: fourier.DiscBasis, direct: Array, inverse: Array, link: int
) -> tuple[Array, Array]:
    """[eps] and Delta = [eps] - [1/eps]^-1 in the orders of Ex or Ey."""
    laurent = fourier.toeplitz_matrix(space, direct, link)
    return laurent, laurent - np.linalg.inv(
        fourier.toeplitz_matrix(space, inverse, link)
    )


def join_blocks(
    ways: PlaneWaves,
    laurent: tuple[Array, Array],
    delta: tuple[Array, Array],
    normal: tuple[Array, ...],
) -> Array:
    """E = [eps] - (Delta N + N Delta) / 2 in the waves, from the blocks in Ex and Ey
    and N = (xx, yy, xy).
    """
    xx, yy, xy = normal
    top = laurent[0] - _symmetric(delta[0] @ xx)
    bottom = laurent[1] - _symmetric(delta[1] @ yy)
    mixed = -0.5 * (delta[0] @ xy + xy @ delta[1])
    rows = (
        np.concatenate([top, mixed], axis=-1),
        np.concatenate([np.swapaxes(mixed, -1, -2), bottom], axis=-1),
    )
    return np.asarray(ways.fold.T @ np.concatenate(rows, axis=-2) @ ways.fold)


def _symmetric(a: Array) -> Array:
    return np.asarray(0.5 * (a + np.swapaxes(a, -1, -2)))


def _real_if_lossless(inside: complex, outside: complex) -> tuple[complex, complex]:
    return (
        (inside.real, outside.real)
        if inside.imag == outside.imag == 0
        else (inside, outside)
    )
