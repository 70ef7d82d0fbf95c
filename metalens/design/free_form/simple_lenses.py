"""Baselines tuned as hard as a design: the focus of a hyperbolic lens, zones and focus
of a double helix.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from metalens.core.errors import ConfigError
from metalens.design import DoubleHelix, Focus, PhaseOf, phase_of
from metalens.design.free_form.search import score_phase, vortex_phase
from metalens.design.free_form.settings import ResolvedFisherSettings, between_mm
from metalens.image import Pupil
from metalens.image import pupil as pupils

FOCI = (
    -0.87,
    1.77,
)  # searched for the hyperbolic lens: of the range of depths in 1/z, from its near end
HELIX_FOCI = (-0.37, 1.21)
ZONES = (1, 2, 3, 4, 5, 6)


@dataclass(frozen=True, slots=True)
class BaselineLens:
    """A simple lens and what it is worth.

    zones: of the double helix, 0 for a hyperbolic lens. focus_um: source distance of
    best focus.
    information: mean of I(z) over the depths, per mm². encircled: least share of the
    light over the depths.
    """

    zones: int
    focus_um: float
    information: float
    encircled: float

    @property
    def name(self) -> str:
        """Kind and focus, for tables."""
        kind = (
            f"helix of {self.zones} zone{'s' * (self.zones > 1)}"
            if self.zones
            else "hyperbolic"
        )
        return f"{kind}, {self.focus_um / 1e3:.1f} mm"

    def phase(self, focus: Focus, *, radius_um: float) -> tuple[PhaseOf, Focus]:
        """The wanted phase as a function of position, and what it images onto what."""
        mine = replace(focus, source_distance_um=self.focus_um)
        shape = DoubleHelix(zones=self.zones) if self.zones else None
        return phase_of(shape, mine, radius_um=radius_um), mine


def judge_baseline(
    pupil: Pupil, settings: ResolvedFisherSettings, *, zones: int, focus_um: float
) -> BaselineLens:
    """One simple lens on the quick pupil, honestly measured at ``settings.pixel_um``.

    Args:
        zones: ring zones of the double helix.
        focus_um: source distance in focus, um.
    """
    phase = baseline_phase(pupil, zones)
    found = score_phase(phase, pupil, focus_um=focus_um, settings=settings)
    return BaselineLens(
        zones, focus_um, float(found.information.mean()), float(found.encircled.min())
    )


def baseline_phase(pupil: Pupil, zones: int) -> Tensor:
    """(nodes, nodes) vortices on the pupil's nodes.

    Args:
        zones: ring zones of the double helix.
    """
    x, y = (a.numpy() for a in pupils.coordinates(pupil))
    return torch.from_numpy(vortex_phase(x, y, radius_um=pupil.radius_um, zones=zones))


def tune_baseline(
    pupil: Pupil,
    settings: ResolvedFisherSettings,
    *,
    zones: Sequence[int] = (0,),
    foci_mm: tuple[float, float],
    count: int = 12,
) -> BaselineLens:
    """Most informative lens over zones and focus: a scan at equal steps of 1/z, then
    twice a finer one around the best.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
        count: how many.

    Raises:
        ConfigError: no zones, foci that do not ascend, or fewer than 3 foci.
    """
    low, high = foci_mm
    if not (zones and 0 < low < high and count >= 3):
        raise ConfigError(
            f"zones = {zones}, foci_mm = {foci_mm}, count = {count}: need 0 < least < largest and 3 foci"
        )
    tried: list[BaselineLens] = []
    for rings in zones:
        here = 1e3 / np.linspace(1 / low, 1 / high, count)
        step = (1 / low - 1 / high) / (count - 1)
        found = [
            judge_baseline(pupil, settings, zones=rings, focus_um=float(f))
            for f in here
        ]
        for _ in range(2):
            best = max(found, key=lambda b: b.information)
            step /= 2
            near = [1 / (1e3 / best.focus_um + side * step) for side in (-1, 1)]
            found += [
                judge_baseline(pupil, settings, zones=rings, focus_um=1e3 * f)
                for f in near
                if low <= f <= high
            ]
        tried += found
    return max(tried, key=lambda b: b.information)


def tune_baselines(
    pupil: Pupil, settings: ResolvedFisherSettings
) -> tuple[BaselineLens, BaselineLens]:
    """The best hyperbolic lens and the best double helix.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
    """
    near, far = (1e3 * z for z in settings.depths_mm)
    plain, wound = (between_mm((near, far), *ends) for ends in (FOCI, HELIX_FOCI))
    helix = tune_baseline(pupil, settings, zones=ZONES, foci_mm=wound, count=6)
    return tune_baseline(pupil, settings, foci_mm=plain), helix
