"""Meshes of pillars of one class, and of any number: triangles, places and colours by
hand.
"""

import json
import math
import struct

import numpy as np
import pytest

from layout.solid import mesh
from layout.solid.tile import Tile

X, Y = np.array([-3.1, 0.4, 7.7]), np.array([2.5, -11.25, 0.8])


def pillars(kind, foot=(0.24,), top=(0.19,)):
    return Tile(np.array(foot), np.array(top), X, Y, np.array(kind), 0.7, 0.4)


def facets_of(path):
    data = path.read_bytes()
    return np.frombuffer(data, mesh.STL, offset=84), struct.unpack("<I", data[80:84])[0]


def gltf_of(path):
    """(tree, binary part)."""
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_pillars_of_one_class_are_that_class_at_every_place(tmp_path):
    """Five sides are 2 x 5 triangles around and 2 x 3 at the ends; cones of equal areas
    have equal volumes.
    """
    total = mesh.write_stl(tmp_path / "a.stl", pillars([0, 0, 0]), sides=5)
    facets, said = facets_of(tmp_path / "a.stl")
    assert total == said == len(facets) == 3 * 16
    each = (
        facets["corners"].astype(float).reshape(3, 16, 3, 3)
        - np.stack([X, Y, 0 * X], 1)[:, None, None]
    )
    volume = (each[:, :, 0] * np.cross(each[:, :, 1], each[:, :, 2])).sum((1, 2)) / 6
    cone = math.pi * 0.7 / 12 * (0.24**2 + 0.24 * 0.19 + 0.19**2)
    assert volume == pytest.approx(
        np.full(3, cone), rel=1e-4
    )  # float32 at 11 um: 1e-6 of 0.2 um, along each edge
    assert np.abs(each - each[0]).max() < 2e-6  # the same shape, to float32 at 11 um


@pytest.mark.parametrize("chunk", [1, 2, 3])
def test_pieces_of_a_file_are_those_of_the_whole(tmp_path, monkeypatch, chunk):
    several = pillars([1, 0, 1], (0.24, 0.31), (0.19, 0.28))
    mesh.write_stl(tmp_path / "whole.stl", several)
    monkeypatch.setattr(mesh, "_CHUNK", chunk)
    mesh.write_stl(tmp_path / "pieces.stl", several)
    assert (tmp_path / "pieces.stl").read_bytes() == (
        tmp_path / "whole.stl"
    ).read_bytes()


@pytest.mark.parametrize(
    ("count", "colours"),
    [
        (1, [[0.525, 0.45, 0.575, 1]]),
        (2, [[0.15, 0.55, 0.9, 1], [0.9, 0.35, 0.25, 1]]),
        (3, [[0.15, 0.55, 0.9, 1], [0.525, 0.45, 0.575, 1], [0.9, 0.35, 0.25, 1]]),
    ],
)
def test_classes_are_coloured_from_blue_to_red_and_one_of_its_own_between(
    tmp_path, count, colours
):
    wide = 0.2 + 0.05 * np.arange(count)
    mesh.write_gltf(
        tmp_path / "a.glb", pillars([0, count - 1, 0], wide, wide - 0.02), sides=5
    )
    tree, _ = gltf_of(tmp_path / "a.glb")
    found = [each["pbrMetallicRoughness"] for each in tree["materials"]]
    assert [each["baseColorFactor"] for each in found] == pytest.approx(
        np.array(colours), abs=1e-9
    )
    assert {(each["metallicFactor"], each["roughnessFactor"]) for each in found} == {
        (0.1, 0.5)
    }
    assert [m["primitives"][0]["material"] for m in tree["meshes"]] == list(
        range(count)
    )
    assert [node["mesh"] for node in tree["nodes"][:-1]] == [0, count - 1, 0]
    assert tree["scenes"] == [{"nodes": [3]}]
    assert tree["nodes"][3]["children"] == [0, 1, 2]


def test_every_mesh_of_a_gltf_lies_where_its_views_say_with_unit_normals_outwards(
    tmp_path,
):
    """Of unlike classes one after the other: corners as the frustums have them, x, z,
    -y in metres.
    """
    sizes = ((0.24, 0.19), (0.31, 0.28))
    mesh.write_gltf(
        tmp_path / "a.glb", pillars([0, 1, 0], *zip(*sizes, strict=True)), sides=7
    )
    tree, raw = gltf_of(tmp_path / "a.glb")
    assert tree["buffers"] == [{"byteLength": len(raw)}]
    for n, (foot, top) in enumerate(sizes):
        plain = mesh.frustum(foot, top, 0.7, sides=7)
        corners = 1e-6 * plain.vertices_um[plain.triangles].reshape(-1, 3)
        parts = {}
        for name, at in tree["meshes"][n]["primitives"][0]["attributes"].items():
            about = tree["accessors"][at]
            view = tree["bufferViews"][about["bufferView"]]
            data = raw[view["byteOffset"] :][: view["byteLength"]]
            parts[name] = np.frombuffer(data, "<f4").reshape(-1, 3).astype(float)
            assert (about["count"], about["componentType"], about["type"]) == (
                len(parts[name]),
                5126,
                "VEC3",
            )
        want = np.column_stack([corners[:, 0], corners[:, 2], -corners[:, 1]])
        assert parts["POSITION"] == pytest.approx(want, abs=1e-13)  # float32 of 1e-6 m
        about = tree["accessors"][
            tree["meshes"][n]["primitives"][0]["attributes"]["POSITION"]
        ]
        assert [about["min"], about["max"]] == pytest.approx(
            np.array([want.min(0), want.max(0)]), abs=1e-13
        )
        assert np.linalg.norm(parts["NORMAL"], axis=1) == pytest.approx(
            np.ones(len(want)), abs=1e-6
        )
        middle = np.array(
            [0, 0.35e-6, 0]
        )  # of a convex body: every face is seen from without
        assert ((want - middle) * parts["NORMAL"]).sum(1).min() > 0


@pytest.mark.parametrize("sides", [3, 5, 8])
def test_a_frustum_has_flats_towards_x_and_the_areas_of_its_circles(sides):
    """Corners at half steps of the turn; n/2 sin(2π/n) R² is π d²/4."""
    made = mesh.frustum(0.3, 0.2, 0.7, sides=sides)
    turn = 2 * math.pi * (np.arange(sides) + 0.5) / sides
    for part, d, z in (
        (made.vertices_um[:sides], 0.3, 0.0),
        (made.vertices_um[sides:], 0.2, 0.7),
    ):
        reach = d / 2 * math.sqrt(math.pi / (sides / 2 * math.sin(2 * math.pi / sides)))
        want = np.column_stack(
            [reach * np.cos(turn), reach * np.sin(turn), np.full(sides, z)]
        )
        assert part == pytest.approx(want, abs=1e-12)
    assert mesh.volume_um3(made) == pytest.approx(
        math.pi * 0.7 / 12 * (0.09 + 0.06 + 0.04), rel=1e-12
    )
    assert len(made.triangles) == 4 * sides - 4


@pytest.mark.parametrize("name", range(4))
def test_a_gltf_is_as_long_as_its_header_says_in_whole_words(tmp_path, name):
    """Of texts of unlike lengths: filled with blanks to four bytes; two chunks, each
    with its length and kind.
    """
    several = pillars([0, 1, 0], (0.24 + 1e-4 * 10**name, 0.31), (0.19, 0.28))
    mesh.write_gltf(tmp_path / "a.glb", several, sides=3 + name)
    data = (tmp_path / "a.glb").read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    length, kind = struct.unpack("<I4s", data[12:20])
    assert (length % 4, kind) == (0, b"JSON")
    text = data[20 : 20 + length]
    assert len(text) - len(text.rstrip(b" ")) < 4
    rest, kind = struct.unpack("<I4s", data[20 + length : 28 + length])
    assert (rest, kind) == (len(data) - 28 - length, b"BIN\0")
    tree = json.loads(text)
    assert [view["buffer"] for view in tree["bufferViews"]] == [0] * 4
    assert tree["scene"] == 0
    places = [node["translation"] for node in tree["nodes"][:-1]]
    assert np.array(places) == pytest.approx(
        np.column_stack([1e-6 * X, 0 * X, -1e-6 * Y]), rel=1e-12
    )
