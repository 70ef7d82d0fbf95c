"""Error estimates of PSFs on random cases, dim and tiny windows among them: how many lie below the error.

``python -m benchmarks psf_float32`` draws 500 cases in single and in double precision; ``python -m
benchmarks.psf_float32 N [SEED]`` so many. The referee is the exact sum in double precision of the very maps that the
engine got.
"""

import math
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchmarks import Row
from metalens import propagate, psf
from metalens.ground.arrays import Array
from metalens.ground.errors import PropagationError

COUNT, SEED = 500, 4127
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)


@dataclass(frozen=True, eq=False, slots=True)
class Drawn:
    """phase_rad, level: (y, x) maps; about: arguments of :func:`metalens.psf.psf_stack`; tolerance; windows beside the
    light: ``dim``."""

    phase_rad: Array
    level: Array
    about: dict[str, Any]
    tolerance: float
    dim: bool


def drawn(rng: np.random.Generator) -> Drawn:
    """A small lens, pupil or screen of any wavelength and pitch, and a window on its light or beside it."""
    pitch, wavelength = rng.uniform(0.2, 0.7), rng.uniform(0.45, 1.6)
    shape = tuple(int(n) for n in rng.integers(12, 64, 2))
    y, x = ((np.arange(n) - (n - 1) / 2) * pitch for n in shape)
    half = max(y[-1], x[-1])
    distance, source = half * rng.uniform(2, 12), half * 10 ** rng.uniform(1, 3)
    r2 = x**2 + y[:, None] ** 2
    phase = -2 * np.pi / wavelength * (np.sqrt(r2 + distance**2) + np.sqrt(r2 + source**2))
    kind = rng.integers(4)
    if kind == 1:
        phase = phase + rng.normal(0, rng.uniform(0.05, 1), shape)
    if kind == 2:
        phase = rng.uniform(-np.pi, np.pi, shape)
    if kind == 3:
        phase = rng.uniform(-20, 20) * x / half + rng.uniform(-9, 9) * r2 / half**2
    level = (r2 <= half**2) * rng.uniform(rng.uniform(0, 1), 1, shape)
    samples, width = int(rng.integers(1, 25)), half * 10 ** rng.uniform(-2, 0)
    dim = bool(rng.random() < 0.4)
    away = rng.uniform(-1, 1, 2) * (half * rng.uniform(0.5, 3) if dim else 0.5 * width)
    about = {
        "pitch_um": pitch,
        "wavelength_um": wavelength,
        "sensor_distance_um": distance,
        "depths_um": np.sort(source * 10 ** rng.uniform(-0.3, 0.3, rng.integers(1, 4))),
        "angle_rad": tuple(rng.uniform(-0.4, 0.4, 2)),
        "window_um": width,
        "samples": samples,
        "offset_um": tuple(away),
    }
    wrapped = np.remainder(phase + np.pi, 2 * np.pi) - np.pi
    return Drawn(wrapped, level, about, float(rng.choice(TOLERANCES)), dim)


def judged(case: Drawn, dtype: torch.dtype) -> tuple[float, float]:
    """(estimate, true relative error) of the windowed method."""
    phase, level = (torch.tensor(a, dtype=dtype) for a in (case.phase_rad, case.level))
    phase.requires_grad_()  # so that the exact sum, which has no derivatives, is not chosen
    stack = psf.psf_stack(phase, level, tolerance=case.tolerance, integrate=False, **case.about)
    want = np.abs(propagate.exact(phase.detach().double().numpy(), level.double().numpy(), **case.about)) ** 2
    want = want / want.sum((-1, -2), keepdims=True)
    got = stack.intensity.detach().double().numpy()
    return stack.error, float(np.linalg.norm(got - want) / np.linalg.norm(want))


def study(count: int, seed: int, dtype: torch.dtype) -> Row:
    """One precision."""
    rng = np.random.default_rng(seed)
    ratios, dim, refused, seconds = [], [], 0, 0.0
    for case in (drawn(rng) for _ in range(count)):
        start = time.perf_counter()
        try:
            estimate, error = judged(case, dtype)
        except PropagationError:
            refused += 1
            continue
        finally:
            seconds += time.perf_counter() - start
        ratios.append(error / estimate)
        dim.append(case.dim)
    below = np.array(ratios) > 1
    text = f"{int(below.sum())} of {len(ratios)} estimates below the error ({int(below[np.array(dim)].sum())} of "
    text += (
        f"{sum(dim)} beside the light), median estimate {1 / float(np.median(ratios)):.1f} errors, {refused} refused"
    )
    return Row(
        case=f"PSFs at random, {str(dtype).removeprefix('torch.')}, seed {seed}: {text}",
        method="windowed",
        seconds=seconds / count,
        error=max(ratios, default=math.inf),
        against="largest error over estimate, exact sum",
        goal=f"at most {count // 100} below the error",
    )


def rows(count: int = COUNT, seed: int = SEED) -> list[Row]:
    """Single and double precision."""
    return [study(count, seed, dtype) for dtype in (torch.float32, torch.float64)]


if __name__ == "__main__":
    from benchmarks.__main__ import table

    sys.stdout.write(table(rows(*(int(word) for word in sys.argv[1:]))) + "\n")
