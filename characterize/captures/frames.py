"""Frames as images: orientation, shifts and normalised cross-correlation."""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from metalens.core.arrays import Array

_QUARTERS = ("turned by 90°", "turned by 180°", "turned by 270°")
TURNS = ("as they are", *_QUARTERS)
MIRRORED = ("mirrored", *(f"mirrored and {words}" for words in _QUARTERS))


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
    ny, nx = frames.shape[1:]
    y, x = np.mgrid[-1 : 1 : ny * 1j, -1 : 1 : nx * 1j].reshape(2, -1)
    design = np.stack([np.ones_like(x), x, y], 1)
    rim = np.ones((ny, nx), bool)
    rim[2:-2, 2:-2] = False
    median = np.nanmedian(frames, axis=(1, 2), keepdims=True)
    filled = np.where(np.isfinite(frames), frames, median)
    planes = np.linalg.lstsq(design[rim.ravel()], filled[:, rim].T, rcond=None)[0]
    return np.asarray(filled - (design @ planes).T.reshape(frames.shape))


def _norm(frames: Array, noise: Array | float) -> Array:
    """(...) norm of (..., y, x) frames less that of their noise (...), in quadrature."""
    power = (frames**2).sum((-2, -1))
    return np.asarray(np.sqrt(np.maximum(power - noise**2, 0.1 * power)))


def best_shift(a: Array, b: Array) -> tuple[int, int]:
    """Shift (y, x) of ``a`` against ``b`` in whole pixels, of the largest
    cross-correlation.

    Args:
        a: (y, x) measured frame.
        b: (y, x) expected frame.
    """
    sides = 2 * a.shape[0], 2 * a.shape[1]
    spectrum = fft.rfft2(a, sides) * np.conj(fft.rfft2(b, sides))
    correlation = fft.fftshift(fft.irfft2(spectrum, sides))
    row, column = np.unravel_index(int(correlation.argmax()), sides)
    return int(row) - a.shape[0], int(column) - a.shape[1]


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
    """Frames for cross-correlation: spectra (n, u, v) of twice the side, and norms (n,)
    less those of the noise, so that weak light does not lower the correlation.
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
