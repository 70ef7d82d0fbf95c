"""Fields of a whole stack: half-spaces, films and pillar layers, matched without
growing exponentials.

A plane's upward-radiating fields form a pair (U, V): every field that only light from
above can not reach is u = U a,
w = V a. Since P and Q are symmetric, two solutions keep u1^T w2 - w1^T u2 from plane to
plane, so "radiates upwards"
reads V^T u - U^T w = 0, and a pair passes from the top of a layer to its foot by one
linear solve with decaying
factors only.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa.layer import FourierModes
from metalens.rcwa.orders.waves import PlaneWaves, half_space, normal_component

Pair = tuple[Array, Array]


@dataclass(frozen=True, slots=True)
class StackMedia:
    """Refractive indices and thicknesses at one wavelength (exp(-iwt)); lengths in
    units of 1/k0.

    under, over: (index, thickness) of the films, in the order that the light meets
    them.
    heights: of the pillar layers, foot first.
    """

    substrate: complex
    cover: complex
    under: tuple[tuple[complex, float], ...] = ()
    over: tuple[tuple[complex, float], ...] = ()
    heights: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class ScatteredAmplitudes:
    """Power-normalised amplitudes of every order for unit incident power in the zero
    order: (*batch, n).

    t, r: of the outgoing waves in cover and substrate, 0 where a wave carries no power.
    """

    t: Array
    r: Array


@dataclass(frozen=True, eq=False, slots=True)
class TangentialFields:
    """Tangential fields of one incident wave.

    u, w: (*batch, n) at the foot of the lowest layer; u_top, w_top: at the top of the
    highest one.
    up, down: for each layer, (*batch, n) amplitudes of its upward modes at its foot and
    downward modes at its top.
    """

    u: Array
    w: Array
    u_top: Array
    w_top: Array
    up: list[Array]
    down: list[Array]


Between = Callable[[Pair, Pair, Array], TangentialFields]


def scatter_zero_order(
    ways: PlaneWaves,
    media: StackMedia,
    layers: list[FourierModes],
    zero: int,
    *,
    between: Between | None = None,
) -> ScatteredAmplitudes:
    """Response to the zero order (place ``zero``) from the substrate; no layers: a
    stack of films.

    between: what matches the fields, given the pairs above and below and the source, in
    place of the layers.
    """
    below, above = half_space(ways, media.substrate), half_space(ways, media.cover)
    top, lift = _through(ways, above, tuple(reversed(media.over)))
    foot, drop = _through(ways, below, media.under)
    source = np.zeros(len(ways.kappa), complex)
    source[zero] = 2 * below[0][zero] * below[1][zero] * drop[zero]
    found = (
        between(top, foot, source)
        if between
        else match_layers(layers, media.heights, top, foot, source)
    )
    incident = power_flux(below)[zero]
    t = (
        outgoing_amplitudes(top, found.u_top, found.w_top)
        * lift
        * np.sqrt(power_flux(above) / incident)
    )
    r = _reflected(ways, media, foot, drop, found, zero) * np.sqrt(
        power_flux(below) / incident
    )
    return ScatteredAmplitudes(t, r)


def outgoing_amplitudes(pair: Pair, u: Array, w: Array) -> Array:
    """Amplitudes a of the diagonal pair with u = U a, w = V a, from whichever of the
    two is large.
    """
    return np.asarray(
        (np.conj(pair[0]) * u + np.conj(pair[1]) * w)
        / (np.abs(pair[0]) ** 2 + np.abs(pair[1]) ** 2)
    )


def match_layers(
    layers: list[FourierModes],
    heights: tuple[float, ...],
    top: Pair,
    foot: Pair,
    source: Array,
) -> TangentialFields:
    """Fields that radiate into ``top`` above the layers, and whose incident part gives
    foot V u + U w = source.
    """
    if not layers:
        a = source / (foot[1] * top[0] + foot[0] * top[1])
        return TangentialFields(top[0] * a, top[1] * a, top[0] * a, top[1] * a, [], [])
    pair, returns = top, []
    for part, height in zip(reversed(layers), reversed(heights), strict=True):
        back, kept, fade = layer_reflection(part, height, pair)
        returns.append((back, kept, fade))
        pair = foot_pair(part, back, kept, fade)
    a = _solve(foot[1][:, None] * pair[0] + foot[0][:, None] * pair[1], source)
    u, w = _times(pair[0], a), _times(pair[1], a)
    u_top, w_top, ups, downs = u, w, [], []
    for i, (part, (back, kept, fade)) in enumerate(
        zip(layers, reversed(returns), strict=True)
    ):
        if i:
            a = (_solve(part.W, u_top) + _solve(part.V, w_top)) / 2
        down = _times(back, a[..., :kept])
        up = np.concatenate(
            [fade * a[..., :kept], np.zeros_like(a[..., kept:])], axis=-1
        )
        u_top, w_top = _times(part.W, up + down), _times(part.V, up - down)
        ups.append(a)
        downs.append(down)
    return TangentialFields(u, w, u_top, w_top, ups, downs)


def layer_reflection(
    part: FourierModes, height: float, pair: Pair
) -> tuple[Array, int, Array]:
    """Downward amplitudes at the top for each upward one at the foot, for the modes
    that reach the top at all.
    """
    exponent = part.q * height
    kept = int(np.count_nonzero(exponent.imag < _FADED, axis=-1).max())
    fade = np.exp(1j * exponent[..., :kept])
    if (
        not part.symmetric
    ):  # up + down = W⁻¹ U a and up - down = V⁻¹ V' a of the pair (U, V') above
        U, V = (np.diag(side) if side.ndim == 1 else side for side in pair)
        both, apart = np.linalg.solve(part.W, U), np.linalg.solve(part.V, V)
        return (
            ((both - apart) @ np.linalg.inv(both + apart))[:, :kept] * fade,
            kept,
            fade,
        )
    wv, vw = _across(pair[0], part.V), _across(pair[1], part.W)
    return (
        np.linalg.solve(wv + vw, (wv - vw)[..., :kept] * fade[..., None, :]),
        kept,
        fade,
    )


_FADED = 41.0  # exp(-41) = 1.6e-18


def foot_pair(part: FourierModes, back: Array, kept: int, fade: Array) -> Pair:
    """The upward-radiating pair at the foot of a layer, its columns the upward modes
    there.
    """
    U, V = part.W.astype(complex), part.V.astype(complex)
    trip = fade[..., :, None] * back[..., :kept, :]
    U[..., :kept] += part.W[..., :kept] @ trip
    V[..., :kept] -= part.V[..., :kept] @ trip
    return U, V


def _through(
    ways: PlaneWaves, pair: Pair, films: tuple[tuple[complex, float], ...]
) -> tuple[Pair, Array]:
    """An outgoing pair seen through films, nearest to its half-space first, and the
    decay of its waves on the way.
    """
    u, w = pair
    fade = np.ones(len(ways.kappa), complex)
    is_p = np.arange(len(ways.kappa)) < ways.p_count
    for index, thickness in films:
        kz = normal_component(ways.kappa, index)
        once = np.exp(1j * kz * thickness)
        cosine = (1 + once**2) / 2
        sine = np.where(
            kz == 0,
            thickness,
            np.expm1(2j * kz * thickness) / (2j * np.where(kz == 0, 1, kz)),
        )
        alpha, beta = (
            np.where(is_p, index**2, kz**2),
            np.where(is_p, kz**2 / index**2, 1.0),
        )
        u, w = cosine * u - 1j * beta * sine * w, cosine * w - 1j * alpha * sine * u
        fade = fade * once
    return (u, w), fade


def _reflected(
    ways: PlaneWaves,
    media: StackMedia,
    foot: Pair,
    drop: Array,
    fields: TangentialFields,
    zero: int,
) -> Array:
    """Reflected amplitudes in the substrate, from the fields above the films under the
    pillar.

    Without the pillar the films would pass the incident wave on into a medium like the
    substrate; what the fields
    differ from that comes from above, and radiates downwards.
    """
    U, V = half_space(ways, media.substrate)
    (u, w), fade = _through(ways, (U, V), tuple(reversed(media.under)))
    whole = V[zero] * u[zero] + U[zero] * w[zero]
    passed = np.zeros(len(U), complex)
    passed[zero] = fade[zero] * 2 * U[zero] * V[zero] / whole
    back = drop * outgoing_amplitudes(
        foot, fields.u - U * passed, V * passed - fields.w
    )
    back[..., zero] += (V[zero] * u[zero] - U[zero] * w[zero]) / whole
    return np.asarray(back)


def power_flux(pair: Pair) -> Array:
    """Power along z of outgoing waves of unit amplitude, Re(u w*); 0 for waves that
    decay.
    """
    power = (pair[0] * np.conj(pair[1])).real
    return np.where(power > 1e-12 * np.abs(pair[0] * pair[1]), power, 0.0)


def _across(left: Array, matrix: Array) -> Array:
    return (
        left[:, None] * matrix if left.ndim == 1 else np.swapaxes(left, -1, -2) @ matrix
    )


def _solve(matrix: Array, right: Array) -> Array:
    right = np.broadcast_to(right, matrix.shape[:-1])
    return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0])


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])
