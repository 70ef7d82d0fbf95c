"""3MF and glTF read back: units, one mesh a class, and where each pillar stands,
against what was asked for.

Nothing of the writers is used: the parts of a 3MF are parsed as XML, a glTF by its
chunks, accessors and nodes.
"""

import json
import math
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from layout.solid.sections import Section
from layout.solid.tile import Tile
from metalens.cell.shapes import Conic, Outline, turned
from metalens.ground.arrays import Array

_NAMESPACE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
_UNITS_UM = {
    "micron": 1.0,
    "millimeter": 1e3,
    "centimeter": 1e4,
    "inch": 25.4e3,
    "foot": 304.8e3,
    "meter": 1e6,
}
_DIGITS = 5e-6  # relative, of a number of six digits; three make a volume
_PLACE_UM = 1e-4  # of seven digits within a millimetre


@dataclass(frozen=True, eq=False, slots=True)
class _Part:
    """A mesh: (n, 3) corners in um and (m, 3) triangles, z along the pillar; (k, 3)
    places of its copies in um.
    """

    corners: Array
    triangles: Array
    places: Array


def differences_3mf(path: Path, pillars: Tile) -> tuple[str, ...]:
    """What a 3MF file lacks of a tile, in words: meshes by name, their box, volume and
    closure, and their places.

    Accuracy: places to 0.1 nm, boxes and volumes to the digits that the file holds.
    """
    try:
        return _differences(_of_3mf(path), pillars)
    except (
        zipfile.BadZipFile,
        ElementTree.ParseError,
        KeyError,
        ValueError,
        IndexError,
    ) as error:
        return (f"it cannot be read as 3MF: {error}",)


def differences_gltf(path: Path, pillars: Tile) -> tuple[str, ...]:
    """As :func:`differences_3mf`, of a binary glTF in metres, y up."""
    try:
        return _differences(_of_gltf(path.read_bytes()), pillars)
    except (struct.error, KeyError, ValueError, IndexError, TypeError) as error:
        return (f"it cannot be read as glTF: {error}",)


def _of_3mf(path: Path) -> dict[str, _Part]:
    with zipfile.ZipFile(path) as file:
        root = ElementTree.fromstring(file.read("3D/3dmodel.model"))
    unit = _UNITS_UM[root.get("unit", "millimeter")]
    places: dict[str, list[list[float]]] = {}
    for item in root.iter(f"{_NAMESPACE}item"):
        turn = [
            float(value)
            for value in item.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split()
        ]
        if turn[:9] != [1, 0, 0, 0, 1, 0, 0, 0, 1]:
            raise ValueError("a copy is turned or scaled")
        places.setdefault(item.attrib["objectid"], []).append(turn[9:])
    parts = {}
    for each in root.iter(f"{_NAMESPACE}object"):
        corners = [
            [float(v.attrib[k]) for k in "xyz"]
            for v in each.iter(f"{_NAMESPACE}vertex")
        ]
        triangles = [
            [int(t.attrib[k]) for k in ("v1", "v2", "v3")]
            for t in each.iter(f"{_NAMESPACE}triangle")
        ]
        at = np.reshape(places.pop(each.attrib["id"], []), (-1, 3)).astype(float)
        parts[each.attrib["name"]] = _Part(
            unit * np.array(corners), np.array(triangles), unit * at
        )
    if places:
        raise ValueError(
            f"copies of objects that it does not hold: {', '.join(sorted(places)[:5])}"
        )
    return parts


def _of_gltf(data: bytes) -> dict[str, _Part]:
    magic, version, length = struct.unpack_from("<4sII", data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    binary, name = struct.unpack_from("<I4s", data, 20 + size)
    if (magic, version, length, kind, name) != (
        b"glTF",
        2,
        len(data),
        b"JSON",
        b"BIN\0",
    ):
        raise ValueError(
            "its header or its chunks are not those of a binary glTF 2.0 of this length"
        )
    tree = json.loads(data[20 : 20 + size])
    buffer = data[28 + size : 28 + size + binary]
    places: dict[int, list[list[float]]] = {}
    waiting = list(tree["scenes"][tree["scene"]]["nodes"])
    for number in waiting:  # grows by the children
        node = tree["nodes"][number]
        waiting += node.get("children", [])
        if {"matrix", "rotation", "scale"} & set(node) or (
            "children" in node and "translation" in node
        ):
            raise ValueError("a node is turned, scaled or moved with others")
        if "mesh" in node:
            places.setdefault(node["mesh"], []).append(
                node.get("translation", [0.0, 0.0, 0.0])
            )
    found = {}
    for number, mesh in enumerate(tree["meshes"]):
        if any({"indices", "mode"} & set(p) for p in mesh["primitives"]):
            raise ValueError("a mesh is no plain list of triangles")
        corners = np.concatenate(
            [
                _positions(tree, buffer, p["attributes"]["POSITION"])
                for p in mesh["primitives"]
            ]
        )
        at = np.reshape(places.get(number, []), (-1, 3)).astype(float)
        triangles = np.arange(len(corners)).reshape(-1, 3)
        found[mesh["name"]] = _Part(_upright(corners), triangles, _upright(at))
    return found


def _upright(metres: Array) -> Array:
    """From metres with y up to um with z up."""
    return np.asarray(1e6 * metres[:, [0, 2, 1]] * [1, -1, 1])


def _positions(tree: dict[str, Any], buffer: bytes, number: int) -> Array:
    accessor = tree["accessors"][number]
    if (accessor["componentType"], accessor["type"]) != (5126, "VEC3"):
        raise ValueError("positions are no triples of float32")
    first = tree["bufferViews"][accessor["bufferView"]]["byteOffset"] + accessor.get(
        "byteOffset", 0
    )
    return (
        np.frombuffer(buffer, "<f4", 3 * accessor["count"], first)
        .reshape(-1, 3)
        .astype(float)
    )


def _differences(parts: dict[str, _Part], pillars: Tile) -> tuple[str, ...]:
    found, sections = [], pillars.sections
    for kind, name in enumerate(pillars.names):
        here = pillars.kind == kind
        part = parts.get(name)
        if part is None or len(part.places) != int(here.sum()):
            found.append(
                f"{name}: {0 if part is None else len(part.places)} copies, planned {int(here.sum())}"
            )
            continue
        found += [
            f"{name}: {text}"
            for text in _shape(part, sections[kind], pillars.height_um)
        ]
        off = _off(
            part.places,
            np.column_stack(
                [pillars.x_um[here], pillars.y_um[here], np.zeros(int(here.sum()))]
            ),
        )
        if off > _PLACE_UM:
            found.append(f"{name}: a copy stands {off:.3g} um off its place")
    strange = sorted(set(parts) - set(pillars.names))
    return (
        *found,
        *(
            [f"meshes that were not planned: {', '.join(strange[:5])}"]
            if strange
            else []
        ),
    )


def _shape(part: _Part, section: Section, height_um: float) -> list[str]:
    """Volume, height, outlines of foot and top, and closure of a mesh."""
    a, b, c = (part.corners[part.triangles[:, k]] for k in range(3))
    volume = float((a * np.cross(b, c)).sum() / 6)
    planned = section.volume_um3(height_um)
    found = []
    if abs(volume / planned - 1) > 3 * _DIGITS:
        found.append(f"volume {volume:.9g} um3, planned {planned:.9g}")
    z = part.corners[:, 2]
    if max(abs(z.min()), abs(z.max() - height_um)) > _DIGITS * height_um:
        found.append(
            f"from {z.min():.6g} to {z.max():.6g} um high, planned 0 to {height_um:.6g}"
        )
    if (
        float(np.abs(np.cross(b - a, c - a).sum(0)).max())
        > _DIGITS * section.foot.radius_um * height_um * 10
    ):
        found.append("its surface is not closed")
    for at, outline, end in (
        (z.min(), section.foot, "foot"),
        (z.max(), section.top, "top"),
    ):
        corners = part.corners[np.abs(z - at) < height_um / 2, :2]
        away, low, high = _beside(corners, outline)
        if not away <= 2 * _DIGITS:
            found.append(
                f"corners of its {end} lie {low:.6g} to {high:.6g} um from the middle"
            )
    return found


def _beside(corners: Array, outline: Outline) -> tuple[float, float, float]:
    """How far corners are from one of the parts of an outline, over its reach, and how
    near and far from the middle.

    A curve's lie on one line of its form, up to 1.1 times as far out; at least three
    are on every part.
    """
    reach = np.hypot(*corners.T)
    away = np.full((len(outline.parts), len(corners)), np.inf)
    for own, part in zip(away, outline.parts, strict=True):
        if isinstance(part, Conic):
            x, y = turned(corners, -part.angle_rad).T
            form = np.hypot(x / part.half_x_um, y / part.half_y_um)
            near = (form >= 1 - _DIGITS) & (form <= 1.1)
            own[near] = (
                np.abs(form[near] - np.median(form[near])) if near.any() else np.inf
            )
        else:
            apart = np.hypot(
                *(corners[:, None] - np.array(part.corners_um)).transpose(2, 0, 1)
            )
            own[:] = apart.min(1) / outline.radius_um
    spread = float(away.min(0).max(initial=np.inf if not len(corners) else 0.0))
    held = ((away <= 2 * _DIGITS).sum(1) >= 3).all()
    return (
        spread if held else np.inf,
        float(reach.min(initial=np.inf)),
        float(reach.max(initial=0.0)),
    )


def _off(places: Array, planned: Array) -> float:
    """How far a copy stands from the nearest place, at most; infinite where a place is
    taken twice.
    """
    from scipy.spatial import cKDTree

    away, which = cKDTree(planned).query(places)
    return (
        float(away.max(initial=0.0))
        if len(np.unique(which)) == len(planned)
        else math.inf
    )
