"""The image engine against every scene point with its own PSF; invariants, gradients
and refusals.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from metalens.cell import Film, Index
from metalens.core.errors import PropagationError, SceneError
from metalens.design import Focus
from metalens.image import (
    Frames,
    Grid,
    Optics,
    SmoothWave,
    Window,
    imager,
    node_psfs,
    psfs,
    with_psfs,
)
from metalens.image.texture import texture_error
from metalens.optics import Layers
from metalens.psf import SpectralNodes

sys.path.insert(0, str(Path(__file__).parents[2]))
from referees.true_image import Referee

DISTANCE, RADIUS, FOCUS, STEP, WINDOW = 240.0, 50.0, 6000.0, 4.8, 15
WAVES = SpectralNodes(np.array([0.838, 0.861]), np.array([0.37, 0.63]), 0.0)
GRID = Grid((9, 7), STEP, (3000.0, 9000.0), margin=WINDOW // 2, window=WINDOW)
MIDDLE = (math.radians(9.0), math.radians(-4.0))


REFEREE = Referee(
    radius=RADIUS,
    distance=DISTANCE,
    focus=FOCUS,
    design_wavelength=0.85,
    fine=0.6,
    count=256,
)


def _depths():
    rows, columns = (n + 2 * GRID.margin for n in GRID.samples)
    down = np.linspace(0, 1, rows)[:, None]
    across = np.linspace(0, 1, columns)
    return 1 / (1 / 3000 + (1 / 9000 - 1 / 3000) * (0.1 + 0.5 * down + 0.3 * across))


def _texture():
    """1/f texture of mean 1 on image and margin."""
    draw = np.random.default_rng(5)
    rows, columns = (n + 2 * GRID.margin for n in GRID.samples)
    f = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)) + 0.5 / rows
    rough = np.fft.ifft2(np.fft.fft2(draw.standard_normal((rows, columns))) / f).real
    return np.clip(1 + 0.4 * (rough - rough.mean()) / rough.std(), 0.05, None)


def _frames(light, depth):
    one = torch.from_numpy(np.stack([np.zeros_like(light), light])[None])
    cover = torch.from_numpy(
        np.stack([np.zeros_like(light), np.ones_like(light)])[None]
    )
    return Frames(one, cover, torch.from_numpy(np.stack([depth, depth])[None]))


@pytest.fixture(scope="module")
def optics():
    return imager(
        SmoothWave(Focus(0.85, DISTANCE, FOCUS), RADIUS),
        GRID,
        spectrum=WAVES,
        field=MIDDLE,
        tolerance=1e-2,
    )


def _error(optics, light):
    got = optics(_frames(light, _depths()))[0].numpy()
    middle = DISTANCE * math.tan(MIDDLE[0]), DISTANCE * math.tan(MIDDLE[1])
    waves = list(zip(WAVES.wavelengths_um, WAVES.weights, strict=True))
    want = REFEREE.image(
        light, _depths(), step=STEP, window=WINDOW, waves=waves, middle=middle
    )
    m = GRID.margin
    want = want[m:-m, m:-m]
    return np.linalg.norm(got - want) / np.linalg.norm(want)


def test_the_image_of_a_texture_errs_by_no_more_than_it_says(optics):
    assert optics.error < 1.2e-2
    # 8 kinds of error, none of them the referee's: its rounding is 1e-12
    assert _error(optics, _texture()) < optics.error


def test_single_bright_points_lie_where_and_are_as_bright_as_the_referee_has_them(
    optics,
):
    """Points hold more of the high frequencies than a texture: twice the stated error,
    and place to 1 / 50 sample.
    """
    light = np.zeros_like(_depths())
    light[9, 11], light[14, 8] = 7.3, 2.1
    assert _error(optics, light) < 2.5 * optics.error


def test_films_behind_the_lens_are_in_the_image():
    """Glass of 0.5 of the way, index 1.5, moves focus by 40 um of 240: without it the
    image is another one.
    """
    layers = Layers(behind=(Film(Index(1.5), 0.25 * DISTANCE),))
    window = Window(WINDOW, STEP)
    wave = SmoothWave(Focus(0.85, DISTANCE, FOCUS), RADIUS)
    place, depth = (31.0, -22.0), 5000.0
    at = torch.tensor([place], dtype=torch.float64)
    got, bare = (
        psfs(
            Optics(wave, films, DISTANCE),
            at,
            depths_um=torch.tensor([depth]),
            wavelength_um=0.85,
            window=window,
        )[0, 0]
        for films in (layers, Layers())
    )
    about = {
        "radius": RADIUS,
        "distance": DISTANCE,
        "focus": FOCUS,
        "design_wavelength": 0.85,
        "fine": 0.6,
        "count": 256,
    }
    glass = Referee(films=((1.5, 0.25 * DISTANCE),), **about)
    want = torch.from_numpy(
        glass.sampled(glass.intensity(place, depth, 0.85), STEP, WINDOW).copy()
    )
    scaled = got.double() * (want.sum() / got.sum())
    assert float(texture_error(scaled, want)) < 6e-3  # rim and fold, as in air
    # 4 % of one face at normal incidence
    assert float(got.sum() / want.sum()) == pytest.approx(0.96, abs=4e-3)
    assert float(texture_error(bare.double(), want)) > 0.02


def test_a_slow_lens_whose_blur_is_many_samples_wide():
    """NA 0.025: fewer nodes across the pupil than harmonics of the window, so that both
    decide the transform's size.
    """
    window, far = Window(31, STEP), 2000.0
    optics = Optics(SmoothWave(Focus(0.85, far, FOCUS), RADIUS), Layers(), far)
    place, depth = (130.0, -71.0), 5200.0
    at = torch.tensor([place], dtype=torch.float64)
    got = psfs(
        optics, at, depths_um=torch.tensor([depth]), wavelength_um=0.85, window=window
    )[0, 0].double()
    slow = Referee(
        radius=RADIUS,
        distance=far,
        focus=FOCUS,
        design_wavelength=0.85,
        fine=0.6,
        count=512,
    )
    want = torch.from_numpy(
        slow.sampled(slow.intensity(place, depth, 0.85), STEP, window.samples).copy()
    )
    # what the sharp rim bends beyond the window folds back: 4√2 / (π² k p h) of the
    # light, here 4 %
    beyond = (
        4
        * math.sqrt(2)
        / (
            math.pi**2
            * 2
            * math.pi
            / 0.85
            * RADIUS
            / math.hypot(far, RADIUS)
            * 15.5
            * STEP
        )
    )
    assert float(texture_error(got * (want.sum() / got.sum()), want)) < beyond


def test_wide_psfs_to_second_order_of_their_width():
    """Far out of focus 25° off the axis the light is 80 um wide, a third of the
    distance to the lens: the flux of the
    second order takes what the first leaves down to rim and fold, 3e-3."""
    wave = SmoothWave(Focus(0.85, DISTANCE, FOCUS), RADIUS)
    place = (100.0, -52.0)
    depth = 300.0
    optics = Optics(wave, Layers(), DISTANCE)
    at = torch.tensor([place], dtype=torch.float64)
    wide = Referee(
        radius=RADIUS,
        distance=DISTANCE,
        focus=FOCUS,
        design_wavelength=0.85,
        fine=0.6,
        count=512,
    )
    want = torch.from_numpy(
        wide.sampled(wide.intensity(place, depth, 0.85), STEP, 31).copy()
    )
    errors = []
    for curved in (False, True):
        window = Window(31, STEP, curved)
        got = psfs(
            optics,
            at,
            depths_um=torch.tensor([depth]),
            wavelength_um=0.85,
            window=window,
        )[0, 0].double()
        errors.append(float(texture_error(got * (want.sum() / got.sum()), want)))
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 4e-3


def test_films_thicker_than_the_gap_are_refused():
    layers = Layers(behind=(Film(Index(1.5), 300.0),))
    with pytest.raises(
        PropagationError, match="300 um in the 240 um from lens to sensor"
    ):
        layers.after(DISTANCE, 0.85)


@pytest.mark.parametrize("tolerance", [0.0, -1.0, 1.0])
def test_tolerances_that_mean_nothing_are_refused(tolerance):
    with pytest.raises(SceneError, match="tolerance"):
        imager(
            SmoothWave(Focus(0.85, DISTANCE, FOCUS), RADIUS),
            GRID,
            spectrum=WAVES,
            tolerance=tolerance,
        )


def test_frames_of_another_size_are_refused(optics):
    with pytest.raises(SceneError, match="samples, need"):
        optics(_frames(np.ones((9, 7)), np.full((9, 7), 4e3)))


def test_compiled_and_differentiable_paths_give_one_image(optics):
    single = _frames(_texture().astype(np.float32), _depths().astype(np.float32))
    quick = optics(single)
    slow = optics(
        Frames(
            single.radiance.clone().requires_grad_(), single.coverage, single.depth_um
        )
    )
    assert slow.requires_grad
    # single precision
    assert float((quick - slow.detach()).norm() / quick.norm()) < 1e-5


def test_frames_of_one_sheet_are_imaged_as_a_near_sheet_too_faint_to_hide_makes_them(
    optics,
):
    """The short path for opaque frames against the two-sheet one, which a near sheet of
    1e-6 somewhere calls for.
    """
    alone = _frames(_texture().astype(np.float32), _depths().astype(np.float32))
    touched = alone.coverage.clone()
    touched[0, 0, 3, 2], touched[0, 1, 3, 2] = 1e-6, 1 - 1e-6
    both = optics(Frames(alone.radiance, touched, alone.depth_um))
    # single precision, and the 1e-6
    assert float((optics(alone) - both).norm() / both.norm()) < 2e-5


@pytest.mark.parametrize("kind", ["coma", "defocus"])
def test_the_gradient_to_a_phase_is_that_of_plane_waves(optics, kind):
    """Five bright points, five weights of the image: root mean square of d Σ weight
    image / d strength against
    differences of the referee's images. PSFs' own slopes are off by 0.03, those between
    the nodes by as much;
    through the eleven kernels of the image it was 0.09 and 0.28.
    """

    def added(strength):
        bent = {
            "coma": lambda x, y: 1.7 * x * (x**2 + y**2) - x,
            "defocus": lambda x, y: 2 * x**2 + 1.6 * y**2,
        }[kind]
        return lambda x, y: strength * bent(x / RADIUS, y / RADIUS)

    draw, size, step = np.random.default_rng(8), (23, 21), 0.02
    light = np.zeros(size)
    light[draw.integers(7, 16, 5), draw.integers(7, 14, 5)] = draw.uniform(0.5, 1.5, 5)
    weight = draw.standard_normal((5, *GRID.samples))
    middle = DISTANCE * math.tan(MIDDLE[0]), DISTANCE * math.tan(MIDDLE[1])
    about = {
        "radius": RADIUS,
        "distance": DISTANCE,
        "focus": FOCUS,
        "design_wavelength": 0.85,
    }
    waves = list(zip(WAVES.wavelengths_um, WAVES.weights, strict=True))
    ends = [
        Referee(**about, fine=0.6, count=256, extra=added(s)).image(
            light, _depths(), step=STEP, window=WINDOW, waves=waves, middle=middle
        )[7:-7, 7:-7]
        for s in (step, -step)
    ]
    want = (weight * (ends[0] - ends[1])).sum((1, 2)) / (2 * step)
    strength = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    lens = Optics(
        SmoothWave(Focus(0.85, DISTANCE, FOCUS), RADIUS, added(strength)),
        Layers(),
        DISTANCE,
    )
    image = with_psfs(optics, *node_psfs(lens, optics.plan))(_frames(light, _depths()))[
        0
    ]
    got = [
        float(
            torch.autograd.grad(
                (torch.from_numpy(w) * image).sum(), strength, retain_graph=True
            )[0]
        )
        for w in weight
    ]
    assert np.linalg.norm(np.array(got) - want) < 0.06 * np.linalg.norm(want)


def test_the_gradient_to_the_depth_of_sources_is_that_of_plane_waves(optics):
    """Five bright points, five weights of the image: d Σ weight image / d (1/z) of each
    point against differences of
    the referee's images. Polynomials between the depth nodes and PSFs' own slopes leave
    0.06; through
    the eleven kernels of the image it was 0.10."""
    draw, size, step = np.random.default_rng(11), (23, 21), 2e-6
    light = np.zeros(size)
    places = list(zip(draw.integers(7, 16, 5), draw.integers(7, 14, 5), strict=True))
    for place in places:
        light[place] = draw.uniform(0.5, 1.5)
    weight = draw.standard_normal((5, *GRID.samples))
    middle = DISTANCE * math.tan(MIDDLE[0]), DISTANCE * math.tan(MIDDLE[1])
    waves = list(zip(WAVES.wavelengths_um, WAVES.weights, strict=True))
    about = {"step": STEP, "window": WINDOW, "waves": waves, "middle": middle}
    want = []
    for place in places:
        alone = np.where(
            np.arange(light.size).reshape(size) == np.ravel_multi_index(place, size),
            light,
            0,
        )
        near, far = (
            REFEREE.image(alone, 1 / (1 / _depths() + s), **about)[7:-7, 7:-7]
            for s in (step, -step)
        )
        want.append((weight * (near - far)).sum((1, 2)) / (2 * step))
    frames = _frames(light, _depths())
    vergence = (1 / frames.depth_um).requires_grad_()
    image = optics(Frames(frames.radiance, frames.coverage, 1 / vergence))[0]
    sums = (torch.from_numpy(weight) * image).sum((1, 2))
    every = torch.stack(
        [torch.autograd.grad(s, vergence, retain_graph=True)[0][0, 1] for s in sums]
    )
    got = np.array([every[:, y, x].numpy() for y, x in places])
    assert np.linalg.norm(got - np.array(want)) < 0.08 * np.linalg.norm(want)
