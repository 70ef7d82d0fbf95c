"""What a free-form design climbs: an objective of the pupil's phase, and the encircled energy that binds it."""

from dataclasses import dataclass
from typing import Protocol

import torch

from metalens import pupil as pupils
from metalens.design_fisher_settings import SAMPLE_UM, Fisher, Variation
from metalens.fisher import axial_information, encircled_energy, pixel_information
from metalens.pupil import Pupil

Tensor = torch.Tensor
STEP_UM = 200.0  # of the difference in Eq. 11
WINDOW_UM = 144.0
CLIMB_WINDOW_UM = 120.0  # while climbing


@dataclass(frozen=True, eq=False, slots=True)
class Score:
    """Honest figures of a phase on the quick pupil model.

    information: (depths,) I(z) per mm², averaged over sub-pixel positions; minus Eq. 6 (one value) for scenes.
    encircled: (depths,) share of the light through the aperture inside the radius.
    """

    information: Tensor
    encircled: Tensor


class Objective(Protocol):
    """Something to climb."""

    def loss(self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Loss and encircled energy at some depths; without a generator the same function at every call."""

    def judge(self, phase_rad: Tensor, focus_um: float) -> Score:
        """Honest figures."""


class AxialObjective:
    """Minus the log of I(z) at jittered depths and two random positions of the pixels."""

    def __init__(self, pupil: Pupil, settings: Fisher) -> None:
        self.pupil, self.settings = pupil, settings

    def loss(self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """See :class:`Objective`."""
        settings = self.settings
        low, high = (1e3 * d for d in settings.depths_mm)
        depths = torch.linspace(low, high, 7, dtype=torch.float64)
        positions = torch.tensor([[-0.25, 0.25], [0.25, -0.25]])
        if generator is not None:
            depths = depths + (high - low) / 12 * 2 * (torch.rand(7, generator=generator, dtype=torch.float64) - 0.5)
            depths = depths.clamp(low - STEP_UM, high + STEP_UM)
            positions = torch.rand(2, 2, generator=generator) - 0.5
        near, far = _stacks(phase_rad, self.pupil, focus_um, depths, CLIMB_WINDOW_UM)
        total = phase_rad.new_zeros(())
        for y, x in (positions * settings.pixel_um).tolist():
            value = pixel_information(
                near,
                far,
                step_um=STEP_UM,
                sample_um=SAMPLE_UM,
                pixel_um=settings.pixel_um,
                normalisation=settings.normalisation,
                shift_um=(y, x),
            )
            spread, mean = torch.log(value + 1e-4).mean(), torch.log(value.mean() + 1e-4)
            total = total - (settings.even * spread + (1 - settings.even) * mean) / 2
        return total, encircled_energy(near, SAMPLE_UM, radius_um=settings.radius_um)

    def judge(self, phase_rad: Tensor, focus_um: float) -> Score:
        """See :class:`Objective`."""
        return score(phase_rad, self.pupil, focus_um=focus_um, settings=self.settings)


class Robust:
    """An objective under the process: its mean over plus and minus the variation, the worst encircled energy."""

    def __init__(self, inner: Objective, pupil: Pupil, variation: Variation) -> None:
        self.inner, self.pupil, self.variation = inner, pupil, variation

    def loss(self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """One sign an iteration at random; both without a generator."""
        if generator is not None:
            sign = 1.0 if float(torch.rand(1, generator=generator)) < 0.5 else -1.0
            return self.inner.loss(self._made(phase_rad, focus_um, sign), focus_um, generator)
        both = [self.inner.loss(self._made(phase_rad, focus_um, sign), focus_um, None) for sign in (1.0, -1.0)]
        return (both[0][0] + both[1][0]) / 2, torch.minimum(both[0][1], both[1][1])

    def judge(self, phase_rad: Tensor, focus_um: float) -> Score:
        """Worst of nominal, plus and minus at every depth."""
        found = [self.inner.judge(self._made(phase_rad, focus_um, sign), focus_um) for sign in (0.0, 1.0, -1.0)]
        worst = [torch.stack([getattr(f, name) for f in found]).amin(0) for name in ("information", "encircled")]
        return Score(worst[0], worst[1])

    def _made(self, phase_rad: Tensor, focus_um: float, sign: float) -> Tensor:
        """The phase of the lens as made: pillars give (1 + error) of their phase in [0, 2 pi)."""
        k = 2 * torch.pi / self.pupil.wavelength_um
        r, distance = pupils.radius(self.pupil), self.pupil.sensor_distance_um
        focus = -k * (pupils.spherical_path(r, distance) + pupils.spherical_path(r, focus_um))
        made = torch.remainder(phase_rad + focus, 2 * torch.pi)
        change = self.variation.distance_um
        moved = pupils.spherical_path(r, distance + sign * change) - pupils.spherical_path(r, distance)
        return phase_rad + sign * self.variation.phase * made + k * moved


def score(phase_rad: Tensor, pupil: Pupil, *, focus_um: float, settings: Fisher, depths: int = 11) -> Score:
    """Information and encircled energy of a phase on the pupil's nodes, at ``depths`` depths of the range."""
    low, high = (1e3 * d for d in settings.depths_mm)
    where = torch.linspace(low, high, depths, dtype=torch.float64)
    near, far = _stacks(phase_rad.detach(), pupil, focus_um, where, WINDOW_UM)
    value = axial_information(
        near,
        far,
        step_um=STEP_UM,
        sample_um=SAMPLE_UM,
        pixel_um=settings.pixel_um,
        normalisation=settings.normalisation,
    )
    return Score(value, encircled_energy(near, SAMPLE_UM, radius_um=settings.radius_um))


def _stacks(
    phase_rad: Tensor, pupil: Pupil, focus_um: float, depths_um: Tensor, window_um: float
) -> tuple[Tensor, Tensor]:
    samples = int(min(window_um, pupil.period_um) / SAMPLE_UM)
    both = torch.cat([depths_um, depths_um + STEP_UM])
    stack = pupils.psf(phase_rad, pupil, depths_um=both, focus_um=focus_um, sample_um=SAMPLE_UM, samples=samples)
    return stack[: len(depths_um)], stack[len(depths_um) :]
