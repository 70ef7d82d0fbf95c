"""Cells of any shape, lattice and layers: the 2 x 2 Jones matrices of transmission and reflection, with error bars."""

import dataclasses
import functools
import math
from dataclasses import dataclass, field

import numpy as np

from metalens.cell import Cell, Film, Light, Response, check_direction, check_tolerance, materials
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError
from metalens.rcwa import layer as modes
from metalens.rcwa import made, mirrors, pattern, wall
from metalens.rcwa.conditions import direction
from metalens.rcwa.made import check_size
from metalens.rcwa.mirrors import FLIP_X, FLIP_Y, HALF_TURN, IDENTITY, Operation
from metalens.rcwa.solver import MOST_COMPARED, compared, crowding, safety
from metalens.rcwa.stack import Media, respond
from metalens.rcwa.waves import Waves

_FIRST = 3  # orders of the first truncation
_LAST = {4: 15, 2: 10, 1: 7}  # by the number of operations: about a second a solve
_COMPARED = 4
SAFETY = 7.0  # the most that :func:`metalens.rcwa.solver.safety` gives
_ROUNDING = 1e-13
_STRAIGHT = 1e-12
_COARSE = 3  # orders that suffice to see what the collocation of a tilted wall leaves


@dataclass(frozen=True, eq=False, slots=True)
class Jones:
    """Zero-order response of one cell to both polarisations, power-normalised, exp(-iwt), incidence from the substrate.

    basis: ("x", "y") at normal incidence, ("s", "p") else: s across the plane of incidence, p in it.
    t, r: (2, 2); column: polarisation that comes, row: that leaves. (For r, p is taken along the same tangential
        direction as that of the light that comes.)
    t_error: estimate of the largest |t - exact| and |r - exact|, not below the true error.
    energy: (2,) power of all propagating orders, for each polarisation that comes.
    orders: harmonics of the finest truncation. converged, reason: whether the tolerance is met, and why it ended.
    earlier: (k, 2, 2) t of the up to six truncations before, the first of them again where fewer are looked at. A
        number that follows from t has as error bar, like t itself, ``SAFETY`` times its farthest change over them.
    """

    basis: tuple[str, str]
    t: Array
    r: Array
    t_error: float
    energy: Array
    orders: int
    converged: bool
    reason: str
    earlier: Array = field(default_factory=lambda: np.empty((0, 2, 2), complex))


@dataclass(frozen=True, slots=True)
class _Tangent:
    """Tangential wave vector over k0, azimuth (0 at normal incidence) and wavelength."""

    kx: float
    ky: float
    azimuth_rad: float
    wavelength_um: float

    @property
    def normal(self) -> bool:
        return self.kx == 0 == self.ky


@dataclass(frozen=True, slots=True)
class _Problem:
    """A cell at one size and light, its media, and the symmetries that its polarisations have."""

    cell: Cell
    size_um: float
    light: _Tangent
    media: Media
    classes: tuple[tuple[Operation, ...], ...]


def jones(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> Jones:
    """Both polarisations of a cell of any shape, at the least number of harmonics that meets the tolerance.

    Args:
        size_um: of the shape (what other stages call the diameter).
        angle_rad: of the light outside, in vacuum; azimuth_rad: of the plane of incidence, from +x to +y.
        harmonics: fix the largest truncation instead (orders as on a square lattice of the same area).

    Accuracy: ``t_error`` is 3 (from 13 orders on) to 7 times the farthest of the four truncations before the last (six
        where pillar or gap is narrow), and what the collocation of a tilted wall leaves. Corners and high contrast
        converge slowly: 1e-2 is usual.

    Raises:
        CellError: pillars that touch or lose their outline, an impossible angle or tolerance, no zero order.
        MaterialError: a wavelength outside the range of a material.
    """
    check_tolerance(tolerance)
    light = _tangent(wavelength_um, angle_rad, azimuth_rad)
    media = _media(cell, light)
    check_size(cell, size_um)
    classes = _classes(cell, size_um, light)
    problem = _Problem(cell, size_um, light, media, classes)
    last = _LAST[min(len(operations) for operations in classes)] if harmonics is None else harmonics
    gap = cell.gap_um(size_um)
    before = int(compared(min(gap, cell.outline(size_um).narrowest_um) / cell.pitch_um))
    first = _FIRST + _COMPARED - before if harmonics is None else max(1, harmonics - before)
    stages, cut = 0, 0.0
    if cell.sidewall_rad:
        stages, cut = wall.enough(lambda count: _both(_truncated(problem, min(last, _COARSE), count)), tolerance)
    crowded = float(crowding(gap, cell.pitch_um))
    history: list[Array] = []
    for reach in range(first, last + 1):
        found = _truncated(problem, reach, stages)
        history.append(_both(found))
        error = crowded * _moved(history, reach, before) + cut
        if len(history) > before and error <= tolerance:
            break
    error = min(error, 2.0)
    met = error <= tolerance
    reason = f"orders within {reach}: estimate {'meets' if met else 'above'} the tolerance {tolerance:.3g}"
    looked_at = [both[0] for both in history[-1 - before : -1]]
    earlier = np.array(looked_at[:1] * (MOST_COMPARED - before) + looked_at).reshape(-1, 2, 2)
    return dataclasses.replace(found, t_error=error, converged=met, reason=reason, earlier=earlier)


def _tangent(wavelength_um: float, angle_rad: float, azimuth_rad: float) -> _Tangent:
    """The tangential wave vector, its components 0 where they are 0 but for rounding."""
    check_direction(angle_rad, azimuth_rad)
    sine = math.sin(angle_rad)
    flat = 0.0 if sine == 0 else azimuth_rad
    kx, ky = (0.0 if abs(v) < _STRAIGHT else v for v in (sine * math.cos(flat), sine * math.sin(flat)))
    return _Tangent(kx, ky, flat, wavelength_um)


def _both(found: Jones) -> Array:
    """(2, 2, 2) t and r."""
    return np.stack([found.t, found.r])


def _moved(history: list[Array], reach: int, before: int) -> float:
    """Error of the last truncation: :func:`metalens.rcwa.solver.safety` times the farthest of those before it."""
    earlier = history[-1 - before : -1]
    farthest = max((float(np.abs(history[-1] - both).max()) for both in earlier), default=1.0)
    return safety(reach) * farthest + _ROUNDING


def co_polarised(cell: Cell, size_um: float, light: Light, *, tolerance: float, harmonics: int | None) -> Response:
    """One diagonal element of :func:`jones`; the same arguments and refusals."""
    place = ("x", "y").index(light.polarization) if light.polarization in ("x", "y") else None
    if light.angle_rad:
        place = ("s", "p").index(direction(light)[-1])
    elif place is None:  # p lies in the plane of incidence that the azimuth names
        turned = round(light.azimuth_rad / (math.pi / 2)) % 2
        place = turned if light.polarization == "p" else 1 - turned
    about = {"angle_rad": light.angle_rad, "azimuth_rad": light.azimuth_rad}
    found = jones(cell, size_um, light.wavelength_um, **about, tolerance=tolerance, harmonics=harmonics)
    t, r, energy = complex(found.t[place, place]), complex(found.r[place, place]), float(found.energy[place])
    return Response(t, r, found.t_error, found.orders, energy, "rcwa", found.converged, found.reason)


def most_harmonics(cell: Cell, size_um: float, *, angle_rad: float = 0.0, azimuth_rad: float = 0.0) -> int:
    """Largest truncation that :func:`jones` takes by itself: less for a cell without mirrors."""
    return _LAST[min(len(found) for found in _classes(cell, size_um, _tangent(1.0, angle_rad, azimuth_rad)))]


def _media(cell: Cell, light: _Tangent) -> Media:
    k0 = 2 * math.pi / light.wavelength_um

    def films(stack: tuple[Film, ...]) -> tuple[tuple[complex, float], ...]:
        return tuple((materials.index(f.material, light.wavelength_um), f.thickness_um * k0) for f in stack)

    below, above = (materials.index(m, light.wavelength_um) for m in (cell.substrate, cell.cover))
    if below.real <= math.hypot(light.kx, light.ky):
        raise CellError(
            f"sin(angle_rad) = {math.hypot(light.kx, light.ky):.6g} in a substrate of n = {below.real:.6g}: the light "
            "cannot come from there; need a smaller angle_rad or another substrate"
        )
    return Media(below, above, films(cell.under), films(cell.over))


def _classes(cell: Cell, size_um: float, light: _Tangent) -> tuple[tuple[Operation, ...], ...]:
    """Sets of operations whose fields together make every polarisation: one set, or one for each polarisation."""
    outline = cell.outline(size_um)
    flip_x = outline.keeps(-1, 1) and light.kx == 0
    flip_y = outline.keeps(1, -1) and light.ky == 0
    if flip_x and flip_y:
        return tuple(
            (IDENTITY, FLIP_X[way], FLIP_Y[way], HALF_TURN) for way in ("x", "y")
        )  # the half turn is the product of both
    if flip_x or flip_y:
        table = FLIP_X if flip_x else FLIP_Y
        return tuple((IDENTITY, table[way]) for way in ("x", "y"))
    return ((IDENTITY, HALF_TURN),) if outline.keeps(-1, -1) and light.normal else ((IDENTITY,),)


def _truncated(problem: _Problem, reach: int, stages: int) -> Jones:
    """All polarisations at one truncation; stages: of the collocation of a tilted wall, 0 for an upright one."""
    cell, size_um, light = problem.cell, problem.size_um, problem.light
    t, r, energy = np.zeros((2, 2), complex), np.zeros((2, 2), complex), np.zeros(2)
    for operations in problem.classes:
        space = mirrors.orders(reach, pattern.frame(cell, operations))
        ways, places = _waves(space, cell, light)
        operators = functools.partial(_operators, space, ways, cell)
        walls = made.walls(cell, size_um, light.wavelength_um, operators)
        media, layers, between = problem.media, [], None
        if stages:
            between = functools.partial(wall.match, walls, stages=stages)
        else:
            symmetric = cell.outline(size_um).keeps(-1, -1)
            layers = [modes.layer(*part.sample(0.5), symmetric=symmetric) for part in walls]
            media = dataclasses.replace(media, heights=tuple(part.reduced_height for part in walls))
        for column, come in places.items():
            found = respond(ways, media, layers, come[0], between=between)
            energy[column] = float((np.abs(found.t) ** 2).sum() + (np.abs(found.r) ** 2).sum())
            for row, leave in places.items():
                sign = come[1] * leave[1]
                t[row, column], r[row, column] = sign * found.t[leave[0]], sign * found.r[leave[0]]
    names = ("x", "y") if light.normal else ("s", "p")
    count = int(np.count_nonzero(np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach))
    return Jones(names, t, r, math.inf, energy, count, False, "")


def _operators(space: mirrors.Orders, ways: Waves, cell: Cell, this: pattern.Slab) -> tuple[Array, Array]:
    return pattern.operators(space, ways, this, cell)


def _waves(space: mirrors.Orders, cell: Cell, light: _Tangent) -> tuple[Waves, dict[int, tuple[int, float]]]:
    """The waves, and for each polarisation of the basis that this class holds: its place, and its sign there.

    At normal incidence the zero order has no Ez or Hz of its own: it is put in front where its set lacks it.
    """

    def holds(part: mirrors.Set) -> bool:
        return bool(((part.m == 0) & (part.n == 0)).any())

    ex, ey, ez, hz = (holds(part) for part in (space.ex, space.ey, space.ez, space.hz))
    quarter = 0
    if light.normal:
        fits = [not (ez and not p) and not (hz and not s) for p, s in ((ex, ey), (ey, ex))]
        quarter = 0 if fits[0] else 1
        if not (ez or hz) and not ex:
            quarter = 1
    p_in, s_in = (ex, ey) if quarter == 0 else (ey, ex)
    bare_p, bare_s = (light.normal and p_in and not ez), (light.normal and s_in and not hz)
    zero = np.zeros(1, int)
    p_m, p_n = (np.concatenate([zero[: int(bare_p)], v]) for v in (space.ez.m, space.ez.n))
    s_m, s_n = (np.concatenate([zero[: int(bare_s)], v]) for v in (space.hz.m, space.hz.n))
    m, n = np.concatenate([p_m, s_m]), np.concatenate([p_n, s_n])
    px, py = cell.lattice.periods_um(cell.pitch_um)
    k = np.stack([light.kx + light.wavelength_um / px * m, light.ky + light.wavelength_um / py * n])
    kappa = np.hypot(*k)
    turn = light.azimuth_rad + quarter * math.pi / 2
    straight = np.array([round(math.cos(turn), 15), round(math.sin(turn), 15)])[:, None]
    along = np.where(kappa > 0, k / np.where(kappa > 0, kappa, 1.0), straight)
    p_count = len(p_m)
    is_p = np.arange(len(m)) < p_count
    e = np.where(is_p, along, np.stack([-along[1], along[0]]))

    def placed(rows: mirrors.Set) -> Array:
        return np.asarray((rows.m[:, None] == m) & (rows.n[:, None] == n), float)

    fold = np.concatenate([placed(space.ex) * e[0], placed(space.ey) * e[1]])
    at = np.flatnonzero((m == 0) & (n == 0))
    places: dict[int, tuple[int, float]] = {}
    for place in at.tolist():
        if light.normal:
            column = int(abs(e[1, place]) > 0.5)
            places[column] = (place, float(np.sign(e[column, place])))
        else:
            places[1 if place < p_count else 0] = (place, 1.0)
    return Waves(space, m, n, kappa, along, p_count, int(bare_p), fold, -1, -1), places  # type: ignore[arg-type]
