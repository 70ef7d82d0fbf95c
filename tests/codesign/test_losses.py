"""Losses: closed values at the ends, finite on empty masks, gradients by finite differences."""

import pytest
import torch

from codesign import losses


def _mask(batch=2):
    mask = torch.zeros(batch, 16, 16, dtype=torch.float64)
    mask[:, 4:9, 6:12] = 1
    return mask


def test_dice_is_zero_for_the_right_mask_and_nearly_one_for_its_complement():
    mask = _mask()
    assert float(losses.dice(200 * (mask - 0.5), mask)) < 1e-12
    wrong = float(losses.dice(-200 * (mask - 0.5), mask))
    assert wrong == pytest.approx(1 - 1 / (16 * 16 + 1), abs=1e-9)  # no overlap: only the smoothing is left


def test_all_blink_batch_is_finite_with_finite_gradient():
    logits = torch.zeros(3, 16, 16, requires_grad=True)
    loss = losses.segmentation(logits, torch.zeros(3, 16, 16))
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(logits.grad).all()
    assert float(losses.overlap(torch.full((3, 16, 16), -9.0), torch.zeros(3, 16, 16)).min()) == 1


def test_gradients_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 8, 8, generator=generator, dtype=torch.float64, requires_grad=True)
    slip = torch.randn(2, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    scale = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    truth = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    mask = _mask()
    assert torch.autograd.gradcheck(lambda a: losses.segmentation(a, mask), (logits,))
    assert torch.autograd.gradcheck(lambda s: losses.slip(s, truth, scale), (slip,))


def test_budget_acts_only_beyond_it():
    macs = torch.tensor(90.0, requires_grad=True)
    losses.over_budget(macs, 100.0).backward()
    assert float(macs.grad) == 0
    assert float(losses.over_budget(torch.tensor(150.0), 100.0)) == pytest.approx(0.5)


def test_overlap_of_half_a_mask():
    mask = torch.zeros(1, 8, 8)
    mask[:, :4] = 1
    logits = torch.full((1, 8, 8), -1.0)
    logits[:, :2] = 1
    assert float(losses.overlap(logits, mask)[0]) == pytest.approx(0.5)
