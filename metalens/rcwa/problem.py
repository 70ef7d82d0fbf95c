"""One cell of any shape in one light, as coupled waves take it: tangential wave vector,
media, symmetries, waves.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.cell import Cell, Film, check_direction, materials
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa.made import check_size
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import FLIP_X, FLIP_Y, HALF_TURN, IDENTITY, Operation
from metalens.rcwa.orders.waves import PlaneWaves
from metalens.rcwa.stack import StackMedia

_STRAIGHT = 1e-12


@dataclass(frozen=True, slots=True)
class TangentialWave:
    """Tangential wave vector over k0, azimuth (0 at normal incidence) and wavelength."""

    kx: float
    ky: float
    azimuth_rad: float
    wavelength_um: float

    @property
    def normal(self) -> bool:
        """Whether the light comes along z."""
        return self.kx == 0 == self.ky


@dataclass(frozen=True, slots=True)
class CellProblem:
    """A cell at one size and light, its media, and the symmetries that its
    polarisations have.
    """

    cell: Cell
    size_um: float
    light: TangentialWave
    media: StackMedia
    classes: tuple[tuple[Operation, ...], ...]


def cell_problem(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    angle_rad: float,
    azimuth_rad: float,
) -> CellProblem:
    """Check a cell, its size and its light, and put them together.

    Raises:
        CellError: pillars that touch or lose their outline, an impossible angle, no
            zero order.
        MaterialError: a wavelength outside the range of a material.
    """
    light = tangential_wave(wavelength_um, angle_rad, azimuth_rad)
    between = stack_media(cell, light)
    check_size(cell, size_um)
    return CellProblem(
        cell, size_um, light, between, symmetry_classes(cell, size_um, light)
    )


def tangential_wave(
    wavelength_um: float, angle_rad: float, azimuth_rad: float
) -> TangentialWave:
    """The tangential wave vector, its components 0 where they are 0 but for rounding."""
    check_direction(angle_rad, azimuth_rad)
    sine = math.sin(angle_rad)
    flat = 0.0 if sine == 0 else azimuth_rad
    kx, ky = (
        0.0 if abs(v) < _STRAIGHT else v
        for v in (sine * math.cos(flat), sine * math.sin(flat))
    )
    return TangentialWave(kx, ky, flat, wavelength_um)


def stack_media(cell: Cell, light: TangentialWave) -> StackMedia:
    """Indices of half-spaces and films, thicknesses times k0.

    Raises:
        CellError: no zero order in the substrate. MaterialError: a wavelength outside
            the range of a material.
    """
    k0 = 2 * math.pi / light.wavelength_um

    def films(stack: tuple[Film, ...]) -> tuple[tuple[complex, float], ...]:
        return tuple(
            (materials.index(f.material, light.wavelength_um), f.thickness_um * k0)
            for f in stack
        )

    below, above = (
        materials.index(m, light.wavelength_um) for m in (cell.substrate, cell.cover)
    )
    if below.real <= math.hypot(light.kx, light.ky):
        raise CellError(
            f"sin(angle_rad) = {math.hypot(light.kx, light.ky):.6g} in a substrate of n = {below.real:.6g}: the light "
            "cannot come from there; need a smaller angle_rad or another substrate"
        )
    return StackMedia(below, above, films(cell.under), films(cell.over))


def symmetry_classes(
    cell: Cell, size_um: float, light: TangentialWave
) -> tuple[tuple[Operation, ...], ...]:
    """Sets of operations whose fields together make every polarisation: one set, or one
    for each polarisation.
    """
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
    return (
        ((IDENTITY, HALF_TURN),)
        if outline.keeps(-1, -1) and light.normal
        else ((IDENTITY,),)
    )


def waves_of(
    space: mirrors.ReducedOrders, cell: Cell, light: TangentialWave
) -> tuple[PlaneWaves, dict[int, tuple[int, float]]]:
    """The waves, and for each polarisation of the basis that this class holds: its
    place, and its sign there.

    At normal incidence the zero order has no Ez or Hz of its own: it is put in front
    where its set lacks it.
    """

    (ex, ey, ez, hz), quarter = _zero_orders(space, light)
    p_in, s_in = (ex, ey) if quarter == 0 else (ey, ex)
    bare_p, bare_s = (
        (light.normal and p_in and not ez),
        (light.normal and s_in and not hz),
    )
    zero = np.zeros(1, int)
    p_m, p_n = (
        np.concatenate([zero[: int(bare_p)], v]) for v in (space.ez.m, space.ez.n)
    )
    s_m, s_n = (
        np.concatenate([zero[: int(bare_s)], v]) for v in (space.hz.m, space.hz.n)
    )
    m, n = np.concatenate([p_m, s_m]), np.concatenate([p_n, s_n])
    px, py = cell.lattice.periods_um(cell.pitch_um)
    k = np.stack(
        [
            light.kx + light.wavelength_um / px * m,
            light.ky + light.wavelength_um / py * n,
        ]
    )
    kappa = np.hypot(*k)
    turn = light.azimuth_rad + quarter * math.pi / 2
    straight = np.array([round(math.cos(turn), 15), round(math.sin(turn), 15)])[:, None]
    along = np.where(kappa > 0, k / np.where(kappa > 0, kappa, 1.0), straight)
    p_count = len(p_m)
    is_p = np.arange(len(m)) < p_count
    e = np.where(is_p, along, np.stack([-along[1], along[0]]))

    def placed(rows: mirrors.OrderSet) -> Array:
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
    any_space: Any = space  # its sets of orders are all that waves need
    ways = PlaneWaves(any_space, m, n, kappa, along, p_count, int(bare_p), fold, -1, -1)
    return ways, places


def _zero_orders(
    space: mirrors.ReducedOrders, light: TangentialWave
) -> tuple[tuple[bool, ...], int]:
    """Which of Ex, Ey, Ez, Hz hold the zero order, and whether its p wave lies along y
    (1) or x (0).
    """
    held = tuple(
        bool(((s.m == 0) & (s.n == 0)).any())
        for s in (space.ex, space.ey, space.ez, space.hz)
    )
    ex, ey, ez, hz = held
    quarter = 0
    if light.normal:
        fits = not (ez and not ex) and not (hz and not ey)
        quarter = 0 if fits else 1
        if not (ez or hz) and not ex:
            quarter = 1
    return held, quarter
