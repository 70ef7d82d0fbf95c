"""What a mask file is, for ``metalens info``: format, unit, top cells, and the shapes of every layer."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from layout.commands.check import read
from layout.files import MaskContent, flat
from layout.process import LayerNumber
from layout.rules import foreign
from metalens.ground.errors import MaskFileError


def told(path: Path) -> dict[str, Any]:
    """Format, unit_nm, cells, top cells, and {"LAYER/DATATYPE": name and shapes}, the hierarchy counted by products.

    Raises:
        MaskFileError: no such file, one that cannot be read, or that claims more shapes than its size allows.
    """
    if not path.is_file():
        raise MaskFileError(f"{path}: no such file")
    most = foreign.most_of(path)
    content = read(path, most)
    flat.refuse_beyond(content, most)
    known: dict[str, Counter[LayerNumber]] = {}
    counts = sum((_below(content, top, known) for top in content.tops), Counter[LayerNumber]())
    layers = {
        f"{layer[0]}/{layer[1]}": {"name": content.layer_names.get(layer, ""), "shapes": counts[layer]}
        for layer in sorted(counts)
    }
    about = {"file": path.name, "kind": f"{content.kind} mask", "unit_nm": content.unit_nm}
    return about | {"cells": len(content.cells), "tops": content.tops, "shapes": counts.total(), "layers": layers}


def _below(content: MaskContent, name: str, known: dict[str, Counter[LayerNumber]]) -> Counter[LayerNumber]:
    """Shapes of a cell and of all that it places, by layer."""
    if name not in known:
        cell, placed = content.cells[name], content.cells[name].kept()
        counts = Counter({layer: len(shapes) for layer, shapes in cell.polygons.items()})
        counts.update({layer: len(shapes) for layer, shapes in cell.circles.items()})
        times = np.bincount(placed.child, minlength=len(placed.children)).tolist()
        for child, count in zip(placed.children, times, strict=True):
            counts.update({layer: count * n for layer, n in _below(content, child, known).items()})
        known[name] = counts
    return known[name]


def text(found: dict[str, Any]) -> str:
    """Lines for people."""
    lines = [
        f"{found['file']}: {found['kind']}, {found['shapes']:,} shapes in {found['cells']} cells, database unit "
        f"{found['unit_nm']:g} nm",
        f"  top cell{'s' * (len(found['tops']) > 1)} {', '.join(found['tops'][:8])}",
    ]
    lines += [f"  {number} {e['name']}: {e['shapes']:,}" for number, e in found["layers"].items()]
    return "\n".join(line.replace(" :", ":") for line in lines)
