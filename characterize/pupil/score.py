"""Agreement of predicted with measured images of a stack, and the checks that refuse a
pupil.
"""

import math
from dataclasses import dataclass

import numpy as np

from characterize.inference import FitImages
from metalens.core.arrays import Array

# correlation below which the window holds no bead of this kind
_LEAST_NCC = 0.8
# share of the light; correct optics leave about 0.1, an aperture wrong by a fifth 0.3
_MOST_UNEXPLAINED = 0.35


@dataclass(frozen=True, slots=True)
class StackAgreement:
    """Agreement of predicted with measured images over usable, unsaturated pixels.

    ncc: Pearson correlation over all pixels. plane_ncc: mean over planes of the
    correlation inside a plane.
    nrmse: |predicted - measured| / |measured - background|.
    unexplained: ``nrmse`` less the noise of single pixels, in quadrature.
    """

    ncc: float
    plane_ncc: float
    nrmse: float
    unexplained: float


def measure_agreement(
    predicted: Array, data: FitImages, background: Array
) -> StackAgreement:
    """Correlation and normalised residual of predicted images.

    Args:
        predicted: (n, y, x) electrons.
        data: the measured planes.
        background: (n, y, x) electrons without the bead.
    """
    keep = data.usable & ~data.saturated
    planes = zip(predicted, data.electrons, keep, strict=True)
    plane_ncc = [np.corrcoef(p[k], d[k])[0, 1] for p, d, k in planes]
    image, measured = predicted[keep], data.electrons[keep]
    light = max(float(np.linalg.norm(measured - background[keep])), 1e-300)
    nrmse = float(np.linalg.norm(image - measured)) / light
    noise = pixel_noise_e(data) * math.sqrt(measured.size) / light
    return StackAgreement(
        float(np.corrcoef(image, measured)[0, 1]),
        float(np.mean(plane_ncc)),
        nrmse,
        math.sqrt(max(nrmse**2 - noise**2, 0.0)),
    )


def pixel_noise_e(data: FitImages) -> float:
    """Standard deviation of a pixel in electrons: median absolute deviation of
    differences of successive planes, most of whose pixels are dark.

    Args:
        data: the measured planes.
    """
    step = np.diff(data.electrons, axis=0)[data.usable[1:] & data.usable[:-1]]
    return 1.4826 * float(np.median(np.abs(step - np.median(step)))) / math.sqrt(2)


def pupil_problems(score: StackAgreement, stopped: str) -> list[str]:
    """Reasons to refuse a pupil, in words.

    Args:
        score: of the planes left out, else of the fitted ones.
        stopped: why the fit stopped before it converged; empty where it did.
    """
    words = []
    if stopped and score.unexplained > _MOST_UNEXPLAINED / 2:
        words.append(f"not converged ({stopped})")
    if score.ncc < _LEAST_NCC:
        words.append(
            f"images and model correlate by {score.ncc:.2f} only (need {_LEAST_NCC}): "
            "too little light, planes out of order, or no bead at the centre of the "
            "window; give center = [row, column]"
        )
    if score.unexplained > _MOST_UNEXPLAINED:
        words.append(
            f"the pupil misses {score.unexplained:.0%} of the light beyond noise (at "
            f"most {_MOST_UNEXPLAINED:.0%} allowed): numerical_aperture, wavelength_um, "
            "pixel_um, index, bead_um or step_um may be wrong, a second bead may be in "
            "the window, or planes are missing or out of order"
        )
    return words
