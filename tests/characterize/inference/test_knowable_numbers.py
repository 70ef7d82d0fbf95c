"""Densities of drawn valleys in closed form, and the pairs and thresholds of what is
told in words.
"""

import math

import numpy as np
import pytest
from scipy import special

from characterize.inference import knowable
from characterize.model import PARAMETERS, PLACE


def test_the_density_of_a_parabola_is_a_normal_distribution_also_beyond_its_ends():
    """Rise ((v - 1.3) / 0.7)², told at unlike steps out to 8 sigma, in any order and
    one of them twice.
    """
    value = 1.3 + 0.7 * np.array([-8.0, -3.0, -1.1, 0.0, 0.4, 2.0, 8.0, -1.1])
    order = np.array([5, 0, 7, 3, 1, 6, 2, 4])
    curve = np.stack([value, ((value - 1.3) / 0.7) ** 2])[:, order]
    at = np.array([[-6.2, 0.5, 1.3], [1.9, 4.4, 7.3]])
    want = np.exp(-(((at - 1.3) / 0.7) ** 2) / 2) / (0.7 * math.sqrt(2 * math.pi))
    assert knowable.profile_density(curve, at) == pytest.approx(
        want, rel=2e-4
    )  # 2001 points over 16 sigma: h² / 12 of 1


def test_a_valley_that_is_steeper_to_one_side_has_two_halves_of_normal_distributions():
    """Roots -3, 0, 2 at -1.5, 0, 4: sigma 0.5 and 2; beyond the ends they go on, the
    whole is that between them.
    """
    curve = np.array([[-1.5, 0.0, 4.0], [9.0, 0.0, 4.0]])
    whole = math.sqrt(math.pi / 2) * (
        0.5 * special.erf(3 / math.sqrt(2)) + 2.0 * special.erf(2 / math.sqrt(2))
    )
    at = np.array([-2.0, -1.0, -0.25, 0.0, 1.0, 3.0, 5.0])
    root = np.where(at < 0, at / 0.5, at / 2.0)
    assert knowable.profile_density(curve, at) == pytest.approx(
        np.exp(-(root**2) / 2) / whole, rel=1e-4
    )
    below = np.array([[-1.5, 0.0, 4.0], [9.0, -1e-9, 4.0]])  # rounding of the least
    assert knowable.profile_density(below, at) == pytest.approx(
        knowable.profile_density(curve, at), rel=1e-9
    )


def test_the_slope_beyond_an_end_is_that_of_the_last_two_points():
    """Roots -4, -1, 0, 3, 4 at -3, -1, 0, 1, 3: 1.5 and 0.5 a unit beyond."""
    curve = np.array([[-3.0, -1.0, 0.0, 1.0, 3.0], [16.0, 1.0, 0.0, 9.0, 16.0]])
    found = knowable.profile_density(curve, np.array([-3.0, -3.4, 3.0, 3.8]))
    assert found[1] / found[0] == pytest.approx(math.exp((16.0 - 4.6**2) / 2), rel=1e-9)
    assert found[3] / found[2] == pytest.approx(math.exp((16.0 - 4.4**2) / 2), rel=1e-9)


def words(first, second, size, prior=np.inf):
    sigma = np.array([0.3, 2.0])
    covariance = np.array([[1, size], [size, 1.0]]) * np.outer(sigma, sigma)
    return knowable.correlated_pairs((first, second), covariance, np.full(2, prior))


@pytest.mark.parametrize(
    ("first", "second", "why"),
    [
        ("wavelength_nm", "distance_um", "spectrometer"),
        ("distance_um", "stage_zero_um", "widen the depth range"),
        ("distance_um", "stage_scale", "calibrate the stage"),
        ("bias_nm", "height_nm", "CDs (SEM) or height (AFM)"),
        ("bias_x_nm", "light_x", "lamp's profile"),
        ("light_y", "bias_y_nm", "lamp's profile"),
        ("tilt_x_deg", "coma_x_rad", "opposite field angles"),
        ("bandwidth_nm", "crosstalk_px", "measure the spectrum"),
        (
            "tilt_x_deg",
            "coma_y_rad",
            "an independent measurement of either settles both",
        ),
    ],
)
def test_pairs_have_their_reasons_in_either_order(first, second, why):
    for one, other in ((first, second), (second, first)):
        (line,) = words(one, other, -0.93)
        assert line.startswith(f"{one} and {other} go together (correlation -0.930): ")
        assert why in line


@pytest.mark.parametrize(("size", "told"), [(0.899, 0), (0.901, 1), (-0.901, 1)])
def test_pairs_go_together_beyond_nine_tenths(size, told):
    assert len(words("bias_nm", "index", size)) == told


@pytest.mark.parametrize(("prior", "told"), [(2.0 / 0.79, 0), (2.0 / 0.81, 1)])
def test_a_parameter_comes_from_its_prior_where_four_fifths_of_it_are_left(prior, told):
    found = knowable.correlated_pairs(
        ("bias_nm",), np.array([[4.0]]), np.array([prior])
    )
    assert (
        found
        == [
            f"bias_nm comes from prior knowledge ({prior:g}), the frames add little (now 2)"
        ]
        * told
    )


def test_the_tightest_pair_comes_first_and_units_are_those_of_the_parameters():
    names = ("bias_nm", "height_nm", "index")
    correlation = np.array([[1, 0.92, 0.9], [0.92, 1, 0.97], [0.9, 0.97, 1.0]])
    found = knowable.correlated_pairs(names, correlation, np.full(3, np.inf))
    assert [line.split(" go together")[0] for line in found] == [
        "height_nm and index",
        "bias_nm and height_nm",
    ]
    scale = np.array([PARAMETERS[PLACE[name]].scale for name in names])
    values, vectors = knowable.information_eigenvectors(
        names, np.diag([3.0, -1e-12, 7.0]) / scale**2
    )
    assert values == pytest.approx(
        [0.0, 3.0, 7.0], abs=1e-11
    )  # what is negative is rounding
    assert (values >= 0).all()
    assert np.abs(vectors) == pytest.approx(
        np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1.0]]), abs=1e-9
    )
