"""The reader of blur that is told what a window shows: where it is told, and how
windows vote.
"""

import numpy as np
import pytest
import torch

from codesign.network import blur, windows
from codesign.network.supernet import SlicedNorm
from tests.codesign.network.told import Told

CHANNELS = 5


def _branch():
    torch.manual_seed(2)
    return blur.InformedBranch(SlicedNorm(blur.FEATURES), CHANNELS).eval()


@pytest.mark.parametrize("size", [8, 16, 40])
def test_a_window_is_told_the_mean_of_the_maps_under_it(size):
    """Of ramps, its middle: windows lie at 1/8 ... 7/8 of the frame."""
    line = (torch.arange(size) + 0.5) / size
    maps = torch.stack(
        [3.7 * line.expand(size, size), 1.3 - line[:, None].expand(size, size)]
    )[None]
    got = windows.window_content(maps)
    middle = np.arange(1, blur.GRID + 1) / 8
    assert got[0, 0].numpy() == pytest.approx(np.tile(3.7 * middle, (7, 1)), rel=1e-5)
    assert got[0, 1].numpy() == pytest.approx(
        np.tile(1.3 - middle[:, None], (1, 7)), rel=1e-5
    )


@pytest.mark.parametrize("size", [4, 5, 13])
def test_maps_of_any_size_are_told(size):
    """Maps coarser than the windows are interpolated: what is the same everywhere stays
    it.
    """
    got = windows.window_content(torch.full((2, 1, size, size), -2.9))
    assert got.shape == (2, 1, blur.GRID, blur.GRID)
    assert got.numpy() == pytest.approx(-2.9)


def test_what_a_corner_shows_is_told_to_the_windows_around_it_alone():
    branch, frames = (
        _branch(),
        torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(3)),
    )
    content = torch.randn(
        1, CHANNELS, 16, 16, generator=torch.Generator().manual_seed(4)
    )
    changed = content.clone()
    changed[..., :2, -2:] += (
        1.0  # a step of the windows, in the corner: of the upper right window alone
    )
    with torch.no_grad():
        for block in branch.together[1::2]:
            block.give.weight.zero_()  # what is told of the whole frame
        moved = (branch(frames, changed)[0] - branch(frames, content)[0]).abs().amax(
            (0, 1)
        ) > 3e-7
    # ten roundings of single precision at answers of 0.4; the least that is told moves
    # one by 3e-6
    reach = 1 + blur.BLOCKS * (blur.REACH // 2)
    wanted = torch.zeros(blur.GRID, blur.GRID, dtype=torch.bool)
    wanted[:reach, -reach:] = True
    assert torch.equal(moved, wanted)


def test_windows_vote_with_the_softmax_of_what_they_claim():
    branch, draw = _branch(), np.random.default_rng(7)
    estimate, claim = draw.normal(0.3, 1.2, (3, 49)), draw.normal(-0.4, 2.1, (3, 49))
    branch.vote = Told(
        torch.tensor(
            np.stack([estimate, claim], 1).reshape(3, 2, 7, 7), dtype=torch.float32
        )
    )
    with torch.no_grad():
        axial = branch(torch.randn(3, 1, 48, 48), torch.randn(3, CHANNELS, 12, 12))[2]
    share = np.exp(claim) / np.exp(claim).sum(1, keepdims=True)
    assert axial.numpy() == pytest.approx((share * estimate).sum(1), rel=1e-4)
