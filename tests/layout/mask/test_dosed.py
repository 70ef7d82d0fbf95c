"""A mask with its doses: shapes as before, each on a datatype of its dose, and each
dose that of the solution.
"""

import dataclasses

import numpy as np
import pytest

from layout.mask import MaskPlan, dosed
from layout.mask.plan import FigureCell, PillarLattice, pillar_classes
from layout.pec.assign import dose_ladder
from layout.process import ExposureSettings, Process

RNG = np.random.default_rng(41)
PROCESS = Process(
    exposure=ExposureSettings(alpha_um=0.02, beta_um=2.1, eta=0.7, tolerance=0.02)
)
MARK = np.array(
    [
        [9000, -2000],
        [15000, -2000],
        [15000, -1000],
        [11000, -1000],
        [11000, 3000],
        [9000, 3000],
    ]
)
BESIDE = np.array(
    [[15000, -2000], [17000, -2000], [17000, 500], [15000, 500]]
)  # shares a side with it
ALONE = np.array([[-14000, 6000], [-11500, 6000], [-11500, 7000], [-14000, 7000]])
LETTER = np.array([[-2000, 8000], [-1000, 8000], [-1000, 9500], [-2000, 9500]])
DIE = np.array([[-20000, -20000], [20000, -20000], [20000, 20000], [-20000, 20000]])


def plan():
    """A lens, a dose test and a witness; marks of two polygons that touch and one
    apart, a label, and an outline.
    """
    kinds = {"D": ([120, 200, 260], (1, 0)), "T": ([200], (5, 0)), "W": ([160], (6, 0))}
    roles = {"D": "pillar", "T": "dose", "W": "witness"}
    classes = [
        dataclasses.replace(made, role=roles[letter])
        for letter, (sizes, layer) in kinds.items()
        for made in pillar_classes(
            np.array(sizes),
            layer=layer,
            grid=1,
            unit_nm=1.0,
            vertices=16,
            shape="round",
            prefix=letter,
        )
    ]
    lens = RNG.integers(0, 4, (31, 38)).astype(np.uint8)
    lens[:12, :20] = 3  # denser here
    lattices = (
        PillarLattice.of("LENS", lens, pitch=400, x0=-7400, y0=6000),
        PillarLattice.of(
            "TEST",
            RNG.choice([0, 4], (5, 3)).astype(np.uint8),
            pitch=700,
            x0=-12000,
            y0=-9000,
        ),
        PillarLattice.of(
            "WITNESS", np.full((2, 3), 5, np.uint8), pitch=900, x0=12000, y0=9000
        ),
    )
    figures = (
        FigureCell("MARKS", {(3, 0): (MARK, BESIDE, ALONE)}),
        FigureCell("LABEL", {(4, 0): (LETTER,)}),
        FigureCell("OUTLINE", {(10, 0): (DIE,)}),
    )
    names = {
        (1, 0): "pillar",
        (3, 0): "marks",
        (4, 0): "labels",
        (5, 0): "dose",
        (6, 0): "witness",
        (10, 0): "outline",
    }
    doses = {layer: 1.0 for layer in [(1, 0), (3, 0), (4, 0), (5, 0), (6, 0)]}
    return MaskPlan(
        "TOP", tuple(classes), lattices, figures, layer_names=names, doses=doses
    )


@pytest.fixture(scope="module")
def made():
    before = plan()
    wanted = dosed.solve_wanted_doses(before, PROCESS)
    steps = dose_ladder([wanted.doses.range], PROCESS.exposure)
    return (before, *dosed.apply_dose_classes(wanted, PROCESS, *steps))


def test_every_pillar_keeps_its_shape_and_gets_the_dose_that_was_found_for_it(made):
    before, after, found = made
    for number, (old, new) in enumerate(
        zip(before.lattices, after.lattices, strict=True)
    ):
        assert (new.name, new.pitch, new.x0, new.y0) == (
            old.name,
            old.pitch,
            old.x0,
            old.y0,
        )
        level = found.classes(number, 0, old.array)
        assert np.array_equal(new.whole() > 0, old.array > 0)
        for row, column in np.argwhere(old.array):
            one, same = (
                before.classes[old.array[row, column] - 1],
                after.classes[new.whole()[row, column] - 1],
            )
            assert np.array_equal(same.outline, one.outline)
            assert (same.diameter_nm, same.goal, same.name[0]) == (
                one.diameter_nm,
                one.goal,
                one.name[0],
            )
            assert same.dose == found.ladder.factors[level[row, column]]
            assert same.layer[0] == one.layer[0]
    assert len({made.name for made in after.classes}) == len(after.classes)


def test_a_datatype_stands_for_one_dose_of_one_kind_and_they_rise_together(made):
    _, after, _ = made
    for number, title in ((1, "pillar"), (5, "dose_test"), (6, "witness")):
        held = {
            made.layer[1]: made.dose
            for made in after.classes
            if made.layer[0] == number
        }
        assert all(
            held[made.layer[1]] == made.dose
            for made in after.classes
            if made.layer[0] == number
        )
        levels = [held[n] for n in range(len(held))]  # 0, 1, 2, ...
        assert levels == sorted(set(levels))
        for n, level in enumerate(levels):
            assert after.doses[number, n] == level
            assert after.layer_names[number, n] == f"{title}_dose_{level:.4f}"
    assert len({made.dose for made in after.classes if made.layer[0] == 1}) > 3


def area(corners):
    x, y = corners.T
    return abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())) / 2


def test_pieces_of_marks_and_labels_fill_them_once_on_the_datatypes_of_their_doses(
    made,
):
    before, after, found = made
    assert after.figures[2] is before.figures[2]
    assert after.layer_names[10, 0] == "outline"
    assert (10, 0) not in after.doses
    drawn = {}
    for old, new in zip(before.figures[:2], after.figures[:2], strict=True):
        ((number, _), shapes), *_ = old.polygons.items()
        pieces = [
            piece
            for layer, some in new.polygons.items()
            for piece in some
            if layer[0] == number
        ]
        assert len(pieces) == sum(len(some) for some in new.polygons.values())
        assert sum(area(piece) for piece in pieces) == sum(
            area(shape) for shape in shapes
        )
        boxes = np.array([[*piece.min(0), *piece.max(0)] for piece in pieces])
        assert [area(piece) for piece in pieces] == (
            (boxes[:, 2:] - boxes[:, :2]).prod(1)
        ).tolist()
        shared = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:]) - np.maximum(
            boxes[:, None, :2], boxes[None, :, :2]
        )
        assert ((shared > 0).all(-1).sum(1) == 1).all()  # each meets itself alone
        drawn |= {
            layer: np.array([p.mean(0) for p in some])
            for layer, some in new.polygons.items()
        }
    assert set(after.doses) == set(drawn) | {made.layer for made in after.classes}
    middles, unit = found.rects.box_um[:, :2] / 2 + found.rects.box_um[:, 2:] / 2, 1e-3
    for layer, places in drawn.items():  # of each the dose that was found where it lies
        for place in places:
            nearest = np.hypot(*(middles - place * unit).T).argmin()
            assert found.ladder.factors[found.rect_class[nearest]] == after.doses[layer]
    for number, title in ((3, "marks"), (4, "labels")):
        levels = [
            after.doses[number, n]
            for n in range(sum(layer[0] == number for layer in drawn))
        ]
        assert levels == sorted(set(levels))
        for n, level in enumerate(levels):
            assert after.layer_names[number, n] == f"{title}_dose_{level:.4f}"


def test_shapes_that_touch_are_one(made):
    """Sides inside a shape need no dose of an edge: both polygons of the mark are one,
    the third is another.
    """
    _, _, found = made
    boxes, group = found.rects.box_um, found.rects.group
    right, alone = boxes[:, 0] >= 9.0, (boxes[:, 0] < -11) & (boxes[:, 1] > 5)
    assert len(set(group[right].tolist())) == 1
    assert len(set(group[alone].tolist())) == 1
    assert len(set(group.tolist())) == 3


def test_what_is_exposed_is_told_in_micrometres_whatever_the_unit_of_the_mask():
    """Units of half a nanometre: discs by their diameters, any other shape by its
    corners, sites by their pitches.
    """
    size = np.array([240, 400, 520])
    about = {
        "layer": (1, 0),
        "grid": 1,
        "unit_nm": 0.5,
        "vertices": 16,
        "shape": "round",
        "prefix": "D",
    }
    classes = tuple(pillar_classes(size, **about))
    lattice = PillarLattice(
        "LENS",
        7,
        5,
        840,
        -1500,
        2300,
        lambda first, end: np.ones((end - first, 5), np.uint8),
        None,
        727,
    )
    made = MaskPlan("TOP", classes, (lattice,), (), layer_names={}, doses={(1, 0): 1.0})
    discs = dosed._drawn(made, 5e-4)
    assert discs.diameter_um == pytest.approx([0.0, 0.12, 0.2, 0.26], rel=1e-12)
    mixed = dataclasses.replace(classes[1], round=False)
    shapes = dosed._drawn(made.replace(classes=(classes[0], mixed, classes[2])), 5e-4)
    assert shapes.area_um2 == pytest.approx(
        [0.0, *(area(one.outline) * 2.5e-7 for one in classes)], rel=1e-12
    )
    body = dosed._body(lattice, 5e-4)
    assert (body.rows, body.columns, body.centred) == (7, 5, False)
    assert (body.pitch_um, body.x_um, body.y_um) == pytest.approx(
        (0.42, -0.75, 1.15), rel=1e-12
    )
    assert body.columns_um == pytest.approx(-0.75 + 0.42 * np.arange(5), rel=1e-12)
    assert body.rows_um(2, 4) == pytest.approx(
        1.15 - 0.3635 * np.arange(2, 6), rel=1e-12
    )
