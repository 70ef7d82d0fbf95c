"""Light of a source that windows hold, and its relative illumination."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.image import Optics, SmoothWave, Window
from metalens.image.engine import normalise_psfs
from metalens.image.plan import ImagingPlan
from metalens.image.points import psfs
from metalens.optics import Layers, Stop
from metalens.psf import SpectralNodes


@pytest.mark.parametrize(
    ("period", "within"), [(1.06, 1.3e-2), (2.12, 3e-3), (4.24, 1e-3), (8.48, 5e-4)]
)
def test_a_window_holds_what_a_round_aperture_sends_there(period, within):
    """∫ (2 J1(v) / v)² π (p / λ)² over the samples' triangles, v = k p r: 0.965 of the
    light in a window of ten rings.

    What nodes lack falls with the square of their number, to the next power of p, 0.068
    at the rim: 2e-4. Counted by
    the squares of their weights the light was 5e-3, 4e-3 and 2e-3 too bright in the
    last three.
    """
    wave = SmoothWave(Focus(0.85, 2200.0, 20e3), 150.0)
    at = torch.zeros(1, 2, dtype=torch.float64)
    depth = torch.tensor([20e3], dtype=torch.float64)
    window = Window(7, 9.6, period=period)
    light = psfs(
        Optics(wave, Layers(), 2200.0),
        at,
        depths_um=depth,
        wavelength_um=0.85,
        window=window,
    )
    p = 150.0 / math.hypot(150.0, 2200.0)
    # a quarter of it, out to where the last sample ends
    x = (np.arange(640) + 0.5) * (4 * 9.6 / 640)
    shown = np.clip(4 - x / 9.6, 0, 1)  # Σ of the triangles
    v = 2 * math.pi / 0.85 * p * np.hypot(x, x[:, None])
    airy = math.pi * (p / 0.85) ** 2 * (2 * j1(v) / v) ** 2
    want = 4 * float(shown @ airy @ shown) * (x[1] - x[0]) ** 2
    assert float(light.sum()) / want == pytest.approx(1, abs=within)


def _relative(slope: float, depth_um: float, thick_um: float, n: float) -> float:
    """Irradiance at the middle of a hole before a glass plate from a sample's piece of
    a plane of even radiance, up to
    a factor. The piece is what the slope's square takes of the plane, seen from behind
    the plate by Snell's law."""
    gap, step = depth_um - thick_um, 1e-4

    def place(t: float) -> float:
        sine = t / math.hypot(1, t)
        return gap * t + thick_um * sine / math.sqrt(n * n - sine * sine)

    s = place(slope)
    wide = s / slope * (place(slope + step) - place(slope - step)) / (2 * step)
    return wide * gap**2 / (s * s + gap**2) ** 2


@pytest.mark.parametrize(
    ("depth_um", "thick_um", "n"),
    [(900.0, 140.0, 1.5), (700.0, 160.0, 1.0), (2500.0, 300.0, 1.8)],
)
def test_relative_illumination_is_that_of_light_on_the_stop(
    depth_um: float, thick_um: float, n: float
) -> None:
    """By the angle at the lens it was 26 % too large at 25 degrees, 700 um before the
    lens, 540 um before the stop.
    """
    front = (Film(Index(n), thick_um),) if n > 1 else ()
    layers = Layers(front=front, stop=Stop(70.0, thick_um))
    optics = Optics(SmoothWave(Focus(0.85, 400.0, 2e3, layers), 300.0), layers, 400.0)
    slope = math.tan(math.radians(25))
    x_um = torch.tensor([4.0, 400 * slope], dtype=torch.float64)
    depths = torch.tensor([depth_um], dtype=torch.float64)
    at = torch.stack([x_um, torch.zeros(2, dtype=torch.float64)], -1)
    window = Window(81, 4.0)
    light = psfs(optics, at, depths_um=depths, wavelength_um=0.85, window=window)
    plan = ImagingPlan(
        torch.zeros(1),
        x_um,
        depths,
        SpectralNodes(np.array([0.85]), np.ones(1), 0.0),
        window,
    )
    found = normalise_psfs(light[None], optics, plan)[1][0, :, 0]
    want = [_relative(t, depth_um, thick_um, n) for t in (0.01, slope)]
    # waves at the edge 0.18 / N, 3e-3
    assert float(found[1] / found[0]) == pytest.approx(want[1] / want[0], rel=6e-3)
