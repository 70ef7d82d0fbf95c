"""How predicted images of a stack compare with measured ones, and what a spline through
its planes predicts.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from characterize.inference import FitImages
from metalens.core.arrays import Array


@dataclass(frozen=True, slots=True)
class StackAgreement:
    """How predicted images compare with measured ones, all planes together.

    ncc: Pearson correlation over all pixels. plane_ncc: mean over planes of the
    correlation inside the plane.
    nrmse: |predicted - measured| / |measured - background|.
    """

    ncc: float
    plane_ncc: float
    nrmse: float


def measure_agreement(
    predicted: Array, data: FitImages, background: float
) -> StackAgreement:
    """Agreement over usable, unsaturated pixels.

    Args:
        predicted: (n, y, x) predicted planes.
        data: frames, masks and noise that are fitted.
        background: level of a frame without light.
    """
    keep = data.usable & ~data.saturated
    a, b = predicted[keep], data.electrons[keep]
    planes = [
        _ncc(p[k], d[k])
        for p, d, k in zip(predicted, data.electrons, keep, strict=True)
    ]
    error = float(np.linalg.norm(a - b) / np.linalg.norm(b - background))
    return StackAgreement(_ncc(a, b), float(np.mean(planes)), error)


def predict_by_splines(
    position: Array, data: FitImages, seen: Array, hidden: Array
) -> Array:
    """(hidden, y, x) light of planes left out by cubic splines through the others: what
    no physics predicts.

    Args:
        position: (n,) positions of the planes.
        data: frames, masks and noise that are fitted.
        seen: planes that are known.
    """
    order = seen[np.argsort(position[seen])]
    light = np.where(
        data.usable, data.electrons, np.nanmedian(data.electrons[data.usable])
    )
    return np.asarray(CubicSpline(position[order], light[order])(position[hidden]))


def _ncc(a: Array, b: Array) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])
