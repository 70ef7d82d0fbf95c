"""Layers through depth-dependent PSFs: exact cases, invariants, and the fast path
against the layer-by-layer one.
"""

import pytest
import torch

from benchmarks.peers import layered
from metalens.core.errors import SceneError
from metalens.image import Grid, uniform_imager
from metalens.image.scene import Frames

N = 96
DEPTHS = 1 / torch.linspace(1 / 28e3, 1 / 15e3, 21, dtype=torch.float64).flip(0)


def _stack(widths, size=31):
    k = torch.arange(size) - size // 2
    r2 = k[:, None] ** 2 + k**2
    blurs = torch.exp(-r2 / (2 * torch.as_tensor(widths)[:, None, None] ** 2)).double()
    return blurs / blurs.sum((1, 2), keepdim=True)


WIDTHS = 0.6 + (1e4 / DEPTHS - 0.5).abs() * 20
STACK = _stack(WIDTHS)


def _imager(stack=STACK, depths=DEPTHS, **about):
    """Of whole frames, borders continued."""
    ends = float(depths.min()), float(depths.max())
    grid = Grid((N, N), 9.0, ends, window=stack.shape[-1])
    return uniform_imager(stack, depths, grid, **about)


def _eye(radiance=None):
    """An eyeball behind a lid that covers the upper third, both curved, with texture."""
    torch.manual_seed(3)
    y = (torch.arange(N, dtype=torch.float64) - N / 2)[:, None].expand(N, N)
    r = torch.hypot(y, y.T)
    lid = torch.sigmoid(-(y + 15 + 0.01 * y.T**2) * 2)
    cover = torch.stack([lid, 1 - lid])[None].expand(2, 2, N, N)
    depth = torch.stack([17e3 + 30 * y.abs(), 18e3 + (r / 48) ** 2 * 4e3])[None].expand(
        2, 2, N, N
    )
    fine = torch.nn.functional.interpolate(
        torch.rand(2, 2, 24, 24), size=(N, N), mode="bicubic"
    ).double()
    return Frames(cover * (fine if radiance is None else radiance), cover, depth)


def test_constant_radiance_stays_constant_at_every_edge():
    flat = _eye(radiance=0.37)
    fast = _imager()(flat)
    assert (fast - 0.37).abs().max() < 1e-12
    layers = layered.cut_layers(flat, DEPTHS)
    slow = layered.image_layers(layers, _psfs_of(layers))
    assert (slow - 0.37).abs().max() < 1e-12


def test_a_sharp_near_edge_hides_a_blurred_far_sheet():
    """Light of the hidden sheet does not bleed onto the near one; behind the edge its
    colour goes on unchanged.
    """
    near = torch.zeros(1, 1, N, N, dtype=torch.float64)
    near[..., :, : N // 2] = 1
    cover = torch.cat([near, 1 - near], 1)
    light = torch.cat([0.2 * near, 0.8 * (1 - near)], 1)
    seen = layered.image_layers(
        layered.Layers(light, cover, DEPTHS[:2], torch.tensor([True, False])),
        _stack(torch.tensor([1e-3, 5.0])),
    )
    assert (seen[..., : N // 2] - 0.2).abs().max() < 1e-9
    assert (seen[..., N // 2 :] - 0.8).abs().max() < 1e-9


def test_one_depth_is_an_ordinary_convolution():
    frames = _eye()
    light = frames.radiance.sum(1, keepdim=True)
    none = torch.zeros_like(light)
    cover = torch.cat([none, torch.ones_like(light)], 1)
    flat = Frames(torch.cat([none, light], 1), cover, torch.full_like(cover, 20e3))
    kernel = _stack(torch.tensor([2.0]))
    image = _imager(kernel, torch.tensor([20e3]))(flat)
    want = torch.nn.functional.conv2d(light, kernel[None])[:, 0]
    # rounding of the transforms
    assert (image[:, 15:-15, 15:-15] - want).abs().max() < 2e-6 * want.max()


def test_an_off_centre_psf_moves_the_image_the_same_way():
    kernel = torch.zeros(1, 31, 31, dtype=torch.float64)
    kernel[0, 15 + 2, 15 + 5] = 1
    frames = _eye()
    image = _imager(kernel, torch.tensor([20e3]))(frames)
    moved = frames.radiance.sum(1)[:, 10:88, 10:85]
    # far sheet under 1 % of coverage fades
    assert (image[:, 12:90, 15:90] - moved).abs().max() < 4e-3


def _psfs_of(layers):
    return STACK[[int((DEPTHS - d).abs().argmin()) for d in layers.depth_um]]


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_few_kernels_meet_the_tolerance(tolerance):
    frames = _eye()
    made = _imager(tolerance=tolerance)
    fast = made(frames)
    layers = layered.cut_layers(frames, DEPTHS)
    slow = layered.image_layers(layers, _psfs_of(layers))
    assert made.error <= tolerance
    error = float((fast - slow).norm() / slow.norm())
    assert error < tolerance + 4e-5  # the look-up table's 4096 depths


def test_gradient_reaches_the_psfs():
    frames = _eye()
    psfs = STACK.clone().requires_grad_(True)
    direction = (
        torch.randn(
            STACK.shape[1:],
            generator=torch.Generator().manual_seed(0),
            dtype=torch.float64,
        )
        * STACK
    )

    # the same change at every depth: what the kept weights can follow
    def energy(stack):
        return (_imager(stack, tolerance=1e-12)(frames) ** 2).sum()

    energy(psfs).backward()
    step = 1e-4
    slope = (energy(STACK + step * direction) - energy(STACK - step * direction)) / (
        2 * step
    )
    # kink where coverage reaches 1
    assert float((psfs.grad * direction).sum()) == pytest.approx(float(slope), rel=1e-3)


def test_mismatched_depths_and_shapes_are_refused():
    with pytest.raises(SceneError, match="ascending"):
        _imager(depths=DEPTHS.flip(0))
    with pytest.raises(SceneError, match="need one a depth"):
        _imager(STACK[:4])
    with pytest.raises(SceneError, match="shapes"):
        Frames(torch.zeros(2, 3, 4), torch.zeros(2, 3, 4), torch.zeros(2, 3, 4))


def test_so_many_times_the_light_is_so_many_times_the_image():
    frames, made = _eye(), _imager()
    light, depth = frames.radiance.sum(1), frames.depth_um[:, 1]
    dim = made.scaled(0.37)
    assert torch.allclose(dim(frames), 0.37 * made(frames))
    assert torch.allclose(dim.surface(light, depth), 0.37 * made.surface(light, depth))
