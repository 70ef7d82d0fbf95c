"""How wrong a windowed result is, measured from the light itself at a few samples of the window.

The moments of the lens are taken to a few orders more than the method uses. From those, the field at sampled points is
summed directly over lens nodes in float64, without depth basis, directions or correction terms; the difference in
intensity is the error of everything but rounding at the pillars, which is modelled. Points are drawn in every depth by
intensity and by its root, more at the edges of the window.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from metalens import legendre
from metalens.propagate_case import Case, chief_path
from metalens.propagate_plan import reference_depth
from metalens.propagate_sincos import turns64
from metalens.store import Array
from metalens.threads import one_blas_thread, split

MORE = 8
POINTS = 256  # where nothing else is said
WORK = 3e6  # node sums that an estimate may take
DEPTHS = 16
SAFETY = 1.7


@dataclass(frozen=True, eq=False, slots=True)
class Sample:
    """One wavelength of a result to be judged.

    weight: of its intensity; field: (depth, y, x) complex; moments: (m + MORE, n + MORE) complex128 of the lens;
    noise: standard deviation of the field from rounding at the pillars.
    """

    case: Case
    weight: float
    field: Array
    moments: Array
    noise: float


def relative_error(tiles: list[list[Sample]]) -> float:
    """Estimate of the relative L2 error of the normalised PSFs (all depths of one direction and lens together).

    With δ the error of an intensity I of sum S, that of I/S is δ/S - (I/S)·Σδ/S; its square is estimated without bias.

    Args:
        tiles: parts of one window; each a list of samples, one a wavelength.

    Accuracy: 1 to 3 times the true error on every case of the tests.
    """
    light = np.concatenate([_intensity(samples) for samples in tiles], axis=1)
    edges = np.concatenate([_edges(samples[0].field.shape) for samples in tiles])
    energy = light.sum(1)
    depths = np.unique(np.linspace(0, len(light) - 1, min(len(light), DEPTHS)).round().astype(int))
    normalised = light[depths] / energy[depths, None]
    count = int(np.clip(WORK / tiles[0][0].moments.size, 128, 512)) * min(4, len(tiles))
    points, chance = draw(normalised, edges, count)
    difference = _difference(tiles, light, depths, points) / energy[depths, None]
    noise = sum(2 * s.weight * s.noise**2 * (1 / energy[depths]).sum() for s in tiles[0])
    total = square_error(normalised, points, chance, difference) + float(noise)
    return float(SAFETY * np.sqrt(total / (normalised**2).sum()))


def square_error(normalised: Array, points: Array, chance: Array, difference: Array) -> float:
    """Unbiased estimate of Σ (δ/S - (I/S)·Σδ/S)² from samples of ``difference`` = δ/S (depth, n) at drawn pixels."""
    value = np.take_along_axis(normalised, points, 1)
    a, b, d = difference**2 / chance, value * difference / chance, difference / chance
    n, power = points.shape[1], (normalised**2).sum(1)
    if n == normalised.shape[1]:
        return float((a.sum(1) - 2 * b.sum(1) * d.sum(1) + d.sum(1) ** 2 * power).sum())
    pairs = n * (n - 1)
    cross = (b.sum(1) * d.sum(1) - (b * d).sum(1)) / pairs
    common = (d.sum(1) ** 2 - (d**2).sum(1)) / pairs
    return max(float((a.mean(1) - 2 * cross + common * power).sum()), 0.03 * float(a.mean(1).sum()))


def _intensity(samples: list[Sample]) -> Array:
    """(depth, pixel) of one tile, wavelengths added."""
    depths = len(samples[0].field)
    parts = (s.weight * np.abs(s.field.astype(complex).reshape(depths, -1)) ** 2 for s in samples)
    return np.asarray(sum(parts, np.zeros((depths, 1))))


def _edges(shape: tuple[int, ...]) -> Array:
    """Weight (pixel,) of 1 at the centre of a tile and 10 at its edge, where truncated series err most."""
    y, x = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in shape[-2:])
    return np.asarray(1 + 9 * np.maximum(np.abs(x), np.abs(y)[:, None]) ** 8).ravel()


def draw(normalised: Array, edges: Array, count: int = POINTS) -> tuple[Array, Array]:
    """(depth, n) pixel indices and their chances: a systematic sample, or every pixel where there are few."""
    depths, pixels = normalised.shape
    n = max(8, count // depths)
    if pixels <= n:
        return np.tile(np.arange(pixels), (depths, 1)), np.ones((depths, pixels))
    root = np.sqrt(normalised) * edges
    density = (normalised + root / root.sum(1, keepdims=True)) / 2
    picks = (np.arange(n) + 0.5) / n
    sums = np.cumsum(density, axis=1)
    points = np.stack([np.searchsorted(row / row[-1], picks) for row in sums])
    return points, np.take_along_axis(density, points, 1)


def _difference(tiles: list[list[Sample]], light: Array, depths: Array, points: Array) -> Array:
    """(depth, n) direct intensity less the method's at the drawn pixels."""
    out = -np.take_along_axis(light[depths], points, 1)
    first = 0
    for samples in tiles:
        _, ny, nx = samples[0].field.shape
        row, column = np.nonzero((points >= first) & (points < first + ny * nx))
        y, x = np.divmod(points[row, column] - first, nx)
        for s in samples:
            out[row, column] += s.weight * np.abs(_direct(s, (depths[row], y, x))) ** 2
        first += ny * nx
    return out


def _direct(sample: Sample, at: tuple[Array, Array, Array]) -> Array:
    """(point,) field at (depth, y, x) indices, summed over the finer nodes."""
    case = sample.case
    m, n = sample.moments.shape
    with one_blas_thread():
        light = legendre.to_nodes(m).T @ sample.moments @ legendre.to_nodes(n)
    (hy, hx), (wy, wx) = case.half_size_um, case.window_um
    e, x = legendre.mapped(m, -hy, hy), legendre.mapped(n, -hx, hx)
    points = np.stack([wx[at[2]], wy[at[1]]], -1)
    lengths = [*case.centre_um, case.sensor_distance_um, case.wavelength_um]
    numbers = np.array([*case.tangents, reference_depth(case), *lengths])
    out = np.zeros(len(points), complex)
    turn: Any = _curved
    total: Any = _sum_nodes
    used = np.unique(at[0])

    def work(a: int, b: int) -> None:
        for depth in used[a:b]:
            mine = np.nonzero(at[0] == depth)[0]
            parts = turn(light, e, x, numbers, case.inverse_depths_per_um[depth])
            out[mine] = total(*parts, e, x, points[mine], numbers)

    split(len(used), work)
    return np.asarray(out * case.pitch_um**2 * np.exp(1j * case.wavenumber * chief_path(case)))


@numba.njit(inline="always")
def _source(x, y, numbers, inverse):  # type: ignore[no-untyped-def]
    tilt = 2 * (x * numbers[0] + y * numbers[1])
    s2 = 1 + numbers[0] ** 2 + numbers[1] ** 2
    top = (x * x + y * y) * inverse + tilt
    return top / (np.sqrt(top * inverse + s2) + np.sqrt(s2))


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _curved(light, e, x, numbers, inverse):  # type: ignore[no-untyped-def]
    """Light on the nodes with the phase of a source depth less the reference's: (real, imaginary)."""
    re, im = np.empty(light.shape), np.empty(light.shape)
    for i in range(e.size):
        for j in range(x.size):
            path = _source(x[j], e[i], numbers, inverse) - _source(x[j], e[i], numbers, numbers[2])
            t = path / numbers[6]
            c, s = turns64(t - np.rint(t))
            a, b = light[i, j].real, light[i, j].imag
            re[i, j], im[i, j] = a * c - b * s, a * s + b * c
    return re, im


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _sum_nodes(re, im, e, x, points, numbers):  # type: ignore[no-untyped-def]
    """(point,) kernel of the plan module summed over lens nodes, at window offsets (X, Y)."""
    distance, wavelength = numbers[5], numbers[6]
    k = 2 * np.pi / wavelength
    out = np.zeros(points.shape[0], np.complex128)
    for p in range(points.shape[0]):
        X, Y = points[p]
        total_re, total_im = 0.0, 0.0
        for i in range(e.size):
            dy = numbers[4] - e[i]
            for j in range(x.size):
                dx = numbers[3] - x[j]
                w2 = dx * dx + dy * dy + distance * distance
                q = X * X + Y * Y + 2 * (X * dx + Y * dy)
                r = np.sqrt(w2 + q)
                t = q / ((r + np.sqrt(w2)) * wavelength)
                c, s = turns64(t - np.rint(t))
                near = 1 / r
                scale = distance / (2 * np.pi) * near * near
                h_re, h_im = scale * (c * near + k * s), scale * (s * near - k * c)
                total_re += re[i, j] * h_re - im[i, j] * h_im
                total_im += re[i, j] * h_im + im[i, j] * h_re
        out[p] = complex(total_re, total_im)
    return out
