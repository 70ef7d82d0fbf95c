"""The parts of an arrangement: every lens as a mask of its own, cells of other files,
what stands around them.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from layout.arrange import (
    CellPart,
    Floorplan,
    FrameSettings,
    LensPart,
    WaferSettings,
    apart,
    joined,
    parts,
    wafer,
)
from layout.commands import make
from layout.commands.check import read_mask
from layout.commands.job import Options
from layout.commands.stages import StageTimes
from layout.drc import DrcReport, Violation, check_library, check_plan
from layout.formats import (
    MaskContent,
    compare,
    hierarchy,
    library_of,
    oasis_write,
    placement_limit,
)
from layout.mask import FieldPlan, MaskPlan, PillarLattice, build
from layout.process import LayerNumber
from layout.process import process as processes
from layout.verify import verify_exposure
from metalens import lens as lenses
from metalens.core import reading
from metalens.core.errors import MaskFileError
from metalens.lens import Lens


@dataclass(eq=False, slots=True)
class FloorplanWork:
    """What is known so far of an arrangement.

    failures: what keeps the mask from the writer. notes: what a person should know.
    unchecked: parts whose design rules nobody checked here.
    placed: parts on the die. near: those that stand too near each other.
    rules: what was found of each part that is checked here. splits: write fields of
    each lens. areas_um2: of each layer, over the whole mask. unlike: files that do not
    read back as planned.
    """

    options: Options
    record: Floorplan
    process: processes.Process
    folder: Path
    stages: StageTimes
    failures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)
    lenses: dict[str, dict[str, Any]] = field(default_factory=dict)
    written: dict[str, int] = field(default_factory=dict)
    dies: wafer.WaferDies | None = None
    placed: list[joined.PartPlacement] = field(default_factory=list)
    near: list[Violation] = field(default_factory=list)
    rules: dict[str, DrcReport] = field(default_factory=dict)
    splits: dict[str, FieldPlan] = field(default_factory=dict)
    areas_um2: dict[LayerNumber, float] = field(default_factory=dict)
    unlike: set[str] = field(default_factory=set)

    @property
    def verdict(self) -> str:
        """First line of everything that tells about the mask."""
        unchecked = "".join(
            f" NOT CHECKED: the design rules of {name} (checked = false)."
            for name in self.unchecked
        )
        if self.failures:
            return "FAILS: " + "; ".join(self.failures) + unchecked
        if unchecked:
            return f"No fault was found by the checks that were made.{unchecked}"
        return "The mask passes its own checks."

    def broken(self, name: str, found: DrcReport) -> None:
        """Enter what was found of the rules of a part."""
        self.rules[name] = found
        if not found.ok:
            self.failures.append(
                f"{name}: design rules violated: {found.violated or 'no shape to check'}"
            )

    def beside(self, file: Path) -> Path:
        """A file that the arrangement names."""
        return self.options.lens.parent / file


def draw_lens(work: FloorplanWork, part: LensPart) -> make.DrawnLens:
    """A lens as it is drawn, before the doses of the job are known."""
    options = dataclasses.replace(
        work.options, lens=work.beside(part.file), name=part.name
    )
    work.options.console.say(f"{part.name}: {part.file}")
    furniture: build.Furniture = "die" if work.record.furnished(part) else "aperture"
    return make.draw_lens(options, furniture=furniture)


def lens_part(
    work: FloorplanWork, drawing: make.DrawnLens, made: build.MadePlan
) -> parts.DieComponent:
    """A lens, with mask, report and job sheet in a folder of its own."""
    name = drawing.options.name
    folder = work.folder / name
    folder.mkdir()
    work.options.console.say(f"{name}: mask and report")
    job = make.make_mask(drawing, folder, made)
    work.failures += [f"{name}: {text}" for text in job.failures]
    work.lenses[name] = make.values_of(job)
    work.splits[name] = job.fields
    for stage, seconds in job.seconds.items():
        work.stages.seconds[f"{name}: {stage}"] = seconds
    path = next(
        path for path in (folder / "mask.oas", folder / "mask.gds") if path.is_file()
    )
    content = read_mask(path, make.MOST_READ, keep=make.KEPT)
    return parts.of_plan(
        name,
        job.plan,
        content,
        work.process,
        corrected=made.dose is not None,
        lattices=_lattices(job.plan),
    )


def _lattices(plan: MaskPlan) -> dict[str, PillarLattice]:
    """{cell: its lattice} in the files of a plan, stored whole or as an eighth."""
    pieces = library_of(plan, fold=True).sites
    whole = {lattice.name: lattice for lattice in plan.lattices}
    return whole | {name: piece.lattice for name, piece in pieces.items()}


def cell_part(work: FloorplanWork, part: CellPart) -> parts.DieComponent:
    """A cell of a file made elsewhere, held to the rules where it is to be."""
    made = _file_part(work, part)
    if part.checked:
        layers = work.process.layers
        with work.stages(f"{part.name}: check"):
            content = MaskContent("cell", parts.UNIT_NM, dict(made.cells))
            skip = (layers.outline[0], layers.fields[0])
            drawn = {number for number, _ in hierarchy.count_shapes(content)}
            found = check_library(
                content,
                work.process.rules,
                layers=[(number, None) for number in sorted(drawn.difference(skip))],
            )
        work.broken(part.name, found)
    else:
        work.unchecked.append(part.name)
    if work.process.exposure.corrected and made.uncorrected:
        work.failures.append(_uncorrected(part, made))
    return made


def _uncorrected(part: CellPart, made: parts.DieComponent) -> str:
    """That shapes of a file get doses that correct nothing, and the cure."""
    shapes = sum(made.uncorrected.values())
    names = ", ".join(f"{a}/{b}" for a, b in list(made.uncorrected)[:8])
    more = ", ..." if len(made.uncorrected) > 8 else ""
    doses = sorted({made.doses[layer] for layer in made.uncorrected})
    return (
        f"{part.name}: {shapes:,} shapes on {names}{more} of {part.file} get the "
        f"relative dose {', '.join(f'{dose:g}' for dose in doses)} without proximity "
        f"correction; correct the file and lay its doses.csv beside it, or set "
        f"exposure.correct = false"
    )


def _file_part(work: FloorplanWork, record: CellPart) -> parts.DieComponent:
    """A cell of a file."""
    path = work.beside(record.file)
    if not path.is_file():
        raise MaskFileError(
            f"{path}: {reading.missing_reason(path)}; need a GDSII or OASIS mask"
        )
    most = placement_limit(path)
    content = read_mask(path, most)
    hierarchy.refuse_beyond(content, most)
    made = parts.of_file(
        record.name,
        path,
        content,
        work.process,
        cell=record.cell,
        relative_dose=record.relative_dose,
    )
    for number, what in ((made.texts, "texts"), (made.empty, "shapes without area")):
        if number:
            work.notes.append(
                f"{number} {what} of {path.name} are left out: they draw nothing"
            )
    return made


def draw_surroundings(
    work: FloorplanWork, die: FrameSettings, placed: list[joined.PartPlacement]
) -> build.MadePlan:
    """Marks, label and test structures around all that is placed."""
    box = apart.extent_of_copies(placed, exposed=True) / joined.PER_UM
    return build.die_surroundings(
        _source(work),
        work.process,
        name="DIE",
        size_um=die.size_um,
        clear_um=max(-float(box[0]), float(box[2])) + apart.reach_um(work.process),
        label=die.label or work.record.name,
    )


def draw_wafer_mark(work: FloorplanWork, size: WaferSettings) -> build.MadePlan:
    """The alignment mark of a wafer."""
    return build.wafer_mark(
        _source(work),
        work.process,
        name="WMARK",
        mark_um=size.mark_um,
        width_um=size.mark_width_um,
    )


def _source(work: FloorplanWork) -> Lens:
    """Whose pillars the test structures repeat."""
    return lenses.load_out_of_core(work.beside(work.record.lens[0].file))


def written_part(work: FloorplanWork, made: build.MadePlan) -> parts.DieComponent:
    """What stands beside the lenses: checked, written, read back and verified as they
    are.
    """
    plan, process = made.plan, work.process
    name = plan.name
    with work.stages(f"{name}: check"):
        work.broken(name, check_plan(plan, process.rules))
    path = work.folder / f"{name}.oas"
    oasis_write.write_oasis(plan, path)
    content = read_mask(path, make.MOST_READ)
    path.unlink()
    work.failures += [
        f"{name}: {text}" for text in compare.compare(plan, content).differences
    ]
    if made.dose is not None and process.exposure.csv is None:
        with work.stages(f"{name}: verify exposure"):
            seen = verify_exposure(content, plan, plan.doses, process)
        if not seen.ok:
            work.failures.append(
                f"{name}: exposure off by {100 * seen.worst_exposure:.2g} % and {seen.worst_nm:.2g} nm"
            )
    return parts.of_plan(name, plan, content, process, corrected=made.dose is not None)
