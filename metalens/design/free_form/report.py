"""A free-form design and simple lenses tuned for the same task, as numbers and as a
picture.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens.core.report import figure_png, make_figure
from metalens.design import vortex_phase
from metalens.design.free_form.search import (
    DesignScore,
    FisherPhase,
    phase_on,
    score_phase,
)
from metalens.design.free_form.settings import ResolvedFisherSettings, between_mm
from metalens.image import Pupil
from metalens.image import pupil as pupils

# range of foci of the simple lenses: shares of the depth range in 1/z, 0 the near end
FOCI = (-0.87, 1.77)  # of the hyperbolic lens
HELIX_FOCI = (-0.37, 1.21)  # of the double helix
ZONES = (1, 2, 3, 4, 5, 6)  # of the double helix


@dataclass(frozen=True, eq=False, slots=True)
class JudgedLens:
    """A lens on the quick pupil.

    phase_rad: (nodes, nodes) without its focus. score: over (angles, depths). zones: of
    the double helix, 0 for none.
    """

    name: str
    phase_rad: Tensor
    focus_um: float
    score: DesignScore
    zones: int

    @property
    def information(self) -> float:
        """Mean axial information over depths and angles, per mm²."""
        return float(self.score.information.mean())


def judge_designs(
    profile: FisherPhase, pupil: Pupil, settings: ResolvedFisherSettings
) -> tuple[JudgedLens, ...]:
    """Figures of the design and of the best hyperbolic lens and double helix.

    All for the same pixels, depths and angles, at 11 depths, averaged over positions of
    the pixels.

    Args:
        profile: the designed phase.
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
    """
    phase = phase_on(pupil, profile)
    score = _score(phase, profile.focus_um, pupil, settings)
    own = JudgedLens("free form", phase, profile.focus_um, score, profile.zones)
    simple = tune_baselines(pupil, settings)
    return own, *(replace(lens, name=f"{lens.name}, tuned") for lens in simple)


def tune_baselines(
    pupil: Pupil, settings: ResolvedFisherSettings
) -> tuple[JudgedLens, JudgedLens]:
    """The most informative hyperbolic lens and double helix.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
    """
    plain = _tune(pupil, settings, (0,), FOCI, count=12)
    return plain, _tune(pupil, settings, ZONES, HELIX_FOCI, count=6)


def _score(
    phase: Tensor, focus_um: float, pupil: Pupil, settings: ResolvedFisherSettings
) -> DesignScore:
    """Figures of a phase, of shape (angles, depths) for one angle too."""
    score = score_phase(phase, pupil, focus_um=focus_um, settings=settings)
    rows = len(settings.angles_deg), -1
    return DesignScore(score.information.reshape(rows), score.encircled.reshape(rows))


def _tune(
    pupil: Pupil,
    settings: ResolvedFisherSettings,
    zones: tuple[int, ...],
    shares: tuple[float, float],
    *,
    count: int,
) -> JudgedLens:
    """Most informative simple lens over zones and focus.

    For each number of zones: a scan at equal steps of 1/z, then two refinements at half
    the step on both sides of the best.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
        zones: numbers of zones of the double helix; 0 for the hyperbolic lens.
        shares: range of the focus as shares of the depth range in 1/z.
        count: foci of the scan.
    """
    near, far = settings.depths_mm
    low, high = between_mm((1e3 * near, 1e3 * far), *shares)
    x, y = (axis.numpy() for axis in pupils.coordinates(pupil))

    def judge(rings: int, focus_mm: float) -> JudgedLens:
        vortices = vortex_phase(x, y, radius_um=pupil.radius_um, zones=rings)
        phase, focus_um = torch.from_numpy(vortices), 1e3 * focus_mm
        score = _score(phase, focus_um, pupil, settings)
        kind = f"helix of {rings} zone{'s' * (rings > 1)}" if rings else "hyperbolic"
        return JudgedLens(f"{kind}, {focus_mm:.1f} mm", phase, focus_um, score, rings)

    candidates: list[JudgedLens] = []
    for rings in zones:
        step = (1 / low - 1 / high) / (count - 1)
        inverse = np.linspace(1 / low, 1 / high, count).tolist()
        lenses = [judge(rings, 1 / value) for value in inverse]
        for _ in range(2):
            best = max(lenses, key=lambda lens: lens.information)
            step /= 2
            foci = [1 / (1e3 / best.focus_um + side * step) for side in (-1, 1)]
            lenses += [judge(rings, focus) for focus in foci if low <= focus <= high]
        candidates += lenses
    return max(candidates, key=lambda lens: lens.information)


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
        "times_the_better_baseline": lenses[0].information
        / max(lens.information for lens in lenses[1:]),
        "lenses": {
            lens.name: {
                "information_per_mm2": lens.score.information.tolist(),
                "encircled_energy": lens.score.encircled.tolist(),
            }
            for lens in lenses
        },
    }


def report_picture(
    lenses: tuple[JudgedLens, ...], settings: ResolvedFisherSettings
) -> bytes:
    """PNG of information and encircled energy over depth at the first angle.

    Args:
        lenses: judged designs.
        settings: resolved settings of the design.
    """
    figure, (left, right) = make_figure(1, 2, size=(10, 3.8))
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
        title="encircled energy; dotted: what was asked for",
        ylim=(0, 1),
    )
    left.legend(fontsize=7)
    return figure_png(figure)


def _depths(lenses: tuple[JudgedLens, ...], settings: ResolvedFisherSettings) -> Any:
    """Depths in mm of the figures."""
    return np.linspace(*settings.depths_mm, lenses[0].score.information.shape[1])
