"""Fisher information of images and of PSFs: Eqs. 4-6 and 11 of the paper, bounds, and
measures beyond them.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.psf import integrate_pixels, whole_pixels

Normalisation = Literal["sum", "l2", "none"]


def information(jacobians: Tensor, variance: Tensor | None = None) -> Tensor:
    """Fisher matrix F_ij = sum over pixels of J_i J_j (Eq. 4), or of J_i J_j / variance
    (Gaussian noise).

    Args:
        jacobians: (parameters, ...) derivative of the image in each parameter.
        variance: (...) noise variance of every pixel, above 0.

    Returns:
        (parameters, parameters), symmetric, positive semi-definite.
    """
    weighted = jacobians if variance is None else jacobians / variance
    return jacobians.flatten(1) @ weighted.flatten(1).mT


@dataclass(frozen=True, eq=False, slots=True)
class OpticsLoss:
    """Eq. 6 and its parts.

    value: sensitivity + orthogonality + compactness, each with its weight.
    floored: parameters whose information is below the floor: their logarithm follows
    its tangent there and has a bounded gradient.
    """

    value: Tensor
    sensitivity: Tensor
    orthogonality: Tensor
    compactness: Tensor
    floored: tuple[int, ...]


def optics_loss(
    fisher: Tensor,
    encircled: Tensor,
    *,
    orthogonality: float = 1.0,
    compactness: float = 1.0,
    floor: float = 1e-8,
    relative: bool = True,
) -> OpticsLoss:
    """Loss of the optics (paper Eq. 6): information, correlation and compactness.

    -Σ log F_ii + orthogonality Σ_{i≠j} F_ij² + compactness (1 - E)

    Args:
        fisher: (n, n) Fisher matrix.
        encircled: encircled energy E in [0, 1], of any shape; its mean enters.
        orthogonality: weight of the second term.
        compactness: weight of the third term.
        floor: least F_ii of the logarithm. Below it the logarithm continues as its
            tangent, so that the gradient still increases the information;
            ``floored`` lists these parameters.
        relative: divide F_ij² by F_ii F_jj. The paper's plain form depends on the units
            of the parameters and on the brightness: dimming the image lowers it.
    """
    diagonal = torch.diagonal(fisher)
    below = diagonal < floor
    safe = torch.where(below, floor, diagonal)
    logs = torch.log(safe) + torch.where(below, (diagonal - floor) / floor, 0.0)
    scale = torch.outer(safe, safe) if relative else torch.ones_like(fisher)
    correlation = (fisher**2 / scale).sum() - (torch.diagonal(fisher**2 / scale)).sum()
    parts = (
        -logs.sum(),
        orthogonality * correlation,
        compactness * (1 - encircled).mean(),
    )
    return OpticsLoss(
        sum(parts, fisher.new_zeros(())),
        *parts,
        tuple(torch.nonzero(below)[:, 0].tolist()),
    )


def encircled_energy(
    intensity: Tensor, sample_um: float, *, radius_um: float
) -> Tensor:
    """(...) light within a circle about the window's centre, in units of ``intensity``.

    Samples cut by the circle count in part. Intensities that are shares of the light
    through the aperture give the absolute encircled energy. Dividing by the window's
    sum instead overrates a wide PSF.

    Args:
        intensity: (..., y, x) light per sample.
        sample_um: step of the samples, um.
        radius_um: of the circle.
    """
    y, x = (
        torch.arange(n, dtype=torch.float64) - (n - 1) / 2 for n in intensity.shape[-2:]
    )
    inside = (radius_um / sample_um + 0.5 - torch.hypot(y[:, None], x)).clamp(0, 1)
    return (intensity * inside.to(intensity)).sum((-2, -1))


def pixel_information(
    near: Tensor,
    far: Tensor,
    *,
    step_um: float,
    sample_um: float,
    pixel_um: float,
    normalisation: Normalisation,
    shift_um: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """(...) axial information I(z) of Eq. 11 for one position of the pixels, per mm².

    Σ over pixels of ((P(z + dz) - P(z)) / dz)², with P the normalised light per pixel.

    Args:
        near: (..., y, x) intensities at z.
        far: (..., y, x) intensities at z + ``step_um``.
        step_um: dz between the two depths.
        sample_um: step of the samples, um.
        pixel_um: pixel pitch, um.
        normalisation: of the pixels of each depth: by their sum, by their Euclidean
            norm, or none. The ranking of lenses depends on it, so always name it.
        shift_um: (y, x) of the pixel grid, um.
    """
    shape = tuple(whole_pixels(n, sample_um, pixel_um) for n in near.shape[-2:])
    grid = dict(pitch_um=pixel_um, shape=(shape[0], shape[1]), shift_um=shift_um)
    a, b = (
        _normalised(
            integrate_pixels(image, sample_um, **grid),  # type: ignore[arg-type]
            normalisation,
        )
        for image in (near, far)
    )
    return ((b - a) ** 2).sum((-2, -1)) / (step_um * 1e-3) ** 2


def axial_information(
    near: Tensor,
    far: Tensor,
    *,
    step_um: float,
    sample_um: float,
    pixel_um: float,
    normalisation: Normalisation = "l2",
    positions: int = 3,
) -> Tensor:
    """(...) axial information I(z) of Eq. 11, mean over sub-pixel positions, per mm².

    At a single position, or with samples coarser than lambda d / 4R, the value misranks
    lenses and an optimiser exploits it. The window must contain the PSF: light outside
    it does not count.

    Args:
        near: (..., y, x) intensities at z, three samples a pixel or more.
        far: the same at z + ``step_um``.
        step_um: dz between the two depths.
        sample_um: step of the samples, um.
        pixel_um: pixel pitch, um.
        normalisation: see :func:`pixel_information`.
        positions: of the image on the pixels, along each axis.

    Raises:
        SceneError: less than three samples a pixel, or less than one position.
    """
    if sample_um > pixel_um / 3 * (1 + 1e-9):
        raise SceneError(
            f"intensity sampled every {sample_um} um for pixels of {pixel_um} um: need at most {pixel_um / 3:.3g} um "
            "(and at most lambda d / 4R) for an honest value"
        )
    if positions < 1:
        raise SceneError(f"positions = {positions}: need at least 1")
    shifts = [((i + 0.5) / positions - 0.5) * pixel_um for i in range(positions)]
    values = [
        pixel_information(
            near,
            far,
            step_um=step_um,
            sample_um=sample_um,
            pixel_um=pixel_um,
            normalisation=normalisation,
            shift_um=(y, x),
        )
        for y in shifts
        for x in shifts
    ]
    return torch.stack(values).mean(0)


def texture_information(
    psf: Tensor, *, step_um: float, spectrum: Tensor, noise: float
) -> Tensor:
    """Fisher information on depth from the blur of an unknown texture, per mm².

    ½ Σ_f (d log S / dz)² (Whittle), where S(f) = |H(f)|² spectrum + noise is the power
    of the image of a Gaussian texture in white noise. Phases, and so displacements of
    the PSF, carry no information.

    Args:
        psf: (depths, y, x) pixel PSFs at equal steps ``step_um``.
        spectrum: (y, x // 2 + 1) power of the texture on the grid of
            ``torch.fft.rfft2``.
        noise: power of the noise per frequency.

    Returns:
        (depths - 1,) between the depths.
    """
    power = torch.log(torch.fft.rfft2(psf).abs() ** 2 * spectrum + noise)
    weight = power.new_full(power.shape[-1:], 2.0)
    weight[0] = 1
    if psf.shape[-1] % 2 == 0:
        weight[-1] = 1
    slope = (power[1:] - power[:-1]) / (step_um * 1e-3)
    total: Tensor = 0.5 * (slope**2 * weight).sum((-2, -1))
    return total


def cramer_rao(fisher: Tensor) -> Tensor:
    """(n,) Cramér-Rao bound: least standard deviation of each parameter, √(F⁻¹)_ii.

    It is infinite where a parameter cannot be separated from others (colinear
    sensitivities), by the eigenvalues of the matrix scaled to a unit diagonal.

    Args:
        fisher: (n, n) Fisher matrix, noise-weighted.
    """
    diagonal = torch.diagonal(fisher)
    scale = torch.sqrt(diagonal.clamp_min(torch.finfo(fisher.dtype).tiny))
    values, vectors = torch.linalg.eigh(fisher / torch.outer(scale, scale))
    nonzero = values > 1e-12 * len(fisher)
    variance = (
        vectors**2 * torch.where(nonzero, 1 / torch.where(nonzero, values, 1.0), 0.0)
    ).sum(1)
    undetermined = ((vectors**2)[:, ~nonzero].sum(1) > 1e-9) | (diagonal <= 0)
    return torch.where(undetermined, math.inf, torch.sqrt(variance) / scale)


def _normalised(pixels: Tensor, normalisation: Normalisation) -> Tensor:
    if normalisation == "none":
        return pixels
    if normalisation == "sum":
        size = pixels.sum((-2, -1), keepdim=True)
    else:
        size = torch.sqrt((pixels**2).sum((-2, -1), keepdim=True))
    return pixels / size.clamp_min(torch.finfo(pixels.dtype).tiny)
