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


def span_angle(fisher: Tensor) -> Tensor:
    """Angle between two sensitivity fields: cos phi = F12 / sqrt(F11 F22) (Eq. 5), in
    [0, pi].

    From atan2, so that it is exact near 0 and pi; 0 where a field vanishes.

    Args:
        fisher: (..., n, n) Fisher matrix.
    """
    f11 = fisher[..., 0, 0]
    f22 = fisher[..., 1, 1]
    f12 = fisher[..., 0, 1]
    across = torch.sqrt((f11 * f22 - f12**2).clamp_min(torch.finfo(fisher.dtype).tiny))
    dark = (f11 <= 0) | (f22 <= 0)
    return torch.where(dark, 0.0, torch.atan2(across, f12))


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
    """- sum log F_ii + orthogonality sum over i != j of F_ij² + compactness (1 - E)
    (Eq. 6).

    Args:
        fisher: (n, n).
        encircled: encircled energy in [0, 1], any shape; its mean enters.
        floor: least F_ii in the logarithm: below it the tangent of the logarithm at the
            floor is used (value and
            slope are continuous, the gradient still points to more information), and
            ``floored`` tells.
        relative: divide F_ij² by F_ii F_jj. The paper's plain form changes with the
            units of the parameters and
            with the brightness: it can be made small by dimming the image.
    """
    diagonal = torch.diagonal(fisher)
    below = diagonal < floor
    safe = torch.where(below, floor, diagonal)
    logs = torch.log(safe) + torch.where(below, (diagonal - floor) / floor, 0.0)
    scale = torch.outer(safe, safe) if relative else torch.ones_like(fisher)
    off = (fisher**2 / scale).sum() - (torch.diagonal(fisher**2 / scale)).sum()
    parts = -logs.sum(), orthogonality * off, compactness * (1 - encircled).mean()
    return OpticsLoss(
        sum(parts, fisher.new_zeros(())),
        *parts,
        tuple(torch.nonzero(below)[:, 0].tolist()),
    )


def encircled_energy(
    intensity: Tensor, sample_um: float, *, radius_um: float
) -> Tensor:
    """Light within ``radius_um`` of the window's centre, in the units of ``intensity``
    (..., y, x).

    Samples cut by the circle count in part. Give intensities as shares of the light
    through the aperture to get
    the absolute encircled energy; dividing by the window's own sum flatters a wide PSF.

    Args:
        sample_um: step of the samples, um.
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
    """I(z) of Eq. 11 for one position of the pixel grid: sum over pixels of ((P(z + dz)
    - P(z)) / dz)², per mm².

    Args:
        pixel_um: pixel pitch, um.
        shift_um: displacement along x and y, um.
        near, far: (..., y, x) intensities at z and at z + ``step_um``, sampled every
            ``sample_um``.
        normalisation: of every depth's pixels: by their sum, by their Euclidean norm,
            or as they are. It decides
            which lens wins; always name it.
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
    """I(z) of Eq. 11, averaged over ``positions``² sub-pixel positions of the image on
    the pixels, per mm².

    Read from one position, or from intensities sampled coarser than lambda d / 4R, the
    value misranks lenses and an
    optimiser exploits it. The window must hold the PSF: light outside it does not
    count.

    Args:
        sample_um: step of the samples, um.
        pixel_um: pixel pitch, um.
        near, far: (..., y, x) intensities at z and z + ``step_um``, sampled at least
            three times a pixel.

    Raises:
        SceneError: less than three samples a pixel, or no position asked for.
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
    """Information on depth from the blur of an unknown texture: 1/2 sum over
    frequencies of (d log S / dz)², per mm².

    The image of a Gaussian texture of power ``spectrum`` in white noise has the power
    S(f) = |H(f)|² spectrum + noise;
    this is the Fisher information of its variance (Whittle). Phases, and so
    displacements of the PSF, carry nothing.

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


def without_nuisance(fisher: Tensor, wanted: int) -> Tensor:
    """Information on the first ``wanted`` parameters when the others are unknown too:
    the Schur complement.

    Nuisance directions that the image does not show at all are left out
    (pseudo-inverse).

    Args:
        fisher: (..., n, n) Fisher matrix.
    """
    a = fisher[:wanted, :wanted]
    b = fisher[:wanted, wanted:]
    c = fisher[wanted:, wanted:]
    scale = torch.sqrt(torch.diagonal(c).clamp_min(torch.finfo(c.dtype).tiny))
    inverse = torch.linalg.pinv(
        c / torch.outer(scale, scale), hermitian=True, rtol=1e-12
    )
    left: Tensor = a - (b / scale) @ inverse @ (b / scale).mT
    return left


def cramer_rao(fisher: Tensor) -> Tensor:
    """(n,) least standard deviation of an unbiased estimate of each parameter: sqrt of
    the diagonal of F^-1.

    ``fisher`` must be noise-weighted. Infinite where a parameter cannot be told from
    the others (colinear
    sensitivities), found from the eigenvalues of the matrix scaled to a unit diagonal.
    """
    diagonal = torch.diagonal(fisher)
    scale = torch.sqrt(diagonal.clamp_min(torch.finfo(fisher.dtype).tiny))
    values, vectors = torch.linalg.eigh(fisher / torch.outer(scale, scale))
    known = values > 1e-12 * len(fisher)
    spread = (
        vectors**2 * torch.where(known, 1 / torch.where(known, values, 1.0), 0.0)
    ).sum(1)
    blind = ((vectors**2)[:, ~known].sum(1) > 1e-9) | (diagonal <= 0)
    return torch.where(blind, math.inf, torch.sqrt(spread) / scale)


def _normalised(pixels: Tensor, normalisation: Normalisation) -> Tensor:
    if normalisation == "none":
        return pixels
    if normalisation == "sum":
        size = pixels.sum((-2, -1), keepdim=True)
    else:
        size = torch.sqrt((pixels**2).sum((-2, -1), keepdim=True))
    return pixels / size.clamp_min(torch.finfo(pixels.dtype).tiny)
