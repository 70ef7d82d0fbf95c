"""The lattice of the pillars in a micrograph: any two basis vectors, from the waves
that the picture holds.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage, optimize

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

_WEAK = 0.25  # amplitude of a lattice's wave over the strongest of all
_LONGER = 2.5  # the longer side of a rectangular cell over the pitch, at most
_APART_DEG = 25.0  # least angle between the two waves of a lattice


@dataclass(frozen=True, eq=False, slots=True)
class ImageLattice:
    """Places origin + i a + j b, in pixels as (row, column); a is the vector nearer to
    +x.
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
        one = float(np.linalg.norm(self.a))
        other = float(np.linalg.norm(self.b))
        angle = math.degrees(
            math.acos(np.clip(float(self.a @ self.b) / one / other, -1, 1))
        )
        alike = abs(one / other - 1) < 0.02
        if abs(angle - 90) < 1.5:
            return "square" if alike else "rectangular"
        return (
            "hexagonal"
            if alike and min(abs(angle - 60), abs(angle - 120)) < 1.5
            else "oblique"
        )

    def sites(self, shape: tuple[int, ...]) -> tuple[Array, Array]:
        """((n, 2) row and column, (n, 2) index j and i) of sites whose cell lies in the
        frame, by j, then by i.
        """
        corners = (
            np.array(list(itertools.product((0, shape[0]), (0, shape[1]))))
            - self.origin
        )
        index = corners @ np.linalg.inv(np.stack([self.b, self.a]))
        low = np.floor(index.min(0)).astype(int)
        high = np.ceil(index.max(0)).astype(int)
        j, i = (
            g.ravel()
            for g in np.meshgrid(
                *(np.arange(p, q + 1) for p, q in zip(low, high, strict=True)),
                indexing="ij",
            )
        )
        place = self.origin + j[:, None] * self.b + i[:, None] * self.a
        half = 0.45 * self.pitch_px
        keep = ((place >= half) & (place <= np.array(shape[:2]) - half)).all(1)
        return place[keep], np.stack([j, i], 1)[keep]


def find_lattice(flat: Array, pitch_px: float | None = None) -> ImageLattice:
    """The lattice of bright pillars in a levelled picture.

    Args:
        flat: (y, x) levelled picture.
        pitch_px: distance of neighbours where it is known: waves of neither it nor a
            longer side are not considered.

    Accuracy: 1e-3 of a pitch for ten pillars a side; drift of the scan goes into the
    vectors.

    Raises:
        CaptureError: no two waves that could span a lattice (of the stated pitch).
    """
    seen = (flat - flat.mean()) * np.outer(
        np.hanning(flat.shape[0]), np.hanning(flat.shape[1])
    )
    waves = [_refined(seen, wave) for wave in _waves(seen, pitch_px)]
    inverse = np.linalg.inv(np.array(waves))  # columns span the lattice
    phase = np.angle([_amount(seen, wave) for wave in waves])
    origin = -inverse @ phase / (2 * math.pi)
    one, other = _reduced(inverse[:, 0], inverse[:, 1])
    a, b = (
        (one, other)
        if abs(one[1]) * np.linalg.norm(other) >= abs(other[1]) * np.linalg.norm(one)
        else (other, one)
    )
    return ImageLattice(origin, a * np.sign(a[1] or 1.0), b * np.sign(b[0] or 1.0))


def _waves(seen: Array, pitch_px: float | None) -> tuple[Array, Array]:
    """Two strongest waves (cycles a pixel: row, column) not along one line, the first
    of the known pitch.
    """
    size = [2 * fft.next_fast_len(n) for n in seen.shape]
    power = np.abs(fft.rfft2(seen, size))
    ky, kx = fft.fftfreq(size[0])[:, None], fft.rfftfreq(size[1])[None]
    length = np.hypot(ky, kx)
    power = np.where((length > 2.5 / min(seen.shape)) & (length < 0.35), power, 0.0)
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


def _amount(seen: Array, wave: Array) -> complex:
    rows, columns = (
        np.exp(-2j * math.pi * k * np.arange(n))
        for k, n in zip(wave, seen.shape, strict=True)
    )
    return complex(rows @ seen @ columns)


def _refined(seen: Array, wave: Array) -> Array:
    """The wave at the top of its peak."""
    step = 0.3 / max(seen.shape)
    simplex = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    ends = {
        "initial_simplex": simplex,
        "xatol": 1e-3,
        "fatol": np.inf,
    }  # whatever the unit of the picture
    found = optimize.minimize(
        lambda k: -abs(_amount(seen, wave + k * step)),
        simplex[0],
        method="Nelder-Mead",
        options=ends,
    )
    return np.asarray(wave + found.x * step)


def _reduced(one: Array, other: Array) -> tuple[Array, Array]:
    """The shortest two vectors of a lattice (Gauss)."""
    while True:
        if one @ one > other @ other:
            one, other = other, one
        turns = round(float(one @ other) / float(one @ one))
        if turns == 0:
            return one, other
        other = other - turns * one
