"""Losses of reading and their weights, and the waves of the blur's windows, number by
number.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from codesign.network import losses, windows

RNG = np.random.default_rng(21)
SLIP, TRUTH = RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3))
SPREADS = RNG.uniform(-1.5, 1.0, (4, 3))
SCALE = np.array([1.4, 1.2, 2.3])


def found(**more):
    known = {
        "slip": torch.from_numpy(SLIP),
        "slip_log_sd": torch.from_numpy(SPREADS),
        "depth": None,
    }
    return SimpleNamespace(**known | more)


def likelihood(miss, spread):
    return (miss**2 / 2 * np.exp(-2 * spread) + spread).mean()


def test_spreads_are_taught_by_the_errors_that_there_are_and_teach_nothing_else():
    slip, spread = (
        torch.from_numpy(SLIP).requires_grad_(),
        torch.from_numpy(SPREADS).requires_grad_(),
    )
    loss = losses.uncertainty_loss(
        found(slip=slip, slip_log_sd=spread), torch.from_numpy(TRUTH)
    )
    assert float(loss.detach()) == pytest.approx(
        likelihood(SLIP - TRUTH, SPREADS), rel=1e-12
    )
    loss.backward()
    assert slip.grad is None
    want = (1 - (SLIP - TRUTH) ** 2 * np.exp(-2 * SPREADS)) / 12
    assert spread.grad.numpy() == pytest.approx(want, rel=1e-9)
    assert (
        float(losses.uncertainty_loss(found(slip_log_sd=None), torch.from_numpy(TRUTH)))
        == 0
    )


def test_the_depth_of_windows_is_half_of_their_likelihood_and_the_spread_a_tenth():
    told, truth = RNG.normal(0, 0.5, (4, 2, 7, 7)), RNG.normal(0, 1, (4, 7, 7))
    depth = likelihood(told[:, 0] - truth, told[:, 1])
    assert float(
        losses.depth_loss(torch.from_numpy(told), torch.from_numpy(truth))
    ) == pytest.approx(depth, rel=1e-12)
    given = (
        torch.from_numpy(truth),
        torch.from_numpy(TRUTH * SCALE),
        torch.from_numpy(SCALE),
    )
    spread = likelihood(SLIP - TRUTH, SPREADS)
    got = losses.depth_reading_loss(
        found(depth=torch.from_numpy(told)), *given, depth_weight=0.5
    )
    assert float(got) == pytest.approx(0.5 * depth + 0.1 * spread, rel=1e-12)
    got = losses.depth_reading_loss(
        found(depth=torch.from_numpy(told)), *given, depth_weight=1.7
    )
    assert float(got) == pytest.approx(1.7 * depth + 0.1 * spread, rel=1e-12)
    assert float(
        losses.depth_reading_loss(found(), *given, depth_weight=0.5)
    ) == pytest.approx(0.1 * spread, rel=1e-12)


def test_slippage_is_squared_to_three_tenths_of_its_scale_and_linear_beyond():
    off = np.abs(SLIP - TRUTH)
    for knee in (0.3, 0.9):
        want = np.where(off < knee, off**2 / (2 * knee), off - knee / 2).mean()
        got = losses.slip_loss(
            torch.from_numpy(SLIP),
            torch.from_numpy(TRUTH * SCALE),
            torch.from_numpy(SCALE),
            knee=knee,
        )
        assert float(got) == pytest.approx(want, rel=1e-9)
    plain = losses.slip_loss(
        torch.from_numpy(SLIP), torch.from_numpy(TRUTH * SCALE), torch.from_numpy(SCALE)
    )
    assert float(plain) == pytest.approx(
        np.where(off < 0.3, off**2 / 0.6, off - 0.15).mean(), rel=1e-9
    )


def test_a_task_is_its_mask_and_twice_its_slippage():
    """Dice 1 - (2 Σpm + 1) / (Σp + Σm + 1) and cross entropy on the mask's pixels,
    between the middles of logits.
    """

    def seen(logits, mask):
        p = 1 / (1 + np.exp(-logits))
        dice = (
            1
            - (2 * (p * mask).sum((1, 2)) + 1) / (p.sum((1, 2)) + mask.sum((1, 2)) + 1)
        ).mean()
        return dice - (mask * np.log(p) + (1 - mask) * np.log(1 - p)).mean()

    logits, mask = RNG.normal(0, 2, (4, 5, 6)), RNG.uniform(0, 1, (4, 5, 6))
    off = np.abs(SLIP - TRUTH)
    slip = np.where(off < 0.3, off**2 / 0.6, off - 0.15).mean()
    given = (
        torch.from_numpy(mask),
        torch.from_numpy(TRUTH * SCALE),
        torch.from_numpy(SCALE),
    )
    got = losses.task_loss(
        found(mask_logits=torch.from_numpy(logits)), *given, slip_weight=2.0
    )
    assert float(got) == pytest.approx(seen(logits, mask) + 2 * slip, rel=1e-9)
    fine = RNG.uniform(0, 1, (4, 15, 12))
    y, x = np.meshgrid(
        (np.arange(15) + 0.5) / 3 - 0.5, (np.arange(12) + 0.5) / 2 - 0.5, indexing="ij"
    )
    drawn = np.stack(
        [map_coordinates(one, [y, x], order=1, mode="nearest") for one in logits]
    )
    got = losses.task_loss(
        found(mask_logits=torch.from_numpy(logits)),
        torch.from_numpy(fine),
        *given[1:],
        slip_weight=0.7,
    )
    assert float(got) == pytest.approx(seen(drawn, fine) + 0.7 * slip, rel=1e-9)


def test_a_network_without_a_mask_is_held_to_the_centroid():
    """Units of 2 % of the frame, linear beyond 0.3 of them; frames without a pupil
    count for nothing.
    """
    mask = RNG.uniform(0, 1, (4, 5, 8))
    mask[2] = 0
    centre = RNG.uniform(-0.1, 0.1, (4, 2))
    y, x = (np.arange(5) + 0.5) / 5 - 0.5, (np.arange(8) + 0.5) / 8 - 0.5
    each = []
    for one, m in zip(np.delete(centre, 2, 0), np.delete(mask, 2, 0), strict=True):
        truth = np.array([(m.sum(0) * x).sum(), (m.sum(1) * y).sum()]) / m.sum()
        off = np.abs(one - truth) / 0.02
        each.append(np.where(off < 0.3, off**2 / 0.6, off - 0.15).mean())
    got = losses.position_loss(torch.from_numpy(centre), torch.from_numpy(mask))
    assert float(got) == pytest.approx(np.mean(each), rel=1e-9)
    given = (
        torch.from_numpy(mask),
        torch.from_numpy(TRUTH * SCALE),
        torch.from_numpy(SCALE),
    )
    whole = found(mask_logits=torch.zeros(4, 0, 0), centre=torch.from_numpy(centre))
    slip = float(losses.slip_loss(whole.slip, *given[1:]))
    assert float(losses.task_loss(whole, *given, slip_weight=2.0)) == pytest.approx(
        np.mean(each) + 2 * slip, rel=1e-9
    )
    dim = torch.from_numpy(
        mask * 0.45 / mask.sum((1, 2)).clip(1e-9)[:, None, None]
    )  # less than half a pixel each
    assert float(losses.position_loss(torch.from_numpy(centre), dim)) == 0


def test_masks_are_averaged_over_cells_and_interpolated_between_them():
    """Blocks of 2 x 3; on 6 x 6 pixels logits and a coarse mask are straight between
    the middles of cells.
    """
    mask, like = (
        torch.from_numpy(RNG.uniform(0, 1, (2, 6, 9))),
        torch.from_numpy(RNG.normal(size=(2, 3, 3))),
    )
    blocks = mask.numpy().reshape(2, 3, 2, 3, 3).mean((2, 4))
    assert losses.resize_mask(mask, like).numpy() == pytest.approx(blocks)
    assert losses.resize_mask(mask, torch.zeros(2, 6, 9)) is mask
    logits, seen = losses.at_pixels(like, mask[:, :2, :3], 6)
    three = mask[:, :2, :3].numpy()
    two = np.stack(
        [three[..., :2].mean(-1), three[..., 1:].mean(-1)], -1
    )  # as many columns as rows, of 1.5 cells
    for got, given in ((logits, like.numpy()), (seen, two)):
        n = given.shape[-1]
        y, x = np.meshgrid(*[(np.arange(6) + 0.5) * n / 6 - 0.5] * 2, indexing="ij")
        want = np.stack(
            [map_coordinates(one, [y, x], order=1, mode="nearest") for one in given]
        )
        assert got.numpy() == pytest.approx(want, rel=1e-6)


@pytest.mark.parametrize("wide", [1.3, 0.7, 2.0])
def test_a_frame_holds_the_share_of_its_cells_that_the_mask_covers(wide):
    """Cells of 0.7, 1.3 or 2 of the mask's about one middle: each the integral of the
    mask over it, by fine points.
    """
    mask, fine = RNG.uniform(0, 1, (2, 5, 5)), 2000
    place = np.floor(((np.arange(5 * fine) + 0.5) / fine - 2.5) * wide + 2.5).astype(
        int
    )
    inside = (place >= 0) & (place < 5)
    share = np.zeros((5, 5))
    np.add.at(share, (np.repeat(np.arange(5), fine)[inside], place[inside]), 1 / fine)
    got = losses.mask_in_frame(torch.from_numpy(mask), wide).numpy()
    assert got == pytest.approx(
        share @ mask @ share.T, abs=2e-3
    )  # half a point at each of some edges


def test_masks_overlap_by_what_both_hold():
    """Threshold 0 of logits and a half of coverage: 2 of 4 pixels, none of 3, nothing
    at all, and no mask.
    """
    logits = torch.tensor(
        [
            [[3.0, 0.1, 2.0], [-1, -2, -0.1]],
            [[1.0, 1, -1], [-1, -1, -1]],
            [[-1.0] * 3] * 2,
        ]
    )
    mask = torch.tensor(
        [
            [[0.9, 0.51, 0.4], [0.6, 0.2, 0.1]],
            [[0.1, 0.0, 0.8], [0.3, 0.3, 0.3]],
            [[0.5] * 3] * 2,
        ]
    )
    assert losses.mask_iou(logits, mask).tolist() == pytest.approx([2 / 4, 0.0, 1.0])
    assert losses.mask_iou(
        logits[:1], mask[1:2] * 0 + (logits[:1] == 0.1)
    ).tolist() == pytest.approx([1 / 3])
    assert losses.mask_iou(logits[2:], mask[1:2]).tolist() == [
        0.0
    ]  # one pixel missed is not nothing at all
    told = losses.mask_iou(torch.zeros(3, 0, 0), mask)
    assert told.shape == (3,)
    assert torch.isnan(told).all()


def test_a_pose_needs_both_and_one_landmark_counts_whole():
    axis, points = torch.zeros(1, 3), torch.tensor([[[0.1, 0.2], [0.7, 0.0]]])
    told = points + torch.tensor([0.1, 0.0])
    one = losses.pose_loss(
        found(points=told, axis=axis), axis, points, axis_weight=1.0, point_weight=3.0
    )
    assert float(one) == pytest.approx(
        3.0 * (2.0 - 0.05) / 2, rel=1e-6
    )  # the second lies outside
    for part in ({"points": told, "axis": None}, {"points": None, "axis": axis}):
        assert (
            float(
                losses.pose_loss(
                    found(**part), axis, points, axis_weight=1.0, point_weight=3.0
                )
            )
            == 0
        )


@pytest.mark.parametrize("size", [64, 61])
def test_windows_are_read_by_waves_under_a_hann_weight(size):
    """The power at a window and frequency pair by the sum in the module's heading, over
    Σw²; beyond Nyquist nothing.
    """
    frames = RNG.normal(size=(2, 1, size, size))
    power, mean = windows.window_spectra(torch.from_numpy(frames))
    step, margin = size // 8, (size - 8 * (size // 8)) // 2
    weight = np.sin(np.pi * (np.arange(2 * step) + 0.5) / (2 * step)) ** 2
    w = np.outer(weight, weight)
    period = size / 4
    for i, j, fx, fy in (
        (0, 0, 0, 0),
        (2, 5, 3, -2),
        (6, 1, 8, 5),
        (3, 3, 1, 8),
        (4, 2, 0, -7),
    ):
        part = frames[
            1,
            0,
            margin + i * step : margin + (i + 2) * step,
            margin + j * step : margin + (j + 2) * step,
        ]
        place = np.arange(2 * step) + 0.5
        wave = np.exp(2j * np.pi / period * (fx * place[None, :] + fy * place[:, None]))
        seen = (
            0.0
            if max(fx, abs(fy)) / period > 0.5
            else abs((w * wave * part).sum()) ** 2 / (w**2).sum()
        )
        got = float(power[1, fx * 16 + fy + 7, i, j])
        assert got == pytest.approx(seen, rel=1e-4, abs=1e-6)  # float32 filters
    part = frames[
        0, 0, margin + 2 * step : margin + 4 * step, margin + step : margin + 3 * step
    ]
    assert float(mean[0, 0, 2, 1]) == pytest.approx(
        (w * part).sum() / w.sum(), rel=1e-3, abs=1e-6
    )
    assert math.isclose(float(power.shape[1]), 9 * 16)
