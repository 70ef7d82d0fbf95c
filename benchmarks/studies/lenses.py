"""Joint training against fixed lenses, read by the reference reader.

``python -m benchmarks.studies.lenses FIELD LINES.jsonl`` designs and trains the lenses
of one field (``wide`` or ``oblique``), and trains the reference reader anew behind each
of them for every seed.
``python -m benchmarks.studies.lenses table LINES.jsonl`` prints the table.
Every result is a line of the file; a stopped study goes on where it was.

Source distance, field angles of the asphere and rings of the double helix are chosen by
axial error with a seed of their own. The pillars of every lens stand in the PSFs that
the reference reader sees.
"""

import functools
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import t as student
from torch import Tensor

from codesign.batches import SceneConfig
from codesign.evaluate import ReaderConfig, judge_reader, train_reader
from codesign.evaluate.reader import SPACE
from codesign.optics import OpticsConfig
from codesign.optics.stack import phase_at, trained_lens
from codesign.train import InnerConfig
from codesign.train.run import RunBudgets, RunConfig, start_run
from codesign.train.separability import SeparabilityConfig
from metalens.core.arrays import Array
from metalens.lens import Lens

FWHM_NM = 30.0
TOLERANCE = 0.03
FOCI_MM = (20.0, 40.0, 150.0, 1000.0)
SHARES = (0.3, 0.6, 1.0)  # of the field angles that an asphere is made for
RINGS = (3, 5)
SEEDS = range(5)
CHOICE, JOINT = 5, 77  # seeds that choose among lenses and that lenses are trained with
CHOICE_FRAMES, FRAMES, JOINT_STEPS = 3200, 6400, 300

Line = dict[str, Any]
Design = tuple[OpticsConfig, Tensor]


@dataclass(frozen=True)
class FieldOfView:
    """A square of pixels whose middle lies at a field angle."""

    pixels: int
    angle_deg: float

    def reader(self, seed: int, frames: int) -> ReaderConfig:
        """Reference reader of this field."""
        return ReaderConfig(
            frames=frames,
            test=512,
            seed=seed,
            pixels=self.pixels,
            fwhm_nm=FWHM_NM,
            angle_deg=self.angle_deg,
            tolerance=TOLERANCE,
        )

    def optics(self, **changes: Any) -> OpticsConfig:
        """A hyperbolic lens of 1 mm, 2 mm before the sensor, on the reader's
        samples.
        """
        config = self.reader(0, FRAMES)
        common: dict[str, Any] = {
            "polynomials": 0,
            "sample_um": config.pitch_um,
            "window_samples": 2 * config.margin + 1,
            "depth_count": 12,
            "fwhm_nm": FWHM_NM,
            "angle_deg": self.angle_deg,
            "image_tolerance": TOLERANCE,
        }
        return OpticsConfig(**(common | changes))

    @property
    def angles_rad(self) -> Array:
        """Angles from the axis of a 5 x 5 grid of image points."""
        config, distance_um = self.reader(0, FRAMES), 2000.0
        half_um = self.pixels * config.pitch_um / 2
        place_um = np.linspace(-half_um, half_um, 5)
        middle_um = distance_um * math.tan(math.radians(self.angle_deg))
        from_axis_um = np.hypot(place_um[:, None], place_um + middle_um)
        return np.arctan(from_axis_um.ravel() / distance_um)


FIELDS = {"wide": FieldOfView(104, 0.0), "oblique": FieldOfView(56, 17.5)}


def least_wavefront_asphere(settings: OpticsConfig, angles_rad: Array) -> Tensor:
    """Radial terms of least mean square wavefront error over field angles.

    At field angle a, light from (-z tan a, 0, -z) is to reach (s tan a, 0, s): the sum
    of both paths and of the lens's phase is to be constant over the aperture, up to a
    tilt, which moves the image. All angles share the radial terms, so the least squares
    over all of them are those of the mean wanted phase.
    """
    focus, radius_um = settings.focus, settings.aperture_mm * 500
    side_um = radius_um * torch.linspace(-1, 1, 41, dtype=torch.float64)
    y_um, x_um = torch.meshgrid(side_um, side_um, indexing="ij")
    inside = torch.hypot(x_um, y_um) <= radius_um
    x_um, y_um = x_um[inside], y_um[inside]
    units = torch.eye(settings.polynomials, dtype=torch.float64)
    terms = [phase_at(settings, u, side_um, side_um[:, None])[inside] for u in units]
    wavenumber = 2 * math.pi / focus.wavelength_um

    def path_um(angle_rad: float) -> Tensor:
        z_um, s_um = focus.source_distance_um, focus.sensor_distance_um
        shift = math.tan(angle_rad)
        source = ((x_um + z_um * shift) ** 2 + y_um**2 + z_um**2).sqrt()
        sensor = ((x_um - s_um * shift) ** 2 + y_um**2 + s_um**2).sqrt()
        return source + sensor

    tilts = torch.linalg.qr(torch.stack([torch.ones_like(x_um), x_um, y_um], 1)).Q

    def without_tilt(columns: Tensor) -> Tensor:
        return columns - tilts @ (tilts.mT @ columns)

    mean_path_um = torch.stack([path_um(a) for a in angles_rad.tolist()]).mean(0)
    wanted_rad = wavenumber * (path_um(0.0) - mean_path_um)
    rows = without_tilt(torch.stack(terms, 1))
    return torch.linalg.lstsq(rows, without_tilt(wanted_rad[:, None])).solution[:, 0]


def jointly_trained(field: FieldOfView, focus_mm: float, loss: str) -> Design:
    """Free-form lens and smallest network of the supernet trained together."""
    separability = SeparabilityConfig(every=5, triplets=2)
    inner = InnerConfig(
        steps=JOINT_STEPS,
        seed=JOINT,
        separability=separability if loss == "Eq. 6" else SeparabilityConfig(),
    )
    reader = field.reader(JOINT, FRAMES)
    settings = RunConfig(
        scenes=SceneConfig(pixels=field.pixels, margin=reader.margin, pool=1024),
        optics=field.optics(focus_mm=focus_mm, polynomials=35),
        sensor=reader.sensor,
        space=SPACE,
        inner=inner,
        run=RunBudgets(reader.pitch_um, (20.0,)),
    )
    run = start_run(settings)
    for record in run.trainer.run():
        if record.step % 50 == 0:
            print(record, flush=True)
    return settings.optics, run.trainer.model.coefficients_rad.detach()


def candidate_designs(
    field: FieldOfView, family: str, best_mm: float
) -> dict[str, Callable[[], Design]]:
    """Functions that make the lenses of a family, by name."""
    none = torch.zeros(0, dtype=torch.float64)

    def focus_of(focus_mm: float) -> Design:
        return field.optics(focus_mm=focus_mm), none

    def asphere_of(share: float) -> Design:
        optics = field.optics(focus_mm=best_mm, polynomials=6, family="radial")
        return optics, least_wavefront_asphere(optics, share * field.angles_rad)

    def helix_of(rings: int) -> Design:
        return field.optics(focus_mm=best_mm, zones=rings), none

    if family == "focus":
        return {f"focus {f:g} mm": lambda f=f: focus_of(f) for f in FOCI_MM}
    if family == "asphere":
        return {f"asphere for {s:.0%}": lambda s=s: asphere_of(s) for s in SHARES}
    if family == "double helix":
        return {f"double helix, {n} rings": lambda n=n: helix_of(n) for n in RINGS}
    return {f"joint, {family}": lambda: jointly_trained(field, best_mm, family)}


FAMILIES = ("focus", "asphere", "double helix", "texture loss", "Eq. 6")


def kept_lines(path: Path, **wanted: Any) -> list[Line]:
    """Lines of the file with these values."""
    text = path.read_text() if path.exists() else ""
    lines = [json.loads(line) for line in text.splitlines()]
    return [x for x in lines if all(x.get(key) == v for key, v in wanted.items())]


def keep_line(path: Path, line: Line) -> Line:
    """Append a result."""
    with path.open("a") as file:
        file.write(json.dumps(line) + "\n")
    print(line, flush=True)
    return line


def kept_design(path: Path, name: str, label: str, make: Callable[[], Design]) -> Line:
    """Coefficients of a lens, made once."""
    key = {"kind": "design", "field": name, "lens": label}
    if lines := kept_lines(path, **key):
        return lines[0]
    optics, coefficients = make()
    form = {
        k: getattr(optics, k) for k in ("focus_mm", "polynomials", "family", "zones")
    }
    return keep_line(
        path, key | {"form": form, "coefficients_rad": coefficients.tolist()}
    )


def design_of(line: Line) -> Design:
    """Optics and coefficients of a kept design."""
    optics = FIELDS[line["field"]].optics(**line["form"])
    return optics, torch.tensor(line["coefficients_rad"], dtype=torch.float64)


def read_lens(path: Path, design: Line, config: ReaderConfig) -> Line:
    """Result of the reference reader behind a lens: the stored one, or a new one."""
    key = {
        "kind": "reader",
        "field": design["field"],
        "lens": design["lens"],
        "seed": config.seed,
    }
    if lines := kept_lines(path, **key):
        return lines[0]
    reader = train_reader(_pillar_lens(json.dumps(design)), config)
    line = key | judge_reader(reader)
    if config.seed == 0:
        finer = judge_reader(reader, TOLERANCE / 4)
        line |= {"finer_mm": finer["axial_mm"], "finer_error": finer["image_error"]}
    return keep_line(path, line)


@functools.lru_cache(maxsize=8)
def _pillar_lens(design: str) -> Lens:
    return trained_lens(*design_of(json.loads(design)))


def chosen_designs(name: str, path: Path) -> list[Line]:
    """The best lens of every family, by one run of the reader with a seed of its
    own.
    """
    field, best_mm, chosen = FIELDS[name], FOCI_MM[0], []
    for family in FAMILIES:
        made = candidate_designs(field, family, best_mm)
        designs = [kept_design(path, name, *item) for item in made.items()]
        if len(designs) > 1:
            config = field.reader(CHOICE, CHOICE_FRAMES)
            errors = [read_lens(path, d, config)["axial_mm"] for d in designs]
            designs = [designs[int(np.argmin(errors))]]
        chosen.append(designs[0])
        if family == "focus":
            best_mm = designs[0]["form"]["focus_mm"]
    return chosen


def run_readers(name: str, path: Path) -> None:
    """All runs of the reference reader in a field that have no line yet."""
    chosen = chosen_designs(name, path)
    for seed in SEEDS:
        for design in chosen:
            read_lens(path, design, FIELDS[name].reader(seed, FRAMES))


def with_interval(values: Array, digits: int = 2) -> str:
    """Mean and 95 % interval of Student's over the seeds."""
    half = 0.0
    if len(values) > 1:
        half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1)
        half /= math.sqrt(len(values))
    mean = values.mean()
    return f"{mean:.{digits}f} [{mean - half:.{digits}f}, {mean + half:.{digits}f}]"


def ratio_interval(values: Array, reference: Array) -> str:
    """Geometric mean of the ratios paired by seed, with its 95 % interval."""
    logs = np.log(values / reference)
    half = student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / math.sqrt(len(logs))
    mean = logs.mean()
    low, middle, high = np.exp([mean - half, mean, mean + half])
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def print_table(lines: list[Line]) -> None:
    """Markdown rows of the lenses of a field, with ratios paired by seed to the best
    focus and to the asphere, and the error on images of a quarter of the tolerance.
    """
    rows = [x for x in lines if x["kind"] == "reader" and x["seed"] != CHOICE]
    lenses = list(dict.fromkeys(x["lens"] for x in rows))
    columns = ("axial_mm", "lateral_mm", "window_mm", "iou")
    head = ("lens", *columns, "axial to focus", "to asphere", "finer axial_mm")
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    seeds = set(SEEDS)
    for lens in lenses:
        seeds &= {x["seed"] for x in rows if x["lens"] == lens}

    def values(lens: str, column: str) -> Array:
        of_lens = [x for x in rows if x["lens"] == lens and x["seed"] in seeds]
        return np.array([x[column] for x in sorted(of_lens, key=lambda x: x["seed"])])

    for lens in lenses:
        cells = [with_interval(values(lens, column)) for column in columns]
        axial = values(lens, "axial_mm")
        cells += [ratio_interval(axial, values(o, "axial_mm")) for o in lenses[:2]]
        finer = [x for x in rows if x["lens"] == lens and "finer_mm" in x]
        cells += [f"{x['finer_mm']:.2f} ({x['axial_mm']:.2f})" for x in finer[:1]]
        print("| " + " | ".join([lens, *cells]) + " |")


def main() -> None:
    """Run the readers of a field, or print its table."""
    name, path = sys.argv[1], Path(sys.argv[2])
    if name in FIELDS:
        run_readers(name, path)
    else:
        print_table(kept_lines(path))


if __name__ == "__main__":
    main()
