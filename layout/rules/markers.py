"""Files beside the mask for KLayout: the layers with names and colours (.lyp), the
violations as markers (.lyrdb).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from layout.files import Assembly
from layout.mask import MaskPlan
from layout.rules.report import DrcReport, Violation
from metalens.ground import store

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


@dataclass(frozen=True, slots=True)
class Top:
    """Name of the top cell and database unit: all that markers need of a mask."""

    name: str
    unit_nm: float


Named = MaskPlan | Top
_HOLLOW = "I1"
_DOTTED = "I9"


def write_lyp(plan: MaskPlan | Assembly, path: str | Path) -> None:
    """Layer properties: a name and a colour for each layer of the mask."""
    root = ElementTree.Element("layer-properties")
    for n, layer in enumerate(sorted(plan.layers)):
        name = plan.layer_names.get(layer, f"layer_{layer[0]}_{layer[1]}")
        colour = _COLOURS[n % len(_COLOURS)]
        entry = ElementTree.SubElement(root, "properties")
        for key, value in (
            ("frame-color", colour),
            ("fill-color", colour),
            (
                "dither-pattern",
                _HOLLOW if name in ("aperture", "outline", "fields") else _DOTTED,
            ),
            ("visible", "true"),
            ("name", name),
            ("source", f"{layer[0]}/{layer[1]}@1"),
        ):
            ElementTree.SubElement(entry, key).text = value
    store.write_text(path, _text(root))


def write_lyrdb(plan: Named, report: DrcReport, path: str | Path) -> None:
    """Marker database of a check: one category for each rule, one box for each listed
    violation.
    """
    root = ElementTree.Element("report-database")
    for key, value in (
        ("description", "design-rule check of pillars as drawn"),
        ("original-file", ""),
        ("generator", "metalens layout"),
        ("top-cell", plan.name),
    ):
        ElementTree.SubElement(root, key).text = value
    ElementTree.SubElement(root, "tags")
    categories = ElementTree.SubElement(root, "categories")
    for rule, count in report.counts.items():
        category = ElementTree.SubElement(categories, "category")
        ElementTree.SubElement(category, "name").text = rule
        ElementTree.SubElement(
            category, "description"
        ).text = f"{count:,} violations, limit {report.limits[rule]:g}"
        ElementTree.SubElement(category, "categories")
    cell = ElementTree.SubElement(ElementTree.SubElement(root, "cells"), "cell")
    for key, value in (("name", plan.name), ("variant", ""), ("layout-name", "")):
        ElementTree.SubElement(cell, key).text = value
    ElementTree.SubElement(cell, "references")
    items = ElementTree.SubElement(root, "items")
    for violation in report.violations:
        _item(items, plan, violation)
    store.write_text(path, _text(root))


def _item(items: ElementTree.Element, plan: Named, violation: Violation) -> None:
    item = ElementTree.SubElement(items, "item")
    ElementTree.SubElement(item, "tags")
    for key, value in (
        ("category", f"'{violation.rule}'"),
        ("cell", plan.name),
        ("visited", "false"),
        ("multiplicity", "1"),
        ("comment", ""),
    ):
        ElementTree.SubElement(item, key).text = value
    values = ElementTree.SubElement(item, "values")
    for value in _values(plan, violation):
        ElementTree.SubElement(values, "value").text = value


def _values(plan: Named, violation: Violation) -> Iterator[str]:
    left, bottom, right, top = (v * plan.unit_nm / 1e3 for v in violation.box)
    yield f"box: ({left:.6g},{bottom:.6g};{right:.6g},{top:.6g})"
    yield f"text: '{violation.text}: {violation.value:.4g}, need {violation.limit:.4g}'"


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root, " ")
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        + ElementTree.tostring(root, encoding="unicode")
        + "\n"
    )
