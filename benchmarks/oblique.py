"""Cameras that look aside, through a hole before the lens or without one: images beside
every point's own plane waves.

A lens of 0.1 mm at 0.24 mm, a hole 60 um before it, samples of 9.6 um, depths of 3 to 9
mm; texture in depth. The judge
shares no code with the image: the source's wave on a fine lattice, through the hole and
the air to the lens, the lens's
phase by its formula, plane waves to the sensor, |U|² averaged twice over a sample, one
point after the other.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks import Row
from metalens.design import Focus
from metalens.field import Grid, Imager, Layers, SmoothWave, imager
from metalens.ground.arrays import Array
from metalens.image import Frames
from metalens.lens import Stop

DISTANCE, RADIUS, FOCUS, WAVELENGTH, GAP, MIDDLE = (
    240.0,
    50.0,
    6000.0,
    0.85,
    60.0,
    (3.0, -2.0),
)
STEP, WINDOW, FINE, COUNT = 9.6, 9, 0.4, 576
K = 2 * math.pi / WAVELENGTH


@dataclass(frozen=True, slots=True)
class Case:
    """hole_um: radius, 0 for none. angle_deg: of the middle of the image along x.
    shape: (y, x) samples.
    """

    hole_um: float
    angle_deg: float
    tolerance: float
    shape: tuple[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """(y, x) samples with the margin."""
        return self.shape[0] + WINDOW - 1, self.shape[1] + WINDOW - 1


CASES = (
    Case(0.0, 35.0, 0.05, (3, 5)),
    Case(0.0, 40.0, 0.05, (3, 5)),
    Case(0.0, 45.0, 0.05, (3, 5)),
    Case(25.0, 25.0, 0.05, (5, 5)),
    Case(40.0, 35.0, 0.02, (3, 5)),
    Case(40.0, 40.0, 0.02, (3, 5)),
    Case(40.0, 45.0, 0.05, (3, 5)),
    Case(30.0, 42.0, 0.05, (3, 5)),
)


def rows() -> Iterator[Row]:
    """Rows of this topic; half a minute each."""
    for case in CASES:
        begin = time.perf_counter()
        made = _made(case)
        seconds = time.perf_counter() - begin
        light, depth = _scene(case)
        want, got = _judged(case, light, depth), _imaged(made, light, depth)
        error = float(np.linalg.norm(got - want) / np.linalg.norm(want))
        named = f"hole of {case.hole_um:g} um" if case.hole_um else "no hole"
        said = f"said {made.error:.3f}, outside {made.parts['outside']:.2f}, light {got.sum() / want.sum():.3f}"
        what = f"{named}, {case.angle_deg:g} degrees, {case.shape[0]} x {case.shape[1]} samples"
        yield Row(
            what,
            f"image, tolerance {case.tolerance:g}",
            seconds,
            error,
            "own plane waves",
            goal=said,
        )


def _made(case: Case) -> Imager:
    layers = Layers(stop=Stop(case.hole_um, GAP, MIDDLE)) if case.hole_um else Layers()
    grid = Grid(case.shape, STEP, (3000.0, 9000.0), margin=WINDOW // 2, window=WINDOW)
    lens = SmoothWave(Focus(WAVELENGTH, DISTANCE, FOCUS), RADIUS)
    return imager(
        lens,
        grid,
        field=(math.radians(case.angle_deg), 0.0),
        tolerance=case.tolerance,
        layers=layers,
    )


def _scene(case: Case) -> tuple[Array, Array]:
    """(y, x) 1/f texture of mean 1 and depths that grow across it, um."""
    rows, columns = case.size
    f = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)) + 0.5 / rows
    rough = np.fft.ifft2(
        np.fft.fft2(np.random.default_rng(4).standard_normal(case.size)) / f
    ).real
    texture = np.clip(1 + 0.3 * (rough - rough.mean()) / rough.std(), 0.05, None)
    y, x = np.mgrid[0:rows, 0:columns]
    return texture, 1 / (
        1 / 8500 + (1 / 3400 - 1 / 8500) * (0.6 * y / rows + 0.4 * x / columns)
    )


def _imaged(made: Imager, light: Array, depth: Array) -> Array:
    cover = torch.tensor([0.0, 1.0]).reshape(1, 2, 1, 1).expand(1, 2, *light.shape)
    frames = Frames(
        cover * torch.from_numpy(light).float(),
        cover,
        torch.from_numpy(depth).float().expand_as(cover),
    )
    return np.asarray(made(frames)[0].double())


def _judged(case: Case, light: Array, depth: Array) -> Array:
    """(y, x) irradiance of the samples of an image: every point's own light, put down
    where it lies.
    """
    half, middle = WINDOW // 2, DISTANCE * math.tan(math.radians(case.angle_deg))
    out = np.zeros([n + 2 * half for n in light.shape])
    for i, j in np.ndindex(*light.shape):
        place = (
            middle + (j - (light.shape[1] - 1) / 2) * STEP,
            (i - (light.shape[0] - 1) / 2) * STEP,
        )
        out[i : i + WINDOW, j : j + WINDOW] += light[i, j] * _samples(
            _intensity(case, place, float(depth[i, j]))
        )
    y, x = (slice(2 * half, 2 * half + n) for n in case.shape)
    return out[y, x]


def _lattice() -> tuple[Array, Array]:
    axis = (np.arange(COUNT) - COUNT // 2) * FINE
    return axis, axis[:, None]


def _inside(radius_um: float, middle: tuple[float, float]) -> Array:
    """Share of each cell of the lattice inside a circle, by 5 x 5 points."""
    (x, y), off = _lattice(), (np.arange(5) - 2) / 5 * FINE
    return np.asarray(
        np.mean(
            [
                np.hypot(x - middle[0] + a, y - middle[1] + b) <= radius_um
                for a in off
                for b in off
            ],
            axis=0,
        )
    )


def _intensity(case: Case, place: tuple[float, float], depth_um: float) -> Array:
    """|U|² about a place of the sensor from a source in its direction, over the light
    on the hole or the lens, cos⁴.
    """
    x, y = _lattice()
    f = np.fft.fftfreq(COUNT, FINE)
    fx, fy = f, f[:, None]
    along = np.sqrt(np.maximum(1 - WAVELENGTH**2 * (fx**2 + fy**2), 0))
    sx, sy = (-p / DISTANCE * depth_um for p in place)
    far = np.sqrt((x - sx) ** 2 + (y - sy) ** 2 + depth_um**2)
    wave = np.exp(1j * K * (far - math.sqrt(sx**2 + sy**2 + depth_um**2)))
    lit, middle = math.pi * RADIUS**2, (0.0, 0.0)
    if case.hole_um:
        short, middle = depth_um - GAP, MIDDLE
        before = np.sqrt((x - sx) ** 2 + (y - sy) ** 2 + short**2)
        wave = (
            _inside(case.hole_um, MIDDLE)
            * np.exp(1j * K * (before - before[COUNT // 2, COUNT // 2]))
            / before
        )
        wave = (
            np.fft.ifft2(np.fft.fft2(wave) * np.exp(1j * K * along * GAP) * (along > 0))
            * far
        )
        lit = math.pi * (case.hole_um * depth_um / short) ** 2
    r2 = x**2 + y**2
    wave = (
        wave
        * _inside(RADIUS, (0.0, 0.0))
        * np.exp(-1j * K * (np.sqrt(r2 + DISTANCE**2) + np.sqrt(r2 + FOCUS**2)))
    )
    p, q, s = WAVELENGTH * fx, WAVELENGTH * fy, np.maximum(along, 1e-3)
    beside = np.hypot(
        DISTANCE * p / s - place[0], DISTANCE * q / s - place[1]
    )  # rays that would come in over an edge
    near = RADIUS + WINDOW * STEP / 2 + 4
    fade = (
        np.cos(np.clip((beside - near) / (COUNT * FINE - 2 * near), 0, 1) * math.pi / 2)
        ** 2
    )
    move = (
        np.exp(
            1j * K * along * DISTANCE + 2j * math.pi * (fx * place[0] + fy * place[1])
        )
        * (along > 0)
        * fade
    )
    out = np.fft.fftshift(np.fft.ifft2(np.fft.fft2(np.fft.ifftshift(wave)) * move))
    slopes = [
        (m - a) / (depth_um - (GAP if case.hole_um else 0.0))
        for m, a in zip(middle, (sx, sy), strict=True)
    ]
    return np.asarray(
        np.abs(out) ** 2 * FINE**2 / lit / (1 + slopes[0] ** 2 + slopes[1] ** 2) ** 2
    )


def _samples(fine: Array) -> Array:
    """(window, window) light on samples from a square source as large as they."""
    keep = np.sinc(np.fft.fftfreq(COUNT, FINE) * STEP) ** 2
    smooth = (
        np.fft.ifft2(np.fft.fft2(fine) * keep[:, None] * keep).real * (STEP / FINE) ** 2
    )
    at = COUNT // 2 + round(STEP / FINE) * (np.arange(WINDOW) - WINDOW // 2)
    return np.asarray(smooth[np.ix_(at, at)])
