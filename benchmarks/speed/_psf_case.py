"""The lens of 1 mm whose PSFs are timed, and what judges them.

2500 x 2500 pillars, 850 nm, sensor at 2 mm. Errors are relative L2 of the intensity
against the exact
Rayleigh-Sommerfeld sum in float64, on a sample of points of three depths; gradients
against float64 at a tolerance of
1e-9.
"""

import ctypes
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from metalens import propagate, psf
from metalens.propagate.estimate import draw_pixels, sampled_square_error

PITCH, WAVELENGTH, D, SOURCE, RADIUS = 0.4, 0.85, 2000.0, 20e3, 500.0
K = 2 * np.pi / WAVELENGTH
DEPTHS = np.linspace(16e3, 26e3, 21)
GEOMETRY = dict(pitch_um=PITCH, wavelength_um=WAVELENGTH, sensor_distance_um=D)
WINDOW = dict(window_um=48.0, samples=64)


def lens(kind: str, n: int = 2500) -> tuple[torch.Tensor, torch.Tensor]:
    """(phase, transmission) float32 of an n x n lens with the focal lengths of the 1 mm
    lens.
    """
    random = np.random.default_rng(7)
    x = (np.arange(n) - (n - 1) / 2) * PITCH
    r2 = x**2 + x[:, None] ** 2
    phase = -K * (
        r2 / (np.sqrt(r2 + D**2) + D) + r2 / (np.sqrt(r2 + SOURCE**2) + SOURCE)
    )
    level = (r2 <= (n * PITCH / 2) ** 2).astype("f4")
    if kind == "free-form":
        for _ in range(40):
            turn = random.uniform(0, 2 * np.pi)
            length = random.uniform(60, 500)
            start = random.uniform(0, 2 * np.pi)
            along = np.cos(turn) * x + np.sin(turn) * x[:, None]
            phase += 0.6 * random.normal() * np.cos(2 * np.pi / length * along + start)
    if kind == "noisy":
        phase += random.normal(0, 0.3, phase.shape)
        level *= random.uniform(0.7, 1, phase.shape).astype("f4")
    if kind == "double helix":
        zone = np.clip(np.ceil(r2 / RADIUS**2 * 7), 1, 7)
        phase += (2 * zone - 1) * np.arctan2(x[:, None], x)
    turns = phase / (2 * np.pi)
    return torch.tensor(
        (turns - np.rint(turns)) * 2 * np.pi, dtype=torch.float32
    ), torch.tensor(level)


def error(
    stack: psf.PsfStack, maps: tuple[torch.Tensor, torch.Tensor], row: int = 0
) -> float:
    """Relative L2 of the normalised PSFs against the exact sum, at three depths of one
    direction.

    From the exact sum at a systematic sample of 64 points.
    """
    plain = stack.numpy()
    pick = [0, len(plain.depths_um) // 2, len(plain.depths_um) - 1]
    light = np.asarray(plain.intensity, float).reshape(
        len(plain.angles_rad), -1, *plain.intensity.shape[-2:]
    )[row, pick]
    energy = np.asarray(plain.energy_um2, float).reshape(len(plain.angles_rad), -1)[
        row, pick
    ]
    flat = light.reshape(len(pick), -1)
    points, chance = draw_pixels(flat.mean(0), 64)
    want = np.stack([exact(maps, plain, (z, row), points) for z in pick])
    sampled = flat[:, points]
    difference = want * (plain.step_um**2 / energy)[:, None] - sampled
    square = sampled_square_error(sampled, chance, difference)
    return math.sqrt(square / (flat**2).sum())


def exact(
    maps: tuple[torch.Tensor, torch.Tensor],
    stack: psf.PsfStack,
    at: tuple[int, int],
    points: np.ndarray,
) -> np.ndarray:
    """(point,) exact intensity at flat window indices, for (depth, angle) indices
    ``at``.
    """
    depth, row = at
    case = propagate.make_case(
        maps[0].shape,
        **GEOMETRY,
        depths_um=stack.depths_um[depth],
        angle_rad=stack.angles_rad[row],
        window_um=stack.step_um,
        samples=1,
    )
    y, x = np.divmod(points, len(stack.x_um))
    where = np.stack(
        [
            stack.centres_um[row, 0] + stack.x_um[x],
            stack.centres_um[row, 1] + stack.y_um[y],
        ],
        -1,
    )
    return (
        np.abs(propagate.field_at(maps[0].numpy(), maps[1].numpy(), case, where)[0])
        ** 2
    )


def forward(maps: Any, **arguments: Any) -> psf.PsfStack:
    """PSF stack with the benchmark's geometry."""
    return psf.psf_stack(
        *maps, **GEOMETRY | dict(depths_um=DEPTHS) | WINDOW | arguments
    )


def gradient(maps: Any, **arguments: Any) -> torch.Tensor:
    """Gradient to every pillar's phase of a merit function without symmetry."""
    phase = maps[0].detach().requires_grad_()  # shares memory with the map
    stack = forward((phase, maps[1]), **arguments)
    shape = stack.intensity.shape
    weight = torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(
        stack.intensity
    )
    (stack.intensity * weight).sum().backward()
    return phase.grad


def peak_mb(work: Callable[[], object]) -> float:
    """Highest memory of the process during ``work`` above what it held before (Linux;
    nan elsewhere).
    """
    status = Path("/proc/self/status")
    reset = Path("/proc/self/clear_refs")
    if not reset.exists():
        return math.nan
    ctypes.CDLL(None).malloc_trim(
        0
    )  # what was freed before must not hide what the work takes
    reset.write_text("5")
    before = _status(status, "VmRSS")
    work()
    return _status(status, "VmHWM") - before


def _status(path: Path, key: str) -> float:
    found = re.search(rf"{key}:\s+(\d+) kB", path.read_text())
    return float(found.group(1)) / 1024 if found else math.nan


def gradient_error(maps: Any, tolerance: float) -> float:
    """Relative L2 of the gradient against float64 at 1e-9."""
    want = gradient(tuple(m.double() for m in maps), tolerance=1e-9)
    return float((gradient(maps, tolerance=tolerance) - want).norm() / want.norm())


def textbook(maps: Any, h: torch.Tensor, *, grad: bool) -> torch.Tensor:
    """One depth by zero-padded complex64 angular spectrum, source phase included; with
    the gradient if asked.
    """
    phase = maps[0].clone().requires_grad_(grad)
    light = torch.polar(maps[1], phase)
    field = torch.fft.ifft2(torch.fft.fft2(light, s=h.shape) * h)
    n = maps[0].shape[0] // 2
    power = field[n - 60 : n + 60, n - 60 : n + 60].abs() ** 2
    power = power / power.sum()
    if grad:
        (power**2).sum().backward()
    return power.detach()
