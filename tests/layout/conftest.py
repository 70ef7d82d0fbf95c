"""Small masks that the tests of writers, readers and checks share."""

import numpy as np
import pytest

from layout.mask.plan import FigureCell, MaskPlan, PillarArray, pillar_classes


def small_plan(classes=None, *, kinds=7, pitch=400, seed=0, figures=True, first=100):
    """A random lattice of a few diameters, without any symmetry, with a figure."""
    if classes is None:
        classes = (
            np.random.default_rng(seed)
            .integers(0, kinds + 1, (23, 31))
            .astype(np.uint8)
        )
    made = pillar_classes(
        np.arange(first, first + 10 * kinds, 10),
        layer=(1, 0),
        grid=1,
        unit_nm=1.0,
        vertices=16,
    )
    corner = np.add(
        [[0, 0], [9000, 0], [9000, 500], [500, 500], [500, 9000], [0, 9000]],
        (20000, 3000),
    )
    return MaskPlan(
        name="TOP",
        classes=made,
        lattices=(PillarArray.of("LENS", classes, pitch=pitch, x0=-6000, y0=4400),),
        figures=(FigureCell("MARKS", {(3, 0): (corner,)}),) if figures else (),
        layer_names={(1, 0): "pillar", (3, 0): "marks"},
    )


@pytest.fixture
def plan():
    return small_plan()


@pytest.fixture
def make_plan():
    return small_plan
