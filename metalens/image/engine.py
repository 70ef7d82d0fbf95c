"""From a lens to an imager: field points, PSFs, patches, and the error that it says."""

import contextlib
import math
from dataclasses import replace
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.image import left_out
from metalens.image.forming import Imager, build_imager
from metalens.image.low_rank import frame_maps, plane_images
from metalens.image.plan import Grid, Plan, plan_nodes, sum_over_spectrum
from metalens.image.points import Optics, sampling
from metalens.image.scene import Frames
from metalens.image.splines import spline_matrix
from metalens.image.stray import stray_of
from metalens.image.texture import CONTRAST, scene_error
from metalens.image.waves import SmoothWave, Wave, wave_of
from metalens.lens import Lens
from metalens.optics import Layers
from metalens.psf import Polarisation, Source, SpectralNodes, blur_um
from metalens.psf import spectrum as spectra

# pixels of the frame at which the PSFs that are used are compared with true ones
HELD_OUT = 16
FEW = 5  # of them at which the transform and the components of the field are judged


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
    """Prepare a lens for frames of a grid.

    Args:
        scene_grid: samples, step, depths and margin of the image.
        lens: a lens file's content, or a wave (:class:`SmoothWave`,
            :class:`PillarWave`).
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
            ``vector``: |Ex|² + |Ey|² + |Ez|², which a thin film that absorbs on the sensor's plane sees.
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
        tolerance (``edge``: light that a small aperture's rim bends beyond the window).
    """
    _check(field, polarisation)
    if layers is None:
        layers = lens.layers if isinstance(lens, Lens) else Layers()
    wave = wave_of(lens, layers, scene_grid.window * scene_grid.step_um, distance_um)
    focus = wave.focus  # type: ignore[attr-defined]
    optics = Optics(
        wave, layers, focus.sensor_distance_um if distance_um is None else distance_um
    )
    source = spectrum or SpectralNodes(np.array([focus.wavelength_um]), np.ones(1), 0.0)
    reduced = layers.after(optics.distance_um, focus.wavelength_um).reduced_um
    middle = reduced * math.tan(field[0]), reduced * math.tan(field[1])
    round_ = (
        isinstance(wave, SmoothWave) and wave.added_rad is None and field == (0.0, 0.0)
    )
    round_ = round_ and (layers.stop is None or layers.stop.centred)
    given = optics, scene_grid, source, middle

    def build(within: float) -> Imager:
        plan = plan_nodes(
            *given, tolerance=within, folds=round_, polarisation=polarisation
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
    depth = float(1 / (1 / prepared.plan.depths_um).mean())
    stray = stray_of(optics, scene_grid, depth, middle)
    return replace(
        prepared, parts=parts, stray=None if stray is None else stray.to(device)
    )


def _check(field: tuple[float, float], polarisation: Polarisation) -> None:
    """Refuse a field beyond 90 degrees and a polarisation that is none."""
    if not all(abs(angle) < math.pi / 2 for angle in field):
        raise SceneError(
            f"field of {field} rad, need angles (x, y) of the middle of the grid within ±pi/2"
        )
    if polarisation not in get_args(Polarisation):
        raise SceneError(
            f"polarisation = {polarisation!r}: need one of {', '.join(get_args(Polarisation))}"
        )


def node_psfs(
    optics: Optics, plan: Plan, device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor]:
    """PSFs of all nodes, of sum 1, and their relative illumination; differentiable in
    the wave's factor.

    Args:
        optics: lens, light and distances at the nodes.
        plan: field nodes, depths and wavelengths.
        device: torch device.
    """
    if plan.folds:
        light = _folded(optics, plan, device)
    else:
        at = plan.places_um.to(device)
        light = sum_over_spectrum(optics, at, plan.depths_um, plan.waves, plan.window)
        size = len(plan.y_um), len(plan.x_um)
        light = light.reshape(*size, *light.shape[1:])
    return normalise_psfs(light, optics, plan)


def normalise_psfs(light: Tensor, optics: Optics, plan: Plan) -> tuple[Tensor, Tensor]:
    """(PSFs of sum 1, relative illumination) of the light on each sample of the nodes'
    windows.

    Args:
        optics: lens, light and distances at the nodes.
        plan: field nodes, depths and wavelengths.
    """
    total = light.sum((-2, -1))
    wave = float(plan.waves.wavelengths_um.mean())
    cosine4 = _cosine4(optics, plan.places_um, plan.depths_um, wave)
    return light / total[..., None, None], total * cosine4.reshape(total.shape).to(
        total
    )


def _cosine4(
    optics: Optics, at_um: Tensor, depths_um: Tensor, wavelength_um: float
) -> Tensor:
    """(…, depths) cos⁴ of the field angles of places (…, [x, y]), at the middle of the
    stop where there is one.
    """
    tangents = (
        at_um.numpy()
        / optics.layers.after(optics.distance_um, wavelength_um).reduced_um
    )
    rays = [
        optics.layers.through_middle(tangents, depth, wavelength_um)
        for depth in depths_um.tolist()
    ]
    return torch.from_numpy(1 / (1 + (np.stack(rays, -2) ** 2).sum(-1)) ** 2)


def _folded(optics: Optics, plan: Plan, device: torch.device | str) -> Tensor:
    """PSFs of a round lens on a square grid about its axis, from one eighth of the
    nodes.
    """
    count = len(plan.x_um)
    half = (count + 1) // 2
    pairs = [(i, j) for i in range(half) for j in range(i, half)]
    at = torch.stack([torch.stack([plan.x_um[j], plan.y_um[i]]) for i, j in pairs]).to(
        device
    )
    few = sum_over_spectrum(optics, at, plan.depths_um, plan.waves, plan.window)
    out = few.new_zeros(count, count, *few.shape[1:])
    for (i, j), psf in zip(pairs, few, strict=True):
        for row, up in ((i, psf), (count - 1 - i, psf.flip(-2))):
            for column, whole in ((j, up), (count - 1 - j, up.flip(-1))):
                out[row, column], out[column, row] = whole, whole.mT
    return out


def textured_frames(grid: Grid) -> Frames:
    """One frame of two sheets over all depths, of mean 1 with a 1/f texture of standard
    deviation 0.3.

    Args:
        grid: samples, step, depths and margin of the image.
    """
    draw = torch.Generator().manual_seed(11)
    y, x = (n + 2 * grid.margin for n in grid.samples)
    fy, fx = torch.fft.fftfreq(y)[:, None], torch.fft.rfftfreq(x)
    white = torch.fft.rfft2(torch.randn(2, y, x, generator=draw))
    lowest = 0.5 / max(x, y)
    rough = torch.fft.irfft2(white / torch.sqrt(fy**2 + fx**2 + lowest**2), s=(y, x))
    texture = (1 + CONTRAST * (rough - rough.mean()) / rough.std()).clamp_min(0)
    down = torch.linspace(-1, 1, y)[:, None].expand(y, x)
    across = torch.linspace(-1, 1, x).expand(y, x)
    near = torch.sigmoid((-down - 0.25 + 0.2 * across) * y / 4)
    cover = torch.stack([near, 1 - near])
    low, high = (1 / d for d in grid.depths_um)
    depth = 1 / torch.stack(
        [
            low + (high - low) * (0.2 + 0.2 * across),
            low + (high - low) * (0.6 + 0.35 * down),
        ]
    )
    return Frames((cover * texture)[None], cover[None], depth[None])


def _error_parts(optics: Optics, prepared: Imager) -> dict[str, float]:
    """Errors by cause, at places, depths and wavelengths that no node holds.

    Those that count by the light of a place are over the whole frame's light: more of
    an image that is dimmer than it.
    """
    plan, draw = prepared.plan, np.random.default_rng(7)
    pixels = np.floor(draw.random((HELD_OUT, 2)) * prepared.grid.frame).astype(int)
    rows, columns = (
        np.linspace(float(nodes[0]), float(nodes[-1]), n)
        for n, nodes in zip(prepared.grid.frame, (plan.y_um, plan.x_um), strict=True)
    )
    at = torch.from_numpy(np.stack([columns[pixels[:, 1]], rows[pixels[:, 0]]], -1))
    near, far = 1 / plan.depths_um[[0, -1]]
    depths = 1 / (near + (far - near) * torch.tensor([0, 0.13, 0.58, 1]).double())
    true = sum_over_spectrum(optics, at, depths, plan.waves, plan.window).detach()
    middle_wave = float(plan.waves.wavelengths_um.mean())
    level = _cosine4(optics, at, depths, middle_wave)[..., None, None]
    used = psfs_used(prepared, torch.from_numpy(pixels), depths).cpu()
    dimmer, light = image_dimming(prepared), true.sum((-1, -2))
    few = at[:FEW], depths[1:-1]
    # of the brightest of few places in the image
    share = float(light[:FEW].max() / (light**2).mean().sqrt()) * dimmer
    judged = left_out.JudgedPsfs(optics, plan.waves, plan.window, few)
    wave = float(plan.waves.wavelengths_um[0])
    pillars = optics, wave, plan.window, (at[:2], depths[1:-1])
    parts = {
        "psfs": scene_error(used, (true * level).to(used)) * dimmer,
        "planes": _plane_error(prepared),
        "spectrum": max(plan.waves.error, 0.0),
        "transform": left_out.transform_error(judged) * share,
        "folded": left_out.folding_error(judged) * share,
        "polarisation": left_out.polarisation_error(judged) * share,
        "pillars": left_out.gathering_error(*pillars) * dimmer,
        "edge": sampling(optics, plan.window, wave).beyond / 2,
    }
    if optics.layers.stop is not None:
        seen = true[:FEW, 1:-1], light[:FEW, 1:-1], light.amax(0)[1:-1]
        ripples = _shadow_error(optics, wave, few, seen, plan.window.step_um)
        parts["stop"] = ripples * dimmer
    return parts


def _plane_error(prepared: Imager) -> float:
    """Root mean square error of uniformly illuminated planes, at the worst depth.

    Compared with images by the PSFs of the nodes, at the depth nodes and half-way.
    """
    near, far = prepared.light.vergence
    count = 2 * len(prepared.plan.depths_um) - 1
    depths = 1 / torch.linspace(near, far, count, dtype=torch.float64)
    field = prepared.field
    deep = spline_matrix(torch.linspace(0, 1, count), len(prepared.plan.depths_um))
    light = torch.einsum("cz,abzhw->abchw", deep.to(field.psf), field.light)
    maps = frame_maps(prepared.grid.frame, light.shape[:2], light)
    wanted = prepared.grid.crop(plane_images(light, maps))
    one = torch.ones(1, *prepared.grid.frame).to(field.psf)
    found = [
        prepared.grid.crop(prepared.light.blur(one, torch.full_like(one, depth))[0])
        for depth in depths.tolist()
    ]
    wrong = (torch.stack(found) - wanted).square().mean((1, 2)).max()
    level = wanted.square().mean((1, 2)).max().clamp_min(1e-30)
    return float(torch.sqrt(wrong / level))


def image_dimming(prepared: Imager) -> float:
    """By how much an image of even light is dimmer than the whole frame's, 1 at least:
    margins may be in the light where an image lies in the shadow of a stop.

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
    seen: tuple[Tensor, ...],
    step_um: float,
) -> float:
    """Error of the stop's shadow, the worst of some places and depths.

    Args:
        places: field points and depths. seen: their PSFs, the share of the light on the
            aperture that these hold, and that of the brightest place of each depth.
    """
    at, depths_um = places
    psfs, contained, brightest = (part.cpu().numpy() for part in seen)
    reduced = optics.layers.after(optics.distance_um, wavelength_um).reduced_um
    share = contained.clip(1e-6, 1)
    unit = psfs / contained.clip(1e-6)[..., None, None]
    rads = blur_um(unit, step_um, share) / reduced
    errors = []
    for i, (x, y) in enumerate((at / reduced).tolist()):
        for k, depth in enumerate(depths_um.tolist()):
            rad = float(rads[i, k]) / math.hypot(1, x, y)
            about = (x, y), depth, wavelength_um, rad, float(share[i, k])
            error = optics.layers.shadow_error(*about)
            errors.append(error * contained[i, k] / brightest[k])
    return float(max(errors))


def psfs_used(optics: Imager, pixels: Tensor, depths_um: Tensor) -> Tensor:
    """(n, depths, h, w) light that the kernels give sources at (n, [row, column]).

    Args:
        optics: lens, light and distances at the nodes.
        pixels: places of the samples.
        depths_um: source depths from the lens, um.
    """
    high, wide = optics.grid.frame
    where = (pixels[:, 0] * wide + pixels[:, 1]).to(optics.stack.device)
    out = []
    for depth in depths_um.tolist():
        deep = torch.full((high, wide), depth).to(optics.stack)
        weights = optics.light.interpolate(deep, where)
        out.append(torch.einsum("rn,rhw->nhw", weights, optics.light.kernels))
    return torch.stack(out, 1)
