"""Step and repeat: dies counted again by points along the edge of the wafer, arrays
that hold each die once.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from layout.arrange.record import WaferMark, WaferSettings
from layout.arrange.wafer import refuse_marks_off, step_and_repeat, usable_dies
from metalens.core.errors import ProcessError


def edge(wafer, count=4000):
    """(n, 2) points along the edge of a wafer, um: circle, chord of the flat, and the
    notch down to its tip.
    """
    radius = 500 * wafer.diameter_mm
    angle = 2 * math.pi * np.arange(count) / count
    points = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    if wafer.flat_mm:
        half = 500 * wafer.flat_mm
        low = -math.sqrt(radius**2 - half**2)
        points = points[points[:, 1] >= low]
        points = np.concatenate(
            [
                points,
                np.column_stack([np.linspace(-half, half, 801), np.full(801, low)]),
            ]
        )
    if wafer.notch_mm:
        points = np.concatenate([points, [[0.0, -radius + 1000 * wafer.notch_mm]]])
    return points


def counted(wafer, box, reach=40):
    """Dies whose every corner lies on the wafer and that are as far from all points of
    its edge as they must.
    """
    points, found = edge(wafer), set()
    radius = 500 * wafer.diameter_mm
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            x = i * wafer.pitch_um[0] + wafer.offset_um[0]
            y = j * wafer.pitch_um[1] + wafer.offset_um[1]
            left = x + box[0]
            bottom = y + box[1]
            right = x + box[2]
            top = y + box[3]
            if (
                max(math.hypot(u, v) for u in (left, right) for v in (bottom, top))
                > radius
            ):
                continue
            if bottom < points[:, 1].min():
                continue
            dx = np.maximum(np.maximum(left - points[:, 0], points[:, 0] - right), 0)
            dy = np.maximum(np.maximum(bottom - points[:, 1], points[:, 1] - top), 0)
            if np.hypot(dx, dy).min() >= 1000 * wafer.edge_exclusion_mm - 0.05:
                found.add((i, j))
    return found


BOX = (-2100.0, -1300.0, 1900.0, 1700.0)  # not about its middle


@pytest.mark.parametrize(
    "wafer",
    [
        WaferSettings(
            (4600.0, 3350.0),
            diameter_mm=50.8,
            edge_exclusion_mm=2.0,
            flat_mm=15.88,
            offset_um=(710.0, 1850.0),  # a die lies between flat and circle
        ),
        WaferSettings(
            (4310.0, 3470.0),
            diameter_mm=76.2,
            edge_exclusion_mm=4.3,
            notch_mm=1.1,
            offset_um=(350.0, 900.0),
        ),
        WaferSettings((4000.0, 3000.0), diameter_mm=40.0, edge_exclusion_mm=0.0),
    ],
)
def test_dies_are_those_that_keep_away_from_every_point_of_the_edge(wafer):
    # points lie 40 um apart at most: the distance of a die is found to 40^2 / 8 / 2000
    # um, 0.1 um
    assert {tuple(pair) for pair in usable_dies(wafer, BOX).index.tolist()} == counted(
        wafer, BOX
    )


def test_dies_that_touch_a_mark_are_left_out():
    box = (-2000.0, -1500.0, 2000.0, 1500.0)
    free = WaferSettings((4000.0, 3000.0), diameter_mm=40.0)
    taken = WaferSettings(
        (4000.0, 3000.0),
        diameter_mm=40.0,
        mark_um=400.0,
        marks=(WaferMark(8.1, 3.0), WaferMark(-6.0, 0.2)),
    )
    gone = {tuple(p) for p in usable_dies(free, box).index.tolist()} - {
        tuple(p) for p in usable_dies(taken, box, around_marks_um=30.0).index.tolist()
    }
    # 8.1 mm lies in column 2 (6 to 10 mm), 3 mm in row 1 (1.5 to 4.5); -6 mm on the
    # border of columns -2 and -1
    assert gone == {(2, 1), (-2, 0), (-1, 0)}
    with pytest.raises(
        ProcessError, match=r"mark at \(19\.5, 0\) mm is off the usable wafer"
    ):
        refuse_marks_off(
            WaferSettings(
                (4000.0, 3000.0), diameter_mm=40.0, marks=(WaferMark(19.5, 0.0),)
            )
        )


@given(
    diameter=st.floats(20, 60),
    pitch=st.tuples(st.integers(2100, 9000), st.integers(1300, 7000)),
    offset=st.tuples(st.integers(-900, 900), st.integers(-900, 900)),
)
def test_arrays_hold_every_die_once_at_its_place(diameter, pitch, offset):
    wafer = WaferSettings(
        tuple(map(float, pitch)),
        diameter_mm=diameter,
        edge_exclusion_mm=1.0,
        offset_um=tuple(map(float, offset)),
    )
    found = usable_dies(wafer, (-1000.0, -600.0, 1000.0, 600.0))
    copies = step_and_repeat("DIE", found, units_per_um=1000.0)
    there = [
        tuple(p)
        for one in copies
        for p in zip(*(v.tolist() for v in one.places()), strict=True)
    ]
    assert sorted(there) == sorted(
        (round(1000 * x), round(1000 * y)) for x, y in found.place_um.tolist()
    )
    assert len(copies) <= 2 * len(set(found.index[:, 1].tolist()))


def test_what_does_not_fit_is_refused_by_key():
    with pytest.raises(
        ProcessError,
        match=r"wafer\.pitch_um is 3000 along y, but a die is 3000\.500 um long",
    ):
        usable_dies(WaferSettings((5000.0, 3000.0)), (-1.0, -1500.25, 1.0, 1500.25))
    with pytest.raises(ProcessError, match=r"no die of 70000 x 70000 um fits"):
        usable_dies(
            WaferSettings((70000.0, 70000.0), diameter_mm=98.0),
            (-35000.0, -35000.0, 35000.0, 35000.0),
        )
    with pytest.raises(ProcessError, match="whole nanometres"):
        WaferSettings((5000.0005, 3000.0))
    with pytest.raises(ProcessError, match=r"flat_mm = 10\.0 and notch_mm = 1\.0"):
        WaferSettings((5000.0, 3000.0), flat_mm=10.0, notch_mm=1.0)
