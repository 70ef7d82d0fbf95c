"""Which tolerances, depths and wavelengths suffice for a gaze error, at the least cost:
settings files ready to run.

What is measured is kept beside the output (NAME.resume): after an interruption the same
command goes on.
"""

import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path

from codesign.adapt import train as retraining
from codesign.budget import (
    Chain,
    Journal,
    Pilot,
    Plan,
    PlanConfig,
    floor,
    plan,
    same_geometry,
    total,
)
from codesign.commands.options.plan import Options
from metalens import __version__
from metalens.ground import config, reading, report, store
from metalens.ground.errors import ConfigError
from metalens.pillars import workers
from metalens.psf import spectrum

UNITS = {"deg": math.pi / 180, "arcmin": math.pi / 10_800, "mrad": 1e-3, "rad": 1.0}


def angle_rad(text: str) -> float:
    """An angle with its unit.

    Raises:
        ConfigError: no number above 0, none below a right angle, or no unit.
    """
    found = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([a-z]+)\s*", text)
    try:
        value = float(found[1]) * UNITS[found[2]] if found else math.nan
    except (ValueError, KeyError):
        value = math.nan
    if not 0 < value < math.pi / 2:
        raise ConfigError(
            f"gaze error {text!r}: need an angle above 0 and below 90deg with its unit, as 0.1deg; units: "
            f"{', '.join(UNITS)}"
        )
    return value


def run(options: Options) -> int:
    """Measure, choose, write; exit 1 where even the finest settings miss the goal, or
    the image its tolerance.

    Raises:
        ConfigError: the goal is below what no setting changes. LensError: the run is of
            another lens.
    """
    goal = angle_rad(options.gaze_error)
    wanted = (
        PlanConfig()
        if options.config is None
        else config.load(options.config, PlanConfig, empty=False)
    )
    target = options.output
    with options.claim_folder(target) as draft:
        rig = replace(
            wanted.task.rig, sensor_distance_um=wanted.focus.sensor_distance_um
        )
        run = retraining.load(options.run) if options.run else None
        if run is not None:
            same_geometry(
                wanted.geometry,
                run.settings.optics,
                "the plan; give PLAN.toml those of the run",
            )
        least = floor.floor(rig, run, options.frames, fwhm_nm=wanted.led_fwhm_nm)
        floor.allowance_rad(goal, least)
        chain = Chain(wanted, options.console.say)
        read = {
            str(file): reading.sha256(file)
            for file in workers.material_files(wanted.cell)
        }
        title = f"{__version__}\n{config.dumps(wanted)}{read}"
        journal = Journal(
            target.with_name(target.name + ".resume"), title, inputs=map(Path, read)
        )
        measured = plan.pilot(chain, journal, floor=least)
        best = plan.choose(measured, goal, wanted)
        write(draft.path, best, measured, chain)
    journal.finish()
    return options.console.judged(
        values(best, measured), text(best, measured, target), failures(best, chain)
    )


def failures(best: Plan, chain: Chain) -> list[str]:
    """Why a plan does not do: the goal is missed, or the image of the chosen tolerance
    is not within it.
    """
    missed = [] if best.met else ["the goal is not met by the finest settings on offer"]
    if isinstance(best.choice, plan.TrueChoice):
        missed.append(chain.device(best.choice.image_tolerance).above)
    return missed


def values(best: Plan, measured: Pilot) -> dict[str, object]:
    """The plan for --json and plan.json."""
    return {
        "goal_deg": math.degrees(best.goal_rad),
        "met": best.met,
        "predicted_deg": math.degrees(best.predicted_rad),
        "image": "true" if isinstance(best.choice, plan.TrueChoice) else "uniform",
        "choice": asdict(best.choice),
        "nodes": chosen_nodes(best, measured),
        "seconds": best.seconds,
        "finest_seconds": best.finest_seconds,
        "pilot_seconds": measured.spent_seconds,
        "noise_deg": math.degrees(measured.noise_rad),
        "floor_deg": {
            entry.link: math.degrees(entry.gaze_rad) for entry in measured.floor
        },
    }


def write(folder: Path, best: Plan, measured: Pilot, chain: Chain) -> None:
    """Settings files for the commands, plan.json and the report."""
    choice, wanted = best.choice, chain.config
    cell = re.sub(r"^(\[+)", r"\1cell.", config.dumps(wanted.cell), flags=re.MULTILINE)
    sweep = f"wavelengths_um = [{wanted.wavelength_nm * 1e-3}]\ntolerance = {choice.library_tolerance}\n"
    store.write_text(folder / "cell.toml", f"[cell]\n{cell}\n[sweep]\n{sweep}")
    store.write_text(folder / "psf.toml", psf_text(best, measured, chain))
    store.write_text(folder / "run.toml", run_text(best, chain))
    store.write_text(
        folder / "process.toml",
        f"[rules]\ndiameter_step_nm = {int(choice.diameter_step_nm)}\n",
    )
    store.write_text(
        folder / "plan.json", json.dumps(values(best, measured), indent=1) + "\n"
    )
    _page(folder / "report.html", best, measured)


def chosen_nodes(best: Plan, measured: Pilot) -> dict[str, int]:
    """What the chosen tolerance of the true image needs: nodes of the field, depths,
    wavelengths; none of one PSF.
    """
    if not isinstance(best.choice, plan.TrueChoice):
        return {}
    found = measured.nodes[
        measured.levels["image_tolerance"].index(best.choice.image_tolerance)
    ]
    return dict(zip(("rows", "columns", "depths", "wavelengths"), found, strict=True))


def psf_text(best: Plan, measured: Pilot, chain: Chain) -> str:
    """PSF.toml: the depths, and for the true image the angles from the axis to the edge
    of the field.
    """
    choice, near, far = best.choice, *(1e-3 * d for d in chain.eyes.depths_um)
    if isinstance(choice, plan.TrueChoice):
        nodes = chosen_nodes(best, measured)
        half = chain.config.task.size / 2 * chain.config.task.pitch_um
        edge = math.degrees(math.atan(half / chain.lens.sensor_distance_um))
        count = nodes["columns"] // 2 + 1
        depths, tolerance = (
            nodes["depths"],
            round(choice.image_tolerance / 3, 4),
        )  # adds a twentieth in quadrature
        angles = [round(edge * k / (count - 1), 3) for k in range(count)]
    else:
        depths, tolerance, angles = choice.depth_count, choice.psf_tolerance, [0.0]
    step = (far - near) / max(depths - 1, 1)
    return (
        f"{_one_wavelength(chain.config)}depths_mm = [{near:.3f}, {far:.3f}, {step:.4f}]\nangles_deg = {angles}\n"
        f"tolerance = {tolerance}\n"
    )


def _one_wavelength(wanted: PlanConfig) -> str:
    """What a diode's PSFs need beyond the library of the design's wavelength, which is
    all that the plan looked at.
    """
    if wanted.source is None:
        return ""
    swept = spectrum.sweep(spectrum.points(wanted.source)[0] * 1e3)
    return (
        f"# of one wavelength, as cell.toml; the diode's: led_fwhm_nm = {wanted.led_fwhm_nm:g} here, and a library of\n"
        f"# cell.toml with {swept}\n"
    )


def run_text(best: Plan, chain: Chain) -> str:
    """RUN.toml's table of the optics."""
    choice, wanted = best.choice, chain.config
    near, far = (1e-3 * d for d in chain.eyes.depths_um)
    lens = (
        f"aperture_mm = {wanted.aperture_mm}\nsensor_distance_mm = {wanted.sensor_distance_mm}\n"
        f"wavelength_nm = {wanted.wavelength_nm}\nfocus_mm = {wanted.source_distance_mm}\n"
        f"depths_mm = [{near:.3f}, {far:.3f}]\n"
    )
    if isinstance(choice, plan.TrueChoice):
        how = f"fwhm_nm = {wanted.led_fwhm_nm}\nimage_tolerance = {choice.image_tolerance}\n"
        return f'[optics]\nimage = "true"\n{lens}{how}'
    how = f"depth_count = {choice.depth_count}\ntolerance = {choice.kernel_tolerance}\n"
    return f'[optics]\nimage = "uniform"\n{lens}{how}'


def _page(path: Path, best: Plan, measured: Pilot) -> None:
    keys = [
        report.KeyFigure("goal", f"{math.degrees(best.goal_rad):.2g}°"),
        report.KeyFigure(
            "predicted", f"{math.degrees(best.predicted_rad):.2g}°", best.met
        ),
        report.KeyFigure("the run", f"{best.seconds:.0f} s"),
        report.KeyFigure("everything at its finest", f"{best.finest_seconds:.0f} s"),
    ]
    rows = []
    for knob, levels in measured.levels.items():
        chosen = getattr(best.choice, knob)
        for level, error, seconds in zip(
            levels, measured.errors[knob], measured.seconds[knob], strict=True
        ):
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
        "Seconds: of a library, a stack, an image, a mask; of the true image, all its PSFs and images.",
    )
    words = (
        "Every setting was measured alone in a pilot; errors add as vectors over the eyes. What no setting changes is "
        f"the floor: {floor_words(measured)}. The process comes on top (metalens budget)."
    )
    report.write(
        path,
        "Plan of a run",
        [report.Section("Settings", words, (table,))],
        key_figures=keys,
    )


def text(best: Plan, measured: Pilot, folder: Path) -> str:
    """The plan for a terminal."""
    rows = [
        f"  {name.replace('_', ' '):<20} {value:g}"
        for name, value in asdict(best.choice).items()
    ]
    nodes = chosen_nodes(best, measured)
    field_of = (
        f"  {'of the true image':<20} {', '.join(f'{v} {k}' for k, v in nodes.items())}\n"
        if nodes
        else ""
    )
    return (
        f"{folder}: gaze error {math.degrees(best.predicted_rad):.2g} deg predicted, "
        f"{math.degrees(best.goal_rad):.2g} allowed\n"
        + "\n".join(rows)
        + f"\n{field_of}  run {best.seconds:.0f} s, everything at its finest {best.finest_seconds:.0f} s; "
        f"the pilot took {measured.spent_seconds:.0f} s\n"
        f"  floor, whatever the settings: {floor_words(measured)}"
    )


def floor_words(measured: Pilot) -> str:
    """The floor and its links."""
    links = ", ".join(
        f"{entry.link} {math.degrees(entry.gaze_rad):.2g} deg"
        for entry in measured.floor
    )
    return f"{math.degrees(total(list(measured.floor)).gaze_rad):.2g} deg ({links or 'no links'})"
