"""lens.h5 to a mask: quantised, dosed, checked, written, read back and compared, with report and pictures."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from layout import build, drc, fields, gdsii_read, gdsii_write, markers, oasis_read, oasis_write, verify
from layout import process as processes
from layout.drc_report import DrcReport
from layout.dxf import Window
from layout.dxf import write as write_dxf
from layout.field_figure import with_fields
from layout.fields import FieldPlan
from layout.mask import MaskPlan
from metalens import config, store
from metalens import lens as lenses
from metalens.commands import Common, Output
from metalens.errors import ConfigError
from metalens.lens import Lens

_MASKS = ("mask.oas", "mask.gds", "mask.dxf", "pillars.stl", "pillars.step", "module.step")


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens layout``.

    Attributes:
        lens: the lens file.
        process: PROCESS.toml; left out: 100 kV electron-beam defaults.
        output: folder for the mask and its report.
        oasis: write OASIS (with --gds the default where neither is asked for).
        gds: write GDSII.
        dxf: write DXF of a window.
        step: write STEP of die, aperture, mount and module, with a tile of pillars.
        stl: write STL, 3MF and glTF of the tapered pillars of a window.
        form: of OASIS: fewest bytes, least time, or one repetition for each diameter.
        circles: true circles in OASIS in place of polygons.
        window: of DXF and STL.
        name: of the top cell.
        dose: proximity correction, where the process asks for it.
        study: add stitching, tolerance (Monte Carlo) and the tolerant choice to the report.
    """

    lens: tyro.conf.Positional[Path]
    process: Path | None = None
    output: Output = Path("mask")
    oasis: bool = False
    gds: bool = False
    dxf: bool = False
    step: bool = False
    stl: bool = False
    form: Literal["small", "fast", "reader"] = "small"
    circles: bool = False
    window: Window = field(default_factory=Window)
    name: str = "METALENS"
    dose: bool = True
    study: bool = False


@dataclass(eq=False, slots=True)
class Job:
    """What a run of the command has made so far.

    seconds: of each stage. written: {file name: bytes}. compared: {file name: outcome of reading it back}.
    """

    options: Options
    source: Lens
    process: processes.Process
    made: build.MadePlan
    fields: FieldPlan
    plan: MaskPlan
    drc: DrcReport
    seconds: dict[str, float]
    written: dict[str, int] = field(default_factory=dict)
    compared: dict[str, verify.Comparison] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether the rules hold and every file reads back as planned."""
        return self.drc.ok and all(outcome.ok for outcome in self.compared.values())


def run(options: Options) -> int:
    """Make the mask; exit 1 where a rule is broken or a file does not read back as planned."""
    target = options.claim(options.output)
    if target.exists() and not target.is_dir():
        raise ConfigError(f"{target} is a file; need a folder for the mask")
    job = _prepare(options)
    target.mkdir(exist_ok=True)
    _write_masks(job, target)
    for name in _MASKS:
        if name not in job.written:
            (target / name).unlink(missing_ok=True)  # of an earlier run: it would not match the report
    with _timed(job.seconds, "report"):
        _accompany(job, target)
    values = _values(job)
    store.write_text(target / "layout.json", json.dumps(values, indent=1) + "\n")
    options.console.result(values, _text(job, target))
    return 0 if job.ok else 1


def _prepare(options: Options) -> Job:
    seconds: dict[str, float] = {}
    with _timed(seconds, "read"):
        source = lenses.load(options.lens)
        rules = processes.Process() if options.process is None else processes.load(options.process)
    with _timed(seconds, "classes and dose"):
        made = build.prepare(source, rules, name=options.name, dosed=options.dose)
    with _timed(seconds, "write fields"):
        split = fields.split(source.diameters, rules)
        plan = with_fields(made.plan, split, rules)
    with _timed(seconds, "check"):
        found = drc.check(plan, rules.rules)
    return Job(options, source, rules, made, split, plan, found, seconds)


def _write_masks(job: Job, target: Path) -> None:
    options, plan = job.options, job.plan
    neither = not (options.oasis or options.gds)
    if options.oasis or neither:
        path = target / "mask.oas"
        with _timed(job.seconds, "write OASIS"):
            oasis_write.write(plan, path, form=options.form, circles=options.circles)
        _read_back(job, path, oasis_read.read)
    if options.gds or neither:
        path = target / "mask.gds"
        with _timed(job.seconds, "write GDSII"):
            gdsii_write.write(plan, path)
        _read_back(job, path, gdsii_read.read)
    if options.dxf:
        with _timed(job.seconds, "write DXF"):
            write_dxf(plan, target / "mask.dxf", window=options.window)
        job.written["mask.dxf"] = (target / "mask.dxf").stat().st_size
    if options.stl or options.step:
        _write_solids(job, target)


def _write_solids(job: Job, target: Path) -> None:
    from layout import solid_files

    options, made = job.options, []
    if options.stl:
        with _timed(job.seconds, "write STL"):
            made += solid_files.write_stl(job.source, job.process, target, options.window)
    if options.step:
        with _timed(job.seconds, "write STEP"):
            made += solid_files.write_step(job.source, job.process, target, options.window)
    job.written |= {path.name: path.stat().st_size for path in made}


def _read_back(job: Job, path: Path, read: Callable[[Path], Any]) -> None:
    with _timed(job.seconds, f"read back {path.suffix[1:]}"):
        job.compared[path.name] = verify.compare(job.plan, read(path))
    job.written[path.name] = path.stat().st_size


def _accompany(job: Job, target: Path) -> None:
    """Layer properties, markers, report and pictures."""
    from layout import page

    markers.write_lyp(job.plan, target / "mask.lyp")
    markers.write_lyrdb(job.plan, job.drc, target / "mask.lyrdb")
    store.write_text(target / "process.toml", config.dumps(job.process))
    page.write(job, target)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def _values(job: Job) -> dict[str, Any]:
    found = job.drc
    return {
        "ok": job.ok,
        "pillars": found.pillars,
        "classes": len(job.plan.classes),
        "diameters": len(job.made.cells.diameters_nm),
        "minimum_gap_nm": found.minimum_gap_nm,
        "minimum_feature_nm": found.minimum_feature_nm,
        "maximum_density": found.maximum_density,
        "violations": found.counts,
        "files": job.written,
        "differences": {name: list(outcome.differences) for name, outcome in job.compared.items()},
        "seconds": job.seconds,
    }


def _text(job: Job, target: Path) -> str:
    lines = [job.drc.summary]
    for name, size in job.written.items():
        outcome = job.compared.get(name)
        verdict = "" if outcome is None else (", reads back as planned" if outcome.ok else ", DIFFERS FROM THE PLAN")
        lines.append(f"  {target / name}: {size / 1e6:.3g} MB{verdict}")
        if outcome is not None:
            lines += [f"    {difference}" for difference in outcome.differences[:10]]
    lines += [
        f"  {v.rule} at ({v.centre[0]:.0f}, {v.centre[1]:.0f}) nm: {v.value:.4g}, need {v.limit:.4g}; {v.text}"
        for v in job.drc.violations[:10]
    ]
    lines.append(f"  {target / 'report.html'}; {sum(job.seconds.values()):.1f} s")
    return "\n".join(lines)
