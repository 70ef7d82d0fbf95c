"""Placements of a hierarchy taken apart by hand: a cell turned and mirrored in another,
in a third.
"""

import numpy as np

from layout.files.content import CellContent, MaskContent, Placed


def placed(child, x, y, turn):
    whole = np.array([x, y], np.int32)
    return Placed(
        (child,),
        np.zeros(1, np.int32),
        whole[:1],
        whole[1:],
        np.array([turn], np.uint8),
    )


def test_leaves_stand_where_turns_and_steps_take_them():
    """The leaf at (10, 3) of a cell that stands a quarter turn on at (100, -20): (100 -
    3, -20 + 10); the other is
    mirrored at the x axis first."""
    for turn, want, left in ((0, (110, -17), 0), (1, (97, -10), 1), (5, (103, -10), 5)):
        cells = {
            "TOP": CellContent("TOP", placed=placed("ROW", 100, -20, turn)),
            "ROW": CellContent("ROW", placed=placed("LEAF", 10, 3, 0)),
            "LEAF": CellContent("LEAF"),
        }
        made = MaskContent("GDSII", 1.0, cells)
        (leaf,) = made.leaves("TOP")
        assert (int(leaf.x[0]), int(leaf.y[0])) == want
        this = leaf.turns[int(leaf.turn[0])]
        assert (this.angle_deg, this.mirrored) == (90.0 * (left & 3), bool(left & 4))
        assert {
            name: (x.tolist(), y.tolist()) for name, (x, y) in made.sites("TOP").items()
        } == {"LEAF": ([want[0]], [want[1]])}
        assert made.tops == ["TOP"]
