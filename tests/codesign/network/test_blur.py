"""The blur branch against Fourier transforms of cut-out windows, closed forms of depth
and blur, and its own count.
"""

import math

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from codesign.network import blur, losses, windows
from codesign.network.supernet import SlicedNorm


def _frames(count=2, size=64, seed=4):
    return torch.randn(
        count, 1, size, size, generator=torch.Generator().manual_seed(seed)
    )


def test_power_is_that_of_the_windows_own_fourier_transform():
    """The referee cuts the windows out and transforms them; a window of 16 pixels has
    just these frequencies.
    """
    frames = _frames()
    power, mean = windows.window_spectra(frames)
    weight = np.hanning(33)[1::2]  # sin² at the pixels' middles
    weight = np.outer(weight, weight) / (weight**2).sum()
    for row, column in ((0, 0), (2, 5), (6, 3)):
        cut = frames[1, 0, 8 * row : 8 * row + 16, 8 * column : 8 * column + 16].numpy()
        want = np.abs(np.fft.fft2(cut * weight)) ** 2
        for fx, fy in ((0, 3), (5, -2), (8, 7), (1, 0)):
            got = float(
                power[1, fx * windows.ROWS + fy + windows.WAVES - 1, row, column]
            )
            # float32 sums of 256 terms
            assert got == pytest.approx(want[fy, fx], rel=1e-4, abs=1e-5)
        assert float(mean[1, 0, row, column]) == pytest.approx(
            (cut * weight).sum() / weight.sum(), rel=1e-4, abs=1e-6
        )


def test_a_wave_looks_the_same_on_coarse_and_on_fine_pixels():
    """10 and 6.4 waves a frame along x and y: the same place and height of the peak on
    64 and on 96 pixels.

    A pixel samples the wave here, so the height differs by the number of pixels in a
    window alone: (96 / 64)².
    """
    found = []
    for size in (64, 96):
        place = (torch.arange(size, dtype=torch.float64) + 0.5) / size
        wave = torch.cos(2 * math.pi * (10 * place + 6.4 * place[:, None]))
        found.append(windows.window_spectra(wave[None, None].float())[0][0, :, 3, 4])
    assert int(found[0].argmax()) == int(found[1].argmax())
    top = int(found[0].argmax())
    assert float(found[1][top] / found[0][top]) == pytest.approx(
        (96 / 64) ** 2, rel=0.01
    )


def test_waves_beyond_nyquist_are_left_out_on_few_pixels():
    # 6 pixels a window: 3 periods and no more
    power, _ = windows.window_spectra(_frames(size=24))
    grid = power.reshape(2, windows.COLUMNS, windows.ROWS, blur.GRID, blur.GRID)
    assert bool((grid[:, :4, windows.WAVES - 1 - 3 : windows.WAVES + 3] > 0).all())
    assert not bool(grid[:, 4:].any())
    assert not bool(grid[:, :, : windows.WAVES - 1 - 3].any())


@pytest.mark.parametrize("size", [16, 63, 100])
def test_the_count_is_that_of_a_counted_pass(size):
    branch = blur.BlurBranch(SlicedNorm(blur.FEATURES), 24).eval()
    content = torch.zeros(1, 24, 16, 16)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        depth, features, axial = branch(_frames(1, size), content)
    layers = blur.blur_branch_macs(size) + blur.content_macs(24)
    # sums of slices: it counts them not
    assert counter.get_total_flops() // 2 == layers - windows.STEP_MACS
    assert axial.shape == (1,)
    assert depth.shape == (1, 2, blur.GRID, blur.GRID)
    assert features.shape == (1, blur.SLIP_FEATURES)


def test_windows_hold_the_vergence_under_them():
    depth = torch.full((1, 64, 96), 25e3)
    depth[:, :8] = (
        # the first 8 rows, which a quarter of the first row of windows' weight sees …
        # and no other
        12.5e3
    )
    got = blur.window_vergence(depth)
    assert got.shape == (1, blur.GRID, blur.GRID)
    far, near = (
        (1e3 / z - blur.VERGENCE_PER_M) / blur.VERGENCE_UNIT_PER_M for z in (25.0, 12.5)
    )
    assert torch.allclose(got[:, 1:], torch.full_like(got[:, 1:], far), atol=1e-5)
    # half of a symmetric weight
    assert float(got[0, 0, 2]) == pytest.approx((far + near) / 2, abs=1e-5)
    assert float(blur.depth_mm(torch.tensor(near))) == pytest.approx(12.5, rel=1e-6)


def test_depth_loss_is_least_at_the_truth_and_at_the_true_spread():
    """The mean of 0.5 e² / s² + log s over errors of spread S is least at s = S, where
    it is 0.5 + log S.
    """
    miss = 0.37 * torch.randn(200_000, 1, 1, generator=torch.Generator().manual_seed(2))
    truth = torch.full_like(miss, 1.3)

    def loss(spread, shift=0.0):
        told = torch.stack(
            [truth + miss + shift, torch.full_like(miss, math.log(spread))], 1
        )
        return float(losses.depth_loss(told, truth))

    # 2e5 draws: 0.0016
    assert loss(0.37) == pytest.approx(0.5 + math.log(0.37), abs=0.005)
    assert loss(0.37) < min(loss(0.3), loss(0.45), loss(0.37, 0.2))


def test_the_mask_is_scored_at_the_pixels_that_are_asked_for():
    """A disc of radius 0.2 of the frame: its logits on 16 cells agree with themselves,
    at 64 pixels with the disc.
    """

    def disc(size):
        place = (torch.arange(size) + 0.5) / size - 0.5
        return 0.2 - torch.hypot(place - 0.03, place[:, None] + 0.07)

    coarse, fine = 40 * disc(16)[None], (disc(64) > 0).float()[None]
    assert float(losses.mask_iou(coarse, fine)) > 0.9
    # a smooth edge is interpolated well within a cell
    assert float(losses.mask_iou(coarse, fine, pixels=64)) > 0.97
    # one cell of 16: of a disc of radius r, shifted by d: closed form
    shifted = 40 * torch.roll(disc(16), 1, 1)[None]
    r, d = 0.2, 1 / 16
    both = 2 * r**2 * math.acos(d / (2 * r)) - d / 2 * math.sqrt(4 * r**2 - d**2)
    want = both / (2 * math.pi * r**2 - both)
    assert float(losses.mask_iou(shifted, fine, pixels=64)) == pytest.approx(
        want, abs=0.02
    )  # pixels of the rim
