"""Diameters of discs that are not wide beside the picture's blur: area by exact chords,
a blur of this file's own.
"""

import numpy as np
import pytest

from characterize.measure import sem

COUNT, STRIPS = 5, 16


def covered(size, row, column, radius):
    """(y, x) share of each pixel within a disc: lengths of its chords in strips of
    pixels, by Pythagoras.
    """
    edges = np.arange(size + 1) - 0.5
    strips = (np.arange(size * STRIPS) + 0.5) / STRIPS - 0.5
    half = np.sqrt(np.maximum(radius**2 - (strips - column) ** 2, 0))
    ends = np.clip(edges[:, None], row - half, row + half)
    return np.diff(ends, axis=0).reshape(size, size, STRIPS).mean(2)


def blurred(picture, sigma):
    """Convolved with exp(-k² / 2 s²) along columns, then rows, written out."""
    reach = int(6 * sigma) + 1
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    for _ in range(2):
        wide = np.pad(picture, ((reach, reach), (0, 0)), mode="edge")
        parts = (
            w * wide[k : k + len(picture)]
            for k, w in enumerate(weights / weights.sum())
        )
        picture = np.sum(list(parts), axis=0).T
    return picture


def measured(diameter, blur, *, noise, rng, pitch=None):
    """Errors of all diameters (p,) and what is told of them, of discs anywhere within
    their pixels.
    """
    pitch = 2.5 * diameter + 0.3 if pitch is None else pitch
    size = int(COUNT * pitch)
    places = rng.uniform(0.47, 0.53, (COUNT, COUNT, 2)) + np.stack(
        np.mgrid[:COUNT, :COUNT], -1
    )
    flat = sum(
        covered(size, *(place * pitch - 0.5), diameter / 2)
        for place in places.reshape(-1, 2)
    )
    picture = 37.0 + 290.0 * (
        blurred(flat, blur) + noise * rng.standard_normal(flat.shape)
    )
    found = sem.measure_diameters(picture, sem.SemMicrograph(1.0, pitch))
    whole = np.isfinite(found.diameter_nm)
    assert whole.sum() >= 19  # of 25, less those that the picture's edge cuts
    return found.diameter_nm[whole] - diameter, found.sigma_nm[whole]


@pytest.mark.parametrize(
    ("diameter", "blur", "most"),
    [
        (
            9.0,
            2.0,
            0.05,
        ),  # 0.5 too large where half of the lowered step was taken for half of the step
        (9.0, 1.0, 0.02),
        (12.0, 2.5, 0.06),  # 0.5 too large
        (16.0, 2.0, 0.02),
        (7.0, 1.0, 0.03),
        (21.0, 1.3, 0.02),  # wide: as it was
    ],
)
def test_discs_in_a_wide_blur_are_as_large_as_they_are(diameter, blur, most):
    """Mean of some twenty, noise of 1 %: 0.02 of each from it; the rest is neighbours'
    light in the gap.
    """
    error, sigma = measured(diameter, blur, noise=0.01, rng=np.random.default_rng(7))
    assert abs(error.mean()) < most
    assert (np.abs(error) < 1.96 * sigma).mean() > 0.9  # of 25: two by chance


@pytest.mark.parametrize(
    ("diameter", "blur"), [(7.0, 2.0), (9.0, 2.0), (12.0, 2.0), (9.0, 1.0)]
)
def test_errors_of_small_discs_hold_their_noise(diameter, blur):
    """Noise of 10 % of the step in each pixel, which a radius of two blurs or less is
    read with several times.
    """
    every = [
        measured(diameter, blur, noise=0.1, rng=np.random.default_rng(seed))
        for seed in range(3)
    ]
    score = np.concatenate([error / sigma for error, sigma in every])
    # of about 70: 2.6 % from chance, four times that
    assert (np.abs(score) < 1.96).mean() > 0.84
    # 9 % from chance, and errors of which a picture's discs share one of its blur
    assert 0.7 < score.std() < 1.3
