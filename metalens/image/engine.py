"""From a lens to an imager: field points, PSFs, patches, and the error that it says."""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.image import model_error
from metalens.image.forming import Imager, build_imager
from metalens.image.low_rank import frame_maps, plane_images
from metalens.image.plan import Grid, ImagingPlan, plan_nodes, sum_over_spectrum
from metalens.image.points import Optics, pupil_sampling
from metalens.image.scene import Frames
from metalens.image.stray import stray_of
from metalens.image.texture import CONTRAST, scene_error
from metalens.image.waves import SmoothWave, Wave, wave_of
from metalens.lens import Lens
from metalens.optics import Layers
from metalens.psf import Polarisation, Source, SpectralNodes, blur_um
from metalens.psf import spectrum as spectra


def imager(
    lens: Lens | Wave,
    scene_grid: Grid,
    *,
    spectrum: Source | spectra.MeasuredSpectrum | SpectralNodes | None = None,
    layers: Layers | None = None,
    field: tuple[float, float] = (0.0, 0.0),
    tolerance: float = 1e-2,
    distance_um: float | None = None,
    polarisation: Polarisation = "auto",
    device: torch.device | str = "cpu",
) -> Imager:
    """Imager of a lens: its PSFs over the field, depth and spectrum as kernels.

    PSFs are computed at nodes of the field and of 1/z and expanded in low-rank kernels.
    Behind a stop that dims the image, the tolerance is lowered by that factor, at most
    8, where enough nodes are allowed.

    Args:
        lens: a lens file's content, or a wave (:class:`SmoothWave`,
            :class:`PillarWave`).
        scene_grid: samples, step, depths and margin of the image.
        spectrum: a diode, curves as measured
            (:func:`metalens.psf.spectrum.read_measured_spectrum`),
            wavelengths with weights, or
            None for the design wavelength alone.
        layers: films around the lens; by default those of the lens file with the cover
            of its cell (none for a wave).
        field: (x, y) angle in rad of the middle of the grid.
        tolerance: relative L2 error of the image of a scene of mean 1 with a 1/f
            texture of standard deviation 0.3.
        distance_um: lens to sensor, by default the design's.
        polarisation: ``flux`` (of unpolarised light through the sensor's plane, which a
            pixel counts), ``scalar``,
            ``auto``: one scalar where its error, ``parts["polarisation"]``, is below
            the tolerance, else the flux, or
            ``vector``: |Ex|² + |Ey|² + |Ez|², as a thin absorbing film on the sensor's
            plane detects.
        device: where PSFs and kernels are computed and frames will be; a few PSFs are
            judged on the processor.

    Raises:
        SceneError: a field that is not within 90 degrees, a polarisation that is none,
            wavelengths, depths or field
            points that no number of meets the tolerance; PropagationError: films
            thicker than the gap, or a spectrum of
            which a wavelength that stands for it lies beyond the library of the
            pillars.

    Accuracy: ``error`` of the result, by cause in ``parts``; what no setting lowers may
    leave it above the
        tolerance (``edge``: light that the rim of a small aperture diffracts beyond the window).
    """
    if not all(abs(angle) < math.pi / 2 for angle in field):
        raise SceneError(
            f"field of {field} rad, need angles (x, y) of the middle of the grid within ±pi/2"
        )
    if polarisation not in get_args(Polarisation):
        raise SceneError(
            f"polarisation = {polarisation!r}: need one of {', '.join(get_args(Polarisation))}"
        )
    if layers is None:
        layers = lens.layers if isinstance(lens, Lens) else Layers()
    wave = wave_of(lens, layers, scene_grid.window * scene_grid.step_um, distance_um)
    focus = wave.focus  # type: ignore[attr-defined]
    if distance_um is None:
        distance_um = focus.sensor_distance_um
    optics = Optics(wave, layers, distance_um)
    source = spectrum or SpectralNodes(np.array([focus.wavelength_um]), np.ones(1), 0.0)
    reduced_um = layers.after(distance_um, focus.wavelength_um).reduced_um
    middle_um = reduced_um * math.tan(field[0]), reduced_um * math.tan(field[1])

    def build(within: float) -> Imager:
        plan = plan_nodes(
            optics,
            scene_grid,
            source,
            middle_um,
            tolerance=within,
            polarisation=polarisation,
        )
        stack, energy = node_psfs(optics, plan, device)
        with torch.no_grad():
            return build_imager(scene_grid, plan, stack, energy, tolerance=within)

    prepared = build(tolerance)
    if layers.stop is not None and (dimmer := image_dimming(prepared)) > 1:
        # an image in the shadow of the stop is prepared to its own light, where enough
        # nodes for that are allowed
        with contextlib.suppress(SceneError):
            prepared = build(tolerance / min(dimmer, 8))
    with torch.no_grad():
        parts = _error_parts(optics, prepared)
    depth_um = float(1 / (1 / prepared.plan.depths_um).mean())
    stray = stray_of(optics, scene_grid, depth_um, middle_um)
    if stray is not None:
        stray = stray.to(device)
    return replace(prepared, parts=parts, stray=stray)


def node_psfs(
    optics: Optics, plan: ImagingPlan, device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor]:
    """PSFs of all nodes, each of sum 1, and their relative illumination.

    Both are differentiable in the wave's factor. A round lens on the axis is computed
    on one quarter of the nodes.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        plan: field nodes, depths and wavelengths.
        device: where they are computed.

    Returns:
        ((rows, columns, depths, h, w) PSFs, (rows, columns, depths) illumination).
    """
    count = len(plan.y_um), len(plan.x_um)
    wave, stop = optics.wave, optics.layers.stop
    folds = (
        isinstance(wave, SmoothWave)
        and wave.added_rad is None
        and (stop is None or stop.centred)
        and bool((plan.places_um.sum(0).abs() < 1e-6).all())
    )
    computed = [(n + 1) // 2 for n in count] if folds else count
    at = plan.places_um.reshape(*count, 2)[: computed[0], : computed[1]]
    light = sum_over_spectrum(
        optics, at.reshape(-1, 2).to(device), plan.depths_um, plan.waves, plan.window
    )
    light = light.reshape(*computed, *light.shape[1:])
    if folds:
        light = _mirror_quarter(light, count)
    return normalise_psfs(light, optics, plan)


def normalise_psfs(
    light: Tensor, optics: Optics, plan: ImagingPlan
) -> tuple[Tensor, Tensor]:
    """PSFs of sum 1, and relative illumination: light in the window times cos⁴ θ.

    Args:
        light: (rows, columns, depths, h, w) share of the light on each sample.
        optics: wave of the lens, layers and lens-sensor distance.
        plan: field nodes, depths and wavelengths.
    """
    total = light.sum((-2, -1))
    wave = float(plan.waves.wavelengths_um.mean())
    cosine4 = _cosine4(optics, plan.places_um, plan.depths_um, wave)
    illumination = total * cosine4.reshape(total.shape).to(total)
    return light / total[..., None, None], illumination


def _cosine4(
    optics: Optics, at_um: Tensor, depths_um: Tensor, wavelength_um: float
) -> Tensor:
    """(…, depths) cos⁴ θ = 1 / (1 + tan² θ)² of the field angles of field points.

    θ is the angle at the middle of the stop, or of the lens without a stop.

    Args:
        at_um: (…, [x, y]) field points on the sensor, um.
        depths_um: (depths,) source depths, um.
    """
    after = optics.layers.after(optics.distance_um, wavelength_um)
    tangents = at_um.numpy() / after.reduced_um
    rays = [
        optics.layers.through_middle(tangents, depth, wavelength_um)
        for depth in depths_um.tolist()
    ]
    return torch.from_numpy(1 / (1 + (np.stack(rays, -2) ** 2).sum(-1)) ** 2)


def _mirror_quarter(quarter: Tensor, count: Sequence[int]) -> Tensor:
    """(rows, columns, depths, h, w) PSFs of a round lens from those of one quarter.

    Args:
        quarter: of the nodes with y and x up to the axis.
        count: (rows, columns) of all nodes.
    """
    out = quarter
    for axis, total in enumerate(count):
        mirrored = out.narrow(axis, 0, total // 2).flip(axis, axis - 2)
        out = torch.cat([out, mirrored], axis)
    return out


def textured_frames(grid: Grid) -> Frames:
    """One test frame of two sheets with a 1/f texture of mean 1 and deviation 0.3.

    The near sheet covers part of the far one with a soft border. Depths vary linearly
    in 1/z over each sheet, within the grid's range. The random texture is always the
    same.

    Args:
        grid: samples, depths and margin of the image.
    """
    y, x = (n + 2 * grid.margin for n in grid.samples)
    draw = torch.Generator().manual_seed(11)
    fy, fx = torch.fft.fftfreq(y)[:, None], torch.fft.rfftfreq(x)
    frequency = torch.sqrt(fy**2 + fx**2 + (0.5 / max(x, y)) ** 2)
    white = torch.fft.rfft2(torch.randn(2, y, x, generator=draw))
    rough = torch.fft.irfft2(white / frequency, s=(y, x))
    texture = (1 + CONTRAST * (rough - rough.mean()) / rough.std()).clamp_min(0)
    sides = torch.linspace(-1, 1, y), torch.linspace(-1, 1, x)
    down, across = torch.meshgrid(*sides, indexing="ij")
    near = torch.sigmoid((0.2 * across - down - 0.25) * y / 4)
    cover = torch.stack([near, 1 - near])
    low, high = (1 / d for d in grid.depths_um)
    share = torch.stack([0.2 + 0.2 * across, 0.6 + 0.35 * down])
    depth_um = 1 / (low + (high - low) * share)
    return Frames((cover * texture)[None], cover[None], depth_um[None])


def _error_parts(
    optics: Optics, prepared: Imager, *, samples: int = 16, few: int = 5
) -> dict[str, float]:
    """Relative L2 errors of an imager by cause, at places and depths between its nodes.

    PSFs of random samples and four depths are computed directly and compared. Errors
    relative to the light of a place are scaled by :func:`image_dimming`, as an image
    can be dimmer than the whole frame.

    Args:
        samples: of the frame at which PSFs are compared.
        few: of them, at which the transform and the field's components are judged.

    Returns:
        dict: error by name; see ``parts`` of :class:`Imager`.
    """
    plan = prepared.plan
    draw = np.random.default_rng(7)
    pixels = np.floor(draw.random((samples, 2)) * prepared.grid.frame).astype(int)
    rows, columns = (
        np.linspace(float(nodes[0]), float(nodes[-1]), n)
        for n, nodes in zip(prepared.grid.frame, (plan.y_um, plan.x_um), strict=True)
    )
    at = torch.from_numpy(np.stack([columns[pixels[:, 1]], rows[pixels[:, 0]]], -1))
    nearest, farthest = 1 / plan.depths_um[[0, -1]]
    unit = torch.tensor([0, 0.13, 0.58, 1]).double()
    depths = 1 / (nearest + (farthest - nearest) * unit)
    true = sum_over_spectrum(optics, at, depths, plan.waves, plan.window).detach()
    mean_wave = float(plan.waves.wavelengths_um.mean())
    cosine4 = _cosine4(optics, at, depths, mean_wave)[..., None, None]
    used = psfs_used(prepared, torch.from_numpy(pixels), depths).cpu()
    dimmer = image_dimming(prepared)
    light = true.sum((-1, -2))
    inner = at[:few], depths[1:-1]
    # of the brightest of few places in the image
    share = float(light[:few].max() / (light**2).mean().sqrt()) * dimmer
    judged = model_error.JudgedPsfs(optics, plan.waves, plan.window, inner)
    wave = float(plan.waves.wavelengths_um[0])
    pillars = optics, wave, plan.window, (at[:2], depths[1:-1])
    parts = {
        "psfs": scene_error(used, (true * cosine4).to(used)) * dimmer,
        "planes": prepared.light.plane_error,
        "spectrum": max(plan.waves.error, 0.0),
        "transform": model_error.transform_error(judged) * share,
        "folded": model_error.folding_error(judged) * share,
        "polarisation": model_error.polarisation_error(judged) * share,
        "pillars": model_error.gathering_error(*pillars) * dimmer,
        "edge": pupil_sampling(optics, plan.window, wave).beyond / 2,
    }
    if optics.layers.stop is not None:
        judged_psfs = true[:few, 1:-1], light[:few, 1:-1], light.amax(0)[1:-1]
        shadow = _shadow_error(optics, wave, inner, judged_psfs, plan.window.step_um)
        parts["stop"] = shadow * dimmer
    return parts


def image_dimming(prepared: Imager) -> float:
    """RMS light of the whole frame over that of the image within it, 1 at least.

    Both are of a uniformly illuminated plane at the middle depth. The ratio exceeds 1
    where the image lies in the shadow of a stop and its margins do not.

    Args:
        prepared: imager with its nodes.
    """
    middle = len(prepared.plan.depths_um) // 2
    light = prepared.field.light[:, :, middle : middle + 1]
    maps = frame_maps(prepared.grid.frame, light.shape[:2], light)
    plane = plane_images(light, maps)[0]
    whole, image = (
        float(part.square().mean().sqrt())
        for part in (plane, prepared.grid.crop(plane))
    )
    return max(whole / max(image, 1e-12 * whole), 1.0)


def _shadow_error(
    optics: Optics,
    wavelength_um: float,
    places: tuple[Tensor, Tensor],
    judged: tuple[Tensor, ...],
    step_um: float,
) -> float:
    """Relative error of the stop's shadow, the worst of some places and depths.

    Each error counts by the light of its place over that of the brightest place.

    Args:
        places: (n, [x, y]) field points in um, and (depths,) in um.
        judged: PSFs (n, depths, h, w), the share of the light on the aperture that each
            contains, and that share of the brightest place of each depth.
    """
    at, depths_um = places
    psfs, contained, brightest = (part.cpu().numpy() for part in judged)
    reduced = optics.layers.after(optics.distance_um, wavelength_um).reduced_um
    share = contained.clip(1e-6, 1)
    unit = psfs / contained.clip(1e-6)[..., None, None]
    rads = blur_um(unit, step_um, share) / reduced
    worst = 0.0
    for (i, k), light in np.ndenumerate(contained / brightest):
        x, y = (at[i] / reduced).tolist()
        error = optics.layers.shadow_error(
            (x, y),
            float(depths_um[k]),
            wavelength_um,
            float(rads[i, k]) / math.hypot(1, x, y),
            float(share[i, k]),
        )
        worst = max(worst, error * float(light))
    return worst


def psfs_used(optics: Imager, pixels: Tensor, depths_um: Tensor) -> Tensor:
    """(n, depths, h, w) PSFs times illumination, as the imager's kernels have them.

    Args:
        optics: imager with its kernels.
        pixels: (n, [row, column]) samples of the frame.
        depths_um: source depths from the lens, um.
    """
    high, wide = optics.grid.frame
    index = (pixels[:, 0] * wide + pixels[:, 1]).to(optics.stack.device)
    out = []
    for depth in depths_um.tolist():
        depth_map = torch.full((high, wide), depth).to(optics.stack)
        weights = optics.light.interpolate(depth_map)[:, index]
        out.append(torch.einsum("rn,rhw->nhw", weights, optics.light.kernels))
    return torch.stack(out, 1)
