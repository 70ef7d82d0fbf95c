"""Errors of PSFs as the image of a natural texture shows them."""

import torch
from torch import Tensor

CONTRAST = 0.3  # standard deviation over mean of the scene that errors are stated for


def scene_spectrum(psf: Tensor, plane: float = 0.0, band: float = 0.0) -> Tensor:
    """(…, features) of PSFs (…, h, w): their L2 norm is that of the image of a scene.

    The scene is a 1/f texture of standard deviation :data:`CONTRAST` plus a uniformly
    illuminated plane. Frequencies below one period in eight windows count as that one.

    Args:
        psf: (..., h, w) PSFs.
        plane: weight of the plane's errors over those of the texture.
        band: spatial frequency of the plane's errors, cycles a sample; 0 for no plane.
    """
    power, both, frequency2 = _powers(psf)
    weight = CONTRAST**2 * power / (power * both).sum()
    if band > 0:
        low = torch.exp(-frequency2 / band**2)
        weight = weight + plane**2 * low / (low * both).sum()
    h, w = psf.shape[-2:]
    spectrum = torch.fft.rfft2(psf, s=(2 * h, 2 * w)) * (weight * both).sqrt()
    features: Tensor = torch.view_as_real(spectrum).flatten(-3)
    return features


def _powers(psf: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(2h, w + 1) texture power, multiplicity (1 or 2) and f² of rfft2 frequencies.

    The power is 1 / (f² + f0²), with f0 one period in eight windows.
    """
    h, w = psf.shape[-2:]
    fy = torch.fft.fftfreq(2 * h, dtype=psf.dtype, device=psf.device)
    fx = torch.fft.rfftfreq(2 * w, dtype=psf.dtype, device=psf.device)
    frequency2 = fy[:, None] ** 2 + fx**2
    both = torch.where((fx == 0) | (fx == 0.5), 1.0, 2.0).to(psf)
    return 1 / (frequency2 + (1 / (8 * max(h, w))) ** 2), both, frequency2


def texture_error(psf: Tensor, reference: Tensor) -> Tensor:
    """(…) relative L2 error of the image of a texture through PSFs (…, h, w).

    Args:
        psf: (..., h, w) PSFs. reference: their true values.
    """
    psf, reference = psf.double(), reference.double()
    spectra = (scene_spectrum(some) for some in (psf - reference, reference))
    error, level = (spectrum.norm(dim=-1) for spectrum in spectra)
    relative: Tensor = error / level
    return relative


def scene_error(psf: Tensor, reference: Tensor) -> float:
    """Relative L2 error of the image of a scene of mean 1 with its texture.

    Over the whole field, at the worst depth, in units of the light of the brightest.

    Args:
        psf, reference: (places, depths, h, w), each times its relative illumination.
    """
    error = scene_spectrum((psf - reference).double()).square().sum(-1)
    light = reference.double().sum((-1, -2)).square()
    return float(torch.sqrt(error.mean(0).max() / light.mean(0).max().clamp_min(1e-30)))


def weigh_by_light(errors: Tensor, light: Tensor) -> float:
    """Root mean square of relative errors (places, depths), each times its light.

    In units of the brightest place of its depth: what is dark shows little.
    """
    return float(((errors * light / light.amax(0)) ** 2).mean().sqrt())
