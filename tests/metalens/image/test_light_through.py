"""Light that windows leave out of an image: of what goes through the lens, not of what
pillars and faces keep.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from metalens import design
from metalens.cell import Cell, Film, Index
from metalens.design import Focus
from metalens.image import Grid, Optics, SmoothWave, Window, imager
from metalens.image.engine import normalise_psfs
from metalens.image.plan import Plan
from metalens.image.points import psfs
from metalens.image.through import aperture_transmission
from metalens.library import Proxy
from metalens.optics import Layers, Stop
from metalens.psf import SpectralNodes, View, from_lens

GLASS = Layers(behind=(Film(Index(1.7), 110.0),))
CELL = Cell(pitch_um=0.41, pillar=Index(3.6), substrate=Index(1.45))


def test_light_outside_is_that_of_the_psf_of_every_pillar():
    """Pillars that let 0.36 of the light through, glass that reflects 7 % of it: those
    were said to lie outside.
    """
    focus = Focus(0.85, 260.0, 1500.0, GLASS)
    phase = design.phase_of(None, focus, radius_um=55.0)
    proxy = Proxy(
        np.array([[0.3, 3 * math.pi]]),
        np.array([[0.6, 0.05]]),
        (0.08, 0.32),
        (0.85, 0.85),
        1e-6,
        1e-6,
    )
    lens = design.make(phase, focus, aperture_um=110.0, cell=CELL, proxy=proxy)[0]
    grid = Grid((12, 12), 2.0, (1450.0, 1560.0), 0, 21)
    made = imager(lens, grid, tolerance=0.05)
    view = View((1500.0,), ((0.0, 0.0),), 42.0, 84)
    stack = from_lens(lens, view, tolerance=1e-3)
    assert made.parts["outside"] == pytest.approx(
        stack.budget.outside, abs=0.012
    )  # sources of 2 um, field, depths
    assert 0.01 < stack.budget.outside < 0.1


def test_nothing_of_a_smooth_wave_is_lost_but_at_faces_and_the_stop():
    """On the axis a face passes 4 n / (n + 1)² (the sensor lies on the glass); all
    light of a hole before the lens
    falls on it, and what both have in common where its shadow lies on the rim."""
    at = torch.tensor([[0.0, 0.0]], dtype=torch.float64)
    about = dict(
        depths_um=torch.tensor([2e3, math.inf], dtype=torch.float64), wavelength_um=0.85
    )
    faces = 4 * 1.7 / 2.7**2
    wave = SmoothWave(Focus(0.85, 400.0, 2e3, GLASS), 45.0)
    window = Window(31, 2.0)
    found = aperture_transmission(
        Optics(wave, GLASS, 400.0), at, window=window, **about
    )
    # of oblique rays, sin 0.11: 1e-5
    assert found.numpy() == pytest.approx(np.full((1, 2), faces), rel=1e-4)
    hole = Layers(front=(Film(Index(1.5), 400.0),), stop=Stop(60.0, 400.0))
    smooth = SmoothWave(Focus(0.85, 400.0, 2e3, hole), 140.0)
    lost = 0.18 / (60.0**2 / (0.85 * 400 / 1.5))
    found = aperture_transmission(
        Optics(smooth, hole, 400.0), at, window=window, **about
    )
    assert found.numpy() == pytest.approx(np.ones((1, 2)), abs=0.005)  # of nodes, 6 um
    slope = math.tan(math.asin(1.5 * math.sin(math.atan(140 / 400))))
    aside = torch.tensor([[400 * slope, 0.0]], dtype=torch.float64)
    beside = float(
        aperture_transmission(
            Optics(smooth, hole, 400.0), aside, window=window, **about
        )[0, 1]
    )
    assert beside == pytest.approx(
        _common(60.0, 140.0) / (math.pi * 60.0**2), abs=2 * lost
    )
    light = psfs(Optics(smooth, hole, 400.0), aside, window=window, **about)[0, 1].sum()
    assert float(light) < beside


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
    at, depth = (
        torch.zeros(1, 2, dtype=torch.float64),
        torch.tensor([20e3], dtype=torch.float64),
    )
    window = Window(7, 9.6, period=period)
    light = psfs(
        Optics(wave, Layers(), 2200.0),
        at,
        depths_um=depth,
        wavelength_um=0.85,
        window=window,
    )
    p = 150.0 / math.hypot(150.0, 2200.0)
    x = (np.arange(640) + 0.5) * (
        4 * 9.6 / 640
    )  # a quarter of it, out to where the last sample ends
    shown = np.clip(4 - x / 9.6, 0, 1)  # Σ of the triangles
    v = 2 * math.pi / 0.85 * p * np.hypot(x, x[:, None])
    airy = math.pi * (p / 0.85) ** 2 * (2 * j1(v) / v) ** 2
    want = 4 * float(shown @ airy @ shown) * (x[1] - x[0]) ** 2
    assert float(light.sum()) / want == pytest.approx(1, abs=within)


def _common(r: float, big: float) -> float:
    """Area common to a circle of radius r whose centre lies on another one."""
    inner = r * r * math.acos(r / (2 * big)) + big**2 * math.acos(
        1 - r * r / (2 * big**2)
    )
    return inner - 0.5 * r * math.sqrt(4 * big**2 - r * r)


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
    x_um, depths = (
        torch.tensor([4.0, 400 * slope], dtype=torch.float64),
        torch.tensor([depth_um], dtype=torch.float64),
    )
    at = torch.stack([x_um, torch.zeros(2, dtype=torch.float64)], -1)
    light = aperture_transmission(
        optics, at, depths_um=depths, wavelength_um=0.85, window=Window(31, 2.0)
    )
    plan = Plan(
        torch.zeros(1),
        x_um,
        depths,
        SpectralNodes(np.array([0.85]), np.ones(1), 0.0),
        Window(31, 2.0),
        folds=False,
    )
    found = normalise_psfs(light[None, :, :, None, None], optics, plan)[1][0, :, 0]
    want = [_relative(t, depth_um, thick_um, n) for t in (0.01, slope)]
    assert float(found[1] / found[0]) == pytest.approx(
        want[1] / want[0], rel=6e-3
    )  # waves at the edge 0.18 / N, 3e-3
