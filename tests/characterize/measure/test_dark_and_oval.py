"""Micrographs whose tops are darker than the ground, and pillars that are no discs:
drawn by area, sizes known.
"""

import numpy as np
import pytest
from scipy import ndimage

from characterize.measure import sem

PITCH, COUNT, FINE = 44.0, 4, 3


def drawn(*, top, ground, rim, width, long=1.0, seed=3):
    """(picture, (row, column) diameters of equal area): pillars turned at random, a rim
    of ``width`` inside them.
    """
    rng = np.random.default_rng(seed)
    size = int(COUNT * PITCH)
    y, x = (np.indices((size * FINE,) * 2) + 0.5) / FINE
    picture = np.full(y.shape, float(ground))
    diameter = rng.uniform(20, 31, (COUNT, COUNT))
    for (j, i), wide in np.ndenumerate(diameter):
        turn = rng.uniform(0, np.pi)
        dy, dx = y - (j + 0.46) * PITCH, x - (i + 0.53) * PITCH  # no cell's middle
        one = dx * np.cos(turn) + dy * np.sin(turn)
        other = dy * np.cos(turn) - dx * np.sin(turn)
        away = np.hypot(one / np.sqrt(long), other * np.sqrt(long))
        picture[away < wide / 2] = rim
        picture[away < wide / 2 - width] = top
    picture = ndimage.gaussian_filter(
        picture.reshape(size, FINE, size, FINE).mean((1, 3)), 0.8
    )
    return picture + 0.03 * rng.standard_normal(picture.shape), diameter


def wrong_by(found, diameter):
    """(p,) measured less true, in pixels; each at its own place."""
    j, i = (np.floor(v / PITCH).astype(int) for v in (found.row, found.column))
    return found.diameter_nm - diameter[j, i]


@pytest.mark.parametrize(
    ("top", "ground", "stated"), [(0.2, 0.2, 0.0), (0.05, 0.3, PITCH)]
)
def test_dark_tops_within_bright_rims_are_measured_at_their_outer_edge(
    top, ground, stated
):
    """Half of a rim 4 wide that blur and smoothing (0.8 and 1) lower is up to a pixel
    farther out, of all alike.
    """
    picture, diameter = drawn(top=top, ground=ground, rim=1.0, width=4.0)
    found = sem.measure_diameters(picture, sem.SemMicrograph(1.0, stated))
    assert found.lattice.kind == "square"
    # four pillars a side, waves as weak as what their sizes differ by
    assert found.lattice.pitch_px == pytest.approx(PITCH, rel=0.03)
    assert len(found.row) >= 9
    assert not (found.missing | found.collapsed | found.oval).any()
    wrong = wrong_by(found, diameter)
    assert 0 < wrong.mean() < 1
    # noise: 0.03; diameters differ by 11, and a rim's peak with them
    assert wrong.std() < 0.15


@pytest.mark.parametrize(("long", "oval"), [(1.1, False), (1.25, True), (1.6, True)])
def test_pillars_longer_than_wide_by_a_sixth_are_named_and_others_have_the_circle_of_their_area(
    long, oval
):
    picture, diameter = drawn(top=0.8, ground=0.2, rim=1.0, width=3.0, long=long)
    found = sem.measure_diameters(picture, sem.SemMicrograph(1.0, PITCH))
    assert len(found.row) >= 9
    assert (found.oval == oval).all()
    assert (np.isfinite(found.diameter_nm) != oval).all()
    if not oval:
        assert np.abs(wrong_by(found, diameter)).max() < 0.8  # half of a rim, as above


def test_noise_makes_no_discs_oval():
    picture, _ = drawn(top=0.7, ground=0.2, rim=1.0, width=3.0, seed=8)
    noisy = picture + 0.2 * np.random.default_rng(4).standard_normal(picture.shape)
    assert not sem.measure_diameters(noisy, sem.SemMicrograph(1.0, PITCH)).oval.any()
