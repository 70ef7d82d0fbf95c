"""Simple lenses tuned for the task of a free-form design, to compare it with."""

from dataclasses import dataclass

import numpy as np
import torch

from metalens.design import vortex_phase
from metalens.design.free_form.search import score_phase
from metalens.design.free_form.settings import ResolvedFisherSettings, between_mm
from metalens.image import Pupil
from metalens.image import pupil as pupils

# range of foci of the simple lenses: shares of the depth range in 1/z, 0 the near end
FOCI = (-0.87, 1.77)  # of the hyperbolic lens
HELIX_FOCI = (-0.37, 1.21)  # of the double helix
ZONES = (1, 2, 3, 4, 5, 6)  # of the double helix


@dataclass(frozen=True, slots=True)
class BaselineLens:
    """A hyperbolic lens or a double helix.

    focus_um: source distance in focus. zones: of the double helix, 0 for none.
    information: mean axial information over depths and angles, per mm².
    """

    name: str
    focus_um: float
    zones: int
    information: float


def tune_baselines(
    pupil: Pupil, settings: ResolvedFisherSettings
) -> tuple[BaselineLens, BaselineLens]:
    """The most informative hyperbolic lens and double helix.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
    """
    plain = _tune(pupil, settings, (0,), FOCI, count=12)
    return plain, _tune(pupil, settings, ZONES, HELIX_FOCI, count=6)


def _tune(
    pupil: Pupil,
    settings: ResolvedFisherSettings,
    zones: tuple[int, ...],
    shares: tuple[float, float],
    *,
    count: int,
) -> BaselineLens:
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

    def judge(rings: int, focus_mm: float) -> BaselineLens:
        vortices = vortex_phase(x, y, radius_um=pupil.radius_um, zones=rings)
        phase, focus_um = torch.from_numpy(vortices), 1e3 * focus_mm
        score = score_phase(phase, pupil, focus_um=focus_um, settings=settings)
        kind = f"helix of {rings} zone{'s' * (rings > 1)}" if rings else "hyperbolic"
        information = float(score.information.mean())
        return BaselineLens(f"{kind}, {focus_mm:.1f} mm", focus_um, rings, information)

    candidates: list[BaselineLens] = []
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
