"""What a free-form design climbs: an objective of the pupil's phase, and the encircled
energy that binds it.
"""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from metalens.design.free_form.settings import ProcessVariation, ResolvedFisherSettings
from metalens.image import (
    Field,
    Pupil,
    axial_information,
    encircled_energy,
    pixel_information,
)
from metalens.image import pupil as pupils
from metalens.optics.paths import path_difference

CLIMB_IMAGES = (
    4  # of a step, at least two an angle: more noise, but more steps in the same time
)
DIRECTIONS = 4  # of the field, that the steps draw from
STILL = torch.tensor(
    [[-0.25, 0.25], [0.25, -0.25]]
)  # positions of the pixels where nothing is drawn


@dataclass(frozen=True, eq=False, slots=True)
class DesignScore:
    """Honest figures of a phase on the quick pupil model.

    information: (depths,) I(z) per mm², averaged over sub-pixel positions, with several
    field angles (angles, depths);
        minus Eq. 6 (one value) for scenes.
    encircled: of the same shape (for scenes at their depths), share of the light
    through the aperture in the radius.
    """

    information: Tensor
    encircled: Tensor


class Objective(Protocol):
    """Something to climb."""

    def loss(
        self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Loss and encircled energy at some depths; without a generator the same
        function at every call.
        """

    def judge(self, phase_rad: Tensor, focus_um: float) -> DesignScore:
        """Honest figures."""


class AxialObjective:
    """Minus the log of I(z) at random depths, field directions and positions of the
    pixels; alike for every angle.
    """

    def __init__(self, pupil: Pupil, settings: ResolvedFisherSettings) -> None:
        self.pupil, self.settings = pupil, settings

    def loss(
        self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """See :class:`Objective`."""
        settings = self.settings
        depths, fields, positions = self._drawn(generator)
        near, far = _stacks(
            phase_rad,
            self.pupil,
            focus_um,
            depths,
            fields,
            settings,
            settings.climb_window_um,
        )
        total = phase_rad.new_zeros(())
        for y, x in (positions * settings.pixel_um).tolist():
            value = pixel_information(near, far, shift_um=(y, x), **_counted(settings))
            value = value.reshape(-1, len(settings.angles_deg))
            spread, mean = (
                torch.log(value + 1e-4).mean(),
                torch.log(value.mean(0) + 1e-4).mean(),
            )
            total = total - (settings.even * spread + (1 - settings.even) * mean) / len(
                positions
            )
        return total, encircled_energy(
            near, settings.sample_um, radius_um=settings.radius_um
        )

    def _drawn(
        self, generator: torch.Generator | None
    ) -> tuple[Tensor, list[Field], Tensor]:
        """Depths and fields (angles in turn) of the images, and positions of the
        pixels.
        """
        angles, (low, high) = (
            self.settings.angles_deg,
            (1e3 * d for d in self.settings.depths_mm),
        )
        if generator is None:
            depths = torch.linspace(
                low, high, 7, dtype=torch.float64
            ).repeat_interleave(len(angles))
            return (
                depths,
                [Field(math.radians(a)) for _ in range(7) for a in angles],
                STILL,
            )
        count = max(2, math.ceil(CLIMB_IMAGES / len(angles))) * len(angles)
        strata = torch.randperm(count, generator=generator) + torch.rand(
            count, generator=generator
        )
        depths = low + (high - low) / count * strata.double()
        turns = torch.randint(0, DIRECTIONS, (count,), generator=generator).tolist()
        fields = [
            _field(angles[i % len(angles)], turn / DIRECTIONS)
            for i, turn in enumerate(turns)
        ]
        return depths, fields, torch.rand(2, 2, generator=generator) - 0.5

    def judge(self, phase_rad: Tensor, focus_um: float) -> DesignScore:
        """See :class:`Objective`."""
        return score_phase(
            phase_rad, self.pupil, focus_um=focus_um, settings=self.settings
        )


class RobustObjective:
    """An objective under the process: its mean over plus and minus the variation, the
    worst encircled energy.
    """

    def __init__(
        self, inner: Objective, pupil: Pupil, variation: ProcessVariation
    ) -> None:
        self.inner, self.pupil, self.variation = inner, pupil, variation

    def loss(
        self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """One sign an iteration at random; both without a generator."""
        if generator is not None:
            sign = 1.0 if float(torch.rand(1, generator=generator)) < 0.5 else -1.0
            return self.inner.loss(
                self._made(phase_rad, focus_um, sign), focus_um, generator
            )
        both = [
            self.inner.loss(self._made(phase_rad, focus_um, sign), focus_um, None)
            for sign in (1.0, -1.0)
        ]
        return (both[0][0] + both[1][0]) / 2, torch.minimum(both[0][1], both[1][1])

    def judge(self, phase_rad: Tensor, focus_um: float) -> DesignScore:
        """Worst of nominal, plus and minus at every depth."""
        found = [
            self.inner.judge(self._made(phase_rad, focus_um, sign), focus_um)
            for sign in (0.0, 1.0, -1.0)
        ]
        worst = [
            torch.stack([getattr(f, name) for f in found]).amin(0)
            for name in ("information", "encircled")
        ]
        return DesignScore(worst[0], worst[1])

    def _made(self, phase_rad: Tensor, focus_um: float, sign: float) -> Tensor:
        """The phase of the lens as made: pillars give (1 + error) of their phase in [0,
        2 pi).
        """
        k = 2 * torch.pi / self.pupil.wavelength_um
        r2, distance = pupils.radius(self.pupil) ** 2, self.pupil.sensor_distance_um
        focus = -k * (path_difference(r2, distance) + path_difference(r2, focus_um))
        made = torch.remainder(phase_rad + focus, 2 * torch.pi)
        change = self.variation.distance_um
        moved: Tensor = path_difference(r2, distance + sign * change) - path_difference(
            r2, distance
        )
        return phase_rad + sign * self.variation.phase * made + k * moved


def score_phase(
    phase_rad: Tensor,
    pupil: Pupil,
    *,
    focus_um: float,
    settings: ResolvedFisherSettings,
    depths: int = 11,
) -> DesignScore:
    """Information and encircled energy of a phase on the pupil's nodes, at ``depths``
    depths of the range.

    Off axis in the directions of +x and +y: mean information, least energy.

    Args:
        phase_rad: phase, rad.
        focus_um: source distance in focus, um.
        settings: resolved settings of the design.
    """
    low, high = (1e3 * d for d in settings.depths_mm)
    where = torch.linspace(low, high, depths, dtype=torch.float64)
    values, energies = [], []
    for angle in settings.angles_deg:
        seen = []
        for turn in (0.0, 0.25) if angle > 0 else (0.0,):
            fields = [_field(angle, turn)] * depths
            near, far = _stacks(
                phase_rad.detach(),
                pupil,
                focus_um,
                where,
                fields,
                settings,
                settings.window_um,
            )
            value = axial_information(near, far, **_counted(settings))
            seen.append(
                (
                    value,
                    encircled_energy(
                        near, settings.sample_um, radius_um=settings.radius_um
                    ),
                )
            )
        values.append(torch.stack([value for value, _ in seen]).mean(0))
        energies.append(torch.stack([energy for _, energy in seen]).amin(0))
    if len(values) == 1:
        return DesignScore(values[0], energies[0])
    return DesignScore(torch.stack(values), torch.stack(energies))


def _counted(settings: ResolvedFisherSettings) -> dict[str, Any]:
    """How Eq. 11 counts, as arguments."""
    return {"step_um": settings.step_um, "sample_um": settings.sample_um, "pixel_um": settings.pixel_um,
            "normalisation": settings.normalisation}  # fmt: skip


def _field(angle_deg: float, turn: float) -> Field:
    return Field(math.radians(angle_deg), 2 * math.pi * turn if angle_deg > 0 else 0.0)


def _stacks(
    phase_rad: Tensor,
    pupil: Pupil,
    focus_um: float,
    depths_um: Tensor,
    fields: list[Field],
    settings: ResolvedFisherSettings,
    window_um: float,
) -> tuple[Tensor, Tensor]:
    sample = settings.sample_um
    samples = int(min(window_um, pupil.period_um) / sample)
    both = torch.cat([depths_um, depths_um + settings.step_um])
    stack = pupils.psf(phase_rad, pupil, depths_um=both, fields=fields * 2, focus_um=focus_um, sample_um=sample,
                       samples=samples)  # fmt: skip
    return stack[: len(depths_um)], stack[len(depths_um) :]
