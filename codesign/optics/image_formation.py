"""The image that training sees: true over field, depth and spectrum, or of
one PSF a depth.
"""

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from codesign.optics import stack as lens
from codesign.optics.lens_errors import DrawnLensErrors, variance_rad2
from codesign.optics.stack import OpticsConfig, PixelPsfStack
from metalens.core.errors import PropagationError, SceneError, TrainingError
from metalens.image import (
    Imager,
    Optics,
    normalise_psfs,
    surrogate_loss,
    textured_frames,
    with_psfs,
)
from metalens.image import imager as field_imager
from metalens.optics import Layers

# samples along a side of the frames, margin included; margin; their device
FrameGrid = tuple[int, int, torch.device]


def make_imager(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    frame: int,
    *,
    margin: int,
    error: DrawnLensErrors | None = None,
    made: PixelPsfStack | None = None,
    shared: bool = False,
    device: torch.device | str = "cpu",
) -> Imager:
    """Imager of square frames: shift-invariant PSFs, or the true image.

    The true image is cached for a lens without error.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        frame: samples along a side, margin included. margin: samples around the frame.
        error: one draw of the lens errors.
        made: a fabricated lens in place of the coefficients.
        shared: as for :func:`codesign.optics.stack.lens_psf_stack`.
        device: where the frames are imaged, and the true image's PSFs are computed.

    Raises:
        TrainingError: the true image of ``made`` is requested, whose PSFs are known for
            one chief ray alone.
    """
    if settings.image == "uniform":
        stack = made or lens.lens_psf_stack(
            settings, coefficients_rad, error=error, shared=shared
        )
        return lens.stack_imager(settings, stack, frame, margin=margin).to(device)
    grid = frame, margin, torch.device(device)
    if made is not None:
        if made.plane is None:
            raise TrainingError(
                "optics.image = 'true', but the lens is given by its PSFs on axis alone: they cannot stand for the field; "
                "use a run of optics.image = 'uniform' for it"
            )
        return _cached_imager(settings, made.plane, grid)
    if error is None:
        coefficients = tuple(coefficients_rad.detach().tolist())
        return _cached_imager(settings, coefficients, grid)
    optics = optics_of(settings, coefficients_rad.detach(), error)
    imager = imager_through(settings, optics, frame, margin=margin, device=device)
    return _with_scattered_light(settings, imager, error)


@functools.lru_cache(maxsize=16)
def _cached_imager(
    settings: OpticsConfig, lens_plane: Optics | tuple[float, ...], grid: FrameGrid
) -> Imager:
    """True image of a fabricated lens, or of phase coefficients in rad, cached."""
    frame, margin, device = grid
    if isinstance(lens_plane, tuple):
        coefficients = torch.tensor(lens_plane, dtype=torch.float64)
        lens_plane = optics_of(settings, coefficients)
    return imager_through(settings, lens_plane, frame, margin=margin, device=device)


@torch.no_grad()
def imager_through(
    settings: OpticsConfig,
    plane: Optics,
    frame: int,
    *,
    margin: int,
    device: torch.device | str = "cpu",
) -> Imager:
    """Imager through a lens plane with its films, in the settings' light and field.

    Args:
        settings: of the lens and its image. plane: wave, films and distance.
        frame: samples along a side, margin included. margin: samples around the frame.
        device: where frames are imaged.

    Raises:
        SceneError, PropagationError: as :func:`metalens.image.imager`.
    """
    imager = field_imager(
        plane.wave,
        lens.grid_of(settings, frame, margin),
        spectrum=settings.light,
        layers=plane.layers,
        field=(math.radians(settings.angle_deg), 0.0),
        tolerance=settings.image_tolerance,
        distance_um=plane.distance_um,
        device=device,
    )
    return imager if settings.passed == 1 else imager.scaled(settings.passed)


def _with_scattered_light(
    settings: OpticsConfig, imager: Imager, error: DrawnLensErrors
) -> Imager:
    """Imager with the light that pillars of wrong phase scatter over the shadow.

    See :func:`codesign.optics.stack.scatter_loss`; the shadow's light is equal on all
    samples. PSFs keep sum 1, the fraction multiplies the energy.
    """
    variance = variance_rad2(error.state(), settings.phase_rates)
    light = lens.scatter_loss(settings, imager.stack, variance)
    fraction = light.sum((-2, -1))
    return with_psfs(
        imager, light / fraction[..., None, None], imager.energy * fraction
    )


@dataclass(frozen=True, eq=False, slots=True)
class DifferentiableImager:
    """True image of a moving lens: an imager with the light of its nodes as a leaf
    tensor.

    light: (rows, columns, depths, h, w), collects the gradient of the loss, of the
    selected nodes. ready: the imager, differentiable in it. pairs: field points and
    wavelengths of :func:`metalens.image.draw_nodes`; None for all nodes.
    """

    light: Tensor
    ready: Imager
    pairs: tuple[Tensor, Tensor] | None = None

    def pass_on(self, settings: OpticsConfig, coefficients_rad: Tensor) -> None:
        """Add the gradient of the light to that of the coefficients, by a surrogate
        loss.

        It is estimated from the drawn points and wavelengths.

        Args:
            settings: of the lens and its image.
            coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        """
        if self.light.grad is None or self.pairs is None:
            return
        optics = optics_of(settings, coefficients_rad)
        loss = surrogate_loss(optics, self.ready.plan, self.light.grad, self.pairs)
        loss.backward()  # type: ignore[no-untyped-call]


def make_differentiable_imager(
    settings: OpticsConfig, whole: Imager, pairs: tuple[Tensor, Tensor] | None = None
) -> DifferentiableImager:
    """An imager with its nodes' light as a leaf tensor.

    The PSFs are the light over its sum, so relative illumination is constant.

    Args:
        settings: of the lens and its image. whole: prepared image of the lens.
        pairs: field points and wavelengths that were drawn; None for all.
    """
    with torch.no_grad():
        unit_energy = normalise_psfs(
            torch.ones_like(whole.stack[..., :1, :1]),
            optics_of(settings, torch.zeros(0)),
            whole.plan,
        )[1]
        light = whole.stack * (whole.energy / unit_energy)[..., None, None]
    light.requires_grad_()
    psfs = light / light.sum((-2, -1), keepdim=True)
    selected = None if pairs is None else set(pairs[0].tolist())
    return DifferentiableImager(
        light, replace(whole, stack=psfs, asked=selected), pairs
    )


def optics_of(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    error: DrawnLensErrors | None = None,
) -> Optics:
    """Lens plane with its films and sensor distance; without coefficients the plain
    focus.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        error: of assembly and process; None for a perfect lens.
    """
    plain = replace(settings, polynomials=0, parameters="polynomials")
    moving = settings if coefficients_rad.numel() else plain
    wave = lens.lens_wave(moving, coefficients_rad, error)
    return Optics(wave, settings.layers or Layers(), settings.sensor_distance_mm * 1e3)


@torch.no_grad()
def uniform_image_error(
    settings: OpticsConfig, coefficients_rad: Tensor, frame: int, *, margin: int
) -> float:
    """Error of 'uniform': relative L2 difference of its image of a texture from the
    true one.

    The texture extends in depth.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        frame: samples along a side, margin included.
        margin: samples around the frame that are imaged and then cut off.
    """
    true = make_imager(
        replace(settings, image="true"), coefficients_rad, frame, margin=margin
    )
    uniform = make_imager(
        replace(settings, image="uniform", layers=None),
        coefficients_rad,
        frame,
        margin=margin,
    )
    frames = textured_frames(true.grid)
    reference = replace(true, stray=None)(frames)
    contrast = (reference - reference.mean()).norm()
    return float((uniform(frames) - reference).norm() / contrast)


def image_tolerance_problem(settings: OpticsConfig, imager_used: Imager) -> str:
    """Why the error of the true image is above ``optics.image_tolerance``.

    Empty where it is not, or the image is uniform, whose difference from the true one
    is reported instead.

    Args:
        settings: of the lens and its image. imager_used: what forms the images.
    """
    return (
        "" if imager_used.light.uniform else imager_used.above(settings.image_tolerance)
    )


def describe_image(
    settings: OpticsConfig, coefficients_rad: Tensor, frame: int, *, margin: int
) -> dict[str, Any]:
    """Record of the image model for a report: kind, error, spectral width and filter.

    error: of the uniform image, :func:`uniform_image_error`; of the true image, its own
    estimate; None where the true image cannot be formed, for the reason under
    ``problem``.
    above: why the true image's own estimate is above ``optics.image_tolerance``; empty
    where it is not.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        frame: samples along a side, margin included.
        margin: samples around the frame that are imaged and then cut off.
    """
    record: dict[str, Any] = {
        "kind": settings.image,
        "fwhm_nm": settings.fwhm_nm,
        "passed": settings.passed,
        "above": "",
    }
    try:
        if settings.image == "uniform":
            error = uniform_image_error(
                settings, coefficients_rad, frame, margin=margin
            )
            return record | {"error": error}
        imager = make_imager(settings, coefficients_rad, frame, margin=margin)
        return record | {
            "error": imager.error,
            "above": image_tolerance_problem(settings, imager),
        }
    except (SceneError, PropagationError) as problem:
        return record | {"error": None, "problem": str(problem)}


def describe_image_text(record: dict[str, Any]) -> str:
    """A line of :func:`describe_image`.

    Args:
        record: of :func:`describe_image`.
    """
    if record["error"] is None:
        return f"image: {record['kind']}; how far it is from the true image is not known: {record['problem']}"
    if record["kind"] == "uniform":
        return (
            "image: one PSF for the whole field, one wavelength (uniform); it differs from the true image of a texture "
            f"by {record['error']:.2f} of its contrast; optics.image = 'true' trains on it"
        )
    light = f"{record['fwhm_nm']:g} nm" if record["fwhm_nm"] else "one wavelength"
    return f"image: whole field, {light}, {100 * record['passed']:.0f} % of the light; error {record['error']:.3f}"
