"""PSFs as a sensor sees them: pixels of any pitch, and binned pixels."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from metalens.core.errors import PropagationError
from metalens.psf.record import PsfStack


def on_pixels(
    stack: PsfStack,
    *,
    pitch_um: Any,
    bins: int = 1,
    shift_um: tuple[float, float] = (0.0, 0.0),
    count: int | None = None,
) -> PsfStack:
    """Light per pixel, each PSF again of sum 1 over the pixels; one without light there
    stays 0, with no energy.

    Args:
        stack: PSFs over angle, depth and wavelength.
        pitch_um: of one pixel, a number or a torch scalar (the result is differentiable
            in it, continuously).
        bins: 1, 2, 3 … pixels along each axis that are added.
        shift_um: (y, x) of the pixel grid towards +; the energy is that of the pixels.
        count: binned pixels along each axis; by default as many as cover the window.

    Raises:
        PropagationError: bins below 1, or pixels finer than the samples.
    """
    pitch = pitch_um * bins
    width = float(pitch.detach()) if isinstance(pitch, torch.Tensor) else float(pitch)
    if bins < 1 or not width >= stack.step_um:
        raise PropagationError(
            f"pixels of {width / max(bins, 1)} um binned {bins} x {bins} on samples of {stack.step_um} um; "
            "need bins of 1 or more and pixels at least as wide as the samples"
        )
    light = torch.as_tensor(stack.intensity)
    shape = None if count is None else (count, count)
    pixels = integrate_pixels(
        light, stack.step_um, pitch_um=pitch, shape=shape, shift_um=shift_um
    )
    share = pixels.sum((-1, -2))
    least = torch.finfo(share.dtype).tiny
    result: tuple[Any, Any] = (
        pixels / share.clamp_min(least)[..., None, None],
        torch.as_tensor(stack.energy_um2) * share,
    )
    if not isinstance(stack.intensity, torch.Tensor) and not result[0].requires_grad:
        result = result[0].numpy(), result[1].numpy()
    return dataclasses.replace(
        stack, intensity=result[0], energy_um2=result[1], step_um=width
    )


def pixel_count(samples: int, sample_um: float, pitch_um: float) -> int:
    """Pixels of this pitch that cover ``samples`` samples; one where the pixel is
    larger than the image.

    Args:
        sample_um: step of the samples, um.
        pitch_um: lattice constant, um.
    """
    return max(1, math.ceil(samples * sample_um / pitch_um * (1 - 1e-12)))


def whole_pixels(samples: int, sample_um: float, pitch_um: float) -> int:
    """Pixels of this pitch that lie wholly inside ``samples`` samples, however the
    lengths are rounded.

    Args:
        sample_um: step of the samples, um.
        pitch_um: lattice constant, um.
    """
    return math.floor(samples * sample_um / pitch_um * (1 + 1e-12))


def pixel_weights(
    samples: int,
    sample_um: float,
    *,
    pitch_um: float | Tensor,
    count: int | None = None,
    shift_um: float = 0.0,
    grid_um: float | None = None,
) -> Tensor:
    """(pixels, samples) share of each sample's light that falls on each pixel, in
    float64.

    The cumulative light at the sample edges is interpolated by a Catmull-Rom cubic and
    differenced at the pixel
    edges: exact area overlap where the edges coincide, telescoping (so the energy is
    kept), and with a continuous
    derivative in the pitch everywhere. Plain overlap has a kink wherever a pixel edge
    meets a sample edge.

    Args:
        sample_um: step of the samples, um.
        samples: of the image along this axis; the image is centred on the pixel row.
        pitch_um: float, or a tensor that the weights are differentiable in.
        count: of pixels; by default as many as cover the image.
        shift_um: of the pixel row towards + along the axis.
        grid_um: distance of the pixels, the pitch by default. Where it is given the
            places stay and ``pitch_um`` is
            the width of the box alone (the paper's learnable box filter), in the light
            of a box of ``grid_um``.

    Accuracy:
        Column sums are 1 to rounding where the pixels reach one sample beyond the
        image. A pixel cut by an
        isolated bright sample takes up to -0.075 of it: the overshoot of the cubic;
        none on sampled PSFs.
    """
    pitch = torch.as_tensor(pitch_um, dtype=torch.float64)
    pixels = pixel_count(
        samples, sample_um, float(pitch.detach()) if grid_um is None else grid_um
    )
    pixels = pixels if count is None else count
    place = torch.arange(pixels + 1, dtype=torch.float64) - pixels / 2

    def light(edge_um: Tensor) -> Tensor:
        position = (edge_um + shift_um) / sample_um + samples / 2
        return _smooth_step(
            position[:, None] - torch.arange(samples, dtype=torch.float64)
        )

    if grid_um is None:
        step = light(place * pitch)
        return step[1:] - step[:-1]
    middle = (place[:-1] + 0.5) * grid_um
    return (light(middle + pitch / 2) - light(middle - pitch / 2)) * (grid_um / pitch)


def integrate_pixels(
    image: Tensor,
    sample_um: float,
    *,
    pitch_um: float | Tensor,
    shape: tuple[int, int] | None = None,
    shift_um: tuple[float, float] = (0.0, 0.0),
    grid_um: float | None = None,
) -> Tensor:
    """Light on every pixel: the sum of ``image`` (light per sample) over the pixel's
    area.

    Args:
        sample_um: step of the samples, um.
        pitch_um: lattice constant, um.
        image: (..., y, x).
        shape: (rows, columns) of pixels; by default as many as cover the image.
        shift_um: (y, x) of the pixel grid.
        grid_um: see :func:`pixel_weights`.

    Returns:
        (..., rows, columns) in the dtype of ``image``; differentiable in image and
        pitch.
    """
    axes = list(
        zip(
            image.shape[-2:],
            (None, None) if shape is None else shape,
            shift_um,
            strict=True,
        )
    )
    if not (
        isinstance(pitch_um, Tensor)
        and pitch_um.requires_grad
        and torch.is_grad_enabled()
    ):
        width = float(pitch_um.detach()) if isinstance(pitch_um, Tensor) else pitch_um
        lengths = [
            length / sample_um
            for length in (width, width if grid_um is None else grid_um)
        ]
        if all(
            _samples(n, count, shift / sample_um, lengths) for n, count, shift in axes
        ):
            return image
    rows, columns = (
        pixel_weights(
            n,
            sample_um,
            pitch_um=pitch_um,
            count=count,
            shift_um=shift,
            grid_um=grid_um,
        )
        for n, count, shift in axes
    )
    return rows.to(image) @ image @ columns.to(image).mT


def _samples(
    samples: int, count: int | None, shift: float, lengths: Sequence[float]
) -> bool:
    """Whether every pixel is one sample, to the rounding of its edges' places (double
    precision).

    count: of pixels. shift: of the grid. lengths: width and distance of the pixels, all
    in samples.
    """
    if (pixel_count(samples, 1.0, lengths[1]) if count is None else count) != samples:
        return False
    return max(abs(length - 1) for length in lengths) * samples / 2 + abs(shift) < 5e-12


def _smooth_step(t: Tensor) -> Tensor:
    """Response of the Catmull-Rom cumulative to one cell [0, 1] of unit light: 0 left
    of -1, 1 right of 2.
    """
    u, w = t + 1, t - 1
    before = 0.5 * u**2 * (u - 1)
    inside = t * (0.5 + t * (1.5 - t))
    after = 1 + 0.5 * w * (1 - w) ** 2
    left = torch.where(
        t < 0, torch.where(t < -1, 0.0, before), inside
    )  # one piece each: its slope counts once
    return torch.where(t < 1, left, torch.where(t < 2, after, 1.0))
