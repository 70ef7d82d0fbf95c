"""What the writer's operator gets with the mask: the write fields in their order, and
a job sheet as text.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from layout.formats.library import MaskLibrary, library_of
from layout.mask.fields import FieldPlan
from layout.mask.plan import MaskPlan
from layout.process.process import LayerNumber, Process
from layout.shapes import polygon, region
from metalens.core import reading, store
from metalens.core.errors import MaskFileError
from metalens.core.units import nm

FIELD_HEAD = ("sequence", "x_um", "y_um", "width_um", "height_um", "pillars")
_OPEN = "________"


@dataclass(frozen=True)
class WriteStep:
    """One write field, in the order of writing.

    x_um, y_um: its middle, +y up; of a lens about its axis.
    width_um, height_um: its sides.
    pillars: in it.
    part: of an arrangement that it belongs to.
    """

    x_um: float
    y_um: float
    width_um: float
    height_um: float
    pillars: int
    part: str = ""


def field_sequence(split: FieldPlan) -> list[WriteStep]:
    """All fields that hold pillars, row by row and back.

    Args:
        split: write fields of a lens.
    """
    x, y = split.x_um.tolist(), split.y_um.tolist()
    steps = []
    for field_row, row in enumerate(split.pillars):
        occupied = np.flatnonzero(row)
        for field_column in (
            occupied if field_row % 2 == 0 else occupied[::-1]
        ).tolist():
            centre = (
                (x[field_column] + x[field_column + 1]) / 2,
                (y[field_row] + y[field_row + 1]) / 2,
            )
            width, height = (
                x[field_column + 1] - x[field_column],
                y[field_row + 1] - y[field_row],
            )
            steps.append(WriteStep(*centre, width, height, int(row[field_column])))
    return steps


def write_fields(steps: Sequence[WriteStep], path: str | Path) -> None:
    """The fields in their order, as CSV.

    Args:
        steps: of a lens, or of all parts of an arrangement.
        path: of the CSV file.
    """
    parts = any(step.part for step in steps)
    lines = [",".join([*FIELD_HEAD, *["part"] * parts])]
    for n, step in enumerate(steps, 1):
        place = f"{step.x_um:.4f},{step.y_um:.4f}"
        size = f"{step.width_um:.4f},{step.height_um:.4f}"
        part = f",{step.part}" * parts
        lines.append(f"{n},{place},{size},{step.pillars}{part}")
    store.write_text(path, "\n".join([*lines, ""]))


def charge_uC(
    areas: Mapping[LayerNumber, float],
    doses: Mapping[LayerNumber, float],
    process: Process,
) -> dict[str, float]:
    """{step: charge in uC} of both steps: base dose times relative dose times area.

    Args:
        areas: um^2 of each layer.
        doses: relative dose of each layer.
        process: base dose, and layer of the aperture.
    """
    charges = {"pillars": 0.0, "aperture": 0.0}
    for layer, dose in doses.items():
        step = "aperture" if layer[0] == process.layers.aperture[0] else "pillars"
        area_cm2 = areas.get(layer, 0.0) * 1e-8
        charges[step] += area_cm2 * dose * process.exposure.base_uC_cm2
    return charges


def charge_lines(charges: Mapping[str, float]) -> Iterator[str]:
    """Charge of each step and its time at 1 nA, for the job sheet.

    Args:
        charges: from :func:`charge_uC`.
    """
    for step, charge in charges.items():
        hours = charge * 1e3 / 3600
        yield (
            f"Step {step}: charge {charge:.4g} uC ({hours:.3g} h at 1 nA, without the "
            f"stage); beam current {_OPEN}"
        )


def dose_lines(
    areas: Mapping[LayerNumber, float],
    doses: Mapping[LayerNumber, float],
    names: Mapping[LayerNumber, str],
    process: Process,
) -> Iterator[str]:
    """The dose table with the area of each layer, for the job sheet.

    Args:
        areas: um^2 of each layer.
        doses: relative dose of each layer.
        names: of the layers.
        process: base dose.
    """
    yield (
        "Doses (layer/datatype, relative, uC/cm2, area um2, name); the same in "
        "doses.csv:"
    )
    for layer, dose in sorted(doses.items()):
        absolute = dose * process.exposure.base_uC_cm2
        yield (
            f"  {layer[0]:>4}/{layer[1]:<4} {dose:.6f} {absolute:>10.3f} "
            f"{areas.get(layer, 0.0):>14,.1f}  {names.get(layer, '')}"
        )


def marks_um(plan: MaskPlan) -> list[tuple[float, float, float, float]]:
    """(x, y, width, height) of each mark, from the lower left on.

    Args:
        plan: of a die.
    """
    shapes = [
        shape
        for figure in (plan.standing or plan).figures
        if figure.name == "MARKS"
        for drawn in figure.polygons.values()
        for shape in drawn
    ]
    boxes = [
        (contour.min(0), contour.max(0))
        for contour in region.union_contours(shapes)
        if polygon.twice_area(contour) > 0
    ]
    scale = plan.unit_nm * nm
    marks = [
        (*((low + high) / 2 * scale).tolist(), *((high - low) * scale).tolist())
        for low, high in boxes
    ]
    return sorted(marks, key=lambda mark: (round(mark[1]), round(mark[0])))


def job_sheet(
    plan: MaskPlan,
    process: Process,
    split: FieldPlan,
    files: Mapping[str, int],
    verdict: str,
) -> str:
    """Everything that an operator needs to set up the job, as text; what the machine
    decides is left open.

    Args:
        plan: of a die.
        process: base dose, layers and verniers.
        split: write fields.
        files: {name: bytes} of the mask files.
        verdict: first line of the report.
    """
    return "\n".join(_lines(plan, process, split, files, verdict)) + "\n"


def _lines(
    plan: MaskPlan,
    process: Process,
    split: FieldPlan,
    files: Mapping[str, int],
    verdict: str,
) -> Iterator[str]:
    """Lines of the job sheet of a lens: files, writer, doses, fields and marks."""
    yield f"JOB SHEET  mask {plan.name}  process {process.name!r}  tone {process.tone}"
    yield verdict
    yield ""
    yield "Files (top cell, database unit):"
    for name, size in sorted(files.items()):
        yield f"  {name:<16} {size:>14,} bytes"
    yield f"  top cell {plan.name}, {plan.unit_nm:g} nm; coordinates in um below: lens axis at (0, 0), +y up"
    yield ""
    yield f"Writer {_OPEN}   resist {_OPEN}   base dose {process.exposure.base_uC_cm2:g} uC/cm2"
    areas = library_of(plan).areas_um2()
    yield from charge_lines(charge_uC(areas, plan.doses, process))
    yield ""
    yield from dose_lines(areas, plan.doses, plan.layer_names, process)
    yield ""
    steps = field_sequence(split)
    yield f"Write fields: {len(steps)} ({split.mode}), in the order of fields.csv"
    yield f"  at most {split.size_um[0]:.3f} x {split.size_um[1]:.3f} um"
    yield f"  no border cuts a pillar; least distance {split.clearance_um / nm:.1f} nm"
    yield ""
    yield "Marks (middle x, y; width x height):"
    for x, y, width, height in marks_um(plan):
        yield f"  ({x:.3f}, {y:.3f}); {width:.3f} x {height:.3f}"
    if any(figure.name == "VERNIERS" for figure in (plan.standing or plan).figures):
        die = process.die
        yield ""
        yield (
            f"Verniers and a box in a box at the upper edge: pillars {die.vernier_pitch_um:g} um, aperture "
            f"{die.vernier_step_nm:g} nm longer from bar to bar"
        )
        yield (
            f"  bars that meet n to the left of the middle one (downwards for y): the aperture lies n x "
            f"{die.vernier_step_nm:g} nm to the right of the pillars (above them)"
        )


# doses

DOSE_HEAD = ("layer", "datatype", "relative_dose", "dose_uC_cm2", "step", "name")


DosedMask = MaskPlan | MaskLibrary


def write_dose_table(plan: DosedMask, process: Process, path: str | Path) -> None:
    """Write the table, one line for each (layer, datatype) that is exposed, rising.

    Args:
        plan: mask with doses and layer names.
        process: base dose, and layer of the aperture.
        path: of the CSV file.
    """
    lines = [",".join(DOSE_HEAD)]
    for layer, dose in sorted(plan.doses.items()):
        step = "aperture" if layer[0] == process.layers.aperture[0] else "pillars"
        absolute = dose * process.exposure.base_uC_cm2
        name = plan.layer_names.get(layer, "")
        lines.append(f"{layer[0]},{layer[1]},{dose:.6f},{absolute:.3f},{step},{name}")
    store.write_text(path, "\n".join([*lines, ""]))


def read_dose_table(path: str | Path) -> dict[LayerNumber, float]:
    """{(layer, datatype): relative dose} of a table.

    Args:
        path: of the CSV file.

    Raises:
        MaskFileError: missing file, missing columns, a line that is no dose or comes
            twice (line named).
    """
    path = Path(path)
    try:
        rows = list(csv.DictReader(reading.read_text(path).splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise MaskFileError(
            f"{path}: cannot be read as a dose table ({error})"
        ) from None
    doses: dict[LayerNumber, float] = {}
    for number, row in enumerate(rows, 2):
        try:
            layer = (int(row["layer"]), int(row["datatype"]))
            dose = float(row["relative_dose"])
        except (KeyError, TypeError, ValueError):
            raise MaskFileError(
                f"{path}, line {number}: need columns {', '.join(DOSE_HEAD[:3])} of numbers"
            ) from None
        if layer in doses or not 0 < dose < 1e6:
            raise MaskFileError(
                f"{path}, line {number}: layer {layer} with dose {dose}: twice, or no dose above 0"
            )
        doses[layer] = dose
    return doses
