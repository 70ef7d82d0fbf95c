"""Evenly lit planes and eye-like frames beside a direct sum, every source with a PSF of
its own: no basis, nodes or splines of the imager.
"""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.image import (
    Frames,
    Grid,
    Optics,
    SmoothWave,
    Window,
    image_direct,
    imager,
    psfs,
)
from metalens.optics import Layers, Stop
from metalens.psf import SpectralNodes

DISTANCE, RADIUS, STEP, SAMPLES, MARGIN = 600.0, 90.0, 10.0, 14, 4
FRAME, WINDOW = SAMPLES + 2 * MARGIN, 2 * MARGIN + 1
NEAR, FAR = 3e3, 12e3
WAVES = SpectralNodes(np.array([0.838, 0.861]), np.array([0.37, 0.63]), 0.0)
GLASS = Film(Index(1.5), 0.2 * DISTANCE)
STOP = Stop(75.0, 60.0)
WAVE = SmoothWave(Focus(0.85, DISTANCE, 7e3), RADIUS)
CASES = {
    "axis": (0.0, Layers()),
    "axis, film and stop": (0.0, Layers(behind=(GLASS,), stop=STOP)),
    "25 degrees": (math.radians(25.0), Layers()),
    "25 degrees, film": (math.radians(25.0), Layers(behind=(GLASS,))),
}


def _grid():
    return Grid((SAMPLES, SAMPLES), STEP, (NEAR, FAR), margin=MARGIN, window=WINDOW)


@functools.cache
def _made(case, tolerance):
    angle, layers = CASES[case]
    about = {"layers": layers, "field": (angle, 0.0), "tolerance": tolerance}
    return imager(WAVE, _grid(), spectrum=WAVES, **about)


def _light(case, depths_um, *, finer=1, rows=slice(None)):
    """(rows, columns, depths, h, w) light of every source of the frame, by its PSF and
    cos⁴ of its ray through the middle of the stop.
    """
    angle, layers = CASES[case]
    reduced = layers.after(DISTANCE, 0.85).reduced_um
    count, step = FRAME * finer, STEP / finer
    place = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * step
    y, x = torch.meshgrid(place[rows], place + reduced * math.tan(angle), indexing="ij")
    at = torch.stack([x.flatten(), y.flatten()], -1)
    depths = torch.tensor(depths_um, dtype=torch.float64)
    # light from the side needs the second order of its distance from the middle
    samples = WINDOW * finer - (finer - 1)
    window = Window(samples, step, curved=angle != 0, period=1.5)
    optics, total = Optics(WAVE, layers, DISTANCE), 0.0
    with torch.no_grad():
        for wave, weight in zip(WAVES.wavelengths_um, WAVES.weights, strict=True):
            about = {"depths_um": depths, "wavelength_um": wave, "window": window}
            total = total + weight * psfs(optics, at, **about)
    gap = 0.0 if layers.stop is None else layers.stop.distance_um
    slope2 = (at / reduced).square().sum(-1)[:, None] * (depths / (depths - gap)) ** 2
    light = total * ((1 + slope2) ** -2)[..., None, None].to(total)
    return light.reshape(*x.shape, *light.shape[1:]).double()


def _rest(plane):
    """Peak to peak of what a 5th-order polynomial leaves, over the mean."""
    y, x = np.mgrid[-1 : 1 : plane.shape[0] * 1j, -1 : 1 : plane.shape[1] * 1j]
    terms = np.stack([x**i * y**j for i in range(6) for j in range(6 - i)], -1)
    terms = terms.reshape(-1, 21)
    values = plane.numpy().astype(float).ravel()
    left = values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]
    return np.ptp(left) / values.mean()


def _plane(made, depth_um):
    depth = torch.as_tensor(depth_um, dtype=torch.float32).expand(1, FRAME, FRAME)
    return made.surface(torch.ones(1, FRAME, FRAME), depth.contiguous())[0]


@pytest.mark.parametrize(
    ("case", "tolerance"),
    [(case, 0.1) for case in CASES] + [("axis", 0.01), ("25 degrees", 0.01)],
)
def test_an_even_plane_is_even_at_every_depth(case, tolerance):
    """1 % of the rest: sampling leaves a direct sum 0.7 to 1 % at such steps."""
    made = _made(case, tolerance)
    for depth in 1 / np.linspace(1 / NEAR, 1 / FAR, 11):
        assert _rest(_plane(made, depth)) < 0.01


@pytest.mark.parametrize("case", ["axis", "25 degrees, film"])
def test_an_even_plane_is_that_of_the_direct_sum_at_half_the_step(case):
    """Of one row of the image: sources of half a step in both directions."""
    made = _made(case, 0.1)
    depths, row = (3.3e3, 9.1e3), FRAME // 2
    high = 2 * WINDOW - 1
    reach = (high - 1) // 2
    few = slice(2 * row - reach, 2 * row + 2 + reach)
    light = _light(case, depths, finer=2, rows=few)
    for number, depth in enumerate(depths):
        fine = image_direct(torch.ones(light.shape[:2]).double(), light[:, :, number])
        fine = fine[:, : fine.shape[1] // 2 * 2]
        want = fine.reshape(1, 2, -1, 2).mean((1, 3))[0]
        got = _plane(made, depth)[row - MARGIN].double()
        assert len(want) == len(got)
        ratio = got / want
        assert float(ratio.max() - ratio.min()) < 0.015


def test_a_step_in_depth_leaves_the_plane_even_away_from_it():
    made = _made("axis", 0.1)
    depth = torch.full((1, FRAME, FRAME), 4.1e3)
    depth[..., : FRAME // 2 - 4] = 9.7e3
    image = made.surface(torch.ones(1, FRAME, FRAME), depth)[0]
    inside = image[:, SAMPLES // 2 + 1 :]  # half a window and more from the step
    assert _rest(inside) < 0.01


def _eye(seed):
    """Skin, sclera, iris and pupil with a 1/f texture on a ball before a tilted face."""
    draw = np.random.default_rng(seed)
    y, x = np.mgrid[-1 : 1 : FRAME * 1j, -1 : 1 : FRAME * 1j]
    f = np.hypot(np.fft.fftfreq(FRAME)[:, None], np.fft.fftfreq(FRAME)) + 0.3 / FRAME
    rough = np.fft.ifft2(np.fft.fft2(draw.standard_normal(x.shape)) / f).real
    r = np.hypot(x - 0.15, y + 0.1)
    light = 0.55 + 0.12 * rough / rough.std()
    for radius, level in ((0.62, 0.9), (0.34, 0.45), (0.14, 0.05)):
        share = 1 / (1 + np.exp((r - radius) * FRAME / 3))
        light = light * (1 - share) + level * share
    depth = 6e3 + 1.8e3 * x + 0.6e3 * y - 1.9e3 * np.sqrt(np.clip(1 - r**2, 0, None))
    return torch.from_numpy(light.clip(0)), torch.from_numpy(depth.clip(NEAR, FAR))


@pytest.mark.parametrize(
    ("case", "tolerance"),
    [
        pytest.param("axis, film and stop", 0.1, marks=pytest.mark.slow),
        ("25 degrees", 0.01),
    ],
)
def test_eye_like_frames_and_planes_err_by_no_more_than_is_stated(case, tolerance):
    """The direct sum interpolates nothing: each source has the PSF of its depth."""
    made = _made(case, tolerance)
    radiance, depth = _eye(5)
    steps = 1 / np.linspace(1 / FAR, 1 / NEAR, 13)[::-1]
    light = _light(case, tuple(steps))
    # cubic in 1/z between 13 depths, two of three of which the imager does not have
    place = (1 / NEAR - 1 / depth) / (1 / NEAR - 1 / FAR) * 12
    first = (place.floor() - 1).clamp(0, 9).long()
    own = 0
    for k in range(4):
        weight = torch.ones_like(place)
        for j in range(4):
            if j != k:
                weight = weight * (place - first - j) / (k - j)
        at = (first + k)[..., None, None, None].expand(-1, -1, 1, WINDOW, WINDOW)
        own = own + weight[..., None, None] * light.gather(2, at)[:, :, 0]
    want = image_direct(radiance, own)
    got = made.surface(radiance[None].float(), depth[None].float())[0].double()
    assert float((got - want).norm() / want.norm()) < made.error
    for number in (1, 6, 10):
        want = image_direct(torch.ones_like(radiance), light[:, :, number])
        got = _plane(made, steps[number]).double()
        assert float((got - want).norm() / want.norm()) < made.error


@pytest.mark.slow
def test_derivatives_by_the_psfs_and_by_depth_are_those_of_the_direct_sum():
    """All PSFs moved by a sample, and the depth of a tilted plane, by differences."""
    made = _made("axis", 0.1)
    radiance, _ = _eye(7)
    depth = torch.linspace(3.4e3, 10e3, FRAME).double().expand(FRAME, FRAME)
    light = _light("axis", tuple(depth[0].tolist()))
    column = torch.arange(FRAME)
    own = light[:, column, column]
    change = image_direct(radiance, own.roll(1, -1) - own)
    stack = made.stack.clone().requires_grad_()
    one, deep = radiance[None].float(), depth[None].float()
    (replace(made, stack=stack).surface(one, deep)[0] * change).sum().backward()
    moved = (stack.grad * (made.stack.roll(1, -1) - made.stack)).sum()
    want = float(change.square().sum())
    assert float(moved) == pytest.approx(want, rel=0.01)

    step = 1e-6
    near, far = (
        _light("axis", tuple((1 / (1 / depth[0] + s)).tolist()))[:, column, column]
        for s in (step, -step)
    )
    slope = image_direct(radiance, (near - far) / (2 * step))
    vergence = (1 / deep).requires_grad_()
    (made.surface(one, 1 / vergence)[0] * slope).sum().backward()
    want = float(slope.square().sum())
    # five depth nodes
    assert float(vergence.grad.sum()) == pytest.approx(want, rel=0.05)


def test_two_sheets_of_one_depth_image_as_one_plane():
    made = _made("axis", 0.01)
    cover = torch.zeros(1, 2, FRAME, FRAME)
    cover[0, 0, :13] = 1
    cover[0, 1, 13:] = 1
    depth = torch.full((1, 2, FRAME, FRAME), 5.3e3)
    both = made(Frames(cover, cover, depth))[0]
    assert float((both / _plane(made, 5.3e3) - 1).abs().max()) < 0.02


class _PastAnEdge:
    """The lens as a point beyond a near edge views it: dark where x > limit_um."""

    radius_um = RADIUS
    carrier_rad = staticmethod(WAVE.carrier_rad)

    def __init__(self, limit_um):
        self.limit_um = limit_um

    def factor(self, x_um, y_um, wavelength_um, angle_rad):
        share = (self.limit_um - x_um) / (x_um[0, 1] - x_um[0, 0]).abs() + 0.5
        return share.clamp(0, 1).to(torch.complex64)


def _behind_edge(near, far, edge, finer, rows):
    """(rows, columns, h, w) light of a far plane past a near sheet of ``edge`` columns.

    Of each point, by the part of the aperture that straight lines to it cross beside
    the edge.
    """
    step, samples = STEP / finer, (WINDOW - 1) * finer + 1
    place = (torch.arange(FRAME * finer) - (FRAME * finer - 1) / 2).double() * step
    light = torch.zeros(len(place[rows]), len(place), samples, samples).double()
    window = Window(samples, step, period=1.5)
    for column, x in enumerate(place.tolist()):
        limit = near / (1 - near / far) * (x / STEP - edge + FRAME / 2) * STEP
        optics = Optics(_PastAnEdge(limit / DISTANCE), Layers(), DISTANCE)
        if limit / DISTANCE < -RADIUS - 5:  # all of the lens lies behind the edge
            continue
        at = torch.stack([torch.full_like(place, x), place], -1)[rows]
        cosine4 = (1 + at.square().sum(-1) / DISTANCE**2) ** -2
        about = {"depths_um": torch.tensor([far]).double(), "window": window}
        for wave, weight in zip(WAVES.wavelengths_um, WAVES.weights, strict=True):
            with torch.no_grad():
                psf = psfs(optics, at, wavelength_um=wave, **about)[:, 0].double()
            light[:, column] += weight * psf * cosine4[:, None, None]
    return light


@pytest.mark.parametrize(
    ("near", "far", "edge"),
    [(3e3, 12e3, 11), pytest.param(3.5e3, 6e3, 9, marks=pytest.mark.slow)],
)
def test_occlusion_is_that_of_every_point_through_its_part_of_the_aperture(
    near, far, edge
):
    """Equal radiance of two sheets leaves no edge. Points of half a step leave 2 %:
    each is dark or bright past the edge as a whole.
    """
    made, finer = _made("axis", 0.01), 2
    middle, high = FRAME // 2, (WINDOW - 1) * finer + 1
    rows = slice(finer * middle - high // 2, finer * (middle + 1) + high // 2)
    plain = _light("axis", (near, far), finer=finer, rows=rows)
    past = _behind_edge(near, far, edge, finer, rows)
    solid = (torch.arange(FRAME) < edge).double().expand(FRAME, FRAME)
    fine = solid.repeat_interleave(finer, 1)[: len(past), :, None, None]
    for opacity, levels in ((1, (1, 1)), (1, (0.9, 0.4)), (1, (0.3, 1)), (0.6, (1, 1))):
        cover = torch.stack([opacity * solid, 1 - opacity * solid])
        radiance = cover * torch.tensor(levels)[:, None, None]
        depth = torch.tensor([near, far])[:, None, None].expand_as(cover)
        depth = torch.where(cover > 0, depth, 1.0)  # no depth where nothing is
        light = levels[0] * opacity * fine * plain[:, :, 0]
        light = light + levels[1] * (1 - opacity) * plain[:, :, 1]
        light = light + levels[1] * opacity * past

        def image(light):
            sums = image_direct(torch.ones(light.shape[:2]).double(), light)
            return sums.reshape(finer, -1, finer).mean((0, 2))

        want, even = image(light), image(plain[:, :, 1])
        frames = Frames(*(a.float()[None] for a in (radiance, cover, depth)))
        got = made(frames)[0, middle - MARGIN].double()
        assert float((got - want).norm() / want.norm()) < 0.02
        if levels == (1, 1):
            assert float((got / even - 1).abs().max()) < 0.01


@pytest.mark.parametrize(("focus", "tolerance"), [(33e3, 0.1), (20e3, 0.01)])
def test_planes_before_a_lens_of_a_millimetre_are_even(focus, tolerance):
    """±19 degrees and defocus from 12 to 50 mm on samples of 18 um, at depths that are
    no nodes. Rings of a direct sum, 0.6 to 1 %, are of its samples.
    """
    wave = SmoothWave(Focus(0.85, 2e3, focus), 500.0)
    grid = Grid((64, 64), 18.0, (12e3, 50e3), margin=8, window=17)
    made = imager(wave, grid, tolerance=tolerance)
    for depth in (12e3, 13e3, 15.1e3, 17e3, 21e3, 27e3, 33e3, 40e3, 47e3, 50e3):
        one = torch.ones(1, 80, 80)
        assert _rest(made.surface(one, depth * one)[0]) < 0.005, depth
