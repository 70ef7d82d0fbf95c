"""Masks of turned pillars, other shapes and hexagonal lattices, as KLayout reads them; what is refused by name."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from layout.files import verify
from layout.gdsii import read as gdsii_read
from layout.gdsii import write as gdsii_write
from layout.mask import build, shaped
from layout.oasis import read as oasis_read
from layout.oasis import write as oasis_write
from layout.process import process as processes
from layout.rules import check as drc
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import Circle, Cross, Ellipse, Rectangle, Ring, Square
from metalens.ground.errors import ProcessError
from metalens.lens import DiameterMap, Lens, Pairs
from metalens.pillars import Proxy

PROXY = Proxy(np.array([[3.0, 3.0]]), np.array([[0.93]]), (0.05, 0.32), (0.94, 0.94), 0.01, 0.01)
PROCESS = processes.Process()


def lens(shape=None, turned=True, rows=14, columns=19):
    rng = np.random.default_rng(4)
    size = np.where(rng.random((rows, columns)) < 0.8, 0.24, 0.0)
    angle = rng.uniform(0, math.pi, size.shape) if turned else None
    cell = Cell(0.4, shape=shape or Rectangle(0.55))
    return Lens(
        DiameterMap(size, 0.4, angle_rad=angle), cell, PROXY, 0.94, 77.0, math.inf, "map", hand="left" if turned else ""
    )


def hexagonal(row_um=0.291):
    rng = np.random.default_rng(6)
    size = np.rint(rng.uniform(90, 240, (15, 22))) * 1e-3
    size[(np.arange(15)[:, None] + np.arange(22)) % 2 == 1] = 0
    cell = Cell(0.336, lattice=Lattice("hexagonal"))
    return Lens(DiameterMap(size, 0.336, cell.lattice, row_um), cell, PROXY, 0.94, 77.0, math.inf, "map")


def shapes(path):
    """[(x, y, corners about the site)] of every pillar of the lens, as KLayout reads them."""
    db = pytest.importorskip("klayout.db")
    read = db.Layout()
    read.read(str(path))
    walk = db.RecursiveShapeIterator(read, read.cell("LENS"), read.layer(1, 0))
    found = []
    while not walk.at_end():
        place = walk.trans().disp
        corners = np.array([(p.x, p.y) for p in walk.shape().polygon.each_point_hull()])
        found.append((place.x, place.y, corners))
        walk.next()
    return found


def written(made, folder, suffix):
    plan = build.plan(made, PROCESS, furnished=True)
    path = folder / f"m.{suffix}"
    if suffix == "gds":
        gdsii_write.write(plan, path)
        content = gdsii_read.read(path)
    else:
        oasis_write.write(plan, path)
        content = oasis_read.read(path)
    outcome = verify.compare(plan, content)
    assert outcome.ok, outcome.differences
    return plan, shapes(path)


def axis_of(corners):
    """(turn of the long axis modulo pi, area, second moments) of a polygon, by Green's theorem."""
    p, q = corners.astype(float), np.roll(corners, -1, axis=0).astype(float)
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    area = cross.sum() / 2
    xx, yy = ((cross * (a * a + a * b + b * b)).sum() / 12 for a, b in zip(p.T, q.T, strict=True))
    mixed = (p[:, 0] * q[:, 1] + 2 * p[:, 0] * p[:, 1] + 2 * q[:, 0] * q[:, 1] + q[:, 0] * p[:, 1]) * cross
    xy = mixed.sum() / 24
    sign = np.sign(area)
    return 0.5 * math.atan2(2 * sign * xy, sign * (xx - yy)) % math.pi, abs(area)


@pytest.mark.parametrize("suffix", ["gds", "oas"])
def test_every_turned_pillar_is_drawn_at_its_place_and_turn(tmp_path, suffix):
    made = lens()
    _, found = written(made, tmp_path, suffix)
    d = made.diameters
    rows, columns = np.nonzero(d.diameter_um)
    assert len(found) == len(rows)
    there = {(x, y): corners for x, y, corners in found}
    for row, column in zip(rows, columns, strict=True):
        corners = there[round(1e3 * d.x_um[column]), round(1e3 * d.y_um[row])]
        turn, area = axis_of(corners)
        off = (turn - d.angle_rad[row, column] + math.pi / 2) % math.pi - math.pi / 2
        assert abs(math.degrees(off)) < 0.5 + 0.35  # half a step of the turns; corners on the grid: 1 nm of 120
        assert area == pytest.approx(240 * 132, rel=0.012)  # half a nm along each edge of 240 and 132


@pytest.mark.parametrize(
    ("shape", "area"),
    [(Square(), 240**2), (Ellipse(0.6), math.pi / 4 * 240 * 144), (Rectangle(0.55, angle_rad=0.4), 240 * 132)],
)
def test_unturned_shapes_are_drawn_too_and_never_folded_into_their_mirror_image(tmp_path, shape, area):
    made = lens(shape, turned=False, rows=12, columns=12)
    d = dataclasses.replace(made.diameters, diameter_um=np.full((12, 12), 0.24))  # the map is symmetric, the shape not
    _, found = written(dataclasses.replace(made, diameters=d), tmp_path, "oas")
    assert len(found) == 144
    assert len({tuple(map(tuple, np.roll(c, -np.lexsort(c.T)[0], axis=0))) for _, _, c in found}) == 1
    assert axis_of(found[0][2])[1] == pytest.approx(area, rel=0.012)
    if isinstance(shape, Rectangle):
        assert axis_of(found[0][2])[0] == pytest.approx(0.4, abs=0.006)


@pytest.mark.parametrize("shape", [Rectangle(), Ellipse()], ids=lambda s: s.kind)
def test_pillars_of_two_sizes_are_drawn_with_their_width_and_length(tmp_path, shape):
    rng, there = np.random.default_rng(8), np.random.default_rng(4).random((9, 12)) < 0.8
    size, length = (
        np.where(there, rng.integers(low, high, (9, 12)) * 2e-3, 0.0) for low, high in ((45, 140), (60, 150))
    )
    axes = 0.09 + 2e-3 * np.arange(96), 0.12 + 2e-3 * np.arange(91)
    table = Pairs(np.array([0.94]), *axes, np.ones((1, 96, 91, 2), complex), (77.0, math.inf))
    sizes = DiameterMap(size, 0.4, length_um=length)
    made = Lens(sizes, Cell(0.4, shape=shape), table.proxy, 0.94, 77.0, math.inf, "map", pairs=table)
    plan, found = written(made, tmp_path, "gds")
    placed = {(x, y): np.ptp(corners, axis=0) for x, y, corners in found}
    assert len(found) == there.sum()
    d, grid = made.diameters, 1.0 if shape.kind == "rectangle" else 2.0  # corners of ellipses keep the area
    for row, column in np.argwhere(there):
        at = round(1e3 * d.x_um[column] + plan.axis[0]), round(1e3 * d.y_um[row] + plan.axis[1])
        want = 1e3 * np.array([size[row, column], length[row, column]])
        assert np.abs(placed[at] - want).max() <= grid
    wide = np.array([c.outline for c in plan.classes if c.name.startswith("D")], dtype=object)
    assert len(wide) == len(np.unique(np.stack([size[there], length[there]]), axis=1).T)


@pytest.mark.parametrize("suffix", ["gds", "oas"])
def test_pillars_of_a_hexagonal_lattice_stand_on_it(tmp_path, suffix):
    made = hexagonal()
    plan, found = written(made, tmp_path, suffix)
    d = made.diameters
    rows, columns = np.nonzero(d.diameter_um)
    axis = np.array(plan.axis)  # it may lie half a step off the grid
    want = np.stack([1e3 * d.x_um[columns], 1e3 * d.y_um[rows]], 1) + axis
    got = np.array([(x, y) for x, y, _ in found], float)
    assert np.abs(got[np.lexsort(got.T)] - want[np.lexsort(np.rint(want).T)]).max() < 1e-6
    apart = np.hypot(*(got[:, None] - got).T)
    assert np.sort(apart[apart > 0])[0] == pytest.approx(336, abs=0.02)  # hypot(168, 291) = 336.01


def test_the_gaps_between_turned_and_hexagonal_pillars_are_measured():
    """Against the least distance between the corners and edges of all pairs, written out."""
    for made in (lens(), hexagonal()):
        plan = build.plan(made, PROCESS, furnished=False)
        lattice = plan.lattices[0]
        sites = lattice.whole()
        rows, columns = np.nonzero(sites)
        place = np.stack([lattice.x0 + columns * lattice.pitch, lattice.y0 - rows * lattice.down], 1)
        outlines = [plan.classes[sites[r, c] - 1].outline + at for r, c, at in zip(rows, columns, place, strict=True)]
        middles = np.array([o.mean(0) for o in outlines])
        least = math.inf
        for i, j in zip(*np.nonzero(np.triu(np.hypot(*(middles[:, None] - middles).T) < 700, 1)), strict=True):
            for a, b in ((outlines[i], outlines[j]), (outlines[j], outlines[i])):
                edge = np.roll(b, -1, axis=0) - b
                to = a[:, None].astype(float) - b
                along = np.clip((to * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
                least = min(least, float(np.hypot(*(to - along[..., None] * edge).T).min()))
        found = drc.check(plan, PROCESS.rules, foot_nm=np.array([c.diameter_nm + 20.0 for c in plan.classes]))
        assert found.minimum_gap_nm == pytest.approx(least)
        assert found.minimum_foot_gap_nm == pytest.approx(least - 20, abs=1.1)  # round ones by circles
        assert found.pillars == len(rows)


@pytest.mark.parametrize(
    ("made", "change", "words"),
    [
        (lens(Ring(0.4), turned=False), {}, "without hollows"),
        (lens(Cross(0.3), turned=False), {}, "without hollows"),
        (lens(), {"tone": "negative"}, "negative"),
        (hexagonal(), {"exposure": processes.Exposure(alpha_um=0.02, beta_um=10.0, eta=0.6)}, "--no-dose"),
        (hexagonal(), {"bias": dataclasses.replace(PROCESS.bias, isolated_nm=4.0)}, "isolated_nm"),
        (hexagonal(row_um=0.0), {}, "no multiple of the grid"),
    ],
)
def test_what_is_not_drawn_is_refused_by_name(made, change, words):
    with pytest.raises(ProcessError, match=words):
        build.prepare(made, dataclasses.replace(PROCESS, **change))


def test_a_step_of_turns_divides_half_a_turn():
    with pytest.raises(ProcessError, match="angle_step_deg"):
        processes.Rules(angle_step_deg=7.0)


@pytest.mark.parametrize("suffix", ["gds", "oas"])
@pytest.mark.parametrize("open_", [Square(hole=True), Circle(hole=True), Ellipse(0.7, 0.4, hole=True)])
def test_openings_of_a_film_are_drawn_as_pillars_of_their_size_would_be(open_, suffix, tmp_path):
    plan, found = written(lens(open_, turned=False), tmp_path, suffix)
    size = 0.24e3  # nm, drawn as it is: the default process has no bias
    area = {"square": 1.0, "circle": math.pi / 4, "ellipse": math.pi / 4 * 0.7}[open_.kind] * size**2
    assert len(found) == (lens(open_, turned=False).diameters.diameter_um > 0).sum()
    for *_, corners in found:
        x, y = corners.T
        shoelace = abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
        # corners on a grid of 1 nm: half a unit along at most four edges of 240 nm, and the n-gon's area for arcs
        assert shoelace == pytest.approx(area, rel=0.01)
    assert plan.layer_names[1, 0] == "opening"
    assert drc.check(plan, dataclasses.replace(PROCESS.rules, minimum_gap_nm=250)).ok is False  # walls of 160 to 240 nm


def test_keys_are_counted_and_numbered_alike_by_a_table_and_by_sorting(monkeypatch):
    table = build.plan(lens(), PROCESS, furnished=False)
    monkeypatch.setattr(shaped, "_TABLED", 0)
    by_sorting = build.plan(lens(), PROCESS, furnished=False)
    assert [c.name for c in table.classes] == [c.name for c in by_sorting.classes]
    np.testing.assert_array_equal(table.lattices[0].whole(), by_sorting.lattices[0].whole())


def test_all_edges_of_a_shape_move_by_the_bias_of_its_size():
    """240 nm drawn come out as 228: a rectangle of 228 by 0.55 x 228, 12 nm more of both; no ratio of 240."""
    process = SimpleNamespace(bias=SimpleNamespace(made_nm=lambda drawn: drawn - 12.0), rules=PROCESS.rules)
    corners = shaped._biased(Cell(0.4, shape=Rectangle(0.55)), 240, process)
    assert np.ptp(corners, axis=0) * 1e3 == pytest.approx([240.0, 0.55 * 228 + 12], abs=1e-9)


def test_turns_are_counted_over_half_a_turn_where_that_brings_the_shape_back():
    """Every half degree: 360 of a rectangle, 720 of what a half turn changes, one where nothing is turned."""
    process = dataclasses.replace(PROCESS, rules=dataclasses.replace(PROCESS.rules, angle_step_deg=0.5))
    d = lens().diameters
    lone = SimpleNamespace(pitch_um=0.4, outline=lambda size: SimpleNamespace(repeats=lambda by: by > 6))
    assert shaped._turns(Cell(0.4, shape=Rectangle(0.55)), d, process) == 360
    assert shaped._turns(lone, d, process) == 720
    assert shaped._turns(lone, lens(turned=False).diameters, process) == 1


def test_a_turn_goes_to_the_nearest_step_and_half_a_turn_to_none():
    degrees = np.array([[0.3, 179.7, 0.6, 90.4, -0.7]])
    sizes = DiameterMap(np.full((1, 5), 0.24), 0.4, angle_rad=np.radians(degrees))
    process = dataclasses.replace(PROCESS, rules=dataclasses.replace(PROCESS.rules, angle_step_deg=1.0))
    ((_, key),) = shaped._keys(sizes, process, 180)
    assert (key % 180).tolist() == [[0, 0, 1, 90, 179]]
    assert (key // 180).tolist() == [[240] * 5]


@pytest.mark.parametrize("unit_nm", [1.0, 0.5])
def test_a_class_is_as_wide_as_its_widest_corners_whatever_the_unit(unit_nm):
    """Corners of 240 by 132 nm lie 273.9 apart, turned or not; sizes are met to half a step of 2 nm."""
    made, drawn = shaped.classes(lens(), PROCESS, unit_nm=unit_nm)
    across, found, within = (getattr(made, f.name) for f in dataclasses.fields(made)[1:])
    assert across == pytest.approx(np.full(len(drawn), math.hypot(240, 132)), abs=1.5)  # corners on a grid of 1 nm
    assert found.sum() == (lens().diameters.diameter_um > 0).sum()
    assert within == PROCESS.rules.diameter_step_nm / 2
    assert {one.diameter_nm for one in drawn} == {240.0}
