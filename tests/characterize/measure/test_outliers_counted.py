"""Outliers of a measured patch: how many sound pillars are called one, and what a
fallen one does to the bias.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from characterize.measure import overlay
from characterize.measure.lattice import ImageLattice
from metalens.lens import DiameterMap

RNG = np.random.default_rng(19)


def laid(scatter_nm, fallen=(), by=0.0, side=36):
    """Pillars measured with normal errors about a bias of -7.5 nm, on their design;
    ``fallen`` ones off by more.
    """
    drawn = RNG.uniform(110, 290, (side + 5, side + 3))
    site = np.argwhere(np.ones((side, side), bool))
    made = (
        drawn[site[:, 0] + 3, site[:, 1] + 2]
        - 7.5
        + RNG.normal(0, scatter_nm, len(site))
    )
    made[list(fallen)] += by
    lattice = ImageLattice(np.zeros(2), np.r_[0.3, 9.0], np.r_[9.0, -0.3])
    found = SimpleNamespace(diameter_nm=made, site=site, lattice=lattice)
    return overlay.overlay_design(found, DiameterMap(drawn * 1e-3, 0.35))


def test_hardly_any_sound_pillar_is_an_outlier():
    """Normal errors pass 4 of their sigma once in 16 000: less than one pillar in ten
    pictures of 1300. Twice in three
    thousand is more than chance."""
    count = sum(int(laid(1.7).outlier.sum()) for _ in range(8))
    assert count <= 8 * 1296 * 1e-3


@pytest.mark.parametrize("sigma", [5.5, 7.0])
def test_pillars_five_sigma_off_are_left_out_of_the_bias(sigma):
    """One sound pillar in 26 million is as far off as the nearest of them; twenty of
    1296 would move the bias by
    their share, 0.15 of the scatter, five of its standard errors."""
    fallen = RNG.choice(1296, 20, replace=False)
    found = laid(1.7, fallen, sigma * 1.7 * 1.15)
    assert found.clearly
    assert (found.row, found.column) == (3, 2)
    assert (
        found.outlier[fallen].mean() > 0.85
    )  # own errors of theirs take some of them back
    table = overlay.bias_table(found, knots=3)
    for _, bias, error, _ in table:
        assert bias == pytest.approx(-7.5, abs=4 * error)
