"""The guide's lenses behind an aperture stop on the other face of their substrate, and
the asphere for such a stop.

The stop is as wide as the other lenses, so the light is the same; the pillars reach as
far as its light does in the
corner of the widest field. Each field angle then has its own part of the radial phase.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from codesign.optics.stack import OpticsConfig, phase_at
from metalens.cell import Film
from metalens.design import profiles
from metalens.ground.arrays import Array
from metalens.lens import Layers, Stop

THICK_UM, RADIUS_UM = 500.0, 500.0  # of the substrate, fused silica, and of the stop
APERTURE_MM = (
    1.42  # of the pillars: 1 mm, and twice 500 um tan(asin(sin 33° / 1.45)) = 0.20 mm
)
RINGS, PLACES = 12, 61  # field angles, and places along the pillars


def behind_stop(settings: OpticsConfig) -> OpticsConfig:
    """The same lens on a substrate with a stop."""
    layers = Layers(front=(Film("SiO2", THICK_UM),), stop=Stop(RADIUS_UM, THICK_UM))
    return replace(settings, aperture_mm=APERTURE_MM, layers=layers)


def asphere(settings: OpticsConfig, widest_rad: float) -> Tensor:
    """(polynomials,) of the radial phase of least wave-front variance, mean over field
    angles of even solid angle.

    By least squares over what the stop lights of each angle; its piston and tilt
    (distortion) are free.
    """
    unit = np.linspace(-1, 1, PLACES) * settings.aperture_mm * 500
    x, y = (
        g[np.hypot(*np.meshgrid(unit, unit)) <= unit[-1]]
        for g in np.meshgrid(unit, unit)
    )
    focus, count = settings.focus, settings.polynomials
    modes = np.stack(
        [_added(settings, one, x, y) for one in torch.eye(count, dtype=torch.float64)],
        1,
    )
    left: list[Array] = []
    wanted: list[Array] = []
    for share in (np.arange(RINGS) + 0.5) / RINGS:
        tangent = math.tan(widest_rad) * math.sqrt(share)
        lit = (
            focus.layers.lit(
                (tangent, 0.0),
                focus.source_distance_um,
                focus.wavelength_um,
                (x, y),
                1e-3,
            )
            > 0
        )
        path = sum(focus.paths_from(x[lit], y[lit], tangent))
        phase = (
            profiles.hyperbolic(x[lit], y[lit], focus)
            + 2 * np.pi / focus.wavelength_um * path
        )
        free = np.linalg.qr(np.stack([np.ones(lit.sum()), x[lit], y[lit]], 1))[0]
        for table, part in ((left, modes[lit]), (wanted, -phase[:, None])):
            table.append((part - free @ (free.T @ part)) / math.sqrt(lit.sum()))
    found = np.linalg.lstsq(
        np.concatenate(left), np.concatenate(wanted)[:, 0], rcond=None
    )[0]
    return torch.from_numpy(found)


def _added(
    settings: OpticsConfig, coefficients_rad: Tensor, x: Array, y: Array
) -> Array:
    places = torch.from_numpy(x)[None], torch.from_numpy(y)[None]
    return np.asarray(phase_at(settings, coefficients_rad, *places)[0])
