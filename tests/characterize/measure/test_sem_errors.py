"""Diameters and their standard errors against discs and ellipses of known area: blur,
noise, dark tops, pillars that are not round.
"""

import numpy as np
import pytest

from characterize.measure import sem
from tests.characterize.micrographs import draw_square, errors_px


@pytest.mark.parametrize(("top", "gap", "stated"), [(0.2, 0.2, 0.0), (0.05, 0.3, 44.0)])
def test_dark_tops_within_bright_rims_are_measured_at_their_outer_edge(
    top, gap, stated
):
    """Half of a rim 4 wide that blur and smoothing (0.8 and 1) lower is up to a pixel
    farther out, equally for all.
    """
    rng = np.random.default_rng(3)
    diameter = rng.uniform(20, 31, (4, 4))
    look = {"top": top, "gap": gap, "rim": 1.0, "blur": 0.8, "noise": 0.03, "rng": rng}
    picture = draw_square(4, 44.0, diameter, centre=(0.46, 0.53), **look)
    found = sem.measure_diameters(picture, sem.SemMicrograph(1.0, stated))
    assert found.lattice.kind == "square"
    # four pillars a side, waves as weak as what their sizes differ by
    assert found.lattice.pitch_px == pytest.approx(44.0, rel=0.03)
    assert len(found.row) >= 9
    assert not (found.missing | found.collapsed | found.oval).any()
    wrong = errors_px(found, diameter, 44.0)
    assert 0 < wrong.mean() < 1
    # noise: 0.03; diameters differ by 11, and a rim's peak with them
    assert wrong.std() < 0.15


@pytest.mark.parametrize(
    ("long", "noise", "oval"),
    [(1.0, 0.2, False), (1.1, 0.03, False), (1.25, 0.03, True), (1.6, 0.03, True)],
)
def test_pillars_longer_than_wide_by_a_sixth_are_named_and_others_have_the_circle_of_their_area(
    long, noise, oval
):
    rng = np.random.default_rng(3)
    diameter = rng.uniform(20, 31, (4, 4))
    look = {"rim": 1.0, "rim_px": 3.0, "blur": 0.8, "noise": noise, "rng": rng}
    picture = draw_square(4, 44.0, diameter, centre=(0.46, 0.53), long=long, **look)
    found = sem.measure_diameters(picture, sem.SemMicrograph(1.0, 44.0))
    assert len(found.row) >= 9
    assert (found.oval == oval).all()
    assert (np.isfinite(found.diameter_nm) != oval).all()
    if not oval and noise < 0.1:
        # half of a rim, as above
        assert np.abs(errors_px(found, diameter, 44.0)).max() < 0.8


@pytest.mark.parametrize("long", [1.0, 1.12])
def test_nineteen_of_twenty_true_diameters_lie_within_two_errors(long):
    """Noise of 1 to 25 % of the step, blur of half a pixel to 1.6, 18 to 31 pixels
    across, round or a little oval.
    """
    rng = np.random.default_rng(round(100 * long))
    score = []
    for blur in (0.5, 0.9, 1.6):
        for noise in (0.005, 0.03, 0.15):
            diameter = rng.uniform(0.4, 0.7, (6, 6)) * 45.3
            ratio = rng.uniform(1, long, 36)
            look = {"blur": blur, "noise": noise, "long": ratio, "rng": rng}
            picture = draw_square(6, 45.3, diameter, spread=0.02, **look)
            found = sem.measure_diameters(picture, sem.SemMicrograph(1.0, 45.3))
            score.append(errors_px(found, diameter, 45.3) / found.sigma_nm)
    whole = np.concatenate(score)
    whole = whole[np.isfinite(whole)]
    # of 324: in much noise one seems longer than what is measured
    assert len(whole) >= 320
    # 1.2 % from chance, three times that
    assert 0.91 < (np.abs(whole) < 1.96).mean() < 0.98
    # 4 % from chance; below 1 where a tenth of what blur takes is most of the error
    assert 0.8 < whole.std() < 1.1
    # a rim is its brightest place, a gap its darkest: in noise, a little too much
    assert abs(whole.mean()) < 0.4
    # of 36 discs: 3.6 % from chance, four times that
    assert max((np.abs(of) > 1.96).mean() for of in score) < 0.2


def measure_small(diameter, blur, *, noise, seed):
    """(p,) errors and stated errors of small discs anywhere within their pixels."""
    rng = np.random.default_rng(seed)
    pitch = 2.5 * diameter + 0.3
    every = np.full((5, 5), diameter)
    look = {"gap": 0.0, "top": 1.0, "blur": blur, "noise": noise, "rng": rng}
    picture = 37.0 + 290.0 * draw_square(5, pitch, every, spread=0.03, **look)
    found = sem.measure_diameters(picture, sem.SemMicrograph(1.0, pitch))
    whole = np.isfinite(found.diameter_nm)
    assert whole.sum() >= 19  # of 25, less those that the picture's edge cuts
    return found.diameter_nm[whole] - diameter, found.sigma_nm[whole]


@pytest.mark.parametrize(
    ("diameter", "blur", "most"),
    [
        (9.0, 2.0, 0.05),  # 0.5 where half of the lowered step is taken for the edge
        (9.0, 1.0, 0.02),
        (12.0, 2.5, 0.06),
        (16.0, 2.0, 0.02),
        (7.0, 1.0, 0.03),
        (21.0, 1.3, 0.02),
    ],
)
def test_discs_in_a_wide_blur_are_as_large_as_they_are(diameter, blur, most):
    """Mean of some twenty, noise of 1 %: 0.02 of each from it; the rest is neighbours'
    light in the gap.
    """
    error, sigma = measure_small(diameter, blur, noise=0.01, seed=7)
    assert abs(error.mean()) < most
    assert (np.abs(error) < 1.96 * sigma).mean() > 0.9  # of 25: two by chance


@pytest.mark.parametrize(
    ("diameter", "blur"), [(7.0, 2.0), (9.0, 2.0), (12.0, 2.0), (9.0, 1.0)]
)
def test_errors_of_small_discs_hold_their_noise(diameter, blur):
    """Noise of 10 % of the step in each pixel, which a radius of two blurs or less is
    read with several times.
    """
    every = [measure_small(diameter, blur, noise=0.1, seed=seed) for seed in range(3)]
    score = np.concatenate([error / sigma for error, sigma in every])
    # of about 70: 2.6 % from chance, four times that
    assert (np.abs(score) < 1.96).mean() > 0.84
    # 9 % from chance, and errors of which a picture's discs share one of its blur
    assert 0.7 < score.std() < 1.3
