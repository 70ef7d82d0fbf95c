"""A few lit samples on pixels: whole ones, parts of ones at their edges, and what a
shift of the grid moves.
"""

import dataclasses

import numpy as np
import pytest

from metalens.core.errors import PropagationError
from metalens.psf import PsfStack, on_pixels

ENERGY = np.array([7.0, 4.0])


def stack(*places):
    """A depth for every list of (row, column, light) on 12 x 12 samples of 0.5 um."""
    light = np.zeros((len(places), 12, 12))
    for depth, lit in enumerate(places):
        for row, column, value in lit:
            light[depth, row, column] = value
    about = {
        "weights": np.ones(1),
        "step_um": 0.5,
        "centres_um": np.zeros((1, 2)),
        "sensor_distance_um": 900.0,
    }
    axes = {
        "depths_um": np.array([5e3, 9e3]),
        "angles_rad": np.zeros((1, 2)),
        "wavelengths_um": np.array([0.85]),
    }
    return PsfStack(
        light, ENERGY, **axes, **about, tolerance=1e-4, error=1e-4, reason="by hand"
    )


TWO = stack([(1, 4, 0.75), (10, 7, 0.25)], [(5, 0, 0.4), (6, 11, 0.6)])


def test_pixels_of_three_samples_hold_theirs():
    """Four by four on 6 um; two by two of their pairs; the middle two by two lose the
    first depth's light.
    """
    found = on_pixels(TWO, pitch_um=1.5)
    want = np.zeros((2, 4, 4))
    want[0, 0, 1], want[0, 3, 2], want[1, 1, 0], want[1, 2, 3] = 0.75, 0.25, 0.4, 0.6
    assert found.intensity == pytest.approx(want, abs=1e-12)
    assert found.energy_um2 == pytest.approx(ENERGY, rel=1e-12)
    assert found.step_um == 1.5
    binned = on_pixels(TWO, pitch_um=1.5, bins=2)
    want = np.array([[[0.75, 0.0], [0.0, 0.25]], [[0.4, 0.0], [0.0, 0.6]]])
    assert binned.intensity == pytest.approx(want, abs=1e-12)
    assert binned.step_um == 3.0


def test_a_grid_that_moves_leaves_light_out():
    """By two samples down and three to the left: of the middle six by six, rows 5 to 10
    and columns 0 to 5.
    """
    light = stack([(6, 3, 0.75), (10, 7, 0.25)], [(5, 0, 0.4), (6, 11, 0.6)])
    found = on_pixels(light, pitch_um=0.5, count=6, shift_um=(1.0, -1.5))
    want = np.zeros((2, 6, 6))
    want[0, 1, 3] = want[1, 0, 0] = 1.0
    assert found.intensity == pytest.approx(want, abs=1e-12)
    assert found.energy_um2 == pytest.approx([7 * 0.75, 4 * 0.4], rel=1e-12)


def test_a_lens_alone_needs_no_axis_of_its_own():
    """(depth, y, x) and (lens, angle, depth, y, x) are summed over the same axes."""
    many = dataclasses.replace(
        TWO, intensity=TWO.intensity[None, None], energy_um2=ENERGY[None, None]
    )
    found, want = on_pixels(many, pitch_um=1.5), on_pixels(TWO, pitch_um=1.5)
    assert found.intensity[0, 0] == pytest.approx(want.intensity, abs=1e-12)
    assert found.energy_um2[0, 0] == pytest.approx(want.energy_um2, rel=1e-12)


@pytest.mark.parametrize(
    ("pitch", "bins", "refused"),
    [(0.5, 1, False), (0.25, 2, False), (0.49, 1, True), (1.5, 0, True)],
)
def test_pixels_are_as_wide_as_samples_at_least(pitch, bins, refused):
    if refused:
        with pytest.raises(
            PropagationError,
            match=f"pixels of {pitch if bins else 0.0} um binned {bins} x {bins}",
        ):
            on_pixels(TWO, pitch_um=pitch, bins=bins)
    else:
        assert on_pixels(TWO, pitch_um=pitch, bins=bins).intensity == pytest.approx(
            TWO.intensity, abs=1e-12
        )


def test_a_psf_whose_light_falls_beside_the_pixels_stays_dark():
    """Of the corner's light the middle two by two pixels see none: 0 and no energy,
    where 0 / 0 was no number.
    """
    found = on_pixels(stack([(0, 0, 1.0)], [(5, 5, 1.0)]), pitch_um=1.5, count=2)
    assert found.intensity.tolist() == [
        [[0.0, 0.0], [0.0, 0.0]],
        [[1.0, 0.0], [0.0, 0.0]],
    ]
    assert found.energy_um2.tolist() == [0.0, 4.0]
