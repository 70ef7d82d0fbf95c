"""Micrographs rendered with charging, noise and drift: diameters come back to a
fraction of a pixel.
"""

import numpy as np
import pytest
from scipy import ndimage

from characterize.measure import sem
from metalens.core.errors import CaptureError
from tests.characterize.micrographs import draw_pillars

PIXEL, PITCH = 4.0, 400.0
ABOUT = sem.SemMicrograph(PIXEL, PITCH)


def render(diameters_nm, seed=0, missing=(), moved=(), noise=0.075, drift_px=1.5):
    """Discs with a brighter rim, a shade, dark streaks, scan drift and noise."""
    rng = np.random.default_rng(seed)
    n, pitch = len(diameters_nm), PITCH / PIXEL
    sites = [site for site in np.ndindex(n, n) if site not in missing]
    places = np.array([(j + 0.5, i + 0.5 + 0.35 * ((j, i) in moved)) for j, i in sites])
    size = int(n * pitch)
    image = draw_pillars(
        (size, size),
        places * pitch,
        [diameters_nm[site] / PIXEL for site in sites],
        gap=0.25,
        rim=0.87,
        rim_px=4.0,
        noise=noise,
        drift_px=drift_px,
        rng=rng,
    )
    y, x = np.mgrid[:size, :size] / size
    streaks = 0.05 * ndimage.gaussian_filter1d(rng.standard_normal(size), 8)
    return image + 0.3 * x * y + 0.1 * np.sin(5 * y) + streaks[:, None]


def test_bias_below_0_3_px_and_repeatability_below_0_1_px():
    truth = np.random.default_rng(1).uniform(140, 300, (4, 4))
    found = [sem.measure_diameters(render(truth, seed), ABOUT) for seed in range(4)]
    runs = np.array([each.diameter_nm for each in found])
    error_px = (runs - truth.ravel()) / PIXEL
    assert not np.isnan(runs).any()
    assert abs(error_px.mean()) < 0.3
    assert error_px.std(0, ddof=1).mean() < 0.1
    assert np.abs(error_px).max() < 1.0
    told_px = np.array([each.sigma_nm for each in found]) / PIXEL
    ratio = np.sqrt(error_px.var(0, ddof=1).mean() / (told_px**2).mean())
    assert (
        0.5 < ratio < 1.3
    )  # 48 degrees of freedom: 10 %; the bar takes four rays as one, which is on the safe side


def test_missing_and_collapsed_pillars_are_named():
    truth = np.full((4, 4), 200.0)
    found = sem.measure_diameters(
        render(truth, missing={(1, 2), (3, 3)}, moved={(2, 0)}), ABOUT
    )
    assert np.flatnonzero(found.missing).tolist() == [6, 15]
    assert np.flatnonzero(found.collapsed).tolist() == [8]
    assert np.isnan(found.diameter_nm[[6, 15, 8]]).all()
    assert abs(found.mean_nm - 200) < 0.3 * PIXEL
    assert found.three_sigma_nm < 3 * PIXEL


def test_bias_becomes_prior_knowledge_of_the_fit():
    truth = np.full((4, 4), 206.0)
    known = sem.measure_diameters(render(truth), ABOUT).bias(200.0)
    assert known.name == "bias_nm"
    assert abs(known.value - 6) < 0.3 * PIXEL
    assert 0 < known.sigma < 1


def test_wrong_pitch_is_refused():
    with pytest.raises(CaptureError, match="no lattice"):
        sem.measure_diameters(
            render(np.full((4, 4), 200.0)), sem.SemMicrograph(PIXEL, 533.0)
        )
    with pytest.raises(CaptureError, match="6 or more pixels"):
        sem.SemMicrograph(100.0, 400.0)


def test_scale_bar_gives_the_pixel():
    picture = np.full((200, 200), 90, np.uint8)
    picture[190:193, 30:155] = 255
    assert sem.scale_from_bar(picture, 500.0) == pytest.approx(4.0)
    with pytest.raises(CaptureError, match="no scale bar"):
        sem.scale_from_bar(np.eye(200), 500.0)


def test_calibrated_edge_bias_comes_off_both_sides():
    image = render(np.random.default_rng(4).uniform(160, 260, (4, 4)))
    plain = sem.measure_diameters(image, ABOUT).diameter_nm
    calibrated = sem.measure_diameters(
        image, sem.SemMicrograph(PIXEL, PITCH, edge_bias_nm=3.7)
    ).diameter_nm
    assert plain - calibrated == pytest.approx(np.full(16, 7.4), abs=1e-9)
