"""Files for KLayout: layer properties (.lyp) and violation markers (.lyrdb)."""

from pathlib import Path
from xml.sax.saxutils import escape

from layout.drc.report import DrcReport
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
_XML = '<?xml version="1.0" encoding="utf-8"?>\n'
_HOLLOW, _DOTTED = "I1", "I9"  # KLayout's stipple patterns


def write_lyp(plan: MaskPlan | MaskLibrary, path: str | Path) -> None:
    """Write layer properties: a name and a colour for each layer that ``plan`` uses.

    Args:
        path: of the file.
    """
    entries = []
    for n, (layer, datatype) in enumerate(sorted(plan.layers)):
        name = plan.layer_names.get((layer, datatype), f"layer_{layer}_{datatype}")
        colour = _COLOURS[n % len(_COLOURS)]
        entries.append(
            f""" <properties>
  <frame-color>{colour}</frame-color>
  <fill-color>{colour}</fill-color>
  <dither-pattern>{_HOLLOW if name in _FRAMES else _DOTTED}</dither-pattern>
  <visible>true</visible>
  <name>{escape(name)}</name>
  <source>{layer}/{datatype}@1</source>
 </properties>
"""
        )
    text = "".join(entries)
    store.write_text(path, f"{_XML}<layer-properties>\n{text}</layer-properties>\n")


def write_lyrdb(report: DrcReport, top_cell: str, path: str | Path) -> None:
    """Write a marker database: a category for each rule, a box for each listed
    violation.

    Args:
        report: of any check.
        top_cell: name of the cell that the boxes refer to.
        path: file to write.
    """
    cell = escape(top_cell)
    categories = "".join(
        f"""  <category>
   <name>{rule}</name>
   <description>{count:,} violations, limit {report.limits[rule]:g}</description>
   <categories/>
  </category>
"""
        for rule, count in report.counts.items()
    )
    items = []
    for violation in report.violations:
        left, bottom, right, top = (v * report.unit_nm / 1e3 for v in violation.box)
        items.append(
            f"""  <item>
   <tags/>
   <category>'{violation.rule}'</category>
   <cell>{cell}</cell>
   <visited>false</visited>
   <multiplicity>1</multiplicity>
   <comment/>
   <values>
    <value>box: ({left:.6g},{bottom:.6g};{right:.6g},{top:.6g})</value>
    <value>text: '{escape(violation.summary)}'</value>
   </values>
  </item>
"""
        )
    store.write_text(
        path,
        f"""{_XML}<report-database>
 <description>design-rule check</description>
 <original-file/>
 <generator>metalens layout</generator>
 <top-cell>{cell}</top-cell>
 <tags/>
 <categories>
{categories} </categories>
 <cells>
  <cell>
   <name>{cell}</name>
   <variant/>
   <layout-name/>
   <references/>
  </cell>
 </cells>
 <items>
{"".join(items)} </items>
</report-database>
""",
    )
