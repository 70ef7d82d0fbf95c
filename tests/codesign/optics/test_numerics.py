"""A lens as places in a table of diameters; PSFs that differ by a known share; a line
of a few wavelengths.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.optics import numerics
from codesign.optics.numerics import ImageWindow, TabulatedLens
from metalens.image.scene import PsfBasis
from metalens.lens import DiameterMap
from metalens.psf import Source, spectrum


class Line:
    domain_um = (0.1, 0.27)

    def phase_rad(self, d, wavelength):
        return 9.0 * d * wavelength

    def transmission(self, d, wavelength):
        return 0.9 - d


DIAMETER = np.array(
    [[0.0, 0.12, 0.18, 0.21], [0.24, 0.18, 0.0, 0.15], [0.3, 0.12, 0.27, 0.18]]
)
LENS = SimpleNamespace(
    diameters=DiameterMap(DIAMETER, 0.4), proxy=Line(), wavelength_um=0.8, source_distance_um=900.0,
    sensor_distance_um=70.0,
)  # fmt: skip


def table_of(aperture):
    """A t that tells its diameter."""
    return (0.3 + aperture.diameter_um) * np.exp(1j * 5 * aperture.diameter_um)


def test_every_pillar_finds_its_diameter_in_the_table():
    aperture = TabulatedLens(LENS)
    assert aperture.diameter_um[[0, -1]] == pytest.approx([0.12 - 0.012, 0.3 + 0.012])
    assert aperture.step_um == pytest.approx((0.18 + 0.024) / 8191)
    there = DIAMETER > 0
    assert (
        np.abs(aperture.diameter_um[aperture.place[there]] - DIAMETER[there]).max()
        <= aperture.step_um / 2
    )
    assert (aperture.place[~there] == -1).all()
    assert aperture.share.sum() == pytest.approx(1)
    assert aperture.share[aperture.place[1, 1]] == pytest.approx(
        3 / 10
    )  # of ten pillars, three are 0.18 um wide
    wide = SimpleNamespace(
        **{
            **vars(LENS),
            "diameters": DiameterMap(np.where(DIAMETER == 0.3, 0.395, DIAMETER), 0.4),
        }
    )
    assert TabulatedLens(wide).diameter_um[-1] == pytest.approx(
        0.999 * 0.4
    )  # no wider than the pitch


def test_maps_take_phase_and_level_of_the_changed_diameter():
    aperture = TabulatedLens(LENS)
    phase, level = aperture.maps(table_of(aperture))
    there = DIAMETER > 0
    assert level.numpy()[there] == pytest.approx(0.3 + DIAMETER[there], abs=2e-5)
    assert phase.numpy()[there] == pytest.approx(5 * DIAMETER[there], abs=1e-4)
    assert not level.numpy()[~there].any()
    bias = np.linspace(-0.02, 0.02, 12).reshape(3, 4)
    _, biased = aperture.maps(table_of(aperture), bias_um=bias)
    want = np.clip(DIAMETER + bias, *aperture.diameter_um[[0, -1]])
    assert biased.numpy()[there] == pytest.approx(0.3 + want[there], abs=4e-5)
    assert not biased.numpy()[~there].any()


def test_a_table_of_rounded_diameters_stands_in_steps():
    aperture = TabulatedLens(LENS)
    made = aperture.rounded(table_of(aperture), 0.01)
    want = np.clip(
        np.rint(aperture.diameter_um / 0.01) * 0.01, *aperture.diameter_um[[0, -1]]
    )
    assert np.abs(made) == pytest.approx(0.3 + want, abs=1e-5)
    assert np.angle(made) == pytest.approx(5 * want, abs=1e-5)


def test_the_designed_table_is_the_proxys_and_holds_at_its_ends():
    aperture = TabulatedLens(LENS)
    inside = np.clip(aperture.diameter_um, 0.1, 0.27)
    assert aperture.designed() == pytest.approx(
        (0.9 - inside) * np.exp(7.2j * inside), rel=1e-12
    )


def test_light_is_turned_by_both_sides():
    """From 900 um in front to 70 um behind: the sines add up; nothing in front of a
    collimated beam.
    """
    sine = TabulatedLens(LENS).turn_sine()
    r = 0.4 * math.hypot(1.5, 1.0)  # the corner of 3 x 4 sites
    assert sine[0, 0] == pytest.approx(
        r / math.hypot(r, 70) + r / math.hypot(r, 900), rel=1e-9
    )
    far = SimpleNamespace(**{**vars(LENS), "source_distance_um": math.inf})
    assert TabulatedLens(far).turn_sine()[0, 0] == pytest.approx(
        r / math.hypot(r, 70), rel=1e-9
    )


def test_depths_are_even_in_their_inverse():
    depths = ImageWindow(15e3, 40e3).depths_um(6)
    assert depths[[0, -1]] == pytest.approx([15e3, 40e3])
    assert np.diff(1 / depths) == pytest.approx(np.full(5, (1 / 40e3 - 1 / 15e3) / 5))


def test_a_line_is_few_wavelengths_of_the_diode():
    one = numerics.spectral_line_nodes(LENS, 0.0, 5)
    assert (one.wavelengths_um.tolist(), one.weights.tolist()) == ([0.8], [1.0])
    assert numerics.spectral_line_nodes(LENS, 30.0, 1).wavelengths_um.tolist() == [0.8]
    three = numerics.spectral_line_nodes(LENS, 30.0, 3)
    um, share = spectrum.spectral_weight(Source(800.0, 30.0))
    for power in range(6):  # Gauss: moments to 2 n - 1
        assert three.weights @ (three.wavelengths_um - 0.8) ** power == pytest.approx(
            share @ (um - 0.8) ** power, abs=1e-12
        )


def test_bases_that_differ_by_a_picture_differ_by_its_length():
    """PSFs 0.8 a + 0.6 b beside a: relative to the second, mean over depths between the
    nodes.
    """
    a, b = torch.zeros(2, 1, 3, 5, dtype=torch.float64)
    a[0, 1, 2], b[0, 0, 4] = 1.0, 1.0
    depths = torch.tensor([15e3, 40e3], dtype=torch.float64)
    kernels = torch.cat([a, b])

    def made(near, far):
        weights = torch.tensor([near, far], dtype=torch.float64).reshape(1, 1, 2, 2)
        return PsfBasis(kernels, weights, depths, 0.0, 0.0)

    window = ImageWindow(15e3, 40e3)
    found = numerics.psf_difference(
        made((0.8, 0.6), (0.8, 0.6)), made((1.0, 0.0), (1.0, 0.0)), window
    )
    assert found == pytest.approx(math.hypot(0.2, 0.6), rel=1e-9)
    found = numerics.psf_difference(
        made((2.0, 0.0), (2.0, 1.0)), made((2.0, 0.0), (2.0, 0.0)), window, depths=9
    )
    share = np.linspace(0, 1, 9)  # of the far node, in 1/z
    assert found == pytest.approx(
        math.sqrt(np.mean((share / 2) ** 2)), rel=1e-3
    )  # steps of the table
