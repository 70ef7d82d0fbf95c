"""From the intensity in front of the sensor to expected electrons: source size, blur,
pixel area, gain, background.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, special

from metalens.core.arrays import Array
from metalens.lens import Lens

_ROOM_UM = 20.0  # for decentre


@dataclass(frozen=True, slots=True)
class DetectorGrid:
    """Fine samples under the pixels of a window, with a margin that keeps blur from
    wrapping around.

    rows, columns: pixels of the window. oversample: fine samples per pixel side.
    margin: pixels on each side. middle_um: (x, y) of the window's middle from the chief
    ray.
    fill: width of a pixel over the pitch.
    """

    rows: int
    columns: int
    pixel_um: float
    oversample: int = 1
    margin: int = 2
    middle_um: tuple[float, float] = (0.0, 0.0)
    fill: float = 1.0

    @property
    def fine_um(self) -> float:
        """Pitch of the fine samples."""
        return self.pixel_um / self.oversample

    @property
    def wide_um(self) -> float:
        """Width of a pixel."""
        return self.fill * self.pixel_um

    @property
    def fine_shape(self) -> tuple[int, int]:
        """(rows, columns) of the fine samples."""
        rows, columns = (
            (pixels + 2 * self.margin) * self.oversample
            for pixels in (self.rows, self.columns)
        )
        return rows, columns

    def axes_um(self) -> tuple[Array, Array]:
        """(y, x) of the fine samples from the chief ray, um.

        One lies at the middle of each pixel; ``middle_um`` is at pixel
        ((rows - 1) / 2, (columns - 1) / 2).
        """
        x, y = self.middle_um
        off = (self.oversample - 1) // 2 - (self.oversample - 1) / 2
        rows, columns = (
            (np.arange(n) - (n - 1) / 2 + off) * self.fine_um for n in self.fine_shape
        )
        return rows + y, columns + x

    def across_um(self, near_um: float) -> float:
        """Side of a square about the chief ray that contains the window, um.

        Offsets of the window count beyond ``near_um`` only.
        """
        off = max(0.0, *(abs(v) - near_um for v in self.middle_um))
        side = (max(self.rows, self.columns) + self.margin) * self.pixel_um
        return side + _ROOM_UM + 2 * off

    def frequencies(self) -> tuple[Array, Array]:
        """Cycles/um of the fine grid: (y, 1) and (1, x / 2 + 1), as
        :func:`scipy.fft.rfft2` orders them.
        """
        rows, columns = self.fine_shape
        fy = fft.fftfreq(rows, self.fine_um)
        fx = fft.rfftfreq(columns, self.fine_um)
        return fy[:, None], fx[None]

    def sample(self, intensity: Array, transfer: Array) -> Array:
        """(..., rows, columns) blurred intensity at the pixel centres.

        Args:
            intensity: (..., y, x) on the fine grid.
            transfer: of the blur, (..., fy, fx).
        """
        blurred = fft.irfft2(fft.rfft2(intensity) * transfer, s=intensity.shape[-2:])
        o, m = self.oversample, self.margin
        y, x = (
            slice(m * o + o // 2, (m + p) * o, o) for p in (self.rows, self.columns)
        )
        return np.asarray(blurred[..., y, x])


def detector_transfer(
    grid: DetectorGrid, crosstalk_px: float, sizes_um: Array
) -> Array:
    """(frames, fy, fx) transfer functions of pixel, crosstalk and round source; one for
    all frames of a point source.

    Args:
        grid: fine samples under the pixels.
        crosstalk_px: standard deviation of blur, pixel widths.
        sizes_um: (frames,) diameters of the source's images.
    """
    fy, fx = grid.frequencies()
    blur = gaussian_transfer(fy, fx, crosstalk_px * grid.wide_um)[0]
    shared = pixel_transfer(fy, fx, grid.wide_um) * blur
    if not np.any(sizes_um):
        return shared[None]
    discs = np.stack([disc_transfer(fy, fx, size) for size in sizes_um])
    return np.asarray(shared * discs)


def fine_enough(pixel_um: float, highest: float) -> int:
    """Least oversampling that samples ``highest`` cycles/um at the Nyquist rate.

    Args:
        pixel_um: pitch of the pixels, um.
        highest: highest frequency of the intensity, cycles/um.
    """
    return max(1, math.ceil(2 * highest * pixel_um * (1 - 1e-9)))


def aperture_sine(lens: Lens) -> float:
    """Sine of the half aperture angle of a lens, seen from its sensor in air."""
    radius_um = lens.diameters.radius_um
    return radius_um / math.hypot(radius_um, lens.reduced_um)


def required_oversampling(lens: Lens, pixel_um: float) -> int:
    """Samples along a pixel's side that are fine enough for the light of a lens.

    Args:
        pixel_um: pitch of the pixels, um.
    """
    return fine_enough(pixel_um, 2 * aperture_sine(lens) / lens.wavelength_um)


def pixel_transfer(fy: Array, fx: Array, pixel_um: float) -> Array:
    """Transfer of a square pixel: sinc(fx p) sinc(fy p).

    Args:
        pixel_um: pitch of the pixels, um.
    """
    return np.asarray(np.sinc(fx * pixel_um) * np.sinc(fy * pixel_um))


def gaussian_transfer(fy: Array, fx: Array, sigma_um: float) -> tuple[Array, Array]:
    """Transfer exp(-2 pi² f² sigma²) of a Gaussian blur, and its derivative by sigma.

    Args:
        fy: cycles/um along y.
        fx: cycles/um along x.
        sigma_um: standard deviation of the blur, um.
    """
    q = 4 * np.pi**2 * (fx**2 + fy**2)
    value = np.exp(-q * sigma_um**2 / 2)
    return value, -q * sigma_um * value


def disc_transfer(fy: Array, fx: Array, diameter_um: float) -> Array:
    """Transfer function 2 J1(u) / u = J0(u) + J2(u), u = pi f D, of a uniform disc.

    Args:
        fy: cycles/um along y.
        fx: cycles/um along x.
        diameter_um: diameter, um.
    """
    u = np.pi * np.hypot(fx, fy) * diameter_um
    return np.asarray(special.j0(u) + special.jv(2, u))


def ball_transfer(fy: Array, fx: Array, diameter_um: float) -> Array:
    """Transfer function 3 (sin u - u cos u) / u³, u = pi f D, of a uniformly
    fluorescent bead in projection.

    Args:
        fy: cycles/um along y.
        fx: cycles/um along x.
        diameter_um: diameter, um.
    """
    u = np.maximum(np.pi * np.hypot(fx, fy) * diameter_um, 1e-3)
    return np.asarray(3 * (np.sin(u) - u * np.cos(u)) / u**3)
