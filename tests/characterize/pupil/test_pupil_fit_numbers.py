"""Which planes a pupil is fitted to and judged by, where the light is looked for, and
how large the window is.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import FitImages
from characterize.pupil import fit as pupilfit
from characterize.pupil.judge import measure_agreement, predict_by_splines
from characterize.pupil.record import PupilModel, PupilSpec

RNG = np.random.default_rng(8)
SPEC = PupilSpec(
    0.3,
    0.5,
    0.4,
    window=16,
    phase_order=4,
    amplitude_order=2,
    drift_order=1,
    model_error=0.0,
)


def data_of(light):
    everywhere = np.ones(light.shape, bool)
    return FitImages(
        light, everywhere, ~everywhere, np.full(light.shape, 4.0), np.ones(light.shape)
    )


@pytest.mark.parametrize(
    ("shape", "window"), [((12, 20), 12), ((30, 14), 14), ((30, 40), 16)]
)
def test_a_window_is_no_larger_than_the_frame(shape, window):
    seen = SimpleNamespace(
        frames=np.zeros((3, *shape)), wavelength_um=0.7, pixel_um=0.2
    )
    assert pupilfit._complete(SPEC, seen).window == window
    unknown = dataclasses.replace(
        SPEC, wavelength_um=float("nan"), pixel_um=float("nan")
    )
    made = pupilfit._complete(unknown, seen)
    assert (made.wavelength_um, made.pixel_um) == (0.7, 0.2)
    made = pupilfit._complete(SPEC, seen)
    assert (made.wavelength_um, made.pixel_um) == (SPEC.wavelength_um, SPEC.pixel_um)


def spot(light, row, column, half, height, planes):
    light[planes, row - half : row + half + 1, column - half : column + half + 1] += (
        height
    )


@pytest.mark.parametrize(
    ("half", "height", "planes"),
    [(0, 4400.0, 1), (1, 290.0, 7), (0, 800.0, 7), (3, 270.0, 7)],
    ids=["flash of one plane", "weaker in all", "a hot pixel", "wide and even"],
)
def test_light_is_looked_for_in_the_brightest_three_planes_seen_through_a_pixel_of_blur(
    half, height, planes
):
    """A square of 3 pixels and 360 in three planes. One pixel keeps 0.16 of its height
    under the blur, a square of
    three 0.78, one of seven all: 281 of it stand against
    233, 226, 127 and 270."""
    light = np.zeros((7, 31, 33))
    spot(light, 9, 22, 1, 360.0, slice(1, 4))
    spot(light, 21, 8, half, height, slice(0, planes))
    light[:, 28, 30] = np.nan
    assert pupilfit._find(light) == (9, 22)


@pytest.mark.parametrize(("window", "first"), [(15, (7, 13)), (16, (6, 12))])
def test_a_window_of_odd_size_has_its_middle_at_the_bead(window, first):
    light = np.full((4, 30, 41), 20.0)
    spot(light, 14, 20, 1, 500.0, slice(0, 4))
    found, _, notes = pupilfit._crop(
        frames_of(light), dataclasses.replace(SPEC, window=window)
    )
    assert found.electrons == pytest.approx(
        light[:, first[0] :, first[1] :][:, :window, :window]
    )
    assert notes == []


def frames_of(light):
    return SimpleNamespace(
        electrons=light, usable=np.ones(light.shape, bool), saturated=np.zeros(light.shape, bool),
        variance_e2=np.ones(light.shape), scale=np.ones(light.shape),
    )  # fmt: skip


def test_a_bead_is_found_on_a_slope_that_is_brighter_and_its_background_is_the_least_fifth():
    """20 electrons a pixel across, 800 in all, and a bead of 300; noise of 9 about the
    plane.
    """
    x = np.tile(np.arange(41.0), (30, 1))
    noise = RNG.normal(0, 9, (30, 41))
    light = np.tile(100 + 20.0 * x + noise, (4, 1, 1))
    spot(light, 14, 20, 2, 300.0, slice(0, 4))
    found, background, notes = pupilfit._crop(frames_of(light), SPEC)
    part = light[:, 6:22, 12:28]
    plane = pupilfit._plane(part)
    assert found.electrons == pytest.approx(part - plane)
    assert background == pytest.approx(np.percentile(part - plane, 20), rel=1e-12)
    assert plane == pytest.approx(
        (20.0 * (x - x[:, 12:28].mean()))[:16, 12:28], abs=9.0
    )  # 9 over 90 pixels, at corners
    assert ["plane" in words for words in notes] == [True]


def test_a_start_moves_to_a_bead_off_the_middle():
    """Pixels of 0.4 um from row and column 8: 5 rows down are 2 um along y, 3 columns
    to the left -1.2 along x.
    """
    light = np.full((4, 16, 16), 12.0)
    spot(light, 13, 5, 1, 90.0, slice(0, 4))
    pupil = PupilModel(
        SPEC, np.array([-8.0, -3.0, 1.0, 6.0]), phase_order=4, amplitude_order=2
    )
    phase, amplitude, dx, dy, *_ = pupil.layout().split(
        pupilfit._start(pupil, data_of(light), 0.0)
    )
    assert dx.tolist() == pytest.approx([-1.2, *[0] * (len(dx) - 1)])
    assert dy.tolist() == pytest.approx([2.0, *[0] * (len(dy) - 1)])
    assert not np.concatenate([phase, amplitude]).any()


def test_low_orders_from_three_starts_then_all_from_the_best(monkeypatch):
    position, asked = np.array([-8.0, -3.0, 1.0, 6.0]), []
    light = np.full((4, 16, 16), 12.0)
    spot(light, 8, 8, 1, 90.0, slice(0, 4))
    spec = dataclasses.replace(SPEC, phase_order=5)

    def fit(images, data, start, *, prior, settings):
        asked.append((images.__self__, start, settings))
        merit = (3.0, 1.0, 2.0, 0.0)[len(asked) - 1]
        return SimpleNamespace(value=start + 0.01 * len(asked), merit=merit)

    monkeypatch.setattr(pupilfit.leastsquares, "fit_levenberg_marquardt", fit)
    model, solution = pupilfit._fit(spec, position, data_of(light))
    models, starts, settings = zip(*asked, strict=True)
    place = models[0].phase_indices.index((4, 0))
    assert [float(start[place]) for start in starts[:3]] == pytest.approx(
        [0.0, 0.8, -0.8]
    )
    assert {max(n for n, _ in each.phase_indices) for each in models[:3]} == {4}
    assert [len(each.amplitude_indices) for each in models] == [
        0,
        0,
        0,
        len(model.amplitude_indices),
    ]
    assert models[3] is model
    assert max(n for n, _ in model.phase_indices) == 5
    whole, best = (
        model.layout().split(starts[3]),
        models[1].layout().split(starts[1] + 0.02),
    )
    for part, before in zip(whole[2:], best[2:], strict=True):
        assert part == pytest.approx(before)
    assert whole[0][: len(best[0])] == pytest.approx(best[0])
    assert (model.layout().size, solution.value[0]) == (
        len(starts[3]),
        pytest.approx(starts[3][0] + 0.04),
    )
    for each in settings[:3]:
        assert (
            each.iterations,
            each.step_tolerance,
            each.near,
            each.secant,
            each.finish,
        ) == (12, 1.0, 1.0, True, False)
    last = settings[3]
    assert (
        last.iterations,
        last.step_tolerance,
        last.near,
        last.secant,
        last.finish,
    ) == (60, 1.0, 2.0, True, True)


@pytest.mark.parametrize(
    ("count", "sparse", "seen"),
    [
        (5, 2, [0, 2, 4]),
        (4, 2, [0, 1, 2, 3]),
        (7, 3, [0, 3, 6]),
        (6, 3, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_what_is_free_is_found_from_some_planes_where_there_are_twice_as_many(
    monkeypatch, count, sparse, seen
):
    position = np.array([9.0, 7.0, 4.5, 1.0, -0.5, -3.0, -7.0])[:count]
    asked = {}

    def freed(spec, part, planes, coarse, *, step_um):
        asked.update(part=part, planes=planes, step_um=step_um)
        return spec, np.array([1.5]), 1.25

    monkeypatch.setattr(pupilfit, "fit_free_settings", freed)
    light = RNG.uniform(5, 9, (count, 16, 16))
    made, scaled, optics = pupilfit._freed(SPEC, position, data_of(light), sparse)
    assert made is SPEC
    assert scaled == pytest.approx(1.25 * position)
    assert optics == pytest.approx([1.5])
    assert asked["part"] == pytest.approx(position[seen])
    assert np.array_equal(asked["planes"].electrons, light[seen])
    assert asked["step_um"] == pytest.approx((position[0] - position[-1]) / (count - 1))


@pytest.mark.parametrize(
    ("sparse", "seen", "hidden"),
    [(2, [0, 2, 4, 6], [1, 3, 5]), (3, [0, 3, 6], [1, 2, 4, 5])],
)
@pytest.mark.parametrize("sigma_um", [0.0, 0.4])
def test_planes_left_out_are_told_with_gains_and_levels_between_their_neighbours(
    monkeypatch, sparse, seen, hidden, sigma_um
):
    """The stack is what a model of all planes makes of parameters whose gains and
    levels are linear between the planes
    that are fitted: told exactly, whichever way the stage ran; stage errors begin at 0.
    """
    position = np.array([9.0, 7.0, 4.5, 1.0, -0.5, -3.0, -7.0])
    spec = dataclasses.replace(SPEC, stage_sigma_um=sigma_um)
    exact = dataclasses.replace(spec, stage_sigma_um=0.0)
    fitted = PupilModel(exact, position[seen], phase_order=4, amplitude_order=2)
    value = RNG.normal(0, 0.05, fitted.layout().size)
    n = len(seen)
    value[-2 * n : -n], value[-n:] = RNG.uniform(6, 7, n), RNG.uniform(10, 30, n)
    value[-2 * n - 1] = 0.3
    gain, level = (
        np.interp(position, position[seen][::-1], part[::-1])
        for part in (value[-2 * n : -n], value[-n:])
    )
    whole = PupilModel(exact, position, phase_order=4, amplitude_order=2)
    whole.span_um = fitted.span_um
    x = np.concatenate([value[: -2 * n], gain, level])
    seen_data = data_of(whole.images(x, False)[0])
    asked = []

    def fit(*words):
        asked.append(words)
        return fitted, SimpleNamespace(value=value)

    monkeypatch.setattr(pupilfit, "_fit", fit)
    told, between, start = pupilfit._judge(spec, position, seen_data, 12.0, sparse)
    assert asked[0][0] == exact
    assert asked[0][1] == pytest.approx(position[seen])
    assert np.array_equal(asked[0][2].electrons, seen_data.electrons[seen])
    assert (told.ncc, told.nrmse) == pytest.approx((1.0, 0.0), abs=1e-12)
    smooth = predict_by_splines(position, seen_data, np.array(seen), np.array(hidden))
    assert between == measure_agreement(
        smooth, seen_data.planes(np.array(hidden)), 12.0
    )
    large = PupilModel(spec, position, phase_order=4, amplitude_order=2).layout()
    assert large.size == len(start)
    phase, amplitude, dx, dy, dz, blur, gains, levels = large.split(start)
    assert np.concatenate([phase, amplitude, dx, dy, [blur]]) == pytest.approx(
        value[: -2 * n]
    )
    assert not dz.any()
    assert (gains, levels) == (pytest.approx(gain), pytest.approx(level))


def test_too_few_planes_are_not_judged():
    assert pupilfit._judge(SPEC, np.arange(4.0), None, 0.0, 2) == (None, None, None)
    assert pupilfit._judge(SPEC, np.arange(6.0), None, 0.0, 3) == (None, None, None)
