"""STEP assemblies with shared instances, labels and colours, the same bytes for the
same input.

The CAD kernel writes shapes, structure and colours. It counts occurrences on from file
to file, and writes styles in
the order of memory addresses: both are renumbered here.
"""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from layout.solid.sections import Section
from layout.solid.tile import Tile, check_count
from metalens.cell.shapes import Conic, Loop
from metalens.ground import store
from metalens.ground.errors import ProcessError

_TIME = "2000-01-01T00:00:00"  # in the header of every file
# one for each solid, its styles behind it
_STYLES = "MECHANICAL_DESIGN_GEOMETRIC_PRESENTATION_REPRESENTATION"
_ENTITY = re.compile(r"^#(\d+) = (.*?;)$", re.MULTILINE | re.DOTALL)
_REFERENCE = re.compile(r"#(\d+)")


@dataclass(frozen=True, eq=False, slots=True)
class Piece:
    """A solid of the CAD kernel (``wrapped``, at its own origin) and the locations at
    which it stands.

    places: (x, y, z) in the unit of the file. colour: red, green, blue from 0 to 1.
    """

    label: str
    wrapped: Any
    colour: tuple[float, float, float]
    places: Sequence[tuple[float, float, float]]


def write_step(path: str | Path, pillars: Tile) -> None:
    """STEP (AP214) of an assembly ``metalens tile`` of tapered pillars on a slab of
    substrate.

    Each class of pillars is stored once. Modelled in um, where the kernel's tolerance
    (1e-7) is far below a
    pillar, and written in mm as STEP readers expect.

    Raises:
        ProcessError: too many pillars (a square that would do is named). OSError: the
            target cannot be written.
    """
    check_count(pillars, "STEP")
    from build123d import Solid

    x, y, half = pillars.x_um, pillars.y_um, pillars.pitch_um / 2
    slab = Solid.make_box(
        float(np.ptp(x)) + 2 * half, float(np.ptp(y)) + 2 * half, 1.0
    ).wrapped
    corner = (float(x.min()) - half, float(y.min()) - half, -1.0)
    pieces = [Piece("substrate", slab, (0.75, 0.85, 0.95), [corner])]
    for kind, section in enumerate(pillars.sections):
        here = pillars.kind == kind
        places = [
            (x, y, 0.0)
            for x, y in zip(
                pillars.x_um[here].tolist(), pillars.y_um[here].tolist(), strict=True
            )
        ]
        pieces.append(
            Piece(
                section.name,
                _pillar(section, pillars.height_um),
                (0.25, 0.35, 0.75),
                places,
            )
        )
    write_pieces(path, "metalens tile", pieces, unit_m=1e-6)


def write_pieces(
    path: str | Path, label: str, pieces: Sequence[Piece], *, unit_m: float
) -> None:
    """Write an assembly of placed solids; the numbers are in ``unit_m`` metres, the
    file in mm.

    Raises:
        ProcessError: the kernel could not write. OSError: the target cannot be written.
    """
    from OCP.gp import gp_Trsf, gp_Vec
    from OCP.Quantity import Quantity_Color, Quantity_TypeOfColor
    from OCP.TopLoc import TopLoc_Location
    from OCP.XCAFDoc import XCAFDoc_ColorType

    document, shapes, colours = _document(unit_m)
    root = shapes.NewShape()
    _name(root, label)
    for piece in pieces:
        stored = shapes.AddShape(piece.wrapped, False)
        _name(stored, piece.label)
        shade = Quantity_Color(*piece.colour, Quantity_TypeOfColor.Quantity_TOC_sRGB)
        colours.SetColor(stored, shade, XCAFDoc_ColorType.XCAFDoc_ColorGen)
        for place in piece.places:
            move = gp_Trsf()
            move.SetTranslation(gp_Vec(*place))
            shapes.AddComponent(root, stored, TopLoc_Location(move))
    shapes.UpdateAssemblies()
    with store.replacing(path) as part:
        if not _write(document, part):
            raise ProcessError(
                f"{path}: the CAD kernel could not write the STEP file; is the disk full?"
            )
        text = part.read_text(encoding="utf-8")
        part.write_text(_ordered(_renumbered(text)), encoding="utf-8")


def _pillar(section: Section, height_um: float) -> Any:
    """Each part of the section as a body of its own, holes cut out of the first."""
    pairs = zip(section.foot.parts, section.top.parts, strict=True)
    whole, *holes = (
        _body(foot, top, height_um, upright=section.upright) for foot, top in pairs
    )
    for hole in holes:
        whole = (whole - hole).solid()
    return whole.wrapped


def _body(
    foot: Conic | Loop, top: Conic | Loop, height_um: float, *, upright: bool
) -> Any:
    from build123d import Face, Solid

    if (
        isinstance(foot, Conic)
        and isinstance(top, Conic)
        and foot.half_x_um == foot.half_y_um
    ):
        if upright:
            return Solid.make_cylinder(foot.half_x_um, height_um)
        return Solid.make_cone(foot.half_x_um, top.half_x_um, height_um)
    if upright:
        return Solid.extrude(Face(_wire(foot, 0.0)), (0, 0, height_um))
    return Solid.make_loft([_wire(foot, 0.0), _wire(top, height_um)], ruled=True)


def _wire(part: Conic | Loop, z_um: float) -> Any:
    from build123d import Location, Wire

    if isinstance(part, Conic):
        made = Wire.make_ellipse(part.half_x_um, part.half_y_um)
        return made.moved(Location((0, 0, z_um), (0, 0, math.degrees(part.angle_rad))))
    return Wire.make_polygon(
        [(x, y, z_um) for x, y in part.vertices(0).tolist()], close=True
    )


def _document(unit_m: float) -> tuple[Any, Any, Any]:
    """(document, its tools for shapes and colours)."""
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDocStd import TDocStd_Document
    from OCP.XCAFApp import XCAFApp_Application
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    document = TDocStd_Document(TCollection_ExtendedString("XmlOcaf"))
    XCAFApp_Application.GetApplication_s().NewDocument(
        TCollection_ExtendedString("MDTV-XCAF"), document
    )
    XCAFDoc_DocumentTool.SetLengthUnit_s(document, unit_m)
    shapes = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    shapes.SetAutoNaming_s(False)
    return document, shapes, XCAFDoc_DocumentTool.ColorTool_s(document.Main())


def _name(label: Any, text: str) -> None:
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDataStd import TDataStd_Name

    TDataStd_Name.Set_s(label, TCollection_ExtendedString(text))


def _write(document: Any, path: Path) -> bool:
    from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
    from OCP.IFSelect import IFSelect_ReturnStatus
    from OCP.Message import Message, Message_Gravity
    from OCP.STEPCAFControl import STEPCAFControl_Writer
    from OCP.STEPControl import STEPControl_StepModelType
    from OCP.TCollection import TCollection_HAsciiString

    for printer in Message.DefaultMessenger_s().Printers():
        printer.SetTraceLevel(Message_Gravity.Message_Fail)  # else it prints statistics
    writer = STEPCAFControl_Writer()
    writer.SetNameMode(True)
    writer.SetColorMode(True)
    writer.Transfer(document, STEPControl_StepModelType.STEPControl_AsIs)
    header = APIHeaderSection_MakeHeader(writer.Writer().Model())
    header.SetTimeStamp(TCollection_HAsciiString(_TIME))
    return bool(writer.Write(str(path)) == IFSelect_ReturnStatus.IFSelect_RetDone)


def _renumbered(text: str) -> str:
    """Occurrences counted from 1."""
    count = itertools.count(1)
    found = r"NEXT_ASSEMBLY_USAGE_OCCURRENCE\('\d+'"
    return re.sub(
        found, lambda _: f"NEXT_ASSEMBLY_USAGE_OCCURRENCE('{next(count)}'", text
    )


def _ordered(text: str) -> str:
    """Styles, which stand last, in the order of the solids that they style."""
    if _STYLES not in text:
        return text
    start, end = text.rindex("#", 0, text.index(_STYLES)), text.rindex("ENDSEC;")
    # the kernel breaks lines by the length of its own numbers: a break less or more at
    # 999 and 1000
    styles = {
        int(n): re.sub(r"\n\s*", "", body)
        for n, body in _ENTITY.findall(text[start:end])
    }
    uses = {n: [int(m) for m in _REFERENCE.findall(body)] for n, body in styles.items()}
    new: dict[int, int] = {}

    def number(n: int) -> None:
        if n in styles and n not in new:
            new[n] = min(styles) + len(new)
            for other in uses[n]:
                number(other)

    def solid(n: int) -> list[int]:
        return sorted(
            m for item in uses[n] for m in uses.get(item, ()) if m not in styles
        )

    for n in sorted(
        (n for n, body in styles.items() if body.startswith(_STYLES)), key=solid
    ):
        number(n)
    lines = [
        f"#{new[n]} = "
        + _REFERENCE.sub(lambda m: f"#{new.get(int(m[1]), int(m[1]))}", styles[n])
        for n in new
    ]
    return text[:start] + "\n".join(lines) + "\n" + text[end:]
