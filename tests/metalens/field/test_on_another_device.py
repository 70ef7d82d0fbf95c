"""The true image on another device than the processor: the same numbers to rounding, by
the same code.
"""

import dataclasses
import functools
import math
from types import SimpleNamespace

import pytest
import scipy.fft
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.field import (
    Grid,
    Layers,
    SmoothWave,
    drawn,
    forming,
    imager,
    patches,
    surrogate,
    together,
)
from metalens.field.points import Optics
from metalens.image import Frames, basis, image, uniform_imager
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
        assert (
            there.stack.device == there.transfer[0].device == there.even.device == AWAY
        )
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


@pytest.mark.parametrize("kinds", [1, 2])
def test_patches_taken_together_are_those_one_by_one(both, kinds):
    """Of unlike sizes and numbers of kernels, a few at a time; light, coverage, and the
    slopes of their transforms.
    """
    here, frames = both[0], _frames(GRID, seed=6)
    about = {"patches": 3, "overlap": 3, "tolerance": 0.02}
    cut = patches.cut(
        here.stack, here.energy, forming.between_nodes(GRID, here.plan), **about
    )
    made = [patch.trimmed(0.2, 0.4) if i % 3 else patch for i, patch in enumerate(cut)]
    assert len({len(patch.mix) for patch in made}) > 1
    assert len({patch.coverage for patch in made}) > 1
    made = forming.with_psfs(
        dataclasses.replace(here, patches=made, transfer=[], even=None),
        here.stack,
        here.energy,
    )
    given = (
        frames.radiance,
        frames.coverage,
        forming.vergence(frames.depth_um, here.plan.depths_um),
    )
    sides = [(b - a for a, b in (patch.rows, patch.columns)) for patch in made.patches]
    shapes = [
        tuple(scipy.fft.next_fast_len(n + GRID.window - 1, real=True) for n in pair)
        for pair in sides
    ]
    few = functools.partial(
        together.through, held_bytes=3 * 6 * 8 * made.transfer[0].numel()
    )
    found = []
    for way in (few, _one_by_one):
        transfer = [part.clone().requires_grad_() for part in made.transfer]
        out = torch.zeros(
            3, kinds, 2, *(n + 2 * (GRID.window // 2) for n in GRID.frame)
        )
        way(given, made.patches, transfer, shapes, out)
        (out.square() * torch.linspace(0.2, 1.7, out.shape[-1])).sum().backward()
        found.append((out.detach(), [part.grad for part in transfer]))
    (seen, slopes), (want, steep) = found
    assert torch.allclose(seen, want, rtol=0, atol=SINGLE * float(want.max()))
    for one, other in zip(slopes, steep, strict=True):
        assert torch.allclose(one, other, rtol=0, atol=1e-5 * float(other.abs().max()))


class _Spectra(TorchDispatchMode):
    """Bytes of every transform to frequencies that is asked for."""

    def __init__(self):
        super().__init__()
        self.bytes = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        if func.overloadpacket.__name__ == "_fft_r2c":
            self.bytes.append(found.numel() * found.element_size())
        return found


def test_no_more_than_two_gigabytes_of_spectra_are_held_at_once_and_no_less_where_there_are_patches():
    """Seven patches of five kernels, 6 frames of two sheets: a patch's spectra are 0.63
    GB, three at a time, the last
    alone. Shapes without numbers."""
    side, size, kernels, nothing = (
        900,
        1600,
        5,
        functools.partial(torch.empty, device=AWAY),
    )
    patch = patches.Patch(
        (0, side),
        (0, side),
        nothing(side * side),
        nothing(side * side, 2, kernels),
        nothing(side * side, 2),
        nothing(kernels, 4),
        nothing(4),
        nothing(kernels + 1),
        kernels,
    )
    given = (
        nothing(6, 2, side, side),
        nothing(6, 2, side, side),
        nothing(6, 2, side, side),
    )
    transfer = [nothing(kernels, size, size // 2 + 1, dtype=torch.complex64)] * 7
    out = nothing(6, 1, 2, size, size)
    with _Spectra() as seen:
        together.through(given, [patch] * 7, transfer, [(size, size)] * 7, out)
    each = 8 * 6 * 2 * kernels * size * (size // 2 + 1)
    assert 3 * each < 2**31 < 4 * each
    assert seen.bytes == [3 * each, 3 * each, each]


@pytest.mark.parametrize(
    ("device", "side", "sizes"),
    [("cpu", 250, [8, 8, 8, 8, 2]), ("cpu", 20, [32, 2]), (AWAY, 20, [34])],
)
def test_a_processor_images_eight_frames_or_more_small_ones_and_a_gpu_a_hundred(
    monkeypatch, device, side, sizes
):
    """A million samples of two sheets are 8 frames of 250 samples along a side, and far
    more than 32 of 20.
    """
    seen = []
    monkeypatch.setattr(
        forming,
        "blurred",
        lambda few, optics: seen.append(len(few.radiance)) or few.radiance[:, 0],
    )
    monkeypatch.setattr(forming, "returned", lambda total, grid: total)
    grid = dataclasses.replace(GRID, samples=(side, side), margin=0)
    optics = SimpleNamespace(grid=grid, stack=torch.empty(1, device=device), stray=None)
    many = torch.empty(34, 2, side, side, device=device)
    forming.image(Frames(many, many, many), optics)
    assert seen == sizes
    if device == AWAY:
        more = torch.empty(300, 2, side, side, device=device)
        forming.image(Frames(more, more, more), optics)
        assert seen[1:] == [128, 128, 44]


def _one_by_one(given, patches, transfer, shapes, out):
    for patch, kernels, shape in zip(patches, transfer, shapes, strict=True):
        forming._add(patch, kernels, shape, given, out)


def test_an_imager_moves_and_comes_back(both):
    here, frames = both[0], _frames(GRID, seed=5)
    with elsewhere():
        seen = here.to(AWAY)(frames.to(AWAY)).cpu()
        again = here.to(AWAY).to("cpu")
    assert torch.allclose(seen, here(frames), rtol=0, atol=1e-5 * float(seen.max()))
    for one, other in zip(again.transfer, here.transfer, strict=True):
        assert torch.equal(one, other)


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
        value = surrogate(
            optics,
            here.plan,
            weights,
            drawn(here.plan, 2, torch.Generator().manual_seed(3)),
        )
        value.backward()
        return float(value.detach()), bends.grad

    with elsewhere():
        value, slope = found(AWAY)
    want, steep = found(torch.device("cpu"))
    assert value == pytest.approx(want, rel=1e-5)
    assert slope.numpy() == pytest.approx(
        steep.numpy(), rel=1e-4
    )  # phases are single precision: 1e-5 of a turn


@pytest.mark.parametrize("points", [(1, 1), (2, 3)])
def test_one_psf_a_depth_images_elsewhere(points):
    draw = torch.Generator().manual_seed(1)
    stack = torch.rand(*points, 4, 7, 7, generator=draw) + 0.1
    psf = basis(stack / stack.sum((-1, -2), keepdim=True), torch.linspace(5e3, 9e3, 4))
    frames = _frames(Grid((24, 24), 4.0, (5e3, 9e3), margin=3, window=7))
    here = uniform_imager(psf, (30, 30), margin=3)
    with elsewhere():
        seen = image(frames.to(AWAY), here.to(AWAY), margin=3).cpu()
    want = image(frames, here, margin=3)
    assert math.isfinite(float(want.max()))
    assert torch.allclose(
        seen, want, rtol=0, atol=2 * SINGLE * float(want.max()) / 0.01
    )  # faint coverage: 1 / FAINT
