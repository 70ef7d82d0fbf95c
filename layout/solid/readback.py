"""Solids read back as they were written: parts, box around them and volume against the
pillars that were asked for.
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np

from layout.solid.mesh import STL, meshes, volume_um3
from layout.solid.module import COLOURS, Module
from layout.solid.tile import Tile
from metalens.ground.arrays import Array

_CHUNK = 1 << 16  # triangles
_SINGLE = 2e-6  # relative, of a sum of float32 corners
_KERNEL_UM = 1e-4  # of places and boxes that the CAD kernel gives back
_VOLUME = 1e-6  # relative, of its solids


def stl_differences(path: Path, pillars: Tile, *, sides: int = 8) -> tuple[str, ...]:
    """What an STL file lacks of a tile, in words: triangles, box, closed volume. Read
    in pieces.

    Accuracy: places to one step of float32 there, volume to 2e-6 of the pillars and of
    their places in float32.
    """
    data = np.memmap(path, np.uint8, "r")
    said = struct.unpack("<I", data[80:84].tobytes())[0] if len(data) >= 84 else -1
    shapes = meshes(pillars, sides=sides)
    each = len(shapes[0].triangles)
    wanted = each * len(pillars.kind)
    if said != wanted or len(data) != 84 + STL.itemsize * wanted:
        return (f"{said} triangles in {len(data)} bytes, planned {wanted}",)
    facets = data[84:].view(STL)
    low, high, volume = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    middle = np.array([pillars.x_um.mean(), pillars.y_um.mean(), 0.0])
    for first in range(0, wanted, _CHUNK * each):
        corners = facets["corners"][first : first + _CHUNK * each].astype(float)
        low, high = (
            np.minimum(low, corners.min((0, 1))),
            np.maximum(high, corners.max((0, 1))),
        )
        a, b, c = (corners - middle).transpose(1, 0, 2)
        volume += float((a * np.cross(b, c)).sum() / 6)
    planned = sum(
        volume_um3(shape) * int(n)
        for shape, n in zip(
            shapes, np.bincount(pillars.kind, minlength=len(shapes)), strict=True
        )
    )
    least, reach = (
        np.array([end(s.vertices_um[:, :2], 0) for s in shapes])[pillars.kind]
        for end in (np.min, np.max)
    )
    place = np.column_stack([pillars.x_um, pillars.y_um])
    box = np.r_[(place + least).min(0), 0.0, (place + reach).max(0), pillars.height_um]
    farthest = float(np.abs(place).max())
    step = float(np.spacing(np.float32(farthest + reach.max())))
    found = _boxes(np.r_[low, high], box, 2 * step + 1e-6)
    rounded = step / float(
        reach.min()
    )  # of each corner, random, on sections of this size
    if abs(volume / planned - 1) > _SINGLE + rounded:
        found.append(f"volume {volume:.9g} um3, planned {planned:.9g}")
    return tuple(found)


def step_differences(path: Path, pillars: Tile) -> tuple[str, ...]:
    """What a STEP file lacks of a tile, in words: solids by name, their volume, and
    where each stands.

    Read by the CAD kernel; the file is in mm.
    """
    parts = _step_parts(path)
    found: list[str] = []
    sections = pillars.sections
    for kind, name in enumerate(pillars.names):
        here = pillars.kind == kind
        volume, places = parts.get(name, (0.0, np.empty((0, 3))))
        if len(places) != int(here.sum()):
            found.append(f"{name}: {len(places)} solids, planned {int(here.sum())}")
            continue
        planned = sections[kind].volume_um3(pillars.height_um)
        if abs(1e9 * volume / planned - 1) > _VOLUME:
            found.append(
                f"{name}: volume {1e9 * volume:.9g} um3, planned {planned:.9g}"
            )
        place = np.column_stack(
            [pillars.x_um[here], pillars.y_um[here], np.zeros(int(here.sum()))]
        )
        away = np.abs(_sorted(1e3 * places) - _sorted(place)).max(initial=0.0)
        if away > _KERNEL_UM:
            found.append(f"{name}: a solid stands {away:.3g} um off its place")
    strange = sorted(set(parts) - set(pillars.names) - {"substrate"})
    if strange:
        found.append(f"solids that were not planned: {', '.join(strange[:5])}")
    return tuple(found)


def module_differences(path: Path, planned: Module) -> tuple[str, ...]:
    """What the STEP file of a module lacks, in words: its parts by name, and its length
    along the light.
    """
    parts = _children(path)
    found = []
    if sorted(part.label for part in parts) != sorted(COLOURS):
        found.append(
            f"parts {', '.join(part.label for part in parts)}, planned {', '.join(COLOURS)}"
        )
    boxes = [part.bounding_box() for part in parts]
    long = max((box.max.Z for box in boxes), default=0.0) - min(
        (box.min.Z for box in boxes), default=0.0
    )
    if abs(long - planned.stack_mm) > _KERNEL_UM:
        found.append(f"{long:.6g} mm along the light, planned {planned.stack_mm:.6g}")
    return tuple(found)


def _step_parts(path: Path) -> dict[str, tuple[float, Array]]:
    """{name: volume in mm3 of one, (n, 3) places in mm of all} of the solids of an
    assembly in a STEP file.
    """
    volumes: dict[str, float] = {}
    places: dict[str, list[tuple[float, float, float]]] = {}
    for part in _children(path):
        if part.label not in volumes:
            volumes[part.label] = float(part.volume)
        places.setdefault(part.label, []).append(tuple(part.location.position))
    return {
        name: (volume, np.array(places[name]).reshape(-1, 3))
        for name, volume in volumes.items()
    }


def _children(path: Path) -> list[Any]:
    """Parts of an assembly."""
    from build123d import import_step

    return list(import_step(path).children)


def _sorted(places: Array) -> Array:
    rounded = np.round(places, 3)
    return places[np.lexsort(rounded.T)]


def _boxes(found: Array, planned: Array, most: float) -> list[str]:
    away = float(np.abs(found - planned).max())
    return [f"the box around it is {away:.3g} um off"] if away > most else []
