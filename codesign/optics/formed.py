"""The image that training sees: true over field, depth and spectrum, or by one PSF a
depth, as the settings say.
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
    PillarWave,
    SmoothWave,
    normalise_psfs,
    surrogate_loss,
    textured_frames,
    with_psfs,
)
from metalens.image import imager as field_imager
from metalens.optics import Layers

There = tuple[
    int, int, torch.device
]  # samples along a side of the frames, margin included; margin; where they are


def lens_wave(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    error: DrawnLensErrors | None = None,
) -> SmoothWave | PillarWave:
    """The lens plane of these coefficients for :func:`metalens.image.imager`;
    differentiable in them.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        error: assembly and process error of one lens; None for none.
    """
    if settings.parameters == "diameters":
        return lens.pillar_wave(settings, coefficients_rad)
    if settings.polynomials or settings.zones or error is not None:
        added = functools.partial(
            lens.phase_at, settings, coefficients_rad, error=error
        )
    else:
        added = None
    return SmoothWave(settings.focus, settings.aperture_mm * 500, added)


def make_imager(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    frame: int,
    *,
    margin: int,
    error: DrawnLensErrors | None = None,
    made: PixelPsfStack | None = None,
    device: torch.device | str = "cpu",
) -> Imager:
    """What images frames of ``frame`` samples, margin included.

    Args:
        error: one draw of the lenses that are made. made: a lens that is made in place
            of the coefficients.
        device: where the frames are imaged, and the true image's PSFs are computed.
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.

    Raises:
        TrainingError: of the lens that is made only PSFs of one chief ray are known,
            and the true image is asked for.
    """
    if settings.image == "uniform":
        found = made or lens.lens_psf_stack(settings, coefficients_rad, error=error)
        return lens.stack_imager(settings, found, frame, margin=margin).to(device)
    there = frame, margin, torch.device(device)
    if made is not None:
        return _made(settings, made, there)
    key = tuple(coefficients_rad.detach().tolist())
    if error is None:
        return _still(settings, key, there)
    return _hazy(settings, _formed(settings, key, there, error), error)


@functools.lru_cache(maxsize=32)
def _made(settings: OpticsConfig, made: PixelPsfStack, there: There) -> Imager:
    """The true image of a lens that is made: formed once for all who look at it."""
    if made.plane is None:
        raise TrainingError(
            "optics.image = 'true', but the lens is given by its PSFs on axis alone: they cannot stand for the field; "
            "use a run of optics.image = 'uniform' for it"
        )
    frame, margin, device = there
    return imager_through(settings, made.plane, frame, margin=margin, device=device)


@functools.lru_cache(maxsize=3)
def _still(
    settings: OpticsConfig, coefficients_rad: tuple[float, ...], there: There
) -> Imager:
    return _formed(settings, coefficients_rad, there, None)


@torch.no_grad()
def _formed(
    settings: OpticsConfig,
    coefficients_rad: tuple[float, ...],
    there: There,
    error: DrawnLensErrors | None,
) -> Imager:
    wave = lens_wave(
        settings, torch.tensor(coefficients_rad, dtype=torch.float64), error
    )
    frame, margin, device = there
    plane = _in_place(settings, wave)
    return imager_through(settings, plane, frame, margin=margin, device=device)


@torch.no_grad()
def imager_through(
    settings: OpticsConfig,
    plane: Optics,
    frame: int,
    *,
    margin: int,
    device: torch.device | str = "cpu",
) -> Imager:
    """The image through a lens plane in its surroundings, in the settings' light.

    Args:
        plane: wave, films and distance. frame: samples along a side, ``margin``
            included. device: where frames are imaged.

    Raises:
        SceneError, PropagationError: as :func:`metalens.image.imager`.
    """
    whole = field_imager(
        plane.wave,
        lens.grid_of(settings, frame, margin),
        spectrum=settings.light,
        layers=plane.layers,
        field=(math.radians(settings.angle_deg), 0.0),
        tolerance=settings.image_tolerance,
        distance_um=plane.distance_um,
        device=device,
    )
    return whole if settings.passed == 1 else whole.scaled(settings.passed)


def _hazy(settings: OpticsConfig, whole: Imager, error: DrawnLensErrors) -> Imager:
    """See :func:`codesign.optics.stack.scatter_loss`; the shadow's light falls on all
    samples
    alike.
    """
    light = lens.scatter_loss(
        settings, whole.stack, variance_rad2(error.state(), settings.phase_rates)
    )
    total = light.sum((-2, -1))
    return with_psfs(whole, light / total[..., None, None], whole.energy * total)


@dataclass(frozen=True, eq=False, slots=True)
class DifferentiableImager:
    """A true image whose lens moves: the imager with the light of its nodes as a leaf.

    light: (rows, columns, depths, h, w), gathers the gradient of the loss, of the nodes
    that were asked for. ready:
    the imager, differentiable in it. pairs: what was drawn of
    :func:`metalens.image.drawn`; None for all nodes.
    """

    light: Tensor
    ready: Imager
    pairs: tuple[Tensor, Tensor] | None = None

    def pass_on(self, settings: OpticsConfig, coefficients_rad: Tensor) -> None:
        """Add to the gradient of the coefficients what the light gathered, from the
        points and wavelengths drawn.

        Args:
            settings: of the lens and its image.
            coefficients_rad: (polynomials,) phase coefficients of the lens, rad.

        Raises:
            ValueError: none were drawn: the light's own gradient is that of all nodes.
        """
        if self.pairs is None:
            raise ValueError(
                "no field points were drawn: a gradient needs live(..., pairs)"
            )
        if self.light.grad is None:
            return
        optics = optics_of(settings, coefficients_rad)
        value = surrogate_loss(optics, self.ready.plan, self.light.grad, self.pairs)
        value.backward()  # type: ignore[no-untyped-call]


def make_differentiable_imager(
    settings: OpticsConfig, whole: Imager, pairs: tuple[Tensor, Tensor] | None = None
) -> DifferentiableImager:
    """An imager with its nodes' light as a leaf, of the nodes that were drawn or of
    all; the relative illumination is
    held, and the image is that of the kernels that there are.

    Args:
        settings: of the lens and its image. whole: prepared image of the lens.
        pairs: field points and wavelengths that were drawn; None for all.
    """
    with torch.no_grad():
        unit = normalise_psfs(
            torch.ones_like(whole.stack[..., :1, :1]),
            optics_of(settings, torch.zeros(0)),
            whole.plan,
        )[1]
        light = whole.stack * (whole.energy / unit)[..., None, None]
    light.requires_grad_()
    psfs = light / light.sum((-2, -1), keepdim=True)
    asked = None if pairs is None else set(pairs[0].tolist())
    return DifferentiableImager(light, replace(whole, stack=psfs, asked=asked), pairs)


def optics_of(settings: OpticsConfig, coefficients_rad: Tensor) -> Optics:
    """Wave, surroundings and distance of the lens.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
    """
    plain = replace(settings, polynomials=0, parameters="polynomials")
    moving = settings if coefficients_rad.numel() else plain
    return _in_place(settings, lens_wave(moving, coefficients_rad))


def _in_place(settings: OpticsConfig, wave: SmoothWave | PillarWave) -> Optics:
    return Optics(wave, settings.layers or Layers(), settings.sensor_distance_mm * 1e3)


@torch.no_grad()
def uniform_image_error(
    settings: OpticsConfig, coefficients_rad: Tensor, frame: int, *, margin: int
) -> float:
    """Relative L2 difference of the uniform image of a texture in depth from its true
    image: the error of 'uniform'.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        frame: samples along a side, margin included.
        margin: samples around the frame that are blurred in and not seen.
    """
    true = make_imager(
        replace(settings, image="true"), coefficients_rad, frame, margin=margin
    )
    one = make_imager(
        replace(settings, image="uniform", layers=None),
        coefficients_rad,
        frame,
        margin=margin,
    )
    return relative_image_difference(one, true)


@torch.no_grad()
def relative_image_difference(one: Imager, true: Imager) -> float:
    """Relative L2 difference of the image of a texture in depth through one PSF a depth
    from its true image.

    Of the texture's contrast; both images of frames of one size, with the same margin.
    """
    frames = textured_frames(true.grid)
    want = replace(true, stray=None)(frames)
    return float((one(frames) - want).norm() / (want - want.mean()).norm())


def image_tolerance_problem(settings: OpticsConfig, found: Imager) -> str:
    """Why the error of the true image is above ``optics.image_tolerance``; empty where
    it is not, or the image is
    uniform, whose distance from the true one is told instead.

    Args:
        settings: of the lens and its image. found: what forms the images.
    """
    return "" if found.light.uniform else found.above(settings.image_tolerance)


def describe_image(
    settings: OpticsConfig, coefficients_rad: Tensor, frame: int, *, margin: int
) -> dict[str, Any]:
    """What the images are and how wrong, for a report: kind, error, and the source's
    width and filter.

    error: of the uniform image, :func:`uniform_image_error`; of the true image, its own estimate;
    None where the true image of this
    lens cannot be formed, for the reason under ``problem``. above: why the true image's
    own estimate is above
    ``optics.image_tolerance``; empty where it is not.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        frame: samples along a side, margin included.
        margin: samples around the frame that are blurred in and not seen.
    """
    found: dict[str, Any] = {
        "kind": settings.image,
        "fwhm_nm": settings.fwhm_nm,
        "passed": settings.passed,
        "above": "",
    }
    try:
        if settings.image == "uniform":
            return found | {
                "error": uniform_image_error(
                    settings, coefficients_rad, frame, margin=margin
                )
            }
        made = make_imager(settings, coefficients_rad, frame, margin=margin)
        return found | {
            "error": float(getattr(made, "error", math.nan)),
            "above": image_tolerance_problem(settings, made),
        }
    except (SceneError, PropagationError) as problem:
        return found | {"error": None, "problem": str(problem)}


def describe_image_text(found: dict[str, Any]) -> str:
    """A line of :func:`describe_image`.

    Args:
        found: record of :func:`describe_image`.
    """
    if found["error"] is None:
        return f"image: {found['kind']}; how far it is from the true image is not known: {found['problem']}"
    if found["kind"] == "uniform":
        return (
            "image: one PSF for the whole field, one wavelength (uniform); it differs from the true image of a texture "
            f"by {found['error']:.2f} of its contrast; optics.image = 'true' trains on it"
        )
    light = f"{found['fwhm_nm']:g} nm" if found["fwhm_nm"] else "one wavelength"
    return f"image: whole field, {light}, {100 * found['passed']:.0f} % of the light; error {found['error']:.3f}"
