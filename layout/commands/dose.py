"""Proximity effect correction of any mask file (GDSII or OASIS): ``metalens dose``."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from layout.formats import gdsii_write, job_files, oasis_write
from layout.formats.library import MaskLibrary
from layout.formats.reading import read_mask
from layout.pec.shapes import correct
from layout.process import process as processes
from layout.verify.exposure import verify_polygons
from metalens.commands import CommonOptions, Output
from metalens.core.errors import ProcessError


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens dose``.

    Attributes:
        mask: GDSII or OASIS file of any polygons.
        process: PROCESS.toml with the point exposure.
        output: folder for the mask and its doses.csv.
        layer: number of the layer that is exposed, all datatypes together; omitted: the
            only one of the file.
        thousandths: the datatype is 1000 times the dose; omitted: the number of the
            dose class, for doses.csv.
    """

    mask: tyro.conf.Positional[Path]
    process: Path
    output: Output = Path("dosed")
    layer: int | None = None
    thousandths: bool = False


def run(options: Options) -> int:
    """Correct a mask, write it, and expose the written file; exit 1 where an edge misses
    its dose.

    Args:
        options: of the command.

    Raises:
        ProcessError: no point exposure, several layers, too many shapes.
    """
    with options.claim_folder(options.output) as draft:
        process = processes.load_process(options.process)
        content = read_mask(options.mask)
        dosed = correct(
            content,
            process.exposure,
            layer=options.layer,
            thousandths=options.thousandths,
        )
        if not isinstance(dosed, MaskLibrary):
            raise ProcessError(f"{options.mask}: no mask of polygons")
        is_oasis = content.kind == "OASIS"
        write = oasis_write.write_oasis if is_oasis else gdsii_write.write_gdsii
        path = draft.path / f"mask.{'oas' if is_oasis else 'gds'}"
        write(dosed, path)
        job_files.write_dose_table(dosed, process, draft.path / "doses.csv")
        table = job_files.read_dose_table(draft.path / "doses.csv")
        report = verify_polygons(read_mask(path), table, process.exposure)
    worst, worst_nm = 100 * report.worst_exposure, report.worst_nm
    text = (
        f"{len(table)} doses from {min(table.values()):.3f} to {max(table.values()):.3f}; "
        f"edges off by up to {worst:.2g} % and {worst_nm:.2g} nm"
    )
    values = {
        "ok": report.ok,
        "doses": len(table),
        "edges": len(report.edges.x_um),
        "worst_relative": report.worst_exposure,
        "worst_nm": worst_nm,
    }
    failures = (
        [] if report.ok else [f"exposure off by {worst:.2g} %, {worst_nm:.2g} nm"]
    )
    return options.console.judged(values, f"{options.output}: {text}", failures)
