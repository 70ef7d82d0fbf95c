"""Lashes over an opening of straight margins: where strokes may lie follows from their
draws.
"""

import numpy as np
import pytest
import torch

from codesign.eye.appearance import draw_lashes

# rows TOP ... BOTTOM, columns LEFT ... RIGHT of the opening
SIZE, TOP, BOTTOM, LEFT, RIGHT = (120, 44, 79, 25, 96)
# of a lash of the upper lid, pixels, times 0.4 to 1.2
LONG = (0.12 + 0.2 * 0.4) * (RIGHT - LEFT + 1)


def drawn(sink, rise):
    """Rows that have a stroke, and the picture."""
    opening = torch.zeros(SIZE, SIZE)
    opening[TOP : BOTTOM + 1, LEFT : RIGHT + 1] = 1
    picture = draw_lashes(
        opening, np.array([0.37, 0.4, sink, rise, 0.9, *[0.0] * 7])
    ).numpy()
    return np.flatnonzero(picture.any(1)), picture


def test_lashes_that_neither_sink_nor_rise_lie_on_the_margins():
    rows, picture = drawn(0.0, 0.0)
    # a soft stroke of one pixel
    assert set(rows) <= {TOP - 1, TOP, TOP + 1, BOTTOM - 1, BOTTOM, BOTTOM + 1}
    assert {TOP, BOTTOM} <= set(rows)
    assert 110 / 255 - 0.01 < picture.max() <= 1.0


def test_lashes_that_rise_lie_outside_and_those_of_the_lower_lid_are_half_as_long():
    rows, _ = drawn(0.0, 0.7)
    reach = 1.4 * 0.7 * LONG
    assert not set(rows) & set(range(TOP + 2, BOTTOM - 1))
    # the longest of 92: 1.0 to 1.2
    assert TOP - rows.min() == pytest.approx(1.1 * reach, abs=0.1 * reach + 1)
    assert rows.max() - BOTTOM == pytest.approx(0.55 * reach, abs=0.05 * reach + 1)


def test_lashes_that_sink_cross_the_eye():
    rows, _ = drawn(0.9, 0.0)
    reach = 0.8 * 0.9 * LONG
    assert rows.min() >= TOP - 1
    assert rows.max() <= BOTTOM + 1
    crossed = np.flatnonzero(np.diff(rows) > 1)[0]
    assert rows[crossed] - TOP == pytest.approx(1.1 * reach, abs=0.1 * reach + 1)
