"""Dies beside the notch of a wafer, by points on the notch's own outline (SEMI M1)."""

import math

import numpy as np
import pytest

from layout.arrange import wafer
from layout.arrange.record import WaferSettings


def notch_outline(radius, depth, bottom=0.9):
    """Points on the outline of a notch of 90 degrees, in mm: its bottom of radius 0.9
    mm, and its two walls down to the edge of the wafer and beyond.
    """
    middle = -radius + depth - bottom
    angle = np.linspace(math.pi / 4, 3 * math.pi / 4, 2001)
    round_part = np.column_stack(
        [bottom * np.cos(angle), middle + bottom * np.sin(angle)]
    )
    start = bottom / math.sqrt(2)
    down = np.linspace(0, 4, 4001)
    right = np.column_stack([start + down, middle + start - down])
    return np.concatenate([round_part, right, right * (-1, 1)])


@pytest.mark.parametrize("exclusion", [0.0, 0.35])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (130.0, 71.0)])
def test_no_die_lies_on_the_notch_or_nearer_to_it_than_the_exclusion(exclusion, offset):
    size = WaferSettings(
        pitch_um=(310, 290),
        diameter_mm=50,
        notch_mm=1.0,
        edge_exclusion_mm=exclusion,
        offset_um=offset,
    )
    box = (-150.0, -140.0, 150.0, 140.0)
    found = {tuple(i) for i in wafer.usable_dies(size, box).index.tolist()}
    whole = WaferSettings(
        pitch_um=(310, 290),
        diameter_mm=50,
        edge_exclusion_mm=exclusion,
        offset_um=offset,
    )
    every = wafer.usable_dies(whole, box)
    outline = notch_outline(25.0, 1.0) * 1e3
    upper_edge = outline[np.argsort(outline[:, 0])].T
    below = every.place_um[:, 1] < -20e3  # all others are 4 mm and more from the notch
    kept = {tuple(index) for index in every.index[~below].tolist()}
    near = every.index[below].tolist(), every.place_um[below].tolist()
    for index, place in zip(*near, strict=True):
        low = np.add(place, box[:2])
        high = np.add(place, box[2:])
        away = np.hypot(*np.maximum(np.maximum(low - outline, outline - high), 0).T)
        roof = np.interp(place[0], *upper_edge)
        # points on the outline are 1 um apart: 0.05 um on a distance of 10 um or more
        if away.min() > 1e3 * exclusion and place[1] > roof:
            kept.add(tuple(index))
    assert len(every.index) > len(kept) > 0.9 * len(every.index)
    assert found == kept
