"""Triangles of tapered pillars: STL, 3MF and glTF. Each pillar is a closed surface of
its own, checked.
"""

import json
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from layout.shapes import region
from layout.solid.sections import Section
from layout.solid.tile import Tile, check_count
from metalens import __version__
from metalens.ground import store
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm

STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
_METRE = 1e-6  # of a um
_CHUNK = 4096  # pillars that are written at a time


@dataclass(frozen=True, eq=False, slots=True)
class Mesh:
    """A closed surface: (n, 3) vertices in um, (m, 3) triangles, outside to the
    right-hand side.
    """

    vertices_um: Array
    triangles: Array


def frustum(foot_um: float, top_um: float, height_um: float, *, sides: int = 8) -> Mesh:
    """A tapered pillar as a prism of ``sides``, of the area of the circles at foot and
    top.

    Raises:
        ProcessError: fewer than 3 sides.
    """
    if sides < 3:
        raise ProcessError(f"sides = {sides}: need 3 or more")
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    equal_area = np.sqrt(np.pi / (sides / 2 * np.sin(2 * np.pi / sides)))
    rings = [
        np.column_stack([equal_area * d / 2 * ring, np.full(sides, z)])
        for d, z in ((foot_um, 0.0), (top_um, height_um))
    ]
    here, after = np.arange(sides), (np.arange(sides) + 1) % sides
    walls = [
        np.stack([here, after, after + sides], -1),
        np.stack([here, after + sides, here + sides], -1),
    ]
    fan = np.stack([np.zeros(sides - 2, int), here[1:-1], here[2:]], -1)
    mesh = Mesh(
        np.concatenate(rings), np.concatenate([*walls, fan[:, ::-1], fan + sides])
    )
    check_watertight(mesh)
    return mesh


def prism(section: Section, height_um: float, *, sides: int = 8) -> Mesh:
    """A tapered pillar of any section; a curved part as ``sides`` edges of its area.

    Raises:
        ProcessError: the surface is not closed.
    """
    contours = [
        tuple(part.vertices(sides)[:: part.sign] for part in (low, high))
        for low, high in zip(section.foot.parts, section.top.parts, strict=True)
    ]
    counts = [len(low) for low, _ in contours]
    starts = np.concatenate([[0], np.cumsum(counts)])
    foot, top = (np.concatenate([pair[end] for pair in contours]) for end in (0, 1))
    total, faces = int(starts[-1]), []
    for start, count in zip(starts, counts, strict=False):
        here, after = start + np.arange(count), start + (np.arange(count) + 1) % count
        faces += [
            np.stack([here, after, after + total], -1),
            np.stack([here, after + total, here + total], -1),
        ]
    for end, turn in ((0, -1), (1, 1)):
        filled = region.triangles([pair[end] / nm for pair in contours])
        faces.append(filled[:, ::turn] + end * total)
    rings = [
        np.column_stack([ring, np.full(total, z)])
        for ring, z in ((foot, 0.0), (top, height_um))
    ]
    mesh = Mesh(np.concatenate(rings), np.concatenate(faces))
    check_watertight(mesh)
    return mesh


def check_watertight(mesh: Mesh) -> None:
    """Every edge must belong to two triangles, run through once in each direction, and
    the volume be positive.

    Raises:
        ProcessError: the surface is open, doubled or inside out.
    """
    edges = np.concatenate(
        [mesh.triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]
    )
    forth, back = (
        np.sort(edges[:, a] * len(mesh.vertices_um) + edges[:, b])
        for a, b in ((0, 1), (1, 0))
    )
    if len(np.unique(forth)) != len(forth) or (forth != back).any():
        raise ProcessError(
            "the surface of a solid is not closed: an edge has not exactly two triangles"
        )
    if volume_um3(mesh) <= 0:
        raise ProcessError("the surface of a solid is inside out or empty")


def volume_um3(mesh: Mesh) -> float:
    """Volume within a closed surface, by the divergence theorem."""
    a, b, c = (mesh.vertices_um[mesh.triangles[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def meshes(pillars: Tile, *, sides: int = 8) -> list[Mesh]:
    """One checked surface for each class of pillars."""
    if pillars.shaped:
        return [
            prism(section, pillars.height_um, sides=sides) for section in pillars.shaped
        ]
    pairs = zip(pillars.foot_um.tolist(), pillars.top_um.tolist(), strict=True)
    return [frustum(foot, top, pillars.height_um, sides=sides) for foot, top in pairs]


def write_stl(path: str | Path, pillars: Tile, *, sides: int = 8) -> int:
    """Binary STL in um, one closed surface a pillar; returns the number of triangles.

    Raises:
        ProcessError: too many pillars (a square that would do is named). OSError: the
            target cannot be written.
    """
    check_count(pillars, "STL")
    parts = [_facets(mesh) for mesh in meshes(pillars, sides=sides)]
    each = len(parts[0])
    total = each * len(pillars.kind)
    with store.replacing(path) as part, open(part, "wb") as file:
        file.write(
            b"tapered pillars, um, metalens-toolchain".ljust(80)
            + struct.pack("<I", total)
        )
        templates = np.stack(parts)
        for start in range(0, len(pillars.kind), _CHUNK):
            some = slice(start, start + _CHUNK)
            facets = templates[pillars.kind[some]]
            facets["corners"][..., 0] += pillars.x_um[some, None, None].astype(
                np.float32
            )
            facets["corners"][..., 1] += pillars.y_um[some, None, None].astype(
                np.float32
            )
            file.write(facets.data)
    return total


def _facets(mesh: Mesh) -> Array:
    corners = mesh.vertices_um[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), STL)
    facets["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    facets["corners"] = corners
    return facets


def write_3mf(path: str | Path, pillars: Tile, *, sides: int = 16) -> None:
    """3MF in micron: one object a class, placed; named by diameter. Same input, same
    bytes.

    Raises:
        ProcessError: too many pillars. OSError: the target cannot be written.
    """
    check_count(pillars, "3MF")
    objects = []
    for n, (mesh, name) in enumerate(
        zip(meshes(pillars, sides=sides), pillars.names, strict=True), 1
    ):
        points = "".join(
            f'<vertex x="{x:.6g}" y="{y:.6g}" z="{z:.6g}"/>'
            for x, y, z in mesh.vertices_um.tolist()
        )
        faces = "".join(
            f'<triangle v1="{a}" v2="{b}" v3="{c}"/>'
            for a, b, c in mesh.triangles.tolist()
        )
        body = (
            f"<mesh><vertices>{points}</vertices><triangles>{faces}</triangles></mesh>"
        )
        objects.append(f'<object id="{n}" type="model" name="{name}">{body}</object>')
    places = zip(
        (pillars.kind + 1).tolist(),
        pillars.x_um.tolist(),
        pillars.y_um.tolist(),
        strict=True,
    )
    items = "".join(
        f'<item objectid="{k}" transform="1 0 0 0 1 0 0 0 1 {x:.7g} {y:.7g} 0"/>'
        for k, x, y in places
    )
    model = (
        '<?xml version="1.0" encoding="UTF-8"?><model unit="micron" xml:lang="en-US" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        f"<resources>{''.join(objects)}</resources><build>{items}</build></model>"
    )
    with (
        store.replacing(path) as part,
        zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as file,
    ):
        for name, text in (
            ("[Content_Types].xml", _TYPES),
            ("_rels/.rels", _RELATIONS),
            ("3D/3dmodel.model", model),
        ):
            file.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED)


_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?><Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)


def write_gltf(path: str | Path, pillars: Tile, *, sides: int = 24) -> None:
    """Binary glTF 2.0 (.glb), in metres, y up: one mesh a class, one node a pillar;
    coloured by diameter.

    Raises:
        ProcessError: too many pillars. OSError: the target cannot be written.
    """
    check_count(pillars, "glTF")
    buffer, document = bytearray(), _document(pillars)
    for n, mesh in enumerate(meshes(pillars, sides=sides)):
        flat = (
            _METRE
            * mesh.vertices_um[mesh.triangles].reshape(-1, 3)[:, [0, 2, 1]]
            * [1, 1, -1]
        )
        corners = flat.reshape(-1, 3, 3)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = np.repeat(
            normal / np.linalg.norm(normal, axis=1, keepdims=True), 3, axis=0
        )
        for values, name in ((flat, "POSITION"), (normal, "NORMAL")):
            data = values.astype("<f4").tobytes()
            document["bufferViews"].append(
                {"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data)}
            )
            accessor: dict[str, Any] = {
                "bufferView": len(document["bufferViews"]) - 1,
                "componentType": 5126,
            }
            accessor |= {"count": len(values), "type": "VEC3"}
            if name == "POSITION":
                single = values.astype("<f4")
                accessor |= {
                    "min": single.min(0).tolist(),
                    "max": single.max(0).tolist(),
                }
            document["accessors"].append(accessor)
            document["meshes"][n]["primitives"][0]["attributes"][name] = (
                len(document["accessors"]) - 1
            )
            buffer += data
    document["buffers"] = [{"byteLength": len(buffer)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with store.replacing(path) as part, open(part, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(buffer)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(buffer), b"BIN\0") + bytes(buffer))


def _document(pillars: Tile) -> dict[str, Any]:
    """The glTF tree without its numbers: materials, meshes and placed nodes."""
    count = len(pillars.names)
    shade = np.linspace(0, 1, count) if count > 1 else np.array([0.5])
    colours = np.stack(
        [
            0.15 + 0.75 * shade,
            0.35 + 0.2 * (1 - shade),
            0.9 - 0.65 * shade,
            np.ones(count),
        ],
        -1,
    )
    places = zip(
        pillars.kind.tolist(), pillars.x_um.tolist(), pillars.y_um.tolist(), strict=True
    )
    nodes: list[dict[str, Any]] = [
        {"mesh": k, "translation": [x * _METRE, 0.0, -y * _METRE]} for k, x, y in places
    ]
    nodes.append({"name": "metalens tile", "children": list(range(len(nodes)))})
    material = {"metallicFactor": 0.1, "roughnessFactor": 0.5}
    return {
        "asset": {"version": "2.0", "generator": f"metalens-toolchain {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [len(nodes) - 1]}],
        "nodes": nodes,
        "meshes": [
            {"name": name, "primitives": [{"attributes": {}, "material": n}]}
            for n, name in enumerate(pillars.names)
        ],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": c, **material}}
            for c in colours.round(4).tolist()
        ],
        "accessors": [],
        "bufferViews": [],
    }
