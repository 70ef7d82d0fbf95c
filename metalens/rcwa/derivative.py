"""Exact derivatives of the transmission, from the fields of the light and of its
reverse.

With tilde the fields of unit power incident from the cover, a change dP, dQ of the
operators anywhere changes the
power-normalised transmission by (Lagrange's identity of u' = i P w, w' = i Q u; P and Q
symmetric)

    dt = i/2 ∫ (u^T dQ u~ - w^T dP w~) dz,      layer stretched by dh:  dt = i/2 (u^T Q u~ - w^T P w~) dh.

No mode is differentiated, so equal propagation constants need no care: only divided
differences of exponentials
appear. In the half-spaces outgoing waves are integrated in closed form; there the
incident wave adds nothing, since
its power is fixed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from metalens.cell import Film, Material, materials
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError
from metalens.rcwa import changes
from metalens.rcwa.changes import Change
from metalens.rcwa.conditions import Case, case_waves, widening
from metalens.rcwa.layer import Layer, layer, operators
from metalens.rcwa.orders.waves import Waves, half_space, normal_component
from metalens.rcwa.solver import homogeneous
from metalens.rcwa.stack import Fields, match, outgoing

# |kz| below which the slope of a half-space is cut off: it is infinite at a Rayleigh
# anomaly
_GRAZING = 1e-8


@dataclass(frozen=True, slots=True)
class Derivatives:
    """The transmission of a pillar at a fixed truncation, and its derivatives.

    wavelength_um: dispersion of all materials included. n, k: of the pillar.
    """

    t: complex
    diameter_um: complex
    height_um: complex
    n: complex
    k: complex
    wavelength_um: complex
    angle_rad: complex


@dataclass(frozen=True, slots=True)
class Section:
    """One layer: its share of the height, and the (weight, lift) of the cross-sections
    that it mixes.

    lift: height of the cross-section above the middle of the pillar, over the height of
    the pillar.
    """

    share: float
    nodes: tuple[tuple[float, float], ...]


def sections(steps: int) -> tuple[Section, ...]:
    """Layers of a tilted wall in this many steps, foot first; 0 steps: an upright wall.

    Commutator-free Magnus of fourth order: over a step two layers of half the height,
    mixed from the cross-sections at
    the Gauss points 1/2 -+ sqrt(3)/6, (b, a) in the lower and (a, b) in the upper one,
    a, b = 1/2 -+ sqrt(3)/3 (Blanes
    and Moan, Appl. Numer. Math. 56, 1519 (2006)). Layers have modes, which the
    integrals here need; ``solve`` follows
    the wall by collocation (:mod:`metalens.rcwa.wall`).
    """
    if not steps:
        return (Section(1.0, ((1.0, 0.0),)),)
    small, large = 0.5 - math.sqrt(3) / 3, 0.5 + math.sqrt(3) / 3
    found = []
    for i in range(steps):
        low, high = (
            (i + 0.5 + sign * math.sqrt(3) / 6) / steps - 0.5 for sign in (-1, 1)
        )
        found.append(Section(0.5 / steps, ((large, low), (small, high))))
        found.append(Section(0.5 / steps, ((small, low), (large, high))))
    return tuple(found)


def mixed(
    this: Case, ways: Waves, diameter_um: Array, part: Section
) -> tuple[Array, Array]:
    """P and Q of one section of the pillar."""
    wide = [diameter_um + lift * widening(this.cell) for _, lift in part.nodes]
    here = [
        operators(ways, w, this.cell.pitch_um, this.pillar, this.between) for w in wide
    ]
    weights = [weight for weight, _ in part.nodes]
    P = sum(weight * P for weight, (P, _) in zip(weights, here, strict=True))
    Q = sum(weight * Q for weight, (_, Q) in zip(weights, here, strict=True))
    return np.asarray(P), np.asarray(Q)


@dataclass(frozen=True, eq=False, slots=True)
class _Region:
    """A layer between the half-spaces: its modes and reduced height; its film, or its
    section of the pillar.
    """

    part: Layer
    height: float
    film: Material | None
    section: Section | None


@dataclass(frozen=True, eq=False, slots=True)
class _Problem:
    this: Case
    diameter_um: float
    ways: Waves
    regions: list[_Region]
    light: Fields
    reverse: Fields
    ends: tuple[tuple[complex, Array, Array], tuple[complex, Array, Array]]
    t: complex


def differentiate(
    this: Case, diameter_um: float, *, harmonics: int, steps: int, angle_rad: float
) -> Derivatives:
    """Derivatives at one truncation.

    Raises:
        CellError: an absorbing half-space, or a zero order that does not propagate in
            the cover.
    """
    problem = _solve(this, diameter_um, harmonics, steps)
    by_index = _by_index(problem)
    return Derivatives(
        problem.t,
        _by_diameter(problem, lambda lift: 1.0),
        _by_height(problem),
        by_index,
        1j * by_index,
        _by_wavelength(problem),
        _by_angle(problem, angle_rad),
    )


def _solve(this: Case, diameter_um: float, harmonics: int, steps: int) -> _Problem:
    ways, zero = case_waves(this, harmonics)
    media = this.media
    if media.substrate.imag or media.cover.imag:
        raise CellError("derivatives need a substrate and a cover that do not absorb")
    if media.cover.real <= ways.kappa[zero]:
        raise CellError(
            "derivatives need a zero order that propagates in the cover; here it is totally reflected"
        )
    regions = _regions(this, ways, diameter_um, steps)
    layers, heights = (
        [region.part for region in regions],
        tuple(region.height for region in regions),
    )
    below, above = half_space(ways, media.substrate), half_space(ways, media.cover)
    light = match(layers, heights, above, below, _source(below, zero))
    reverse = match(layers[::-1], heights[::-1], below, above, _source(above, zero))
    unit = np.zeros(len(ways.kappa))
    unit[zero] = 1
    transmitted = outgoing(above, light.u_top, light.w_top)
    reflected = _returned(below, light, unit)
    ends = (
        (media.substrate, reflected, outgoing(below, reverse.u_top, reverse.w_top)),
        (media.cover, transmitted, _returned(above, reverse, unit)),
    )
    t = complex(transmitted[zero] * np.sqrt(above[0][zero] * above[1][zero]))
    return _Problem(this, diameter_um, ways, regions, light, reverse, ends, t)


def _source(pair: tuple[Array, Array], zero: int) -> Array:
    source = np.zeros(len(pair[0]), complex)
    source[zero] = 2 * np.sqrt(pair[0][zero] * pair[1][zero])
    return source


def _returned(pair: tuple[Array, Array], fields: Fields, unit: Array) -> Array:
    incident = unit / np.sqrt(pair[0] * pair[1] + (1 - unit))
    return outgoing(pair, fields.u - pair[0] * incident, pair[1] * incident - fields.w)


def _regions(this: Case, ways: Waves, diameter_um: float, steps: int) -> list[_Region]:
    def films(
        stack: tuple[Film, ...], indices: tuple[tuple[complex, float], ...]
    ) -> list[_Region]:
        pairs = zip(stack, indices, strict=True)
        return [
            _Region(film_layer(ways, index), height, film.material, None)
            for film, (index, height) in pairs
        ]

    pillar = []
    for section in sections(steps):
        flat = bool(homogeneous(this, np.array(diameter_um)))
        part = (
            film_layer(ways, this.between)
            if flat
            else layer(*mixed(this, ways, np.array(diameter_um), section))
        )
        pillar.append(
            _Region(part, section.share * this.cell.height_um * this.k0, None, section)
        )
    return (
        films(this.cell.under, this.media.under)
        + pillar
        + films(this.cell.over, this.media.over)
    )


def film_layer(ways: Waves, index: complex, *, symmetric: bool = True) -> Layer:
    """A homogeneous layer, its plane waves as modes, the longest-lived first;
    symmetric: whether all that it is matched
    with are (:class:`metalens.rcwa.layer.Layer`)."""
    kz = normal_component(ways.kappa, index)
    kz = np.where(np.abs(kz) < _GRAZING, _GRAZING, kz)
    is_p = np.arange(len(kz)) < ways.p_count
    P, Q = np.where(is_p, kz**2 / index**2, 1.0), np.where(is_p, index**2, kz**2)
    order = np.argsort(kz.imag, kind="stable")
    return Layer(
        np.diag(P),
        np.diag(Q),
        kz[order],
        np.eye(len(kz))[:, order],
        np.diag(Q / kz)[:, order],
        symmetric,
    )


def _by_diameter(problem: _Problem, share: Callable[[float], float]) -> complex:
    """Slope for diameters that change by ``share(lift)``."""

    def rim(diameter: Array, lift: float) -> Change:
        dP, dQ = changes.rim(problem.this, problem.ways, diameter)
        return share(lift) * dP, share(lift) * dQ

    return sum(_inside(problem, i, _mix(problem, i, rim)) for i in _pillar(problem))


def _by_index(problem: _Problem) -> complex:
    def bulk(diameter: Array, lift: float) -> Change:
        return changes.indices(problem.this, problem.ways, diameter, 1.0, 0.0)

    return sum(_inside(problem, i, _mix(problem, i, bulk)) for i in _pillar(problem))


def _by_height(problem: _Problem) -> complex:
    this, total = problem.this, 0j
    for region, i in ((problem.regions[i], i) for i in _pillar(problem)):
        total += (
            region.section.share * this.k0 * _stretch(problem, i)
            if region.section
            else 0
        )
    if this.cell.sidewall_rad:
        spread = -2 * math.tan(this.cell.sidewall_rad)
        total += _by_diameter(problem, lambda lift: lift * spread)
    return total


def _pillar(problem: _Problem) -> list[int]:
    return [i for i, region in enumerate(problem.regions) if region.section]


def _mix(problem: _Problem, i: int, change: Callable[[Array, float], Change]) -> Change:
    """Change of the operators of a section, from that of each cross-section (diameter,
    lift) that it mixes.
    """
    section = problem.regions[i].section
    n = len(problem.ways.kappa)
    dP, dQ = np.zeros((n, n), complex), np.zeros((n, n), complex)
    for weight, lift in section.nodes if section else ():
        part = change(
            np.array(problem.diameter_um + lift * widening(problem.this.cell)), lift
        )
        dP, dQ = dP + weight * part[0], dQ + weight * part[1]
    return dP, dQ


def _by_wavelength(problem: _Problem) -> complex:
    this, ways = problem.this, problem.ways
    wavelength, cell = this.wavelength_um, this.cell

    def slope(material: Material) -> complex:
        return materials.slope(material, wavelength)

    turn = changes.turning(ways, np.stack([ways.m, ways.n]) / cell.pitch_um)

    def pattern(diameter: Array, lift: float) -> Change:
        bulk = changes.indices(
            this, ways, diameter, slope(cell.pillar), slope(cell.fill)
        )
        return changes.add(changes.turned_pattern(this, ways, diameter, turn), bulk)

    total = 0j
    for i, region in enumerate(problem.regions):
        if region.film is None:
            change = _mix(problem, i, pattern)
        else:
            index = materials.index(region.film, wavelength)
            change = changes.medium(ways, index, 2 * index * slope(region.film), turn)
        total += _inside(problem, i, change) - region.height / wavelength * _stretch(
            problem, i
        )
    for (index, out, back), material in zip(
        problem.ends, (cell.substrate, cell.cover), strict=True
    ):
        total += _outside(
            ways,
            index,
            out,
            back,
            changes.medium(ways, index, 2 * index * slope(material), turn),
        )
    return total


def _by_angle(problem: _Problem, angle_rad: float) -> complex:
    this, ways = problem.this, problem.ways
    if angle_rad == 0:
        return 0j  # the response is even in the angle
    tilt = math.cos(angle_rad) / math.sin(angle_rad) * np.array([[this.kx], [this.ky]])
    turn = changes.turning(ways, np.broadcast_to(tilt, (2, len(ways.kappa))))

    def pattern(diameter: Array, lift: float) -> Change:
        return changes.turned_pattern(this, ways, diameter, turn)

    total = 0j
    for i, region in enumerate(problem.regions):
        if region.film is None:
            change = _mix(problem, i, pattern)
        else:
            change = changes.medium(
                ways, materials.index(region.film, this.wavelength_um), 0j, turn
            )
        total += _inside(problem, i, change)
    for index, out, back in problem.ends:
        total += _outside(ways, index, out, back, changes.medium(ways, index, 0j, turn))
    return total


def _inside(problem: _Problem, i: int, change: Change) -> complex:
    """i/2 of the integral over a layer."""
    region, (a, b), (c, d) = problem.regions[i], *_amplitudes(problem, i)
    part, h = region.part, region.height
    q, fade = part.q, np.exp(1j * part.q * h)
    total, apart = q[:, None] + q, q[:, None] - q
    same = np.expm1(1j * total * h) / (1j * total)
    near = np.abs(apart) * h < 0.5
    x = np.where(near, apart, 0) * h / 2
    middle = np.exp(1j * np.where(near, total, 0) * h / 2) * h * np.sinc(x / np.pi)
    opposite = np.where(
        near, middle, (fade[:, None] - fade) / np.where(near, 1, 1j * apart)
    )
    even = same * (np.outer(a, c) + np.outer(b, d))
    odd = opposite * (np.outer(a, d) + np.outer(b, c))
    from_q = (part.W.T @ change[1] @ part.W) * (even + odd)
    from_p = (part.V.T @ change[0] @ part.V) * (even - odd)
    return complex(0.5j * (from_q.sum() - from_p.sum()))


def _stretch(problem: _Problem, i: int) -> complex:
    """i/2 (u^T Q u~ - w^T P w~), the same at every height of a layer; taken at its
    foot.
    """
    region, (a, b), (c, d) = problem.regions[i], *_amplitudes(problem, i)
    part = region.part
    fade = np.exp(1j * part.q * region.height)
    u, w = part.W @ (a + fade * b), part.V @ (a - fade * b)
    u_back, w_back = part.W @ (c + fade * d), part.V @ (c - fade * d)
    return complex(0.5j * (u @ part.Q @ u_back - w @ part.P @ w_back))


def _amplitudes(
    problem: _Problem, i: int
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """(up, down) of the light and of the reverse in a layer, both as seen from below."""
    j = len(problem.regions) - 1 - i
    light, reverse = problem.light, problem.reverse
    return (light.up[i], light.down[i]), (reverse.down[j], reverse.up[j])


def _outside(
    ways: Waves, index: complex, out: Array, back: Array, change: Change
) -> complex:
    """i/2 of the integral over a half-space, of its outgoing waves."""
    U, V = half_space(ways, index)
    kz = normal_component(ways.kappa, index)
    total = kz[:, None] + kz
    total = np.where(np.abs(total) < _GRAZING, _GRAZING, total)
    u, w, u_back, w_back = U * out, V * out, U * back, V * back
    kernel = change[1] * np.outer(u, u_back) - change[0] * np.outer(w, w_back)
    return complex(0.5j * (1j / total * kernel).sum())
