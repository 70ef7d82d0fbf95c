"""The page: panels as JSON and deflated arrays, with the script and style that show
them, in one file.
"""

import base64
import dataclasses
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np

from metalens import __version__
from metalens.core.arrays import Array
from metalens.view.panels import CurvePanel, ImagePanel, OutlinePanel, Panel

DTYPES = {
    "float32": "Float32Array",
    "int32": "Int32Array",
    "uint8": "Uint8Array",
    "uint16": "Uint16Array",
}


def page_html(
    title: str, panels: Sequence[Panel], *, about: Mapping[str, Any] | None = None
) -> str:
    """The page as HTML text, without references outside the file.

    Args:
        title: file and kind.
        panels: in order.
        about: header and provenance, shown at the end.
    """
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


# fields whose numbers go to the page packed, in single precision
_PACKED: dict[type, tuple[str, ...]] = {
    ImagePanel: ("values",),
    CurvePanel: ("x", "lines", "errors"),
}


def _plain(value: Any) -> Any:
    """A panel, or a part of one, as JSON has it.

    Records become dictionaries of their fields with their type; 2-D arrays and the
    fields of :data:`_PACKED` are packed.
    """
    if isinstance(value, OutlinePanel):
        return _outline(value)
    if dataclasses.is_dataclass(value):
        packed = _PACKED.get(type(value), ())
        content: dict[str, Any] = {"type": type(value).__name__}
        for field in dataclasses.fields(value):
            encode = _packed if field.name in packed else _plain
            content[field.name] = encode(getattr(value, field.name))
        return content
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, np.ndarray) and value.ndim == 2:
        return pack_array(value)
    if isinstance(value, list | tuple | range | np.ndarray):
        return [_plain(part) for part in value]
    return _number(value)


def _packed(value: Any) -> dict[str, Any]:
    """Arrays packed in single precision, by name where there are several."""
    if isinstance(value, Mapping):
        return {name: _packed(part) for name, part in value.items()}
    return pack_array(np.asarray(value, np.float32))


def _outline(outline: OutlinePanel) -> dict[str, Any]:
    """A polygon and its copies as JSON has it, places as steps by rising y, then x.

    Steps of a lattice repeat, so that they deflate to a fraction of a byte.
    """
    places = outline.places[np.lexsort((outline.places[:, 0], outline.places[:, 1]))]
    steps = np.diff(places, axis=0, prepend=np.zeros((1, 2), places.dtype))
    return {
        "layer": outline.layer,
        "corners": pack_array(np.asarray(outline.corners, np.float32)),
        "dx": pack_array(np.asarray(steps[:, 0], np.int32)),
        "dy": pack_array(np.asarray(steps[:, 1], np.int32)),
        "notes": _plain(outline.notes),
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
