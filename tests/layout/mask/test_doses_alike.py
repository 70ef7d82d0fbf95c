"""Doses of a lens that is alike in its eighths: alike where only rounding parts them,
and else as the die asks.
"""

import numpy as np
import pytest

from layout.mask import MaskPlan, dosed, symmetry
from layout.mask.plan import Figure, Lattice, pillar_classes
from layout.process import Exposure, Process

COUNT, PITCH, BETA_UM = 400, 400, 3.2
PROCESS = Process(
    exposure=Exposure(alpha_um=0.02, beta_um=BETA_UM, eta=0.7, tolerance=0.02)
)
HALF = (COUNT - 1) * PITCH // 2


def plan(away_um):
    """A lens of 60 sizes, the same from all sides, and a pad on its right, so far from
    the last pillars.
    """
    across = np.abs(2 * np.arange(COUNT) - (COUNT - 1))
    kinds = np.random.default_rng(5).integers(0, 61, (COUNT + 1, COUNT + 1))
    lens = np.maximum(kinds, kinds.T)[across[:, None], across].astype(np.uint8)
    sizes = pillar_classes(
        np.arange(140, 260, 2),
        layer=(1, 0),
        grid=1,
        unit_nm=1.0,
        vertices=16,
        shape="round",
    )
    left = HALF + round(1e3 * away_um)
    pad = np.array(
        [[left, -40000], [left + 6000, -40000], [left + 6000, 30000], [left, 30000]]
    )
    return MaskPlan(
        "TOP",
        sizes,
        (Lattice.of("LENS", lens, pitch=PITCH, x0=-HALF, y0=HALF),),
        (Figure("MARKS", {(3, 0): (pad,)}),),
        layer_names={(1, 0): "pillar", (3, 0): "marks"},
        doses={(1, 0): 1.0, (3, 0): 1.0},
    )


def levels(made, found):
    """(y, x) dose class of each pillar, as drawn; -1 where there is none."""
    number = {float(factor): n for n, factor in enumerate(found.ladder.factors)}
    table = np.array([-1, *(number[one.dose] for one in made.classes)])
    return table[made.lattices[0].whole()]


def nearest(before, found):
    """(y, x) class of the dose that each pillar asks for, rounded by itself; -1 where
    there is none.
    """
    lens = before.lattices[0].whole()
    return np.where(lens > 0, found.classes(0, 0, lens).astype(int), -1)


def test_rounding_does_not_keep_a_lens_from_being_alike_in_its_eighths():
    """A pad 8.5 um away gives 0.41 erfc(8.5 / 3.2) / 2 = 4e-5 where 0.4 is wanted: 5e-3
    of a step of 1.7 %.

    That puts some of 160,000 pillars on the other side of the middle of a step than
    their images.
    """
    before = plan(8.5)
    made, found = dosed.corrected(before, PROCESS)
    own, drawn = nearest(before, found), levels(made, found)
    images = [np.rot90(one, quarter) for one in (own, own.T) for quarter in range(4)]
    lowest = np.min(images, axis=0)
    assert 0 < (own != lowest).sum() < 100
    assert symmetry.is_square_symmetric(made.lattices[0])
    assert np.array_equal(drawn, lowest)
    assert (own - lowest).max() == 1  # the lower of two neighbouring steps


@pytest.mark.parametrize("away_um", [2.0, 6.8])
def test_a_lens_beside_a_pad_keeps_its_own_doses(away_um):
    """At 6.8 um 0.41 erfc(6.8 / 3.2) / 2 = 5e-4 of 0.4 is 8e-2 of a step: eight times
    what passes for rounding.
    """
    before = plan(away_um)
    made, found = dosed.corrected(before, PROCESS)
    own = nearest(before, found)
    assert np.array_equal(levels(made, found), own)
    rim = (
        own[:, -3:] - own[:, 2::-1]
    )  # nearer to the pad than the other side: less dose, never more
    assert rim.max() == 0
    assert rim.min() < 0


def test_the_least_of_all_images_is_that_of_turns_and_mirrors():
    values = np.random.default_rng(8).integers(0, 200, (7, 7))
    images = [
        np.rot90(one, quarter) for one in (values, values.T) for quarter in range(4)
    ]
    assert np.array_equal(symmetry.least(values), np.min(images, axis=0))
