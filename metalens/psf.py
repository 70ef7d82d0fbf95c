"""Point spread functions of a lens over depth, field angle and wavelength (paper Sec. 3.1, Eqs. 1-3)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from metalens import propagate
from metalens.errors import PropagationError
from metalens.propagate_case import Case, check_aperture
from metalens.propagate_window import field_windowed, plan
from metalens.psf_record import PsfStack
from metalens.store import Array

__all__ = ["PsfStack", "psf_stack"]


def psf_stack(
    phase_rad: Any,
    transmission: Any,
    *,
    pitch_um: float,
    wavelength_um: float | Sequence[float],
    sensor_distance_um: float,
    depths_um: Any,
    angle_rad: Any = 0.0,
    window_um: float,
    samples: int,
    tolerance: float = 1e-4,
    weights: Sequence[float] | None = None,
    offset_um: tuple[float, float] = (0.0, 0.0),
) -> PsfStack:
    """PSF stack of a lens: |U|² on a window that follows the chief ray, each PSF of sum 1.

    Args:
        phase_rad, transmission: (…, y, x) maps, numpy or torch, float32 or float64; leading axes are a batch of
            lenses. With several wavelengths the axis before y is the wavelength. Torch maps are differentiable.
        wavelength_um: one, or several with ``weights`` (equal if None), whose intensities add (incoherent light).
        depths_um: source depths from the lens, inf for collimated light.
        angle_rad: field angle along x, a pair (x, y), or (n, 2) for several angles.
        window_um, samples: full width of the square window, and cells along it; samples lie at cell centres.
        tolerance: relative L2 error of every PSF.
        offset_um: (x, y) of the window from the chief ray.

    Returns:
        PsfStack with intensity (…, [angle,] depth, y, x) of the kind and dtype that came in.

    Raises:
        PropagationError: empty aperture, NaN (row and column named), impossible geometry, no light in the window.
    """
    maps, waves, share = _maps(phase_rad, transmission, wavelength_um, weights)
    several = np.ndim(angle_rad) == 2
    field_angles = [propagate.angles(a) for a in (angle_rad if several else [angle_rad])]
    about = {"pitch_um": pitch_um, "sensor_distance_um": sensor_distance_um, "depths_um": depths_um}
    about |= {"window_um": window_um, "samples": samples, "offset_um": offset_um}
    shape = maps[0].shape
    cases = [[propagate.case(shape, wavelength_um=w, angle_rad=a, **about) for w in waves] for a in field_angles]
    for phase, level in zip(*(m.detach().cpu().reshape(-1, *shape[-2:]).numpy() for m in maps), strict=True):
        check_aperture(phase, level, cases[0][0])
    light = torch.stack([_polychromatic(maps, row, share, tolerance) for row in cases], dim=-4)
    energy = light.sum((-1, -2))
    if not bool((energy > 0).all()):
        raise PropagationError("no light reaches the window at some depth; move or widen the window")
    step = cases[0][0].step_um
    results: tuple[Any, Any] = light / energy[..., None, None], energy * step**2
    if not several:
        results = results[0].squeeze(-4), results[1].squeeze(-2)
    if not isinstance(phase_rad, torch.Tensor):
        results = results[0].detach().numpy(), results[1].detach().numpy()
    return PsfStack(
        *results,
        depths_um=np.atleast_1d(np.asarray(depths_um, float)),
        angles_rad=np.array(field_angles),
        wavelengths_um=np.array(waves),
        weights=share,
        step_um=step,
        centres_um=np.array([row[0].centre_um for row in cases]),
        sensor_distance_um=float(sensor_distance_um),
        tolerance=tolerance,
    )


def _maps(
    phase: Any, level: Any, wavelength_um: float | Sequence[float], weights: Sequence[float] | None
) -> tuple[tuple[torch.Tensor, torch.Tensor], list[float], Array]:
    """Maps (…, wavelength, y, x) as tensors of one dtype, the wavelengths, and their weights of sum 1."""
    waves = np.atleast_1d(np.asarray(wavelength_um, float)).tolist()
    share = np.full(len(waves), 1 / len(waves)) if weights is None else np.asarray(weights, float)
    if share.shape != (len(waves),) or not (share >= 0).all() or not share.sum() > 0:
        raise PropagationError(f"{len(waves)} wavelengths with weights {share}, need one weight >= 0 for each")
    phase = torch.as_tensor(phase)
    if not phase.is_floating_point():
        raise PropagationError(f"phase_rad is {phase.dtype}, need float32 or float64")
    level = torch.as_tensor(level).to(phase).expand(phase.shape)
    if np.ndim(wavelength_um) == 0:
        phase, level = phase.unsqueeze(-3), level.unsqueeze(-3)
    elif phase.ndim < 3 or phase.shape[-3] != len(waves):
        raise PropagationError(
            f"{len(waves)} wavelengths, but maps of shape {tuple(phase.shape)}; need (…, wavelength, y, x)"
        )
    return (phase, level), waves, share / share.sum()


def _polychromatic(
    maps: tuple[torch.Tensor, torch.Tensor], cases: list[Case], share: Array, tolerance: float
) -> torch.Tensor:
    """(…, depth, y, x) intensity of one field angle, wavelengths added with their weights."""
    phase, level = maps
    batch = phase.shape[:-3]
    total: Any = 0
    for i, (one, weight) in enumerate(zip(cases, share, strict=True)):
        made = plan(one, tolerance, phase.dtype, phase.device)
        pairs = zip(
            phase[..., i, :, :].reshape(-1, *one.shape), level[..., i, :, :].reshape(-1, *one.shape), strict=True
        )
        fields = torch.stack([field_windowed(p, t, made) for p, t in pairs])
        total = total + weight * (fields.real**2 + fields.imag**2)
    return torch.reshape(total, (*batch, *total.shape[1:]))
