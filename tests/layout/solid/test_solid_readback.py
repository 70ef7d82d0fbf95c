"""Solids read back: a file as it was written is whole, and what is missing, moved or
thinner is told.
"""

import dataclasses
import json
import struct

import numpy as np
import pytest

from layout.process.process import Etch, Process
from layout.solid import mesh, module, readback, step
from layout.solid.tile import Tile

PROCESS = Process(etch=Etch(sidewall_deg=1.0))


def tile(side=5):
    """Pillars of two classes with tilted walls, some 30 um off the axis."""
    rng = np.random.default_rng(side)
    x, y = (
        v.ravel() * 0.4 + 31.0
        for v in np.meshgrid(np.arange(side), np.arange(side + 1))
    )
    kind = rng.integers(0, 2, len(x))
    kind[:2] = 0, 1
    return Tile(
        np.array([0.15, 0.24]), np.array([0.12, 0.21]), x, y - 47.0, kind, 0.7, 0.4
    )


def changed(path, edit):
    data = bytearray(path.read_bytes())
    facets = np.frombuffer(data, mesh.STL, offset=84)
    edit(facets["corners"])
    path.write_bytes(data)


def test_stl_is_whole_and_every_damage_is_told(tmp_path):
    path, pillars = tmp_path / "a.stl", tile()
    mesh.write_stl(path, pillars)
    assert readback.stl_differences(path, pillars) == ()
    whole = path.read_bytes()
    path.write_bytes(whole[:-50])
    assert "triangles in" in readback.stl_differences(path, pillars)[0]
    path.write_bytes(whole[:80] + struct.pack("<I", 5) + whole[84:])
    assert "5 triangles in" in readback.stl_differences(path, pillars)[0]
    path.write_bytes(whole)

    def thinner(corners):  # one pillar of 30, by 1 %: 3e-4 of the volume
        first = corners[28 * 8 : 28 * 9]
        middle = np.array([pillars.x_um[8], pillars.y_um[8]])
        first[..., :2] = (first[..., :2] - middle) * 0.99 + middle

    changed(path, thinner)
    assert "volume" in readback.stl_differences(path, pillars)[0]
    path.write_bytes(whole)
    changed(
        path,
        lambda corners: np.add(corners, [0.01, 0, 0], out=corners, casting="unsafe"),
    )
    assert "box around it is 0.01 um off" in readback.stl_differences(path, pillars)[0]


def test_step_is_whole_and_what_differs_is_told(tmp_path):
    pytest.importorskip("build123d")
    path, pillars = tmp_path / "a.step", tile(3)
    step.write_step(path, pillars)
    assert readback.step_differences(path, pillars) == ()
    (thin,) = readback.step_differences(
        path, dataclasses.replace(pillars, top_um=np.array([0.12, 0.210001]))
    )
    assert "volume" in thin
    moved = pillars.x_um.copy()
    moved[4] += 0.002
    (away,) = readback.step_differences(path, dataclasses.replace(pillars, x_um=moved))
    assert "0.002 um off its place" in away
    fewer = dataclasses.replace(
        pillars, **{k: getattr(pillars, k)[1:] for k in ("x_um", "y_um", "kind")}
    )
    assert "solids, planned" in readback.step_differences(path, fewer)[0]


def test_diameters_of_tenths_of_a_nanometre_keep_their_names(tmp_path):
    """A bias table leaves such diameters; readers of STEP make an underscore of a point
    in a name.
    """
    pytest.importorskip("build123d")
    path = tmp_path / "a.step"
    pillars = dataclasses.replace(
        tile(2), foot_um=np.array([0.1559, 0.24]), top_um=np.array([0.1262, 0.21])
    )
    assert pillars.names == [
        "pillar_141_1nm",
        "pillar_225nm",
    ]  # the mean of both ends is 141.05
    step.write_step(path, pillars)
    assert readback.step_differences(path, pillars) == ()


def test_a_module_has_its_parts_and_its_length(tmp_path):
    pytest.importorskip("build123d")
    path = tmp_path / "m.step"
    module.write_module(path, module.Module())
    assert readback.module_differences(path, module.Module()) == ()
    (long,) = readback.module_differences(path, module.Module(filter_mm=0.6))
    assert long == "3.5 mm along the light, planned 3.6"


def test_gltf_is_in_metres_and_stands_upright(tmp_path):
    path, pillars = tmp_path / "a.glb", tile()
    mesh.write_gltf(path, pillars)
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    nodes = [node["translation"] for node in document["nodes"][:-1]]
    assert np.allclose(
        nodes,
        np.column_stack([pillars.x_um, 0 * pillars.x_um, -pillars.y_um]) * 1e-6,
        rtol=1e-12,
    )
    tops = [document["accessors"][2 * k]["max"][1] for k in range(2)]
    assert tops == pytest.approx([0.7e-6] * 2, rel=1e-6)  # y is up
    wide = [document["accessors"][2 * k]["max"][0] for k in range(2)]
    # equal-area polygon of 24 sides: its farthest corner is 1.004 of the radius, its x
    # at 7.5 degrees 0.995
    assert wide == pytest.approx([0.5 * d * 1e-6 for d in (0.15, 0.24)], rel=0.01)
