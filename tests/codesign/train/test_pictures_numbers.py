"""What a run shows at its end: frames and answers in the units that they are told in,
the first ones.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.network.blur import VERGENCE_PER_M, VERGENCE_UNIT_PER_M
from codesign.train import pictures

DRAW = torch.Generator().manual_seed(8)
FRAMES, PIXELS, COARSE = 5, 8, 4


def random(*shape):
    return torch.randn(*shape, generator=DRAW, dtype=torch.float64)


SEEN = SimpleNamespace(
    frames=random(FRAMES, 2, PIXELS, PIXELS),
    slip_mm=random(FRAMES, 3),
    mask=torch.rand(
        FRAMES, 2 * PIXELS, 2 * PIXELS, generator=DRAW, dtype=torch.float64
    ),
    vergence=random(FRAMES, 3, 3),
)


def end(*, mask=True, depth=True, interval=True):
    """A network's answers; the mask on a grid half as fine as the frames."""
    answers = SimpleNamespace(
        slip_mm=random(FRAMES, 3),
        mask=random(FRAMES, COARSE, COARSE) if mask else None,
        depth=random(FRAMES, 2, 3, 3) if depth else None,
    )
    return SimpleNamespace(
        seen=SEEN,
        answers=answers,
        interval_mm=random(FRAMES).abs() if interval else None,
    )


def depth_um(vergence):
    """Of vergences in the units of the branch, which stay within 1 to 200 a metre here."""
    return 1e6 / (vergence * VERGENCE_UNIT_PER_M + VERGENCE_PER_M)


def between(grid, fine):
    """(fine, fine) values straight between the middles of a grid, the rim held."""
    at = np.clip((np.arange(fine) + 0.5) * len(grid) / fine - 0.5, 0, len(grid) - 1)
    low = np.minimum(at.astype(int), len(grid) - 2)
    rows = grid[low] + (at - low)[:, None] * (grid[low + 1] - grid[low])
    return rows[:, low] + (at - low) * (rows[:, low + 1] - rows[:, low])


def test_answers_of_all_networks_stand_beside_the_truth_in_micrometres():
    ends, count = [end(), end()], 3
    found = pictures.answered(ends, count)
    assert {value.dtype for value in found.values()} == {np.dtype(np.float32)}
    assert found["frames"] == pytest.approx(SEEN.frames[:3, 0].numpy(), rel=1e-6)
    assert found["slip_um"] == pytest.approx(1e3 * SEEN.slip_mm[:3].numpy(), rel=1e-6)
    blocks = SEEN.mask[:3].numpy().reshape(3, PIXELS, 2, PIXELS, 2).mean((2, 4))
    assert found["pupil"] == pytest.approx(blocks, rel=1e-6)
    for n, one in enumerate(ends):
        assert found["told_slip_um"][n] == pytest.approx(
            1e3 * one.answers.slip_mm[:3].numpy(), rel=1e-6
        )
        assert found["interval_um"][n] == pytest.approx(
            1e3 * one.interval_mm[:3].numpy(), rel=1e-6
        )
        for k in range(3):
            logits = between(one.answers.mask[k].numpy(), PIXELS)
            assert found["told_pupil"][n, k] == pytest.approx(
                1 / (1 + np.exp(-logits)), rel=1e-6
            )
        assert found["told_window_um"][n] == pytest.approx(
            depth_um(one.answers.depth[:3, 0].numpy()), rel=1e-5
        )
    assert found["window_um"] == pytest.approx(
        depth_um(SEEN.vergence[:3].numpy()), rel=1e-5
    )


@pytest.mark.parametrize(
    ("less", "gone"),
    [
        ({"mask": False}, {"pupil", "told_pupil"}),
        ({"depth": False}, {"window_um", "told_window_um"}),
        ({}, set()),
    ],
)
def test_what_one_network_does_not_tell_is_left_out_and_no_interval_is_nan(less, gone):
    whole = pictures.answered([end(), end()], 9)
    found = pictures.answered([end(interval=False), end(**less)], 9)
    assert whole.keys() - found.keys() == gone
    assert np.isnan(found["interval_um"][0]).all()
    assert np.isfinite(found["interval_um"][1]).all()
    assert found["interval_um"].shape == (2, FRAMES)
    assert found["told_slip_um"].shape == (2, FRAMES, 3)
