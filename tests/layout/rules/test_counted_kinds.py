"""Shapes of a kind are counted once each, and added to what is there."""

import numpy as np

from layout.rules import foreign


def test_shapes_that_stand_alone_are_counted_by_kind():
    draw = np.random.default_rng(3)
    kind, alone = draw.integers(0, 5, 90), draw.uniform(size=90) > 0.4
    before = np.array([7, 0, 2, 0, 11])
    found = foreign.counted(kind, alone, before.copy())
    assert found.tolist() == (before + np.bincount(kind[alone], minlength=5)).tolist()
