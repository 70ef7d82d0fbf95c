"""Light on the nodes of a pupil against its formula, and wavelengths that share the
rays of a field point.
"""

import math

import numpy as np
import pytest
import torch

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.field import Layers, Optics, SmoothWave, Window, compiled, points, psfs
from metalens.field.plan import spectral
from metalens.field.rays import rays, source_paths
from metalens.field.texture import texture_error
from metalens.lens import Stop
from metalens.psf import SpectralNodes


def test_the_light_on_the_nodes_is_its_formula():
    """Polynomials of sine and cosine in float32: 2e-7 of the weight, times 3."""
    draw = np.random.default_rng(8)
    weight, turns = draw.uniform(0, 3, (7, 12)), draw.uniform(-40, 40, (7, 12))
    paths, mix = draw.uniform(-900, 900, (3, 7, 12)), draw.normal(size=(5, 3))
    want = weight * np.exp(2j * np.pi * (turns + np.tensordot(mix, paths, 1)))
    got = compiled.phasors(weight, turns, paths, mix)
    assert got.dtype == np.complex64
    assert np.abs(got - want).max() < 1.5e-6


@pytest.mark.parametrize("glass_um", [0.0, 130.0])
def test_paths_from_sources_are_those_of_rays_drawn_to_each_point(glass_um):
    """Fermat: of all points of the face between air and glass, the ray takes the one of
    the shortest path.
    """
    layers = Layers(front=(Film(Index(1.6), glass_um),))
    seen = rays(
        layers.after(240.0, 0.85), 50.0, (21.0, -13.0), (6, 0.06), torch.device("cpu")
    )
    tangents, depths = (
        torch.tensor([0.09, -0.05], dtype=torch.float64),
        np.linspace(700.0, 2100.0, 7),
    )
    got = source_paths(layers, tangents, seen, torch.tensor(depths), 0.85).um.numpy()
    x, y = seen.x_um.numpy(), seen.y_um.numpy()

    def path(depth, reach):
        """Shortest optical path over a lateral distance, by a fine search of the place
        on the face.
        """
        share = np.linspace(0, 1, 20_001)
        return (
            np.hypot(depth - glass_um, reach * share)
            + 1.6 * np.hypot(glass_um, reach * (1 - share))
        ).min()

    for d in (0, 3, 6):
        sine = math.hypot(*tangents) / math.sqrt(1 + float((tangents**2).sum()))
        inside = sine / math.sqrt(1.6**2 - sine**2)
        away = (depths[d] - glass_um) * math.hypot(*tangents) + glass_um * inside
        sx, sy = (-away * float(t) / math.hypot(*tangents) for t in tangents)
        for i, j in ((0, 0), (2, 5), (5, 1)):
            want = path(depths[d], math.hypot(x[i, j] - sx, y[i, j] - sy)) - path(
                depths[d], math.hypot(sx, sy)
            )
            assert got[d, i, j] == pytest.approx(
                want, abs=2e-5
            )  # the search: 1e-9 of a square; 5 nodes of 1/z: 1e-5


def test_wavelengths_that_share_their_rays_are_those_alone():
    """The nodes of the longer ones lie closer than alone: what folds back from outside
    the window changes, 1e-3.
    """
    optics = Optics(SmoothWave(Focus(0.85, 240.0, 6e3), 50.0), Layers(), 240.0)
    at, depths = (
        torch.tensor([[20.0, -31.0], [3.0, 8.0]], dtype=torch.float64),
        torch.tensor([3e3, 5e3, 9e3]).double(),
    )
    waves, window = (
        SpectralNodes(np.array([0.87, 0.83, 0.85]), np.array([0.3, 0.2, 0.5]), 0.0),
        Window(15, 4.8, curved=True),
    )
    got = spectral(optics, at, depths, waves, window)
    want = sum(
        weight * psfs(optics, at, depths_um=depths, wavelength_um=wave, window=window)
        for wave, weight in zip(
            waves.wavelengths_um.tolist(), waves.weights.tolist(), strict=True
        )
    )
    assert got.shape == (2, 3, 15, 15)
    assert float((got - want).norm() / want.norm()) < 2e-3


def test_field_points_are_the_same_on_any_number_of_threads():
    """Whatever thread forms a point, in the order asked for; 1e-5: transforms in single
    precision, and compiled.
    """
    optics, window = (
        Optics(SmoothWave(Focus(0.85, 240.0, 6e3), 50.0), Layers(), 240.0),
        Window(9, 4.8),
    )
    at, depths = (
        torch.tensor([[20.0, -31.0], [3.0, 8.0], [-40.0, 5.0], [9.0, 44.0]]).double(),
        torch.tensor([5e3]).double(),
    )
    waves = SpectralNodes(np.array([0.84, 0.85]), np.array([0.4, 0.6]), 0.0)
    before, found = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(spectral(optics, at, depths, waves, window))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)
    alone = torch.cat(
        [spectral(optics, place, depths, waves, window) for place in at.unsqueeze(1)]
    )
    for got in found:
        assert float((got - alone).norm() / alone.norm()) < 1e-5
    assert float((alone[0] - alone[3]).norm() / alone.norm()) > 0.05


def test_what_wraps_round_in_a_transform_is_nothing_of_the_sharpest_image(monkeypatch):
    """In focus on the axis the pupil's rims interfere most; against a transform in
    which nothing wraps.
    """
    optics, window = (
        Optics(SmoothWave(Focus(0.85, 240.0, 6e3), 50.0), Layers(), 240.0),
        Window(15, 9.0),
    )
    at, depth = (
        torch.zeros(1, 2, dtype=torch.float64),
        torch.tensor([6e3], dtype=torch.float64),
    )
    sizes, found = [], []
    for clear in (points.CLEAR, 1.0):
        monkeypatch.setattr(points, "CLEAR", clear)
        sizes.append(points.sampling(optics, window, 0.85).size)
        found.append(
            psfs(optics, at, depths_um=depth, wavelength_um=0.85, window=window)[0, 0]
        )
    assert sizes[0] < sizes[1]
    assert 0 < float(texture_error(*found)) < 3e-4


def test_a_sharp_rim_bends_light_beyond_the_window_by_its_aperture_and_the_window_s_width():
    """4√2 / (π² k p h): p = 50 / √(50² + 240²) of the rim, 0.4 of it behind a hole of
    20 um, h = 67.5 um.
    """
    wave, window = SmoothWave(Focus(0.85, 240.0, 6e3), 50.0), Window(15, 9.0)
    k, p = 2 * math.pi / 0.85, 50 / math.hypot(50, 240)
    want = 4 * math.sqrt(2) / (math.pi**2 * k * p * 67.5)
    for stop, share in ((None, 1.0), (Stop(20.0, 3.0), 0.4), (Stop(51.0, 3.0), 1.0)):
        found = points.sampling(Optics(wave, Layers(stop=stop), 240.0), window, 0.85)
        assert found.beyond == pytest.approx(want / share, rel=1e-12)
    assert (
        points.sampling(
            Optics(wave, Layers(stop=Stop(0.02, 3.0)), 240.0), window, 0.85
        ).beyond
        == 0.5
    )
