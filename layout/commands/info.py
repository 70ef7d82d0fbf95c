"""What a mask file is, for ``metalens info``: format, unit, top cells, and the shapes
of every layer.
"""

from pathlib import Path
from typing import Any

from layout.commands.check import format_counts
from layout.formats.reading import read_mask


def mask_summary(path: Path, top: str | None = None) -> dict[str, Any]:
    """Format, unit, cells and the shapes of each layer, the hierarchy not expanded.

    Args:
        path: GDSII or OASIS file.
        top: cell to count with all below it; None: all top cells.

    Raises:
        MaskFileError: no such file or cell, a file that cannot be read, or of which one
            cell claims more placements than the size of the file allows.
    """
    content = read_mask(path)
    if top is not None:
        content = content.below(top)
    counts = content.count_shapes()
    layers = {
        f"{layer[0]}/{layer[1]}": {
            "name": content.layer_names.get(layer, ""),
            "shapes": counts[layer],
        }
        for layer in sorted(counts)
    }
    return {
        "file": path.name,
        "kind": f"{content.kind} mask",
        "unit_nm": content.unit_nm,
        "cells": len(content.cells),
        "tops": content.tops,
        "shapes": counts.total(),
        "layers": layers,
        "skipped": dict(content.skipped),
    }


def mask_summary_text(summary: dict[str, Any]) -> str:
    """Lines for people.

    Args:
        summary: from :func:`mask_summary`.
    """
    lines = [
        f"{summary['file']}: {summary['kind']}, {summary['shapes']:,} shapes in "
        f"{summary['cells']} cells, database unit {summary['unit_nm']:g} nm",
        f"  top cell{'s' * (len(summary['tops']) > 1)} {', '.join(summary['tops'][:8])}",
    ]
    for number, entry in summary["layers"].items():
        name = f" {entry['name']}" if entry["name"] else ""
        lines.append(f"  {number}{name}: {entry['shapes']:,}")
    if summary["skipped"]:
        lines.append(f"  draw nothing: {format_counts(summary['skipped'])}")
    return "\n".join(lines)
