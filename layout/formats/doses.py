"""The dose table beside a mask: relative dose of each (layer, datatype), as CSV, and
what it leaves out.

Pattern-preparation programs (BEAMER, and the job files of JEOL, Raith and Elionix
writers) take doses by layer and
datatype from a table of those columns; the first three are theirs, the others are for
people.
"""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from layout.formats.content import MaskContent
from layout.process import LayerNumber, Process
from metalens.core import reading, store
from metalens.core.errors import MaskFileError

HEAD = ("layer", "datatype", "relative_dose", "dose_uC_cm2", "step", "name")


class DosedMask(Protocol):
    """A mask that knows the doses and names of its layers."""

    @property
    def doses(self) -> Mapping[LayerNumber, float]:
        """Relative dose of each (layer, datatype) that is exposed."""
        ...

    @property
    def layer_names(self) -> Mapping[LayerNumber, str]:
        """Shown by viewers."""
        ...


def write_dose_table(plan: DosedMask, process: Process, path: str | Path) -> None:
    """Write the table, one line for each (layer, datatype) that is exposed, rising."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(HEAD)
    for layer, dose in sorted(plan.doses.items()):
        step = "aperture" if layer[0] == process.layers.aperture[0] else "pillars"
        name = plan.layer_names.get(layer, "")
        out.writerow(
            [
                *layer,
                f"{dose:.6f}",
                f"{dose * process.exposure.base_uC_cm2:.3f}",
                step,
                name,
            ]
        )
    store.write_text(path, text.getvalue())


def read_dose_table(path: str | Path) -> dict[LayerNumber, float]:
    """{(layer, datatype): relative dose} of a table.

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
    found: dict[LayerNumber, float] = {}
    for number, row in enumerate(rows, 2):
        try:
            layer, dose = (
                (int(row["layer"]), int(row["datatype"])),
                float(row["relative_dose"]),
            )
        except (KeyError, TypeError, ValueError):
            raise MaskFileError(
                f"{path}, line {number}: need columns {', '.join(HEAD[:3])} of numbers"
            ) from None
        if layer in found or not 0 < dose < 1e6:
            raise MaskFileError(
                f"{path}, line {number}: layer {layer} with dose {dose}: twice, or no dose above 0"
            )
        found[layer] = dose
    return found


def layers_without_dose(
    content: MaskContent, doses: Mapping[LayerNumber, float], process: Process
) -> tuple[LayerNumber, ...]:
    """Layers of a file that hold shapes to be exposed and have no dose; outline and
    write fields are not exposed.
    """
    layers = process.layers
    drawn = {
        layer
        for cell in content.cells.values()
        for layer in (*cell.polygons, *cell.circles)
    }
    return tuple(sorted(drawn - {layers.outline, layers.fields} - set(doses)))
