"""Whole furnished masks and random nested ones of any turn, beside what KLayout counts
and measures of the files.
"""

import math

import numpy as np
import pytest

import layout
from layout.commands.check import read
from layout.files import Assembly, CellContent, Copies, Turn, flat, hierarchy
from layout.gdsii import assemble as gdsii_assemble
from layout.mask import build
from layout.process.process import Die, Etch, Process, Rules
from layout.rules import foreign
from layout.shapes import polygon
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import Ellipse, Rectangle
from metalens.lens import DiameterMap, Lens
from metalens.pillars import Proxy

db = pytest.importorskip("klayout.db")
pytestmark = pytest.mark.peers

MOST = 170  # nm: gaps and widths beyond are not told apart
# KLayout rounds the ends of the parts of slanted edges that it measures between
STEP = 1.0
# degrees: edges that lean more to each other are no width; opposite ones of our pillars
# do not
PARALLEL = 2.0
PROXY = Proxy(
    np.array([[3.0, 3.0]]), np.array([[0.93]]), (0.05, 0.32), (0.94, 0.94), 0.01, 0.01
)


def lens(name):
    """Round pillars on two lattices, and rectangles and ellipses turned one by one."""
    rng = np.random.default_rng(5)
    stands = rng.random((14, 19)) < 0.8
    if name == "round":
        return DiameterMap(
            np.where(stands, rng.uniform(0.11, 0.29, stands.shape), 0), 0.4
        )
    if name == "hexagonal":
        stands &= (np.arange(14)[:, None] + np.arange(19)) % 2 == 0
        cell = Cell(0.336, lattice=Lattice("hexagonal"))
        size = np.where(stands, np.rint(rng.uniform(90, 240, stands.shape)) * 1e-3, 0)
        return Lens(
            DiameterMap(size, 0.336, cell.lattice, 0.291),
            cell,
            PROXY,
            0.94,
            77.0,
            math.inf,
            "map",
        )
    cell = Cell(0.4, shape=Rectangle(0.55) if name == "rectangles" else Ellipse(0.6))
    turned = DiameterMap(
        np.where(stands, 0.24, 0.0),
        0.4,
        angle_rad=rng.uniform(0, math.pi, stands.shape),
    )
    return Lens(turned, cell, PROXY, 0.94, 77.0, math.inf, "map", hand="left")


def regions(path):
    """{(layer, datatype): raw shapes below the top cells}, as KLayout reads them."""
    there = db.Layout()
    there.read(str(path))
    found = {}
    for index in there.layer_indexes():
        about, raw = there.get_info(index), db.Region()
        for top in there.top_cells():
            raw += db.Region(top.begin_shapes_rec(index))
        raw.merged_semantics = False
        raw.flatten()  # it is looked at when the layout is gone
        if not raw.is_empty():
            found[about.layer, about.datatype] = raw
    return found


def areas(content):
    """{(layer, datatype): area of all shapes}, database units squared."""
    found = {}
    for top in content.tops:
        for shape in flat.shapes(content, top):
            own = abs(polygon.twice_area(shape.outline)) * len(shape.x) / 2
            found[shape.layer] = found.get(shape.layer, 0) + own
    return found


def largest_kept(check):
    """Largest whole limit up to MOST that a check of KLayout finds kept."""
    low, high = 0, MOST + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if check(middle) else (middle, high)
    return low


@pytest.mark.parametrize(
    ("name", "tone"),
    [(name, "positive") for name in ("round", "hexagonal", "rectangles", "ellipses")]
    + [("round", "negative")],
)
def test_furnished_masks_have_the_shapes_areas_and_least_sizes_of_klayout(
    tmp_path, name, tone
):
    process = Process(
        tone=tone, die=Die(margin_um=330, label="R8 O"), etch=Etch(sidewall_deg=1.5)
    )
    made = build.prepare(lens(name), process, with_doses=False).plan
    layout.write_oasis(made, tmp_path / "m.oas")
    layout.write_gdsii(made, tmp_path / "m.gds")
    for path in (tmp_path / "m.oas", tmp_path / "m.gds"):
        content, theirs = read(path), regions(path)
        assert dict(hierarchy.shapes(content)) == {
            layer: raw.count() for layer, raw in theirs.items()
        }
        assert areas(content) == {layer: raw.area() for layer, raw in theirs.items()}
    for number in sorted(
        {layer[0] for layer in theirs}
        - {process.layers.outline[0], process.layers.fields[0]}
    ):
        merged = db.Region()
        for layer, raw in theirs.items():
            merged += raw if layer[0] == number else db.Region()
        merged = merged.merged()
        others = sorted({layer[0] for layer in theirs} - {number})
        found = foreign.check(
            content, Rules(minimum_gap_nm=MOST, minimum_feature_nm=MOST), skip=others
        )
        across = (
            (db.Region.Projection, PARALLEL)
            if tone == "negative"
            else (db.Region.Euclidian,)
        )  # round holes
        gap = largest_kept(
            lambda d, m=merged, how=across: m.space_check(d, True, *how).count()
        )
        assert (
            abs(
                min(
                    math.floor(found.minimum_gap_nm + 1e-9)
                    if found.counts["gap"]
                    else MOST,
                    MOST,
                )
                - gap
            )
            <= STEP
        )
        width = largest_kept(
            lambda d, m=merged: m.width_check(
                d, True, db.Region.Projection, PARALLEL
            ).count()
        )
        least = min(found.minimum_feature_nm, MOST)
        assert abs(math.floor(least + 1e-9) - width) <= STEP, (name, number)


def nested(rng):
    """Polygons of any angle in cells that are placed in rows, turned and scaled in any
    way, three deep.
    """
    cells, copies, names, size = {}, {}, [], 400
    for k in range(4):
        angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(5, 12))))
        corners = np.rint(
            rng.uniform(60, 160) * np.column_stack([np.cos(angle), np.sin(angle)])
        ).astype(np.int64)
        cells[f"P{k}"] = CellContent(f"P{k}", {(1 + k % 2, k): [corners]})
        names.append(f"P{k}")
    for storey in range(3):
        new = [f"C{storey}{k}" for k in range(2)]
        for name in new:
            placed = []
            for child in rng.choice(names, 3).tolist():
                turn = Turn(
                    float(rng.uniform(0, 360)),
                    bool(rng.integers(2)),
                    float(rng.choice([1.0, 0.5, 1.7])),
                )
                at, step = (
                    rng.integers(-5 * size, 5 * size, 2).tolist(),
                    (size * rng.uniform(1.4, 2.2, 2)).astype(int),
                )
                columns, rows = rng.integers(1, 5, 2).tolist()
                across, up = (
                    (int(step[0]), int(rng.integers(-60, 60))),
                    (int(rng.integers(-60, 60)), int(step[1])),
                )
                placed.append(Copies(child, *at, turn, columns, rows, across, up))
            cells[name], copies[name] = CellContent(name), tuple(placed)
        names, size = [*new, names[0]], 4 * size
    return Assembly("M", cells, copies)


@pytest.mark.parametrize("seed", range(40))
def test_random_masks_of_any_turn_and_scale_are_those_of_klayout(tmp_path, seed):
    """Counts are equal, areas but for the rounding of corners."""
    path = tmp_path / "m.gds"
    gdsii_assemble.write(nested(np.random.default_rng(seed)), path)
    content, theirs = read(path), regions(path)
    assert dict(hierarchy.shapes(content)) == {
        layer: raw.count() for layer, raw in theirs.items()
    }
    assert min(raw.count() for raw in theirs.values()) > 0
    found = areas(content)
    for layer, raw in theirs.items():
        around = sum(p.perimeter() for p in raw.each())
        assert (
            abs(found[layer] - raw.area()) < around / 2
        )  # each corner is off by half a unit along x and y at most
