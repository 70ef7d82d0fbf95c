"""Frames as images: orientation, shifts and normalised cross-correlation."""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from metalens.core.arrays import Array

TURNS = ("as they are", "turned by 90°", "turned by 180°", "turned by 270°")
MIRRORED = ("mirrored", *(f"mirrored and {words}" for words in TURNS[1:]))


def orient_frames(frames: Array, orientation: int) -> Array:
    """(n, y, x) frames mirrored left-right for 4 to 7, then turned by 90° (orientation
    mod 4) times.

    Args:
        frames: (n, y, x).
        orientation: 0 to 7.
    """
    turned = frames[..., ::-1] if orientation >= 4 else frames
    return np.rot90(turned, orientation % 4, axes=(-2, -1))


def relative_orientation(first: int, second: int) -> int:
    """Orientation that turns frames of the ``first`` orientation into those of the
    ``second``.

    Args:
        first: orientation, 0 to 7, as :func:`orient_frames` takes it.
        second: likewise.

    >>> relative_orientation(3, 1), relative_orientation(4, 6)
    (2, 2)
    """
    frame = np.arange(4).reshape(1, 2, 2)
    return next(
        orientation
        for orientation in range(8)
        if np.array_equal(
            orient_frames(orient_frames(frame, first), orientation),
            orient_frames(frame, second),
        )
    )


def above_rim(frames: Array) -> Array:
    """(n, y, x) frames less a plane fitted to their two outermost pixels; nan becomes
    the frame's median.

    Args:
        frames: (n, y, x) frames.
    """
    result = np.empty(frames.shape)
    ny, nx = frames.shape[1:]
    y, x = np.mgrid[-1 : 1 : ny * 1j, -1 : 1 : nx * 1j]
    rim = np.ones((ny, nx), bool)
    rim[2:-2, 2:-2] = False
    for i, frame in enumerate(frames):
        filled = np.where(np.isfinite(frame), frame, np.nanmedian(frame))
        design = np.stack([np.ones(rim.sum()), x[rim], y[rim]], 1)
        plane = np.linalg.lstsq(design, filled[rim], rcond=None)[0]
        result[i] = filled - (plane[0] + plane[1] * x + plane[2] * y)
    return result


def _norm(frames: Array, noise: Array | float) -> Array:
    """(...) norm of (..., y, x) frames less that of their noise (...), in quadrature."""
    power = (frames**2).sum((-2, -1))
    return np.asarray(np.sqrt(np.maximum(power - noise**2, 0.1 * power)))


def normalized_cross_correlation(
    a: Array, b: Array, noise: float
) -> tuple[float, tuple[float, float]]:
    """Largest normalised cross-correlation over all shifts, and that shift (y, x) of a
    against b in pixels.

    The norm of ``a`` is reduced by that of its noise, so that weak light does not lower
    the correlation.

    Args:
        a: (y, x) measured frame.
        b: (y, x) expected frame.
        noise: norm of the noise of ``a``.
    """
    norm = float(_norm(a, noise)) * float(np.linalg.norm(b))
    if norm == 0:
        return 0.0, (0.0, 0.0)
    shape = [2 * size for size in a.shape]
    correlation = fft.irfft2(fft.rfft2(a, shape) * np.conj(fft.rfft2(b, shape)), shape)
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    shift = [
        int(index) - size if index >= size // 2 else int(index)
        for index, size in ((row, shape[0]), (column, shape[1]))
    ]
    return min(float(correlation.max()) / norm, 1.0), (float(shift[0]), float(shift[1]))


def shift_frames(light: Array, shift: tuple[int, int]) -> Array:
    """(..., y, x) moved by whole pixels (y, x); nothing comes in from outside.

    Args:
        light: (..., y, x) light.
        shift: (y, x) pixels.
    """
    shifted = np.zeros_like(light)
    rows, columns = light.shape[-2:]
    dy, dx = shift
    shifted[..., max(dy, 0) : rows + min(dy, 0), max(dx, 0) : columns + min(dx, 0)] = (
        light[..., max(-dy, 0) : rows - max(dy, 0), max(-dx, 0) : columns - max(dx, 0)]
    )
    return shifted


@dataclass(frozen=True, eq=False, slots=True)
class FrameSpectra:
    """Frames as :func:`normalized_cross_correlation` correlates them: spectra (n, u, v)
    of twice the side,
    norms (n,) freed of noise.
    """

    spectrum: Array
    norm: Array
    sides: tuple[int, int]

    @classmethod
    def of(cls, frames: Array, noise: Array) -> "FrameSpectra":
        """Of frames with noise of some norm, (n,)."""
        sides = 2 * frames.shape[1], 2 * frames.shape[2]
        return cls(fft.rfft2(frames, sides), _norm(frames, noise), sides)

    def mean_correlation(self, expected: "FrameSpectra") -> float:
        """Mean normalised cross-correlation with expected frames, each at its best
        shift.

        Args:
            expected: spectra of the expected frames.
        """
        correlation = fft.irfft2(
            self.spectrum * np.conj(expected.spectrum), self.sides
        ).max((1, 2))
        norm = self.norm * expected.norm
        return float(
            np.minimum(
                np.divide(
                    correlation, norm, out=np.zeros_like(correlation), where=norm > 0
                ),
                1.0,
            ).mean()
        )
