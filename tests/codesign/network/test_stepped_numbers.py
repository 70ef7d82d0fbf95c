"""Steps of brightness by plain loops in double precision: blocks, neighbours, edges,
and a logarithm of its own.
"""

import math

import numpy as np
import pytest
import torch

from codesign.network import stepped, windows

TAPS = np.array(
    [[[0, -0.5, 0], [0.25, 1, 0], [0, 0, -2]], [[0, 0, 0], [0, 3, 0], [0, 0, 0]]], float
)
FLOOR = 0.02


def by_loops(frames, reach, blocks):
    """(3, batch, kinds, blocks, blocks) of (batch, y, x)."""
    count, rows, columns = frames.shape
    out = np.zeros((3, count, len(TAPS), blocks, blocks))
    for n, kind, row, column in np.ndindex(count, len(TAPS), rows, columns):
        step = 0.0
        for y, x in np.ndindex(3, 3):
            at = (
                np.clip(row + reach * (y - 1), 0, rows - 1),
                np.clip(column + reach * (x - 1), 0, columns - 1),
            )
            step += TAPS[kind, y, x] * frames[n][at]
        log = math.log1p(step**2 / FLOOR)
        place = n, kind, row * blocks // rows, column * blocks // columns
        for part, value in enumerate((log, log**2, step**8)):
            out[part][place] += value * blocks**2 / (rows * columns)
    return out


def test_blocks_of_both_reaches_by_plain_loops():
    draw = np.random.default_rng(5)
    light = [draw.normal(size=(3, 8, 12)), draw.normal(size=(3, 8, 12)) * 0.2]
    found = stepped.moments(
        [torch.tensor(part)[:, None].float() for part in light], (1, 2), TAPS, 4, FLOOR
    )
    want = np.concatenate(
        [by_loops(part, reach, 4) for part, reach in zip(light, (1, 2), strict=True)], 2
    )
    assert found[0].shape == (3, 4, 4, 4)
    for mine, other in zip(found, want, strict=True):
        assert mine.numpy() == pytest.approx(other, rel=3e-6)


def test_logarithms_from_a_millionth_to_a_million():
    """Of single steps: one sample a block."""
    size = np.geomspace(1e-5, 1e4, 4096).astype(np.float32)
    frames = torch.from_numpy(size.reshape(1, 1, 64, 64))
    alone = np.array([[[0, 0, 0], [0, 1, 0], [0, 0, 0]]], float)
    mean, second, _ = (
        part.double().numpy().ravel()
        for part in stepped.moments([frames], (1,), alone, 64, 1.0)
    )
    want = np.log1p(size.astype(float) ** 2)
    assert np.abs(mean - want).max() < 3e-6  # 2e-7 of ln 1e8
    seen = want > 1e-6
    assert np.abs(mean[seen] / want[seen] - 1).max() < 0.1  # 1 + q holds 6e-8
    assert second == pytest.approx(want**2, rel=5e-7, abs=1e-6)


def test_windows_hear_the_same_of_frames_with_and_without_derivatives():
    frames = (
        torch.randn(5, 1, 70, 96, generator=torch.Generator().manual_seed(2)).cumsum(-1)
        * 0.2
    )
    exact = windows.steps(frames.double())
    quick, known = windows.steps(frames), windows.steps(frames.clone().requires_grad_())
    assert known.requires_grad
    assert not quick.requires_grad
    for found in (quick, known.detach()):
        assert float((found - exact).abs().max()) < 2e-5


def test_a_frame_without_steps_and_one_that_is_no_number():
    """0 everywhere but the spread's floor; of the other nothing is a number in its
    windows.
    """
    frames = torch.full((2, 1, 64, 64), 7.0)
    frames[1, 0, 20, 20] = float("nan")
    told = windows.steps(frames)
    kinds = windows.STEP_FEATURES // windows.TOLD
    assert (told[0, :kinds] == 0).all()
    assert told[0, kinds : 2 * kinds].numpy() == pytest.approx(1e-2)
    assert told[1, 0, 1, 1].isnan()
    assert told[1, 0, 6, 6] == 0


def test_bytes_are_the_same_for_one_thread_and_two():
    frames, kept = (
        torch.randn(7, 1, 64, 64, generator=torch.Generator().manual_seed(4)),
        torch.get_num_threads(),
    )
    try:
        found = []
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(windows.steps(frames))
    finally:
        torch.set_num_threads(kept)
    assert torch.equal(*found)
