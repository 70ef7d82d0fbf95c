"""The true image on another device than the processor: the same numbers to rounding, by
the same code.
"""

import math

import pytest
import torch

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.image import (
    Frames,
    Grid,
    SmoothWave,
    draw_nodes,
    imager,
    surrogate_loss,
    uniform_imager,
)
from metalens.image.points import Optics
from metalens.optics import Layers
from tests.elsewhere import AWAY, elsewhere

FOCUS = Focus(0.94, 900.0, 7e3)
GRID = Grid((33, 26), 4.0, (5e3, 9e3), margin=6, window=13)
LAYERS = Layers(behind=(Film(Index(1.52), 210.0),))
SINGLE = (
    3e-6  # rounding of sums of a few hundred single numbers, each 6e-8 of the largest
)


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


def test_gradients_of_the_phase_come_back_to_the_processor(both):
    here, _ = both
    bend = torch.tensor([0.4, -0.7], dtype=torch.float64)

    def found(device):
        bends = bend.clone().requires_grad_()

        def added(x, y):
            return (
                _added(x, y)
                + bends[0].to(x.device) * (x / 200) ** 3
                + bends[1].to(x.device) * (y / 200) ** 2
            )

        optics = Optics(
            SmoothWave(FOCUS, 200.0, added), LAYERS, FOCUS.sensor_distance_um
        )
        weights = (
            torch.linspace(-1, 2, here.stack.numel())
            .reshape(here.stack.shape)
            .to(device)
        )
        value = surrogate_loss(
            optics,
            here.plan,
            weights,
            draw_nodes(here.plan, 2, torch.Generator().manual_seed(3)),
        )
        value.backward()
        return float(value.detach()), bends.grad

    with elsewhere():
        value, slope = found(AWAY)
    want, steep = found(torch.device("cpu"))
    assert value == pytest.approx(want, rel=1e-5)
    # phases are single precision: 1e-5 of a turn
    assert slope.numpy() == pytest.approx(steep.numpy(), rel=1e-4)


def test_one_psf_a_depth_images_elsewhere():
    draw = torch.Generator().manual_seed(1)
    grid = Grid((24, 24), 4.0, (5e3, 9e3), margin=3, window=7)
    stack = torch.rand(4, 7, 7, generator=draw) + 0.1
    frames = _frames(grid)
    here = uniform_imager(stack, torch.linspace(5e3, 9e3, 4), grid)
    with elsewhere():
        seen = here.to(AWAY)(frames.to(AWAY)).cpu()
    want = here(frames)
    assert math.isfinite(float(want.max()))
    assert torch.allclose(
        seen, want, rtol=0, atol=2 * SINGLE * float(want.max()) / 0.01
    )  # faint coverage: 1 / FAINT
