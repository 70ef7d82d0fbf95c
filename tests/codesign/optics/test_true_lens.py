"""A lens plane by its pillars averaged over cells, and images of a device with one
cause left out, by hand.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.optics import true_lens
from codesign.optics.true_lens import ImagingDevice, PillarCells
from metalens.cell import Cell
from metalens.design import Focus, profiles
from metalens.field import Grid, SmoothWave, imager
from metalens.lens import DiameterMap, Lens
from metalens.pillars import Proxy

DRAW = torch.Generator().manual_seed(12)
FOCUS = Focus(0.85, 210.0, 900.0)


def test_cells_are_means_of_the_pillars_that_stand_in_them():
    """7 x 11 sites in blocks of three, spare sites half before and half after; a cell
    without pillars has those of its
    neighbours, for what lies at its edge."""
    level = torch.rand(7, 11, generator=DRAW) + 0.2
    light = torch.polar(level, 6.28 * torch.rand(7, 11, generator=DRAW))
    stands = torch.rand(7, 11, generator=DRAW) > 0.3
    stands[0:2, 8:11] = False  # of the upper right cell
    layers = torch.stack([light.real * stands, light.imag * stands, stands.float()])
    found = true_lens._averaged(layers, 3)
    assert found.shape == (2, 3, 4)
    padded = np.zeros((2, 9, 12), complex)
    padded[0, 1:8, :11], padded[1, 1:8, :11] = (light * stands).numpy(), stands.numpy()
    total = padded.reshape(2, 3, 3, 4, 3).sum((2, 4))
    for row in range(3):
        for column in range(4):
            some = total[:, row, column]
            if some[1] == 0:
                some = total[
                    :, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2
                ].sum((1, 2))
            want = some[0] / some[1]
            assert complex(*found[:, row, column].tolist()) == pytest.approx(
                want, abs=1e-6
            )
    assert total[1, 0, 3] == 0


def lens(phase, level, pitch_um=0.4):
    rows, columns = phase.shape
    axes = [(np.arange(n) - (n - 1) / 2) * pitch_um for n in (rows, columns)]
    sizes = SimpleNamespace(
        pitch_um=pitch_um, radius_um=7.0, y_um=axes[0], x_um=axes[1]
    )
    return SimpleNamespace(
        diameters=sizes, wavelength_um=0.85, sensor_distance_um=210.0, source_distance_um=900.0,
        layers=FOCUS.layers, neighbours=None,
    )  # fmt: skip


@pytest.mark.parametrize("rows", [5, 256])
def test_pillars_of_the_ideal_phase_and_a_ramp_are_the_ramp(monkeypatch, rows):
    """t = 0.7 exp(i (ideal + 0.013 x - 0.02 y)): cells of 6 pillars of 0.4 um shrink it
    by the sines of half a cell.
    """
    monkeypatch.setattr(true_lens, "ROWS", rows)
    y, x = (
        (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * 0.4 for n in (36, 30)
    )
    ideal = SmoothWave(FOCUS, 7.2).carrier_rad(x, y[:, None])
    phase = torch.remainder(ideal + 0.013 * x - 0.02 * y[:, None], 2 * math.pi).float()
    made = true_lens.gather_lens_plane(
        lens(phase, None), phase, torch.full((36, 30), 0.7), window_um=20.0
    )
    assert (made.radius_um, made.half_um) == (7.2, pytest.approx((6.0, 7.2)))
    at_x, at_y = (
        torch.tensor([[2.4, -2.4, 0.0]], dtype=torch.float64),
        torch.tensor([[3.6, -1.2, 1.2]], dtype=torch.float64),
    )
    want = 0.7 * torch.exp(1j * (0.013 * at_x - 0.02 * at_y))
    off = 0.7 * ((0.013 * 2.4) ** 2 + (0.02 * 2.4) ** 2) / 24
    assert (
        made.factor(at_x, at_y, 0.85, 0.0) - want
    ).abs().max() < off + 1e-5  # single precision of phases of 1e3


def test_a_bent_wave_front_turns_the_cells_about_their_middle():
    cells = torch.rand(2, 4, 6, generator=DRAW)
    sites = torch.polar(
        torch.full((4, 5), 0.9), 6.28 * torch.rand(4, 5, generator=DRAW)
    )
    about = FOCUS, 9.0, cells, (9.0, 6.0), 0.4, lambda: sites
    plain = PillarCells(*about, centre_um=(1.5, -0.5))
    x = (
        torch.tensor([[-7.5, 4.5]], dtype=torch.float64) + 1.5
    )  # middles of cells 3 um apart
    y = torch.tensor([[-4.5, 1.5]], dtype=torch.float64) - 0.5
    want = torch.complex(cells[0, [0, 2], [0, 4]], cells[1, [0, 2], [0, 4]])
    assert torch.allclose(plain.factor(x, y, 0.85, 0.0)[0], want, atol=1e-5)
    bent = PillarCells(
        *about, (1.5, -0.5), added_rad=lambda x, y: 0.3 * x - 0.11 * x * y
    )
    turned = want * torch.exp(1j * (0.3 * x - 0.11 * x * y)[0])
    assert torch.allclose(
        bent.factor(x, y, 0.85, 0.0)[0], turned.to(torch.complex64), atol=1e-5
    )
    assert torch.equal(plain.answer(0.85, 0.0), sites)
    at = (
        (np.arange(5) - 2) * 0.4,
        (np.arange(4)[:, None] - 1.5) * 0.4,
    )  # pillars stand about the axis
    bend = np.exp(1j * (0.3 * at[0] - 0.11 * at[0] * at[1]))
    assert np.allclose(
        bent.answer(0.85, 0.0), sites.numpy() * bend, atol=1e-5
    )  # single precision


@pytest.mark.parametrize("count", [48, 51])
def test_what_cells_leave_out_is_told_of_given_pillars_as_of_a_lens_file(count):
    """Eight sizes of pillars, whose cells 51 of them do not fill; over cells that the
    window asks for, not 2.5 um.
    """
    x = (np.arange(count) - (count - 1) / 2) * 0.4
    wanted = np.remainder(
        profiles.hyperbolic_phase(x, x[:, None], FOCUS) + 1.0, 2 * math.pi
    )
    size = np.where(
        np.hypot(x, x[:, None]) < 9.7, 0.12 + 0.2 * np.round(wanted / 6.2832 * 8) / 8, 0
    )
    proxy = Proxy(
        np.array([[3.0, math.pi]]),
        np.array([[0.9, -0.05]]),
        (0.12, 0.32),
        (0.85, 0.85),
        1e-6,
        1e-6,
    )
    made = Lens(
        DiameterMap(size, 0.4),
        Cell(pitch_um=0.4),
        proxy,
        0.85,
        210.0,
        900.0,
        "hyperbolic",
    )
    grid = Grid((4, 5), 4.8, (8e2, 1e3), window=21)
    maps = (
        torch.from_numpy(part).float()
        for part in (made.phase_rad(), made.transmission())
    )
    wave = true_lens.gather_lens_plane(made, *maps, window_um=21 * 4.8)
    want = imager(made, grid, tolerance=0.2).parts["pillars"]
    assert want > 1e-3
    found = imager(wave, grid, distance_um=210.0, tolerance=0.2).parts["pillars"]
    assert found == pytest.approx(
        want, rel=1e-3
    )  # the same sums, of phases in single precision


def test_one_psf_is_that_of_the_middle_and_even_light_that_of_the_mean(monkeypatch):
    monkeypatch.setattr(
        true_lens,
        "with_psfs",
        lambda whole, stack, energy: SimpleNamespace(stack=stack, energy=energy),
    )
    whole = SimpleNamespace(
        stack=torch.rand(3, 5, 2, 4, 4, generator=DRAW),
        energy=torch.rand(3, 5, generator=DRAW),
    )
    made = ImagingDevice(None, None, 210.0, whole, 0.03)
    one, even = made.one_psf(), made.evenly_lit()
    assert torch.equal(one.energy, whole.energy)
    assert torch.equal(even.stack, whole.stack)
    assert all(
        torch.equal(one.stack[a, b], whole.stack[1, 2])
        for a in range(3)
        for b in range(5)
    )
    assert even.energy.flatten().tolist() == pytest.approx(
        [float(whole.energy.sum()) / 15] * 15
    )
    moved = SimpleNamespace(stack=whole.stack + 0.2 * one.stack)
    size = float((one.stack**2).sum() / (whole.stack**2).sum()) ** 0.5
    assert true_lens.image_difference(moved, whole) == pytest.approx(
        0.2 * size, rel=1e-5
    )


def test_hats_are_straight_between_their_places():
    axis = torch.linspace(-4.0, 8.0, 5)
    wanted = torch.tensor([-4.0, -2.5, 0.5, 7.9, 8.0])
    weights = true_lens._hats(wanted, axis)
    assert weights.sum(1).tolist() == pytest.approx([1.0] * 5)
    assert (weights @ (2 * axis + 1)).tolist() == pytest.approx(
        (2 * wanted + 1).tolist(), rel=1e-6
    )
    assert true_lens._few(torch.linspace(-4.0, 8.0, 9)).tolist() == [
        -4.0,
        -1.0,
        2.0,
        5.0,
        8.0,
    ]
    assert true_lens._few(torch.linspace(-4.0, 8.0, 3)).tolist() == [-4.0, 2.0, 8.0]
