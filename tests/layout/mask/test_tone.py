"""The negative tone draws what the positive mask leaves empty: by booleans of KLayout
and by counting edges.
"""

import dataclasses

import numpy as np
import pytest

import layout
from layout.drc import check_plan
from layout.formats import flatten
from layout.mask import tone
from layout.mask.plan import FigureCell, MaskPlan, PillarLattice, pillar_classes
from layout.process.process import DesignRules, DieSettings, ExposureSettings, Process
from layout.shapes import rectilinear
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap

STEP_ONE = (
    1,
    3,
    4,
    5,
    6,
)  # layer numbers of the exposure of the pillars: pillars, marks, label, dose test, witness
FINE, COARSE = DesignRules(), DesignRules(grid_nm=5, diameter_step_nm=5)


def with_empty_rows(pitch):
    """Asymmetric: empty rows and columns, a lone pillar, an empty site among others."""
    d = np.random.default_rng(3).uniform(0.11, 0.29, (19, 23))
    d[4:7] = 0
    d[:, -3:] = 0
    d[5, 21] = 0.17
    d[12, 9] = 0
    return DiameterMap(d, pitch)


def one_pillar(pitch):
    return DiameterMap(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.233]]), pitch)


def written(source, process, folder, tone_name, **more):
    """The mask of a tone, as the file holds it."""
    plan = layout.plan(source, dataclasses.replace(process, tone=tone_name), **more)
    layout.write_gdsii(plan, folder / f"{tone_name}.gds")
    return plan, folder / f"{tone_name}.gds"


def region_of(path):
    """All shapes of the exposure of the pillars, merged, and the outline, as KLayout
    reads them.
    """
    db = pytest.importorskip("klayout.db")
    mask = db.Layout()
    mask.read(str(path))
    found = db.Region()
    area = 0
    for index in mask.layer_indexes():
        if mask.get_info(index).layer in STEP_ONE:
            raw = db.Region(mask.top_cell().begin_shapes_rec(index))
            raw.merged_semantics = False
            area += sum(p.area() for p in raw.each())
            found += raw
    outline = db.Region(
        mask.top_cell().begin_shapes_rec(mask.find_layer(10, 0))
    ).merged()
    return found.merged(), outline, area


@pytest.mark.parametrize(
    ("make", "pitch", "rules"),
    [
        (with_empty_rows, 0.4, FINE),
        (with_empty_rows, 0.405, COARSE),
        (one_pillar, 0.4, FINE),
    ],
)
def test_both_tones_together_are_the_die_and_share_nothing(
    make, pitch, rules, tmp_path
):
    process = Process(rules=rules, die=DieSettings(label="R8 O"))
    _, positive = written(make(pitch), process, tmp_path, "positive")
    plan, negative = written(make(pitch), process, tmp_path, "negative")
    stays, die, _ = region_of(positive)
    drawn, same_die, area = region_of(negative)
    assert (drawn & stays).is_empty()
    assert ((drawn + stays) ^ die).is_empty()
    assert (die ^ same_die).is_empty()
    assert area == drawn.area()  # nothing is drawn (and exposed) twice
    assert check_plan(plan, dataclasses.replace(process.rules, maximum_density=1.0)).ok
    content = layout.read_gdsii(negative)
    assert layout.compare(plan, content).ok


def inside(points, polygons):
    """(n,) polygons that cover each point: crossings of a ray to +x, counted. Shares
    nothing with any library.
    """
    count = np.zeros(len(points), int)
    for p in polygons:
        q, odd = np.roll(p, -1, axis=0), np.zeros(len(points), bool)
        for (x0, y0), (x1, y1) in zip(p.tolist(), q.tolist(), strict=True):
            if y0 != y1:
                straddles = (points[:, 1] >= min(y0, y1)) & (points[:, 1] < max(y0, y1))
                odd ^= straddles & (
                    x0 + (points[:, 1] - y0) * (x1 - x0) / (y1 - y0) > points[:, 0]
                )
        count += odd
    return count


def test_every_point_of_the_lens_is_a_pillar_or_drawn_once(tmp_path):
    source = with_empty_rows(0.4)
    _, path = written(source, Process(), tmp_path, "negative", furnished=False)
    content = layout.read_gdsii(path)
    polygons = [
        shape.outline + np.array([x, y])
        for shape in flatten.flatten_shapes(content, "METALENS")
        for x, y in zip(shape.x.tolist(), shape.y.tolist(), strict=True)
    ]
    points = np.random.default_rng(0).uniform((-4598, -3798), (4598, 3798), (4000, 2))
    columns, rows = (
        np.rint(points[:, 0] / 400 + 11).astype(int),
        np.rint(points[:, 1] / 400 + 9).astype(int),
    )
    d = source.diameter_um[rows, columns] * 1e3
    away = np.hypot(
        points[:, 0] - (columns - 11) * 400, points[:, 1] - (rows - 9) * 400
    )
    covered = inside(points, polygons)
    clear = (
        abs(away - d / 2) > 3
    )  # diameter steps of 2 nm, polygons within a grid step of their circle
    assert np.array_equal(covered[clear], (away > d / 2).astype(int)[clear])
    assert clear.mean() > 0.97


def bare(figures=(), pitch=400, diameter=200):
    made = pillar_classes(
        np.array([diameter]),
        layer=(1, 0),
        grid=1,
        unit_nm=1.0,
        vertices=16,
        shape="round",
    )
    lattice = PillarLattice.of(
        "LENS", np.ones((2, 3), np.uint8), pitch=pitch, x0=0, y0=0
    )
    outline = FigureCell(
        "OUTLINE",
        {(10, 0): (rectilinear.box_corners(np.array([-40000, -40000, 50000, 50000])),)},
    )
    return MaskPlan("TOP", made, (lattice,), figures=(*figures, outline))


@pytest.mark.parametrize(
    ("arm", "gap", "broken"),
    [(81, 71, {}), (20, 71, {"width"}), (81, 30, {"space", "notch"})],
)
def test_thin_marks_and_narrow_gaps_of_a_negative_mask_are_seen(arm, gap, broken):
    bars = [
        np.array([0, 9000, 5000, 9000 + arm]),
        np.array([0, 9000 + arm + gap, 5000, 12000]),
    ]
    marks = FigureCell("MARKS", {(3, 0): tuple(map(rectilinear.box_corners, bars))})
    negative = tone.reverse_tone(
        bare([marks]), Process(tone="negative", exposure=ExposureSettings())
    )
    found = check_plan(negative, DesignRules())
    assert {rule for rule, count in found.counts.items() if count} == set(broken)


def test_a_pillar_wider_than_its_square_is_refused():
    with pytest.raises(ProcessError, match=r"wider than the lattice square of 400"):
        tone.reverse_tone(bare(diameter=412), Process(tone="negative"))


def test_a_full_lattice_without_a_die_is_framed_by_one_pitch_and_has_nothing_to_clear():
    """Three columns and two rows of 400 with the first site at 0: squares from -200 to
    1000, and from -600 to 200.
    """
    plan = bare()
    negative = tone.reverse_tone(plan.replace(figures=()), Process(tone="negative"))
    (rim,) = negative.figures
    assert rim.name == "RIM"
    ((layer, shapes),) = rim.polygons.items()
    assert layer == Process().layers.pillar
    sides = sorted((*shape.min(0).tolist(), *shape.max(0).tolist()) for shape in shapes)
    want = [
        (-600, -1000, 1400, -600),
        (-600, -600, -200, 200),
        (-600, 200, 1400, 600),
        (1000, -600, 1400, 200),
    ]
    assert sides == sorted(want)


@pytest.mark.parametrize("way", [(-1, 0), (1, 0), (0, -1), (0, 1)])
def test_a_pillar_beyond_any_side_of_its_square_is_refused(way):
    """200 wide on 400: up to 100 to either side stays inside."""
    plan, pillar = bare(), rectilinear.box_corners(np.array([-100, -100, 100, 100]))
    for share, stands in ((100, True), (101, False)):
        moved = dataclasses.replace(
            plan.classes[0], outline=pillar + np.array(way) * share
        )
        if stands:
            tone.reverse_tone(plan.replace(classes=(moved,)), Process(tone="negative"))
        else:
            with pytest.raises(ProcessError, match="200 by 200 units"):
                tone.reverse_tone(
                    plan.replace(classes=(moved,)), Process(tone="negative")
                )
