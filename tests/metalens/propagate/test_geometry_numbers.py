"""Places, areas and parts of a propagation at unlike rows and columns, by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from metalens.core.errors import PropagationError
from metalens.propagate import geometry
from metalens.propagate.geometry import PropagationCase

CASE = PropagationCase(
    shape=(4, 7), pitch_um=0.5, row_um=0.8, wavelength_um=0.85, sensor_distance_um=90.0, tangents=(0.1, -0.2),
    inverse_depths_per_um=(0.0, 0.001), centre_um=(-6.0, 2.5), step_um=0.3, samples=(9, 14),
)  # fmt: skip


def test_lengths_along_rows_and_columns():
    assert CASE.steps_um == (0.8, 0.5)
    assert CASE.area_um2 == pytest.approx(0.4)
    assert replace(CASE, site_um2=0.9).area_um2 == 0.9
    assert replace(CASE, row_um=0.0).steps_um == (0.5, 0.5)
    assert CASE.wavenumber == pytest.approx(2 * math.pi / 0.85)
    assert CASE.half_size_um == pytest.approx((1.5 * 0.8, 3 * 0.5))
    assert CASE.half_window_um == pytest.approx((4 * 0.3, 6.5 * 0.3))
    one = replace(CASE, shape=(1, 1), samples=(1, 1))
    assert one.half_size_um == pytest.approx((0.4, 0.25))  # half a step
    assert one.half_window_um == pytest.approx((0.003, 0.003))  # a hundredth of one
    assert CASE.reach_um == pytest.approx(math.hypot(2.5 + 1.2 + 1.2, 6.0 + 1.95 + 1.5))
    rows, columns = CASE.pillars_um
    assert rows == pytest.approx([-1.2, -0.4, 0.4, 1.2])
    assert columns == pytest.approx([-1.5, -1.0, -0.5, 0, 0.5, 1.0, 1.5])
    rows, columns = CASE.window_um
    assert (len(rows), len(columns), rows[0], columns[-1]) == (
        9,
        14,
        pytest.approx(-1.2),
        pytest.approx(1.95),
    )


def samples_of(case):
    """(y,), (x,) places of the samples on the sensor."""
    y, x = case.window_um
    return case.centre_um[1] + y, case.centre_um[0] + x


@pytest.mark.parametrize(
    ("parts", "rows", "columns"),
    [(1, [9], [14]), (4, [2, 2, 2, 3], [3, 4, 3, 4]), (20, [1] * 9, [1] * 14)],
)
def test_parts_of_a_window_hold_every_sample_once_and_in_order(parts, rows, columns):
    made = geometry.split_window(CASE, parts)
    assert [row[0].samples[0] for row in made] == rows
    assert [part.samples[1] for part in made[0]] == columns
    y, x = samples_of(CASE)
    assert np.concatenate([samples_of(row[-1])[0] for row in made]) == pytest.approx(y)
    assert np.concatenate([samples_of(part)[1] for part in made[-1]]) == pytest.approx(
        x
    )
    assert {part.step_um for row in made for part in row} == {0.3}


@pytest.mark.parametrize("parts", [1, 3, 4, 20])
def test_tiles_are_of_one_size_and_reach_from_rim_to_rim(parts):
    (top, left), made = geometry.window_tiles(CASE, parts)
    sides = {part.samples for row in made for part in row}
    assert sides == {tuple(math.ceil(n / min(parts, n)) for n in (9, 14))}
    ((high, wide),) = sides
    assert (top[0], left[0], top[-1] + high, left[-1] + wide) == (0, 0, 9, 14)
    assert max(np.diff(top), default=0) <= high
    assert max(np.diff(left), default=0) <= wide
    assert (len(made), len(made[0])) == (min(parts, 9), min(parts, 14))
    y, x = samples_of(CASE)
    for first, row in zip(top, made, strict=True):
        for start, part in zip(left, row, strict=True):
            down, across = samples_of(part)
            assert down == pytest.approx(y[first : first + high])
            assert across == pytest.approx(x[start : start + wide])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"pitch_um": 0.0}, "pitch_um is 0.0"),
        ({"wavelength_um": -1.0}, "wavelength_um"),
        ({"step_um": math.inf}, "step"),
        ({"row_um": -0.1}, "row_um = -0.1"),
        ({"site_um2": math.nan}, "site_um2 = nan"),
        ({"shape": (0, 3)}, "one of each"),
        ({"samples": (3, 0)}, "one of each"),
        ({"inverse_depths_per_um": ()}, "at least one source depth"),
        ({"inverse_depths_per_um": (0.1, -0.1)}, "above 0"),
        ({"tangents": (0.0, math.nan)}, "not finite"),
        ({"centre_um": (math.inf, 0.0)}, "not finite"),
        ({"front": ((1.5, 600.0), (1.4, 401.0))}, "films of 1001 um in the 1000"),
    ],
)
def test_what_cannot_be_is_refused(change, said):
    with pytest.raises(PropagationError) as caught:
        replace(CASE, **change)
    assert said in str(caught.value)


def test_films_may_fill_the_whole_gap():
    assert len(replace(CASE, front=((1.5, 600.0), (1.4, 400.0))).front) == 2


@pytest.mark.parametrize("which", [0, 1])
def test_a_pillar_that_is_no_number_is_named_wherever_it_lies(which):
    """Rows are looked at 256 at a time."""
    case = replace(CASE, shape=(600, 3))
    for row in (0, 255, 256, 511, 599):
        maps = [np.ones(case.shape), np.ones(case.shape)]
        geometry.check_aperture(*maps, case)
        maps[which][row, 2] = math.nan
        with pytest.raises(
            PropagationError, match=f"row {row}, column 2 is not finite"
        ):
            geometry.check_aperture(*maps, case)
        with pytest.raises(PropagationError, match=r"shape \(599, 3\)"):
            geometry.check_aperture(
                *(part[1:] if n == which else part for n, part in enumerate(maps)), case
            )


def test_an_aperture_without_light_is_refused_and_one_of_a_single_pillar_is_not():
    case = replace(CASE, shape=(600, 3))
    light = np.zeros(case.shape)
    with pytest.raises(PropagationError, match="empty aperture"):
        geometry.check_aperture(np.ones(case.shape), light, case)
    for row, value in ((0, 0.5), (300, 0.5), (599, -0.5)):
        some = light.copy()
        some[row, 1] = value
        geometry.check_aperture(np.ones(case.shape), some, case)
