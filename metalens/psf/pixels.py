"""PSFs as a sensor sees them: pixels of any pitch, and binned pixels."""

import dataclasses
from typing import Any

import torch

from metalens.core.errors import PropagationError
from metalens.image import integrate
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
    pixels = integrate(
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
