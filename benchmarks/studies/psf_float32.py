"""Error estimates of PSFs on random cases in single and in double precision: how many
lie below the error.

Lenses, pupils and screens of any pitch, wavelength and numerical aperture; windows on
their light, beside it, tiny,
wider than the lens, and as wide as Fourier transforms take them; sources from the side.
The referee is the plain sum
over pillars (:mod:`benchmarks.peers.plain_sum`), which shares no code with the engine,
of the very maps that the
engine got: at every sample of a window, or at ``POINTS`` of them drawn by their light,
its root and evenly.

``python -m benchmarks psf_float32`` draws 500 cases; ``python -m benchmarks.studies.psf_float32
N [SEED]`` so many.
"""

import math
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchmarks import Row
from benchmarks.peers import plain_sum
from metalens import psf
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError

COUNT, SEED, POINTS = 500, 4127, 600
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
KINDS = {
    "on its light": 0.14,
    "beside the light": 0.2,
    "tiny windows": 0.1,
    "few pillars": 0.1,
    "large aperture": 0.1,
    "light from the side": 0.1,
    "window wider than the lens": 0.06,
    "lens of 160 to 260 pillars": 0.06,
    "wide windows": 0.08,
    "wide windows beside the light": 0.06,
}
UNPULLED = (
    "window wider than the lens",
    "lens of 160 to 260 pillars",
    "wide windows",
)  # without gradients
STEEPER = {
    "wide windows": 0.5,
    "wide windows beside the light": 0.4,
    "light from the side": 3,
}  # angles, times


@dataclass(frozen=True, eq=False, slots=True)
class Drawn:
    """phase_rad, level: (y, x) float32 maps, so that both precisions get the same;
    about: arguments of
    :func:`metalens.psf.psf_stack`; kind: one of ``KINDS``."""

    phase_rad: Array
    level: Array
    about: dict[str, Any]
    tolerance: float
    kind: str


def drawn(rng: np.random.Generator) -> Drawn:
    """One case of a kind drawn by its share."""
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    pitch, wavelength = rng.uniform(0.2, 0.7), rng.uniform(0.45, 1.6)
    shape = tuple(int(n) for n in rng.integers(*_pillars(kind), 2))
    half = max(max(shape) - 1, 1) / 2 * pitch
    distance = half * rng.uniform(2, 12)
    source = half * 10 ** rng.uniform(1, 3)
    if kind == "large aperture":
        distance = half * rng.uniform(0.3, 2)
    if kind.startswith("wide"):
        distance = half * rng.uniform(2.5, 4.5)  # no rays too steep for the transforms
    depths = np.sort(source * 10 ** rng.uniform(-0.3, 0.3, rng.integers(1, 4)))
    if rng.random() < 0.1:
        depths[-1] = np.inf
    phase, level = _maps(rng, shape, (pitch, wavelength, distance, source))
    about = {
        "pitch_um": pitch,
        "wavelength_um": wavelength,
        "sensor_distance_um": distance,
        "depths_um": depths,
        "angle_rad": tuple(rng.uniform(-0.4, 0.4, 2) * STEEPER.get(kind, 1)),
        **_window(rng, kind, half, wavelength),
    }
    wrapped = np.remainder(phase + np.pi, 2 * np.pi) - np.pi
    return Drawn(
        wrapped.astype("f4"),
        level.astype("f4"),
        about,
        float(rng.choice(TOLERANCES)),
        kind,
    )


def _pillars(kind: str) -> tuple[int, int]:
    """Least and most along an axis."""
    if kind == "few pillars":
        return 1, 9
    if kind.startswith("wide"):
        return 140, 240
    return (160, 260) if kind.startswith("lens") else (12, 64)


def _maps(
    rng: np.random.Generator, shape: tuple[int, ...], of: tuple[float, ...]
) -> tuple[Array, Array]:
    """Phase and transmission of a lens, one with errors, a screen of chance, or one
    that is tilted and out of focus.
    """
    pitch, wavelength, distance, source = of
    y, x = ((np.arange(n) - (n - 1) / 2) * pitch for n in shape)
    half, r2 = max(y[-1], x[-1], pitch / 2), x**2 + y[:, None] ** 2
    phase = (
        -2 * np.pi / wavelength * (np.sqrt(r2 + distance**2) + np.sqrt(r2 + source**2))
    )
    kind = rng.integers(4)
    if kind == 1:
        phase = phase + rng.normal(0, rng.uniform(0.05, 1), shape)
    if kind == 2:
        phase = rng.uniform(-np.pi, np.pi, shape)
    if kind == 3:
        phase = rng.uniform(-20, 20) * x / half + rng.uniform(-9, 9) * r2 / half**2
    rim = half if min(shape) > 8 else math.inf
    return phase, (r2 <= rim**2) * rng.uniform(rng.uniform(0, 1), 1, shape)


def _window(
    rng: np.random.Generator, kind: str, half: float, wavelength: float
) -> dict[str, Any]:
    """Where it lies and how large it is."""
    samples = int(rng.integers(2, 25))
    width = half * 10 ** rng.uniform(-2, 0)
    away = 0.5 * width * rng.uniform(-1, 1, 2)
    if kind == "tiny windows":
        samples = int(rng.integers(2, 5))
        width = wavelength * 10 ** rng.uniform(-2, 0.3)
        away = rng.uniform(-1, 1, 2) * half * rng.choice([0.05, 1.0])
    if kind == "window wider than the lens":
        width = 2 * half * rng.uniform(1, 4)
        samples = int(rng.integers(8, 64))
    if kind.startswith("lens"):
        width = half * rng.uniform(0.1, 1)
        samples = int(rng.integers(24, 80))
    if kind.startswith("wide"):
        width = wavelength * rng.uniform(200, 300)
        samples = int(width / (wavelength * rng.uniform(1, 2)))
    if kind.endswith("beside the light"):
        away = (
            rng.uniform(-1, 1, 2)
            * half
            * rng.uniform(0.5, 1.5 if kind.startswith("wide") else 3)
        )
    return {"window_um": width, "samples": samples, "offset_um": tuple(away)}


def judged(
    case: Drawn, dtypes: tuple[torch.dtype, ...]
) -> list[tuple[float, float, str, bool]]:
    """(estimate, true relative error, method, whether the estimate is above the
    tolerance) in every precision.
    """
    found: list[tuple[float, float, str, bool]] = []
    drawing = np.random.default_rng(9)
    points: Any = None
    chance: Any = None
    want: Any = None
    for dtype in dtypes:
        maps = [torch.tensor(one, dtype=dtype) for one in (case.phase_rad, case.level)]
        maps[0].requires_grad_(
            case.kind not in UNPULLED
        )  # the exact sum, which has no derivatives, is not chosen
        stack = psf.psf_stack(
            *maps, tolerance=case.tolerance, integrate=False, **case.about
        ).numpy()
        light = np.asarray(stack.intensity, float).reshape(len(stack.depths_um), -1)
        if points is None:
            points, chance = _points(light, drawing)
            want = _plain(case, stack, points)
        raw = (
            light[:, points]
            * (np.asarray(stack.energy_um2, float) / stack.step_um**2)[:, None]
        )
        energy = np.asarray(stack.energy_um2, float)[:, None] / stack.step_um**2
        wrong = (raw - want) / energy
        wrong = wrong - light[:, points] * (wrong / chance).sum(1, keepdims=True)
        true = math.sqrt((wrong**2 / chance).sum() / (light**2).sum())
        found.append(
            (stack.error, true, stack.reason.split(":")[0], not stack.converged)
        )
    return found


def _points(light: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Flat samples of the window, and how often each is expected among them: all, or
    ``POINTS`` drawn by chance.
    """
    mean = (light / light.sum(1, keepdims=True)).mean(0)
    if len(mean) <= POINTS:
        return np.arange(len(mean)), np.ones(len(mean))
    chance = (mean + np.sqrt(mean) / np.sqrt(mean).sum() + 1 / len(mean)) / 3
    points = rng.choice(len(mean), POINTS, p=chance)
    return points, POINTS * chance[points]


def _plain(case: Drawn, stack: psf.PsfStack, points: Array) -> Array:
    """(depth, point) light by the plain sum at flat samples of the window."""
    y, x = np.divmod(points, len(stack.x_um))
    about = {
        name: v
        for name, v in case.about.items()
        if name not in ("window_um", "samples", "offset_um")
    }
    tangents = np.tan(case.about["angle_rad"])
    where = case.about["sensor_distance_um"] * tangents + np.array(
        case.about["offset_um"]
    )
    step = case.about["window_um"] / case.about["samples"]
    middle = (case.about["samples"] - 1) / 2
    at = where + step * (np.stack([x, y], -1) - middle)
    return np.asarray(plain_sum.light((case.phase_rad, case.level), at, **about))


def study(count: int, seed: int) -> list[Row]:
    """Both precisions on the same cases."""
    rng = np.random.default_rng(seed)
    dtypes = (torch.float32, torch.float64)
    found: list[tuple[str, list[tuple[float, float, str, bool]]]] = []
    refused, start = 0, time.perf_counter()
    while len(found) < count:
        case = drawn(rng)
        try:
            found.append((case.kind, judged(case, dtypes)))
        except PropagationError:
            refused += 1
    seconds = (time.perf_counter() - start) / count
    about = seed, refused, seconds
    return [
        _row(found, i, str(dtype).removeprefix("torch."), about)
        for i, dtype in enumerate(dtypes)
    ]


def _row(found: list[Any], i: int, dtype: str, about: tuple[int, int, float]) -> Row:
    """One precision, and under its name the worst of every kind."""
    seed, refused, seconds = about
    ratios = np.array([results[i][1] / results[i][0] for _, results in found])
    kinds = np.array([kind for kind, _ in found])
    wide = sum(results[i][2].startswith("wide") for _, results in found)
    above = sum(results[i][3] for _, results in found)
    parts = [
        f"{kind} {int((ratios[kinds == kind] > 1).sum())} of {int((kinds == kind).sum())} (largest "
        f"{ratios[kinds == kind].max():.2f})"
        for kind in KINDS
        if (kinds == kind).any()
    ]
    text = f"{int((ratios > 1).sum())} of {len(ratios)} estimates below the error: {', '.join(parts)}; median estimate "
    text += f"{1 / float(np.median(ratios)):.1f} errors, {wide} by Fourier transforms, {refused} more refused"
    text += f", {above} above the tolerance"
    return Row(
        case=f"PSFs at random, {dtype}, seed {seed}: {text}",
        method="windowed",
        seconds=seconds,
        error=float(ratios.max()),
        against="largest error over estimate, plain sum",
        goal=f"at most {len(found) // 100} below the error",
    )


def rows(count: int = COUNT, seed: int = SEED) -> list[Row]:
    """Single and double precision."""
    return study(count, seed)


if __name__ == "__main__":
    from benchmarks.__main__ import table

    sys.stdout.write(table(rows(*(int(word) for word in sys.argv[1:]))) + "\n")
