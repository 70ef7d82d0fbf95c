"""Trapezoids of OASIS by what defines them: how far each slanted side leans, their box,
and their area.
"""

import numpy as np
import pytest

from layout.oasis import trapezoids

W, H = 370, 110


def area(corners):
    x, y = corners.T
    return abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())) / 2


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize(
    ("a", "b"), [(40, 25), (40, -25), (-40, 25), (-40, -25), (0, 30), (-60, 0)]
)
def test_the_sides_lean_by_what_is_said_within_their_box(a, b, upright):
    """Lying: from foot to head the left side goes right by a, the right one by b.
    Upright: the lower side from its
    right end to its left one goes up by a, the upper one by b."""
    made = trapezoids.sloped(W, H, a, b, upright=upright)
    assert made.min(0).tolist() == [0, 0]
    assert made.max(0).tolist() == [W, H]
    if upright:
        (left_low, left_high), (right_high, right_low) = made[:2], made[2:]
        assert left_low[0] == left_high[0] == 0
        assert right_low[0] == right_high[0] == W
        assert (left_low[1] - right_low[1], left_high[1] - right_high[1]) == (a, b)
        assert (
            area(made)
            == W * (left_high[1] - left_low[1] + right_high[1] - right_low[1]) / 2
        )
    else:
        (head_left, head_right), (foot_right, foot_left) = made[:2], made[2:]
        assert head_left[1] == head_right[1] == H
        assert foot_left[1] == foot_right[1] == 0
        assert (head_left[0] - foot_left[0], head_right[0] - foot_right[0]) == (a, b)
        assert (
            area(made)
            == H * (head_right[0] - head_left[0] + foot_right[0] - foot_left[0]) / 2
        )


CUT = [W * H - H * H / 2] * 4 + [
    W * H - H * H
] * 4  # lying, then upright with width and height in turn
AREAS = [*CUT, *CUT] + [W * W / 2] * 4 + [H * H] * 2 + [W * W] * 2 + [W * H, W * W]
BOXES = (
    [(W, H)] * 16
    + [(W, W)] * 4
    + [(2 * H, H)] * 2
    + [(W, 2 * W)] * 2
    + [(W, H), (W, W)]
)


def test_compact_ones_have_their_box_and_area_and_edges_of_45_degrees():
    """Kinds 0 to 7 are wider than high, 8 to 15 higher than wide: one corner or two cut
    off; 16 to 19 half squares, 20
    to 23 their doubles, then a rectangle and a square. No two are alike."""
    assert trapezoids.KINDS == 26
    seen = set()
    for kind in range(26):
        w, h = (H, W) if 8 <= kind < 16 else (W, H)
        made = trapezoids.compact(kind, w, h)
        assert area(made) == AREAS[kind]
        box = BOXES[kind] if not 8 <= kind < 16 else (H, W)
        assert (*made.min(0).tolist(), *made.max(0).tolist()) == (0, 0, *box)
        edge = np.abs(np.roll(made, -1, axis=0) - made)
        assert ((edge.min(1) == 0) | (edge[:, 0] == edge[:, 1])).all()
        wide, high = trapezoids.needs(kind)
        assert wide or (kind in (20, 21))
        assert high is (kind < 16 or kind in (20, 21, 24))
        seen.add((wide, high, tuple(sorted(map(tuple, made.tolist())))))
    assert len(seen) == 26
