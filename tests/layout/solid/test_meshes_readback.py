"""3MF and glTF read back: whole as they were written, and each thing that is missing,
moved or thinner is told.

The files themselves are read by strangers: lib3mf, the format's own library, and the
glTF reader of the CAD kernel.
"""

import dataclasses
import json
import math
import re
import struct
import zipfile

import numpy as np
import pytest

from layout.solid import mesh
from layout.solid.readback_meshes import differences_3mf, differences_gltf
from tests.layout.solid.test_solid_readback import tile

PILLARS = tile()
FIRST, SECOND = PILLARS.names


def edited(path, pattern, text):
    """The 3MF with the first match of a pattern in its model replaced."""
    with zipfile.ZipFile(path) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    found = parts["3D/3dmodel.model"].decode()
    changed = re.sub(pattern, text, found, count=1)
    assert changed != found
    with zipfile.ZipFile(path, "w") as file:
        for name, data in parts.items():
            file.writestr(name, changed if name == "3D/3dmodel.model" else data)


@pytest.mark.parametrize(
    ("pattern", "text", "told"),
    [
        ('unit="micron"', 'unit="millimeter"', "planned 0 to 0.7"),
        (r"<item [^>]*/>", "", "copies, planned"),
        (r"0 0 1 31 ", "0 0 1 31.001 ", "a copy stands 0.001 um off its place"),
        ("1 0 0 0 1", "0 1 0 -1 0", "a copy is turned or scaled"),
        (r"<triangle [^>]*/>", "", "its surface is not closed"),
        ('z="0.7"', 'z="0.69"', "planned"),
        (
            f'name="{FIRST}"',
            'name="pillar_7nm"',
            "meshes that were not planned: pillar_7nm",
        ),
        ("</model>", "", "it cannot be read as 3MF"),
        (r'<vertex x="0\.0', '<vertex x="0.1', "corners of its foot lie"),
    ],
)
def test_3mf_is_whole_and_every_damage_is_told(tmp_path, pattern, text, told):
    path = tmp_path / "a.3mf"
    mesh.write_3mf(path, PILLARS)
    assert differences_3mf(path, PILLARS) == ()
    edited(path, pattern, text)
    assert any(told in line for line in differences_3mf(path, PILLARS)), (
        differences_3mf(path, PILLARS)
    )


def test_how_far_corners_lie_is_told_from_the_nearest_to_the_farthest(tmp_path):
    """One corner of the foot of the first class drawn in to half its way: read from the
    file's own words.
    """
    path = tmp_path / "a.3mf"
    mesh.write_3mf(path, PILLARS)
    with zipfile.ZipFile(path) as file:
        first = file.read("3D/3dmodel.model").decode().partition("</object>")[0]
    x, y = (
        float(v) for v in re.findall(r'<vertex x="([^"]*)" y="([^"]*)" z="0"', first)[0]
    )
    edited(
        path,
        r'<vertex x="[^"]*" y="[^"]*" z="0"',
        f'<vertex x="{x / 2!r}" y="{y / 2!r}" z="0"',
    )
    (told,) = (
        line
        for line in differences_3mf(path, PILLARS)
        if "corners of its foot lie" in line
    )
    low, high = (float(v) for v in re.search(r"lie (\S+) to (\S+) um", told).groups())
    assert low == pytest.approx(math.hypot(x, y) / 2, rel=1e-5)  # six digits
    assert high == pytest.approx(
        math.hypot(x, y), rel=0.02
    )  # the others of a round outline


@pytest.mark.parametrize(
    ("unit", "um"),
    [
        ("micron", 1),
        ("millimeter", 1e3),
        ("centimeter", 1e4),
        ("meter", 1e6),
        ("inch", 25.4e3),
        ("foot", 12 * 25.4e3),
    ],
)
def test_3mf_in_any_unit_of_the_format_is_the_same(tmp_path, unit, um):
    path = tmp_path / "a.3mf"
    mesh.write_3mf(path, PILLARS)
    with zipfile.ZipFile(path) as file:
        model = file.read("3D/3dmodel.model").decode()

    def shorter(numbers):
        return " ".join(repr(float(n) / um) for n in numbers.split())

    model = model.replace('unit="micron"', f'unit="{unit}"')
    model = re.sub(r' ([xyz])="([^"]*)"', lambda m: f' {m[1]}="{shorter(m[2])}"', model)
    model = re.sub(
        r'(transform="1 0 0 0 1 0 0 0 1) ([^"]*)"',
        lambda m: f'{m[1]} {shorter(m[2])}"',
        model,
    )
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("3D/3dmodel.model", model)
    assert differences_3mf(path, PILLARS) == ()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (dict(height_um=0.7 * (1 + 4e-6)), ""),  # six digits hold 5e-6 of a number
        (dict(height_um=0.7 * (1 + 6e-6)), "high, planned 0 to 0.7"),
        (dict(height_um=0.7 * (1 + 16e-6)), "volume"),  # a volume is of three
        (dict(foot_um=PILLARS.foot_um * (1 + 1e-5)), ""),
        (
            dict(foot_um=PILLARS.top_um, top_um=PILLARS.foot_um),
            "corners of its foot lie",
        ),  # upside down: 1.25 wider
        (dict(x_um=PILLARS.x_um + 0.8e-4), ""),
        (dict(x_um=PILLARS.x_um + 1.2e-4), "a copy stands 0.00012 um off its place"),
    ],
)
def test_a_plan_that_differs_by_more_than_the_digits_of_the_file_is_told(
    tmp_path, change, told
):
    path = tmp_path / "a.3mf"
    mesh.write_3mf(path, PILLARS)
    found = differences_3mf(path, dataclasses.replace(PILLARS, **change))
    assert any(told in line for line in found) if told else found == ()


def rewritten(path, edit):
    """The glTF with its tree and its buffer as ``edit`` leaves them."""
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    tree, buffer = json.loads(data[20 : 20 + size]), bytearray(data[28 + size :])
    edit(tree, np.frombuffer(buffer, "<f4"))
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(buffer), b"BIN\0")
        + buffer
    )
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def moved(tree, buffer):
    tree["nodes"][3]["translation"][2] += 2e-9


def lost(tree, buffer):
    tree["nodes"][-1]["children"].pop()


def doubled(tree, buffer):
    one, two = np.flatnonzero(PILLARS.kind == 0)[:2].tolist()
    tree["nodes"][two]["translation"] = tree["nodes"][one]["translation"]


def in_um(tree, buffer):
    buffer *= 1e6


def one_corner(tree, buffer):
    buffer[0] *= 1.001


def scaled(tree, buffer):
    tree["nodes"][0]["scale"] = [1, 1, 2]


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (moved, "a copy stands 0.002 um off its place"),
        (lost, "copies, planned"),
        (doubled, "a copy stands inf um off its place"),
        (in_um, "planned 0 to 0.7"),
        (one_corner, "corners of its"),
        (scaled, "a node is turned, scaled"),
    ],
)
def test_gltf_is_whole_and_every_damage_is_told(tmp_path, edit, told):
    path = tmp_path / "a.glb"
    mesh.write_gltf(path, PILLARS)
    assert differences_gltf(path, PILLARS) == ()
    rewritten(path, lambda tree, buffer: None)
    assert differences_gltf(path, PILLARS) == ()
    rewritten(path, edit)
    assert any(told in line for line in differences_gltf(path, PILLARS)), (
        differences_gltf(path, PILLARS)
    )
    path.write_bytes(path.read_bytes()[:-4])
    assert "it cannot be read as glTF" in differences_gltf(path, PILLARS)[0]


def planned_volumes():
    radii = PILLARS.foot_um / 2, PILLARS.top_um / 2
    return np.pi * 0.7 / 3 * (radii[0] ** 2 + radii[0] * radii[1] + radii[1] ** 2)


def test_the_reference_library_of_3mf_finds_the_same(tmp_path):
    lib3mf = pytest.importorskip("lib3mf")
    path = tmp_path / "a.3mf"
    mesh.write_3mf(path, PILLARS)
    model = lib3mf.Wrapper().CreateModel()
    model.QueryReader("3mf").ReadFromFile(str(path))
    assert model.GetUnit() == lib3mf.ModelUnit.MicroMeter
    found, items = {FIRST: [], SECOND: []}, model.GetBuildItems()
    volumes = {}
    while items.MoveNext():
        item = items.GetCurrent()
        each = item.GetObjectResource()
        found[each.GetName()].append(tuple(item.GetObjectTransform().Fields[3]))
        if each.GetName() not in volumes:
            assert each.IsManifoldAndOriented()
            corners = np.array([v.Coordinates for v in each.GetVertices()], float)
            a, b, c = corners[
                np.array([t.Indices for t in each.GetTriangleIndices()])
            ].transpose(1, 0, 2)
            volumes[each.GetName()] = (a * np.cross(b, c)).sum() / 6
    assert [volumes[FIRST], volumes[SECOND]] == pytest.approx(
        planned_volumes(), rel=1e-5
    )  # six digits
    for kind, name in enumerate(PILLARS.names):
        here = PILLARS.kind == kind
        want = np.column_stack(
            [PILLARS.x_um[here], PILLARS.y_um[here], np.zeros(here.sum())]
        )
        assert np.array(found[name]) == pytest.approx(
            want, abs=5e-6
        )  # float32 at 50 um


def test_the_cad_kernel_finds_the_gltf_in_its_place_and_size(tmp_path):
    pytest.importorskip("OCP")
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib
    from OCP.Message import Message_ProgressRange
    from OCP.RWGltf import RWGltf_CafReader
    from OCP.RWMesh import RWMesh_CoordinateSystem
    from OCP.TCollection import TCollection_AsciiString

    path = tmp_path / "a.glb"
    mesh.write_gltf(path, PILLARS)
    reader = RWGltf_CafReader()
    reader.SetSystemLengthUnit(1e-6)
    reader.SetSystemCoordinateSystem(
        RWMesh_CoordinateSystem.RWMesh_CoordinateSystem_Zup
    )
    assert reader.Perform(TCollection_AsciiString(str(path)), Message_ProgressRange())
    box = Bnd_Box()
    BRepBndLib.Add_s(reader.SingleShape(), box)
    box.SetGap(0.0)
    low, high = box.CornerMin(), box.CornerMax()
    reach = PILLARS.foot_um[PILLARS.kind] / 2
    want = (
        [(v - reach).min() for v in (PILLARS.x_um, PILLARS.y_um)],
        [(v + reach).max() for v in (PILLARS.x_um, PILLARS.y_um)],
    )
    assert [low.X(), low.Y(), low.Z()] == pytest.approx(
        [*want[0], 0.0], abs=1e-3
    )  # the polygon's corners reach 0.995 to 1.004
    assert [high.X(), high.Y(), high.Z()] == pytest.approx([*want[1], 0.7], abs=1e-3)
