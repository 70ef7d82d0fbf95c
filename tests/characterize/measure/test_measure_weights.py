"""Weights and windows of measurements: what lies beside the spot, the edge, the pillar
does not move the answer.
"""

import math

import numpy as np
import pytest
from scipy import special, stats

from characterize.measure import frames, metrics, overlay, sem

RNG = np.random.default_rng(17)


def test_widths_are_those_of_the_spot_without_a_speck_far_off():
    """A hundredth of the light 30 samples away lies outside the window of three widths
    (ISO 11146-1).
    """
    y, x = np.mgrid[:80, :90]
    light = np.exp(-((x - 41.3) ** 2 / (2 * 2.1**2) + (y - 38.6) ** 2 / (2 * 1.7**2)))
    light[66:70, 60:64] += light.sum() * 0.01 / 16
    spot = metrics.measure_spot(light, step_um=0.6)
    assert spot.d4sigma_um == pytest.approx((4 * 2.1 * 0.6, 4 * 1.7 * 0.6), rel=2e-3)
    assert spot.centroid_um == pytest.approx(
        ((41.3 - 44.5) * 0.6, (38.6 - 39.5) * 0.6), abs=1e-3
    )


def test_the_line_of_an_edge_is_not_drawn_to_a_second_edge():
    """Of six tenths of the contrast, 20 samples behind: a fifth of a percent of the
    weight is left, 0.08 samples.
    """
    rows = np.arange(60)
    place = 31.7 + 0.11 * rows
    columns = np.arange(90)[None]
    image = 1 / (1 + np.exp(-(columns - place[:, None]) / 0.7))
    image += 0.6 / (1 + np.exp(-(columns - place[:, None] - 20) / 0.7))
    slope, offset = metrics._edge_line(image, rows)
    assert slope == pytest.approx(0.11, abs=1e-3)
    assert slope * 30 + offset == pytest.approx(31.7 + 3.3, abs=0.1)


@pytest.mark.parametrize(("peak", "seen"), [(11.2, True), (11.0, False)])
def test_one_bright_pixel_of_the_rim_is_not_noise(peak, seen):
    """The rim is 18.5, 20, 21.5 in turn: 5 x 1.4826 x 1.5 = 11.12 electrons above its
    median is a spot.
    """
    light = np.full((9, 10), 20.0)
    for edge in (light[0], light[-1], light[1:-1, 0], light[1:-1, -1]):
        edge += 1.5 * (np.arange(len(edge)) % 3 - 1)
    light[0, 4] = light[8, 7] = 300.0
    usable = np.ones(light.shape, bool)
    usable[0, 4] = usable[8, 7] = False
    light[4, 5] = 20.0 + peak
    if seen:
        rim = np.concatenate([light[0], light[-1], light[1:-1, 0], light[1:-1, -1]])
        assert frames._above(light, usable, "x.tif")[4, 5] == pytest.approx(
            light[4, 5] - np.median(rim)
        )
    else:
        with pytest.raises(
            frames.CaptureError,
            match=r"^x\.tif at 3\.7 um: no spot above five times .*defocus",
        ):
            frames._above(light, usable, "x.tif at 3.7 um")


def test_a_pillar_is_as_wide_from_wherever_its_site_is_guessed():
    """A circle about a place 0.9 pixels off is 0.9² / (4 x 12.4) = 0.016 pixels too
    narrow, until that is put right.
    """
    y, x = np.mgrid[:61, :61]
    disc = np.clip(12.4 - np.hypot(y - 30.2, x - 29.7) + 0.5, 0, 1)
    true = sem._pillar(disc, 30.2, 29.7, 40.0, there=True)
    off = sem._pillar(disc, 30.2 + 0.75, 29.7 - 0.5, 40.0, there=True)
    assert true[2] == pytest.approx(12.4, abs=0.05)  # rays are smoothed over a pixel
    assert off[2] == pytest.approx(true[2], abs=3e-3)
    assert off[:2] == pytest.approx((30.2, 29.7), abs=0.01)


def test_the_error_of_a_radius_is_the_scatter_of_its_rays_over_the_root_of_their_number():
    """Smoothed by a Gaussian of one ray and between pixels, less the oval's five
    numbers; half of rim and gap too.
    """
    y, x = np.mgrid[:61, :61]
    rough = 12.4 + 0.4 * np.cos(3 * np.arctan2(y - 30.2, x - 29.7))
    disc = np.clip(rough - np.hypot(y - 30.2, x - 29.7) + 0.5, 0, 1)
    _, _, radius, sigma, scatter = sem._edges(disc, 30.2, 29.7, 40.0)
    assert radius == pytest.approx(12.4, abs=0.05)
    assert scatter == pytest.approx(
        0.4 / math.sqrt(2), rel=0.05
    )  # smoothing over rays takes 3 %
    edge, rim, gap = (
        sem.RAYS
        / math.sqrt(4 * math.pi * (1 + 1 / 6 / (2 * math.pi * r / sem.RAYS) ** 2))
        for r in (radius, 9.4, (radius + 20) / 2)
    )
    noise = scatter**2 / (1 - 5 / edge)
    assert sigma == pytest.approx(
        math.sqrt(noise * (1 / edge + 0.25 / rim + 0.25 / gap)), rel=0.02
    )  # rim to 2 pixels


@pytest.mark.parametrize("long", [1.05, 1.14])
def test_what_is_a_little_oval_has_the_circle_of_its_area_and_is_no_noise(long):
    """Half axes of 12.4 times and over the root of their ratio, turned by 25 degrees;
    of r(t) the fourth wave is left.

    It is 3 / 16 of the square of half the ratio less one: 0.02 pixels at 1.14, over the
    root of 20 rays and 2.
    """
    y, x = np.mgrid[:61, :61]
    dy, dx, turn = y - 30.2, x - 29.7, math.radians(25)
    one, other = (
        dx * math.cos(turn) + dy * math.sin(turn),
        dy * math.cos(turn) - dx * math.sin(turn),
    )
    away = np.hypot(one / math.sqrt(long), other * math.sqrt(long))
    _, _, radius, sigma, scatter = sem._edges(
        np.clip(12.4 - away + 0.5, 0, 1), 30.2, 29.7, 40.0
    )
    assert radius == pytest.approx(
        12.4, abs=0.03
    )  # of which the ramp, no blur but taken for one, is 0.01
    assert sigma < 0.01
    assert scatter == pytest.approx(
        12.4 * (long - 1) / 2 / math.sqrt(2), rel=0.1
    )  # smoothing over rays: 2 %


def test_pillars_nearly_of_one_size_are_laid_by_what_little_they_differ():
    """Drawn sizes vary by 0.6 nm; made ones are 7 nm less: no scatter about the line
    where they belong.
    """
    drawn = 180.0 + 0.6 * RNG.standard_normal((9, 8))
    made = drawn[2:7, 3:7] - 7.0
    scatter = overlay._scatter(made, np.ones(made.shape), drawn)
    assert np.unravel_index(scatter.argmin(), scatter.shape) == (2, 3)
    assert scatter[2, 3] == pytest.approx(0, abs=1e-6)
    x = drawn[1:6, 1:5]
    slope = np.clip(
        np.cov(x.ravel(), made.ravel(), bias=True)[0, 1] / x.var(), 2 / 3, 4 / 3
    )
    rest = made - made.mean() - slope * (x - x.mean())
    assert scatter[1, 1] == pytest.approx(
        (rest**2).mean(), rel=1e-4
    )  # differences of squares of 180


def test_the_line_of_an_edge_lies_in_the_middle_of_the_square_of_its_slope():
    """An edge with a foot of half its height 5 pixels behind, as integrals: smoothed by
    one pixel (first slope), about
    the line within 12, 8, then 6 pixels. Of the slope itself it lay 0.4 pixels farther
    to the foot, of its cube 0.3
    nearer to the edge."""
    rows, columns = np.arange(40), np.arange(90)
    place = 37.4 + 0.11 * rows[:, None]
    image = special.ndtr((columns - place) / 1.6) + 0.5 * special.ndtr(
        (columns - place - 5) / 2.1
    )
    fine, middle = np.linspace(-40, 45, 17001), 0.0
    steep = sum(
        a * stats.norm.pdf(fine, at, math.hypot(s, 1))
        for a, at, s in ((1.0, 0.0, 1.6), (0.5, 5.0, 2.1))
    )
    for reach in (math.inf, 12, 8, 6):
        weight = np.exp(-0.5 * ((fine - middle) / reach) ** 2) * steep**2
        middle = (weight * fine).sum() / weight.sum()
    slope, offset = metrics._edge_line(image, rows)
    assert slope == pytest.approx(0.11, abs=1e-3)
    assert slope * 20 + offset == pytest.approx(
        37.4 + 2.2 + middle, abs=0.02
    )  # pixels in place of integrals
