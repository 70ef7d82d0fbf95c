"""Meshes of pillars of one class, and of any number: triangles, places and colours by hand."""

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
    """Five sides are 2 x 5 triangles around and 2 x 3 at the ends; cones of equal areas have equal volumes."""
    total = mesh.write_stl(tmp_path / "a.stl", pillars([0, 0, 0]), sides=5)
    facets, said = facets_of(tmp_path / "a.stl")
    assert total == said == len(facets) == 3 * 16
    each = facets["corners"].astype(float).reshape(3, 16, 3, 3) - np.stack([X, Y, 0 * X], 1)[:, None, None]
    volume = (each[:, :, 0] * np.cross(each[:, :, 1], each[:, :, 2])).sum((1, 2)) / 6
    cone = math.pi * 0.7 / 12 * (0.24**2 + 0.24 * 0.19 + 0.19**2)
    assert volume == pytest.approx(np.full(3, cone), rel=1e-4)  # float32 at 11 um: 1e-6 of 0.2 um, along each edge
    assert np.abs(each - each[0]).max() < 2e-6  # the same shape, to float32 at 11 um


@pytest.mark.parametrize("chunk", [1, 2, 3])
def test_pieces_of_a_file_are_those_of_the_whole(tmp_path, monkeypatch, chunk):
    several = pillars([1, 0, 1], (0.24, 0.31), (0.19, 0.28))
    mesh.write_stl(tmp_path / "whole.stl", several)
    monkeypatch.setattr(mesh, "_CHUNK", chunk)
    mesh.write_stl(tmp_path / "pieces.stl", several)
    assert (tmp_path / "pieces.stl").read_bytes() == (tmp_path / "whole.stl").read_bytes()


@pytest.mark.parametrize(
    ("count", "colours"),
    [
        (1, [[0.525, 0.45, 0.575, 1]]),
        (2, [[0.15, 0.55, 0.9, 1], [0.9, 0.35, 0.25, 1]]),
        (3, [[0.15, 0.55, 0.9, 1], [0.525, 0.45, 0.575, 1], [0.9, 0.35, 0.25, 1]]),
    ],
)
def test_classes_are_coloured_from_blue_to_red_and_one_of_its_own_between(tmp_path, count, colours):
    wide = 0.2 + 0.05 * np.arange(count)
    mesh.write_gltf(tmp_path / "a.glb", pillars([0, count - 1, 0], wide, wide - 0.02), sides=5)
    tree, _ = gltf_of(tmp_path / "a.glb")
    found = [each["pbrMetallicRoughness"] for each in tree["materials"]]
    assert [each["baseColorFactor"] for each in found] == pytest.approx(np.array(colours), abs=1e-9)
    assert {(each["metallicFactor"], each["roughnessFactor"]) for each in found} == {(0.1, 0.5)}
    assert [m["primitives"][0]["material"] for m in tree["meshes"]] == list(range(count))
    assert [node["mesh"] for node in tree["nodes"][:-1]] == [0, count - 1, 0]
    assert tree["scenes"] == [{"nodes": [3]}]
    assert tree["nodes"][3]["children"] == [0, 1, 2]


def test_every_mesh_of_a_gltf_lies_where_its_views_say_with_unit_normals_outwards(tmp_path):
    """Of unlike classes one after the other: corners as the frustums have them, x, z, -y in metres."""
    sizes = ((0.24, 0.19), (0.31, 0.28))
    mesh.write_gltf(tmp_path / "a.glb", pillars([0, 1, 0], *zip(*sizes, strict=True)), sides=7)
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
            assert (about["count"], about["componentType"], about["type"]) == (len(parts[name]), 5126, "VEC3")
        want = np.column_stack([corners[:, 0], corners[:, 2], -corners[:, 1]])
        assert parts["POSITION"] == pytest.approx(want, abs=1e-13)  # float32 of 1e-6 m
        about = tree["accessors"][tree["meshes"][n]["primitives"][0]["attributes"]["POSITION"]]
        assert [about["min"], about["max"]] == pytest.approx(np.array([want.min(0), want.max(0)]), abs=1e-13)
        assert np.linalg.norm(parts["NORMAL"], axis=1) == pytest.approx(np.ones(len(want)), abs=1e-6)
        middle = np.array([0, 0.35e-6, 0])  # of a convex body: every face is seen from without
        assert ((want - middle) * parts["NORMAL"]).sum(1).min() > 0
