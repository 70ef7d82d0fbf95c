"""What brings how much: one base cell, one knob changed at a time, judged by the reference reader.

    python -m benchmarks.design_guide run --work DIR                          # every run of the plan without a line
    python -m benchmarks.design_guide run --work DIR --only field=oblique,fwhm=30,lens=focus150/2
    python -m benchmarks.design_guide report --work DIR                       # JSON and docs/codesign/guide.md

A cell is named by what it changes of the base, ``knob=value`` joined by commas (``base``: nothing); a run is a cell and
a seed. Scenes, noise, and weights of the reader come from the seed, so the cells of one seed are paired. Lenses are
designed once for their field, light and pixels, on scenes that no run judges. One JSON line a run; a stopped plan goes
on where it was.
"""

import argparse
import functools
import json
import math
import re
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import keep_line, kept_lines
from benchmarks.codesign_study import fitted, oblique
from codesign.evaluate import reader
from codesign.evaluate.reader import ReaderConfig, Scenery
from codesign.evaluate.reader_lens import LensTraining, trained
from codesign.optics import formed
from codesign.optics.stack import OpticsConfig
from metalens.image.pupil import coordinates

LINES, DESIGNS = "runs.jsonl", "designs.jsonl"
CHOICE, DESIGN = 5, 77  # seeds of the runs that choose among lenses, and of the scenes that lenses are trained on
SEEDS = range(5)
FREE, RADIAL = 63, 6  # terms of a free form and of an asphere
TRAINING = LensTraining()
IMAGE, TRAINED = 0.05, 0.2  # tolerances of the image that is read, and of the one that lenses are trained on
LENS = re.compile(r"(free-|radial-)?(focus|quadratic|(?<!radial-)oblique|(?<!-)helix|(?<!-)split)(\d+)")


@dataclass(frozen=True, slots=True)
class Place:
    """Part of the field that a camera sees: width of its square sensor, and field angle of the middle."""

    width_um: float
    angle_deg: float


FIELDS = {"axis": Place(1008.0, 0.0), "oblique": Place(1008.0, 17.0), "ring": Place(1872.0, 0.0)}


@dataclass(frozen=True, slots=True)
class Cell:
    """Values of all knobs; the defaults are the base.

    lens: ``focusF``, hyperbolic, for sources at F mm. ``quadraticF``: r² alone, whose blur is the same over the field,
        in six radial terms. ``obliqueF``: free of aberrations at the middle of the field. ``helixN``: double helix of N
        rings. ``splitA``: two halves whose images lie A um apart. ``free-`` before one of the first three, ``radial-``
        before one of the first two: 63 or 6 terms trained with the reader from there.
    field: of :data:`FIELDS`. fwhm: of the light, nm. pitch: of the pixels, um. electrons: from white in 9 um.
    frames: that the reader learns from.
    """

    lens: str = "focus40"
    field: str = "axis"
    fwhm: float = 0.0
    pitch: float = 18.0
    electrons: float = 2000.0
    frames: int = 3200

    @property
    def name(self) -> str:
        """What differs from the base."""
        values = ((f.name, getattr(self, f.name), f.default) for f in fields(self))
        return (
            ",".join(f"{n}={v:g}" if n not in ("lens", "field") else f"{n}={v}" for n, v, d in values if v != d)
            or "base"
        )

    @property
    def light(self) -> "Cell":
        """The cell of the base lens in the same field, light and pixels: what a ratio is taken to."""
        return replace(self, lens=Cell().lens)

    @property
    def reader(self) -> ReaderConfig:
        """Settings of the reader but for the seed."""
        pixels = round(FIELDS[self.field].width_um / self.pitch)
        return ReaderConfig(
            frames=self.frames, pixels=pixels, pitch_um=self.pitch, electrons=self.electrons, fwhm_nm=self.fwhm
        )

    @property
    def design(self) -> str:
        """Name of the cell that a lens is designed for: a reader's number of frames has no part in it."""
        return replace(self, frames=Cell().frames).name


def cell_of(name: str) -> Cell:
    """The cell of a name.

    Raises:
        SystemExit: a knob or a value that there is not, with those that there are.
    """
    kinds = {f.name: type(f.default) for f in fields(Cell)}
    found: dict[str, Any] = {}
    for part in [] if name == "base" else name.split(","):
        knob, _, value = part.partition("=")
        if knob not in kinds or knob in found:
            raise SystemExit(f"cell {name!r}: no knob {knob!r} (or twice): need {', '.join(kinds)}, or base alone")
        try:
            found[knob] = kinds[knob](value)
        except ValueError:
            raise SystemExit(f"cell {name!r}: {knob} = {value!r} is no number") from None
    cell = Cell(**found)
    if cell.field not in FIELDS or not LENS.fullmatch(cell.lens):
        raise SystemExit(
            f"cell {name!r}: field = {cell.field!r}, lens = {cell.lens!r}: need one of {', '.join(FIELDS)} and a lens: "
            "focusF, quadraticF, obliqueF, helixN, splitA; free- before one of the first three, "
            "radial- of the first two"
        )
    return cell


def run_of(name: str) -> tuple[Cell, int]:
    """Cell and seed of a run ``CELL/SEED``."""
    cell, _, seed = name.rpartition("/")
    if not seed.isdecimal():
        raise SystemExit(f"run {name!r}: need CELL/SEED, as base/0")
    return cell_of(cell), int(seed)


def optics_of(cell: Cell) -> OpticsConfig:
    """The lens before its coefficients, on samples of the pixels."""
    family, kind, number = LENS.fullmatch(cell.lens).groups()  # type: ignore[union-attr]
    settings = OpticsConfig(
        polynomials=0, sample_um=cell.pitch, window_samples=2 * cell.reader.margin + 1, image_tolerance=TRAINED,
        angle_deg=FIELDS[cell.field].angle_deg, fwhm_nm=cell.fwhm,
    )  # fmt: skip
    if kind == "helix":
        settings = replace(settings, zones=int(number))
    elif kind == "split":
        settings = replace(settings, focus_mm=40.0, parts=2, apart_um=float(number))
    else:
        settings = replace(settings, focus_mm=float(number))
    if family == "free-" or kind == "oblique":
        return replace(settings, polynomials=FREE)
    return replace(settings, polynomials=RADIAL, family="radial") if family or kind == "quadratic" else settings


def start_of(cell: Cell) -> Tensor:
    """Coefficients of the lens as a designer has it, before any training."""
    settings, kind = optics_of(cell), LENS.fullmatch(cell.lens)[2]  # type: ignore[index]
    if kind == "oblique":
        return oblique(settings)
    if kind == "quadratic":
        return fitted(settings, flat_field(settings))
    return torch.zeros(settings.polynomials, dtype=torch.float64)


def flat_field(settings: OpticsConfig) -> Tensor:
    """(nodes, nodes) phase of r² alone less that of the hyperbolic lens of the same power, rad.

    Light that comes in under an angle crosses another part of the same parabola: it is shifted, with no aberration that
    depends on the angle; what is left is spherical, of all angles alike (Pu et al., Opt. Express 25, 31471, 2017).
    """
    x, y = coordinates(settings.pupil)
    r2, k = x.double() ** 2 + y.double() ** 2, 2 * math.pi / settings.pupil.wavelength_um
    ends = settings.sensor_distance_mm * 1e3, settings.focus_mm * 1e3
    paths = [r2 / (torch.sqrt(r2 + d**2) + d) - r2 / (2 * d) for d in ends]
    return k * (paths[0] + paths[1])


def designed(work: Path, cell: Cell) -> Tensor:
    """Coefficients of a cell's lens; a lens that is trained has a line of its own, and is trained once."""
    if not cell.lens.startswith(("free-", "radial-")):
        return start_of(cell)
    for line in kept_lines(work / DESIGNS):
        if line["design"] == cell.design:
            return torch.tensor(line["coefficients_rad"], dtype=torch.float64)
    config = replace(cell.reader, seed=DESIGN)
    learn = scenery(config).learn
    end, loss = trained(optics_of(cell), start_of(cell), learn, config, TRAINING)
    last = max(len(loss) // 10, 1)
    line: dict[str, Any] = {"design": cell.design, "loss": round(sum(loss[-last:]) / last, 4)}
    line["coefficients_rad"] = [round(float(v), 4) for v in end]
    keep_line(work / DESIGNS, line)
    return torch.tensor(line["coefficients_rad"], dtype=torch.float64)


@functools.lru_cache(maxsize=2)
def scenery(config: ReaderConfig) -> Scenery:
    """Scenes of a seed, for all lenses."""
    return reader.scenery(config, sensor_distance_um=OpticsConfig().sensor_distance_mm * 1e3)


def run_one(work: Path, name: str) -> dict[str, Any]:
    """The line of one run."""
    cell, seed = run_of(name)
    place, config = designed(work, cell), replace(cell.reader, seed=seed)
    settings = replace(optics_of(cell), image_tolerance=IMAGE)
    optics = formed.imager(settings, place, config.pixels + 2 * config.margin, margin=config.margin)
    start = time.process_time()
    found = reader.read(optics, scenery(replace(config, **SAME)), config)
    return {"run": f"{cell.name}/{seed}", "cpu_s": round(time.process_time() - start, 1)} | found.values()


SAME: dict[str, Any] = {"frames": Cell().frames, "fwhm_nm": 0.0, "electrons": 2000.0}  # knobs that no scene knows of
FOCI = ("focus40", "focus70", "focus150", "focus1000")
DESIGNERS = ("quadratic40", "quadratic150", "oblique40", "oblique150")
DEVICE = tuple(f"field={place},fwhm={width}" for width in (30, 10) for place in ("oblique", "ring"))
KNOBS = ("base", "lens=focus20", "lens=focus70", "fwhm=10", "fwhm=30", "field=oblique", "field=ring", "electrons=500",
         "electrons=8000", "frames=1600", "frames=6400", "pitch=9", "lens=helix2", "lens=split60")  # fmt: skip


def candidates(device: str, family: str) -> list[str]:
    """Cells of the field and light of a device, one a lens; a ring has no one angle that a lens could be made for."""
    lenses = FOCI if family == "focus" else [n for n in DESIGNERS if "ring" not in device or "oblique" not in n]
    return [replace(cell_of(device), lens=lens).name for lens in lenses]


def chosen(lines: dict[str, dict[str, Any]], device: str, family: str) -> str | None:
    """The cell of least axial error in the runs that choose; None before all of them are there."""
    scan = {cell: lines.get(f"{cell}/{CHOICE}") for cell in candidates(device, family)}
    told = {cell: line["axial_mm"] for cell, line in scan.items() if line is not None}
    return min(told, key=lambda cell: told[cell]) if len(told) == len(scan) else None


def compared(lines: dict[str, dict[str, Any]], device: str) -> dict[str, str]:
    """{role: cell} of a device: its chosen lenses, and the lens that is trained from the best focus, once known."""
    found = {family: cell for family in ("focus", "designer") if (cell := chosen(lines, device, family))}
    if "focus" in found:
        best = cell_of(found["focus"])
        found["trained"] = replace(best, lens=f"free-{best.lens}").name
    return found


def plan(lines: dict[str, dict[str, Any]]) -> list[str]:
    """Runs, in their order; those that depend on a choice follow it."""
    found: list[str] = []
    for device in DEVICE:
        found += [f"{cell}/{CHOICE}" for family in ("focus", "designer") for cell in candidates(device, family)]
        found += [f"{cell}/{seed}" for seed in SEEDS for cell in compared(lines, device).values()]
    return found + [f"{cell_of(knob).name}/{seed}" for seed in SEEDS for knob in KNOBS]


def done(work: Path) -> dict[str, dict[str, Any]]:
    """Lines by run."""
    return {line["run"]: line for line in kept_lines(work / LINES)}


def run(work: Path, only: list[str] | None) -> None:
    """Every run of the plan, or of ``only``, that has no line; a choice that becomes known adds its runs."""
    for name in only or ():
        run_of(name)
    while True:
        lines = done(work)
        open_runs = [name for name in only or plan(lines) if name not in lines]
        if not open_runs:
            return
        line = run_one(work, open_runs[0])
        keep_line(work / LINES, line)
        print(json.dumps(line), flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verb", choices=["run", "report"])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=None, help="runs CELL/SEED")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.work.mkdir(parents=True, exist_ok=True)
    if options.verb == "run":
        run(options.work, options.only)
    else:
        from benchmarks.design_guide_report import write

        write(options.work)


if __name__ == "__main__":
    main()
