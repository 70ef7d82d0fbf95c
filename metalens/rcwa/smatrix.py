"""Eigenmodes of layers, and the scattering of a whole stack: half-spaces, films and
patterned layers, matched without growing exponentials.
"""

from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa.basis import PlaneWaves, half_space, normal_component

Pair = tuple[Array, Array]
_TINY = 1e-9  # a mode exactly at its cut-off: up and down waves may not coincide
_FADED = 41.0  # exp(-41) = 1.6e-18: waves that do not reach the other end of a layer


@dataclass(frozen=True, slots=True)
class StackMedia:
    """Refractive indices and thicknesses at one wavelength (exp(-iwt)); lengths in
    units of 1/k0.

    under, over: (index, thickness) of the films, in the order that the light meets
        them. heights: of the patterned layers, foot first.
    """

    substrate: complex
    cover: complex
    under: tuple[tuple[complex, float], ...] = ()
    over: tuple[tuple[complex, float], ...] = ()
    heights: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class FourierModes:
    """Eigenmodes of one layer, u' = i P w, w' = i Q u.

    Q: (n, n). q: (n,) propagation constants over k0, imaginary part >= 0, the
        longest-lived first.
    W, V: (n, n) columns u and w of the upward modes (u, -w: downward).
    symmetric: whether P and Q are.
    """

    Q: Array
    q: Array
    W: Array
    V: Array
    symmetric: bool = True


def solve_eigenmodes(P: Array, Q: Array, *, symmetric: bool = True) -> FourierModes:
    """Eigenmodes of a layer: P Q W = W q^2, V = Q W / q.

    Args:
        P, Q: (n, n) operators. symmetric: whether they are symmetric matrices.
    """
    square, W = np.linalg.eig(P @ Q)
    q = np.sqrt(square.astype(complex))
    downward = (q.imag < 0) | ((np.abs(q.imag) <= 1e-13 * np.abs(q)) & (q.real < 0))
    q = np.where(downward, -q, q)
    q = np.where(np.abs(q) < _TINY, _TINY, q)
    order = np.argsort(q.imag, kind="stable")
    q, W = q[order], W[:, order]
    return FourierModes(Q, q, W, (Q @ W) / q, symmetric)


def film_modes(
    waves: PlaneWaves, index: complex, *, symmetric: bool = True
) -> FourierModes:
    """Plane ``waves`` as modes of a homogeneous layer of this ``index``.

    symmetric: whether the operators of all layers of the stack are.
    """
    kz = normal_component(waves.kappa, index)
    kz = np.where(np.abs(kz) < _TINY, _TINY, kz)
    Q = np.where(waves.is_p, index**2, kz**2)
    order = np.argsort(kz.imag, kind="stable")
    W, V = np.eye(len(kz))[:, order], np.diag(Q / kz)[:, order]
    return FourierModes(np.diag(Q), kz[order], W, V, symmetric)


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
    waves: PlaneWaves, media: StackMedia, layers: list[FourierModes], zero: int
) -> ScatteredAmplitudes:
    """Transmitted and reflected orders of a stack for the zero order from the
    substrate.

    Args:
        waves: of the basis. media: half-spaces, films and heights.
        layers: modes of the patterned layers, foot first; none: a stack of films.
        zero: place of the incident wave.
    """
    below = half_space(waves, media.substrate)
    above = half_space(waves, media.cover)
    top, decay_above = _through_films(waves, above, tuple(reversed(media.over)))
    foot, decay_below = _through_films(waves, below, media.under)
    source = np.zeros(len(waves.kappa), complex)
    source[zero] = 2 * below[0][zero] * below[1][zero] * decay_below[zero]
    fields = match_layers(layers, media.heights, top, foot, source)
    incident = power_flux(below)[zero]
    t = outgoing_amplitudes(top, fields.u_top, fields.w_top) * decay_above
    r = _reflected(waves, media, foot, decay_below, fields, zero)
    return ScatteredAmplitudes(
        t * np.sqrt(power_flux(above) / incident),
        r * np.sqrt(power_flux(below) / incident),
    )


def outgoing_amplitudes(pair: Pair, u: Array, w: Array) -> Array:
    """Amplitudes a of a diagonal ``pair`` (U, V) with u = U a, w = V a, by least
    squares.
    """
    norm = np.abs(pair[0]) ** 2 + np.abs(pair[1]) ** 2
    return np.asarray((np.conj(pair[0]) * u + np.conj(pair[1]) * w) / norm)


def match_layers(
    layers: list[FourierModes],
    heights: tuple[float, ...],
    top: Pair,
    foot: Pair,
    source: Array,
) -> TangentialFields:
    """Fields that radiate into ``top`` above the layers and satisfy foot V u + U w =
    source below.

    From the top down, the reflection of every layer gives an outgoing pair at its foot.
    From the foot up, the amplitudes of the modes follow.

    Args:
        layers: modes, foot first. heights: of the layers.
        top, foot: diagonal pairs above and below. source: (n,).
    """
    if not layers:
        a = source / (foot[1] * top[0] + foot[0] * top[1])
        return TangentialFields(top[0] * a, top[1] * a, top[0] * a, top[1] * a, [], [])
    pair, reflections = top, []
    for modes, height in zip(reversed(layers), reversed(heights), strict=True):
        reflection, fade = _layer_reflection(modes, height, pair)
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
    modes: FourierModes, height: float, pair: Pair
) -> tuple[Array, Array]:
    """Reflection matrix from upward amplitudes at the foot of a layer to downward ones
    at its top, and the factors exp(iqh).

    Only modes whose amplitude at the top is not negligible have a column.

    Args:
        modes: of the layer. height: of the layer, times k0.
        pair: (U, V) of outgoing waves above it, diagonal or matrices.
    """
    exponent = modes.q * height
    reaching = int(np.count_nonzero(exponent.imag < _FADED))
    fade = np.exp(1j * exponent[:reaching])
    if not modes.symmetric:
        # up + down = W^-1 U a and up - down = V^-1 V' a of the pair (U, V') above
        U, V = (np.diag(side) if side.ndim == 1 else side for side in pair)
        total = np.linalg.solve(modes.W, U)
        difference = np.linalg.solve(modes.V, V)
        reflection = (total - difference) @ np.linalg.inv(total + difference)
        return reflection[:, :reaching] * fade, fade
    wv = _transposed_product(pair[0], modes.V)
    vw = _transposed_product(pair[1], modes.W)
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


def _through_films(
    waves: PlaneWaves, pair: Pair, films: tuple[tuple[complex, float], ...]
) -> tuple[Pair, Array]:
    """Outgoing pair (u, w) on the other side of films, and the factors exp(i kz d) of
    its waves through them.

    u and w are scaled by that factor, so that nothing grows.

    Args:
        waves: of the basis.
        pair: (n,) u and w at the half-space.
        films: (index, thickness times k0), from the half-space outwards.
    """
    u, w = pair
    fade = np.ones(len(waves.kappa), complex)
    for index, thickness in films:
        kz = normal_component(waves.kappa, index)
        phase = np.exp(1j * kz * thickness)
        cosine = (1 + phase**2) / 2
        safe = np.where(kz == 0, 1, kz)
        sine = np.where(kz == 0, thickness, np.expm1(2j * kz * thickness) / (2j * safe))
        alpha = np.where(waves.is_p, index**2, kz**2)
        beta = np.where(waves.is_p, kz**2 / index**2, 1.0)
        u, w = cosine * u - 1j * beta * sine * w, cosine * w - 1j * alpha * sine * u
        fade = fade * phase
    return (u, w), fade


def _reflected(
    waves: PlaneWaves,
    media: StackMedia,
    foot: Pair,
    decay: Array,
    fields: TangentialFields,
    zero: int,
) -> Array:
    """Reflected amplitudes (n,) in the substrate, from the fields above its films.

    Without the pillar the films would transmit the incident wave into a medium like the
    substrate. The difference of the fields from that wave radiates downwards.

    Args:
        waves: of the basis. media: half-spaces and films.
        foot: outgoing pair of the substrate above the lower films.
        decay: (n,) factors of its waves through the films.
        fields: at the foot of the pillar. zero: place of the incident wave.
    """
    U, V = half_space(waves, media.substrate)
    (u, w), fade = _through_films(waves, (U, V), tuple(reversed(media.under)))
    denominator = V[zero] * u[zero] + U[zero] * w[zero]
    incident = np.zeros(len(U), complex)
    incident[zero] = fade[zero] * 2 * U[zero] * V[zero] / denominator
    reflected = decay * outgoing_amplitudes(
        foot, fields.u - U * incident, V * incident - fields.w
    )
    reflected[zero] += (V[zero] * u[zero] - U[zero] * w[zero]) / denominator
    return np.asarray(reflected)


def power_flux(pair: Pair) -> Array:
    """(n,) power along z, Re(u w*), of outgoing waves of unit amplitude with fields
    ``pair`` = (u, w); 0 for waves that decay.
    """
    power = (pair[0] * np.conj(pair[1])).real
    return np.where(power > 1e-12 * np.abs(pair[0] * pair[1]), power, 0.0)


def _transposed_product(left: Array, matrix: Array) -> Array:
    """left^T matrix; a vector ``left`` stands for its diagonal matrix."""
    return left[:, None] * matrix if left.ndim == 1 else left.T @ matrix
