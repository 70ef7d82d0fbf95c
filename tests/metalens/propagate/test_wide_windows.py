"""Windows as wide as a sensor by Fourier transforms, against the exact sum of all
pillars at points of the window.
"""

import dataclasses

import numpy as np
import pytest
import torch

from metalens import propagate, psf
from metalens.core.errors import PropagationError
from metalens.optics import Media

PITCH, WAVELENGTH, DISTANCE = 0.43, 0.87, 430.0
DEPTHS = np.array([3100.0, 4300.0, 7700.0])
ABOUT = {
    "pitch_um": PITCH,
    "wavelength_um": WAVELENGTH,
    "sensor_distance_um": DISTANCE,
    "depths_um": DEPTHS,
}
WINDOW = {"window_um": (201 * 1.3, 191 * 1.3), "samples": (201, 191)}


def lens(shape=(590, 610)):
    """A lens that focuses some 15 um beside its axis, with random phases and levels on
    top, closed beyond its rim.
    """
    rng = np.random.default_rng(4)
    y, x = ((np.arange(n) - (n - 1) / 2) * PITCH for n in shape)
    r2 = (x - 15) ** 2 + (y[:, None] + 9) ** 2
    phase = (
        -2
        * np.pi
        / WAVELENGTH
        * (np.sqrt(r2 + DISTANCE**2) + np.sqrt(x**2 + y[:, None] ** 2 + 4300.0**2))
    )
    phase = phase + rng.normal(0, 0.5, shape)
    level = rng.uniform(0.5, 1, shape) * (x**2 + y[:, None] ** 2 < 124.0**2)
    return (phase + np.pi) % (2 * np.pi) - np.pi, level


def points(stack, count=20):
    """Flat indices: the brightest, some by chance, and the corners, where what wraps
    round would show.
    """
    rng = np.random.default_rng(8)
    high, wide_ = stack.shape[-2:]
    bright = np.argsort(stack[1].ravel())[-count:]
    return np.concatenate(
        [bright, rng.integers(0, high * wide_, count), [0, wide_ - 1, high * wide_ - 1]]
    )


@pytest.mark.parametrize(
    ("angle", "tolerance", "corner"),
    # corners: what is left of light that the padding holds and that wraps round, of
    # what shines there
    [((0.0, 0.0), 1e-4, 3e-4), ((0.17, -0.09), 1e-4, 3e-2), ((0.06, 0.11), 1e-7, 1e-2)],
)
def test_against_the_exact_sum_where_it_is_bright_and_in_the_corners(
    angle, tolerance, corner
):
    phase, level = lens()
    case = propagate.make_case(phase.shape, **ABOUT, **WINDOW, angle_rad=angle)
    made = propagate.plan_wide(case, tolerance / 2, torch.float64)
    light = propagate.light_on_window(
        (torch.tensor(phase)[None], torch.tensor(level)[None]), made
    )[0].numpy()
    at = points(light)
    y, x = np.divmod(at, case.samples[1])
    wy, wx = case.window_um
    where = np.stack([case.centre_um[0] + wx[x], case.centre_um[1] + wy[y]], -1)
    want = np.abs(propagate.field_at(phase, level, case, where)) ** 2
    got = light.reshape(3, -1)[:, at]
    share = np.linalg.norm(got - want, axis=1) / np.linalg.norm(want, axis=1)
    # the brightest weigh most: the relative L2 error that is asked for
    assert (share < tolerance).all()
    plain = np.abs(got - want)[:, 20:40].max(1) / want[:, 20:40].mean(1)
    assert (plain < 30 * tolerance).all()  # anywhere; of the mean of what is dim
    assert (np.abs(got - want)[:, 40:] < corner * want[:, 20:].mean()).all()


def test_through_films_it_is_the_windowed_field_of_the_same_window():
    """A filter of 60 um and a cover of 25 um; the middle of the window by the other
    method, whose error is 1e-6.
    """
    phase, level = (torch.tensor(m) for m in lens())
    films = Media((1.0, 1.52, 1.45), (DISTANCE - 85.0, 60.0, 25.0))
    case = dataclasses.replace(
        propagate.make_case(lens()[0].shape, **ABOUT, **WINDOW), behind=films
    )
    light = propagate.light_on_window(
        (phase[None], level[None]), propagate.plan_wide(case, 1e-6, torch.float64)
    )[0]
    # of the middle, both counts odd
    small = dataclasses.replace(case, samples=(21, 21))
    field = propagate.field_windowed(
        phase, level, propagate.plan_window(small, 1e-6, torch.float64)
    )
    want = field.abs() ** 2
    got = light[:, 95 - 10 : 95 + 11, 100 - 10 : 100 + 11]
    # plane waves against the ray of each pillar: the latter leaves out 1/(kL)² of the
    # amplitude, 1e-7, beside 1e-6
    assert float((got - want).norm() / want.norm()) < 1e-5


def test_the_stack_takes_it_and_says_what_it_errs():
    phase, level = lens()
    stack = psf.psf_stack(
        phase.astype("f4"), level.astype("f4"), **ABOUT, **WINDOW, integrate=False
    )
    assert "wide window" in stack.reason
    assert stack.converged
    light = stack.intensity * stack.energy_um2[:, None, None] / stack.step_um**2
    exact = psf.psf_stack(
        phase, level, **ABOUT, **WINDOW, integrate=False, tolerance=1e-7
    )
    want = exact.intensity * exact.energy_um2[:, None, None] / exact.step_um**2
    true = np.linalg.norm(light - want) / np.linalg.norm(want)
    # is stated in any case: 0.02 of the setting (5e-5) and the rounding of transforms,
    # 1e-6 each
    least = 1.5e-6
    # energies are compared too: they share float32's scatter
    assert true / 1.1 < stack.error < max(12 * true, least)


def test_gradients_are_those_of_differences():
    phase, level = (torch.tensor(m) for m in lens())
    case = propagate.make_case(tuple(phase.shape), **ABOUT, **WINDOW)
    made = propagate.plan_wide(case, 1e-6, torch.float64)
    draw = torch.Generator().manual_seed(3)
    weight = torch.rand(3, 191, 201, generator=draw, dtype=torch.float64)
    way = torch.randn(phase.shape, generator=draw, dtype=torch.float64)

    def merit(at):
        return (
            weight * propagate.light_on_window((at[None], level[None]), made)[0]
        ).sum()

    start = phase.clone().requires_grad_()
    (slope,) = torch.autograd.grad(merit(start), start)
    step = 1e-4
    with torch.no_grad():
        between = (merit(phase + step * way) - merit(phase - step * way)) / (2 * step)
    # step² of the third derivative
    assert float((slope * way).sum()) == pytest.approx(float(between), rel=1e-6)


def test_dark_corners_of_the_lens_take_fewer_fields_and_change_no_light():
    """Where a gradient is wanted all depth fields are taken: both ways are the same
    light to what may be left out.
    """
    phase, level = (torch.tensor(m) for m in lens())
    depths = 1 / np.linspace(1 / 7700.0, 1 / 1900.0, 17)
    made = propagate.plan_wide(
        propagate.make_case(
            tuple(phase.shape), **ABOUT | {"depths_um": depths}, **WINDOW
        ),
        1e-4,
        torch.float64,
    )
    few, _, _ = propagate.light_on_window((phase[None], level[None]), made)
    want = propagate.light_on_window((phase[None].requires_grad_(), level[None]), made)[
        0
    ].detach()
    # of a field rms 1e-4 over the whole plane: of the intensity twice that at most
    # where both lie alike
    left = float((few - want).norm() / want.norm())
    assert 1e-7 < left < 2e-4
    assert few.sum((1, 2)).numpy() == pytest.approx(want.sum((1, 2)).numpy(), rel=1e-4)


def test_narrow_windows_and_small_lenses_go_the_other_way():
    whole = propagate.make_case((610, 610), **ABOUT, **WINDOW)
    assert propagate.choose_method(whole, 1e-4, differentiable=True).method == "wide"
    narrow = propagate.make_case((610, 610), **ABOUT, window_um=31.0, samples=40)
    assert propagate.choose_method(narrow, 1e-4).method == "windowed"


def test_rays_that_graze_are_refused():
    steep = propagate.make_case(
        (610, 610), **ABOUT | {"sensor_distance_um": 40.0}, **WINDOW
    )
    with pytest.raises(PropagationError, match="too steep"):
        propagate.plan_wide(steep, 1e-4, torch.float64)
