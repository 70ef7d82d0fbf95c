"""Files for KLayout: layer properties (.lyp) and violation markers (.lyrdb)."""

from pathlib import Path
from xml.etree import ElementTree

from layout.drc.report import DrcReport, RuleViolation
from layout.formats.library import MaskLibrary
from layout.mask.plan import MaskPlan
from metalens.core import store

_COLOURS = (
    "#1f6feb",
    "#d1495b",
    "#2a9d8f",
    "#e9a23b",
    "#6d597a",
    "#4b7f52",
    "#b56576",
    "#355070",
)
_FRAMES = ("aperture", "outline", "fields")
_HOLLOW, _DOTTED = "I1", "I9"  # KLayout's stipple patterns


def write_lyp(plan: MaskPlan | MaskLibrary, path: str | Path) -> None:
    """Write layer properties: a name and a colour for each layer that ``plan`` uses.

    Args:
        path: of the file.
    """
    root = ElementTree.Element("layer-properties")
    for n, (layer, datatype) in enumerate(sorted(plan.layers)):
        name = plan.layer_names.get((layer, datatype), f"layer_{layer}_{datatype}")
        colour = _COLOURS[n % len(_COLOURS)]
        entry = ElementTree.SubElement(root, "properties")
        _add_texts(
            entry,
            {
                "frame-color": colour,
                "fill-color": colour,
                "dither-pattern": _HOLLOW if name in _FRAMES else _DOTTED,
                "visible": "true",
                "name": name,
                "source": f"{layer}/{datatype}@1",
            },
        )
    _write_xml(root, path)


def write_lyrdb(report: DrcReport, top_cell: str, path: str | Path) -> None:
    """Write a marker database: a category for each rule, a box for each listed
    violation.

    Args:
        report: of any check.
        top_cell: name of the cell that the boxes refer to.
        path: file to write.
    """
    root = ElementTree.Element("report-database")
    _add_texts(
        root,
        {
            "description": "design-rule check",
            "original-file": "",
            "generator": "metalens layout",
            "top-cell": top_cell,
            "tags": "",
        },
    )
    categories = ElementTree.SubElement(root, "categories")
    for rule, count in report.counts.items():
        about = f"{count:,} violations, limit {report.limits[rule]:g}"
        category = ElementTree.SubElement(categories, "category")
        _add_texts(category, {"name": rule, "description": about, "categories": ""})
    cells = ElementTree.SubElement(root, "cells")
    cell = ElementTree.SubElement(cells, "cell")
    _add_texts(
        cell, {"name": top_cell, "variant": "", "layout-name": "", "references": ""}
    )
    items = ElementTree.SubElement(root, "items")
    for violation in report.violations:
        _add_marker(items, violation, top_cell, report.unit_nm)
    _write_xml(root, path)


def _add_marker(
    items: ElementTree.Element, violation: RuleViolation, top_cell: str, unit_nm: float
) -> None:
    """Append the marker of a violation: its category, box in um and text.

    Args:
        items: element that receives the marker.
        violation: rule, box and values.
        top_cell: name of the cell that the box refers to.
        unit_nm: database unit.
    """
    item = ElementTree.SubElement(items, "item")
    _add_texts(
        item,
        {
            "tags": "",
            "category": f"'{violation.rule}'",
            "cell": top_cell,
            "visited": "false",
            "multiplicity": "1",
            "comment": "",
        },
    )
    values = ElementTree.SubElement(item, "values")
    left, bottom, right, top = (
        coordinate * unit_nm / 1e3 for coordinate in violation.box
    )
    box = f"box: ({left:.6g},{bottom:.6g};{right:.6g},{top:.6g})"
    text = f"text: '{violation.summary}'"
    for value in (box, text):
        ElementTree.SubElement(values, "value").text = value


def _add_texts(parent: ElementTree.Element, texts: dict[str, str]) -> None:
    """Append one element for each name, with its text."""
    for name, text in texts.items():
        ElementTree.SubElement(parent, name).text = text or None


def _write_xml(root: ElementTree.Element, path: str | Path) -> None:
    """Write an indented XML document."""
    ElementTree.indent(root, " ")
    body = ElementTree.tostring(root, encoding="unicode")
    store.write_text(path, f'<?xml version="1.0" encoding="utf-8"?>\n{body}\n')
