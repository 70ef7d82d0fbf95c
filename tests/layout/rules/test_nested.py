"""Cells that are checked once for all their copies: what is found is what is found with
everything taken apart.
"""

import dataclasses
import json
import tracemalloc

import numpy as np
import pytest

from layout.commands.check import read
from layout.files import (
    NOTHING,
    QUARTERS,
    Assembly,
    CellContent,
    Copies,
    MaskContent,
    Placed,
    Turn,
)
from layout.gdsii import assemble as gdsii_assemble
from layout.oasis import assemble as oasis_assemble
from layout.process import Rules
from layout.rules import copies, foreign
from layout.rules import nested as rules_nested
from metalens import cli
from metalens.ground.errors import MaskFileError

NEVER = 1 << 60
BOX = np.array([[0, 0], [200, 0], [200, 170], [0, 170]])


def taken_apart(made):
    """An assembly as a reader gives it: arrays as lists of placements."""
    cells = {}
    for name, cell in made.cells.items():
        held = made.copies.get(name, ())
        children, turns = (
            tuple(dict.fromkeys(c.child for c in held)),
            tuple(dict.fromkeys([*QUARTERS, *(c.turn for c in held)])),
        )
        rows = [
            (children.index(c.child), x, y, turns.index(c.turn))
            for c in held
            for x, y in zip(*(a.tolist() for a in c.places()), strict=True)
        ]
        placed = (
            Placed(children, *np.array(rows, np.int32).T, turns) if rows else NOTHING
        )
        cells[name] = dataclasses.replace(cell, placed=placed)
    return MaskContent("GDSII", 1.0, cells)


def outline(rng):
    angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(5, 10))))
    reach = rng.uniform(40, 120)
    return np.rint(
        np.column_stack([reach * np.cos(angle), reach * np.sin(angle)])
    ).astype(np.int64)


def ell(rng, size):
    (w, h), at = rng.integers(100, 3 * size, 2), rng.integers(-2 * size, 3 * size, 2)
    return (
        np.array([[0, 0], [w, 0], [w, 80], [90, 80], [90, h + 100], [0, h + 100]]) + at
    )


def some_copies(rng, child, size):
    turn = (
        QUARTERS[int(rng.integers(8))]
        if rng.random() < 0.85
        else Turn(17.0, bool(rng.integers(2)), 0.5)
    )
    step = (size * rng.uniform(0.9, 1.6, 2)).astype(int).tolist()
    lean = rng.integers(-20, 20, 2).tolist()
    columns, rows = rng.integers(1, 4, 2).tolist()
    at = rng.integers(-4 * size, 4 * size, 2).tolist()
    return Copies(
        child, *at, turn, columns, rows, (step[0], lean[0]), (lean[1], step[1])
    )


def nested(rng):
    """Three storeys of cells that place those below them, near each other, on each
    other, turned, within an L.
    """
    cells = {
        f"P{k}": CellContent(f"P{k}", {(1 + k % 2, k): [outline(rng)]})
        for k in range(3)
    }
    placed, names, size = {}, list(cells), 300
    for storey in range(3):
        new = [f"C{storey}{k}" for k in range(2)]
        for name in new:
            cells[name] = CellContent(
                name, {(1, 9): [ell(rng, size)]} if rng.random() < 0.7 else {}
            )
            chosen = rng.choice(names, int(rng.integers(1, 4))).tolist()
            placed[name] = tuple(some_copies(rng, child, size) for child in chosen)
        names, size = [*new, *names[:2]], 4 * size
    return Assembly("M", cells, placed)


def told(report):
    listed = sorted((v.rule, v.box, round(v.value, 6)) for v in report.violations)
    least = [round(v, 6) for v in (report.minimum_gap_nm, report.minimum_feature_nm)]
    return (
        report.pillars,
        report.counts,
        least,
        listed if max(report.counts.values()) < 500 else None,
    )


@pytest.mark.parametrize("seed", range(8))
def test_random_hierarchies_give_what_they_give_taken_apart(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    content = taken_apart(nested(rng))
    rules = Rules(
        minimum_gap_nm=float(rng.uniform(5, 200)),
        minimum_feature_nm=90,
        grid_nm=1 + seed % 3,
        diameter_step_nm=6,
    )
    monkeypatch.setattr(copies, "_LEAST", NEVER)
    flat = told(foreign.check(content, rules))
    monkeypatch.setattr(copies, "_LEAST", 2)
    assert len(copies.found(content).times) > 1
    assert told(foreign.check(content, rules)) == flat


def wafer(dies, step, beside=()):
    """A die of 72 x 60 pairs of boxes, 40 nm between the two of a pair, 101 nm from
    pair to pair; step and repeat.
    """
    pair = CellContent("PAIR", {(1, 0): [BOX, BOX + np.array([240, 0])]})
    cells = {
        "PAIR": pair,
        "DIE": CellContent("DIE", {(3, 0): [3 * BOX]}),
        "WAFER": CellContent("WAFER"),
    }
    pillars = Copies(
        "PAIR", -9000, 700, columns=72, rows=60, across=(541, 0), up=(0, 271)
    )
    array = Copies("DIE", 0, 0, QUARTERS[5], *dies, (step[0], 0), (0, step[1]))
    return Assembly("WAFER", cells, {"DIE": (pillars,), "WAFER": (array, *beside)})


@pytest.mark.parametrize("write", [oasis_assemble.write, gdsii_assemble.write])
def test_a_wafer_of_millions_of_shapes_is_checked_in_the_memory_of_a_die(
    tmp_path, capsys, write
):
    path = tmp_path / "w.mask"
    write(wafer((120, 90), (17_000, 40_000)), path)
    toml = tmp_path / "p.toml"
    toml.write_text("[rules]\nminimum_gap_nm = 40\nminimum_feature_nm = 170\n")
    assert cli.main(["check", str(path), "--process", str(toml), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["shapes"] == 120 * 90 * (2 * 72 * 60 + 1)  # 9.3e7
    toml.write_text("[rules]\nminimum_gap_nm = 41\nminimum_feature_nm = 171\n")
    content = read(path)
    tracemalloc.start()
    try:
        report = foreign.check(
            content, Rules(minimum_gap_nm=41, minimum_feature_nm=171)
        )
        assert (
            tracemalloc.get_traced_memory()[1] < 12e6
        )  # 10,800 dies at some 200 bytes, and one die
    finally:
        tracemalloc.stop()
    assert report.counts["gap"] == 120 * 90 * 72 * 60
    assert report.counts["feature"] == 120 * 90 * 2 * 72 * 60  # 3 * BOX is wide enough
    assert (report.minimum_gap_nm, report.minimum_feature_nm) == (40, 170)
    first = next(v for v in report.violations if v.rule == "gap")
    assert "in each of 10,800 copies of DIE" in first.text
    # the lowest pair of the die begins at (-9000, 700), 440 x 170, mirrored at the x
    # axis and turned by 90 degrees
    assert (700, -9000, 870, -8560) in {v.box for v in report.violations}
    assert [
        sum(v.rule == rule for v in report.violations) for rule in ("gap", "feature")
    ] == [500, 500]


def counts_of(made, rules, **more):
    report = foreign.check(taken_apart(made), rules, **more)
    return {rule: count for rule, count in report.counts.items() if count}, report


def test_a_mark_is_covered_by_its_pieces_and_one_that_overlaps_itself_by_the_box_around_it():
    """An L in two boxes; a strip of 1250 units² that goes round and across its own
    start, 100 of them twice.
    """
    bent = np.array([[0, 0], [30, 0], [30, 10], [10, 10], [10, 25], [0, 25]])
    assert sorted(rules_nested._covering(bent).tolist()) == [
        [0, 0, 30, 10],
        [0, 10, 10, 25],
    ]
    crossed = [
        [0, 0],
        [40, 0],
        [40, 40],
        [5, 40],
        [5, -10],
        [15, -10],
        [15, 30],
        [30, 30],
        [30, 10],
        [0, 10],
    ]
    assert rules_nested._covering(np.array(crossed)).tolist() == [[0, -10, 40, 40]]


def test_neighbouring_dies_that_come_too_near_are_measured_where_they_meet():
    """Dies 40 nm apart along y: 72 gaps between each two of them (their upper rows),
    and none along x.
    """
    height = 59 * 271 + 170
    made = wafer((7, 5), (60_000, 60_000))
    die = dataclasses.replace(
        made.copies["WAFER"][0], turn=QUARTERS[0], up=(0, height + 40)
    )
    made = dataclasses.replace(made, copies=dict(made.copies) | {"WAFER": (die,)})
    found, report = counts_of(
        made, Rules(minimum_gap_nm=39), most=40_000
    )  # a die, and its squares beside the others
    assert found == {}
    found, report = counts_of(made, Rules(minimum_gap_nm=40.5), most=40_000)
    # two boxes of each pair, and the larger box of the die, 700 nm below: in another
    # layer
    assert found == {"gap": 7 * 5 * 72 * 60 + 7 * 4 * 144}
    assert report.pillars == 35 * 8641
    assert report.minimum_gap_nm == 40
    with pytest.raises(
        MaskFileError,
        match=r"copies of cell 'DIE' lie on .* 35 times .*--most-shapes \d+ takes",
    ):
        counts_of(made, Rules(minimum_gap_nm=300), most=9_000)


def test_a_mark_on_one_die_counts_there_alone_and_a_ring_around_all_on_none():
    """A bar 30 nm beside the outermost pair of one of 12 dies; a frame whose box holds
    all dies, far from each.
    """
    ring = [
        (-99, -99),
        (1000, -99),
        (1000, 900),
        (-99, 900),
        (-99, 0),
        (0, 0),
        (0, 800),
        (900, 800),
        (900, 0),
        (-99, 0),
    ]
    bar = CellContent("BAR", {(1, 7): [BOX]})
    frame = CellContent("RING", {(1, 8): [np.array(ring) * 500 - 30_000]})
    beside = (Copies("BAR", -9000 - 230, 700), Copies("RING", 0, 0))
    made = wafer((4, 3), (60_000, 30_000), beside)
    die = dataclasses.replace(made.copies["WAFER"][0], turn=QUARTERS[0])
    cells = {"BAR": bar, "RING": frame} | dict(made.cells)
    made = dataclasses.replace(
        made, cells=cells, copies=dict(made.copies) | {"WAFER": (die, *beside)}
    )
    found, report = counts_of(made, Rules(minimum_gap_nm=35), most=10_000)
    assert found == {"gap": 1}
    assert report.minimum_gap_nm == 30


def test_dies_off_the_grid_are_counted_one_by_one():
    """Steps of 60 002 nm on a grid of 5 nm: columns 1 to 4 of 6 lie off it, in both
    rows.
    """
    made = wafer((6, 2), (60_002, 50_000))
    cells = dict(made.cells) | {"PAIR": CellContent("PAIR", {(1, 0): [BOX]})}
    pillars = dataclasses.replace(made.copies["DIE"][0], across=(540, 0), up=(0, 270))
    found = dict(made.copies) | {"DIE": (pillars,)}
    made = dataclasses.replace(made, cells=cells, copies=found)
    rules = Rules(minimum_gap_nm=50, grid_nm=5, diameter_step_nm=5)
    counts, report = counts_of(made, rules)
    assert counts == {"off-grid": 4 * 2 * (72 * 60 + 1)}  # columns 0 and 5 lie on it
    assert all(v.box[0] % 5 and not v.box[1] % 5 for v in report.violations)


def test_what_is_beyond_the_limit_even_so_says_what_would_do():
    made = wafer((3, 2), (60_000, 30_000))
    with pytest.raises(
        MaskFileError,
        match=r"draws 51,846 shapes.* 8,647 are left.*most-shapes 8647 takes",
    ):
        foreign.check(taken_apart(made), Rules(), most=8_000)


def eighths(rng, reach=90):
    """A disc of boxes stored as layout folds it: an eighth, placed eight times, and its
    diagonal, placed four times.
    """
    at, size = (
        np.arange(1, reach) * 300,
        [np.array([[-s, -s], [s, -s], [s, s], [-s, s]]) for s in (60, 77, 91)],
    )
    x, y = (v.ravel() for v in np.meshgrid(at, at))
    kind = rng.integers(3, size=len(x))
    inside = x**2 + y**2 < (300 * reach) ** 2
    some = {"EIGHTH": (y < x) & inside, "DIAGONAL": (y == x) & inside}
    cells = {f"P{k}": CellContent(f"P{k}", {(1, 0): [o]}) for k, o in enumerate(size)}
    placed = {
        n: tuple(Copies(f"P{kind[i]}", x[i], y[i]) for i in np.flatnonzero(s))
        for n, s in some.items()
    }
    cells |= {n: CellContent(n) for n in (*some, "LENS")}
    turns = {"EIGHTH": QUARTERS, "DIAGONAL": QUARTERS[:4]}
    return cells, placed | {
        "LENS": tuple(Copies(n, 0, 0, t) for n in some for t in turns[n])
    }


def test_eighths_of_a_lens_that_lie_in_each_others_boxes_are_looked_at_once_but_for_their_edges(
    monkeypatch,
):
    """A bar of the eighth is too near the box to its right, in each copy; only rows
    along the edges are taken apart.
    """
    cells, placed = eighths(np.random.default_rng(3))
    near_by = np.array([[0, 0], [25, 0], [25, 90], [0, 90]]) + np.array([12_165, 6_000])
    cells["EIGHTH"] = CellContent("EIGHTH", {(1, 0): [near_by]})
    content = taken_apart(Assembly("M", cells, placed))
    shapes = sum(
        len(placed[n]) * times for n, times in (("EIGHTH", 8), ("DIAGONAL", 4))
    )
    rules = Rules(minimum_gap_nm=70, minimum_feature_nm=20)
    monkeypatch.setattr(copies, "_LEAST", 2000)
    report = foreign.check(content, rules, most=len(placed["EIGHTH"]) + 8 * 6 * 90)
    assert len(placed["EIGHTH"]) + 8 * 6 * 90 < shapes / 3
    assert report.pillars == shapes + 8
    monkeypatch.setattr(copies, "_LEAST", NEVER)
    assert told(foreign.check(content, rules)) == told(report)
    assert {rule: n for rule, n in report.counts.items() if n} == {"gap": 8}
    beside = next(c for c in placed["EIGHTH"] if (c.x, c.y) == (12_300, 6_000))
    half = cells[beside.child].polygons[1, 0][0].max()
    assert report.minimum_gap_nm == 12_300 - half - 12_190
