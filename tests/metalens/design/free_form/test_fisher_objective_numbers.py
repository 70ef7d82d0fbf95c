"""The objective of a free-form design added up image by image, what its steps draw, and
the lens as made by hand.
"""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

from metalens.design.free_form.objective import AxialObjective, Robust, Score, score
from metalens.design.free_form.settings import Fisher, Variation
from metalens.design.profiles import Focus
from metalens.image import Field, Pupil, encircled_energy, pixel_information
from metalens.image import pupil as pupils

PUPIL, SOURCE = Pupil(210.0, 1700.0, 0.81, 64), 21e3
BASE = Fisher(
    depths_mm=(13.0, 37.0),
    angles_deg=(0.0, 4.0),
    even=0.3,
    pixel_um=7.7,
    radius_um=23.0,
)
ASKED = dataclasses.replace(
    BASE.about(Focus(0.81, 1700.0, SOURCE), 210.0), sample_um=1.9, step_um=310.0
)
PHASE = 0.8 * torch.randn(
    64, 64, generator=torch.Generator().manual_seed(4), dtype=torch.float64
)


@functools.cache
def image(depth_um, field, window_um):
    samples = math.floor(min(window_um, PUPIL.period_um) / 1.9)
    stack = pupils.psf(
        PHASE, PUPIL, depths_um=torch.tensor([depth_um], dtype=torch.float64), fields=[field], focus_um=SOURCE,
        sample_um=1.9, samples=samples,
    )  # fmt: skip
    return stack[0]


def told(depth_um, field, shift_um, window_um):
    """Eq. 11 at one depth: of the change over 310 um."""
    near, far = (
        image(depth_um, field, window_um),
        image(depth_um + 310.0, field, window_um),
    )
    how = {"step_um": 310.0, "sample_um": 1.9, "pixel_um": 7.7, "normalisation": "l2"}
    return float(pixel_information(near, far, shift_um=shift_um, **how))


def test_the_loss_is_added_up_over_seven_depths_every_angle_and_two_positions():
    """Quarters of a pixel along both diagonals; of each position even of the mean
    logarithm and the rest of the
    logarithm of an angle's mean. Energies in the order of the images, of the near
    depths."""
    fields = [Field(0.0), Field(math.radians(4.0))]
    want = 0.0
    for y, x in ((-7.7 / 4, 7.7 / 4), (7.7 / 4, -7.7 / 4)):
        table = np.array(
            [
                [told(1e3 * z, f, (y, x), ASKED.climb_window_um) for f in fields]
                for z in (13, 17, 21, 25, 29, 33, 37)
            ]
        )
        each, of_mean = np.log(table + 1e-4).mean(), np.log(table.mean(0) + 1e-4).mean()
        want -= (0.3 * each + 0.7 * of_mean) / 2
    loss, energy = AxialObjective(PUPIL, ASKED).loss(PHASE, SOURCE, None)
    assert float(loss) == pytest.approx(
        want, rel=1e-5
    )  # single precision of the images
    assert energy.shape == (14,)
    for at, (z, f) in (
        (0, (13, 0)),
        (1, (13, 1)),
        (5, (21, 1)),
        (12, (37, 0)),
        (13, (37, 1)),
    ):
        lit = encircled_energy(
            image(1e3 * z, fields[f], ASKED.climb_window_um), 1.9, radius_um=23.0
        )
        assert float(energy[at]) == pytest.approx(float(lit), rel=1e-5)


@pytest.mark.parametrize(
    ("angles", "count"),
    [((0.0,), 4), ((0.0, 5.0), 4), ((1.0, 3.0, 5.0), 6), ((2.0,) * 5, 10)],
)
def test_a_step_draws_one_depth_in_every_part_of_the_range_and_its_angles_in_turn(
    angles, count
):
    """Four images at least, and two an angle; one in each of as many equal parts of the
    depths, over a hundred draws to
    both ends of each; directions of the field in quarters of a turn, none on the axis;
    positions to half a pixel."""
    asked, generator = (
        dataclasses.replace(ASKED, angles_deg=angles),
        torch.Generator().manual_seed(11),
    )
    places, turns, where = [], set(), []
    for _ in range(100):
        depths, fields, positions = AxialObjective(PUPIL, asked)._drawn(generator)
        assert [f.angle_rad for f in fields] == pytest.approx(
            [math.radians(angles[i % len(angles)]) for i in range(count)]
        )
        places.append(
            (np.sort(depths.numpy()) - 13e3) / (24e3 / count) - np.arange(count)
        )
        turns |= {
            round(f.azimuth_rad / (math.pi / 2), 9) for f in fields if f.angle_rad
        }
        assert all(f.azimuth_rad == 0 for f in fields if not f.angle_rad)
        assert positions.shape == (2, 2)
        where.append(positions.numpy())
    places, where = np.array(places), np.array(where)
    assert places.shape == (100, count)
    assert places.min() >= 0
    assert places.max() <= 1
    assert places.min() < 0.05  # of 400 draws and more, none but once in 1e8
    assert places.max() > 0.95
    assert turns == ({0.0, 1.0, 2.0, 3.0} if any(angles) else set())
    assert -0.5 <= where.min() < -0.4
    assert 0.4 < where.max() <= 0.5


def test_depths_of_the_parts_come_in_no_order():
    """Else near depths would always meet the first angle."""
    generator = torch.Generator().manual_seed(5)
    first = [
        float(AxialObjective(PUPIL, ASKED)._drawn(generator)[0][0]) for _ in range(40)
    ]
    assert min(first) < 19e3
    assert max(first) > 31e3


def test_honest_figures_off_the_axis_are_of_two_directions():
    """The mean of I(z), each over nine positions of the pixels, and the least energy,
    at depths from end to end.
    """
    got = score(PHASE, PUPIL, focus_um=SOURCE, settings=ASKED, depths=2)
    assert got.information.shape == got.encircled.shape == (2, 2)
    for row, fields in enumerate(
        ([Field(0.0)], [Field(math.radians(4.0), turn) for turn in (0.0, math.pi / 2)])
    ):
        for column, depth in enumerate((13e3, 37e3)):
            shifts = [7.7 * s for s in (-1 / 3, 0, 1 / 3)]
            each = [
                told(depth, f, (y, x), ASKED.window_um)
                for f in fields
                for y in shifts
                for x in shifts
            ]
            assert float(got.information[row, column]) == pytest.approx(
                np.mean(each), rel=1e-4
            )
            lit = [
                encircled_energy(image(depth, f, ASKED.window_um), 1.9, radius_um=23.0)
                for f in fields
            ]
            assert float(got.encircled[row, column]) == pytest.approx(
                float(min(lit)), rel=1e-5
            )


def test_one_angle_has_one_row_and_eleven_depths():
    got = AxialObjective(PUPIL, dataclasses.replace(ASKED, angles_deg=(4.0,))).judge(
        PHASE, SOURCE
    )
    assert got.information.shape == got.encircled.shape == (11,)
    both = score(PHASE, PUPIL, focus_um=SOURCE, settings=ASKED)
    assert got.information.tolist() == pytest.approx(
        both.information[1].tolist(), rel=1e-6
    )
    assert both.information.shape == (2, 11)


class Told:
    """An objective whose loss and figures are given by the mean phase that it is asked
    of.
    """

    def __init__(self):
        self.asked = []

    def loss(self, phase_rad, focus_um, generator):
        self.asked.append((phase_rad, focus_um, generator))
        mean = phase_rad.mean()
        return 3 * mean, torch.stack([0.4 + mean / 100, 0.4 - mean / 70])

    def judge(self, phase_rad, focus_um):
        self.asked.append((phase_rad, focus_um, None))
        mean = phase_rad.mean()
        return Score(
            torch.stack([5 + mean, 5 - mean]),
            torch.stack([0.4 - mean / 70, 0.6 + mean / 100]),
        )


def as_made(sign, phase=0.07, distance=41.0):
    """Pillars give (1 ± 0.07) of their phase in [0, 2π); the sensor lies 41 um farther
    or nearer.
    """
    x, y = (a.numpy() for a in pupils.coordinates(PUPIL))
    r2, k = x**2 + y**2, 2 * math.pi / 0.81
    d, moved = (
        np.sqrt(r2 + 1700.0**2) - 1700.0,
        np.sqrt(r2 + (1700.0 + sign * distance) ** 2),
    )
    whole = PHASE.numpy() - k * (d + np.sqrt(r2 + SOURCE**2) - SOURCE)
    return (
        PHASE.numpy()
        + sign * phase * np.mod(whole, 2 * math.pi)
        + k * (moved - 1700.0 - sign * distance - d)
    )


def same(got, want):
    """Turns of 1e3 rad lost by cancellation: 1e-8; where a pillar's phase is 0 or 2π
    either may come.
    """
    off = np.abs(got.detach().numpy() - want)
    assert np.quantile(off, 0.999) < 1e-7


def test_the_lens_as_made_has_pillars_of_more_phase_and_a_sensor_farther_off():
    inner = Told()
    robust = Robust(inner, PUPIL, Variation(0.07, 41.0))
    loss, energy = robust.loss(PHASE, SOURCE, None)
    assert [focus for _, focus, _ in inner.asked] == [SOURCE] * 2
    for sign, (phase, _, generator) in zip((1, -1), inner.asked, strict=True):
        same(phase, as_made(sign))
        assert generator is None
    high, low = (float(phase.mean()) for phase, *_ in inner.asked)
    assert float(loss) == pytest.approx(3 * (high + low) / 2, rel=1e-12)
    both = [[0.4 + m / 100, 0.4 - m / 70] for m in (high, low)]
    assert energy.tolist() == pytest.approx(np.min(both, axis=0), rel=1e-12)


def test_a_step_takes_one_sign_at_random():
    inner, generator = Told(), torch.Generator().manual_seed(2)
    robust = Robust(inner, PUPIL, Variation(0.07, 41.0))
    signs = []
    for _ in range(60):
        loss, energy = robust.loss(PHASE, SOURCE, generator)
        phase, focus, passed = inner.asked[-1]
        assert passed is generator
        assert focus == SOURCE
        mean = float(phase.mean())
        assert float(loss) == pytest.approx(3 * mean, rel=1e-12)
        assert energy.tolist() == pytest.approx(
            [0.4 + mean / 100, 0.4 - mean / 70], rel=1e-12
        )
        signs.append(1 if abs(mean - as_made(1).mean()) < 1e-6 else -1)
        same(phase, as_made(signs[-1]))
    assert len(inner.asked) == 60
    assert (
        abs(sum(signs)) < 60 - 2 * 12
    )  # 18 to 42 of 60: each beyond by chance once in 300


def test_it_is_judged_by_the_worst_of_three_at_every_depth():
    inner = Told()
    got = Robust(inner, PUPIL, Variation(0.07, 41.0)).judge(PHASE, SOURCE)
    means = [float(phase.mean()) for phase, *_ in inner.asked]
    assert len(means) == 3
    same(inner.asked[0][0], PHASE.numpy())
    assert means[1:] == pytest.approx([as_made(1).mean(), as_made(-1).mean()], abs=1e-7)
    assert got.information.tolist() == pytest.approx(
        [5 + min(means), 5 - max(means)], rel=1e-9
    )
    assert got.encircled.tolist() == pytest.approx(
        [0.4 - max(means) / 70, 0.6 + min(means) / 100], rel=1e-9
    )


def test_each_cause_moves_the_lens_alone():
    for phase, distance in ((0.11, 0.0), (0.0, 23.0)):
        inner = Told()
        Robust(inner, PUPIL, Variation(phase, distance)).loss(PHASE, SOURCE, None)
        for sign, (made, *_) in zip((1, -1), inner.asked, strict=True):
            same(made, as_made(sign, phase, distance))
