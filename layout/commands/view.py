"""Panels of a mask: every shape of the file on its layers, with size, dose and broken
rules.
"""

import re
from pathlib import Path

import numpy as np

from layout.formats import job_files
from layout.formats.files import placement_limit
from layout.formats.library import MaskLibrary, PolygonStack, equal_shapes
from layout.formats.reading import read_mask
from layout.process.process import LayerNumber
from metalens.commands import MASKS
from metalens.core.errors import MaskFileError
from metalens.view import DrawingPanel, OutlinePanel, Panel

_MARKER = re.compile(
    r"<category>'([^<]*)'</category>.*?box: \(([^,;]+),([^,;]+);([^,;]+),([^,;]+)\)",
    re.DOTALL,
)


def mask_panels(path: Path) -> list[Panel]:
    """The drawing of a mask file, or of the one in a folder.

    Args:
        path: of a mask file, or of a folder with one.

    Raises:
        MaskFileError: no mask file, one that cannot be read, or that draws nothing.
    """
    masks = [path]
    if path.is_dir():
        masks = [mask for end in MASKS for mask in sorted(path.glob(f"*{end}"))]
    if not masks:
        raise MaskFileError(f"{path}: no mask file ({', '.join(MASKS)}) in it")
    mask = masks[0]
    limit = placement_limit(mask)
    content = read_mask(mask, limit)
    content.refuse_beyond(limit)
    table = mask.with_name("doses.csv")
    dose = job_files.read_dose_table(table) if table.is_file() else {}
    outlines = [_outline(content, group, dose) for group in equal_shapes(content)]
    if not outlines:
        raise MaskFileError(f"{mask} holds no shape to be shown")
    marks = _marks(mask.with_suffix(".lyrdb"))
    caption = (
        f"{sum(len(o.places) for o in outlines):,} shapes, each as it is in the file. Drag to move, wheel or + and - "
        "to zoom: far away a pixel shows how much of it is covered, near by the outlines are drawn. "
        + (f"Boxes: {len(marks)} places where a rule is broken." if marks else "")
    )
    drawn = DrawingPanel(mask.name, outlines, 1e-3 * content.unit_nm, caption, marks)
    return [drawn]


def _outline(
    content: MaskLibrary, group: list[PolygonStack], dose: dict[LayerNumber, float]
) -> OutlinePanel:
    """Copies of one polygon."""
    shape = group[0]
    size = np.ptp(shape.outlines[0], axis=0) * content.unit_nm
    number = "/".join(map(str, shape.layer))
    notes = {
        "layer": number,
        "cell": shape.cell,
        "width / nm": float(size[0]),
        "height / nm": float(size[1]),
    }
    if shape.layer in dose:
        notes["relative dose"] = dose[shape.layer]
    places = np.concatenate(
        [np.column_stack([stack.x, stack.y]) for stack in group]
    ).astype(np.int32)
    return OutlinePanel(_name(content, shape.layer), shape.outlines[0], places, notes)


def _name(content: MaskLibrary, layer: LayerNumber) -> str:
    """One switch for all doses of a layer."""
    name = content.layer_names.get(layer, "").partition("_dose_")[0]
    return f"{layer[0]} {name.replace('_', ' ')}".strip()


def _marks(path: Path) -> list[tuple[float, float, str]]:
    """Centres and rules of a marker database of this toolchain; none where there is no
    such file.
    """
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    return [
        ((float(left) + float(right)) / 2, (float(bottom) + float(top)) / 2, rule)
        for rule, left, bottom, right, top in _MARKER.findall(text)
    ]
