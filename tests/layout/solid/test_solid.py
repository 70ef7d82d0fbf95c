"""Solids: closed surfaces checked twice, instances shared, labels, colours and places
kept through STEP.
"""

import json
import math
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile

import numpy as np
import pytest

from layout.files.dxf import Window
from layout.process.process import Etch, Process
from layout.solid import files as solid_files
from layout.solid import mesh as solid_mesh
from layout.solid import module
from layout.solid import step as solid_step
from layout.solid import verbs as solid
from layout.solid.mesh import Mesh
from metalens.cell.record import Cell
from metalens.ground.errors import ProcessError
from metalens.lens.record import DiameterMap, Lens
from metalens.made import Bias
from metalens.pillars.proxy import Proxy

PROXY = Proxy(
    np.array([[3.0, 3.0]]), np.array([[0.9]]), (0.1, 0.3), (0.85, 0.85), 0.0, 0.0
)
TILTED = Process(etch=Etch(sidewall_deg=1.0))


def lens(ny=14, nx=11):
    rng = np.random.default_rng(0)
    diameter = rng.choice([0.0, 0.12, 0.2, 0.26], (ny, nx))
    diameter[0, 0], diameter[ny - 1, nx - 1] = 0.12, 0.26
    return Lens(
        DiameterMap(diameter, 0.4), Cell(0.4), PROXY, 0.85, 100.0, 1000.0, "random"
    )


def stl(path):
    data = path.read_bytes()
    return np.frombuffer(data[84:], solid_mesh.STL), struct.unpack("<I", data[80:84])[0]


def test_a_tile_holds_the_pillars_of_its_square_with_tilted_walls():
    whole = solid.tile(lens(), TILTED)
    d = lens().diameters
    assert len(whole.kind) == (d.diameter_um > 0).sum()
    lean = 0.7 * math.tan(math.radians(1))
    assert whole.foot_um - whole.top_um == pytest.approx(np.full(3, 2 * lean))
    assert (whole.foot_um + whole.top_um) / 2 == pytest.approx(
        [0.12, 0.2, 0.26], abs=1e-5
    )  # corners: 3e-6
    part = solid.tile(lens(), TILTED, side_um=1.6, centre_um=(0.4, 1.0))
    inside = (
        (abs(d.x_um - 0.4) <= 0.8 + 1e-6)
        & (abs(d.y_um[:, None] - 1.0) <= 0.8 + 1e-6)
        & (d.diameter_um > 0)
    )
    assert len(part.kind) == inside.sum()
    rows, columns = np.nonzero(inside)
    assert part.y_um == pytest.approx(d.y_um[rows])
    assert part.x_um == pytest.approx(d.x_um[columns])


def test_a_frustum_has_the_volume_of_its_cone_and_manifold3d_takes_it():
    manifold3d = pytest.importorskip("manifold3d")
    mesh = solid_mesh.frustum(0.3, 0.2, 0.7, sides=8)
    want = (
        math.pi * 0.7 / 12 * (0.3**2 + 0.3 * 0.2 + 0.2**2)
    )  # equal areas at foot and top: equal volume
    assert solid_mesh.volume_um3(mesh) == pytest.approx(want, rel=1e-12)
    body = manifold3d.Manifold(
        manifold3d.Mesh64(mesh.vertices_um, mesh.triangles.astype(np.uint64))
        if hasattr(manifold3d, "Mesh64")
        else manifold3d.Mesh(
            mesh.vertices_um.astype(np.float32), mesh.triangles.astype(np.uint32)
        )
    )
    assert body.status() == manifold3d.Error.NoError
    assert body.volume() == pytest.approx(want, rel=1e-5)


def test_a_continuous_design_becomes_few_classes_of_made_pillars():
    rng = np.random.default_rng(1)
    many = Lens(
        DiameterMap(rng.uniform(0.1, 0.2, (60, 60)), 0.4),
        Cell(0.4),
        PROXY,
        0.85,
        100.0,
        1000.0,
        "map",
    )
    biased = Process(bias=Bias(table_nm=((80.0, -6.0), (300.0, 1.0))))
    pillars = solid.tile(many, biased)
    assert len(pillars.names) <= 52
    made = (pillars.foot_um + pillars.top_um)[pillars.kind] / 2
    assert (
        abs(made - many.diameters.diameter_um.ravel()).max() < 1.05e-3
    )  # half a step of 2 nm, times 1 + slope of the bias


@pytest.mark.parametrize("damage", ["hole", "flip", "double", "inside out"])
def test_a_damaged_surface_is_refused(damage):
    mesh = solid_mesh.frustum(0.3, 0.2, 0.7)
    faces = {
        "hole": mesh.triangles[1:],
        "flip": np.concatenate([mesh.triangles[:1, ::-1], mesh.triangles[1:]]),
        "double": np.concatenate([mesh.triangles, mesh.triangles[:1]]),
        "inside out": mesh.triangles[:, ::-1],
    }
    with pytest.raises(ProcessError, match=r"not closed|inside out"):
        solid_mesh.check_watertight(Mesh(mesh.vertices_um, faces[damage]))


def test_stl_holds_every_pillar_in_its_place_and_all_volume(tmp_path):
    pillars = solid.tile(lens(), TILTED)
    total = solid_mesh.write_stl(tmp_path / "tile.stl", pillars)
    facets, said = stl(tmp_path / "tile.stl")
    assert said == total == len(facets) == 28 * len(pillars.kind)
    corners = facets["corners"].astype(float)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    volume = (a * np.cross(b, c)).sum() / 6
    cones = (
        math.pi
        * 0.7
        / 12
        * (pillars.foot_um**2 + pillars.foot_um * pillars.top_um + pillars.top_um**2)
    )
    assert volume == pytest.approx(cones[pillars.kind].sum(), rel=1e-5)  # float32
    middles = corners.reshape(len(pillars.kind), -1, 3)
    assert np.ptp(middles[..., 2], axis=1) == pytest.approx(
        np.full(len(pillars.kind), 0.7)
    )
    assert (middles[..., 0].max(1) + middles[..., 0].min(1)) / 2 == pytest.approx(
        pillars.x_um, abs=1e-6
    )
    assert (middles[..., 1].max(1) + middles[..., 1].min(1)) / 2 == pytest.approx(
        pillars.y_um, abs=1e-6
    )
    normal = np.cross(b - a, c - a)
    assert (facets["normal"] * normal).sum(1) == pytest.approx(
        np.linalg.norm(normal, axis=1), rel=1e-4
    )


def test_3mf_places_one_object_a_class_and_repeats_itself(tmp_path):
    pillars = solid.tile(lens(), TILTED)
    solid_mesh.write_3mf(tmp_path / "a.3mf", pillars)
    solid_mesh.write_3mf(tmp_path / "b.3mf", pillars)
    assert (tmp_path / "a.3mf").read_bytes() == (tmp_path / "b.3mf").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.3mf") as file:
        root = ElementTree.fromstring(file.read("3D/3dmodel.model"))
    space = {"m": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"}
    assert root.attrib["unit"] == "micron"
    objects = root.findall("m:resources/m:object", space)
    assert [each.attrib["name"] for each in objects] == [
        "pillar_120nm",
        "pillar_200nm",
        "pillar_260nm",
    ]
    items = root.findall("m:build/m:item", space)
    assert len(items) == len(pillars.kind)
    last = [float(v) for v in items[-1].attrib["transform"].split()]
    assert last[9:11] == pytest.approx([pillars.x_um[-1], pillars.y_um[-1]])
    assert items[-1].attrib["objectid"] == str(pillars.kind[-1] + 1)


def test_gltf_is_one_mesh_a_class_and_one_node_a_pillar(tmp_path):
    pillars = solid.tile(lens(), TILTED)
    solid_mesh.write_gltf(tmp_path / "tile.glb", pillars)
    data = (tmp_path / "tile.glb").read_bytes()
    magic, version, size = struct.unpack("<4sII", data[:12])
    assert (magic, version, size) == (b"glTF", 2, len(data))
    length = struct.unpack("<I", data[12:16])[0]
    tree = json.loads(data[20 : 20 + length])
    assert len(tree["meshes"]) == 3
    assert len(tree["nodes"]) == len(pillars.kind) + 1
    place = tree["nodes"][5]["translation"]
    assert place == pytest.approx(
        [1e-6 * pillars.x_um[5], 0, -1e-6 * pillars.y_um[5]]
    )  # metres
    view = tree["bufferViews"][tree["accessors"][0]["bufferView"]]
    start = 28 + length + view["byteOffset"]
    points = np.frombuffer(data[start : start + view["byteLength"]], "<f4").reshape(
        -1, 3
    )
    a, b, c = (
        points[::3].astype(float),
        points[1::3].astype(float),
        points[2::3].astype(float),
    )
    assert (
        a * np.cross(b, c)
    ).sum() / 6 > 0  # still right side out after the axes were turned
    assert points[:, 1].max() == pytest.approx(0.7e-6)
    assert points.max(0).tolist() == pytest.approx(tree["accessors"][0]["max"])


def test_step_of_a_tile_shares_its_pillars_and_keeps_labels_places_and_sizes(tmp_path):
    build123d = pytest.importorskip("build123d")
    pillars = solid.tile(lens(5, 4), TILTED)
    path = tmp_path / "tile.step"
    solid_step.write_step(path, pillars)
    first = path.read_bytes()
    solid_step.write_step(path, pillars)
    assert path.read_bytes() == first
    assert (
        len(re.findall(rb"CONICAL_SURFACE", first)) == 3
    )  # one for each class, however many pillars
    found = build123d.import_step(path)
    assert found.label.replace("_", " ") == "metalens tile"
    assert len(found.children) == len(pillars.kind) + 1
    slab = found.children[
        0
    ].bounding_box()  # half a pitch wider than the sites on every side, 1 um thick
    half = pillars.pitch_um / 2
    low = pillars.x_um.min() - half, pillars.y_um.min() - half, -1.0
    high = pillars.x_um.max() + half, pillars.y_um.max() + half, 0.0
    assert pytest.approx([v * 1e-3 for v in (*low, *high)], abs=1e-9) == [
        *slab.min,
        *slab.max,
    ]
    order = np.argsort(pillars.kind, kind="stable")
    sites = zip(
        pillars.kind[order], pillars.x_um[order], pillars.y_um[order], strict=True
    )
    for part, (kind, x, y) in zip(found.children[1:], sites, strict=True):
        assert part.label == pillars.names[kind]
        box = part.bounding_box()
        assert pytest.approx((x * 1e-3, y * 1e-3), abs=1e-9) == (
            box.center().X,
            box.center().Y,
        )  # mm
        assert pytest.approx(pillars.foot_um[kind] * 1e-3, rel=1e-3) == box.size.X
        assert pytest.approx([0, 7e-4], abs=1e-9) == [box.min.Z, box.max.Z]
        assert tuple(part.color)[:3] == pytest.approx((0.25, 0.35, 0.75), abs=0.01)


def test_upright_pillars_are_cylinders_in_step(tmp_path):
    pytest.importorskip("build123d")
    solid_step.write_step(tmp_path / "tile.step", solid.tile(lens(3, 3), Process()))
    assert b"CYLINDRICAL_SURFACE" in (tmp_path / "tile.step").read_bytes()


def test_the_module_is_3_5_mm_and_comes_back_with_labels_colours_and_places(tmp_path):
    build123d = pytest.importorskip("build123d")
    path = tmp_path / "module.step"
    checked = module.write_module(path, module.Module())
    first = path.read_bytes()
    module.write_module(path, module.Module())
    assert path.read_bytes() == first
    found = {part.label: part for part in build123d.import_step(path).children}
    assert list(found) == list(module.COLOURS)
    for name, colour in module.COLOURS.items():
        assert tuple(found[name].color)[:3] == pytest.approx(colour[:3], abs=1e-6)
    ends = {
        name: (part.bounding_box().min.Z, part.bounding_box().max.Z)
        for name, part in found.items()
    }
    assert max(e[1] for e in ends.values()) - min(
        e[0] for e in ends.values()
    ) == pytest.approx(3.5)
    assert ends["nir_filter"] == pytest.approx((-0.8, -0.3))
    assert ends["die"] == pytest.approx((-0.3, 0), abs=1e-9)
    assert ends["sensor"] == pytest.approx((2.0, 2.5))
    assert ends["flex"] == pytest.approx((2.5, 2.7))
    assert max(part.bounding_box().size.X for part in found.values()) < 2
    gap = {(each.first, each.second): each.distance_mm for each in checked}
    assert gap["mount", "sensor"] == pytest.approx(0.02)
    assert gap["metalens", "sensor"] == pytest.approx(2.0 - 0.0007)
    assert gap["die", "sensor"] == pytest.approx(2.0)
    assert len(checked) == 7 * 6 / 2


def test_a_cut_takes_a_quarter_out_and_leaves_out_what_stands_in_it():
    build123d = pytest.importorskip("build123d")
    whole = build123d.Box(2, 3, 1)
    assert module._without_quarter(whole).volume == pytest.approx(0.75 * 6)
    assert (
        module._without_quarter(build123d.Pos(2, -1, 0) * build123d.Box(1, 1, 1))
        is None
    )  # to +x, -y
    assert module._without_quarter(
        build123d.Pos(2, 1, 0) * build123d.Box(1, 1, 1)
    ).volume == pytest.approx(1)


def test_colliding_parts_are_refused():
    build123d = pytest.importorskip("build123d")
    a, b = build123d.Box(1, 1, 1), build123d.Pos(0.9, 0, 0) * build123d.Box(1, 1, 1)
    a.label, b.label = "left", "right"
    with pytest.raises(ProcessError, match="left and right collide"):
        module.clearances(build123d.Compound(children=[a, b]))


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"spacing_mm": 0.0}, "spacing_mm"),
        ({"die_side_mm": 1.85}, "die_side_mm"),
        ({"aperture_mm": 1.4}, "aperture_mm"),
        ({"ledge_mm": 2.5}, "ledge_mm"),
        ({"flex_mm": math.nan}, "flex_mm"),
    ],
)
def test_an_impossible_module_is_refused(sizes, words):
    with pytest.raises(ProcessError, match=words):
        module.Module(**sizes)


def test_the_picture_of_the_module_is_a_png():
    pytest.importorskip("build123d")
    assert module.picture(module.Module())[:8] == b"\x89PNG\r\n\x1a\n"


def test_too_many_pillars_are_refused_with_a_square_that_would_do(tmp_path):
    full = Lens(
        DiameterMap(np.full((120, 120), 0.2), 0.4),
        Cell(0.4),
        PROXY,
        0.85,
        100.0,
        1000.0,
        "map",
    )
    pillars = solid.tile(full, TILTED)
    with pytest.raises(ProcessError, match=r"14,400 pillars.*side_um = 39.6"):
        solid_step.write_step(tmp_path / "tile.step", pillars)
    assert not list(tmp_path.iterdir())
    solid.check_count(solid.tile(full, TILTED, side_um=39.6), "STEP")


def test_walls_that_leave_no_top_or_no_gap_are_refused():
    with pytest.raises(ProcessError, match="need above 0 and below the pitch"):
        solid.tile(lens(), Process(etch=Etch(sidewall_deg=10.5)))
    with pytest.raises(ProcessError, match="no pillar"):
        solid.tile(lens(), Process(), side_um=1.0, centre_um=(50.0, 0.0))
    with pytest.raises(ProcessError, match="3 or more"):
        solid_mesh.frustum(0.2, 0.2, 0.7, sides=2)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    target = tmp_path / "tile.stl"
    target.write_text("old", encoding="utf-8")
    pillars = solid.tile(lens(), TILTED)
    with pytest.raises(OSError):  # noqa: PT011 - the kernel's own error, whatever it says
        solid_mesh.write_stl(tmp_path / "absent" / "tile.stl", pillars)
    with pytest.raises(ProcessError):
        solid_mesh.write_stl(target, pillars, sides=2)
    assert target.read_text(encoding="utf-8") == "old"


def test_a_module_is_built_around_any_lens():
    pytest.importorskip("build123d")
    wide = DiameterMap(np.full((1, 9001), 0.2), 0.4)
    big = Lens(wide, Cell(0.4, height_um=0.9), PROXY, 0.85, 5000.0, 20000.0, "map")
    made = module.around(big, TILTED)
    assert made.aperture_mm == pytest.approx(3.6004)
    assert made.spacing_mm == 5.0
    assert made.height_mm == pytest.approx(9e-4)
    module.clearances(module.assemble(made))
    close = Lens(lens().diameters, Cell(0.4), PROXY, 0.85, 100.0, 20000.0, "map")
    module.clearances(module.assemble(module.around(close, TILTED)))


def test_files_of_a_window_of_a_lens(tmp_path):
    pytest.importorskip("build123d")
    window = Window(0.4, 0.6, 1.2)
    made = solid_files.write_stl(
        lens(), TILTED, tmp_path, window
    ) + solid_files.write_step(lens(), TILTED, tmp_path, window)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        path.name for path in made
    )
    corners = stl(tmp_path / "pillars.stl")[0]["corners"]
    assert 0.4 < corners[..., 1].mean() < 0.8  # +y up, as in the mask
    with pytest.raises(ProcessError, match="no pillar"):
        solid_files.write_step(lens(), TILTED, tmp_path, Window(90.0, 0.0, 0.1))


FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from layout.solid import verbs as solid
from layout.solid.tile import Tile
from metalens.ground.errors import ProcessError
folder = Path(sys.argv[1])
x = np.arange(400) * 0.4
pillars = Tile(np.full(1, 0.2), np.full(1, 0.18), x, x, np.zeros(400, int), 0.7, 0.4)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for name, write in (("a.stl", solid.write_stl), ("a.glb", solid.write_gltf), ("a.step", solid.write_step)):
    (folder / name).write_text("old")
    try:
        write(folder / name, pillars)
    except (OSError, ProcessError):
        print(name, (folder / name).read_text(), len(list(folder.iterdir())))
        (folder / name).unlink()
"""


def test_a_full_disk_in_the_middle_leaves_the_old_file_and_nothing_else(tmp_path):
    pytest.importorskip("build123d")
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split("\n")[:3] == ["a.stl old 1", "a.glb old 1", "a.step old 1"]


def test_colours_stay_with_their_solids_wherever_these_lie_in_memory(tmp_path):
    build123d = pytest.importorskip("build123d")
    colours = [
        (0.75, 0.85, 0.95),
        (0.25, 0.35, 0.75),
        (0.9, 0.1, 0.2),
        (0.25, 0.35, 0.75),
        (0.3, 0.31, 0.0),
    ]
    made, kept = [], []
    for turn in range(4):
        pieces = []
        for k in (
            np.random.default_rng(turn).permutation(5).tolist()
        ):  # other addresses each time
            kept.append(build123d.Solid.make_box(1 + k, 2, 3))
            pieces.append(
                (
                    k,
                    solid_step.Piece(
                        f"p{k}",
                        kept[-1].wrapped,
                        colours[k],
                        [(9.0 * k, 0, 0), (0, 5.0 * k, 1)],
                    ),
                )
            )
        pieces.sort(key=lambda piece: piece[0])
        solid_step.write_pieces(
            tmp_path / "a.step", "all", [piece for _, piece in pieces], unit_m=1e-3
        )
        made.append((tmp_path / "a.step").read_bytes())
    assert len(set(made)) == 1
    assert made[0].count(b"COLOUR_RGB") == 4  # one for each colour
    found = [
        (part.label, tuple(part.color)[:3])
        for part in build123d.import_step(tmp_path / "a.step").children
    ]
    assert len(found) == 10
    for label, colour in found:
        assert colour == pytest.approx(colours[int(label[1])], abs=1e-6)
