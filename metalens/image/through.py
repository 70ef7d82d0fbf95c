"""Light of a field point that goes through a lens, wherever it then lands: what the
light in a window is a share of.
"""

import math

import torch
from torch import Tensor

from metalens.image.points import Optics, Window, node_rays, sampling
from metalens.image.rays import Rays
from metalens.image.waves import PillarWave


def aperture_transmission(
    optics: Optics,
    at_um: Tensor,
    *,
    depths_um: Tensor,
    wavelength_um: float,
    window: Window,
) -> Tensor:
    """(points, depths) light through stop, lens and faces behind it, over that on the
    aperture as
    :func:`metalens.image.points.psfs` counts it: σ = Σ S |T|² spread / Σ spread on the
    nodes, S 1 for rays that pass
    the stop.

    Of pillars |T|² is the mean of all of them: what single ones scatter is in it,
    whether it lands in a window or not.

    Args:
        optics: lens, light and distances at the nodes.
        at_um: (points, 2) field points on the sensor, um.
        depths_um: source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
    """
    grid, wave = sampling(optics, window, wavelength_um), optics.wave
    reduced, out = optics.layers.after(optics.distance_um, wavelength_um).reduced_um, []
    with torch.no_grad():
        for place in at_um:
            rays, pupil = node_rays(optics, place, grid, wavelength_um)
            tangents = place / reduced
            tilt = math.atan(math.hypot(*tangents.tolist()))
            light = (pupil.weight * rays.passed * rays.width_um / grid.step).expand(
                len(depths_um), -1, -1
            )
            if isinstance(wave, PillarWave):
                light = light * wave.transmittance(wavelength_um, tilt)
            elif (
                factor := wave.factor(rays.x_um, rays.y_um, wavelength_um, tilt)
            ) is not None:
                light = light * factor.abs() ** 2
            out.append(
                (light * _passed(optics, tangents, rays, depths_um, wavelength_um)).sum(
                    (-1, -2)
                )
                / pupil.given
            )
    return torch.stack(out)


def _passed(
    optics: Optics,
    tangents: Tensor,
    found: Rays,
    depths_um: Tensor,
    wavelength_um: float,
) -> Tensor | float:
    """(depths, nodes, nodes) of rays that pass the stop, over its light's share of the
    whole lens on the axis; 1
    without one. Of rays, since what a node's mean of the edge's waves lacks goes
    through all the same."""
    layers, radius = optics.layers, optics.wave.radius_um
    if layers.stop is None:
        return 1.0
    x, y, width = (part.cpu() for part in (found.x_um, found.y_um, found.width_um))
    slopes, each = (float(tangents[0]), float(tangents[1])), []
    for depth in depths_um.tolist():
        share = (layers.footprint_um(depth, wavelength_um) / radius) ** 2
        each.append(
            layers.stop_share(slopes, depth, wavelength_um, (x, y), width) / share
        )
    return torch.stack(each).to(found.x_um.device)
