"""The sensor: continuous pixel pitch, photon and read noise, full well, quantisation
(paper Sec. 3.1).
"""

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.psf import integrate_pixels


@dataclass(frozen=True, slots=True)
class Sensor:
    """What turns irradiance into numbers. Defaults: a small global-shutter pixel of 3
    um with 10 bits.

    pitch_um: effective pixel pitch (the paper's p hat).
    base_pitch_um: pitch for which the electron counts below hold.
    exposure_e: electrons that one unit of irradiance gives in a base pixel.
    ambient_e: electrons of background light in a base pixel.
    full_well_e: capacity of a base pixel; it grows with the area, like the light.
    read_noise_e: standard deviation of the Gaussian noise of one read-out pixel.
    bits: of the converter, whose full scale is the full well.

    Raises:
        SceneError: a value is not finite or not in its range.
    """

    pitch_um: float = 3.0
    base_pitch_um: float = 3.0
    exposure_e: float = field(default=4000.0, metadata={"above": 0})
    ambient_e: float = 0.0
    full_well_e: float = 8000.0
    read_noise_e: float = 3.0
    bits: int = 10

    def __post_init__(self) -> None:
        positive = self.pitch_um, self.base_pitch_um, self.full_well_e
        others = self.exposure_e, self.ambient_e, self.read_noise_e
        in_range = all(0 < value < math.inf for value in positive)
        in_range &= all(0 <= value < math.inf for value in others)
        if not (in_range and self.bits in range(1, 17)):
            raise SceneError(
                f"{self}: need finite values, pitches and full well above 0, the others "
                "0 or more, and 1 to 16 bits"
            )

    @property
    def well_e(self) -> float:
        """Full well of a pixel of the effective pitch, electrons."""
        return self.full_well_e * (self.pitch_um / self.base_pitch_um) ** 2


def kappa(pitch_um: float | Tensor, base_pitch_um: float) -> float | Tensor:
    """Light of a pixel relative to a base pixel: (pitch / base pitch)², the paper's
    energy-preserving factor.

    Args:
        pitch_um: of the pixel. base_pitch_um: of the base pixel.
    """
    return (pitch_um / base_pitch_um) ** 2


def mean_electrons(
    irradiance: Tensor,
    sample_um: float,
    *,
    sensor: Sensor,
    pitch_um: Tensor | None = None,
    count: int | None = None,
    grid_um: float | None = None,
) -> Tensor:
    """Expected electrons of every pixel, before noise and saturation.

    Args:
        irradiance: (..., y, x), 1 where a base pixel collects ``sensor.exposure_e``
            electrons.
        sample_um: step of the samples, um.
        sensor: pitch, exposure and ambient light.
        pitch_um: tensor in place of ``sensor.pitch_um``, to differentiate in.
        count: pixels along each axis.
        grid_um: see :func:`metalens.psf.pixel_weights`; light and ambient are then
            those of a pixel of this size.

    Returns:
        (..., rows, columns): kappa times (exposure times mean irradiance plus ambient),
        at least 0.
    """
    pitch = pitch_um
    if pitch is None:
        pitch = torch.as_tensor(sensor.pitch_um, dtype=torch.float64)
    shape = None if count is None else (count, count)
    light = integrate_pixels(
        irradiance, sample_um, pitch_um=pitch, shape=shape, grid_um=grid_um
    )
    light = light * (sample_um / sensor.base_pitch_um) ** 2
    scale = torch.as_tensor(
        kappa(pitch if grid_um is None else grid_um, sensor.base_pitch_um)
    ).to(irradiance)
    return (sensor.exposure_e * light + sensor.ambient_e * scale).clamp_min(0)


def draw_photons(mean: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Poisson counts k of mean m, with the surrogate gradient dk/dm = (1 + k / m) / 2.

    The expected gradient of k is 1 and that of k² is 2m + 1, as of the true
    distribution for every m > 0. That of k³ is too high by 1/2, against 3m² + 6m + 1. A
    Gaussian instead has a wrong skewness and negative counts.

    Args:
        mean: expected counts m.
        generator: of the random draws; the global one without it.
    """
    device = mean.device if generator is None else generator.device
    count = torch.poisson(mean.detach().to(device), generator=generator).to(mean.device)
    safe = mean.detach().clamp_min(torch.finfo(mean.dtype).tiny)
    slope = torch.where(mean.detach() > 0, 0.5 * (1 + count / safe), 1.0)
    return count + slope * (mean - mean.detach())


def expose(
    mean: Tensor,
    *,
    sensor: Sensor,
    generator: torch.Generator | None = None,
    reads: float | Tensor = 1.0,
) -> Tensor:
    """Electrons read from pixels: Poisson counts up to full well, plus read noise.

    The read noise is Gaussian, of √reads times that of one read. Saturated pixels have
    gradient 0.

    Args:
        mean: expected electrons of every pixel.
        sensor: pixels, gain and noise of the sensor.
        generator: of the random draws; the global one without it.
    """
    collected = draw_photons(mean, generator).clamp(max=sensor.well_e)
    noise = normal(tuple(mean.shape), mean, generator)
    return (
        collected
        + sensor.read_noise_e * torch.as_tensor(reads).to(noise).sqrt() * noise
    )


def normal(
    shape: tuple[int, ...], like: Tensor, generator: torch.Generator | None
) -> Tensor:
    """Standard normal numbers, of the dtype and device of ``like``.

    They are drawn on the generator's device, so that a seed gives the same noise on
    every device.

    Args:
        shape: of the result.
        like: tensor whose dtype and device it has.
        generator: of the random draws; None for the global generator.
    """
    device = like.device if generator is None else generator.device
    return torch.randn(shape, generator=generator, dtype=like.dtype, device=device).to(
        like.device
    )


def digitise(electrons: Tensor, *, sensor: Sensor) -> Tensor:
    """Digital numbers 0 … 2^bits - 1, full scale at the full well.

    The gradient is that of the line without rounding (straight-through).

    Args:
        electrons: read from the pixels.
        sensor: pixels, gain and noise of the sensor.
    """
    top = 2**sensor.bits - 1
    level = (electrons * (top / sensor.well_e)).clamp(0, top)
    rounded: Tensor = level + (level.round() - level).detach()
    return rounded


def variance(mean: Tensor, *, sensor: Sensor) -> Tensor:
    """Noise variance of a pixel, electrons²: mean + read noise² + step² / 12.

    The step is that of the digital numbers.

    Args:
        mean: expected electrons.
        sensor: pixels, gain and noise of the sensor.
    """
    total: Tensor = (
        mean + sensor.read_noise_e**2 + (sensor.well_e / (2**sensor.bits - 1)) ** 2 / 12
    )
    return total


def low_snr(
    sensor: Sensor,
    mean_irradiance: float,
    *,
    snr_db: float = 15.0,
    ambient_ratio: float = 4.0,
) -> Sensor:
    """The sensor with exposure and ambient light that give a signal-to-noise ratio.

    It is 20 log10(S / √(S (1 + ambient_ratio) + read noise²)) dB, with S the mean
    signal electrons at the sensor's own pitch. As in the paper's low-light test, the ambient
    light enters before the photon noise.

    Args:
        sensor: pixels and read noise.
        mean_irradiance: of the image, on the scale of :func:`mean_electrons`.
        snr_db: signal-to-noise ratio.
        ambient_ratio: ambient light over the signal.
    """
    if not (0 < mean_irradiance < math.inf and 0 <= ambient_ratio < math.inf):
        raise SceneError(
            f"mean_irradiance = {mean_irradiance}, ambient_ratio = {ambient_ratio}: need "
            "one above 0 and one of 0 or more"
        )
    q2 = 10 ** (snr_db / 10)
    area = float(kappa(sensor.pitch_um, sensor.base_pitch_um))
    shot = q2 * (1 + ambient_ratio)
    signal = (shot + math.sqrt(shot**2 + 4 * q2 * sensor.read_noise_e**2)) / 2 / area
    return replace(
        sensor, exposure_e=signal / mean_irradiance, ambient_e=signal * ambient_ratio
    )
