"""Cells of any shape, lattice and section against fmmax, which shares no code: do both
agree within their bars?

``python -m benchmarks engines_shapes --peers`` (in the environment of ``make
bench-peers``) draws 200 cells of each
kind (half an hour); ``python -m benchmarks.peers.engines_shapes N [SEED [KIND ...]]`` prints
the table of fewer. All four
numbers of t and of r are compared, phases included. Ours: few orders, fixed. fmmax has
no bars: it is given ``FACTOR``
times what its last truncation changes, and ``RASTER`` for its pixels, which are filled
by the shapes' definitions
here. A section with a tilted wall is a staircase there, and its bar so much wider. No
times are taken.
"""

import dataclasses
import functools
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks import Row
from metalens import rcwa
from metalens.cell import Cell, Film, Index, Lattice, Layer
from metalens.cell.shapes import (
    Circle,
    Cross,
    Ellipse,
    Polygon,
    Rectangle,
    RegularPolygon,
    Ring,
    Square,
)
from metalens.core.arrays import Array
from metalens.core.errors import CellError

COUNT, SEED = 200, 9377
HARMONICS = {
    4: 9,
    2: 8,
    1: 7,
}  # of ours, by the last truncation that it would take by itself
TERMS = (49, 97)  # of fmmax
FACTOR = 3.0
STEPS = (3, 6)  # of a tilted wall
PIXELS, FINE, RASTER = 72, (55, 34), 1e-3  # and what the raster may leave
HEXAGONAL = Lattice("hexagonal")
WIDE = Lattice("rectangular", 1.3)
FLAT = Lattice("rectangular", 0.8)
TRIANGLE = Polygon(((-0.5, -0.3), (0.5, -0.35), (0.1, 0.55)))


@dataclasses.dataclass(frozen=True, slots=True)
class Drawn:
    """A cell, its size and a plane wave."""

    cell: Cell
    size_um: float
    wavelength_um: float
    angle_rad: float = 0.0
    azimuth_rad: float = 0.0

    def jones(self, **how: Any) -> rcwa.JonesResponse:
        """By coupled waves; how: tolerance or harmonics."""
        light = {"angle_rad": self.angle_rad, "azimuth_rad": self.azimuth_rad}
        return rcwa.jones(self.cell, self.size_um, self.wavelength_um, **light, **how)


def fitting(cell: Cell, size_um: float, gap: float) -> float:
    """The size, or a smaller one whose widest section leaves a gap, over the pitch."""
    tilt = abs(math.tan(cell.sidewall_rad)) * cell.height_um
    grow = max(layer.grow_um + 2 * layer.coat_um for layer in cell.sections) + tilt
    while cell.gap_um(size_um, grow_um=max(grow, 0.0)) < gap * cell.pitch_um:
        size_um *= 0.95
    return size_um


Shaped = Callable[[np.random.Generator], Any]


def _kind(
    shape: Shaped,
    lattices: tuple[Lattice, ...] = (Lattice(),),
    *,
    light: str = "normal",
    **how: Any,
) -> Callable[[np.random.Generator], Drawn]:
    """Cells of a shape, wider than lenses have them: index 1.4 to 4, 0.3 to 1.6 waves
    in a pitch, flat to tall.

    light: normal, axis (oblique along x or y), or any (any azimuth). how: see
    ``_cell``.
    """

    def draw(rng: np.random.Generator) -> Drawn:
        pitch = float(rng.uniform(0.25, 0.7))
        cell = _cell(
            rng, pitch, shape(rng), lattices[int(rng.integers(len(lattices)))], **how
        )
        wavelength = pitch * cell.substrate.n / rng.uniform(0.4, 1.3)  # type: ignore[union-attr]
        angle = 0.0 if light == "normal" else float(rng.uniform(0.03, 1.0))
        azimuth = float(
            rng.uniform(-3.1, 3.1) if light == "any" else rng.integers(4) * math.pi / 2
        )
        return Drawn(
            cell,
            fitting(cell, pitch * rng.uniform(0.2, 0.9), 0.03),
            wavelength,
            angle,
            azimuth if angle else 0.0,
        )

    return draw


def _cell(
    rng: np.random.Generator,
    pitch: float,
    shape: Any,
    lattice: Lattice,
    *,
    absorbing: bool = False,
    layered: bool = False,
    tilted: bool = False,
) -> Cell:
    k = float(10 ** rng.uniform(-2, 0)) if absorbing else 0.0
    about = {
        "pillar": Index(rng.uniform(1.4, 4.0), k),
        "between": Index(rng.uniform(1.0, 1.35)),
        "substrate": Index(rng.uniform(1.2, 2.0)),
        "cover": Index(rng.uniform(1.0, 1.5)),
    }
    if rng.uniform() < 0.2:  # sections of the rarer medium
        about["pillar"], about["between"] = about["between"], about["pillar"]
    heights = rng.uniform(0.1, 0.3, 3) * (1.0, 3.0, 0.6) * pitch
    if layered:
        layers = (
            Layer(
                heights[0],
                grow_um=0.1 * pitch * rng.uniform(),
                material=Index(rng.uniform(1.4, 2.4)),
            ),
            Layer(heights[1], coat_um=0.04 * pitch, coat=Index(rng.uniform(1.5, 2.4))),
            Layer(
                heights[2],
                grow_um=-0.05 * pitch * rng.uniform(),
                material=Index(rng.uniform(1.5, 3.0), 0.1),
            ),
        )
        films = {
            "under": (Film(Index(2.1), 0.1 * pitch),),
            "over": (Film(Index(1.6), 0.2 * pitch),),
        }
        return Cell(
            pitch,
            float(sum(heights)),
            **about,
            shape=shape,
            lattice=lattice,
            layers=layers,
            **films,
        )
    tilt = {"sidewall_rad": float(rng.uniform(-0.06, 0.12))} if tilted else {}
    height = pitch * (rng.uniform(0.3, 1.0) if tilted else 2 ** rng.uniform(-4, 2))
    return Cell(pitch, height, **about, shape=shape, lattice=lattice, **tilt)


def _turned(rng: np.random.Generator) -> float:
    return float(rng.uniform(-1.5, 1.5) * (rng.uniform() < 0.3))


SHAPES: dict[str, Shaped] = {
    "circles": lambda rng: Circle(),
    "squares": lambda rng: Square(_turned(rng)),
    "rectangles": lambda rng: Rectangle(rng.uniform(0.3, 0.95), _turned(rng)),
    "ellipses": lambda rng: Ellipse(rng.uniform(0.3, 0.95), _turned(rng)),
    "rings": lambda rng: Ring(rng.uniform(0.25, 0.75)),
    "crosses": lambda rng: Cross(rng.uniform(0.25, 0.6), _turned(rng)),
    "polygons": lambda rng: [
        RegularPolygon(int(rng.integers(3, 9)), _turned(rng)),
        TRIANGLE,
    ][rng.uniform() < 0.2],
}
HOLES = tuple(
    SHAPES[name] for name in ("circles", "squares", "rectangles", "ellipses", "crosses")
)


def _one_of(shapes: tuple[Shaped, ...], *, hole: bool = False) -> Shaped:
    def draw(rng: np.random.Generator) -> Any:
        shape = shapes[int(rng.integers(len(shapes)))](rng)
        return dataclasses.replace(shape, hole=True) if hole else shape

    return draw


ANY = _one_of(tuple(SHAPES.values()))
GROWING = _one_of(tuple(SHAPES[n] for n in SHAPES if n != "polygons"))
KINDS: dict[str, Callable[[np.random.Generator], Drawn]] = {
    **{name: _kind(shape) for name, shape in SHAPES.items() if name != "circles"},
    "holes": _kind(_one_of(HOLES, hole=True)),
    "hexagonal lattice": _kind(
        _one_of((SHAPES["circles"], SHAPES["ellipses"], SHAPES["rectangles"])),
        (HEXAGONAL,),
    ),
    "rectangular lattice": _kind(ANY, (WIDE, FLAT)),
    "in layers, films": _kind(GROWING, layered=True),
    "tilted walls": _kind(GROWING, tilted=True),
    "oblique, along the axes": _kind(ANY, light="axis"),
    "oblique, any azimuth": _kind(ANY, light="any"),
    "absorbing": _kind(ANY, absorbing=True),
}


def raster(cell: Cell, size_um: float, grow_um: float) -> Array:
    """Share of every pixel of the primitive cell, pitch 1, that the section covers:
    from the definitions of shapes.
    """
    count, generator = FINE
    k = np.arange(
        count
    )  # points of a pixel: a lattice of rank 1, no two in a row or column
    i = (np.arange(PIXELS)[:, None, None] + (k + 0.5) / count) / PIXELS
    j = (np.arange(PIXELS)[:, None] + (generator * k % count + 0.5) / count) / PIXELS
    u, v = primitive(cell.lattice)
    x, y = (i * u[axis] + j * v[axis] for axis in (0, 1))
    inside = np.zeros((PIXELS, PIXELS, count), bool)
    size, grow = size_um / cell.pitch_um, grow_um / cell.pitch_um
    for a in (-1, 0):  # sites at the corners; no section reaches further
        for b in (-1, 0):
            inside |= within(
                cell.shape, size, grow, x + a * u[0] + b * v[0], y + a * u[1] + b * v[1]
            )
    return np.asarray(inside.mean(axis=2))


def primitive(lattice: Lattice) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two steps of the lattice, pitch 1."""
    if lattice.kind == "hexagonal":
        return (1.0, 0.0), (0.5, math.sqrt(3) / 2)
    return (1.0, 0.0), (0.0, lattice.ratio)


def within(shape: Any, size: float, grow: float, x: Array, y: Array) -> Array:
    """Whether points lie in the solid section."""
    angle = getattr(shape, "angle_rad", 0.0)
    c, s = math.cos(angle), math.sin(angle)
    x, y = c * x + s * y, c * y - s * x
    wide, deep = size + grow, getattr(shape, "ratio", 1.0) * size + grow
    if isinstance(shape, Circle | Ellipse):
        return np.asarray((x / wide) ** 2 + (y / deep) ** 2 < 0.25)
    if isinstance(shape, Ring):
        inner = shape.ratio * size - grow
        return np.asarray((np.hypot(x, y) < wide / 2) & (np.hypot(x, y) >= inner / 2))
    if isinstance(shape, Square | Rectangle):
        return np.asarray((np.abs(x) < wide / 2) & (np.abs(y) < deep / 2))
    if isinstance(shape, Cross):
        across = (np.abs(x) < wide / 2) & (np.abs(y) < deep / 2)
        return np.asarray(across | ((np.abs(y) < wide / 2) & (np.abs(x) < deep / 2)))
    if isinstance(shape, RegularPolygon):
        apothem = size / 2 * math.cos(math.pi / shape.sides) + grow / 2
        faces = (2 * np.arange(shape.sides) + 1) * math.pi / shape.sides
        return np.all(
            [x * math.cos(f) + y * math.sin(f) < apothem for f in faces], axis=0
        )
    corners = size * np.array(shape.corners)
    edges = (
        np.roll(corners, -1, axis=0) - corners
    )  # anticlockwise and convex, as ``TRIANGLE`` is
    return np.all(
        [
            e[0] * (y - p[1]) - e[1] * (x - p[0]) > 0
            for p, e in zip(corners, edges, strict=True)
        ],
        axis=0,
    )


def slabs(one: Drawn, steps: int) -> tuple[list[Array], list[float]]:
    """Permittivities on the raster and heights in pitches, foot first; films and
    half-spaces are left out.
    """
    cell, foot, found, heights = one.cell, 0.0, [], []
    for layer in cell.sections:
        pieces = steps if cell.sidewall_rad else 1
        for piece in range(pieces):
            middle = foot + (piece + 0.5) / pieces * layer.height_um
            lean = -2 * math.tan(cell.sidewall_rad) * (middle - cell.height_um / 2)
            found.append(permittivity(one, layer, layer.grow_um + lean))
            heights.append(layer.height_um / pieces / cell.pitch_um)
        foot += layer.height_um
    return found, heights


def permittivity(one: Drawn, layer: Layer, grow_um: float) -> Array:
    """Of one section, on the raster."""
    cell = one.cell
    pillar, around = (
        _square(a or b)
        for a, b in ((layer.material, cell.pillar), (layer.between, cell.between))
    )
    if cell.shape.hole:
        pillar, around = around, pillar
    solid = raster(cell, one.size_um, grow_um)
    if layer.coat is None:
        return around + (pillar - around) * solid
    coated = raster(cell, one.size_um, grow_um + 2 * layer.coat_um)
    return (
        around
        + (_square(layer.coat) - around) * coated
        + (pillar - _square(layer.coat)) * solid
    )


def _square(material: Any) -> complex:
    return complex(material.n, material.k) ** 2


@functools.cache
def _compiled(lattice: Lattice, terms: int) -> Callable[..., Any]:
    """The scattering matrix of fmmax for lengths in pitches, compiled: zero-order (Hx,
    Hy) blocks of t and r.
    """
    import fmmax
    import jax

    jax.config.update("jax_enable_x64", True)
    u, v = primitive(lattice)
    vectors = fmmax.LatticeVectors(*(w[0] * fmmax.X + w[1] * fmmax.Y for w in (u, v)))
    expansion = fmmax.generate_expansion(
        vectors, terms, fmmax.TruncatedSolution.CIRCULAR
    )
    zero = np.array([0, expansion.num_terms])

    @jax.jit
    def solve(wavelength: Any, kxy: Any, permittivities: Any, heights: Any) -> Any:
        layers = [
            fmmax.eigensolve_isotropic_media(
                wavelength=wavelength,
                in_plane_wavevector=kxy,
                primitive_lattice_vectors=vectors,
                permittivity=eps,
                expansion=expansion,
                formulation=fmmax.Formulation.JONES_DIRECT_FOURIER,
            )
            for eps in permittivities
        ]
        found = fmmax.stack_s_matrix(layers, list(heights))
        return found.s11[zero[:, None], zero], found.s21[zero[:, None], zero]

    return solve


def fmmax_both(one: Drawn, terms: int, steps: int) -> Array:
    """(2, 2, 2): t and r of fmmax in the basis of :func:`metalens.rcwa.jones`."""
    import jax.numpy as jnp

    cell, pitch = one.cell, one.cell.pitch_um
    inner, heights = slabs(one, steps)
    films = [
        [(np.full((1, 1), _square(f.material)), f.thickness_um / pitch) for f in s]
        for s in (cell.under, cell.over)
    ]
    ends = [np.full((1, 1), _square(m)) for m in (cell.substrate, cell.cover)]
    eps = [
        ends[0],
        *(e for e, _ in films[0]),
        *inner,
        *(e for e, _ in films[1]),
        ends[1],
    ]
    thick = [0.0, *(h for _, h in films[0]), *heights, *(h for _, h in films[1]), 0.0]
    wavelength = one.wavelength_um / pitch
    sine = math.sin(one.angle_rad)
    along = np.array([math.cos(one.azimuth_rad), math.sin(one.azimuth_rad)])
    t, r = _compiled(cell.lattice, terms)(
        jnp.asarray(wavelength),
        jnp.asarray(2 * math.pi / wavelength * sine * along),
        tuple(jnp.asarray(e, dtype=complex) for e in eps),
        tuple(jnp.asarray(h) for h in thick),
    )
    below, above = (
        _amplitudes(complex(e[0, 0]).real, sine, along, bool(one.angle_rad))
        for e in ends
    )
    back = np.linalg.inv(below)
    return np.stack([above @ np.asarray(t) @ back, -below @ np.asarray(r) @ back])


def _amplitudes(eps: float, sine: float, along: Array, oblique: bool) -> Array:
    """(2, 2): from tangential (Hx, Hy) of a forward wave to power-normalised
    amplitudes, signs those of the field E.

    With k the plane of incidence and s = z x k: E_s = -H_k / kz, E_k = kz H_s / eps
    (lengths over k0).
    """
    kz = math.sqrt(eps - sine**2)
    s = np.array([-along[1], along[0]])
    waves = np.stack([-along / math.sqrt(kz), s * math.sqrt(kz / eps)])
    return waves if oblique else waves[::-1]


def shares(one: Drawn) -> tuple[float, float, float]:
    """|difference| over the sum of both bars, the largest of t and r; both bars."""
    most = rcwa.most_harmonics(
        one.cell, one.size_um, angle_rad=one.angle_rad, azimuth_rad=one.azimuth_rad
    )
    harmonics = HARMONICS[{15: 4, 10: 2, 7: 1}[most]]
    ours = one.jones(harmonics=harmonics)
    tilted = bool(one.cell.sidewall_rad)
    rough, fine = (fmmax_both(one, n, STEPS[0]) for n in TERMS)
    bar = RASTER + FACTOR * float(np.abs(fine - rough).max())
    if tilted:  # errors of the staircase fall as 1 / steps²
        smoother = fmmax_both(one, TERMS[0], STEPS[1])
        bar += FACTOR * float(np.abs(smoother - rough).max())
        fine = fine + (smoother - rough)
    apart = float(np.abs(np.stack([ours.t, ours.r]) - fine).max())
    return apart / (ours.t_error + bar), ours.t_error, bar


def compared(kind: str, count: int, seed: int = SEED) -> dict[str, float]:
    """Counts of one kind; cells that overlap or have no zero order are drawn again."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    found: list[tuple[float, float, float]] = []
    while len(found) < count:
        try:
            found.append(shares(KINDS[kind](rng)))
        except CellError:
            continue
    share, ours, theirs = np.array(found).T
    return {
        "cells": len(found),
        "apart": int(np.count_nonzero(share > 1)),
        "largest_share_of_both_bars": float(share.max()),
        "median_share_of_both_bars": float(np.median(share)),
        "median_bar": float(np.median(ours)),
        "median_bar_fmmax": float(np.median(theirs)),
        "seed": seed,
    }


def peer_rows(
    count: int = COUNT, seed: int = SEED, kinds: tuple[str, ...] = tuple(KINDS)
) -> list[Row]:
    """One row a kind."""
    return [_row(kind, compared(kind, count, seed)) for kind in kinds]


def _row(kind: str, found: dict[str, float]) -> Row:
    bars = f"median bars {found['median_bar']:.2g} and {found['median_bar_fmmax']:.2g}"
    return Row(
        case=f"{kind}, seed {found['seed']}: {found['apart']} of {found['cells']} outside both bars, {bars}",
        method="RCWA and fmmax",
        seconds=math.nan,
        error=found["largest_share_of_both_bars"],
        against="largest |difference| of t and r, both polarisations, over the sum of both bars",
        goal="below 1",
    )


if __name__ == "__main__":
    from benchmarks.__main__ import table

    numbers = [int(word) for word in sys.argv[1:3]]
    sys.stdout.write(
        table(peer_rows(*numbers, *([tuple(sys.argv[3:])] if sys.argv[3:] else [])))
        + "\n"
    )  # type: ignore[arg-type]
