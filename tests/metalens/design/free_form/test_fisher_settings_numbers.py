"""What a design is asked for where it was left to the lens: by numbers worked out by
hand for one lens.
"""

import math

import pytest

from metalens.design.free_form.settings import Asked, Fisher, between_mm
from metalens.design.profiles import Focus
from metalens.ground.errors import ConfigError

FOCUS, RADIUS = (
    Focus(0.94, 1300.0, 17e3),
    230.0,
)  # wavelength / NA = 0.94 * 1300 / 230 = 5.313 um


def test_what_is_left_out_is_worked_out_from_the_lens():
    """1.75 waves at the rim are 2 * 1.75 * 0.94 / 230² = 6.219e-5 per um, of 1 / 17 mm
    = 5.882e-5: near at 8.263 mm;
    far, never out of focus by that, at ten times near. Window: 42.4 * 5.313 = 225.3,
    more than eight blurs of
    230 * 1300 (1 / 8300 - 1 / 17000) = 18.4; two thirds of it while climbing. Step 0.23
    * 0.94 (8300 / 230)² = 281.6,
    at most a fiftieth of 8300. Samples 0.86 * 0.94 / (4 * 0.17422) = 1.16, less than a
    quarter of 4.7."""
    made = Fisher().about(FOCUS, RADIUS)
    assert made.depths_mm == pytest.approx((8.3, 83.0), rel=1e-12)
    assert made.window_um == pytest.approx(225.0, rel=1e-12)
    assert made.climb_window_um == pytest.approx(150.0, rel=1e-12)
    assert (made.pixel_um, made.radius_um, made.sample_um) == pytest.approx(
        (4.7, 28.0, 1.2), rel=1e-12
    )
    assert made.step_um == pytest.approx(170.0, rel=1e-12)
    # 1 / 8.3 = 0.12048 and 1 / 83 = 0.01205 per mm: 0.08904 and 0.04349 at 29 % and 71
    # %
    assert made.focus_mm == pytest.approx((11.0, 23.0), rel=1e-12)


def test_what_is_given_is_kept_and_decides_the_rest():
    """Pixels of 3.1: samples of a quarter. Near at 5 mm: eight blurs of 230 * 1300 (1 /
    5000 - 1 / 17000) = 42.21.
    """
    own = Fisher(
        depths_mm=(5.0, 40.0),
        pixel_um=3.1,
        radius_um=21.5,
        focus_mm=(6.1, 7.3),
        encircled=0.37,
        grids=(7, 13),
        seed=5,
    )
    made = own.about(FOCUS, RADIUS)
    assert isinstance(made, Asked)
    assert made.depths_mm == pytest.approx((5.0, 40.0), rel=1e-12)
    assert (made.pixel_um, made.radius_um, made.focus_mm) == (3.1, 21.5, (6.1, 7.3))
    assert (made.encircled, made.grids, made.seed) == (0.37, (7, 13), 5)
    assert made.window_um == pytest.approx(338.0, rel=1e-12)
    assert made.climb_window_um == pytest.approx(338 * 2 / 3, rel=1e-12)
    assert made.sample_um == pytest.approx(0.78, rel=1e-12)  # 3.1 / 4 = 0.775
    assert made.step_um == pytest.approx(
        100.0, rel=1e-12
    )  # 0.216 (5000 / 230)² = 102 is more than a fiftieth
    assert made.about(Focus(0.5, 900.0, 3e3), 100.0) is made


def test_three_pixels_fit_into_what_is_climbed():
    """225 um of window: 50 um pixels are the widest."""
    assert Fisher(pixel_um=49.9).about(FOCUS, RADIUS).pixel_um == 49.9
    with pytest.raises(
        ConfigError,
        match=r"need at most 50 um for a lens whose spots are seen in a window of 150 um",
    ):
        Fisher(pixel_um=50.1).about(FOCUS, RADIUS)


@pytest.mark.parametrize(
    ("shares", "want"),
    [
        ((0.0, 1.0), (16.0, 26.0)),
        (
            (0.25, 0.75),
            (18.0, 23.0),
        ),  # 1 / (1 / 16 - 0.25 * (1 / 16 - 1 / 26)) = 17.70, and 22.49 -> 22
        ((-0.5, 1.5), (13.0, 38.0)),  # 13.42, 37.82
        ((2.0, 3.0), (69.0, 260.0)),  # 69.33; beyond infinity a tenth of 1 / 26
    ],
)
def test_foci_lie_at_shares_of_the_range_in_inverse_depth(shares, want):
    inverse = [max(1 / 16 - s * (1 / 16 - 1 / 26), 0.1 / 26) for s in shares]
    got = between_mm((16e3, 26e3), *shares)
    assert got == pytest.approx([float(f"{1 / u:.1e}") for u in inverse], rel=1e-12)
    assert got == pytest.approx(want, rel=0.06)  # the same by hand, to two digits
    assert all(math.isfinite(z) for z in got)


@pytest.mark.parametrize("grids", [(5,), (4,), (4, 4), (7, 0), (4, 0), (9, 5, 0)])
def test_grids_of_four_and_nodes_as_the_last_are_taken(grids):
    assert Fisher(grids=grids).grids == grids


@pytest.mark.parametrize("grids", [(), (0,), (3,), (3, 0), (0, 5), (5, 3), (5, 0, 7)])
def test_other_grids_are_refused(grids):
    with pytest.raises(ConfigError, match="grids"):
        Fisher(grids=grids)


@pytest.mark.parametrize("length", ["radius_um", "pixel_um"])
def test_either_length_of_nothing_is_refused(length):
    assert getattr(Fisher(**{length: 0.01}), length) == 0.01
    with pytest.raises(ConfigError, match=f"{length} = 0"):
        Fisher(**{length: 0.0})
