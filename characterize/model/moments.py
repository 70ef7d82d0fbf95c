"""Derivatives of frames by what turns or weighs light over the aperture, from
derivatives of the field on the window.

A factor f(x, y) on the lens is, seen from a place (X, Y) of the window, a function of
the direction in which light
comes: a polynomial sum c_ab t^a s^b in the direction cosines (t, s) from the middle
one. Light times t^a s^b has the
field's own derivative there (:func:`window.turned`), so that one field and a few of its
derivatives serve all
parameters: d|E|² = 2 Re sum c_ab conj(E) E_ab. The coefficients change little across a
pixel and are put on after it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from characterize.model.detector import DetectorGrid, SeparableBlur
from characterize.model.kernel import CompressedKernel
from characterize.model.window import STEP, DerivativeOperators, real_complex_product
from metalens.core import legendre, threads
from metalens.core.arrays import Array

LIT = "lit"
Cut = tuple[Any, ...]
WHOLE: Cut = (slice(None), slice(None))
_DEGREE = 5
_PLACES = 4  # of the window along each axis where coefficients are computed
_ACROSS = 15  # places of the lens along each axis that they are fitted to
_BLOCK = 40  # rows of fine samples whose derivatives are formed at once
# of a factor, where no polynomial is close enough: its parameter is computed by itself
MISSED = 5e-3
_COARSE_PIXEL = (
    7e-3  # of the lens's radius: pixels across which coefficients change too much
)


@dataclass(frozen=True, eq=False, slots=True)
class LightFactor:
    """What one unit of a parameter does to the light on the nodes: (frames or 1, q, p)
    ``values`` times one base.

    values: of some rows and columns of the nodes, as these are asked for. moves, um:
    the name by which it moves the
    window too (``distance`` or ``wave``), and by how much. added: another base, as it
    is.
    """

    base: str
    values: Callable[[Cut], Array]
    moves: str = ""
    um: float = 1.0
    added: str = ""

    @classmethod
    def fixed(cls, base: str, values: Array) -> "LightFactor":
        """The same for all frames: (q, p) ``values``."""
        return cls(base, lambda cut: values[cut][None])


@dataclass(frozen=True, eq=False, slots=True)
class LightBases:
    """Light on the nodes that factors act on: ``lit`` (frames, q, p), and ``slopes``
    {name: (q, p)} of the lens, each
    times the ``phasor`` of every frame."""

    lit: Array
    phasor: Array
    slopes: Mapping[str, Array]

    def of(self, name: str) -> Array:
        """(frames, q, p) of one base: ``lit``, or by name."""
        return self.lit if name == LIT else np.asarray(self.slopes[name] * self.phasor)

    def share(self, name: str) -> complex:
        """Of the light itself in a base: it needs no sum of its own, nor loses digits;
        0 for ``lit``.
        """
        return (
            0.0
            if name == LIT
            else complex(
                np.vdot(self.lit, self.of(name)) / np.vdot(self.lit, self.lit).real
            )
        )

    def changed(self, factor: LightFactor) -> Array:
        """(frames, q, p) derivative of the light on the nodes, without the window's own
        move.
        """
        values = factor.values(WHOLE)
        if factor.base == LIT:
            out = values.astype(self.lit.dtype) * self.lit
        else:
            out = (values * self.slopes[factor.base]).astype(
                self.lit.dtype
            ) * self.phasor
        return np.asarray(out + self.of(factor.added) if factor.added else out)


def fine_enough(grid: DetectorGrid, radius_um: float) -> bool:
    """Whether pixels are small enough that coefficients do not change across one, on a
    lens of this radius.
    """
    return grid.pixel_um < _COARSE_PIXEL * radius_um


def light_derivatives(
    turned: DerivativeOperators,
    grid: DetectorGrid,
    blur: SeparableBlur,
    lens: tuple[Array, Array, Array],
    bases: LightBases,
    field: Callable[[str, Array], Array],
    factors: Mapping[str, LightFactor],
    missed: float = MISSED,
) -> dict[str, Array]:
    """(frames, rows, columns) derivatives of the light by name; those that no
    polynomial is close to are left out.

    Args:
        lens: (q, p) direction cosines p and q of the nodes, and which of them meet the
            lens.
        field: (name, (frames, q, p) light) to (frames, Y, X) coarse field. missed:
            share of a factor that is close.
    """
    tables = _tables(turned, grid, lens, factors, missed)
    needed = {LIT: 0}
    for name, (degree, _) in tables.items():
        for base, most in ((factors[name].base, degree), (factors[name].added, 0)):
            needed[base] = max(needed.get(base, 0), most)
    needed.pop("", None)
    needed[LIT] = max(needed.values())
    shares = {base: bases.share(base) for base in needed}
    light = {
        base: bases.of(base) - share * bases.lit if share else bases.of(base)
        for base, share in shares.items()
    }
    seen = _seen(
        turned,
        grid,
        blur,
        {base: field(base, part) for base, part in light.items()},
        needed,
    )
    for base, share in shares.items():
        if share:
            seen[base] += share * seen[LIT][:, : seen[base].shape[1]]
    return {
        name: _summed(table, factors[name], seen) for name, (_, table) in tables.items()
    }


def _summed(table: Array, factor: LightFactor, seen: Mapping[str, Array]) -> Array:
    images = seen[factor.base][:, : table.shape[1]]
    out = 2 * np.einsum("fcyx,fcyx->fyx", *np.broadcast_arrays(table, images)).real
    return np.asarray(out + 2 * seen[factor.added][:, 0].real if factor.added else out)


def monomial_powers(degree: int) -> list[tuple[int, int]]:
    """(a, b) of t^a s^b, the total degree rising."""
    return [(n - b, b) for n in range(degree + 1) for b in range(n + 1)]


def _seen(
    turned: DerivativeOperators,
    grid: DetectorGrid,
    blur: SeparableBlur,
    bases: Mapping[str, Array],
    needed: Mapping[str, int],
) -> dict[str, Array]:
    """{base: (frames, powers, rows, columns)} conj(E) times the derivatives of a base
    field, through the pixels.
    """
    most = max(needed.values(), default=0)
    ways, frames = turned.ways(most), len(bases["lit"])
    out = {
        base: np.empty(
            (frames, len(monomial_powers(degree)), grid.rows, grid.columns),
            bases["lit"].dtype,
        )
        for base, degree in needed.items()
    }
    order = {
        degree: [monomial_powers(degree).index(one) for one in _by_rows(degree)]
        for degree in needed.values()
    }
    turns = {
        degree: np.array([1j ** (a % 2 + b % 2) for a, b in _by_rows(degree)])
        for degree in needed.values()
    }

    def some(first: int, last: int) -> None:
        for i in range(first, last):
            light = bases[LIT][i]
            conjugate = real_complex_product(
                ways[0][0], real_complex_product(ways[1][0], light.T).T
            ).conj()
            for base, degree in needed.items():
                found = _through(blur, conjugate, bases[base][i], ways, degree)
                out[base][i, order[degree]] = found * turns[degree][:, None, None]

    with threads.one_blas_thread():
        threads.run_split(frames, some)
    return out


def _by_rows(degree: int) -> list[tuple[int, int]]:
    """:func:`monomial_powers` in the order of :func:`_through`."""
    return [(a, b) for b in range(degree + 1) for a in range(degree + 1 - b)]


def _through(
    blur: SeparableBlur,
    conjugate: Array,
    field: Array,
    ways: tuple[Array, Array],
    degree: int,
) -> Array:
    """(powers, rows, columns) conj(E) times the derivatives of a field (Y, X), in the
    order of :func:`_by_rows`.

    Weights reach over a few samples only: blocks of rows leave out those that are zero
    for all of them.
    """
    y, x = (way[: degree + 1] for way in ways)
    fine, counts = x.shape[1], [degree + 1 - b for b in range(degree + 1)]
    places = fine * np.concatenate([[0], np.cumsum(counts)])
    across = (
        real_complex_product(x.reshape(-1, x.shape[2]), field.T)
        .reshape(-1, field.shape[0])
        .T.copy()
    )
    out = [np.zeros((len(py), 2 * places[-1]), y.dtype) for py, _ in blur.pairs]
    turned = np.empty((min(_BLOCK, y.shape[1]), places[-1]), field.dtype)
    for first in range(0, y.shape[1], _BLOCK):
        rows = slice(first, first + _BLOCK)
        seen = np.flatnonzero(y[0, rows].any(0))
        part, block = slice(int(seen[0]), int(seen[-1]) + 1), turned[: len(y[0, rows])]
        for b, count in enumerate(counts):
            at = block[:, places[b] : places[b + 1]].view(y.dtype)
            np.matmul(
                y[b, rows, part], across[part, : count * fine].view(y.dtype), out=at
            )
        by_power = block.reshape(len(block), -1, fine)
        by_power *= conjugate[rows, None]
        for down, (py, _) in zip(out, blur.pairs, strict=True):
            down += py[:, rows] @ block.view(y.dtype)
    sums = [one.view(field.dtype).reshape(len(one), -1, fine) for one in out]
    return np.asarray(
        sum(
            s @ px.T.astype(s.dtype)
            for s, (_, px) in zip(sums, blur.pairs, strict=True)
        )
    ).transpose(1, 0, 2)


def _tables(
    turned: DerivativeOperators,
    grid: DetectorGrid,
    lens: tuple[Array, Array, Array],
    factors: Mapping[str, LightFactor],
    missed: float,
) -> dict[str, tuple[int, Array]]:
    """{name: (degree, (frames or 1, powers, rows, columns) coefficients)} of those
    factors that are polynomials.
    """
    some = np.unique(np.linspace(0, len(lens[0]) - 1, _ACROSS).round().astype(int))
    cut = np.ix_(some, some)
    keep = lens[2][cut]
    p, q = (part[cut][keep] for part in lens[:2])
    axes = [legendre.mapped_nodes(_PLACES, *end) for end in grid.ends_um()]
    to_y, to_x = (
        legendre.interpolation_matrix(_PLACES, np.linspace(-1, 1, n))
        for n in (grid.rows, grid.columns)
    )
    places = np.repeat(axes[0], _PLACES)[:, None], np.tile(axes[1], _PLACES)[:, None]
    seen = _directions(turned, p, q, places)
    shapes = np.linalg.qr(
        np.stack([seen[0] ** a * seen[1] ** b for a, b in monomial_powers(_DEGREE)], -1)
    )
    values = {
        name: factor.values(cut)[:, keep].astype(complex)
        for name, factor in factors.items()
    }
    amounts, out = _amounts(shapes[0], list(values.values())), {}
    for (name, factor), one in zip(factors.items(), amounts, strict=True):
        found = _fitted(
            shapes, values[name], one, _moves(turned, factor, p, q, places), missed
        )
        if found is not None:
            degree, table = found
            square = np.moveaxis(table, 0, -1).reshape(
                *table.shape[1:], _PLACES, _PLACES
            )
            out[name] = degree, np.moveaxis(to_y @ square @ to_x.T, 1, 0)
    return out


def _directions(
    turned: DerivativeOperators, p: Array, q: Array, places: tuple[Array, Array]
) -> tuple[Array, Array]:
    """(t, s) of the nodes (n,) seen from places (Y, X), (k, 1) each, of the window: (k,
    n), between -1 and 1.
    """
    by_x, by_y = turned.kernel.turning(p, q, places[1], places[0])
    k, (band_y, band_x) = turned.kernel.k, turned.bands
    return k * by_x / band_x, k * by_y / band_y


def _moves(
    turned: DerivativeOperators,
    factor: LightFactor,
    p: Array,
    q: Array,
    places: tuple[Array, Array],
) -> Array:
    """(k, n) what the window's own move adds at every place, the slope of the kernel's
    logarithm; (1, 1) where none.
    """
    if not factor.moves:
        return np.zeros((1, 1))
    up, down = (
        _logarithm(turned.kernel.moved(factor.moves, sign * STEP), p, q, places)
        for sign in (1, -1)
    )
    length = (
        turned.kernel.distance_um
        if factor.moves == "distance"
        else 2 * math.pi / turned.kernel.k
    )
    return np.asarray(factor.um * (up - down) / (2 * STEP * length))


def _logarithm(
    kernel: CompressedKernel, p: Array, q: Array, places: tuple[Array, Array]
) -> Array:
    path, ray = kernel.path(p, q, places[1], places[0])
    return np.asarray(
        1j * kernel.k * path + np.log(kernel.k * kernel.amplitude(ray)[0])
    )


def _amounts(basis: Array, values: Sequence[Array]) -> list[Array]:
    """(places, powers, frames) products of orthonormal shapes (places, nodes, powers)
    with values (frames, nodes) each:
    all in one, of real numbers."""
    every = np.concatenate(values).T.copy().view(float)
    flat = basis.transpose(0, 2, 1).reshape(-1, basis.shape[1]) @ every
    found = flat.view(complex).reshape(len(basis), basis.shape[2], -1)
    ends = np.cumsum([len(one) for one in values])
    return np.split(found, ends[:-1], axis=2)


def _fitted(
    shapes: tuple[Array, Array],
    values: Array,
    amounts: Array,
    moved: Array,
    missed: float,
) -> tuple[int, Array] | None:
    """(degree, (places, powers, frames) coefficients) of the least degree that is
    close; None where none is.

    shapes: orthonormal ones (places, nodes, powers), and the triangles that make them
    of the powers. amounts: of them
    in ``values`` (frames, nodes); ``moved`` (places or 1, nodes) comes to these.
    """
    basis, triangle = shapes
    if moved.any():
        amounts = amounts + np.einsum("knp,kn->kp", basis, moved)[..., None]
    wanted = (values + moved[:, None]).transpose(0, 2, 1)
    repeats = len(basis) / len(wanted)
    size = repeats * float(
        np.linalg.norm(wanted - 1j * wanted.imag.mean(1, keepdims=True)) ** 2
    )
    left = repeats * float(np.linalg.norm(wanted) ** 2) - np.cumsum(
        (np.abs(amounts) ** 2).sum((0, 2))
    )
    for degree in range(_DEGREE + 1):
        count = len(monomial_powers(degree))
        if left[count - 1] <= missed**2 * size:
            return degree, np.linalg.solve(
                triangle[:, :count, :count], amounts[:, :count]
            )
    return None
