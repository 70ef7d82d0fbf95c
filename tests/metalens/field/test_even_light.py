"""Even light through patches of few kernels: PSFs that move over the field, whose image
is known in closed form.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from metalens.design import Focus
from metalens.field import (
    Grid,
    Layers,
    Optics,
    SmoothWave,
    engine,
    even,
    forming,
    imager,
    patches,
    psfs,
)
from metalens.image import Frames

WINDOW, STEP = 13, 2.0
GRID = Grid((33, 41), STEP, (3e3, 9e3), margin=WINDOW // 2, window=WINDOW)
STRETCH = (
    0.05,
    -0.03,
)  # by how much more than the field point the middle of its PSF moves, along y and x
BLUR = 1.7  # samples


def _plan(depths=3):
    y, x = (
        torch.linspace(-h, h, n, dtype=torch.float64)
        for h, n in zip(GRID.half_um, (17, 19), strict=True)
    )
    return SimpleNamespace(
        y_um=y,
        x_um=x,
        depths_um=1 / torch.linspace(1 / 3e3, 1 / 9e3, depths, dtype=torch.float64),
    )


def _moving(plan, stretch, blur=BLUR):
    """Gaussians about stretch times the field point, samples from it; narrower and
    wider at the ends of depth.
    """
    place = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    wide = blur * torch.tensor([0.8, 1.0, 1.25], dtype=torch.float64)[:, None]
    along = []
    for nodes, part in zip((plan.y_um, plan.x_um), stretch, strict=True):
        away = place - part * nodes[:, None, None] / STEP
        along.append(torch.exp(-0.5 * (away / wide) ** 2))
    both = torch.einsum("azh,bzw->abzhw", *along)
    return (both / both.sum((-1, -2), keepdim=True)).float()


def _imager(stretch, level=0.37):
    """Four patches of one kernel each."""
    plan = _plan()
    stack = _moving(plan, stretch)
    energy = torch.full(stack.shape[:3], level)
    made = patches.cut(
        stack,
        energy,
        forming.between_nodes(GRID, plan),
        patches=2,
        overlap=4,
        tolerance=1e-3,
    )
    whole = forming.with_psfs(
        forming.Imager(GRID, plan, stack, energy, made, [], {}), stack, energy
    )
    few = engine.trimmed(whole, 2.0)
    assert [len(patch.mix) for patch in few.patches] == [1] * 4
    return few


def _even(depth_um):
    size = tuple(n + 2 * GRID.margin for n in GRID.samples)
    light = torch.stack([torch.zeros(size), torch.ones(size)])[None]
    return Frames(light, light.clone(), torch.full_like(light, depth_um))


def _inside(image):
    """What no PSF reaches from beyond the frame."""
    return image[0, WINDOW // 2 : -(WINDOW // 2), WINDOW // 2 : -(WINDOW // 2)]


@pytest.mark.parametrize("depth_um", [4.5e3, 3.2e3, 8e3])
def test_even_light_is_as_even_as_the_field_is_stretched(depth_um):
    """Light of X lands at (1 + s) X: the image holds 1 / ((1 + s_y)(1 + s_x)) of it, at
    every depth alike. Sums over
    samples of Gaussians of 1.36 and more are integrals to 1e-8, those of a window's
    nodes within 1e-4."""
    few = _imager(STRETCH)
    want = 0.37 / ((1 + STRETCH[0]) * (1 + STRETCH[1]))
    seams = float((_inside(few(_even(depth_um))) / want - 1).abs().max())
    left = float((_inside(forming.evened(few)(_even(depth_um))) / want - 1).abs().max())
    assert seams > 0.03
    assert left < 2e-4


@pytest.mark.parametrize("depth_um", [4.5e3, 3e3, 8e3])
def test_one_kernel_holds_the_light_of_every_depth(depth_um):
    """PSFs at rest that are wider than the kernel or narrower: their light is 1,
    whatever the kernel lacks.
    """
    few = _imager((0.0, 0.0))
    assert (
        float((_inside(few(_even(depth_um))) / 0.37 - 1).abs().max()) < 1e-5
    )  # float32


def test_the_plain_sum_of_even_light_is_the_product_of_matrices():
    """Every pixel's PSF, interpolated and put down one by one, of a field without
    symmetry.
    """
    plan = _plan(1)
    draw = torch.Generator().manual_seed(5)
    stack = torch.rand(17, 19, 5, 3, generator=draw, dtype=torch.float64)
    energy = torch.rand(17, 19, generator=draw, dtype=torch.float64)
    between = forming.between_nodes(Grid((7, 9), STEP, (3e3, 3e3), window=1), plan)
    want = torch.zeros(7 + 4, 9 + 2, dtype=torch.float64)
    for i in range(7):
        for j in range(9):
            psf = torch.einsum(
                "a,b,ab,abyx->yx", between[0][i], between[1][j], energy, stack
            )
            want[i : i + 5, j : j + 3] += psf
    got = even.light(stack, energy, between)
    assert torch.allclose(got, want[2:-2, 1:-1], rtol=1e-12, atol=1e-12)


def test_other_psfs_bring_their_own_map():
    """PSFs that do not move need none: the map of those that do would be a seam itself."""
    moving = forming.evened(_imager(STRETCH))
    still = _moving(moving.plan, (0.0, 0.0))
    made = forming.with_psfs(moving, still, moving.energy)
    assert (
        float((_inside(made(_even(4.5e3))) / 0.37 - 1).abs().max()) < 2e-4
    )  # as above


@pytest.mark.parametrize("mapped", [False, True])
def test_the_gradient_is_that_of_every_place_with_its_own_psf(mapped):
    """To the stretch of the field, of an uneven scene, where one kernel a patch does
    not move at all.

    Truth: differences of plain sums over all sources, whose PSFs are known. Left are
    Lagrange's interpolation between
    nodes, and float32. The map of even light, which nodes need not, is not in it.
    """
    few, frames, reach = _imager(STRETCH), _even(4.5e3), WINDOW // 2
    frames.radiance[0, 1, 11:19, 17:20] = 3.1
    weight = torch.randn(
        GRID.samples, generator=torch.Generator().manual_seed(4), dtype=torch.float64
    )
    every = _plan()
    every.y_um, every.x_um = (
        torch.linspace(-h, h, n, dtype=torch.float64)
        for h, n in zip(GRID.half_um, GRID.frame, strict=True)
    )

    def plain(stretch):
        own = (
            0.37
            * frames.radiance[0, 1, ..., None, None]
            * _moving(every, (stretch, -0.03))[:, :, 1]
        )
        out = torch.zeros(
            GRID.frame[0] + 2 * reach, GRID.frame[1] + 2 * reach, dtype=torch.float64
        )
        for y in range(WINDOW):
            for x in range(WINDOW):
                out[y : y + GRID.frame[0], x : x + GRID.frame[1]] += own[..., y, x]
        return float(
            (weight * forming.returned(out[reach:-reach, reach:-reach], GRID)).sum()
        )

    stretch = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    optics = forming.evened(few) if mapped else few
    made = forming.with_psfs(optics, _moving(few.plan, (stretch, -0.03)), few.energy)
    (weight * made(frames)[0]).sum().backward()
    assert float(stretch.grad) == pytest.approx(
        (plain(0.051) - plain(0.049)) / 2e-3, rel=2e-3
    )


def test_nodes_that_are_not_asked_for_have_no_gradient_and_the_others_their_own():
    few, frames = _imager(STRETCH), _even(4.5e3)
    found = []
    for asked in (None, {5, 40, 211}):
        stack = few.stack.clone().requires_grad_()
        (
            forming.with_psfs(replace(few, asked=asked), stack, few.energy)(frames) ** 2
        ).sum().backward()
        found.append(stack.grad.flatten(0, 1))
    whole, some = found
    wanted = torch.tensor([5, 40, 211])
    near = 1e-5 * float(
        whole[wanted].abs().max()
    )  # single precision, in products of other widths
    assert float((some[wanted] - whole[wanted]).abs().max()) < near
    assert int((some.flatten(1).abs().amax(1) > 0).sum()) == 3


def test_the_dark_is_left_as_it_is():
    ratio = even.ratio(
        torch.tensor([2.0, 1e-9, 0.0, 1.0]), torch.tensor([1.0, 1e-6, 0.0, -1e-7])
    )
    assert torch.allclose(
        ratio, torch.tensor([2.0, 1.0, 1.0, 1.0]), atol=3e-3
    )  # ε of 0.02: 4e-4 of the first


def test_a_lens_shows_no_seam_where_its_patches_meet():
    """A loose image 15° off the axis, at the middle where four patches meet, on a seam
    and beside both, against the sum
    over every sample of its own PSF, cos⁴ included. What is left is what few nodes of
    the field miss between them."""
    distance, middle = 240.0, (60.0, -21.0)
    wave = SmoothWave(Focus(0.85, distance, 6000.0), 50.0)
    grid = Grid((44, 47), 4.8, (6000.0, 6000.0), margin=7, window=15)
    angles = tuple(math.atan(place / distance) for place in middle)
    made = imager(wave, grid, field=angles, tolerance=0.1)
    size = tuple(n + 2 * grid.margin for n in grid.samples)
    one = torch.stack([torch.zeros(size), torch.ones(size)])[None]
    got = made(Frames(one, one.clone(), torch.full_like(one, 6000.0)))[0]
    assert len(made.patches) == 4
    for row, column in ((22, 23), (22, 8), (9, 10)):
        y, x = torch.meshgrid(
            torch.arange(15.0) - 7 + row, torch.arange(15.0) - 7 + column, indexing="ij"
        )
        at = (
            torch.stack([(x - 23) * 4.8 + middle[0], (y - 21.5) * 4.8 + middle[1]], -1)
            .double()
            .flatten(0, 1)
        )
        about = {
            "depths_um": torch.tensor([6000.0]),
            "wavelength_um": 0.85,
            "window": made.plan.window,
        }
        seen = psfs(Optics(wave, Layers(), distance), at, **about)[:, 0]
        fall = 1 / (1 + (at**2).sum(-1) / distance**2) ** 2
        index = torch.arange(225)
        want = float((seen[index, 14 - index // 15, 14 - index % 15] * fall).sum())
        assert float(got[row, column]) == pytest.approx(want, rel=0.015), (row, column)


def test_faint_light_is_put_right_by_halves_at_a_hundredth_of_the_most():
    """wanted / found where there is light; at f = 1 % of the most the change (w - f) /
    f halves, below it fades.
    """
    wanted = torch.tensor([[2.0, 0.03, 0.0], [0.0, 1.7, 0.0002]], dtype=torch.float64)
    found = torch.tensor([[1.6, 0.02, 0.0], [0.02, 1.9, 0.0001]], dtype=torch.float64)
    ratio = even.ratio(wanted, found)
    assert ratio[0, 1].item() == pytest.approx(1 + 0.5 * 0.5)
    assert ratio[0, 2].item() == 1.0
    assert ratio[1, 0].item() == pytest.approx(1 - 0.5)
    assert ratio[1, 2].item() == pytest.approx(
        1.0, abs=3e-5
    )  # (f / 1 %)² of a change of 1
    lit = wanted > 1
    assert ratio[lit].numpy() == pytest.approx(
        (wanted / found)[lit].numpy(), rel=4e-5
    )  # a quarter of (0.02 / 1.6)²
