"""What a free-form design is worth: honest figures beside simple lenses tuned as hard;
as text, numbers and picture.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens.core.report import figure_png, make_figure
from metalens.design.free_form import simple_lenses as baselines
from metalens.design.free_form.objective import DesignScore, score_phase
from metalens.design.free_form.search import FisherPhase, phase_on
from metalens.design.free_form.settings import ResolvedFisherSettings
from metalens.image import Field, Pupil
from metalens.image import pupil as pupils

SHOWN = 3  # times as wide as a PSF in the picture is the window
STRIP = 6  # depths of them


@dataclass(frozen=True, eq=False, slots=True)
class JudgedLens:
    """A lens on the quick pupil. phase_rad: (nodes, nodes) without its focus. score:
    over (angles, depths).
    """

    name: str
    phase_rad: Tensor
    focus_um: float
    score: DesignScore


def judge_designs(
    made: FisherPhase, pupil: Pupil, settings: ResolvedFisherSettings
) -> tuple[JudgedLens, ...]:
    """The design, and the best hyperbolic lens and double helix for the same pixels,
    depths and angles.

    Intensities every ``settings.sample_um``, averaged over sub-pixel positions, at 11
    depths.

    Args:
        made: what was designed or computed.
        pupil: sampled pupil of the lens.
    """
    lenses = [("free form", phase_on(pupil, made), made.focus_um)]
    for simple in baselines.tune_baselines(pupil, settings):
        lenses.append(
            (
                f"{simple.name}, tuned",
                baselines.baseline_phase(pupil, simple.zones),
                simple.focus_um,
            )
        )
    out = []
    for name, phase, focus in lenses:
        found = score_phase(phase, pupil, focus_um=focus, settings=settings)
        rows = [
            t.reshape(len(settings.angles_deg), -1)
            for t in (found.information, found.encircled)
        ]
        out.append(JudgedLens(name, phase, focus, DesignScore(rows[0], rows[1])))
    return tuple(out)


def information_gain(lenses: tuple[JudgedLens, ...]) -> float:
    """Mean information of the first lens over that of the best of the others.

    Args:
        lenses: judged designs.
    """
    means = [float(lens.score.information.mean()) for lens in lenses]
    return means[0] / max(means[1:])


def report_values(
    lenses: tuple[JudgedLens, ...], settings: ResolvedFisherSettings
) -> dict[str, Any]:
    """Every figure, ready for JSON.

    Args:
        lenses: judged designs.
        settings: resolved settings of the design.
    """
    return {
        "depths_mm": _depths(lenses, settings).tolist(),
        "angles_deg": list(settings.angles_deg),
        "pixel_um": settings.pixel_um,
        "radius_um": settings.radius_um,
        "step_um": settings.step_um,
        "normalisation": settings.normalisation,
        "times_the_better_baseline": information_gain(lenses),
        "lenses": {
            lens.name: {
                "information_per_mm2": lens.score.information.tolist(),
                "encircled_energy": lens.score.encircled.tolist(),
            }
            for lens in lenses
        },
    }


def report_picture(
    lenses: tuple[JudgedLens, ...], pupil: Pupil, settings: ResolvedFisherSettings
) -> bytes:
    """Information and energy over depth at the first angle, and PSFs of the lenses
    through the range.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
    """
    figure, _ = make_figure(1, 1, size=(10, 7.6))
    figure.clear()
    top, bottom = figure.subfigures(2, 1, height_ratios=(3, 0.4 + 1.3 * len(lenses)))
    left, right = top.subplots(1, 2)
    depths, angle = _depths(lenses, settings), settings.angles_deg[0]
    for lens in lenses:
        left.plot(depths, lens.score.information[0].numpy(), ".-", label=lens.name)
        right.plot(depths, lens.score.encircled[0].numpy(), ".-")
    right.axhline(settings.encircled, color="0.5", ls=":")
    left.set(
        ylabel="I(z) / mm⁻²",
        xlabel="source depth / mm",
        title=f"axial information at {angle:g}°",
        ylim=(0, None),
    )
    right.set(
        ylabel=f"energy in {settings.radius_um:g} µm",
        xlabel="source depth / mm",
        ylim=(0, 1),
    )
    right.set_title("encircled energy; dotted: what was asked for")
    left.legend(fontsize=7)
    planes = torch.linspace(
        1e3 * settings.depths_mm[0],
        1e3 * settings.depths_mm[1],
        STRIP,
        dtype=torch.float64,
    )
    fields = [Field(float(np.radians(angle)))] * STRIP
    samples = max(2, int(settings.window_um / SHOWN / settings.sample_um))
    panels = bottom.subplots(len(lenses), STRIP, squeeze=False)
    for row, lens in enumerate(lenses):
        stack = pupils.psf(lens.phase_rad, pupil, depths_um=planes, fields=fields, focus_um=lens.focus_um,
                                  sample_um=settings.sample_um, samples=samples)  # fmt: skip
        for column, image in enumerate(stack):
            panel = panels[row, column]
            panel.imshow(torch.sqrt(image).numpy(), cmap="inferno")
            panel.set(xticks=[], yticks=[])
            if row == 0:
                panel.set_title(f"{planes[column] / 1e3:g} mm", fontsize=8)
            if column == 0:
                panel.set_ylabel(lens.name.replace(", ", "\n"), fontsize=7)
    bottom.supxlabel(
        f"PSFs, {samples * settings.sample_um:.3g} µm wide, square root of the intensity, each at its own scale",
        fontsize=8,
    )
    return figure_png(figure)


def _depths(lenses: tuple[JudgedLens, ...], settings: ResolvedFisherSettings) -> Any:
    return np.linspace(*settings.depths_mm, lenses[0].score.information.shape[1])
