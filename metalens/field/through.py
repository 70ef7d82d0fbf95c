"""Light of a field point that goes through a lens, wherever it then lands: what the light in a window is a share of."""

import math

import torch
from torch import Tensor

from metalens.field.points import Optics, Window, sampling, seen, stopped
from metalens.field.waves import PillarWave


def through(optics: Optics, at_um: Tensor, *, depths_um: Tensor, wavelength_um: float, window: Window) -> Tensor:
    """(points, depths) light through stop, lens and faces behind it, over that on the aperture as
    :func:`metalens.field.points.psfs` counts it: σ = Σ |S|² |T|² spread / Σ spread on the nodes.

    Of pillars |T|² is the mean of all of them: what single ones scatter is in it, whether it lands in a window or not.
    """
    grid, wave = sampling(optics, window, wavelength_um), optics.wave
    reduced, out = optics.layers.after(optics.distance_um, wavelength_um).reduced_um, []
    with torch.no_grad():
        for place in at_um:
            rays, pupil = seen(optics, place, grid, wavelength_um)
            tangents = place / reduced
            tilt = math.atan(math.hypot(*tangents.tolist()))
            light = (pupil.weight**2).expand(len(depths_um), -1, -1)
            if isinstance(wave, PillarWave):
                light = light * wave.transmittance(wavelength_um, tilt)
            elif (factor := wave.factor(rays.x_um, rays.y_um, wavelength_um, tilt)) is not None:
                light = light * factor.abs() ** 2
            given = torch.tensor(pupil.given, dtype=light.dtype, device=light.device)
            if optics.layers.stop is not None:
                shade, share = stopped(optics, tangents, rays, depths_um, wavelength_um)
                light, given = light * shade.abs() ** 2, given * share.flatten().to(light)
            out.append(light.sum((-1, -2)) / given)
    return torch.stack(out)
