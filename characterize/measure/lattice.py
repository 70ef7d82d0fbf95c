"""Lattice of the pillars in a micrograph: two basis vectors from the strongest spatial
frequencies of the picture.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage, optimize

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

_WEAK = 0.25  # least amplitude of a lattice's wave, over that of the strongest
_LONGER = 2.5  # the longer side of a rectangular cell over the pitch, at most
_APART_DEG = 25.0  # least angle between the two waves of a lattice


@dataclass(frozen=True, eq=False, slots=True)
class ImageLattice:
    """Lattice of places origin + i a + j b, (row, column) in pixels; a is the vector
    closer to +x.
    """

    origin: Array
    a: Array
    b: Array

    @property
    def pitch_px(self) -> float:
        """Shortest of the two vectors."""
        return float(min(np.linalg.norm(self.a), np.linalg.norm(self.b)))

    @property
    def kind(self) -> str:
        """Square, hexagonal, rectangular or oblique, to 2 % and 1.5 degrees."""
        length_a, length_b = (float(np.linalg.norm(v)) for v in (self.a, self.b))
        cosine = abs(float(self.a @ self.b)) / length_a / length_b
        angle = math.degrees(math.acos(min(cosine, 1.0)))
        equal = abs(length_a / length_b - 1) < 0.02
        if abs(angle - 90) < 1.5:
            return "square" if equal else "rectangular"
        return "hexagonal" if equal and abs(angle - 60) < 1.5 else "oblique"

    def sites(self, shape: tuple[int, ...]) -> tuple[Array, Array]:
        """((n, 2) row and column, (n, 2) index j and i) of the sites whose cell lies in
        a frame, by j, then by i.

        Args:
            shape: (rows, columns) of the frame.
        """
        # rows of a reduced lattice lie half a pitch apart or more
        reach = math.ceil(2 * math.hypot(*shape[:2]) / self.pitch_px) + 1
        index = np.indices((2 * reach + 1,) * 2).reshape(2, -1).T - reach
        place = self.origin + index @ np.stack([self.b, self.a])
        half = 0.45 * self.pitch_px
        inside = ((place >= half) & (place <= np.array(shape[:2]) - half)).all(1)
        return place[inside], index[inside]


def find_lattice(flat: Array, pitch_px: float | None = None) -> ImageLattice:
    """Lattice of bright pillars in a levelled picture.

    The two strongest wave vectors k give the basis as the inverse matrix of k. Their
    phases give the origin.

    Args:
        flat: (y, x) levelled picture.
        pitch_px: known distance of neighbours: only waves of it or of a longer side
            are considered.

    Accuracy: 1e-3 of a pitch for ten pillars a side; drift of the scan goes into the
    vectors.

    Raises:
        CaptureError: no two waves that could span a lattice (of the stated pitch).
    """
    windowed = (flat - flat.mean()) * np.outer(
        np.hanning(flat.shape[0]), np.hanning(flat.shape[1])
    )
    waves = [_refined(windowed, wave) for wave in _strongest_waves(windowed, pitch_px)]
    inverse = np.linalg.inv(np.array(waves))  # columns span the lattice
    phase = np.angle([_fourier_amplitude(windowed, wave) for wave in waves])
    origin = -inverse @ phase / (2 * math.pi)
    first, second = _shortest_basis(inverse[:, 0], inverse[:, 1])
    a, b = (
        (first, second)
        if abs(first[1]) * np.linalg.norm(second)
        >= abs(second[1]) * np.linalg.norm(first)
        else (second, first)
    )
    return ImageLattice(origin, a * np.sign(a[1] or 1.0), b * np.sign(b[0] or 1.0))


def _strongest_waves(windowed: Array, pitch_px: float | None) -> tuple[Array, Array]:
    """Two strongest waves at an angle of ``_APART_DEG`` or more, (row, column) cycles a
    pixel; the first has the known pitch.

    Args:
        windowed: (y, x) picture times a window.
        pitch_px: known distance of neighbours, or None.
    """
    size = [2 * fft.next_fast_len(n) for n in windowed.shape]
    power = np.abs(fft.rfft2(windowed, size))
    ky = fft.fftfreq(size[0])[:, None]
    kx = fft.rfftfreq(size[1])[None]
    length = np.hypot(ky, kx)
    power = np.where((length > 2.5 / min(windowed.shape)) & (length < 0.35), power, 0.0)
    peaks = (ndimage.maximum_filter(power, 5, mode="wrap") == power) & (
        power > _WEAK * power.max()
    )
    if pitch_px is not None:
        peaks &= (length * pitch_px > 0.9 / _LONGER) & (length * pitch_px < 1.25)
    rows, columns = np.nonzero(peaks)
    first = (
        length[rows, columns] * (pitch_px or math.inf) > 0.9
    )  # before those of a longer side
    order = np.lexsort((-power[rows, columns], ~first))
    waves = np.stack([ky[rows[order], 0], kx[0, columns[order]]], 1)
    for wave in waves[1:] if first.any() else waves[:0]:
        across = abs(waves[0, 0] * wave[1] - waves[0, 1] * wave[0])
        lengths = np.hypot(*waves[0]), np.hypot(*wave)
        if (
            across > math.sin(math.radians(_APART_DEG)) * lengths[0] * lengths[1]
            and lengths[1] < 2.5 * lengths[0]
        ):
            return waves[0], wave
    stated = f" of pitch {pitch_px:.2f} pixels" if pitch_px else ""
    raise CaptureError(
        f"no lattice{stated} in the picture; check pixel and pitch, or crop to the pillars"
    )


def _fourier_amplitude(windowed: Array, wave: Array) -> complex:
    """Fourier transform of a (y, x) picture at one (row, column) frequency."""
    rows, columns = (
        np.exp(-2j * math.pi * frequency * np.arange(size))
        for frequency, size in zip(wave, windowed.shape, strict=True)
    )
    return complex(rows @ windowed @ columns)


def _refined(windowed: Array, wave: Array) -> Array:
    """(2,) frequency of the largest Fourier amplitude close to ``wave``."""
    step = 0.3 / max(windowed.shape)
    solution = optimize.minimize(
        lambda offset: -abs(_fourier_amplitude(windowed, wave + offset * step)),
        np.zeros(2),
        method="Nelder-Mead",
        options={
            "initial_simplex": np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]),
            "xatol": 1e-3,
            "fatol": np.inf,  # whatever the unit of the picture
        },
    )
    return np.asarray(wave + solution.x * step)


def _shortest_basis(first: Array, second: Array) -> tuple[Array, Array]:
    """The two shortest vectors of a lattice, by Gauss reduction of a basis."""
    while True:
        if first @ first > second @ second:
            first, second = second, first
        multiple = round(float(first @ second) / float(first @ first))
        if multiple == 0:
            return first, second
        second = second - multiple * first
