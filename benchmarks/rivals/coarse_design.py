"""How a careless measure is exploited: the axial information climbed as read coarsely,
at one position of the pixels.

Kept to show why :func:`metalens.fisher.axial_information` samples finely and averages
over positions.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from metalens.design import Focus
from metalens.design.free_form import Fisher, score
from metalens.image import Pupil, pixel_information
from metalens.image import pupil as pupils

PIXEL_UM, STEP_UM = 3.0, 200.0


@dataclass(frozen=True, eq=False, slots=True)
class Claim:
    """Mean I(z) per mm² that the coarse measure claims and that the lens has, over the
    iterations.

    claimed, honest: at the end. history: (looks, 2) claimed and honest on the way.
    phase_rad: that was found.
    """

    claimed: float
    honest: float
    history: Tensor
    phase_rad: Tensor


def coarse_climb(
    pupil: Pupil,
    *,
    iterations: int = 60,
    looks: int = 4,
    seed: int = 0,
    focus_um: float = 20e3,
) -> Claim:
    """Climb I(z) with one intensity sample a pixel of 3 um, at one position, on free
    nodes of the pupil.
    """
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randn(1, 1, 10, 10, generator=generator, dtype=torch.float64)
    grown = torch.nn.functional.interpolate(
        coarse, size=(pupil.nodes, pupil.nodes), mode="bicubic"
    )
    phase = (2 * grown[0, 0]).requires_grad_(True)
    step = torch.optim.Adam([phase], lr=0.2)
    depths = torch.linspace(16e3, 26e3, 6, dtype=torch.float64)
    own = Focus(pupil.wavelength_um, pupil.sensor_distance_um, focus_um)
    asked = Fisher(depths_mm=(16.0, 26.0)).about(own, pupil.radius_um)
    both = torch.cat([depths, depths + STEP_UM])
    history = []
    for i in range(iterations):
        stack = pupils.psf(
            phase,
            pupil,
            depths_um=both,
            focus_um=focus_um,
            sample_um=PIXEL_UM,
            samples=40,
        )
        near, far = stack[: len(depths)], stack[len(depths) :]
        value = pixel_information(
            near,
            far,
            step_um=STEP_UM,
            sample_um=PIXEL_UM,
            pixel_um=PIXEL_UM,
            normalisation="l2",
        ).mean()
        if i % max(1, iterations // looks) == 0 or i == iterations - 1:
            honest = score(
                phase, pupil, focus_um=focus_um, settings=asked, depths=6
            ).information.mean()
            history.append(torch.stack([value.detach(), honest]))
        step.zero_grad()
        (-torch.log(value)).backward()  # type: ignore[no-untyped-call]
        step.step()
    claimed, honest = history[-1].tolist()
    return Claim(claimed, honest, torch.stack(history), phase.detach())
