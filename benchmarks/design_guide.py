"""What brings how much: one base cell, one knob changed at a time, judged by the
reference reader.

    python -m benchmarks.design_guide begin --work DIR                        # takes over what the result file has
    python -m benchmarks.design_guide run --work DIR                          # every run of the plan without a line
    python -m benchmarks.design_guide run --work DIR --only
    field=oblique,fwhm=30,lens=focus150/2
    python -m benchmarks.design_guide report --work DIR                       # JSON and docs/codesign/guide.md

A cell is named by what it changes of the base, ``knob=value`` joined by commas
(``base``: nothing); a run is a cell and
a seed. Scenes, noise, and weights of the reader come from the seed, so the cells of one
seed are paired. Lenses are
designed once for their field, light and pixels, on scenes that no run judges. One JSON
line a run; a stopped plan goes
on where it was. The bound of every compared lens has a line of its own.
"""

import argparse
import functools
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import design_guide_network as network
from benchmarks import keep_line, kept_lines
from benchmarks.codesign_study import fitted, oblique
from benchmarks.design_guide_bound import bound_mm
from benchmarks.design_guide_cells import (
    FIELDS,
    LENS,
    Cell,
    cell_of,
    corner_rad,
    run_of,
)
from benchmarks.design_guide_image import forms
from benchmarks.design_guide_stop import asphere, behind_stop
from codesign.evaluate import reader
from codesign.evaluate.reader import ReaderConfig, Scenery
from codesign.evaluate.reader_lens import LensTraining, kept, trained
from codesign.optics.stack import OpticsConfig
from metalens.image import Imager, UniformImager
from metalens.image.pupil import coordinates

LINES, DESIGNS, BOUNDS = "runs.jsonl", "designs.jsonl", "bounds.jsonl"
RESULT = Path(__file__).parent / "results" / "design_guide.json"
CHOICE, DESIGN = (
    5,
    77,
)  # seeds of the runs that choose among lenses, and of the scenes that lenses are trained on
SEEDS = range(5)
RADIALS = ("quadratic", "stop")  # lenses that are radial terms to begin with
FREE, RADIAL = 63, 6  # terms of a free form and of an asphere
TRAINING = LensTraining()
LOOKS = (
    1.0,
)  # shares of the training after which a lens is read, as its start is; the best is kept
IMAGE, TRAINED = (
    0.05,
    0.05,
)  # tolerances of the image that is read, and of the one that lenses are trained on


def optics_of(cell: Cell) -> OpticsConfig:
    """The lens before its coefficients, on samples of the pixels."""
    family, kind, number = LENS.fullmatch(cell.lens).groups()  # type: ignore[union-attr]
    settings = OpticsConfig(
        polynomials=0, sample_um=cell.pitch, window_samples=2 * cell.config.margin + 1, image_tolerance=TRAINED,
        angle_deg=FIELDS[cell.field].angle_deg, fwhm_nm=cell.fwhm,
    )  # fmt: skip
    if kind == "helix":
        settings = replace(settings, zones=int(number))
    elif kind == "split":
        settings = replace(settings, focus_mm=40.0, parts=2, apart_um=float(number))
    else:
        settings = replace(settings, focus_mm=float(number))
    if kind == "stop":
        settings = behind_stop(settings)
    if family == "free-" or kind == "oblique":
        return replace(settings, polynomials=FREE)
    return (
        replace(settings, polynomials=RADIAL, family="radial")
        if family or kind in RADIALS
        else settings
    )


def start_of(cell: Cell) -> Tensor:
    """Coefficients of the lens as a designer has it, before any training."""
    settings, kind = optics_of(cell), LENS.fullmatch(cell.lens)[2]  # type: ignore[index]
    if kind == "oblique":
        return oblique(settings)
    if kind == "quadratic":
        return fitted(settings, flat_field(settings))
    if kind == "stop":
        return asphere(settings, corner_rad(FIELDS[cell.field]))
    return torch.zeros(settings.polynomials, dtype=torch.float64)


def flat_field(settings: OpticsConfig) -> Tensor:
    """(nodes, nodes) phase of r² alone less that of the hyperbolic lens of the same
    power, rad.

    Light that comes in under an angle crosses another part of the same parabola: it is
    shifted, with no aberration that
    depends on the angle; what is left is spherical, of all angles alike (Pu et al.,
    Opt. Express 25, 31471, 2017).
    """
    x, y = coordinates(settings.pupil)
    r2, k = (
        x.double() ** 2 + y.double() ** 2,
        2 * math.pi / settings.pupil.wavelength_um,
    )
    ends = settings.sensor_distance_mm * 1e3, settings.focus_mm * 1e3
    paths = [r2 / (torch.sqrt(r2 + d**2) + d) - r2 / (2 * d) for d in ends]
    return k * (paths[0] + paths[1])


def designed(work: Path, cell: Cell) -> Tensor:
    """Coefficients of a cell's lens; a lens that is trained has a line of its own, and
    is trained once.
    """
    if not cell.lens.startswith(("free-", "radial-")):
        return start_of(cell)
    for line in kept_lines(work / DESIGNS):
        if line["design"] == cell.design:
            return torch.tensor(line["coefficients_rad"], dtype=torch.float64)
    line = {"design": cell.design} | trained_line(cell)
    keep_line(work / DESIGNS, line)
    return torch.tensor(line["coefficients_rad"], dtype=torch.float64)


def trained_line(cell: Cell) -> dict[str, Any]:
    """The best lens of a training by axial error on frames that it has not seen, never
    worse there than its start.

    image: its tolerance in training. axial_mm: by turn, 0 the start. apart_rad:
    root-mean-square phase between the
    lens and its start.
    """
    config, begun = replace(cell.config, seed=DESIGN), time.process_time()
    seen, form = scenery(config), forms(FIELDS[cell.field].share)
    path, loss = trained(
        optics_of(cell), start_of(cell), seen.learn, config, TRAINING, forms=form
    )
    path[1:], last = path[1:].round(decimals=4), max(len(loss) // 10, 1)

    def error_mm(place: Tensor) -> float:
        return float(reader.read(imaged(cell, place), seen, config).axial_mm.mean())

    turn, told = kept(
        path, [round(share * TRAINING.turns) for share in LOOKS], error_mm
    )
    return {
        "image": TRAINED, "loss": round(sum(loss[-last:]) / last, 4), "turn": turn,
        "axial_mm": {k: round(v, 4) for k, v in told.items()},
        "apart_rad": round(float((path[turn] - path[0]).norm()), 3), "cpu_s": round(time.process_time() - begun, 1),
        "coefficients_rad": path[turn].tolist(),
    }  # fmt: skip


@functools.lru_cache(maxsize=2)
def scenery(config: ReaderConfig) -> Scenery:
    """Scenes of a seed, for all lenses."""
    return reader.scenery(
        config, sensor_distance_um=OpticsConfig().sensor_distance_mm * 1e3
    )


def run_one(work: Path, name: str) -> dict[str, Any]:
    """The line of one run."""
    cell, seed = run_of(name)
    place, config = designed(work, cell), replace(cell.config, seed=seed)
    start, seen = time.process_time(), scenery(replace(config, **SAME))
    settings = replace(optics_of(cell), image_tolerance=IMAGE)
    if cell.reader == "network":
        found = network.read(settings, place, seen.judge, config)
    else:
        found = reader.read(imaged(cell, place), seen, config).values()
    return {
        "run": f"{cell.name}/{seed}",
        "cpu_s": round(time.process_time() - start, 1),
    } | found


def same_lens(work: Path, cell: Cell) -> str | None:
    """The cell of the start, where training kept it: the same lens, of which every
    number is known already.
    """
    if not any(
        line["design"] == cell.design and line.get("turn") == 0
        for line in kept_lines(work / DESIGNS)
    ):
        return None
    return replace(
        cell, lens=cell.lens.removeprefix("free-").removeprefix("radial-")
    ).name


def already_read(
    work: Path, name: str, lines: dict[str, dict[str, Any]]
) -> dict[str, Any] | None:
    """The line of a run, where it is that of the start."""
    cell, seed = run_of(name)
    start = same_lens(work, cell)
    found = lines.get(f"{start}/{seed}")
    return None if found is None else found | {"run": name, "read_as": start}


def imaged(cell: Cell, place: Tensor) -> Imager | UniformImager:
    """The image of a cell's field and light through the lens of these coefficients."""
    settings, config = replace(optics_of(cell), image_tolerance=IMAGE), cell.config
    frame = config.pixels + 2 * config.margin
    return forms(FIELDS[cell.field].share)(settings, place, frame, margin=config.margin)


def bounded(work: Path, name: str) -> dict[str, Any]:
    """The line of a lens's bound."""
    cell = cell_of(name)
    start = same_lens(work, cell)
    for line in kept_lines(work / BOUNDS):
        if line["cell"] == start:
            return line | {"cell": name}
    place, config, field = designed(work, cell), cell.config, FIELDS[cell.field]
    whole = imaged(cell, place)
    if not isinstance(whole, Imager):
        raise TypeError("the true image needs a field of PSFs")
    return {
        "cell": name,
        "bound_mm": round(
            bound_mm(optics_of(cell), place, whole, config, field.share), 4
        ),
    }


SAME: dict[str, Any] = {
    "frames": Cell().frames,
    "fwhm_nm": 0.0,
    "electrons": 2000.0,
}  # knobs that no scene knows of
FOCI = ("focus40", "focus70", "focus150", "focus1000")
DESIGNERS = ("quadratic40", "quadratic150", "oblique40", "oblique150")
STOPS = ("stop150",)
DEVICE = tuple(
    f"field={place},fwhm={width}" for width in (30, 10) for place in ("oblique", "ring")
)
LADDER = (
    "field=angle,fwhm=30",
    "field=line,fwhm=30",
    DEVICE[0],
)  # from one field angle to the whole field
ASPHERES = DEVICE[:2]  # where six radial terms are trained too, and stand behind a stop
LONG_READ = (DEVICE[0], LADDER[0])  # read after many frames too
WATCHED, NETWORK_FRAMES = (
    DEVICE[0],
    6400,
)  # where the network reads too, and the frames that it sees once each
# frames after which the reader no longer tells lenses apart by how soon their blur is
# learned
MANY = 25_600
KNOBS = ("base", "lens=focus20", "lens=focus70", "fwhm=10", "fwhm=30", "field=oblique", "field=ring", "electrons=500",
         "electrons=8000", "frames=1600", "frames=6400", "pitch=9", "lens=helix2", "lens=split60")  # fmt: skip


def candidates(device: str, family: str) -> list[str]:
    """Cells of the field and light of a device, one a lens; a ring has no one angle
    that a lens could be made for.
    """
    standing = {"focus": FOCI, "stop": STOPS, "designer": DESIGNERS}[family]
    lenses = [n for n in standing if "ring" not in device or "oblique" not in n]
    return [replace(cell_of(device), lens=lens).name for lens in lenses]


def chosen(lines: dict[str, dict[str, Any]], device: str, family: str) -> str | None:
    """The cell of least axial error in the runs that choose; None before all of them
    are there.
    """
    scan = {cell: lines.get(f"{cell}/{CHOICE}") for cell in candidates(device, family)}
    told = {cell: line["axial_mm"] for cell, line in scan.items() if line is not None}
    return min(told, key=lambda cell: told[cell]) if len(told) == len(scan) else None


def compared(lines: dict[str, dict[str, Any]], device: str) -> dict[str, str]:
    """{role: cell} of a device: its chosen lenses, and those that are trained, once
    known.

    An asphere is trained from the best focus, a free form from the best of all lenses
    that stand.
    """
    found = {
        family: cell
        for family in ("focus", "designer")
        if (cell := chosen(lines, device, family))
    }
    if "focus" in found and device in ASPHERES:
        focus = cell_of(found["focus"])
        found["asphere"] = replace(focus, lens=f"radial-{focus.lens}").name
    if device in ASPHERES and (stopped := chosen(lines, device, "stop")):
        found["stop"] = stopped
    if {"focus", "designer"} <= set(found):
        best = cell_of(
            min(
                found["focus"],
                found["designer"],
                key=lambda cell: lines[f"{cell}/{CHOICE}"]["axial_mm"],
            )
        )
        found["trained"] = replace(best, lens=f"free-{best.lens}").name
    return found


def watched(lines: dict[str, dict[str, Any]]) -> dict[str, str]:
    """{role: cell} that the network reads."""
    roles = {
        role: cell
        for role, cell in compared(lines, WATCHED).items()
        if role not in ("asphere", "stop")
    }
    return {
        r: replace(cell_of(c), frames=NETWORK_FRAMES, reader="network").name
        for r, c in roles.items()
    }


def long_read(lines: dict[str, dict[str, Any]], device: str) -> dict[str, str]:
    """{role: cell} of a device that the reader reads after ``MANY`` frames too; none of
    a device that is not.
    """
    compare = compared(lines, device) if device in LONG_READ else {}
    roles = {role: cell for role, cell in compare.items() if role != "asphere"}
    return {
        role: replace(cell_of(cell), frames=MANY).name for role, cell in roles.items()
    }


def plan(lines: dict[str, dict[str, Any]]) -> list[str]:
    """Runs, in their order; those that depend on a choice follow it."""
    found: list[str] = []
    for device in dict.fromkeys(LADDER + DEVICE):
        found += [
            f"{cell}/{CHOICE}"
            for family in ("focus", "designer")
            for cell in candidates(device, family)
        ]
        found += [
            f"{cell}/{CHOICE}"
            for cell in candidates(device, "stop")
            if device in ASPHERES
        ]
        found += [
            f"{cell}/{seed}"
            for seed in SEEDS
            for cell in compared(lines, device).values()
        ]
    found += [f"{cell}/{seed}" for seed in SEEDS for cell in watched(lines).values()]
    found += [
        f"{cell}/{seed}"
        for device in LONG_READ
        for seed in SEEDS
        for cell in long_read(lines, device).values()
    ]
    return found + [f"{cell_of(knob).name}/{seed}" for seed in SEEDS for knob in KNOBS]


def unbounded(work: Path, lines: dict[str, dict[str, Any]]) -> list[str]:
    """Compared cells that were read and have no bound yet."""
    have = {line["cell"] for line in kept_lines(work / BOUNDS)}
    cells = [
        c
        for device in dict.fromkeys(LADDER + DEVICE)
        for c in compared(lines, device).values()
    ]
    return [cell for cell in cells if f"{cell}/0" in lines and cell not in have]


def done(work: Path) -> dict[str, dict[str, Any]]:
    """Lines by run."""
    return {line["run"]: line for line in kept_lines(work / LINES)}


def begin(work: Path) -> None:
    """Lines of the committed results, for a plan that goes on from them.

    Raises:
        SystemExit: the folder has lines of its own.
    """
    kept = json.loads(RESULT.read_text("utf-8"))
    files = {"runs": LINES, "designs": DESIGNS, "bounds": BOUNDS}
    if there := [name for name in files.values() if (work / name).exists()]:
        raise SystemExit(
            f"{work} already holds {', '.join(there)}: go on with run, or name another folder"
        )
    for part, name in files.items():
        for line in kept.get(part, []):
            keep_line(work / name, line)


def run(work: Path, only: list[str] | None) -> None:
    """Every run of the plan, or of ``only``, that has no line; a choice that becomes
    known adds its runs.
    """
    for name in only or ():
        run_of(name)
    while True:
        lines = done(work)
        open_runs = [name for name in only or plan(lines) if name not in lines]
        if not open_runs:
            break
        line = already_read(work, open_runs[0], lines) or run_one(work, open_runs[0])
        keep_line(work / LINES, line)
        print(json.dumps(line), flush=True)
    named = {name.rpartition("/")[0] for name in only or ()}
    for cell in unbounded(work, lines):
        if not only or cell in named:
            keep_line(work / BOUNDS, bounded(work, cell))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verb", choices=["begin", "run", "report"])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=None, help="runs CELL/SEED")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.work.mkdir(parents=True, exist_ok=True)
    if options.verb == "begin":
        begin(options.work)
    elif options.verb == "run":
        run(options.work, options.only)
    else:
        from benchmarks.design_guide_report import write

        write(options.work)


if __name__ == "__main__":
    main()
