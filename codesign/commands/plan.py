"""Which tolerances, depths and wavelengths suffice for a gaze error, at the least cost: settings files ready to run.

What is measured is kept beside the output (NAME.resume): after an interruption the same command goes on.
"""

import json
import math
import re
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import tyro

from codesign.adapt import train as retraining
from codesign.budget import Chain, Journal, Pilot, Plan, PlanConfig, floor, plan, total
from codesign.evaluate import ExperimentConfig
from metalens import __version__
from metalens.commands import Common, Output
from metalens.ground import config, report, store
from metalens.ground.errors import ConfigError

UNITS = {"deg": math.pi / 180, "arcmin": math.pi / 10_800, "mrad": 1e-3, "rad": 1.0}


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens plan``.

    Attributes:
        gaze_error: the goal, with its unit: 1deg, 50arcmin, 20mrad; of the whole error, from pillar to answered gaze.
        run: RUN_DIR of a co-design run: its reader is part of the floor; without one the floor is that of the person.
        frames: that the floor is measured on: subjects, stimuli, calibration, as those of the experiment.
        config: PLAN.toml of the lens and the run; left out: a 1 mm lens, 200 PSF stacks, 10 000 images.
        output: folder for cell.toml, psf.toml, run.toml, process.toml, plan.json and report.html.
    """

    gaze_error: str
    config: Path | None = None
    run: Path | None = None
    frames: tyro.conf.OmitArgPrefixes[ExperimentConfig] = field(default_factory=lambda: ExperimentConfig(subjects=5))
    output: Output = Path("plan")


def angle_rad(text: str) -> float:
    """An angle with its unit.

    Raises:
        ConfigError: no number above 0, or no unit.
    """
    found = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([a-z]+)\s*", text)
    try:
        value = float(found[1]) * UNITS[found[2]] if found else math.nan
    except (ValueError, KeyError):
        value = math.nan
    if not (0 < value < math.inf):
        raise ConfigError(
            f"gaze error {text!r}: need a number above 0 with a unit, as 0.1deg; units: {', '.join(UNITS)}"
        )
    return value


def run(options: Options) -> int:
    """Measure, choose, write; exit 1 where even the finest settings miss the goal.

    Raises:
        ConfigError: the goal is below what no setting changes.
    """
    goal = angle_rad(options.gaze_error)
    wanted = PlanConfig() if options.config is None else config.load(options.config, PlanConfig, empty=False)
    target = options.output
    with options.claim_folder(target) as draft:
        rig = replace(wanted.task.rig, sensor_distance_um=wanted.focus.sensor_distance_um)
        run = retraining.load(options.run) if options.run else None
        least = floor.floor(rig, run, options.frames, fwhm_nm=wanted.led_fwhm_nm)
        floor.allowance_rad(goal, least)
        chain = Chain(wanted, options.console.say)
        journal = Journal(target.with_name(target.name + ".resume"), f"{__version__}\n{config.dumps(wanted)}")
        measured = plan.pilot(chain, journal, floor=least)
        best = plan.choose(measured, goal, wanted)
        write(draft.path, best, measured, chain)
    journal.finish()
    options.console.result(values(best, measured), text(best, measured, target))
    return 0 if best.met else 1


def values(best: Plan, measured: Pilot) -> dict[str, object]:
    """The plan for --json and plan.json."""
    return {
        "goal_deg": math.degrees(best.goal_rad),
        "met": best.met,
        "predicted_deg": math.degrees(best.predicted_rad),
        "choice": asdict(best.choice),
        "seconds": best.seconds,
        "finest_seconds": best.finest_seconds,
        "pilot_seconds": measured.spent_seconds,
        "noise_deg": math.degrees(measured.noise_rad),
        "floor_deg": {entry.link: math.degrees(entry.gaze_rad) for entry in measured.floor},
    }


def write(folder: Path, best: Plan, measured: Pilot, chain: Chain) -> None:
    """Settings files for the commands, plan.json and the report."""
    choice, wanted = best.choice, chain.config
    cell = config.dumps(wanted.cell)
    lines = [line for line in cell.splitlines() if line]
    split = next((i for i, line in enumerate(lines) if line.startswith("[")), len(lines))
    tables = [line.replace("[", "[cell.", 1) if line.startswith("[") else line for line in lines[split:]]
    sweep = [f"wavelengths_um = [{wanted.wavelength_nm * 1e-3}]", f"tolerance = {choice.library_tolerance}"]
    store.write_text(folder / "cell.toml", "\n".join(["[cell]", *lines[:split], *tables, "", "[sweep]", *sweep]) + "\n")
    near, far = (1e-3 * d for d in chain.eyes.depths_um)
    step = (far - near) / (choice.depth_count - 1)
    store.write_text(
        folder / "psf.toml",
        f"depths_mm = [{near:.3f}, {far:.3f}, {step:.4f}]\nangles_deg = [0.0]\nled_fwhm_nm = {wanted.led_fwhm_nm}\n"
        f"tolerance = {choice.psf_tolerance}\n",
    )
    store.write_text(
        folder / "run.toml",
        f"[optics]\naperture_mm = {wanted.aperture_mm}\ndepth_count = {choice.depth_count}\n"
        f"depths_mm = [{near:.3f}, {far:.3f}]\ntolerance = {choice.kernel_tolerance}\n",
    )
    store.write_text(folder / "process.toml", f"[rules]\ndiameter_step_nm = {int(choice.diameter_step_nm)}\n")
    store.write_text(folder / "plan.json", json.dumps(values(best, measured), indent=1) + "\n")
    _page(folder / "report.html", best, measured)


def _page(path: Path, best: Plan, measured: Pilot) -> None:
    keys = [
        report.KeyFigure("goal", f"{math.degrees(best.goal_rad):.2g}°"),
        report.KeyFigure("predicted", f"{math.degrees(best.predicted_rad):.2g}°", best.met),
        report.KeyFigure("the run", f"{best.seconds:.0f} s"),
        report.KeyFigure("everything at its finest", f"{best.finest_seconds:.0f} s"),
    ]
    rows = []
    for knob, levels in measured.levels.items():
        chosen = getattr(best.choice, knob)
        for level, error, seconds in zip(levels, measured.errors[knob], measured.seconds[knob], strict=True):
            gaze = math.degrees(float((error**2).sum(-1).mean() ** 0.5))
            rows.append(
                (
                    report.in_words(knob),
                    f"{level:g}",
                    f"{gaze:.2g}",
                    f"{seconds:.3g}",
                    "chosen" if level == chosen else "",
                )
            )
    table = report.Table(
        ("knob", "setting", "gaze error / deg", "seconds", ""),
        rows,
        "Seconds: of a library, a stack, an image, a mask.",
    )
    words = (
        "Every setting was measured alone in a pilot; errors add as vectors over the eyes. What no setting changes is "
        f"the floor: {floor_words(measured)}. The process comes on top (metalens budget)."
    )
    report.write(path, "Plan of a run", [report.Section("Settings", words, (table,))], key_figures=keys)


def text(best: Plan, measured: Pilot, folder: Path) -> str:
    """The plan for a terminal."""
    rows = [f"  {name.replace('_', ' '):<20} {value:g}" for name, value in asdict(best.choice).items()]
    verdict = "" if best.met else "  THE GOAL IS NOT MET by the finest settings on offer\n"
    return (
        f"{folder}: gaze error {math.degrees(best.predicted_rad):.2g} deg predicted, "
        f"{math.degrees(best.goal_rad):.2g} allowed\n"
        + "\n".join(rows)
        + f"\n{verdict}  run {best.seconds:.0f} s, everything at its finest {best.finest_seconds:.0f} s; "
        f"the pilot took {measured.spent_seconds:.0f} s\n"
        f"  floor, whatever the settings: {floor_words(measured)}"
    )


def floor_words(measured: Pilot) -> str:
    """The floor and its links."""
    links = ", ".join(f"{entry.link} {math.degrees(entry.gaze_rad):.2g} deg" for entry in measured.floor)
    return f"{math.degrees(total(list(measured.floor)).gaze_rad):.2g} deg ({links or 'no links'})"
