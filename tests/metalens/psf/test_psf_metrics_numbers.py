"""What two lit samples of a small window are worth: transfers, circles, widths and
information by hand.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens.psf import PsfStack, metrics

STEP = 0.7
DEPTHS = np.array([4e3, 5.5e3, 9e3])
ENERGY = np.array([3.0, 7.0, 11.0])


def stack(light):
    """(depth, y, x) of sum 1 each."""
    light = np.asarray(light, float)
    about = {
        "weights": np.ones(1),
        "step_um": STEP,
        "centres_um": np.zeros((1, 2)),
        "sensor_distance_um": 900.0,
    }
    axes = {"angles_rad": np.zeros((1, 2)), "wavelengths_um": np.array([0.85])}
    count = len(light)
    made = {
        "depths_um": DEPTHS[:count],
        "tolerance": 1e-4,
        "error": 1e-4,
        "reason": "by hand",
    }
    return PsfStack(light, ENERGY[:count], **axes, **about, **made)


def two(share, first, second, shape=(6, 9)):
    """Light at two samples [row, column], of which the second has this share."""
    light = np.zeros(shape)
    light[first], light[second] = 1 - share, share
    return light


FIRST, SECOND = (1, 2), (3, 5)  # two rows and three columns apart
PAIR = stack([two(0.75, FIRST, SECOND), two(0.4, (5, 8), (0, 6))])


def test_the_transfer_of_two_lines_beats_with_their_distance():
    """|1 - a + a exp(-2 pi i f d)|² = 1 - 2 a (1 - a) (1 - cos 2 pi f d)."""
    f = np.array([0.0, 0.11, 0.34])
    found = metrics.mtf(PAIR, frequencies_per_um=f)
    assert found.shape == (2, 2, 3)
    for depth, (share, columns, rows) in enumerate(((0.75, 3, 2), (0.4, 2, 5))):
        for axis, apart in enumerate((columns, rows)):
            want = np.sqrt(
                1 - 2 * share * (1 - share) * (1 - np.cos(2 * np.pi * f * apart * STEP))
            )
            assert found[depth, axis] == pytest.approx(want, rel=1e-12)


def test_the_centre_of_light_counts_from_the_middle_of_the_window():
    """Nine columns have theirs at the fifth, six rows between the third and the fourth."""
    x, y = metrics.centroid(PAIR)
    assert x == pytest.approx(
        STEP * np.array([0.25 * -2 + 0.75 * 1, 0.6 * 4 + 0.4 * 2])
    )
    assert y == pytest.approx(
        STEP * np.array([0.25 * -1.5 + 0.75 * 0.5, 0.6 * 2.5 + 0.4 * -2.5])
    )
    angled = dataclasses.replace(
        PAIR, intensity=np.stack([PAIR.intensity[::-1], PAIR.intensity])
    )
    for one, of_angles in zip((x, y), metrics.centroid(angled), strict=True):
        assert of_angles == pytest.approx(np.stack([one[::-1], one]), rel=1e-12)


def test_circles_about_the_centre_hold_parts_of_the_samples_at_their_rim():
    """Two samples √13 steps apart: a quarter of that from the brighter one, three from
    the other; the rim is a step.
    """
    near, far = 0.25 * math.sqrt(13) * STEP, 0.75 * math.sqrt(13) * STEP
    radii = np.array([near - 0.4, near + 0.14, near + 0.36, far - 0.14, far + 0.36])
    want = np.array([0.0, 0.75 * (0.2 + 0.5), 0.75, 0.75 + 0.25 * (0.5 - 0.2), 1.0])
    found = metrics.encircled_energy(PAIR, radii_um=radii)
    assert found.shape == (2, 5)
    assert found[0] == pytest.approx(want, abs=1e-12)
    light = metrics.encircled_energy(PAIR, radii_um=radii, of_window=False)
    assert light == pytest.approx(found * np.array([[3.0], [7.0]]), rel=1e-12)


# quarters of the columns end behind 2 and 4 of them, those of the rows behind 1 and 2
PROFILES = np.outer([1.0, 5.0, 1.0, 1.0, 1.0], [1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0])
EVEN = STEP * math.sqrt(5 * 7 / math.pi)


@pytest.mark.parametrize(
    ("held", "rows", "columns"),
    [
        (
            1.0,
            2,
            3,
        ),  # a quarter on either side: from the third column to the fifth, from the second row to the third
        (0.85, 3, 3),  # 0.206 on either side, of the rows a fifth behind the first two
    ],
)
def test_the_blur_is_the_disc_whose_middle_half_is_as_wide_along_both_axes(
    held, rows, columns
):
    """Half of a disc lies within 0.4040 radii of its middle: 2/pi (c √(1 - c²) + asin
    c) = 1/2.
    """
    c = 0.4040
    assert 2 / math.pi * (c * math.sqrt(1 - c * c) + math.asin(c)) == pytest.approx(
        0.5, abs=1e-4
    )
    want = math.hypot(rows / 2, columns / 2) * STEP / c / math.sqrt(2)
    assert metrics.blur_um(PROFILES, STEP, held) == pytest.approx(
        min(want, EVEN / math.sqrt(held)), rel=1e-3
    )
    assert metrics.blur_um(PROFILES[:, ::-1].T, STEP, held) == pytest.approx(
        metrics.blur_um(PROFILES, STEP, held)
    )


def test_the_blur_is_at_most_the_disc_that_is_as_bright_as_the_window():
    """Of 45 % that is held it is that disc; of half the quarters lie at both rims,
    wider than it.
    """
    for held in (0.45, 0.5, 0.85):
        assert metrics.blur_um(PROFILES, STEP, held) == pytest.approx(
            EVEN / math.sqrt(held), rel=1e-12
        )
    lone = np.zeros((5, 7))
    lone[3, 1] = 2.0
    assert metrics.blur_um(lone, STEP, 0.45) == pytest.approx(
        EVEN / math.sqrt(0.45), rel=1e-12
    )
    assert metrics.blur_um(lone, STEP, 0.55) == pytest.approx(
        STEP / 2 / 0.404, rel=1e-3
    )  # one sample each way
    assert metrics.blur_um(PROFILES, STEP, 1.3) == metrics.blur_um(
        PROFILES, STEP
    )  # no more than all
    some = metrics.blur_um(np.stack([lone, PROFILES]), STEP, np.array([1.0, 0.45]))
    assert some == pytest.approx([STEP / 2 / 0.404, EVEN / math.sqrt(0.45)], rel=1e-3)


def test_information_is_the_squared_slope_between_neighbouring_depths():
    """Light of 1 moves to another sample, or half of it stays: 2, 1/2 and so on over
    the squared steps in mm.
    """
    light = [two(0.5, FIRST, SECOND), two(0.0, FIRST, SECOND), two(1.0, FIRST, SECOND)]
    middle, found = metrics.axial_information(stack(light), normalisation="sum")
    assert middle == pytest.approx([4750.0, 7250.0])
    assert found == pytest.approx([(0.5**2 + 0.5**2) / 1.5**2, 2 / 3.5**2], rel=1e-12)
    by_norm = metrics.axial_information(stack(light), normalisation="l2")[1]
    assert by_norm == pytest.approx(
        [(2 - math.sqrt(2)) / 1.5**2, 2 / 3.5**2], rel=1e-12
    )
    by_power = metrics.axial_information(stack(light), normalisation="none")[1]
    want = [((7 - 1.5) ** 2 + 1.5**2) / 1.5**2, (7**2 + 11**2) / 3.5**2]
    assert by_power == pytest.approx(want, rel=1e-12)
    named = metrics.information_by_name(stack(light))
    assert list(named) == ["sum", "l2"]
    assert named["l2"] == pytest.approx(by_norm)
    assert named["sum"] == pytest.approx(found)
