"""What PSFs of the field leave out: by the transform, by components of the field, by
pillars taken together.

Errors are of the image: those of PSFs count by their light, so that places in the
shadow of a stop count little.
"""

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens import propagate
from metalens.image.points import Optics, Window, psfs, sampling
from metalens.image.texture import texture_error, weigh_by_light
from metalens.image.waves import PillarPlane
from metalens.psf import Polarisation, SpectralNodes, blur_um, psf_stack


@dataclass(frozen=True, eq=False)
class JudgedPsfs:
    """PSFs by which errors are judged: of the first wavelength, at (field points,
    depths).
    """

    optics: Optics
    waves: SpectralNodes
    window: Window
    at: tuple[Tensor, Tensor]

    @functools.cached_property
    def shown(self) -> Tensor:
        """(field points, depths, h, w) as the window shows them, with their light;
        computed once.
        """
        return self.compute_psfs()

    def compute_psfs(
        self, *, shift_um: tuple[float, float] = (0.0, 0.0), **other: Any
    ) -> Tensor:
        """The same PSFs through a window with other settings."""
        about: dict[str, Any] = {
            "wavelength_um": float(self.waves.wavelengths_um[0]),
            "shift_um": shift_um,
        }
        with torch.no_grad():
            return psfs(
                self.optics,
                self.at[0],
                depths_um=self.at[1],
                window=replace(self.window, **other),
                **about,
            )


def transform_error(judged: JudgedPsfs) -> float:
    """Error of the second-order transform: PSFs with rays recomputed at their own width
    from the field point, against themselves.

    Args:
        judged: PSFs by which the error is judged.
    """
    shown, step_um = judged.shown, judged.window.step_um
    light = shown.sum((-1, -2))
    # root mean square distance of the light of a disc of this blur
    wide = float(blur_um(shown.cpu().numpy(), step_um).mean()) / math.sqrt(2)
    moved = judged.compute_psfs(shift_um=(wide * 0.6, wide * 0.8))
    return weigh_by_light(texture_error(moved, shown), light)


def folding_error(judged: JudgedPsfs) -> float:
    """What the transform folds back from beyond the period of the nodes: PSFs, with
    their light, against those of twice
    the period.

    Args:
        judged: PSFs by which the error is judged.
    """
    want = judged.compute_psfs(period=2 * judged.window.period)
    return weigh_by_light(texture_error(judged.shown, want), want.sum((-1, -2)))


def choose_polarisation(
    judged: JudgedPsfs, polarisation: Polarisation, *, within: tuple[float, float]
) -> Window:
    """The window with one scalar where that images within the first tolerance
    (``auto``), else with as few components
    of the fields of both polarisations as image within the second.

    Args:
        judged: PSFs by which the error is judged.
    """
    judged = replace(
        judged, window=replace(judged.window, flux=polarisation != "vector")
    )
    window = judged.window
    if polarisation == "scalar" or (
        polarisation == "auto" and polarisation_error(judged) <= within[0]
    ):
        return window
    whole = judged.compute_psfs(components=window.whole)
    tried = (replace(window, components=count) for count in range(1, window.whole + 1))
    return next(
        one
        for one in tried
        if polarisation_error(replace(judged, window=one), whole) <= within[1]
    )


def polarisation_error(judged: JudgedPsfs, whole: Tensor | None = None) -> float:
    """What the components of the field that a window leaves out change: PSFs of sum 1
    against those of all components
    (``whole``, where they are known).

    Args:
        judged: PSFs by which the error is judged.
    """
    window = judged.window
    if window.components == window.whole:
        return 0.0
    whole = judged.compute_psfs(components=window.whole) if whole is None else whole
    few, light = judged.shown, whole.sum((-1, -2))
    return weigh_by_light(
        texture_error(
            few / few.sum((-1, -2), keepdim=True), whole / light[..., None, None]
        ),
        light,
    )


def gathering_error(
    optics: Optics, wavelength_um: float, window: Window, at: tuple[Tensor, Tensor]
) -> float:
    """What gathering pillars over cells changes: PSFs of sum 1 at (field points,
    depths) against those of every pillar,
    to the same samples; 0 of a wave that is no lens of pillars. Light of other orders
    in the window is in it.

    Args:
        optics: lens, light and distances at the nodes.
        wavelength_um: vacuum wavelength, um.
    """
    wave = optics.wave
    if not isinstance(wave, PillarPlane):
        return 0.0
    grid = sampling(optics, window, wavelength_um)
    # points of a sample, half of Nyquist's step apart: triangles of a sample are then
    # summed to 2e-3 of fine detail. At
    # Nyquist's step it is 5e-3 too much; what scatters to the rim of a window is more,
    # so that no window is cut for it.
    finer = math.ceil(2 * grid.nodes * grid.step * window.step_um / wavelength_um)
    most = 256  # along an axis; of a wider window the middle is looked at
    finer *= 2 if (window.samples + 2) * 2 * finer <= most else 1
    count = min(window.samples, max(most // finer - 2, 3) | 1)
    share = _triangles(count, finer)
    edge = (window.samples - count) // 2
    few = slice(edge, edge + count)
    errors, lights = [], []
    with torch.no_grad():
        for place in at[0]:
            light = _of_pillars(
                optics,
                wave,
                wavelength_um,
                (place, at[1]),
                (window.step_um, count + 1, finer),
            )
            want = share @ light @ share.T
            got = psfs(
                optics,
                place[None],
                depths_um=at[1],
                wavelength_um=wavelength_um,
                window=window,
            )[0, :, few, few]
            errors.append(
                texture_error(
                    got / got.sum((-1, -2), keepdim=True),
                    want / want.sum((-1, -2), keepdim=True),
                )
            )
            lights.append(got.sum((-1, -2)))
    return weigh_by_light(torch.stack(errors), torch.stack(lights))


def _triangles(count: int, finer: int) -> Tensor:
    """(samples, points) share of the light at points of a window one sample wider: a
    square source over a square.
    """
    points = (np.arange((count + 1) * finer) - ((count + 1) * finer - 1) / 2) / finer
    away = np.abs(points - (np.arange(count) - (count - 1) / 2)[:, None])
    return torch.from_numpy(np.maximum(1 - away, 0))


def _of_pillars(
    optics: Optics,
    wave: PillarPlane,
    wavelength_um: float,
    at: tuple[Tensor, Tensor],
    sampled: tuple[float, int, int],
) -> Tensor:
    """(depths, y, x) light of point sources, from every pillar; sampled: step of a
    sample, samples, points of each.
    """
    (place, depths_um), (step_um, count, finer) = at, sampled
    tangents = (
        place.cpu() / optics.layers.after(optics.distance_um, wavelength_um).reduced_um
    )
    angle = torch.atan(tangents).tolist()
    t = wave.pillar_transmission(
        wavelength_um, math.atan(math.hypot(*tangents.tolist()))
    ).cpu()
    about: dict[str, Any] = {
        "pitch_um": wave.pitch_um,
        "wavelength_um": wavelength_um,
        "sensor_distance_um": optics.distance_um,
        "depths_um": depths_um.tolist(),
        "angle_rad": angle,
        "window_um": count * step_um,
        "samples": count * finer,
        "layers": optics.layers,
    }
    chief = propagate.make_case(
        tuple(t.shape), **about | {"layers": optics.layers.open}
    ).centre_um
    offset = [float(a) - b for a, b in zip(place, chief, strict=True)]
    made = psf_stack(
        torch.angle(t), t.abs(), **about, offset_um=offset, integrate=False
    )
    return torch.as_tensor(made.intensity).double()
