"""Masks of turned pillars, other shapes and hexagonal lattices, as KLayout reads them;
what is refused by name.
"""

import dataclasses
import math

import numpy as np
import pytest

from layout.drc.lattice import check_plan
from layout.formats import compare, gdsii_read, gdsii_write, oasis_read, oasis_write
from layout.mask import build, shaped
from layout.process import process as processes
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import (
    Circle,
    Cross,
    Ellipse,
    Polygon,
    Rectangle,
    Ring,
    Square,
)
from metalens.core.errors import ProcessError
from metalens.fabrication import Bias
from metalens.lens import DiameterMap, Lens, TwoSizeTable
from tests.proxies import proxy_of

PROXY = proxy_of([3.0, 3.0], [0.93], (0.05, 0.32), 0.94, 0.01)
PROCESS = processes.Process()


def lens(shape=None, turned=True, rows=14, columns=19):
    rng = np.random.default_rng(4)
    size = np.where(rng.random((rows, columns)) < 0.8, 0.24, 0.0)
    angle = rng.uniform(0, math.pi, size.shape) if turned else None
    cell = Cell(0.4, shape=shape or Rectangle(0.55))
    return Lens(
        DiameterMap(size, 0.4, angle_rad=angle),
        cell,
        PROXY,
        0.94,
        77.0,
        math.inf,
        "map",
        hand="left" if turned else "",
    )


def hexagonal(row_um=0.291):
    rng = np.random.default_rng(6)
    size = np.rint(rng.uniform(90, 240, (15, 22))) * 1e-3
    size[(np.arange(15)[:, None] + np.arange(22)) % 2 == 1] = 0
    cell = Cell(0.336, lattice=Lattice("hexagonal"))
    return Lens(
        DiameterMap(size, 0.336, cell.lattice, row_um),
        cell,
        PROXY,
        0.94,
        77.0,
        math.inf,
        "map",
    )


def shapes(path):
    """[(x, y, corners about the site)] of every pillar of the lens, as KLayout reads
    them.
    """
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
        gdsii_write.write_gdsii(plan, path)
        content = gdsii_read.read_gdsii(path)
    else:
        oasis_write.write_oasis(plan, path)
        content = oasis_read.read_oasis(path)
    outcome = compare.compare(plan, content)
    assert outcome.ok, outcome.differences
    return plan, shapes(path)


def axis_of(corners):
    """(turn of the long axis modulo pi, area, second moments) of a polygon, by Green's
    theorem.
    """
    p = corners.astype(float)
    q = np.roll(corners, -1, axis=0).astype(float)
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    area = cross.sum() / 2
    xx, yy = (
        (cross * (a * a + a * b + b * b)).sum() / 12
        for a, b in zip(p.T, q.T, strict=True)
    )
    mixed = (
        p[:, 0] * q[:, 1]
        + 2 * p[:, 0] * p[:, 1]
        + 2 * q[:, 0] * q[:, 1]
        + q[:, 0] * p[:, 1]
    ) * cross
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
        # half a step of the turns; corners on the grid: 1 nm of 120
        assert abs(math.degrees(off)) < 0.5 + 0.35
        # half a nm along each edge of 240 and 132
        assert area == pytest.approx(240 * 132, rel=0.012)


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        (Square(), 240**2),
        (Ellipse(0.6), math.pi / 4 * 240 * 144),
        (Rectangle(0.55, angle_rad=0.4), 240 * 132),
    ],
)
def test_unturned_shapes_are_drawn_too_and_never_folded_into_their_mirror_image(
    tmp_path, shape, area
):
    made = lens(shape, turned=False, rows=12, columns=12)
    # the map is symmetric, the shape not
    d = dataclasses.replace(made.diameters, diameter_um=np.full((12, 12), 0.24))
    _, found = written(dataclasses.replace(made, diameters=d), tmp_path, "oas")
    assert len(found) == 144
    assert (
        len(
            {
                tuple(map(tuple, np.roll(c, -np.lexsort(c.T)[0], axis=0)))
                for _, _, c in found
            }
        )
        == 1
    )
    assert axis_of(found[0][2])[1] == pytest.approx(area, rel=0.012)
    if isinstance(shape, Rectangle):
        assert axis_of(found[0][2])[0] == pytest.approx(0.4, abs=0.006)


@pytest.mark.parametrize("shape", [Rectangle(), Ellipse()], ids=lambda s: s.kind)
def test_pillars_of_two_sizes_are_drawn_with_their_width_and_length(tmp_path, shape):
    rng = np.random.default_rng(8)
    there = np.random.default_rng(4).random((9, 12)) < 0.8
    size, length = (
        np.where(there, rng.integers(low, high, (9, 12)) * 2e-3, 0.0)
        for low, high in ((45, 140), (60, 150))
    )
    axes = 0.09 + 2e-3 * np.arange(96), 0.12 + 2e-3 * np.arange(91)
    table = TwoSizeTable(
        np.array([0.94]), *axes, np.ones((1, 96, 91, 2), complex), (77.0, math.inf)
    )
    sizes = DiameterMap(size, 0.4, length_um=length)
    made = Lens(
        sizes,
        Cell(0.4, shape=shape),
        table.proxy,
        0.94,
        77.0,
        math.inf,
        "map",
        pairs=table,
    )
    plan, found = written(made, tmp_path, "gds")
    placed = {(x, y): np.ptp(corners, axis=0) for x, y, corners in found}
    assert len(found) == there.sum()
    # corners of ellipses keep the area
    d, grid = (made.diameters, 1.0 if shape.kind == "rectangle" else 2.0)
    for row, column in np.argwhere(there):
        at = (
            round(1e3 * d.x_um[column] + plan.axis[0]),
            round(1e3 * d.y_um[row] + plan.axis[1]),
        )
        want = 1e3 * np.array([size[row, column], length[row, column]])
        assert abs(placed[at] - want).max() <= grid
    wide = np.array(
        [c.outline for c in plan.classes if c.name.startswith("D")], dtype=object
    )
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
    assert abs(got[np.lexsort(got.T)] - want[np.lexsort(np.rint(want).T)]).max() < 1e-6
    apart = np.hypot(*(got[:, None] - got).T)
    # hypot(168, 291) = 336.01
    assert np.sort(apart[apart > 0])[0] == pytest.approx(336, abs=0.02)


def test_the_gaps_between_turned_and_hexagonal_pillars_are_measured():
    """Against the least distance between the corners and edges of all pairs, written
    out.
    """
    for made in (lens(), hexagonal()):
        plan = build.plan(made, PROCESS, furnished=False)
        lattice = plan.lattices[0]
        sites = lattice.whole()
        rows, columns = np.nonzero(sites)
        place = np.stack(
            [lattice.x0 + columns * lattice.pitch, lattice.y0 - rows * lattice.down], 1
        )
        outlines = [
            plan.classes[sites[r, c] - 1].outline + at
            for r, c, at in zip(rows, columns, place, strict=True)
        ]
        middles = np.array([o.mean(0) for o in outlines])
        least = math.inf
        for i, j in zip(
            *np.nonzero(np.triu(np.hypot(*(middles[:, None] - middles).T) < 700, 1)),
            strict=True,
        ):
            for a, b in ((outlines[i], outlines[j]), (outlines[j], outlines[i])):
                edge = np.roll(b, -1, axis=0) - b
                to = a[:, None].astype(float) - b
                along = np.clip((to * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
                least = min(
                    least, float(np.hypot(*(to - along[..., None] * edge).T).min())
                )
        found = check_plan(
            plan,
            PROCESS.rules,
            foot_nm=np.array([c.diameter_nm + 20.0 for c in plan.classes]),
        )
        assert found.minimum_space_nm == pytest.approx(least)
        # round ones by circles
        assert found.minimum_foot_space_nm == pytest.approx(least - 20, abs=1.1)
        assert found.shapes == len(rows)


@pytest.mark.parametrize(
    ("made", "change", "words"),
    [
        (lens(Ring(0.01), turned=False), {}, "four steps of the grid"),
        (
            lens(Ring(0.05), turned=False),
            {"bias": Bias(table_nm=((80.0, -30.0), (300.0, -30.0)))},
            "no hole",
        ),
        (hexagonal(row_um=0.0), {}, "no multiple of the grid"),
    ],
)
def test_what_is_not_drawn_is_refused_by_name(made, change, words):
    with pytest.raises(ProcessError, match=words):
        build.draw_mask(made, dataclasses.replace(PROCESS, **change))


LONE = dataclasses.replace(PROCESS, bias=Bias(isolated_nm=-14.0, range_um=0.6))


def drawn_of(made, process):
    """(y, x) class of every site, 0 for none."""
    found = build.draw_mask(made, process)
    return found.cells.classes, (None, *found.plan.classes)


@pytest.mark.parametrize("shape", [Rectangle(0.55), Ellipse(1.4), Ring(0.45)])
def test_edges_of_a_lone_pillar_of_any_shape_move_by_what_it_lacks(shape):
    """It comes out 14 nm thinner: all its edges are drawn 7 nm further out, its two
    sides stay those of the design.
    """
    size = np.full((31, 31), 0.2)
    size[:, 22:] = 0
    size[15, 28] = 0.2  # 3.5 ranges from all others
    made = dataclasses.replace(
        lens(shape, turned=False), diameters=DiameterMap(size, 0.4)
    )
    number, kinds = drawn_of(made, LONE)
    among, lone = kinds[number[15, 8]], kinds[number[15, 28]]
    spread = np.ptp(lone.outline, axis=0) - np.ptp(among.outline, axis=0)
    # corners on a grid of 1 nm on both sides, both of the same design
    assert abs(spread - 14).max() <= 1
    edge = kinds[number[15, 21]]  # at a straight rim
    lost = sum(math.exp(-((0.4 * i / 0.6) ** 2)) for i in range(1, 9))
    share = lost * (1 + 2 * lost) / ((1 + 2 * lost) ** 2 - 1)
    # a step of 2 nm; the other side 1.4 of half a step
    assert abs(edge.diameter_nm - 200 - 14 * share) <= 1.01
    assert (
        abs(
            np.ptp(edge.outline, axis=0) - np.ptp(among.outline, axis=0) - 14 * share
        ).max()
        <= 3
    )


def test_lone_pillars_of_two_sizes_have_both_drawn_larger():
    there = np.zeros((9, 12), bool)
    axes = 0.09 + 2e-3 * np.arange(96), 0.12 + 2e-3 * np.arange(91)
    pairs = TwoSizeTable(
        np.array([0.94]), *axes, np.ones((1, 96, 91, 2), complex), (77.0, math.inf)
    )
    there[::3, 1::3] = True  # 1.2 um apart: 6 ranges
    sizes = DiameterMap(
        np.where(there, 0.15, 0), 0.4, length_um=np.where(there, 0.24, 0)
    )
    made = Lens(
        sizes,
        Cell(0.4, shape=Rectangle()),
        pairs.proxy,
        0.94,
        77.0,
        math.inf,
        "map",
        pairs=pairs,
    )
    table = dataclasses.replace(LONE, bias=Bias(isolated_nm=-20.0, range_um=0.2))
    number, kinds = drawn_of(made, table)
    plain, before = drawn_of(made, PROCESS)
    for now, was in {
        (int(a), int(b))
        for a, b in zip(number.ravel(), plain.ravel(), strict=True)
        if a
    }:
        assert (
            abs(
                np.ptp(kinds[now].outline, axis=0)
                - np.ptp(before[was].outline, axis=0)
                - 20
            ).max()
            <= 1
        )


def test_a_step_of_turns_divides_half_a_turn():
    with pytest.raises(ProcessError, match="angle_step_deg"):
        processes.DesignRules(angle_step_deg=7.0)


@pytest.mark.parametrize("suffix", ["gds", "oas"])
@pytest.mark.parametrize(
    "open_", [Square(hole=True), Circle(hole=True), Ellipse(0.7, 0.4, hole=True)]
)
def test_openings_of_a_film_are_drawn_as_pillars_of_their_size_would_be(
    open_, suffix, tmp_path
):
    plan, found = written(lens(open_, turned=False), tmp_path, suffix)
    size = 0.24e3  # nm, drawn as it is: the default process has no bias
    area = {"square": 1.0, "circle": math.pi / 4, "ellipse": math.pi / 4 * 0.7}[
        open_.kind
    ] * size**2
    assert len(found) == (lens(open_, turned=False).diameters.diameter_um > 0).sum()
    for *_, corners in found:
        x, y = corners.T
        shoelace = abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
        # corners on a grid of 1 nm: half a unit along at most four edges of 240 nm, and
        # the n-gon's area for arcs
        assert shoelace == pytest.approx(area, rel=0.01)
    assert plan.layer_names[1, 0] == "opening"
    assert (
        check_plan(plan, dataclasses.replace(PROCESS.rules, minimum_gap_nm=250)).ok
        is False
    )  # walls of 160 to 240 nm


@pytest.mark.parametrize("unit_nm", [1.0, 0.5])
def test_a_class_is_as_wide_as_its_widest_corners_whatever_the_unit(unit_nm):
    """Corners of 240 by 132 nm lie 273.9 apart, turned or not."""
    made, drawn = shaped.shape_classes(lens(), PROCESS, unit_nm=unit_nm)
    assert made.diameters_nm == pytest.approx(
        np.full(len(drawn), math.hypot(240, 132)), abs=1.5
    )  # corners on a grid of 1 nm
    assert made.counts.sum() == (lens().diameters.diameter_um > 0).sum()
    assert {one.diameter_nm for one in drawn} == {240.0}


U = Polygon(
    (
        (-0.5, -0.45),
        (0.5, -0.35),
        (0.5, 0.5),
        (0.2, 0.5),
        (0.2, 0.0),
        (-0.2, -0.1),
        (-0.25, 0.4),
        (-0.5, 0.4),
    ),
    0.2,
)
LATTICES = {
    "square": Lattice(),
    "rectangular": Lattice("rectangular", 1.1),
    "hexagonal": Lattice("hexagonal"),
}


def of_sizes(shape, kind, rows=9, columns=14):
    """A lens of two sizes without mirror images, on any lattice."""
    rng, lattice = np.random.default_rng(12), LATTICES[kind]
    size = rng.choice([0.0, 0.22, 0.26], (rows, columns))
    row_um = 0.0
    if lattice.centred:
        size[np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 1] = 0
        row_um = 0.346
    return Lens(
        DiameterMap(size, 0.4, lattice, row_um),
        Cell(0.4, shape=shape, lattice=lattice),
        PROXY,
        0.94,
        77.0,
        math.inf,
        "map",
    )


def region(path, cell):
    """A layer of a cell as KLayout merges it."""
    db = pytest.importorskip("klayout.db")
    read = db.Layout()
    read.read(str(path))
    return db.Region(
        db.RecursiveShapeIterator(read, read.cell(cell), read.layer(1, 0))
    ).merged()


@pytest.mark.parametrize("suffix", ["gds", "oas"])
@pytest.mark.parametrize("kind", list(LATTICES))
@pytest.mark.parametrize(
    "shape", [Ring(0.45), Cross(0.35, 0.3), U], ids=lambda s: s.kind
)
def test_rings_crosses_and_hollow_polygons_are_drawn_with_their_area_on_their_sites(
    shape, kind, suffix, tmp_path
):
    """KLayout merges the pieces of a ring into one polygon with one hole; no piece
    touches itself.
    """
    made = of_sizes(shape, kind)
    plan, found = written(made, tmp_path, suffix)
    d = made.diameters
    rows, columns = np.nonzero(d.diameter_um)
    want = np.stack([1e3 * d.x_um[columns], 1e3 * d.y_um[rows]], 1) + np.array(
        plan.axis
    )
    sizes = dict(
        zip(
            map(tuple, np.rint(want).astype(int).tolist()),
            d.diameter_um[rows, columns].tolist(),
            strict=True,
        )
    )
    merged = region(tmp_path / f"m.{suffix}", "LENS")
    assert sum(p.area2() for p in merged.each()) == 2 * sum(
        axis_of(c)[1] for *_, c in found
    )  # pieces do not overlap
    assert (
        merged.count() == len(rows) == len(found) / (2 if shape.kind == "ring" else 1)
    )
    for x, y, corners in found:
        outline = made.cell.outline(sizes[x, y])
        share = (
            axis_of(corners)[1]
            / (1e6 * outline.area_um2)
            * (2 if shape.kind == "ring" else 1)
        )
        # circles keep their area to 1e-3; half a unit along 1.3 um of edges, random
        # over 8 or more, is 0.7 % of 25 000
        assert share == pytest.approx(1, rel=2e-3 if shape.kind == "ring" else 1.2e-2)
        assert len(np.unique(corners, axis=0)) == len(corners)
    holes = [polygon.holes() for polygon in merged.each()]
    assert set(holes) == {1 if shape.kind == "ring" else 0}


@pytest.mark.parametrize("kind", list(LATTICES))
@pytest.mark.parametrize(
    "shape", [Ring(0.45), Cross(0.35, 0.3), U], ids=lambda s: s.kind
)
def test_widths_and_spaces_of_hollow_shapes_are_those_that_klayout_finds(
    shape, kind, tmp_path
):
    """The least width and space: the next whole nm below passes its check, the next
    above does not.
    """
    db = pytest.importorskip("klayout.db")
    made = of_sizes(shape, kind)
    plan = build.plan(made, PROCESS, furnished=False)
    gdsii_write.write_gdsii(plan, tmp_path / "m.gds")
    drawn = region(tmp_path / "m.gds", "LENS")
    found = check_plan(plan, PROCESS.rules)
    # of curves chords at an angle are no widths; edges that share a corner count for
    # neither
    angle = 10 if shape.kind == "ring" else 45
    facing = db.Region.Projection, angle

    def keeps_width(limit):
        return drawn.width_check(limit, False, *facing).is_empty()

    def keeps_space(limit):
        """Between pillars to their corners, within one as edges face each other."""
        between = drawn.isolated_check(limit, False, db.Region.Euclidian, 90)
        within = drawn.notch_check(limit, False, *facing)
        return between.is_empty() and within.is_empty()

    for value, is_kept in (
        (found.minimum_width_nm, keeps_width),
        (found.minimum_space_nm, keeps_space),
    ):
        assert is_kept(math.floor(value))
        assert not is_kept(math.floor(value) + 1)
    outline = made.cell.outline(0.22)
    solid, space = (1e3 * v for v in outline.spans_um)
    # corners on a grid of 1 nm
    assert found.minimum_width_nm == pytest.approx(solid, abs=1.5)
    assert found.minimum_space_nm <= space + 1.5


def test_a_hole_or_wall_below_the_rules_is_found_in_every_pillar():
    made = of_sizes(Ring(0.45), "square")
    rules = dataclasses.replace(
        PROCESS.rules, minimum_feature_nm=65, minimum_gap_nm=105
    )
    found = check_plan(build.plan(made, PROCESS, furnished=False), rules)
    # walls of 60.5, holes of 99 nm; of 260: 71.5, 117
    few = int((made.diameters.diameter_um == 0.22).sum())
    assert found.counts["width"] == few
    assert found.counts["notch"] == few
    # flats of the circles stand on whole nm
    assert {round(v.value) for v in found.violations} == {60, 98}


@pytest.mark.parametrize("kind", ["rectangular", "hexagonal"])
def test_dose_test_and_witness_cells_stand_on_the_lattice_of_the_lens(kind):
    """Pillars 1.1 pitches apart along y, and long along y, would touch on a square
    lattice.
    """
    made = of_sizes(Ellipse(1.5) if kind == "rectangular" else Circle(), kind)
    plan = build.plan(made, PROCESS)
    lens_ = plan.lattices[0]
    assert [each.name for each in plan.lattices] == ["LENS", "DOSETEST", "WITNESS"]
    for each in plan.lattices[1:]:
        assert (each.pitch, each.down, each.centred) == (
            lens_.pitch,
            lens_.down,
            lens_.centred,
        )
        sites = each.whole()
        if each.centred:
            assert not sites[
                np.add.outer(np.arange(each.rows), np.arange(each.columns)) % 2 == 1
            ].any()
        blocks = np.bincount(sites.ravel())[1:]
        assert set(blocks[blocks > 0]) == {16**2 if each.name == "DOSETEST" else 40**2}


def exposed(path):
    """(merged, twice the area of the pieces, outline) of all that is written with the
    pillars, as KLayout reads it.
    """
    db = pytest.importorskip("klayout.db")
    mask, found, area = db.Layout(), db.Region(), 0
    mask.read(str(path))
    for index in mask.layer_indexes():
        if mask.get_info(index).layer in (1, 3, 4, 5, 6):
            raw = db.Region(mask.top_cell().begin_shapes_rec(index))
            raw.merged_semantics = False
            area += sum(p.area2() for p in raw.each())
            found += raw
    return (
        found.merged(),
        area,
        db.Region(mask.top_cell().begin_shapes_rec(mask.find_layer(10, 0))).merged(),
    )


@pytest.mark.parametrize(
    "made",
    [
        of_sizes(Ring(0.45), "hexagonal"),
        of_sizes(Cross(0.35, 0.3), "rectangular"),
        of_sizes(U, "hexagonal"),
        lens(),
    ],
    ids=["ring", "cross", "own", "turned"],
)
def test_both_tones_of_any_shape_and_lattice_are_the_die_and_share_nothing(
    made, tmp_path
):
    found = []
    for tone in ("positive", "negative"):
        plan = build.plan(made, dataclasses.replace(PROCESS, tone=tone))
        gdsii_write.write_gdsii(plan, tmp_path / f"{tone}.gds")
        assert compare.compare(plan, gdsii_read.read_gdsii(tmp_path / f"{tone}.gds")).ok
        found.append(exposed(tmp_path / f"{tone}.gds"))
    (stays, _, die), (drawn, area, _) = found
    assert (drawn & stays).is_empty()
    assert ((drawn + stays) ^ die).is_empty()
    # nothing is drawn (and exposed) twice
    assert area == sum(p.area2() for p in drawn.each())
    assert (
        check_plan(plan, PROCESS.rules).shapes > (made.diameters.diameter_um > 0).sum()
    )


@pytest.mark.parametrize(("shape", "classes"), [(Rectangle(0.55), 12), (U, 24)])
def test_turns_of_a_shape_that_repeats_after_half_a_turn_are_half_as_many(
    shape, classes
):
    """All turns in steps of 15 degrees."""
    made = lens(shape, rows=4, columns=6)
    grid = DiameterMap(
        np.full((4, 6), 0.24),
        0.4,
        angle_rad=np.radians(15.0 * np.arange(24)).reshape(4, 6),
    )
    rules = dataclasses.replace(PROCESS.rules, angle_step_deg=15.0)
    plan = build.plan(
        dataclasses.replace(made, diameters=grid),
        dataclasses.replace(PROCESS, rules=rules),
        furnished=False,
    )
    assert len(plan.classes) == classes
