"""Losses: closed values at the ends, finite on empty masks, gradients by finite
differences.
"""

import math

import pytest
import torch

from codesign.network import losses


def _mask(batch=2):
    mask = torch.zeros(batch, 16, 16, dtype=torch.float64)
    mask[:, 4:9, 6:12] = 1
    return mask


def test_dice_is_zero_for_the_right_mask_and_nearly_one_for_its_complement():
    mask = _mask()
    assert float(losses.dice_loss(200 * (mask - 0.5), mask)) < 1e-12
    wrong = float(losses.dice_loss(-200 * (mask - 0.5), mask))
    # no overlap: only the smoothing is left
    assert wrong == pytest.approx(1 - 1 / (16 * 16 + 1), abs=1e-9)


def test_all_blink_batch_is_finite_with_finite_gradient():
    logits = torch.zeros(3, 16, 16, requires_grad=True)
    loss = losses.segmentation_loss(logits, torch.zeros(3, 16, 16))
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(logits.grad).all()
    assert (
        float(
            losses.mask_iou(torch.full((3, 16, 16), -9.0), torch.zeros(3, 16, 16)).min()
        )
        == 1
    )


def test_gradients_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(
        2, 8, 8, generator=generator, dtype=torch.float64, requires_grad=True
    )
    slip = torch.randn(
        2, 3, generator=generator, dtype=torch.float64, requires_grad=True
    )
    scale = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    truth = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    mask = _mask()
    assert torch.autograd.gradcheck(
        lambda a: losses.segmentation_loss(a, mask), (logits,)
    )
    assert torch.autograd.gradcheck(
        lambda s: losses.slip_loss(s, truth, scale), (slip,)
    )


def test_budget_acts_only_beyond_it():
    macs = torch.tensor(90.0, requires_grad=True)
    losses.over_budget(macs, 100.0).backward()
    assert float(macs.grad) == 0
    assert float(losses.over_budget(torch.tensor(150.0), 100.0)) == pytest.approx(0.5)


def test_slip_is_counted_in_units_of_its_scale():
    """Off by 0.1 and 0.5 units: half the square over the knee below it, straight
    beyond; no scale is 1.
    """
    truth = torch.tensor([[0.8, -2.1, 3.3]])
    scale = torch.tensor([0.4, 0.7, 3.0])
    predicted = truth / scale + torch.tensor([[0.1, 0.0, -0.5]])
    want = (0.1**2 / 2 / 0.3 + (0.5 - 0.3 / 2)) / 3
    assert float(losses.slip_loss(predicted, truth, scale)) == pytest.approx(
        want, rel=1e-5
    )


def test_dice_of_a_half_covered_mask_in_closed_form():
    logits = torch.full((1, 4, 6), 0.0, dtype=torch.float64)  # one half everywhere
    mask = torch.zeros(1, 4, 6, dtype=torch.float64)
    mask[0, :, :2] = 1
    assert float(losses.dice_loss(logits, mask, smooth=3.0)) == pytest.approx(
        1 - (2 * 4 + 3) / (12 + 8 + 3), rel=1e-12
    )


def test_masks_are_held_to_the_finer_grid_of_the_two():
    """An edge at a third of a cell: no logit of that cell costs less than the entropy
    of a third; on pixels it can.
    """
    mask = torch.zeros(1, 12, 12, dtype=torch.float64)
    mask[0, :, :7] = 1  # cells of three pixels: the third holds one of them
    # 0 at x = 7 pixels
    steep = 30 * (7 / 3 - 0.5 - torch.arange(4, dtype=torch.float64)).expand(1, 4, 4)
    assert float(losses.segmentation_loss(steep, mask)) < 0.1
    entropy = (math.log(3) + 2 * math.log(3 / 2)) / 3 / 4  # of one column of four
    assert (
        float(losses.segmentation_loss(steep, torch.nn.functional.avg_pool2d(mask, 3)))
        > entropy
        > 0.15
    )


def test_landmarks_in_the_image_and_the_axis_are_held_to_in_their_units():
    """Off by 0.002 of the image (under the knee of 0.005), by 0.1 (beyond), outside; by
    0.01 and 0.2 of the axis.
    """
    from codesign.network.supernet import NetworkPrediction

    points = torch.tensor([[[0.1, -0.4], [0.2, 0.3], [0.1, 0.51]]])
    axis = torch.tensor([[0.2, -0.7, -0.66]])
    told = points + torch.tensor([[[0.002, 0.0], [0.0, 0.1], [3.0, 3.0]]])
    turned = axis + torch.tensor([[0.01, 0.0, -0.2]])
    found = NetworkPrediction(
        *(torch.zeros(1) for _ in range(5)), points=told, axis=turned
    )
    # two coordinates, two points inside
    seen = (0.04**2 / 2 / 0.1 + (2.0 - 0.05)) / 2 / 2
    looked = (0.1**2 / 2 / 0.3 + (2.0 - 0.15)) / 3
    got = losses.pose_loss(found, axis, points, axis_weight=0.7, point_weight=3.0)
    assert float(got) == pytest.approx(0.7 * looked + 3.0 * seen, rel=1e-5)
    away = losses.pose_loss(found, axis, points + 2, axis_weight=0.0, point_weight=3.0)
    assert float(away) == 0  # no landmark in the image: finite
