"""Numbers of a finished run, from answers that are typed in."""

import math
from types import SimpleNamespace

import pytest
import torch

from codesign.train import finish


def test_errors_of_slippage_are_means_over_frames_of_each_axis():
    truth = torch.tensor([[0.1, 0.5, 1.0], [0.2, -0.3, 2.0], [0.0, 0.0, -1.0]])
    off = torch.tensor([[0.3, -0.2, 0.7], [-0.6, 0.1, 0.2], [0.0, 0.9, -1.5]])
    answers = SimpleNamespace(slip_mm=truth + off, iou=torch.tensor([0.9, 0.4, 0.8]))
    got = finish._errors("dim_", answers, SimpleNamespace(slip_mm=truth))
    assert got["dim_axial_slip_mm"] == pytest.approx(0.8)
    assert got["dim_lateral_slip_mm"] == pytest.approx((0.3 + 0.4) / 2)
    assert got["dim_iou"] == pytest.approx(0.7)
    blind = SimpleNamespace(slip_mm=truth, iou=torch.tensor([math.nan]))
    assert finish._errors("", blind, SimpleNamespace(slip_mm=truth))["iou"] is None


def typed(off, sd, **more):
    slip = torch.zeros(len(off), 3, dtype=torch.float64)
    slip[:, 2] = torch.tensor(off, dtype=torch.float64)
    slip[:, :2] = 7.0  # what is told is of the axis alone
    width = None if sd is None else torch.full((len(off), 3), 99.0, dtype=torch.float64)
    if sd is not None:
        width[:, 2] = torch.tensor(sd, dtype=torch.float64)
    return SimpleNamespace(slip_mm=slip, slip_sd_mm=width, depth=None, **more)


SEEN = SimpleNamespace(slip_mm=torch.zeros(9, 3, dtype=torch.float64), vergence=None)


def test_half_widths_are_the_conformal_quantile_of_misses_in_their_own_units():
    """Nine frames: for a share of 0.6 the 6th of the sorted ratios, of ceil(0.6 x 10)."""
    ratio = [0.9, 0.1, 2.5, 0.4, 1.7, 0.3, 1.1, 3.2, 0.6]
    sd = [0.5, 2.0, 0.25, 1.5, 0.4, 3.0, 0.8, 0.3, 1.2]
    answers = typed(
        [r * s * (-1) ** k for k, (r, s) in enumerate(zip(ratio, sd, strict=True))], sd
    )
    assert finish.conformal_quantiles(answers, SEEN, share=0.6) == pytest.approx(1.1)
    assert finish.conformal_quantiles(answers, SEEN, share=0.61) == pytest.approx(1.7)
    assert finish.conformal_quantiles(answers, SEEN) == pytest.approx(
        3.2
    )  # 0.9 x 10: the last
    assert finish.conformal_quantiles(answers, SEEN, share=0.99) == pytest.approx(3.2)
    assert finish.conformal_quantiles(typed(ratio, None), SEEN) is None


def test_half_widths_from_other_frames_cover_nine_in_ten():
    """Errors of any law, here with heavy tails: over many draws the share covered is
    0.9 or a little more.
    """
    generator = torch.Generator().manual_seed(3)
    covered = []
    for _ in range(400):
        sd = torch.rand(60, generator=generator, dtype=torch.float64) + 0.3
        miss = sd * torch.randn(60, generator=generator, dtype=torch.float64) ** 3
        seen = SimpleNamespace(slip_mm=torch.zeros(59, 3), vergence=None)
        reach = finish.conformal_quantiles(
            typed(miss[1:].tolist(), sd[1:].tolist()), seen
        )
        covered.append(bool(abs(miss[0]) <= reach * sd[0]))
    assert sum(covered) / 400 == pytest.approx(0.9, abs=0.045)  # three of 1.5 %


def test_coverage_counts_frames_within_their_own_interval():
    answers = typed([0.9, -0.3, 0.2, -4.0], [0.5, 0.1, 0.4, 2.0])
    row = finish.uncertainty_summary(
        "dim_", answers, SimpleNamespace(slip_mm=torch.zeros(4, 3), vergence=None), 1.9
    )
    assert row == pytest.approx(
        {"dim_axial_coverage_90": 0.5, "dim_axial_interval_mm": 1.9 * 3.0 / 4}
    )
    assert finish.uncertainty_summary("", answers, SEEN, None) == {}
    assert finish.uncertainty_summary("", typed([0.1], None), SEEN, 1.9) == {}


def test_depths_of_windows_err_in_millimetres():
    """Vergences of 45 + 8 v per metre: told 0.5 and -1 where 0 and -0.25 are true."""
    told, truth = torch.tensor([0.5, -1.0]), torch.tensor([0.0, -0.25])
    answers = SimpleNamespace(
        slip_sd_mm=None, depth=torch.stack([told, torch.full((2,), 9.0)], 1)
    )
    row = finish.uncertainty_summary("", answers, SimpleNamespace(vergence=truth), None)
    want = (abs(1e3 / 49 - 1e3 / 45) + abs(1e3 / 37 - 1e3 / 43)) / 2
    assert row["window_depth_mm"] == pytest.approx(want, rel=1e-5)
