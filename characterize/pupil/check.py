"""Checks of a fitted pupil, each with the cause it points to: order of the planes,
convergence, planes left out.
"""

import math

import numpy as np

from characterize.inference import FitImages

LEAST_NCC = 0.8
# of the light that planes left out may miss beyond their noise; right optics miss about
# a tenth
MISSED = 0.35
DOUBTFUL = 0.18  # the same, from where on the optics are doubted aloud
CAUSES = (
    "numerical_aperture, wavelength_um, pixel_um, index, bead_um or step_um may be wrong, a second bead may be in the "
    "window, or planes are missing or shifted"
)


def order_score(data: FitImages) -> float:
    """How much likelier planes resemble their neighbours than any others: 1 in order, 0
    shuffled.

    Mean correlation of planes that follow each other, against that of the most alike
    ones; both above the mean of all.
    nan where all planes look alike, or fewer than six.

    Args:
        data: frames, masks and noise that are fitted.
    """
    n = len(data.electrons)
    if n < 6:
        return math.nan
    flat = np.where(data.usable, data.electrons, np.nan).reshape(n, -1)
    flat = np.nan_to_num(flat - np.nanmedian(flat, axis=1, keepdims=True))
    alike = np.corrcoef(flat)
    others = alike[~np.eye(n, dtype=bool)].reshape(n, n - 1)
    follow = float(np.diagonal(alike, 1).mean())
    best = float(np.sort(others, axis=1)[:, -2:].mean())
    every = float(others.mean())
    return (follow - every) / (best - every) if best - every > 0.02 else math.nan


def unexplained_share(nrmse: float, data: FitImages, background: float) -> float:
    """Share of the light that a prediction misses beyond pixel noise, which dark places
    estimate.

    Args:
        nrmse: normalised error of the prediction.
        data: frames, masks and noise that are fitted.
        background: level of a frame without light.
    """
    steps = np.diff(data.electrons, axis=0)[
        data.usable[1:] & data.usable[:-1]
    ] / math.sqrt(2)
    noise = 1.4826 * float(np.median(np.abs(steps - np.median(steps))))
    light = (data.electrons - background)[data.usable]
    by_noise = noise * math.sqrt(light.size) / max(float(np.linalg.norm(light)), 1e-300)
    return math.sqrt(max(nrmse**2 - by_noise**2, 0.0))


def pupil_problems(
    data: FitImages, ncc: float, share: float, stopped: str
) -> list[str]:
    """What makes a pupil no result, in words.

    Args:
        data: frames, masks and noise that are fitted.
        ncc: correlation with the planes left out, else with all. share: of the light
            that is :func:`unexplained_share` there.
        stopped: why the fit stopped before it converged; empty where it did.
    """
    if order_score(data) < 0.4:
        return [
            "planes that follow each other look no more alike than others: the stack is shuffled, or its files are "
            "listed in the wrong order"
        ]
    words = []
    if stopped and share > DOUBTFUL:
        words.append(f"not converged ({stopped})")
    if ncc < LEAST_NCC:
        words.append(
            f"images and model correlate by {ncc:.2f} only (need {LEAST_NCC}): too little light, or no bead at "
            "the centre of the window; give center = [row, column]"
        )
    if share > MISSED:
        words.append(
            f"the pupil misses {share:.0%} of the light beyond noise (at most {MISSED:.0%} allowed): "
            + CAUSES
        )
    return words


def pupil_warnings(share: float, stopped: str) -> list[str]:
    """What a pupil that is not refused still leaves to explain, in words; ``share`` of
    the light is missed.

    Args:
        stopped: why the fit stopped, empty where it converged.
    """
    words = (
        [f"not converged ({stopped}), though it predicts the images well"]
        if stopped and share <= DOUBTFUL
        else []
    )
    if DOUBTFUL < share <= MISSED:
        words.append(
            f"the pupil misses {share:.0%} of the light beyond noise, where right optics miss about a tenth: "
            + CAUSES
        )
    return words
