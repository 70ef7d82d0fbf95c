"""Rules on masks made elsewhere: no disagreement with KLayout on what both can express."""

import json
import math

import numpy as np
import pytest

import layout
from layout.drc.lattice import check_plan
from layout.drc.library import check_library
from layout.formats.library import MaskCell, MaskLibrary
from layout.formats.reading import read_mask
from layout.process import process as processes
from layout.process.process import DesignRules
from metalens.lens import DiameterMap
from tests.command_line import call, printed

db = pytest.importorskip("klayout.db")


def turned_pillars(path, count=900, seed=3):
    """Rectangles and hexagons at jittered places and any angle, some too near, some too
    thin; no two overlap.
    """
    rng = np.random.default_rng(seed)
    made = db.Layout()
    top, layer = made.create_cell("TOP"), made.layer(1, 0)
    boxes = []
    for n in range(count):
        x, y = np.array(divmod(n, 30)) * 372 + rng.uniform(-35, 35, 2)
        wide, long = rng.uniform(75, 190), rng.uniform(180, 300)
        if n % 3:
            corners = (
                np.array([[-long, -wide], [long, -wide], [long, wide], [-long, wide]])
                / 2
            )
        else:
            angle = np.arange(6) * np.pi / 3
            corners = wide / 1.5 * np.column_stack([np.cos(angle), np.sin(angle)])
        turn = rng.uniform(0, np.pi)
        c, s = np.cos(turn), np.sin(turn)
        points = np.rint(corners @ [[c, s], [-s, c]] + (x, y)).astype(int)
        shape = db.Polygon([db.Point(*map(int, p)) for p in points])
        top.shapes(layer).insert(shape)
        boxes.append(shape)
    made.write(str(path))
    return made, boxes


def pairs_of_klayout(shapes, gap):
    """Pairs of shapes that KLayout finds nearer than ``gap``, as boxes around both."""
    found = set()
    regions = [db.Region(s) for s in shapes]
    for i, a in enumerate(shapes):
        for j in range(i + 1, len(shapes)):
            b = shapes[j]
            if (
                a.bbox().enlarged(gap, gap).touches(b.bbox())
                and regions[i]
                .separation_check(regions[j], gap, False, db.Region.Euclidian)
                .count()
            ):
                both = a.bbox() + b.bbox()
                found.add((both.left, both.bottom, both.right, both.top))
    return found


@pytest.mark.parametrize("suffix", ["gds", "oas"])
def test_turned_convex_pillars_anywhere_agree_with_klayout(tmp_path, suffix):
    path = tmp_path / f"m.{suffix}"
    _, shapes = turned_pillars(path)
    touching = sum(
        1
        for i, a in enumerate(shapes)
        for b in shapes[i + 1 : i + 40]
        if a.bbox().touches(b.bbox()) and a.touches(b)
    )
    rules = DesignRules(minimum_gap_nm=70, minimum_feature_nm=1)
    report = check_library(read_mask(path), rules, metric="euclidean")
    assert report.shapes == len(shapes)
    own = {v.box for v in report.violations if v.rule == "space"}
    theirs = pairs_of_klayout(shapes, 70)
    assert touching == 0 or own <= theirs
    assert own == theirs or touching
    assert len(own) > 10


def marks(path, arm=20, notch=45):
    """A cross with one thin arm, a U with a narrow notch, and two abutting pieces of
    one bar.
    """
    made = db.Layout()
    top, layer = made.create_cell("TOP"), made.layer(3, 0)
    cross = [
        (0, 0),
        (0, -3000),
        (arm, -3000),
        (arm, 0),
        (3000, 0),
        (3000, 500),
        (500, 500),
        (500, 3000),
        (0, 3000),
    ]
    u = [
        (8000, 0),
        (9000, 0),
        (9000, 900),
        (8500 + notch, 900),
        (8500 + notch, 200),
        (8500, 200),
        (8500, 900),
        (8000, 900),
    ]
    for points in (cross, u):
        top.shapes(layer).insert(db.Polygon([db.Point(*p) for p in points]))
    top.shapes(layer).insert(db.Box(12000, 0, 12030, 400))
    top.shapes(layer).insert(db.Box(12030, 0, 12400, 400))
    made.write(str(path))
    return db.Region(top.begin_shapes_rec(layer)).merged()


def test_thin_arms_and_notches_are_found_and_abutting_pieces_are_one(tmp_path, capsys):
    path = tmp_path / "m.gds"
    region = marks(path)
    process = tmp_path / "p.toml"
    process.write_text("[rules]\nminimum_feature_nm = 80\nminimum_gap_nm = 70\n")
    assert (
        call(f"check {path} --process {process} --json --output {tmp_path}/m.lyrdb")
        == 1
    )
    values = printed(capsys)
    found = values["violations"]
    assert (
        found["width"]
        == region.width_check(80, False, db.Region.Euclidian).count()
        == 1
    )
    assert (
        found["notch"]
        == region.notch_check(70, False, db.Region.Euclidian).count()
        == 1
    )
    assert values["minimum_width_nm"] == 20
    assert values["minimum_space_nm"] == 45
    assert values["failures"] == ["design rules violated: 1 width, 1 notch"]
    rdb = pytest.importorskip("klayout.rdb")
    database = rdb.ReportDatabase()
    database.load(str(tmp_path / "m.lyrdb"))
    assert database.num_items() == 2


def test_sound_marks_pass_and_a_missing_file_is_refused(tmp_path, capsys):
    marks(tmp_path / "m.oas", arm=90, notch=80)
    assert call(f"check {tmp_path}/m.oas") == 0
    assert "keeps the design rules" in capsys.readouterr().out
    assert call(f"check {tmp_path}/none.oas") == 2
    assert "no such file" in capsys.readouterr().err


def test_a_shape_that_stands_alone_has_no_gap_and_says_so(tmp_path, capsys):
    made = db.Layout()
    made.create_cell("TOP").shapes(made.layer(1, 0)).insert(db.Box(0, 0, 310, 170))
    made.write(str(tmp_path / "one.gds"))
    assert call(f"check {tmp_path}/one.gds") == 0
    told = capsys.readouterr().out
    assert "no space below 70 nm, minimum width 170.0 nm" in told
    assert call(f"check {tmp_path}/one.gds --json") == 0
    # no Infinity, which JSON does not know
    values = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert (values["minimum_space_nm"], values["minimum_width_nm"]) == (None, 170.0)


def test_pillars_within_the_hull_of_a_mark_keep_their_own_width(tmp_path):
    """A round pillar is as wide as its diameter wherever it stands; KLayout's
    projection says the same.
    """
    made = db.Layout()
    top = made.create_cell("TOP")
    pillar = made.create_cell("P")
    layer = made.layer(1, 0)
    angle = 2 * np.pi * (np.arange(32) + 0.5) / 32
    corners = np.rint(51 * np.column_stack([np.cos(angle), np.sin(angle)])).astype(int)
    pillar.shapes(layer).insert(db.Polygon([db.Point(*map(int, p)) for p in corners]))
    top.insert(
        db.CellInstArray(
            pillar.cell_index(),
            db.Trans(0, 0),
            db.Vector(400, 0),
            db.Vector(0, 390),
            5,
            4,
        )
    )
    angled = [
        (-900, -900),
        (3000, -900),
        (3000, -100),
        (-100, -100),
        (-100, 2500),
        (-900, 2500),
    ]
    top.shapes(layer).insert(db.Polygon([db.Point(*p) for p in angled]))
    path = tmp_path / "m.gds"
    made.write(str(path))
    region = db.Region(top.begin_shapes_rec(layer))
    report = check_library(
        read_mask(path), DesignRules(minimum_gap_nm=45, minimum_feature_nm=95)
    )
    assert report.ok
    assert region.width_check(95, False, db.Region.Projection).is_empty()
    thin = check_library(
        read_mask(path), DesignRules(minimum_gap_nm=50, minimum_feature_nm=102)
    )
    assert thin.counts["width"] == 20
    # of the first row and column to the bar: 100 less 51
    assert thin.minimum_space_nm == 49
    assert not region.space_check(50, False, db.Region.Euclidian).is_empty()
    assert region.space_check(49, False, db.Region.Euclidian).is_empty()


def test_a_round_hole_is_a_gap_as_wide_as_itself(tmp_path):
    """Not as its chords: KLayout's projection of edges that face each other says the
    same.
    """
    made = db.Layout()
    top, layer = made.create_cell("TOP"), made.layer(1, 0)
    angle = 2 * np.pi * (np.arange(32) + 0.5) / 32
    plate = db.Region(db.Box(0, 0, 2300, 1900))
    for x, y, radius in ((500, 600, 41), (1400, 700, 47), (900, 1300, 60)):
        corners = np.rint(
            radius * np.column_stack([np.cos(angle), np.sin(angle)])
        ).astype(int) + np.array([x, y])
        plate -= db.Region(db.Polygon([db.Point(int(p), int(q)) for p, q in corners]))
    top.shapes(layer).insert(plate)
    path = tmp_path / "m.gds"
    made.write(str(path))
    report = check_library(
        read_mask(path), DesignRules(minimum_gap_nm=90, minimum_feature_nm=90)
    )
    assert report.counts["notch"] == 1
    assert report.counts["width"] == 0
    assert plate.notch_check(
        int(report.minimum_space_nm), False, db.Region.Projection, 2.0
    ).is_empty()
    assert not plate.notch_check(
        int(report.minimum_space_nm) + 2, False, db.Region.Projection, 2.0
    ).is_empty()
    assert report.violations[0].box == (459, 559, 541, 641)


def test_a_negative_mask_is_held_to_the_rules_of_what_stays_as_its_plan_is(
    tmp_path, capsys
):
    """Pillars too thin are clear areas too small: as many as the plan has; walls
    between pillars are wide enough.
    """
    rng = np.random.default_rng(11)
    size = rng.uniform(0.095, 0.25, (13, 17))
    size[3:5, 4:9] = 0.0
    process = tmp_path / "p.toml"
    process.write_text(
        'tone = "negative"\n[rules]\nminimum_feature_nm = 120\nminimum_gap_nm = 20\n'
    )
    rules = processes.load_process(process)
    plan = layout.plan(DiameterMap(size, 0.3), rules, furnished=False)
    layout.write_oasis(plan, tmp_path / "m.oas")
    planned = check_plan(plan, rules.rules)
    assert call(f"check {tmp_path}/m.oas --process {process} --json") == 1
    found = printed(capsys)
    assert found["violations"]["width"] == planned.counts["width"] > 20
    assert found["violations"]["space"] == planned.counts["space"] == 0
    assert found["minimum_width_nm"] == pytest.approx(planned.minimum_width_nm)


def test_small_circles_and_turned_pillars_are_as_wide_as_they_are(tmp_path):
    """Their rounded corners leave dents of parts of a unit; chords of them are no
    widths.
    """
    made = db.Layout()
    top, layer = made.create_cell("TOP"), made.layer(1, 0)
    for n, turn in enumerate((0.0, 0.31, 0.77)):
        angle = 2 * np.pi * np.arange(64) / 64 + turn
        corners = np.rint(61 * np.column_stack([np.cos(angle), np.sin(angle)])).astype(
            int
        ) + np.array([400 * n, 0])
        top.shapes(layer).insert(
            db.Polygon([db.Point(int(p), int(q)) for p, q in corners])
        )
    path = tmp_path / "m.gds"
    made.write(str(path))
    report = check_library(
        read_mask(path), DesignRules(minimum_gap_nm=70, minimum_feature_nm=119)
    )
    assert report.ok
    assert 119 < report.minimum_width_nm < 123
    assert (
        check_library(
            read_mask(path), DesignRules(minimum_gap_nm=70, minimum_feature_nm=124)
        ).counts["width"]
        == 3
    )


@pytest.mark.parametrize(
    "flat",
    [
        [[0, 0], [100, 0], [300, 0]],
        [[5, 5], [5, 5], [5, 5]],
        [[0, 0], [500, 0], [500, 0], [0, 0]],
        [[10, 10], [200, 200], [300, 300]],
        [[500, 100], [900, 100], [700, 100]],
        [[0, 0], [100, 0], [100, 90], [100, 0], [180, 70], [100, 0]],
    ],
)
def test_a_polygon_without_area_draws_nothing(flat):
    """Alone, and on or beside a box that keeps the rules: what the box alone gives, 500
    by 400 nm.
    """
    box = np.array([[0, 0], [500, 0], [500, 400], [0, 400]])
    for drawn in ([box], []):
        cell = MaskCell("T", {(1, 0): [*drawn, np.array(flat)]})
        report = check_library(MaskLibrary("", {"T": cell}), DesignRules())
        assert report.ok == bool(drawn)  # nothing checked is not passed
        assert report.minimum_width_nm == (400 if drawn else math.inf)
