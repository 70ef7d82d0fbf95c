"""How wrong a windowed result is, measured from the light itself at a few samples of
the window.

The moments of the lens are taken to a few orders more than the method uses. From those,
the field at sampled points is
summed directly over lens nodes in float64, without depth basis, directions or
correction terms; the difference in
intensity is the error of everything but rounding at the pillars and the interpolation
inside blocks of pillars, which
are modelled as noise of the pillars. Points are drawn by intensity, by its root, more
at tile edges, and by light near.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.threads import one_blas_thread, run_split
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.layered import media_arrays, node_phases, sum_nodes, sum_rays
from metalens.propagate.operators import depth_factors
from metalens.propagate.paths import rayleigh_sommerfeld_kernel, reference_depth
from metalens.propagate.pillars import Pupils

MORE = 8
POINTS, EVERY = (
    128,
    32,
)  # that an estimate looks at, and more than one in so many where a window has many
DEPTHS = 8
NEAR = 9  # samples on a side of the neighbourhood whose light draws points to a sample
WORK, FEWEST = (
    1e7,
    32,
)  # nodes times points above which fewer points are looked at, and the fewest
SAFETY = 1.7
RAYS = 8  # points at which factors of their own are looked at
FACTORS = 12  # nodes along an axis of the lens on which these are formed
# of the error of intensities, the least that is left of it once they are normalised;
# and where fewer than one in
# ``EVERY`` points are looked at, whose Σδ is mostly scatter of the halo: of rough
# lenses the rest came out negative,
# which left a sixth of the error
NORMALISED, SPARSE = 0.03, 0.5


@dataclass(frozen=True, eq=False, slots=True)
class ErrorSample:
    """One wavelength of a result to be judged.

    weight: of its intensity; moments: (m + MORE, n + MORE) complex128 of the lens, or
    (map, …) of several; noise:
    standard deviation of the field from rounding and interpolation at the pillars;
    parts: tiles along each axis.
    nodes_um: (e,), (x,) of the lens where ``moments`` are the light there, None where
    they are coefficients of
    polynomials. pupils: (components,) signs and (components, map, e, x) factors on the
    light of these nodes, whose
    squares add up; None for the light of one map.
    """

    case: PropagationCase
    weight: float
    moments: Array
    noise: float
    parts: int
    nodes_um: tuple[Array, Array] | None = None
    pupils: tuple[Array, Array] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(depth, y, x)."""
        return len(self.case.inverse_depths_per_um), *self.case.samples


def relative_error(windows: list[list[ErrorSample]], seen: list[Array]) -> float:
    """Estimate of the relative L2 error of the normalised PSFs (all depths of one
    direction and lens together).

    With δ the error of an intensity I of sum S, that of I/S is δ/S - (I/S)·Σδ/S; its
    square is estimated without bias.
    All depths are judged at the same points: the kernel of a point serves them all.

    Args:
        windows: parts of one window that were computed apart; each a list of samples,
            one a wavelength.
        seen: (depth, y, x) intensity of each part, wavelengths added.

    Accuracy: 1 to 3 times the true error on every case of the tests.
    """
    normalised, energy, depths, points, chance = _looked_at(
        windows, seen, _effort(windows)
    )
    direct = _direct_light(windows, depths, points[0]) / energy[:, None]
    difference = direct - np.take_along_axis(normalised, points, 1)
    noise = sum(2 * abs(s.weight) * s.noise**2 * (1 / energy).sum() for s in windows[0])
    least = NORMALISED if points.shape[1] >= normalised.shape[1] // EVERY else SPARSE
    total = square_error(normalised, points, chance, difference, least) + float(noise)
    return float(SAFETY * np.sqrt(total / _squares(normalised).sum()))


def pupil_error(
    windows: list[list[ErrorSample]],
    seen: list[Array],
    pupils: Callable[[PropagationCase], Pupils],
) -> float:
    """Estimate of the relative L2 error of factors that are those of a window's middle
    all over it.

    The factors are smooth over the lens: they are formed on ``FACTORS`` x ``FACTORS``
    nodes, to which the light of a
    point is handed down,

        Σ_yx f(y, x) L(y, x) K(y, x) = Σ_ab f_ab Σ_yx I_a(y) I_b(x) L K,    I: interpolation between the nodes.

    windows, seen: as :func:`relative_error`, of samples with factors, or of scalars,
    which count as |U|² in place of
    them; pupils: those for the middle of a case's window.
    Accuracy: 1.1 to 2.1 times the difference on 25 random lenses; the coarse nodes 1e-4
    of it at 45 degrees.
    """
    nodes = max(math.prod(samples[0].moments.shape[-2:]) for samples in windows)
    few = 2 if nodes * RAYS <= WORK / 8 else 1  # depths
    normalised, energy, depths, points, chance = _looked_at(
        windows, seen, (few * RAYS, few)
    )
    ends = np.cumsum([math.prod(samples[0].shape[-2:]) for samples in windows])
    light = [
        [_at_nodes(replace(s, pupils=None)) for s in samples] for samples in windows
    ]
    found = np.zeros(points.shape)
    for i, point in enumerate(points[0]):
        which = int(np.searchsorted(ends, point, side="right"))
        for s, given in zip(windows[which], light[which], strict=True):
            at = np.divmod(point - (ends[which - 1] if which else 0), s.shape[-1])
            found[:, i] += s.weight * _changed(s, given, (depths, *at), pupils)
    total = square_error(normalised, points, chance, found / energy[:, None], SPARSE)
    return float(SAFETY * np.sqrt(total / _squares(normalised).sum()))


def _changed(
    sample: ErrorSample,
    given: tuple[Array, Array, Array],
    at: tuple[Array, int, int],
    pupils: Callable[[PropagationCase], Pupils],
) -> Array:
    """(depth,) intensity with a point's own factors less that held; given: light and
    places of the nodes; at: indices
    of depths, row and column."""
    (light, e, x), case, (depths, row, column) = given, sample.case, at
    Y, X = case.window_um[0][row], case.window_um[1][column]
    inverse = np.array(case.inverse_depths_per_um)[depths, None, None]
    there = replace(
        case, centre_um=(case.centre_um[0] + float(X), case.centre_um[1] + float(Y))
    )
    (coarse_e, onto_e), (coarse_x, onto_x) = _coarse(e), _coarse(x)
    waves = (
        onto_e
        @ (
            light[:, None]
            * rayleigh_sommerfeld_kernel(case, x, e[:, None], X, Y, inverse)
        )
        @ onto_x.T
    )
    signs, factors = pupils(there)(coarse_e, coarse_x)
    own = signs @ np.abs(np.einsum("cmyx,mzyx->cz", factors, waves)) ** 2
    if sample.pupils is None:
        held = np.abs(waves[0].sum((-1, -2))) ** 2
    else:
        signs, factors = pupils(case)(coarse_e, coarse_x)
        held = signs @ np.abs(np.einsum("cmyx,mzyx->cz", factors, waves)) ** 2
    return np.asarray((own - held) * case.area_um2**2)


def _coarse(places_um: Array) -> tuple[Array, Array]:
    """(n,) few nodes over places of the lens, and (n, place) shares of each in what
    lies there.
    """
    low, high = float(places_um.min()), float(places_um.max())
    if len(places_um) <= FACTORS or not high > low:
        return places_um, np.eye(len(places_um))
    at = (2 * places_um - low - high) / (high - low)
    return np.asarray(legendre.mapped_nodes(FACTORS, low, high)), np.asarray(
        legendre.interpolation_matrix(FACTORS, at)
    ).T


def _looked_at(
    windows: list[list[ErrorSample]], seen: list[Array], count: tuple[int, int]
) -> tuple[Array, Array, Array, Array, Array]:
    """(depth, pixel) light of sum 1 and (depth,) its sums before, of the (depth,)
    indices that are looked at, and
    (depth, n) pixels there with their chances; count: of points and depths."""
    total_depths = len(seen[0])
    edges = np.concatenate(
        [_edges(samples[0].shape, samples[0].parts) for samples in windows]
    )
    depths = np.unique(
        np.linspace(0, total_depths - 1, min(total_depths, count[1]))
        .round()
        .astype(int)
    )
    parts = [part.reshape(total_depths, -1)[depths] for part in seen]
    normalised = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    energy = normalised.sum(1, dtype=float)
    normalised /= energy[:, None].astype(normalised.dtype)
    order = _orders([samples[0].shape for samples in windows])
    mean = np.maximum(
        normalised.mean(0, dtype=float, keepdims=True), 0.0
    )  # a flux may run back where it is dark
    near = _near(mean[0], [samples[0].shape[-2:] for samples in windows])
    points, chance = draw_pixels(mean, order, count[0], edges, near)
    return (
        normalised,
        energy,
        depths,
        np.tile(points, (len(depths), 1)),
        np.tile(chance, (len(depths), 1)),
    )


def square_error(
    normalised: Array,
    points: Array,
    chance: Array,
    difference: Array,
    least: float = NORMALISED,
) -> float:
    """Unbiased estimate of Σ (δ/S - (I/S)·Σδ/S)² from samples of ``difference`` = δ/S
    (depth, n) at drawn pixels.

    least: share of Σ (δ/S)² below which the rest, products of sums of few points, is
    taken for chance.
    """
    value = np.take_along_axis(normalised, points, 1).astype(float)
    a, b, d = difference**2 / chance, value * difference / chance, difference / chance
    n, power = points.shape[1], _squares(normalised)
    if n == normalised.shape[1]:
        return float((a.sum(1) - 2 * b.sum(1) * d.sum(1) + d.sum(1) ** 2 * power).sum())
    pairs = n * (n - 1)
    cross = (b.sum(1) * d.sum(1) - (b * d).sum(1)) / pairs
    common = (d.sum(1) ** 2 - (d**2).sum(1)) / pairs
    return max(
        float((a.mean(1) - 2 * cross + common * power).sum()),
        least * float(a.mean(1).sum()),
    )


def _squares(normalised: Array) -> Array:
    """(depth,) sums of squares, without an array of squares."""
    return np.asarray(np.einsum("ij,ij->i", normalised, normalised, dtype=float))


def _effort(windows: list[list[ErrorSample]]) -> tuple[int, int]:
    """(points, depths) that are looked at: fewer where a point takes the sum over very
    many nodes.
    """
    nodes = max(math.prod(samples[0].moments.shape[-2:]) for samples in windows)
    if windows[0][0].nodes_um is None:
        pixels = sum(math.prod(samples[0].shape[-2:]) for samples in windows)
        return max(POINTS * min(4, len(windows)), pixels // EVERY), DEPTHS
    if nodes * POINTS <= WORK:
        return POINTS * min(4, len(windows)), DEPTHS
    return max(FEWEST, int(WORK / nodes)), DEPTHS // 2


def _edges(shape: tuple[int, ...], parts: int) -> Array:
    """Weight (pixel,) of 1 at the middle of a tile and 10 at its edge, where truncated
    series err most.
    """
    y, x = (_within(n, parts) if n > 1 else np.zeros(1) for n in shape[-2:])
    return np.asarray(1 + 9 * np.maximum(np.abs(x), np.abs(y)[:, None]) ** 8).ravel()


def _within(count: int, parts: int) -> Array:
    """(count,) positions within the tile that holds the sample, -1 to 1."""
    return np.asarray(
        2 * ((np.arange(count) + 0.5) / count * min(parts, count) % 1) - 1
    )


@functools.lru_cache(maxsize=16)
def morton_scan(shape: tuple[int, ...]) -> Array:
    """(pixel,) flat indices of a window (…, y, x) along a curve that stays near itself
    (Morton's).
    """
    y, x = (i.ravel() for i in np.indices(shape[-2:]))
    code = np.zeros(y.size, np.int64)
    for bit in range(16):
        code |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    return np.argsort(code, kind="stable")


def _orders(shapes: list[tuple[int, ...]]) -> Array:
    """:func:`morton_scan` of several windows, one after the other."""
    firsts = np.cumsum([0, *(shape[-2] * shape[-1] for shape in shapes)])
    return np.concatenate(
        [
            first + morton_scan(shape)
            for first, shape in zip(firsts[:-1], shapes, strict=True)
        ]
    )


def _near(mean: Array, shapes: list[tuple[int, ...]]) -> Array:
    """(pixel,) light of a pixel's neighbourhood: beside a sharp spot it is dim, and
    errors are those of the spot.
    """
    ends = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
    parts = zip(np.split(mean, ends), shapes, strict=True)
    return np.concatenate(
        [uniform_filter(part.reshape(shape), NEAR).ravel() for part, shape in parts]
    )


def draw_pixels(
    normalised: Array,
    order: Array,
    count: int,
    edges: Array | float = 1.0,
    near: Array | None = None,
) -> tuple[Array, Array]:
    """(depth, n) pixel indices and their chances: a systematic sample along ``order``,
    or every pixel of few.

    Args:
        normalised: (depth, pixel) of sum 1; the chance follows it, its root times
            ``edges``, and ``near`` if given.
        order: (pixel,) as :func:`morton_scan`, so that the sample is even over the
            window.
        count: of points in all depths together.
    """
    depths, pixels = normalised.shape
    n = max(8, count // depths)
    if pixels <= n:
        return np.tile(np.arange(pixels), (depths, 1)), np.ones((depths, pixels))
    root = np.sqrt(normalised) * edges
    parts = [
        normalised,
        root,
        *(np.broadcast_to(part, root.shape) for part in (near,) if part is not None),
    ]
    density = np.sum(
        [part / part.sum(1, keepdims=True) for part in parts], axis=0
    ) / len(parts)
    sums = np.cumsum(density[:, order], axis=1)
    picks = (np.arange(n) + 0.5) / n
    points = np.stack([order[np.searchsorted(row / row[-1], picks)] for row in sums])
    return points, np.take_along_axis(density, points, 1)


def _direct_light(
    windows: list[list[ErrorSample]], depths: Array, points: Array
) -> Array:
    """(depth, n) direct intensity at the drawn pixels (n,), wavelengths added."""
    out = np.zeros((len(depths), len(points)))
    first = 0
    for samples in windows:
        ny, nx = samples[0].case.samples
        mine = np.nonzero((points >= first) & (points < first + ny * nx))[0]
        at = np.divmod(points[mine] - first, nx)
        for s in samples:
            signs = np.ones(1) if s.pupils is None else s.pupils[0]
            out[:, mine] += s.weight * np.einsum(
                "c,czp->zp", signs, np.abs(_direct(s, depths, at)) ** 2
            )
        first += ny * nx
    return np.asarray(out)


def _at_nodes(sample: ErrorSample) -> tuple[Array, Array, Array]:
    """Light (component, row, column) on nodes of the lens, and their places."""
    (m, n), (e, x), light = sample.moments.shape[-2:], _places(sample), sample.moments
    if sample.nodes_um is None:
        with one_blas_thread():
            light = legendre.to_nodes(m).T @ light @ legendre.to_nodes(n)
    light = light.reshape(-1, m, n)
    return (
        light
        if sample.pupils is None
        else np.einsum("cmyx,myx->cyx", sample.pupils[1], light),
        e,
        x,
    )


def _places(sample: ErrorSample) -> tuple[Array, Array]:
    """(e,), (x,) of its nodes on the lens."""
    if sample.nodes_um is not None:
        return sample.nodes_um
    (m, n), (hy, hx) = sample.moments.shape[-2:], sample.case.half_size_um
    return np.asarray(legendre.mapped_nodes(m, -hy, hy)), np.asarray(
        legendre.mapped_nodes(n, -hx, hx)
    )


def _direct(sample: ErrorSample, depths: Array, at: tuple[Array, Array]) -> Array:
    """(component, depth, point) field at (y, x) indices, summed over the finer nodes;
    one kernel serves them all.
    """
    case = sample.case
    light, e, x = _at_nodes(sample)
    wy, wx = case.window_um
    points = np.stack([wx[at[1]], wy[at[0]]], -1)
    lengths = [*case.centre_um, case.sensor_distance_um, case.wavelength_um]
    numbers: Any = np.array([*case.tangents, reference_depth(case), *lengths])
    inverse = np.array(case.inverse_depths_per_um)[depths]
    spans = _lit(light)
    given = [_of_depths(case, one, (e, x, spans), numbers, inverse) for one in light]
    re, im = (np.concatenate([parts[i] for parts in given], axis=1) for i in (0, 1))
    out = np.zeros((re.shape[1], len(points)), complex)
    total: Any = sum_nodes
    more: tuple[Any, ...] = (spans,)
    if case.behind is not None:
        k = case.wavenumber
        total, numbers = (
            sum_rays,
            (*case.centre_um, (k, *media_arrays(case.behind, k, case.reach_um))),
        )
        more = ()
    run_split(
        len(points),
        lambda a, b: total(re, im, e, x, points[a:b], numbers, *more, out[:, a:b]),
    )
    return np.asarray(out * case.area_um2).reshape(len(light), len(depths), -1)


def _lit(light: Array) -> Array:
    """(row, 2) first column of each row with light of any component (component, row,
    column), and that after the last:
    a round lens leaves the corners of its square dark."""
    there = (light != 0).any(0)
    last = there.shape[1] - there[:, ::-1].argmax(1)
    return np.stack([there.argmax(1), np.where(there.any(1), last, 0)], 1)


def _of_depths(
    case: PropagationCase,
    light: Array,
    at_um: tuple[Array, Array, Array],
    numbers: Array,
    inverse: Array,
) -> Array:
    """(real and imaginary, row, depth, column) light (row, column) with the phase of
    every depth; at_um: places of rows
    and columns, and what :func:`_lit` found."""
    e, x, spans = at_um
    out = np.zeros((2, len(e), len(inverse), len(x)))
    turn: Any = node_phases
    if case.front:
        angle = depth_factors(
            case, e[:, None], x, case.tangents, inverse[:, None, None]
        )
        turned = (light * np.exp(1j * angle)).swapaxes(0, 1)
        out[:] = turned.real, turned.imag
    else:
        run_split(
            len(e),
            lambda a, b: turn(
                light[a:b],
                e[a:b],
                x,
                numbers,
                inverse,
                spans[a:b],
                out[0, a:b],
                out[1, a:b],
            ),
        )
    return out
