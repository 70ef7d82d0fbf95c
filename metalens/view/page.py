"""The page: panels as JSON and deflated arrays, with the script and style that show
them, in one file.
"""

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from metalens import __version__
from metalens.core import store
from metalens.core.arrays import Array
from metalens.view.panels import (
    ClassMapPanel,
    CurvePanel,
    DrawingPanel,
    ImagePanel,
    OutlinePanel,
    Panel,
    PointPanel,
    SliderAxis,
    TablePanel,
)

DTYPES = {
    "float32": "Float32Array",
    "int32": "Int32Array",
    "uint8": "Uint8Array",
    "uint16": "Uint16Array",
}


def write_page(
    path: str | Path,
    title: str,
    panels: Sequence[Panel],
    *,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write the page.

    Args:
        path: file to read or write.
        title: file and kind. panels: in order. about: header and provenance, shown at
            the end.

    Raises:
        OSError: the target cannot be written.
    """
    store.write_text(path, page_html(title, panels, about=about))


def page_html(
    title: str, panels: Sequence[Panel], *, about: Mapping[str, Any] | None = None
) -> str:
    """The page as text; no address in it leads out of the file."""
    from jinja2 import Environment

    content = {
        "title": title,
        "panels": [_plain(panel) for panel in panels],
        "about": dict(about or {}),
    }
    template = Environment(autoescape=False).from_string(_data("view.html"))
    return template.render(
        title=title.replace("<", "&lt;"),
        version=__version__,
        style=_data("uPlot.min.css") + _data("view.css"),
        licence=_data("uPlot-LICENSE.txt"),
        library=_data("uPlot.iife.min.js"),
        script=_data("view.js"),
        data=json.dumps(content, allow_nan=False).replace("<", "\\u003c"),
    )


def _data(name: str) -> str:
    return (
        resources.files("metalens")
        .joinpath("data", "view", name)
        .read_text(encoding="utf-8")
    )


def _plain(panel: Panel) -> dict[str, Any]:
    shared = {
        "type": type(panel).__name__,
        "title": panel.title,
        "caption": panel.caption,
    }
    if isinstance(panel, ImagePanel):
        return shared | {
            "values": pack_array(np.asarray(panel.values, np.float32)),
            "axes": [_axis(axis) for axis in panel.axes],
            "step": panel.step_um,
            "unit": panel.unit,
            "signed": panel.signed,
            "optics": panel.optics,
            "across": panel.across,
            "fromLeast": panel.from_least,
        }
    if isinstance(panel, CurvePanel):
        return shared | {
            "x": pack_array(np.asarray(panel.x, np.float32)),
            "xName": panel.x_name,
            "yName": panel.y_name,
            "lines": {
                name: pack_array(np.asarray(line, np.float32))
                for name, line in panel.lines.items()
            },
            "errors": {
                name: pack_array(np.asarray(line, np.float32))
                for name, line in panel.errors.items()
            },
            "axes": [_axis(axis) for axis in panel.axes],
            "bands": [list(band) for band in panel.bands],
            "scale": panel.scale,
        }
    if isinstance(panel, ClassMapPanel):
        return shared | {
            "index": pack_array(panel.index),
            "sizes": [_number(v) for v in panel.sizes],
            "pitch": panel.pitch_um,
            "unit": panel.unit,
            "columns": {
                name: [_number(v) for v in column]
                for name, column in panel.columns.items()
            },
            "marks": [list(mark) for mark in panel.marks],
        }
    if isinstance(panel, DrawingPanel):
        return shared | {
            "outlines": [_outline(outline) for outline in panel.outlines],
            "unit": panel.unit_um,
            "marks": [list(mark) for mark in panel.marks],
        }
    return shared | (_points(panel) if isinstance(panel, PointPanel) else _table(panel))


def _points(panel: PointPanel) -> dict[str, Any]:
    notes = panel.notes or [{}] * len(panel.x)
    return {
        "x": [_number(v) for v in panel.x],
        "y": [_number(v) for v in panel.y],
        "xName": panel.x_name,
        "yName": panel.y_name,
        "groups": list(panel.groups),
        "front": list(panel.front),
        "frontName": panel.front_name,
        "notes": [{name: _number(v) for name, v in note.items()} for note in notes],
    }


def _outline(outline: OutlinePanel) -> dict[str, Any]:
    """Places by rising y, then x, as steps: those of a lattice repeat and deflate to a
    fraction of a byte.
    """
    places = outline.places[np.lexsort((outline.places[:, 0], outline.places[:, 1]))]
    steps = np.diff(places, axis=0, prepend=np.zeros((1, 2), places.dtype))
    return {
        "layer": outline.layer,
        "corners": pack_array(np.asarray(outline.corners, np.float32)),
        "dx": pack_array(np.asarray(steps[:, 0], np.int32)),
        "dy": pack_array(np.asarray(steps[:, 1], np.int32)),
        "notes": {name: _number(value) for name, value in outline.notes.items()},
    }


def _table(panel: TablePanel) -> dict[str, Any]:
    return {
        "head": list(panel.head),
        "rows": [[_number(v) for v in row] for row in panel.rows],
    }


def _axis(axis: SliderAxis) -> dict[str, Any]:
    values = [_number(v) for v in axis.values]
    return {
        "name": axis.name,
        "values": values,
        "unit": axis.unit,
        "blink": axis.blink,
        "first": axis.first,
    }


def _number(value: Any) -> Any:
    """A value as JSON has it: numbers to six digits, what is not finite as text."""
    if isinstance(value, (np.floating, float)):
        number = float(value)
        return float(f"{number:.6g}") if math.isfinite(number) else str(number)
    return int(value) if isinstance(value, np.integer) else value


def pack_array(array: Array) -> dict[str, Any]:
    """An array for the page: type, shape, and its little-endian bytes deflated, in base
    64.
    """
    array = np.ascontiguousarray(array)
    content = zlib.compress(array.astype(array.dtype.newbyteorder("<")).tobytes(), 6)
    return {
        "type": DTYPES[array.dtype.name],
        "shape": list(array.shape),
        "data": base64.b64encode(content).decode(),
    }
