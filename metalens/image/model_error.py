"""Model errors of the field's PSFs: transform, field components, averaged pillars.

PSFs count by their light, so that places in the shadow of a stop count little.
"""

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens.image.points import Optics, Window, psfs, pupil_sampling
from metalens.image.texture import texture_error, weigh_by_light
from metalens.image.waves import PillarWave
from metalens.optics import media
from metalens.psf import Polarisation, SpectralNodes, blur_um, psf_stack


@dataclass(frozen=True, eq=False)
class JudgedPsfs:
    """PSFs by which errors are judged, of the first wavelength.

    at: (field points, [x, y]) in um, and (depths,) in um.
    """

    optics: Optics
    waves: SpectralNodes
    window: Window
    at: tuple[Tensor, Tensor]

    @functools.cached_property
    def window_psfs(self) -> Tensor:
        """(field points, depths, h, w) PSFs of the window, with their light; cached."""
        return self.compute_psfs()

    def compute_psfs(
        self, *, shift_um: tuple[float, float] = (0.0, 0.0), **other: Any
    ) -> Tensor:
        """(field points, depths, h, w) PSFs with changed settings of the window.

        Args:
            shift_um: (x, y) added to where the window's rays are traced.
            other: fields of :class:`Window` to replace.
        """
        with torch.no_grad():
            return psfs(
                self.optics,
                self.at[0],
                depths_um=self.at[1],
                wavelength_um=float(self.waves.wavelengths_um[0]),
                window=replace(self.window, **other),
                shift_um=shift_um,
            )


def transform_error(judged: JudgedPsfs) -> float:
    """Relative error of the second-order transform of rays over the window.

    PSFs with rays traced to a place off the field point, by the root mean square radius
    of the PSF, are compared with the PSFs themselves.

    Args:
        judged: PSFs by which the error is judged.
    """
    psf = judged.window_psfs
    step_um = judged.window.step_um
    light = psf.sum((-1, -2))
    # root mean square distance of the light of a disc of this blur
    rms_radius = float(blur_um(psf.cpu().numpy(), step_um).mean()) / math.sqrt(2)
    moved = judged.compute_psfs(shift_um=(rms_radius * 0.6, rms_radius * 0.8))
    return weigh_by_light(texture_error(moved, psf), light)


def folding_error(judged: JudgedPsfs) -> float:
    """Relative error of light aliased from beyond the period of the nodes.

    PSFs, with their light, are compared with those of twice the period.

    Args:
        judged: PSFs by which the error is judged.
    """
    reference = judged.compute_psfs(period=2 * judged.window.period)
    return weigh_by_light(
        texture_error(judged.window_psfs, reference), reference.sum((-1, -2))
    )


def choose_polarisation(
    judged: JudgedPsfs, polarisation: Polarisation, *, within: tuple[float, float]
) -> Window:
    """The window with the fewest field components that image within the tolerance.

    ``auto`` is one scalar where its error is within the first tolerance. Else the
    components of both polarisations are added until the error is within the second.

    Args:
        judged: PSFs by which the error is judged.
        polarisation: ``"auto"``, ``"scalar"``, ``"flux"`` or ``"vector"``.
        within: relative errors of a scalar, and of the components left out.
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
    windows = (
        replace(window, components=count) for count in range(1, window.whole + 1)
    )
    return next(
        fewer
        for fewer in windows
        if polarisation_error(replace(judged, window=fewer), whole) <= within[1]
    )


def polarisation_error(judged: JudgedPsfs, whole: Tensor | None = None) -> float:
    """Relative error of the field components that a window leaves out.

    PSFs of sum 1 are compared with those of all components.

    Args:
        judged: PSFs by which the error is judged.
        whole: PSFs of all components; None to compute them.
    """
    window = judged.window
    if window.components == window.whole:
        return 0.0
    if whole is None:
        whole = judged.compute_psfs(components=window.whole)
    few = judged.window_psfs
    light = whole.sum((-1, -2))
    errors = texture_error(
        few / few.sum((-1, -2), keepdim=True), whole / light[..., None, None]
    )
    return weigh_by_light(errors, light)


def gathering_error(
    optics: Optics, wavelength_um: float, window: Window, at: tuple[Tensor, Tensor]
) -> float:
    """Relative error of averaging pillars over cells; 0 of a wave without pillars.

    PSFs of sum 1 are compared with those of every pillar (:func:`psf_stack`), on the
    same samples.
    The error includes light of other orders in the window.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        wavelength_um: vacuum wavelength, um.
        window: samples of the PSFs; of a wide window its middle is compared.
        at: (field points, [x, y]) in um, and (depths,) in um.
    """
    wave = optics.wave
    if not isinstance(wave, PillarWave):
        return 0.0
    grid = pupil_sampling(optics, window, wavelength_um)
    # points at half of Nyquist's step sum a triangle to 2e-3 of fine detail, where a
    # window of them fits; at Nyquist's step to 5e-3
    nyquist = math.ceil(2 * grid.nodes * grid.step * window.step_um / wavelength_um)
    most = 256  # points along an axis
    per_sample = nyquist * (1 + ((window.samples + 2) * 2 * nyquist <= most))
    count = min(window.samples, max(most // per_sample - 2, 3) | 1)
    weights = _triangles(count, per_sample)
    edge = (window.samples - count) // 2
    middle = slice(edge, edge + count)
    sampled = window.step_um, count + 1, per_sample
    with torch.no_grad():
        light = [
            _of_pillars(optics, wave, wavelength_um, (place, at[1]), sampled)
            for place in at[0]
        ]
        psf = psfs(
            optics, at[0], depths_um=at[1], wavelength_um=wavelength_um, window=window
        )[..., middle, middle]
    reference = weights @ torch.stack(light) @ weights.T
    units = [part / part.sum((-1, -2), keepdim=True) for part in (psf, reference)]
    return weigh_by_light(texture_error(*units), psf.sum((-1, -2)))


def _triangles(count: int, per_sample: int) -> Tensor:
    """(samples, points) weights that average points over each sample: a unit triangle.

    It is the convolution of the source's square with that of the sample.

    Args:
        count: samples; the points cover one more.
        per_sample: points per sample.
    """
    points = (
        np.arange((count + 1) * per_sample) - ((count + 1) * per_sample - 1) / 2
    ) / per_sample
    distance = np.abs(points - (np.arange(count) - (count - 1) / 2)[:, None])
    return torch.from_numpy(np.maximum(1 - distance, 0))


def _of_pillars(
    optics: Optics,
    wave: PillarWave,
    wavelength_um: float,
    at: tuple[Tensor, Tensor],
    sampled: tuple[float, int, int],
) -> Tensor:
    """(depths, y, x) PSFs of point sources from every pillar, float64.

    The window is centred on the field point.

    Args:
        at: (x, y) field point in um, and (depths,) in um.
        sampled: step of a sample in um, number of samples, points per sample.
    """
    place, depths_um = at
    step_um, count, per_sample = sampled
    after = optics.layers.after(optics.distance_um, wavelength_um)
    tangents = place.cpu() / after.reduced_um
    slope = math.hypot(*tangents.tolist())
    # the chief ray through films lands off its paraxial place
    reach = media.reach_per_direction(after.layers, slope**2 / (1 + slope**2))
    landing = tangents * reach / math.hypot(1, slope)
    t = wave.pillar_transmission(wavelength_um, math.atan(slope)).cpu()
    stack = psf_stack(
        torch.angle(t),
        t.abs(),
        pitch_um=wave.pitch_um,
        wavelength_um=wavelength_um,
        sensor_distance_um=optics.distance_um,
        depths_um=depths_um.tolist(),
        angle_rad=torch.atan(tangents).tolist(),
        window_um=count * step_um,
        samples=count * per_sample,
        layers=optics.layers,
        offset_um=(place.cpu() - landing).tolist(),
        integrate=False,
    )
    return torch.as_tensor(stack.intensity).double()
