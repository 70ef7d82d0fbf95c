"""The Rayleigh-Sommerfeld sum over pillars in float64 in one medium, at points anywhere
on the sensor.

    U(X) = Σ_j T_j exp(iφ_j) exp(ik(s_j - s_0)) A d/(2πr²)(1/r - ik) exp(ikr),    r = |X - x_j|,

s_j from the source (-z tan a_x, -z tan a_y, -z) to pillar j, s_0 to the lens centre; z
infinite: a plane wave. Written
from this line alone; it shares no code with the engine that it judges.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

HELD = 2e6  # pillars times points at once


def light(
    maps: tuple[Any, Any],
    points_um: Any,
    *,
    pitch_um: float,
    wavelength_um: float,
    sensor_distance_um: float,
    depths_um: Any,
    angle_rad: Sequence[float] = (0.0, 0.0),
) -> Any:
    """(depth, point) |U|² at points (point, [x, y]) um from the lens axis.

    maps: phase in rad and transmission, (y, x) real; closed pillars are left out.
    """
    phase, level = (np.asarray(one, float) for one in maps)
    open_ = level != 0
    y, x = np.meshgrid(
        *((np.arange(n) - (n - 1) / 2) * pitch_um for n in phase.shape), indexing="ij"
    )
    x, y, k = x[open_], y[open_], 2 * np.pi / wavelength_um
    lit = [
        level[open_] * np.exp(1j * (phase[open_] + k * _longer(x, y, z, angle_rad)))
        for z in np.ravel(depths_um)
    ]
    pillars = torch.from_numpy(np.stack([x, y], -1))
    there = torch.from_numpy(np.asarray(points_um, float))
    given, d = torch.from_numpy(np.stack(lit, -1)), sensor_distance_um
    out = torch.empty((len(there), given.shape[1]), dtype=torch.complex128)
    step = max(1, int(HELD / len(pillars)))
    for start in range(0, len(there), step):
        away = there[start : start + step, None] - pillars
        r = torch.sqrt(away[..., 0] ** 2 + away[..., 1] ** 2 + d * d)
        size = pitch_um**2 * d / (2 * np.pi * r * r)
        kernel = torch.complex(size / r, -k * size) * torch.polar(
            torch.ones_like(r), k * r
        )
        out[start : start + step] = kernel @ given
    return (out.abs() ** 2).T.numpy()


def _longer(x: Any, y: Any, z: float, angle_rad: Sequence[float]) -> Any:
    """Path from the source to a pillar less that to the lens centre, um."""
    tx, ty = np.tan(angle_rad)
    if not np.isfinite(z):
        return (x * tx + y * ty) / np.sqrt(1 + tx * tx + ty * ty)
    far = z * np.sqrt(1 + tx * tx + ty * ty)
    return np.sqrt((x + z * tx) ** 2 + (y + z * ty) ** 2 + z * z) - far
