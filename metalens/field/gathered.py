"""What gathering pillars over cells leaves out of a PSF: against the PSF of every pillar, to the same samples."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens import propagate
from metalens.field.patches import relative
from metalens.field.points import Optics, Window, psfs, sampling
from metalens.field.waves import PillarWave
from metalens.psf import psf_stack

JUDGE = 3e-4  # tolerance of the PSFs of every pillar
MOST = 256  # of their samples along an axis; the middle of a wider window is looked at, where the light is


def missing(optics: Optics, wavelength_um: float, window: Window, at: tuple[Tensor, Tensor]) -> float:
    """Relative L2 of the image of a 1/f texture through PSFs of sum 1 at (field points, depths), root mean square; 0 of
    a wave that is no lens of pillars. Light of other orders that falls into the window is in it."""
    wave = optics.wave
    if not isinstance(wave, PillarWave):
        return 0.0
    grid = sampling(optics, window, wavelength_um)
    # points of a sample, half of Nyquist's step apart: triangles of a sample are then summed to 2e-3 of fine detail
    finer = 2 * math.ceil(2 * grid.nodes * grid.step * window.step_um / wavelength_um)
    count = min(window.samples, max(MOST // finer - 2, 3) | 1)
    share, edge = _triangles(count, finer), (window.samples - count) // 2
    few = slice(edge, edge + count)
    errors = []
    with torch.no_grad():
        for place in at[0]:
            light = _of_pillars(optics, wave, wavelength_um, (place, at[1]), (window.step_um, count + 1, finer))
            want = share @ light @ share.T
            got = psfs(optics, place[None], depths_um=at[1], wavelength_um=wavelength_um, window=window)[0, :, few, few]
            errors.append(relative(got / got.sum((-1, -2), keepdim=True), want / want.sum((-1, -2), keepdim=True)))
    return float((torch.stack(errors) ** 2).mean().sqrt())


def _triangles(count: int, finer: int) -> Tensor:
    """(samples, points) share of the light at points of a window one sample wider: a square source over a square."""
    points = (np.arange((count + 1) * finer) - ((count + 1) * finer - 1) / 2) / finer
    away = np.abs(points - (np.arange(count) - (count - 1) / 2)[:, None])
    return torch.from_numpy(np.maximum(1 - away, 0))


def _of_pillars(
    optics: Optics, wave: PillarWave, wavelength_um: float, at: tuple[Tensor, Tensor], sampled: tuple[float, int, int]
) -> Tensor:
    """(depths, y, x) light of point sources, from every pillar; sampled: step of a sample, samples, points of each."""
    (place, depths_um), (step_um, count, finer) = at, sampled
    tangents = place.cpu() / optics.layers.after(optics.distance_um, wavelength_um).reduced_um
    angle = torch.atan(tangents).tolist()
    t = wave.answer(wavelength_um, math.atan(math.hypot(*tangents.tolist()))).cpu()
    about: dict[str, Any] = {
        "pitch_um": wave.lens.diameters.pitch_um,
        "wavelength_um": wavelength_um,
        "sensor_distance_um": optics.distance_um,
        "depths_um": depths_um.tolist(),
        "angle_rad": angle,
        "window_um": count * step_um,
        "samples": count * finer,
        "layers": optics.layers,
    }
    chief = propagate.case(tuple(t.shape), **about | {"layers": optics.layers.open}).centre_um
    offset = [float(a) - b for a, b in zip(place, chief, strict=True)]
    made = psf_stack(torch.angle(t), t.abs(), **about, offset_um=offset, integrate=False, tolerance=JUDGE)
    return torch.as_tensor(made.intensity).double()
