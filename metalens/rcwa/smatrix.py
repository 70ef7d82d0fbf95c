"""Eigenmodes of layers, and the scattering of a whole stack: half-spaces, films and
patterned layers, matched without growing exponentials.
"""

import math
import sys
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa.basis import PlaneWaves, half_space, normal_component

Pair = tuple[Array, Array]
# q of a mode exactly at its cut-off, where q² is rounding: up and down waves differ
_TINY = math.sqrt(sys.float_info.epsilon)


@dataclass(frozen=True, eq=False, slots=True)
class FourierModes:
    """Eigenmodes of one layer, u' = i P w, w' = i Q u.

    height: of the layer, times k0. Q: (n, n). q: (n,) propagation constants over k0,
        imaginary part >= 0, the longest-lived first.
    W, V: (n, n) columns u and w of the upward modes (u, -w: downward).
    """

    height: float
    Q: Array
    q: Array
    W: Array
    V: Array


def solve_eigenmodes(P: Array, Q: Array, height: float) -> FourierModes:
    """Eigenmodes of a layer: P Q W = W q^2, V = Q W / q.

    Args:
        P, Q: (n, n) operators. height: of the layer, times k0.
    """
    square, W = np.linalg.eig(P @ Q)
    q = np.sqrt(square.astype(complex))
    downward = (q.imag < 0) | ((np.abs(q.imag) <= 1e-13 * np.abs(q)) & (q.real < 0))
    q = np.where(downward, -q, q)
    q = np.where(np.abs(q) < _TINY, _TINY, q)
    order = np.argsort(q.imag, kind="stable")
    q, W = q[order], W[:, order]
    return FourierModes(height, Q, q, W, (Q @ W) / q)


def film_modes(waves: PlaneWaves, index: complex, height: float) -> FourierModes:
    """Plane ``waves`` as modes of a homogeneous layer of this ``index`` and ``height``
    (times k0).
    """
    kz = normal_component(waves.kappa, index)
    kz = np.where(np.abs(kz) < _TINY, _TINY, kz)
    Q = np.where(waves.is_p, index**2, kz**2)
    order = np.argsort(kz.imag, kind="stable")
    W, V = np.eye(len(kz))[:, order], np.diag(Q / kz)[:, order]
    return FourierModes(height, np.diag(Q), kz[order], W, V)


@dataclass(frozen=True, eq=False, slots=True)
class ScatteredAmplitudes:
    """Power-normalised amplitudes (n,) of every order for unit incident power in the
    zero order.

    t, r: of the outgoing waves in cover and substrate, 0 where a wave carries no power.
    """

    t: Array
    r: Array

    @property
    def energy(self) -> float:
        """Transmitted plus reflected power of all orders."""
        return float((np.abs(self.t) ** 2).sum() + (np.abs(self.r) ** 2).sum())


@dataclass(frozen=True, eq=False, slots=True)
class TangentialFields:
    """Tangential fields of one incident wave.

    u, w: (n,) at the foot of the lowest layer; u_top, w_top: at the top of the highest.
    up, down: for each layer, (n,) amplitudes of its upward modes at its foot and
        downward modes at its top.
    """

    u: Array
    w: Array
    u_top: Array
    w_top: Array
    up: list[Array]
    down: list[Array]


def scatter_zero_order(
    waves: PlaneWaves,
    indices: tuple[complex, complex],
    layers: list[FourierModes],
    zero: int,
    *,
    symmetric: bool = True,
) -> ScatteredAmplitudes:
    """Transmitted and reflected orders of a stack for the zero order from the
    substrate.

    Args:
        waves: of the basis. indices: of substrate and cover.
        layers: modes of films and patterned layers, foot first.
        zero: place of the incident wave. symmetric: as in :func:`match_layers`.
    """
    below, above = (half_space(waves, index) for index in indices)
    incident = np.arange(len(waves.kappa)) == zero
    source = 2 * below[0] * below[1] * incident
    fields = match_layers(layers, above, below, source, symmetric=symmetric)
    t = outgoing_amplitudes(above, fields.u_top, fields.w_top)
    r = outgoing_amplitudes(
        below, fields.u - below[0] * incident, below[1] * incident - fields.w
    )
    power = power_flux(below)[zero]
    return ScatteredAmplitudes(
        t * np.sqrt(power_flux(above) / power), r * np.sqrt(power_flux(below) / power)
    )


def outgoing_amplitudes(pair: Pair, u: Array, w: Array) -> Array:
    """Amplitudes a of a diagonal ``pair`` (U, V) with u = U a, w = V a, by least
    squares.
    """
    norm = np.abs(pair[0]) ** 2 + np.abs(pair[1]) ** 2
    return np.asarray((np.conj(pair[0]) * u + np.conj(pair[1]) * w) / norm)


def match_layers(
    layers: list[FourierModes], top: Pair, foot: Pair, source: Array, *, symmetric: bool
) -> TangentialFields:
    """Fields that radiate into ``top`` above the layers and satisfy foot V u + U w =
    source below.

    From the top down, the reflection of every layer gives an outgoing pair at its foot.
    From the foot up, the amplitudes of the modes follow.

    Args:
        layers: modes, foot first.
        top, foot: diagonal pairs (U, V) above and below. source: (n,).
        symmetric: whether the operators of all layers are.
    """
    pair = np.diag(top[0]), np.diag(top[1])
    reflections = []
    for modes in reversed(layers):
        reflection, fade = _layer_reflection(modes, pair, symmetric)
        reflections.append((reflection, fade))
        pair = _foot_pair(modes, reflection, fade)
    a = np.linalg.solve(foot[1][:, None] * pair[0] + foot[0][:, None] * pair[1], source)
    u, w = pair[0] @ a, pair[1] @ a
    u_top, w_top, ups, downs = u, w, [], []
    for i, (modes, (reflection, fade)) in enumerate(
        zip(layers, reversed(reflections), strict=True)
    ):
        if i:
            a = (np.linalg.solve(modes.W, u_top) + np.linalg.solve(modes.V, w_top)) / 2
        reaching = len(fade)
        down = reflection @ a[:reaching]
        up = np.concatenate([fade * a[:reaching], np.zeros_like(a[reaching:])])
        u_top, w_top = modes.W @ (up + down), modes.V @ (up - down)
        ups.append(a)
        downs.append(down)
    return TangentialFields(u, w, u_top, w_top, ups, downs)


def _layer_reflection(
    modes: FourierModes, pair: Pair, symmetric: bool
) -> tuple[Array, Array]:
    """Reflection matrix from upward amplitudes at the foot of a layer to downward ones
    at its top, and the factors exp(iqh).

    Only modes whose amplitude at the top is not negligible have a column.

    Args:
        modes: of the layer. pair: (U, V) of outgoing waves above it, (n, n) each.
        symmetric: as in :func:`match_layers`.
    """
    exponent = modes.q * modes.height
    remains = np.exp(-exponent.imag)
    reaching = int(np.count_nonzero(remains > sys.float_info.epsilon))
    fade = np.exp(1j * exponent[:reaching])
    U, V = pair
    if not symmetric:
        # up + down = W^-1 U a and up - down = V^-1 V' a of the pair (U, V') above
        total, difference = np.linalg.solve(modes.W, U), np.linalg.solve(modes.V, V)
        reflection = (total - difference) @ np.linalg.inv(total + difference)
        return reflection[:, :reaching] * fade, fade
    wv, vw = U.T @ modes.V, V.T @ modes.W
    return np.linalg.solve(wv + vw, (wv - vw)[:, :reaching] * fade), fade


def _foot_pair(modes: FourierModes, reflection: Array, fade: Array) -> Pair:
    """The upward-radiating pair at the foot of a layer; its columns are the upward
    modes there.
    """
    reaching = len(fade)
    U, V = modes.W.astype(complex), modes.V.astype(complex)
    round_trip = fade[:, None] * reflection[:reaching]
    U[:, :reaching] += modes.W[:, :reaching] @ round_trip
    V[:, :reaching] -= modes.V[:, :reaching] @ round_trip
    return U, V


def power_flux(pair: Pair) -> Array:
    """(n,) power along z, Re(u w*), of outgoing waves of unit amplitude with fields
    ``pair`` = (u, w); 0 for waves that decay.
    """
    power = (pair[0] * np.conj(pair[1])).real
    return np.where(power > 1e-12 * np.abs(pair[0] * pair[1]), power, 0.0)
