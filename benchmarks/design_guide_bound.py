"""What blur alone can tell of a window's depth, over the field and the light: the blind
texture's Fisher information.

For a window of the reader, a patch of unknown 1/f texture whose contrast and fall are
unknown too, behind the PSF of
its own field angle and of the whole spectrum, with the photons' noise
(:mod:`benchmarks.rivals.blind_texture`). With
what is known of depths beforehand, no reader of such a patch errs by less than 1 / √(J
+ 1 / prior²). Real frames are
not such patches: they hold edges, and say what they show.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.rivals.blind_texture import Texture, blinder_information, relative_noise
from codesign.evaluate.reader import ReaderConfig
from codesign.network import blur
from codesign.optics import formed
from codesign.optics.stack import OpticsConfig
from metalens.field import Window
from metalens.field.plan import spectral
from metalens.image import Imager
from metalens.psf import Nodes

DEPTHS_MM = (14.0, 30.0)  # of the faces that the frames hold
COUNT, STEP_UM = 7, 200.0
PRIOR_MM = 3.0  # spread of the windows' depths in the frames
CONTRAST, ALBEDO, FOLDS = 0.2, 0.3, 3


def bound_mm(
    settings: OpticsConfig,
    place: Tensor,
    whole: Imager,
    config: ReaderConfig,
    share: tuple[float, float],
) -> float:
    """Least standard deviation of a window's depth, mean over the reader's windows and
    the depths.

    Args:
        whole: the image of the lens: its wavelengths and its windows of the PSFs are
            used.
        share: (y, x) of the field that the PSFs vary over.
    """
    with torch.no_grad():
        at, plan = centres_um(settings, config, share), whole.plan
        return spread_mm(told(settings, place, at, plan.waves, plan.window, config))


def told(
    settings: OpticsConfig,
    place: Tensor,
    at_um: Tensor,
    waves: Nodes,
    seen: Window,
    config: ReaderConfig,
    depths_mm: tuple[float, float] = DEPTHS_MM,
) -> Tensor:
    """(points, depths) information on the depth of windows about these points, per mm²;
    differentiable in ``place``.

    Args:
        at_um: (points, [x, y]) on the sensor. seen: of the PSFs, on the reader's
            pixels.
    """
    near, far = (1 / (1e3 * d) for d in depths_mm)
    depths = 1 / torch.linspace(far, near, COUNT, dtype=torch.float64).flip(0)
    fine = replace(seen, samples=FOLDS * seen.samples, step_um=config.pitch_um / FOLDS)
    noise = relative_noise(config.sensor, albedo=ALBEDO)
    texture = Texture(
        config.pitch_um, 2 * blur.step_of(config.pixels), CONTRAST, noise, folds=FOLDS
    )
    plane = formed.optics_of(settings, place)
    pair = (
        spectral(plane, at_um, depths + way * STEP_UM / 2, waves, fine)
        for way in (-1, 1)
    )
    return blinder_information(
        *pair, step_um=STEP_UM, sample_um=fine.step_um, texture=texture
    )


def spread_mm(information: Tensor) -> float:
    """Mean of 1 / √(J + 1 / prior²) of information per mm²."""
    return float(spreads_mm(information).mean())


def spreads_mm(information: Tensor) -> Tensor:
    """1 / √(J + 1 / prior²) of information per mm²."""
    return 1 / torch.sqrt(information.clamp_min(0) + PRIOR_MM**-2)


def centres_um(
    settings: OpticsConfig, config: ReaderConfig, share: tuple[float, float]
) -> Tensor:
    """(windows, [x, y]) middles of the reader's windows on the sensor, from the lens
    axis.
    """
    step = blur.step_of(config.pixels) * config.pitch_um
    along = (torch.arange(blur.GRID, dtype=torch.float64) - (blur.GRID - 1) / 2) * step
    y, x = torch.meshgrid(along * share[0], along * share[1], indexing="ij")
    middle = (
        settings.sensor_distance_mm * 1e3 * math.tan(math.radians(settings.angle_deg))
    )
    return torch.stack([x.flatten() + middle, y.flatten()], -1)
