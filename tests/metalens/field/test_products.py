"""Patches by matrix products: transforms against numpy's FFT, whole images against the
ones that torch forms.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.field import Grid, forming, patches, products
from metalens.ground.errors import SceneError
from metalens.image import Frames


@pytest.mark.parametrize(("count", "size"), [(7, 9), (6, 10), (5, 9), (4, 8), (7, 45)])
def test_products_transform_and_lead_back(count, size):
    """Even and odd numbers of samples and of points, one with more frequencies than a
    block holds. Counted from the
    middle, a transform is numpy's turned by (count - 1) / 2 samples; back it is the
    samples again, with a dark one on
    either side for a window of 3."""
    given = np.random.default_rng(3).normal(size=(4, count)).astype(np.float32)
    made, frequencies = products.bases(count, size, 3), size // 2 + 1
    angle = 2 * np.pi / size * np.arange(frequencies)
    want = np.fft.rfft(given, n=size) * np.exp(1j * angle * (count - 1) / 2)
    one, other = _folded(given)
    real, imaginary = one @ made.cos, other @ made.sin
    assert (
        np.abs(real[:, :frequencies] + 1j * imaginary[:, :frequencies] - want).max()
        < 1e-5
    )  # float32 of up to 12
    assert np.abs(real[:, frequencies:]).max(initial=0) == 0  # lanes that are filled up
    cosines, sines = made.across_cos @ one.T, made.across_sin @ other.T
    assert np.abs(cosines - 1j * sines - want.T).max() < 1e-5
    dark = np.pad(given, ((0, 0), (1, 1)))
    assert (
        np.abs(
            _unfolded(real @ made.back_cos, imaginary @ made.back_sin, count + 2) - dark
        ).max()
        < 1e-6
    )
    up, down = made.up_cos @ (2 * cosines), made.up_sin @ (2 * sines)
    assert np.abs(_unfolded(up.T, down.T, count + 2) - dark).max() < 1e-6
    assert made.turn == pytest.approx(
        np.exp(1j * angle), abs=1e-6
    )  # a window's middle is its second sample


def _folded(given):
    """Sums and differences of samples and their mirror images, up to the middle one."""
    half = (given.shape[1] + 1) // 2
    return (given + given[:, ::-1])[:, :half], (given - given[:, ::-1])[:, :half]


def _unfolded(one, other, count):
    return np.concatenate([one + other, (one - other)[:, : count // 2][:, ::-1]], 1)


@pytest.fixture(scope="module", params=[(5, 1), (7, 3), (9, 6)])
def optics(request):
    """Random PSFs over a field: windows of 5 to 9, and 1, 3 or 6 depths; patches of
    unlike sizes.
    """
    window, depths = request.param
    draw = np.random.default_rng(window)
    stack = torch.from_numpy(draw.random((5, 4, depths, window, window))).float()
    stack /= stack.sum((-1, -2), keepdim=True)
    grid = Grid(
        (23, 18), 2.0, (3e3, 3e3 if depths == 1 else 9e3), margin=3, window=window
    )
    rows, columns = grid.frame
    y, x = (
        torch.linspace(-n, n, k, dtype=torch.float64)
        for n, k in ((rows, 5), (columns, 4))
    )
    deep = 1 / torch.linspace(
        1 / 3e3, 1 / grid.depths_um[1], depths, dtype=torch.float64
    )
    plan = SimpleNamespace(y_um=y, x_um=x, depths_um=deep)
    energy = torch.from_numpy(0.5 + draw.random((5, 4, depths))).float()
    cut = patches.cut(
        stack,
        energy,
        forming.between_nodes(grid, plan),
        patches=3,
        overlap=2,
        tolerance=1e-3,
    )
    return forming.with_psfs(
        forming.Imager(grid, plan, stack, energy, cut, [], {}), stack, energy
    )


def _frames(optics, count):
    """A near sheet over the upper part, softly ended; the far one has a dark hole, and
    the last frame no near sheet.
    """
    draw = torch.Generator().manual_seed(8)
    size = tuple(n + 2 * optics.grid.margin for n in optics.grid.samples)
    y = torch.arange(size[0], dtype=torch.float32)[:, None].expand(size)
    near = torch.sigmoid((8 - y) * 3).repeat(count, 1, 1)
    near[-1] = 0
    cover = torch.stack([near, 1 - near], 1)
    light = cover * torch.rand(count, 2, *size, generator=draw)
    light[:, 1, 14:19, 3:11] = 0
    depth = 3e3 + (optics.grid.depths_um[1] - 3e3) * torch.rand(
        count, 2, *size, generator=draw
    )
    return Frames(light, cover.contiguous(), depth)


@pytest.mark.parametrize("count", [1, 5])
def test_products_form_the_image_that_torch_forms(optics, count):
    frames = _frames(optics, count)
    by_fft = Frames(
        frames.radiance.clone().requires_grad_(), frames.coverage, frames.depth_um
    )
    want, got = optics(by_fft).detach(), optics(frames)
    assert float((got - want).norm() / want.norm()) < 2e-6  # float32


def test_images_do_not_depend_on_the_number_of_threads(optics):
    frames, before = _frames(optics, 5), torch.get_num_threads()
    images = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            images.append(optics(frames))
    finally:
        torch.set_num_threads(before)
    one, other = images
    assert float((one - other).abs().max()) < 1e-6 * float(
        other.max()
    )  # float32: parts of a sum may end elsewhere


def test_sheets_that_hold_nothing_in_a_patch_are_left_out(optics, monkeypatch):
    """The near sheet ends softly, 1e-7 of 1 at ln(1e7) / 3 = 5.4 rows below its edge;
    the second frame has none.
    """
    held = []
    monkeypatch.setattr(
        products,
        "_convolved",
        lambda content, place, some, *_: held.append(some.tolist()),
    )
    optics(_frames(optics, 2))
    last = 8 + math.log(1e7) / 3 + optics.grid.spare
    upper = sum(patch.rows[0] <= last for patch in optics.patches)
    assert upper < len(optics.patches)
    assert sum([0, 0] in some for some in held) == 2 * upper  # light and coverage
    assert sum([1, 0] in some for some in held) == 0
    assert sum([1, 1] in some for some in held) == 2 * len(optics.patches)


def test_one_surface_is_a_far_sheet_that_covers_all(optics):
    both = _frames(optics, 3)
    light, depth_um = both.radiance[:, 1], both.depth_um[:, 1]
    cover = torch.stack([torch.zeros_like(light), torch.ones_like(light)], 1)
    want = optics(
        Frames(torch.stack([torch.zeros_like(light), light], 1), cover, both.depth_um)
    )
    assert float((optics.surface(light, depth_um) - want).abs().max()) < 1e-6 * float(
        want.max()
    )  # float32
    with pytest.raises(SceneError, match="samples, need"):
        optics.surface(light[:, 1:], depth_um[:, 1:])


@pytest.mark.parametrize(("share", "seen"), [(0.8e-7, False), (1.3e-7, True)])
def test_what_is_below_a_ten_millionth_of_the_most_is_nothing(optics, share, seen):
    """Below the rounding of the rest: a patch that holds no more is left out, one point
    of a frame that is lit in
    another patch."""
    light = torch.zeros(1, 2, *optics.grid.frame)
    light[0, 1, 2, 2], light[0, 1, -3, -3] = 3.0, 3.0 * share
    depth = torch.full_like(light, 3e3)
    image = forming.blur(Frames(light, torch.zeros_like(light), depth), optics)[0, 0, 1]
    far = image[-5:, -5:].abs().max()
    assert (float(far) > 0) is seen
