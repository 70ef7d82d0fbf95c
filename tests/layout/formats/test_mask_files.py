"""GDSII and OASIS: what is written reads back the same, here and in KLayout; limits of
the formats are refused.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import layout
from layout.mask.plan import FigureCell, MaskPlan, PillarArray, PillarClass
from metalens.core.errors import MaskFileError, ProcessError
from tests.referees.mask_places import places

FORMS = [("gds", {}), ("oas", {})]
READ = {"gds": layout.read_gdsii, "oas": layout.read_oasis}


def write(plan, path, options):
    (layout.write_gdsii if path.suffix == ".gds" else layout.write_oasis)(
        plan, path, **options
    )
    return path


def klayout_sites(path, plan):
    """{cell: sorted (x, y)} of all placements of pillar cells below the top, as KLayout
    reads them.
    """
    db = pytest.importorskip("klayout.db")
    read = db.Layout()
    read.read(str(path))
    assert [cell.name for cell in read.top_cells()] == [plan.name]
    assert read.dbu == pytest.approx(plan.unit_nm * 1e-3, rel=1e-12)
    found = {}
    walk = read.top_cell().begin_instances_rec()
    pillars = {made.name for made in plan.classes}
    while not walk.at_end():
        name = read.cell(walk.inst_cell().cell_index()).name
        if name in pillars:
            for step in each_copy(walk.current_inst_element()):
                move = walk.trans() * step
                found.setdefault(name, []).append(
                    (round(move.disp.x), round(move.disp.y))
                )
        walk.next()
    return {name: sorted(places) for name, places in found.items()}, read


def each_copy(element):
    yield element.specific_cplx_trans()


def planned_sites(plan):
    found = {}
    for lattice in plan.lattices:
        for row, column in np.argwhere(lattice.whole() > 0):
            name = plan.classes[lattice.whole()[row, column] - 1].name
            place = (
                lattice.x0 + int(column) * lattice.pitch,
                lattice.y0 - int(row) * lattice.pitch,
            )
            found.setdefault(name, []).append(place)
    return {name: sorted(places) for name, places in found.items()}


@pytest.mark.parametrize(("suffix", "options"), FORMS)
def test_a_mask_reads_back_as_planned_and_klayout_agrees(
    plan, tmp_path, suffix, options
):
    path = write(plan, tmp_path / f"m.{suffix}", options)
    content = READ[suffix](path)
    outcome = layout.compare(plan, content)
    assert outcome.ok, outcome.differences
    assert outcome.pillars == np.count_nonzero(plan.lattices[0].whole())
    own = {
        k: sorted(zip(x.tolist(), y.tolist(), strict=True))
        for k, (x, y) in places(content, "LENS").items()
    }
    assert own == planned_sites(plan)
    seen, read = klayout_sites(path, plan)
    assert seen == planned_sites(plan)
    db = pytest.importorskip("klayout.db")
    for made in plan.classes:
        region = db.Region(read.cell(made.name).begin_shapes_rec(read.layer(1, 0)))
        assert region.area() == pytest.approx(np.pi * made.diameter_nm**2 / 4, rel=3e-3)


@settings(max_examples=40)
@given(
    classes=arrays.arrays(
        np.uint8,
        st.tuples(st.integers(1, 9), st.integers(1, 9)),
        elements=st.integers(0, 3),
    ),
    form=st.sampled_from(FORMS),
)
def test_any_small_map_survives_the_round_trip(make_plan, tmp_path, classes, form):
    plan = make_plan(classes, kinds=3)
    path = write(plan, tmp_path / f"m.{form[0]}", form[1])
    if classes.any():
        assert layout.compare(plan, READ[form[0]](path)).ok
    assert {k: len(x) for k, (x, _) in places(READ[form[0]](path), "LENS").items()} == {
        k: len(v) for k, v in planned_sites(plan).items()
    }


@pytest.mark.parametrize(("suffix", "options"), FORMS)
def test_row_blocks_give_the_same_file_as_the_whole_map(
    make_plan, tmp_path, suffix, options
):
    classes = np.random.default_rng(1).integers(0, 8, (1100, 130)).astype(np.uint8)
    plan = make_plan(classes)
    whole = plan.lattices[0]
    calls = []

    def rows(first, end):
        calls.append((first, end))
        return classes[first:end].copy()

    streamed = PillarArray(
        whole.name, whole.rows, whole.columns, whole.pitch, whole.x0, whole.y0, rows
    )
    one = write(plan, tmp_path / f"a.{suffix}", options).read_bytes()
    two = write(
        plan.replace(lattices=(streamed,)), tmp_path / f"b.{suffix}", options
    ).read_bytes()
    assert one == two
    assert calls


@pytest.mark.parametrize("count", [3000, pytest.param(65535, marks=pytest.mark.slow)])
def test_thousands_of_classes(tmp_path, count):
    outline = np.array(
        [
            [40, -20],
            [40, 20],
            [20, 40],
            [-20, 40],
            [-40, 20],
            [-40, -20],
            [-20, -40],
            [20, -40],
        ]
    )
    made = tuple(
        PillarClass(f"C{n:05}", 80.0, 80, (1, 0), outline) for n in range(count)
    )
    classes = np.arange(1, count + 1, dtype=np.uint16).reshape(15, -1)
    plan = MaskPlan(
        "TOP", made, (PillarArray.of("LENS", classes, pitch=400, x0=0, y0=0),)
    )
    for suffix in ("gds", "oas"):
        content = READ[suffix](write(plan, tmp_path / f"m.{suffix}", {}))
        assert layout.compare(plan, content).ok


def test_65536_classes_are_refused(plan):
    with pytest.raises(ProcessError, match="65536 pillar classes"):
        plan.replace(classes=plan.classes[:1] * 65536)


def test_coordinates_beyond_32_bit_are_refused():
    with pytest.raises(ProcessError, match="beyond 32 bits"):
        PillarArray.of(
            "LENS", np.ones((2, 3), np.uint8), pitch=400, x0=2**31 - 500, y0=0
        )
    with pytest.raises(ProcessError, match="beyond 32 bits"):
        FigureCell("F", {(1, 0): (np.array([[0, 0], [2**31, 0], [0, 5]]),)})


def test_polygons_beyond_8190_points_are_refused_by_gdsii_and_the_old_file_stays(
    plan, tmp_path
):
    angle = np.arange(8190) * 2 * np.pi / 8190
    ring = np.rint(1e6 * np.column_stack([np.cos(angle), np.sin(angle)])).astype(
        np.int64
    )
    path = tmp_path / "m.gds"
    path.write_bytes(b"old")
    with pytest.raises(ProcessError, match="8190 vertices"):
        layout.write_gdsii(
            plan.replace(figures=(FigureCell("BIG", {(2, 0): (ring,)}),)), path
        )
    assert path.read_bytes() == b"old"
    layout.write_gdsii(
        plan.replace(figures=(FigureCell("BIG", {(2, 0): (ring[:-1],)}),)), path
    )
    assert len(layout.read_gdsii(path).cells["BIG"].polygons[2, 0][0]) == 8189


def test_layers_beyond_gdsii_are_refused(plan, tmp_path):
    far = tuple(dataclasses.replace(made, layer=(40000, 0)) for made in plan.classes)
    with pytest.raises(ProcessError, match="32767"):
        layout.write_gdsii(plan.replace(classes=far), tmp_path / "m.gds")
    layout.write_oasis(plan.replace(classes=far), tmp_path / "m.oas")
    assert (40000, 0) in layout.read_oasis(tmp_path / "m.oas").cells[
        far[0].name
    ].polygons


@pytest.mark.parametrize("name", ["", "A B", "é", "x" * 33, "A/B", "a\nb"])
def test_illegal_names_are_refused_with_a_legal_one(plan, name):
    with pytest.raises(ProcessError, match="for example"):
        plan.replace(name=name)


def test_two_cells_of_one_name_are_refused(plan):
    with pytest.raises(ProcessError, match="two cells"):
        plan.replace(name=plan.classes[0].name)


def test_an_unwritable_target_is_an_os_error(plan, tmp_path):
    for suffix in ("gds", "oas"):
        with pytest.raises(OSError, match="nowhere"):
            write(plan, tmp_path / "nowhere" / f"m.{suffix}", {})


@pytest.mark.parametrize("suffix", ["gds", "oas"])
def test_a_file_cut_at_any_byte_is_refused_with_the_offset(make_plan, tmp_path, suffix):
    data = write(
        make_plan(np.ones((3, 4), np.uint8), kinds=2), tmp_path / f"m.{suffix}", {}
    ).read_bytes()
    cut = tmp_path / f"cut.{suffix}"
    for length in range(len(data)):
        cut.write_bytes(data[:length])
        with pytest.raises(MaskFileError, match=r"byte \d+"):
            READ[suffix](cut)


def test_a_wrong_checksum_is_found(plan, tmp_path):
    path = write(plan, tmp_path / "m.oas", {})
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(MaskFileError, match="checksum"):
        layout.read_oasis(path)


def test_a_moved_pillar_and_another_diameter_are_found(make_plan, tmp_path):
    plan = make_plan()
    path = write(plan, tmp_path / "m.gds", {})
    classes = plan.lattices[0].whole().copy()
    row, column = np.argwhere(classes == 1)[5]
    classes[row, column] = 2
    other = plan.replace(
        lattices=(PillarArray.of("LENS", classes, pitch=400, x0=-6000, y0=4400),)
    )
    place = f"at ({-6000 + 400 * column}, {4400 - 400 * row})"
    wrong = layout.compare(other, layout.read_gdsii(path)).differences
    assert [place in text for text in wrong] == [True, True]  # one class more, one less
    shifted = plan.replace(lattices=(dataclasses.replace(plan.lattices[0], x0=-5999),))
    assert (
        "not all at their places"
        in layout.compare(shifted, layout.read_gdsii(path)).differences[0]
    )


def test_klayout_reads_our_oasis_in_strict_mode(plan, tmp_path):
    db = pytest.importorskip("klayout.db")
    path = write(plan, tmp_path / "m.oas", {})
    options = db.LoadLayoutOptions()
    options.oasis_expect_strict_mode = 1
    read = db.Layout()
    read.read(str(path), options)
    assert {read.get_info(i).name for i in read.layer_indexes()} == {"pillar", "marks"}


def test_masks_of_klayout_are_read(tmp_path):
    db = pytest.importorskip("klayout.db")
    made = db.Layout()
    top, pillar = made.create_cell("TOP"), made.create_cell("PILLAR")
    layer = made.layer(7, 3)
    pillar.shapes(layer).insert(db.Box(-50, -40, 60, 70))
    pillar.shapes(layer).insert(
        db.Polygon([db.Point(0, 0), db.Point(10, 30), db.Point(40, 5)])
    )
    array = db.CellInstArray(
        pillar.cell_index(),
        db.Trans(1, False, 100, 200),
        db.Vector(400, 0),
        db.Vector(0, 500),
        3,
        2,
    )
    top.insert(array)
    top.shapes(layer).insert(db.Text("note", 5, 6))
    for suffix in ("gds", "oas"):
        made.write(str(tmp_path / f"k.{suffix}"))
        content = READ[suffix](tmp_path / f"k.{suffix}")
        assert content.tops == ["TOP"]
        assert len(content.cells["PILLAR"].polygons[7, 3]) == 2
        x, y = places(content, "TOP")["PILLAR"]
        assert sorted(zip(x.tolist(), y.tolist(), strict=True)) == [
            (100 + 400 * i, 200 + 500 * j) for i in range(3) for j in range(2)
        ]
        assert content.cells["TOP"].skipped["text"] == 1
