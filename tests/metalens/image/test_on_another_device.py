"""The true image on another device than the processor: the same numbers to rounding, by
the same code.
"""

import pytest
import torch

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.image import Frames, Grid, SmoothWave, imager
from metalens.optics import Layers
from tests.elsewhere import AWAY, elsewhere

FOCUS = Focus(0.94, 900.0, 7e3)
GRID = Grid((33, 26), 4.0, (5e3, 9e3), margin=6, window=13)
LAYERS = Layers(behind=(Film(Index(1.52), 210.0),))


def _added(x, y):
    return 2.3 * (x / 200) ** 2 - 1.1 * (x / 200) * (y / 200) ** 2


def _frames(grid, seed=4):
    draw = torch.Generator().manual_seed(seed)
    size = tuple(n + 2 * grid.margin for n in grid.samples)
    near = torch.zeros(size)
    near[: size[0] // 2, 5:] = 1
    cover = torch.stack([near, 1 - near])[None].repeat(3, 1, 1, 1)
    depth = 5e3 + 4e3 * torch.rand(3, 2, *size, generator=draw)
    return Frames(torch.rand(3, 2, *size, generator=draw) * cover, cover, depth)


def _made(device, **about):
    wave = SmoothWave(FOCUS, 200.0, _added)
    return imager(
        wave,
        GRID,
        layers=LAYERS,
        field=(0.11, -0.06),
        tolerance=0.1,
        device=device,
        **about,
    )


@pytest.fixture(scope="module")
def both():
    here = _made("cpu")
    with elsewhere():
        return here, _made(AWAY)


def test_psfs_and_images_are_those_of_the_processor(both):
    here, there = both
    with elsewhere() as done:
        assert there.stack.device == there.light.transfer.device == AWAY
        psfs = there.stack.cpu()
        frames = _frames(GRID)
        seen = there(frames.to(AWAY))
        assert seen.device == AWAY
        seen = seen.cpu()
    want = here(frames)
    assert "_fft_r2c" in done
    assert (
        float((psfs - here.stack).abs().max()) <= 2e-6 * float(here.stack.max()) + 1e-9
    )  # phases of single precision
    assert torch.allclose(seen, want, rtol=0, atol=1e-5 * float(want.max()))
    assert there.parts.keys() == here.parts.keys()
    for name, value in here.parts.items():
        assert there.parts[name] == pytest.approx(value, abs=1e-4), name


def test_an_imager_moves_and_comes_back(both):
    here, frames = both[0], _frames(GRID, seed=5)
    with elsewhere():
        seen = here.to(AWAY)(frames.to(AWAY)).cpu()
        again = here.to(AWAY).to("cpu")
    assert torch.allclose(seen, here(frames), rtol=0, atol=1e-5 * float(seen.max()))
    assert torch.equal(again.light.table, here.light.table)


def test_what_lies_on_two_devices_is_refused(both):
    with elsewhere(), pytest.raises(RuntimeError, match="two devices"):
        both[1](_frames(GRID))
