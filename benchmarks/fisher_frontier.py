"""The frontier of axial information against encircled energy, per binning, and its
lenses as pillars at field angles.

Longer than the other benchmarks, so it runs in steps that resume:

    python -m benchmarks.fisher_frontier design FOLDER        # free-form phases, a minute of one core each
    python -m benchmarks.fisher_frontier pillars FOLDER LENS  # those for field angles,
    and at energy 0.5 on axis, on
                                                              # the pillars of LENS, at
                                                              0-20 degrees
    python -m benchmarks.fisher_frontier collect FOLDER       # into docs/fisher/frontier.json and frontier.png
"""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from metalens import design
from metalens.design.free_form import search as design_fisher
from metalens.design.free_form import simple_lenses as baselines
from metalens.design.free_form.search import Fisher
from metalens.design.free_form.settings import Asked
from metalens.design.profiles import Focus
from metalens.image.pupil import Pupil

PUPIL = Pupil(nodes=160)
FOCUS = Focus(PUPIL.wavelength_um, PUPIL.sensor_distance_um, 20e3)
ENERGIES = (0.5, 0.3, 0.7, 0.85)
BINNINGS = (2, 1, 3)
PAPER = 1.12  # at 5 degrees, Table 3
DOCS = Path(__file__).parents[1] / "docs" / "fisher"


ANGLES = (0.0, 5.0, 10.0)  # of the designs off axis, at the first energy of SPREAD
SPREAD = 0.3


def settings(
    binning: int, energy: float, angles_deg: tuple[float, ...] = (0.0,)
) -> Asked:
    """What ``metalens design`` takes by default; one start for several angles."""
    starts = 3 if len(angles_deg) == 1 else 1
    asked = Fisher(
        pixel_um=3.0 * binning, encircled=energy, angles_deg=angles_deg, starts=starts
    )
    return asked.about(FOCUS, PUPIL.radius_um)


def figures(phase: torch.Tensor, focus_um: float) -> dict[str, Any]:
    """Mean information at every binning and least energy, over 11 depths."""
    asked = [Fisher(pixel_um=3.0 * b).about(FOCUS, PUPIL.radius_um) for b in (1, 2, 3)]
    found = [
        design_fisher.score(phase, PUPIL, focus_um=focus_um, settings=one)
        for one in asked
    ]
    return {
        "information": [float(f.information.mean()) for f in found],
        "encircled": float(found[0].encircled.min()),
    }


def make(folder: Path) -> None:
    """Design what is missing."""
    wanted = {
        f"b{b}_{energy:.2f}": settings(b, energy)
        for energy in ENERGIES
        for b in BINNINGS
    }
    wanted |= {
        f"b{b}_{SPREAD:.2f}_to_10deg": settings(b, SPREAD, ANGLES) for b in BINNINGS
    }
    for name, asked in wanted.items():
        path = folder / f"{name}.npz"
        if path.exists():
            continue
        found = design_fisher.optimise(PUPIL, asked)
        made = figures(design_fisher.phase_on(PUPIL, found), found.focus_um)
        np.savez(
            path,
            controls=found.controls.numpy().astype(np.float32),
            cells=found.cells,
            focus_um=found.focus_um,
            made=json.dumps(made),
        )
        print(path.stem, made, found.reason, flush=True)


def baseline_figures() -> dict[str, Any]:
    """Tuned hyperbolic lens and double helix of every binning."""
    out = {}
    for binning in (1, 2, 3):
        asked = Fisher(pixel_um=3.0 * binning).about(FOCUS, PUPIL.radius_um)
        plain, helix = baselines.tuned_pair(PUPIL, asked)
        for kind, found in (("hyperbolic", plain), ("double helix", helix)):
            phase = baselines.baseline_phase(PUPIL, found.zones)
            about = {"focus_um": found.focus_um, "zones": found.zones}
            out[f"{kind}, tuned at {binning} x {binning}"] = about | figures(
                phase, found.focus_um
            )
    return out


def fringe(binning: int) -> dict[str, float]:
    """What two points of the pupil can give: a fringe between radii, seen through the
    pixel. Many points can do better.

    The phase between r1 and r2 turns by k (r2² - r1²) / 2z² per unit of depth. A fringe
    of full contrast has
    I(z) = (rate)² MTF² / (2 + MTF²), at the best pair of radii; mean over 16-26 mm.
    """
    k, pixel, z = 2 * math.pi / 0.85e-3, 3e-3 * binning, np.linspace(16, 26, 51)
    inner, outer = np.meshgrid(np.linspace(0, 0.5, 101), np.linspace(0, 0.5, 101))
    apart = np.abs(outer - inner) + 1e-9
    rate = k * np.abs(outer**2 - inner**2)[..., None] / (2 * z**2)
    mtf = np.abs(np.sinc(pixel * apart / (0.85e-3 * 2.0)))[..., None]
    value = (rate**2 * mtf**2 / (2 + mtf**2)).mean(-1)
    best = np.unravel_index(int(value.argmax()), value.shape)
    return {
        "information": float(value.max()),
        "r1_mm": float(inner[best]),
        "r2_mm": float(outer[best]),
    }


def pillars(folder: Path, lens_file: str) -> None:
    """The designs for angles and at energy 0.5, and tuned lenses, on the pillars of a
    lens, through the PSF engine.
    """
    from codesign.evaluate.optics import Setting, axial
    from metalens import lens

    like = lens.load(lens_file)
    setting = Setting(count=6, window_um=144.0, angles_deg=(0.0, 5.0, 10.0, 20.0))
    focus = Focus(like.wavelength_um, like.sensor_distance_um, 20e3)
    phases = {}
    for path in (
        *sorted(folder.glob("b*_to_*deg.npz")),
        *sorted(folder.glob("b*_0.50.npz")),
    ):
        phases[path.stem] = phase_of(path, focus)
    for zones, depth_um in ((0, 20e3), (2, 19.1e3), (1, 19.8e3), (1, 14.4e3)):
        simple = baselines.Baseline(zones, depth_um, 0.0, 0.0)
        phases[simple.name] = simple.phase(focus, radius_um=PUPIL.radius_um)
    for name, (phase, at) in phases.items():
        target = folder / f"pillars {name}.json"
        if target.exists():
            continue
        made, _ = design.make(
            phase,
            at,
            aperture_um=1000.0,
            cell=like.cell,
            proxy=like.proxy,
            profile="fisher",
        )
        lens.save(folder / f"{name.replace(' ', '_').replace(',', '')}.h5", made)
        found = axial(made, setting)
        values = {
            "angles_deg": list(setting.angles_deg),
            "information": found.information.mean(-1).tolist(),
            "encircled": found.encircled.amin(1).tolist(),
            "psf_error": found.psf_error,
        }
        target.write_text(json.dumps(values, indent=1))
        print(name, values, flush=True)


def phase_of(path: Path, focus: Focus) -> tuple[design.PhaseOf, Focus]:
    """A saved design as a function of position."""
    held = np.load(path)
    controls, mine = (
        held["controls"],
        replace(focus, source_distance_um=float(held["focus_um"])),
    )
    plain = design.phase_of(None, mine, radius_um=PUPIL.radius_um)
    extra = design_fisher.free_form(
        controls.astype(float), PUPIL, cells=bool(held["cells"])
    )
    return lambda x_um, y_um: plain(x_um, y_um) + extra(x_um, y_um), mine


def collect(folder: Path) -> None:
    """Everything that is there, on top of what was collected before, as JSON and
    picture.
    """
    held: dict[str, Any] = (
        json.loads((DOCS / "frontier.json").read_text())
        if (DOCS / "frontier.json").exists()
        else {}
    )
    known = {
        path.stem: json.loads(str(np.load(path)["made"]))
        for path in sorted(folder.glob("b*_*.npz"))
    }
    on_pillars = {
        p.stem.removeprefix("pillars "): json.loads(p.read_text())
        for p in sorted(folder.glob("pillars *"))
    }
    simple = held.get("baselines") or baseline_figures()
    values = {
        "what": "I(z) of Eq. 11 per mm², mean over 16-26 mm, L2-normalised, intensities every 0.75 um, 9 sub-pixel "
        "positions, at 1 x 1, 2 x 2, 3 x 3 pixels of 3 um; encircled: least share within 18 um over the depths",
        "designs": held.get("designs", {}) | known,
        "baselines": simple,
        "two_point_fringe": {str(b): fringe(b) for b in (1, 2, 3)},
        "pillars_what": "mean over 6 depths (16, 18 ... 26 mm), per field angle (rows) and binning (columns); the "
        "least energy of each angle, in the circle of 18 um that holds most; proxy at normal incidence",
        "paper": {"proposed at 5 degrees": PAPER},
        "pillars": held.get("pillars", {}) | on_pillars,
    }
    DOCS.mkdir(parents=True, exist_ok=True)
    (DOCS / "frontier.json").write_text(json.dumps(values, indent=1) + "\n")
    (DOCS / "frontier.png").write_bytes(picture(values))


def picture(values: dict[str, Any]) -> bytes:
    """Information against encircled energy, a panel for each binning."""
    from metalens.ground.report import canvas, png

    figure, panels = canvas(1, 3, size=(11, 3.6))
    for k, panel in enumerate(panels):
        best = max(b["information"][k] for b in values["baselines"].values())
        for shown, mark, colour, label in (
            (values["designs"], "o", "C0", "free form"),
            (
                {n: b for n, b in values["baselines"].items() if "hyper" in n},
                "s",
                "C3",
                "hyperbolic, focus 14-33 mm",
            ),
            (
                {n: b for n, b in values["baselines"].items() if "helix" in n},
                "D",
                "C2",
                "double helix, tuned",
            ),
        ):
            points = sorted(
                (v["encircled"], v["information"][k]) for v in shown.values()
            )
            panel.plot(
                *zip(*points, strict=True), mark, color=colour, label=label, ms=5
            )
            if mark == "o":
                edge = [
                    p
                    for i, p in enumerate(points)
                    if all(q[1] < p[1] for q in points[i + 1 :])
                ]
                panel.plot(*zip(*edge, strict=True), "-", color=colour, lw=1)
        limit = values["two_point_fringe"][str(k + 1)]["information"]
        for level, style, label in (
            (best, ":", "better baseline"),
            (2 * best, "--", "twice that"),
            (limit, "-.", "best two-point fringe"),
        ):
            panel.axhline(level, ls=style, color="0.4", lw=1, label=label)
        if k == 0:
            panel.axhline(PAPER, color="C1", lw=1, label="paper, 5° (claimed)")
        panel.set(
            title=f"{k + 1} × {k + 1} of 3 µm",
            xlabel="least encircled energy in 18 µm",
            xlim=(0, 1),
            ylim=(0, None),
        )
    panels[0].set_ylabel("I(z) / mm⁻², mean over 16-26 mm")
    panels[0].legend(fontsize=7)
    return png(figure)


if __name__ == "__main__":
    torch.set_num_threads(1)
    where = Path(sys.argv[2])
    where.mkdir(parents=True, exist_ok=True)
    if sys.argv[1] == "design":
        make(where)
    elif sys.argv[1] == "pillars":
        pillars(where, sys.argv[3])
    else:
        collect(where)
