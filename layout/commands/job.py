"""Options and results so far of ``metalens layout``."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from layout.arrange import assembly, wafer
from layout.arrange.record import DieFloorplan
from layout.drc.report import DrcReport, RuleViolation
from layout.formats import compare
from layout.formats.dxf import DxfWindow
from layout.mask import build
from layout.mask.fields import FieldPlan
from layout.mask.plan import MaskPlan
from layout.pec.correct import DoseLadder
from layout.process import process as processes
from layout.process.process import LayerNumber
from layout.verify.report import ExposureReport
from layout.verify.written_lens import LensRows
from metalens.commands import DistributedOptions, Output
from metalens.lens import Lens


@dataclass(frozen=True)
class Options(DistributedOptions):
    """Options of ``metalens layout``.

    Attributes:
        lens: the lens file, or an ARRANGEMENT.toml of lenses, cells of other files, and
            a wafer.
        process: PROCESS.toml; left out: 100 kV electron-beam defaults.
        output: folder for the mask and its report.
        oasis: write OASIS (with --gds the default where neither is asked for).
        gds: write GDSII.
        dxf: write DXF of a window.
        step: write STEP of the tapered pillars of a window.
        stl: write STL of the tapered pillars of a window.
        window: of DXF, STL and STEP.
        name: of the top cell.
        dose: proximity correction, where the process asks for it.
        study: add stitching and tolerance (Monte Carlo) to the report.
    """

    lens: tyro.conf.Positional[Path]
    process: Path | None = None
    output: Output = Path("mask")
    oasis: bool = False
    gds: bool = False
    dxf: bool = False
    step: bool = False
    stl: bool = False
    window: DxfWindow = field(default_factory=DxfWindow)
    name: str = "METALENS"
    dose: bool = True
    study: bool = False


@dataclass(eq=False)
class LayoutJob:
    """Results so far of a run of the command.

    say: announces each stage. written: {file name: bytes}. compared: {file name:
    outcome of reading it back}.
    verified: {file name: what the file and the dose table make, by the simulator}.
    predicted: sizes of the lens that results.
    """

    options: Options
    source: Lens
    process: processes.Process
    drawn: build.DrawnMask
    fields: FieldPlan
    plan: MaskPlan
    drc: DrcReport
    say: Callable[[str], None]
    dose: DoseLadder | None = None
    written: dict[str, int] = field(default_factory=dict)
    compared: dict[str, compare.ReadbackComparison] = field(default_factory=dict)
    verified: dict[str, ExposureReport] = field(default_factory=dict)
    predicted: LensRows | None = None

    @property
    def failures(self) -> list[str]:
        """What is wrong with the mask, in words, worst first; empty where it may go to
        the writer.
        """
        failures = [
            f"{name} does not read back as planned"
            for name, outcome in self.compared.items()
            if not outcome.ok
        ]
        exposure = self.process.exposure  # a fitted table has an error of its own
        needed, most = (
            0 if self.dose is None else self.dose.needed,
            exposure.maximum_classes,
        )
        too_few = f" ({needed} doses are needed, exposure.maximum_classes = {most})"
        if exposure.corrected and exposure.csv is None and self.options.dose:
            failures += [
                f"{name}: exposure off by {100 * report.worst_exposure:.2g} % and "
                f"{report.worst_nm:.2g} nm{too_few * (needed > most)}"
                for name, report in self.verified.items()
                if not report.ok
            ]
        if self.drc.violated:
            failures.append(f"design rules violated: {self.drc.violated}")
        return failures

    @property
    def ok(self) -> bool:
        """Whether the rules hold, every dose is there and every file reads back as
        planned.
        """
        return not self.failures

    @property
    def verdict(self) -> str:
        """First line of everything that tells about the mask."""
        return (
            "FAILS: " + "; ".join(self.failures)
            if self.failures
            else "The mask passes its own checks."
        )


@dataclass(eq=False)
class FloorplanWork:
    """What is known so far of an arrangement.

    failures: what keeps the mask from the writer.
    notes: what a person should know.
    unchecked: parts whose design rules nobody checked here.
    lenses: {name: values of its layout.json}.
    written: {file: bytes}.
    dies: on the wafer.
    placed: parts on the die.
    near: parts that stand too near each other.
    rules: violations of each part that is checked here.
    splits: write fields of each lens.
    areas_um2: of each layer, over the whole mask.
    different: files that do not read back as planned.
    """

    options: Options
    record: DieFloorplan
    process: processes.Process
    folder: Path
    say: Callable[[str], None]
    failures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)
    lenses: dict[str, dict[str, Any]] = field(default_factory=dict)
    written: dict[str, int] = field(default_factory=dict)
    dies: wafer.WaferDies | None = None
    placed: list[assembly.PartPlacement] = field(default_factory=list)
    near: list[RuleViolation] = field(default_factory=list)
    rules: dict[str, DrcReport] = field(default_factory=dict)
    splits: dict[str, FieldPlan] = field(default_factory=dict)
    areas_um2: dict[LayerNumber, float] = field(default_factory=dict)
    different: set[str] = field(default_factory=set)

    @property
    def corrected(self) -> bool:
        """Whether every shape gets a dose of its own."""
        return self.process.exposure.corrected

    @property
    def warnings(self) -> list[str]:
        """What was not checked, in words."""
        return [
            f"NOT CHECKED: the design rules of {name} (checked = false)."
            for name in self.unchecked
        ]

    @property
    def verdict(self) -> str:
        """First line of everything that is said of the mask."""
        if self.failures:
            return " ".join(["FAILS: " + "; ".join(self.failures), *self.warnings])
        if self.unchecked:
            passed = "No fault was found by the checks that were made."
            return " ".join([passed, *self.warnings])
        return "The mask passes its own checks."

    def judge_rules(self, name: str, report: DrcReport) -> None:
        """Enter the design-rule check of a part.

        Args:
            name: of the part.
            report: of its check.
        """
        self.rules[name] = report
        if not report.ok:
            violated = report.violated or "no shape to check"
            self.failures.append(f"{name}: design rules violated: {violated}")
