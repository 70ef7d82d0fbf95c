"""Depth from the blur of a texture that nobody knows: what the power spectrum of an
image tells, against noise.

A network that never saw the surface before cannot tell blur from texture at one
frequency, but it knows how the
spectra of surfaces fall, S ~ 1/f² (Field, J. Opt. Soc. Am. A 4, 2379, 1987). The image
of such a texture has the
power P(f, z) = |OTF(f, z)|² S(f) + N, aliases folded, and the Fisher information of its
Gaussian likelihood
(Whittle, Ark. Mat. 2, 423, 1953) is J(z) = 1/2 sum over f of (d ln P / dz)². For images
on their own grid and any
spectrum see :func:`metalens.fisher.texture_information`.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from metalens.ground.errors import ConfigError, SceneError
from metalens.image.information import without_nuisance
from metalens.image.sensor import Sensor, kappa, variance


@dataclass(frozen=True, slots=True)
class Texture:
    """A patch of unknown texture on the sensor.

    pitch_um, pixels: of the patch, pixels x pixels. contrast: standard deviation over
    mean of the sharp texture at
    the frequencies that the patch can show. noise: standard deviation over mean of one
    pixel's noise.
    exponent: of the spectrum's fall with frequency. folds: odd number of aliases kept
    along each axis.
    """

    pitch_um: float
    pixels: int = 32
    contrast: float = 0.2
    noise: float = 0.02
    exponent: float = 2.0
    folds: int = 3

    def __post_init__(self) -> None:
        if not (
            self.pitch_um > 0
            and self.pixels >= 4
            and self.contrast > 0
            and self.noise >= 0
        ):
            raise ConfigError(
                f"pitch_um, pixels, contrast, noise = {self.pitch_um}, {self.pixels}, {self.contrast}, {self.noise}: "
                "need a pitch and contrast above 0, 4 pixels or more, and noise of 0 or more"
            )
        if self.pixels % 2 or self.folds < 1 or self.folds % 2 == 0:
            raise ConfigError(
                f"pixels, folds = {self.pixels}, {self.folds}: need an even and an odd number"
            )


def relative_noise(sensor: Sensor, *, albedo: float) -> float:
    """Standard deviation over mean of a pixel that sees a surface of this albedo, at
    the sensor's own pitch.

    Raises:
        ConfigError: no light comes back.
    """
    light = (
        albedo * sensor.exposure_e * float(kappa(sensor.pitch_um, sensor.base_pitch_um))
    )
    if not light > 0:
        raise ConfigError(
            f"albedo = {albedo} at exposure_e = {sensor.exposure_e}: need light above 0"
        )
    mean = torch.tensor(
        light + sensor.ambient_e * float(kappa(sensor.pitch_um, sensor.base_pitch_um))
    )
    return math.sqrt(float(variance(mean, sensor=sensor))) / light


def power(psf: Tensor, sample_um: float, texture: Texture) -> tuple[Tensor, Tensor]:
    """Expected power of the image of the texture, per frequency of the patch other than
    0.

    Args:
        psf: (..., y, x) light on samples; its sum does not matter, its place does not
            either.

    Returns:
        (..., frequencies) power with noise, and the part of it that is texture, both in
        units of the mean squared
        per pixel. All frequencies of the plane: each real component counts twice.

    Raises:
        SceneError: the samples are too coarse for the aliases that are kept.
    """
    if sample_um * texture.folds > texture.pitch_um * (1 + 1e-9):
        raise SceneError(
            f"PSF sampled every {sample_um} um, pixels of {texture.pitch_um} um with {texture.folds} aliases: need "
            f"samples of at most {texture.pitch_um / texture.folds:.3g} um"
        )
    count = texture.folds * texture.pixels
    f = (torch.arange(count, dtype=torch.float64) - count // 2) / (
        texture.pixels * texture.pitch_um
    )
    rows, columns = (_waves(f, n, sample_um).to(psf.device) for n in psf.shape[-2:])
    box = torch.sinc(f * texture.pitch_um)
    kind = torch.complex128 if psf.dtype == torch.float64 else torch.complex64
    total = psf.sum((-2, -1), keepdim=True)
    otf = rows.to(kind) @ (psf / total).to(kind) @ columns.mT.to(kind)
    seen = (otf.real**2 + otf.imag**2) * (
        _spectrum(f, texture) * (box[:, None] * box) ** 2
    ).to(psf)
    aliases = (texture.folds, texture.pixels)
    folded = seen.reshape(*seen.shape[:-2], *aliases, *aliases).sum((-4, -2))
    kept = folded[..., _base(texture) > 0]
    return kept + texture.noise**2, kept


def blind_matrix(
    near: Tensor, far: Tensor, *, step_um: float, sample_um: float, texture: Texture
) -> Tensor:
    """Fisher matrix of depth (mm), log of the texture's power, and exponent of its
    spectrum: (..., 3, 3).

    Args:
        near, far: (..., y, x) PSFs at z - step / 2 and z + step / 2.
    """
    (low, low_texture), (high, high_texture) = (
        power(p, sample_um, texture) for p in (near, far)
    )
    slope = (torch.log(high) - torch.log(low)) / (step_um * 1e-3)
    share = (low_texture / low + high_texture / high) / 2
    falls = -share * _log_frequency(texture).to(
        share
    )  # of an alias, as of the frequency that it lands on
    parts = torch.stack([slope, share, falls], -2)
    return 0.5 * parts @ parts.mT


def blind_information(
    near: Tensor, far: Tensor, *, step_um: float, sample_um: float, texture: Texture
) -> Tensor:
    """J(z) = 1/2 sum over frequencies of (d ln P / dz)², per mm²: the spectrum of the
    texture is known. (...,).
    """
    return blind_matrix(
        near, far, step_um=step_um, sample_um=sample_um, texture=texture
    )[..., 0, 0]


def blinder_information(
    near: Tensor, far: Tensor, *, step_um: float, sample_um: float, texture: Texture
) -> Tensor:
    """J(z) when contrast and fall of the spectrum are unknown too (projected out), per
    mm²; (...,).
    """
    matrix = blind_matrix(
        near, far, step_um=step_um, sample_um=sample_um, texture=texture
    )
    flat = [without_nuisance(m, 1)[0, 0] for m in matrix.reshape(-1, 3, 3)]
    return torch.stack(flat).reshape(matrix.shape[:-2])


def blind_error(
    psf: Tensor, depths_um: Tensor, *, sample_um: float, texture: Texture
) -> Tensor:
    """Mean absolute error in mm of a reader of the spectrum who confuses depths of like
    spectra; (depths,).

    Information is local: a lens whose blur is the same on either side of its focus has
    plenty and still cannot tell
    the sides. Here every depth is weighted by exp(-D), D the expected log-likelihood
    ratio against the true depth at
    the contrast that fits best (between a quarter and four times the power), all depths
    equally likely before.

    Args:
        psf: (depths, y, x). depths_um: (depths,).
    """
    whole, seen = power(psf, sample_um, texture)
    scales = torch.logspace(-1, 1, 9, base=4.0, dtype=whole.dtype)
    least = []
    for true in whole:
        other = scales[:, None, None] * seen + texture.noise**2
        ratio = true / other
        least.append((0.5 * (ratio - 1 - torch.log(ratio)).sum(-1)).amin(0))
    weight = torch.softmax(-torch.stack(least), 1)
    apart = (depths_um[:, None] - depths_um).abs().to(weight) * 1e-3
    return (weight * apart).sum(1)


def _waves(frequency: Tensor, samples: int, sample_um: float) -> Tensor:
    """(frequencies, samples) of exp(-2 pi i f x)."""
    place = (torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * sample_um
    return torch.exp(-2j * math.pi * frequency[:, None] * place)


def _spectrum(frequency: Tensor, texture: Texture) -> Tensor:
    """(y, x) power of the sharp texture: its mean over the patch's frequencies other
    than 0 is contrast².
    """
    radius = torch.hypot(frequency[:, None], frequency)
    fall = torch.where(radius > 0, radius.clamp_min(1e-12) ** -texture.exponent, 0.0)
    shown = (
        torch.maximum(frequency[:, None].abs(), frequency.abs())
        <= 0.5 / texture.pitch_um
    )
    return fall * texture.contrast**2 / fall[shown & (radius > 0)].mean()


def _base(texture: Texture) -> Tensor:
    """(y, x) radius of the patch's own frequencies in cycles per patch, from -pixels /
    2 up: where aliases land.
    """
    signed = torch.arange(texture.pixels, dtype=torch.float64) - texture.pixels // 2
    return torch.hypot(signed[:, None], signed)


def _log_frequency(texture: Texture) -> Tensor:
    """ln of the frequencies in the order of :func:`power`, about their mean."""
    radius = _base(texture)
    logs = torch.log(radius[radius > 0])
    return logs - logs.mean()
