"""What a mask file is, for ``metalens info``: format, unit, top cells, and the shapes
of every layer.
"""

from pathlib import Path
from typing import Any

from layout.commands.check import read
from layout.files import hierarchy
from metalens.ground import reading
from metalens.ground.errors import MaskFileError


def told(path: Path) -> dict[str, Any]:
    """Format, unit_nm, cells, top cells, and {"LAYER/DATATYPE": name and shapes}, the
    hierarchy counted by products.

    Raises:
        MaskFileError: no such file, one that cannot be read, or of which one cell
            claims more placements than the size
            of the file allows.
    """
    if not path.is_file():
        raise MaskFileError(f"{path}: {reading.absent(path)}")
    content = read(path)
    counts = hierarchy.shapes(content)
    layers = {
        f"{layer[0]}/{layer[1]}": {
            "name": content.layer_names.get(layer, ""),
            "shapes": counts[layer],
        }
        for layer in sorted(counts)
    }
    about = {
        "file": path.name,
        "kind": f"{content.kind} mask",
        "unit_nm": content.unit_nm,
    }
    return about | {
        "cells": len(content.cells),
        "tops": content.tops,
        "shapes": counts.total(),
        "layers": layers,
    }


def text(found: dict[str, Any]) -> str:
    """Lines for people."""
    lines = [
        f"{found['file']}: {found['kind']}, {found['shapes']:,} shapes in {found['cells']} cells, database unit "
        f"{found['unit_nm']:g} nm",
        f"  top cell{'s' * (len(found['tops']) > 1)} {', '.join(found['tops'][:8])}",
    ]
    lines += [
        f"  {number} {e['name']}: {e['shapes']:,}"
        for number, e in found["layers"].items()
    ]
    return "\n".join(line.replace(" :", ":") for line in lines)
