"""Error bars at places where the usual case hides them: bounds, outliers, few pixels,
chi-square below 1, bent ends.
"""

import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import (
    estimate,
    explore,
    missing,
    posterior,
    search,
    verdict,
)
from characterize.inference.ends import Profile
from characterize.inference.explore import REACH
from characterize.inference.leastsquares import Data, Prior, Settings, fit
from characterize.inference.posterior import Valley

RNG = np.random.default_rng(44)
SHAPES = RNG.uniform(0.3, 1.6, (2, 3, 6, 5))


def straight(x, slopes):
    return np.tensordot(x, SHAPES, 1), SHAPES if slopes else None


def frames(value, sigma):
    image = np.tensordot(value, SHAPES, 1)
    whole = np.ones(image.shape, bool)
    return Data(
        image, whole, ~whole, np.full(image.shape, sigma**2), np.full(image.shape, 1e15)
    )


def test_a_bound_holds_back_by_so_many_sigma_with_the_sign_of_the_way_out():
    """Frames of 31 and 17; one may not exceed 30.2 and the other makes up for it: the
    parabola's least lies outside.

    ``beyond`` is the free minimum as seen from the end, over the covariance's sigma,
    for both parameters together.
    """
    data, sigma = frames([31.0, 17.0], 0.8), 0.8
    prior = Prior(
        np.zeros(2), np.full(2, np.inf), np.full(2, -np.inf), np.array([30.2, np.inf])
    )
    found = fit(
        straight,
        data,
        np.array([29.0, 18.0]),
        prior=prior,
        settings=Settings(step_tolerance=1e-6),
    )
    assert found.value[0] == pytest.approx(30.2, abs=1e-6)
    columns = SHAPES.reshape(2, -1) / sigma
    own = np.sqrt(np.diag(np.linalg.inv(columns @ columns.T)))
    assert found.beyond == pytest.approx(
        (np.array([31.0, 17.0]) - found.value) / own, rel=1e-6
    )


def test_an_outlier_tells_as_much_less_as_it_lies_beyond_the_limit():
    """Huber's weight: 6 over its size in sigma; information and chi-square are of the
    others' noise.
    """
    data, sigma = frames([31.0, 17.0], 0.8), 0.8
    data.electrons[1, 2, 3] += 15 * sigma
    prior = Prior(
        np.array([31.0, 17.0]),
        np.full(2, 1e-9),
        np.full(2, -np.inf),
        np.full(2, np.inf),
    )
    found = fit(straight, data, np.array([31.0, 17.0]), prior=prior)
    weight = np.ones(SHAPES[0].shape)
    weight[1, 2, 3] = 6 / 15
    columns = SHAPES.reshape(2, -1) / sigma
    assert found.information == pytest.approx(
        (columns * weight.ravel()) @ columns.T, rel=1e-6
    )


def test_without_a_pixel_the_chance_of_chi_square_is_that_of_one():
    nothing = SimpleNamespace(residual_sigma=np.zeros((1, 2, 2)))
    assert verdict.chance_of(nothing) == pytest.approx(math.sqrt(2))


def test_lengths_in_sigma_are_those_of_the_covariance():
    """|S d|² = dᵀ C⁻¹ d, of two shapes that are much alike and unlike in size."""
    shapes = np.stack([SHAPES[0], 40 * (SHAPES[0] + 0.1 * SHAPES[1])])
    data = frames([1.0, 0.0], 0.37)
    valley = Valley(
        lambda x, j: (np.tensordot(x, shapes, 1), shapes),
        data,
        np.array([1.0, 0.0]),
        Prior.none(np.zeros(2)),
    )
    way = np.array([0.31, -0.0023])
    columns = shapes.reshape(2, -1).T / 0.37
    assert np.linalg.norm(valley._sigmas @ way) == pytest.approx(
        np.linalg.norm(columns @ way), rel=1e-9
    )
    assert way @ np.linalg.solve(valley.covariance, way) == pytest.approx(
        np.linalg.norm(columns @ way) ** 2, rel=1e-6
    )


def valley(sigma, rho, least):
    covariance = np.array([[1, rho], [rho, 1]]) * np.outer(sigma, sigma)
    return SimpleNamespace(
        sigma=np.array(sigma),
        covariance=covariance,
        least=least,
        calibration=lambda: np.zeros((2, 2)),
    )


def test_shares_of_modes_hold_for_misfits_of_any_size():
    """Of a million pixels exp(-misfit / 2) itself is nothing; two of five sigma's
    difference are far apart.
    """
    pair = [valley((0.7, 2.1), 0.6, 1e6 + 3.0), valley((0.7, 2.1), 0.6, 1e6)]
    small = math.exp(-1.5) / (1 + math.exp(-1.5))
    assert posterior.shares(pair) == pytest.approx([small, 1 - small], rel=1e-9)


ABOUT = SimpleNamespace(
    names=("bias_nm", "background_e"),
    prior=SimpleNamespace(low=np.full(2, -99.0), high=np.full(2, 99.0)),
)


def test_chi_square_below_one_narrows_nothing():
    best = SimpleNamespace(value=np.array([1.0, 2.0]), merit=50.0, chi2_per_dof=0.49)
    found = explore._joined(ABOUT, [best], [valley((0.7, 2.1), 0.6, 0.0)], {}, {})
    assert found.high == pytest.approx(best.value + REACH * np.array([0.7, 2.1]))
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx([0.7, 2.1])


def test_the_standard_error_of_a_bent_posterior_is_that_of_its_interval(monkeypatch):
    """Half of the 95 % interval over 1.96, where draws take the parabola's place;
    correlation from both.
    """
    best = SimpleNamespace(value=np.array([1.0, 2.0]), merit=50.0, chi2_per_dof=1.0)
    drawn = RNG.multivariate_normal(best.value, [[1.4, -0.8], [-0.8, 9.0]], 96)
    monkeypatch.setattr(explore, "_drawn", lambda *_: drawn)
    profile = Profile(-1.7, 2.9, np.zeros(1), np.zeros(1), parabolic=False)
    found = explore._joined(
        ABOUT, [best], [valley((0.7, 2.1), 0.6, 0.0)], {"bias_nm": profile}, {}
    )
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(
        [4.6 / (2 * 1.959964), 2.1], rel=1e-6
    )
    rho = 0.8 * np.corrcoef(drawn.T)[0, 1] + 0.2 * 0.6
    assert found.covariance[0, 1] == pytest.approx(
        rho * 4.6 / (2 * 1.959964) * 2.1, rel=1e-6
    )


def test_without_draws_the_predicted_error_is_that_of_the_covariance():
    """A picture at right angles to the light, of amplitude q: rms sine of atan(a q), a
    Gaussian of the covariance's
    sigma. 24 draws of their own seed: the mean square is that of the sigma to 30 %,
    five of its own are 150 %."""
    light, picture = np.zeros((1, 4, 6)), np.zeros((1, 4, 6))
    light[0, :2], picture[0, 2:] = 5.0, 0.2
    found = SimpleNamespace(
        draws=np.empty((0, 1)),
        best=SimpleNamespace(value=np.array([0.0])),
        covariance=np.array([[0.09]]),
    )
    setting = SimpleNamespace(depth_um=np.array([2e4]))
    model = SimpleNamespace(
        setting=setting,
        groups=[],
        images=lambda x, names=None: (light + x[-1] * picture, None),
    )
    model.quick = lambda: model
    prior = SimpleNamespace(low=np.array([-50.0]), high=np.array([50.0]))
    task = SimpleNamespace(
        model=model, names=("bias_nm",), prior=prior, start=np.zeros(1)
    )
    problem = lambda *_: lambda x, jacobian: (light + x[0] * picture, None)  # noqa: E731
    want = 0.3 * math.sqrt((picture**2).sum() / (light**2).sum())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdict.residual, "problem", problem)
        patch.setattr(verdict, "between", lambda model: model)
        here, _ = verdict.predicted_error(task, found)
    assert here == pytest.approx(want, rel=0.45)


@pytest.mark.parametrize(("bias", "turned"), [(0.19, 0), (0.21, 1)])
def test_a_gradient_is_turned_round_where_it_stands_off_zero_by_its_sigma(bias, turned):
    """Sigma 0.2. The other parameter goes along as the parabola says: by covariance
    over variance.
    """
    covariance = np.array([[0.04, 0.03], [0.03, 0.25]])
    best = SimpleNamespace(value=np.array([bias, 5.0]), covariance=covariance)
    prior = Prior(np.zeros(2), np.full(2, np.inf), np.full(2, -99.0), np.full(2, 99.0))
    task = SimpleNamespace(names=("bias_x_nm", "defocus"), prior=prior)
    found = search.reversals(task, best)
    assert len(found) == turned
    if turned:
        assert found[0] == pytest.approx([-bias, 5.0 - 2 * bias * 0.03 / 0.04])


def test_structure_is_looked_for_with_common_errors_over_the_noise(monkeypatch):
    """A floor of 5.3 e² and light of 40: the dark's share of the floor and the flat's
    of the light, in sigma.
    """
    asked = []
    monkeypatch.setattr(
        verdict, "structure", lambda residual, shared: asked.append(shared) or []
    )
    monkeypatch.setattr(missing, "words", lambda leans: [])
    image = np.full((2, 3, 4), 40.0)
    whole = np.ones(image.shape, bool)
    data = Data(
        image,
        whole,
        ~whole,
        np.full(image.shape, 5.3),
        np.full(image.shape, 1.7),
        0.0,
        0.3,
        0.02,
    )
    task = SimpleNamespace(data=data)
    words = estimate._seen(
        task,
        SimpleNamespace(image=image, residual_sigma=image),
        SimpleNamespace(leans=[]),
        1.24,
    )
    noise = math.sqrt(5.3 + 40 / 1.7)
    assert asked[0][0] == pytest.approx(
        np.full(image.shape, math.sqrt(0.3 * 5.3) / noise)
    )
    assert asked[0][1] == pytest.approx(np.full(image.shape, 0.02 * 40 / noise))
    assert words == []
    again = estimate._seen(
        task,
        SimpleNamespace(image=image, residual_sigma=image),
        SimpleNamespace(leans=[]),
        1.26,
    )
    assert "chi-square 1.26 a pixel" in again[0]


def test_the_reach_of_distances_is_two_sigma_of_what_is_known_within_a_quarter():
    from characterize.model import Known

    lens = b.row(sensor_distance_um=1700.0)
    assert estimate._reach_um(
        {"distance_um": Known("distance_um", 3.0, 41.0)}, lens
    ) == pytest.approx(82.0)
    assert (
        estimate._reach_um({"distance_um": Known("distance_um", 3.0, 4100.0)}, lens)
        <= 1700 / 4
    )


def test_causes_that_are_stated_are_reckoned_with_as_stated():
    """Sigma as given; of a wall the square counts, so its value adds to its sigma; what
    nobody says has its usual.
    """
    from characterize.inference import causes
    from characterize.model import PARAMETERS, PLACE, Known

    known = {
        "sidewall_deg": Known("sidewall_deg", 0.8, 0.6),
        "index": Known("index", 0.01, 0.003),
        "pinhole_um": Known("pinhole_um", 6.0, 0.0),
    }
    lens = b.row(wavelength_um=0.7)
    task = SimpleNamespace(
        known=known, unfitted={"stitching_nm": 11.0}, model=SimpleNamespace(lens=lens)
    )
    assert causes._size(task, "sidewall_deg") == pytest.approx(1.0)
    assert causes._size(task, "index") == 0.003
    assert causes._size(task, "pinhole_um") == 0.0
    assert causes._size(task, "stitching_nm") == 11.0
    assert (
        causes._size(task, "bandwidth_nm")
        == PARAMETERS[PLACE["bandwidth_nm"]].sigma
        > 0
    )
    assert (
        PARAMETERS[PLACE["glass_um"]].sigma == math.inf
    )  # of which no interval would end
    assert (
        causes._size(task, "glass_um")
        == PARAMETERS[PLACE["glass_um"]].plausible
        < math.inf
    )


def test_the_phase_of_a_moved_field_is_that_of_the_focus_there():
    """Pillars moved by 1 um along x see the path to the sensor and from the source
    change by x / r and x / r'.
    """
    from characterize.inference import causes

    distances = {
        "sensor_distance_um": 1170.0,
        "layers": b.GLASS,
        "source_distance_um": 5200.0,
    }
    lens = b.row(300.0, wavelength_um=0.87, **distances)
    u, v = np.array([0.6, -0.3, 0.1]), np.array([-0.2, 0.7, 0.4])
    for along in (0, 1):
        shape = causes._field_off(lens, along)(u, v, 1)[0]
        for k in range(3):
            x, y = 300 * u[k], 300 * v[k]

            def path(x, y):
                return math.hypot(x, y, 1100.0) + math.hypot(x, y, 5200.0)

            h = 1e-3
            step = (h, 0) if along == 0 else (0, h)
            rate = (path(x + step[0], y + step[1]) - path(x - step[0], y - step[1])) / (
                2 * h
            )
            want = 2 * math.pi / 0.87 * rate if u[k] > 0 else 0.0
            assert shape[k] == pytest.approx(want, rel=1e-6, abs=1e-9)
    flat = replace(lens, source_distance_um=0.0)
    assert causes._moved_phase(flat, u, v, 0)[0] == pytest.approx(
        2 * math.pi / 0.87 * 180 / math.hypot(180, 60, 1100), rel=1e-9
    )


def test_of_frames_each_may_change_alone():
    from characterize.inference import causes

    change = RNG.normal(size=(3, 4, 5))
    alone = causes._each(change)
    assert alone.shape == (3, 3, 4, 5)
    for i in range(3):
        for j in range(3):
            assert alone[i, j] == pytest.approx(
                change[i] if i == j else np.zeros((4, 5))
            )


def test_background_is_a_plane_with_its_slopes_at_the_edge():
    from characterize.model import Setting, background, vector

    x = vector({"background_e": 20.0, "background_x_e": 3.0, "background_y_e": -5.0})
    (plane,) = background(
        x, Setting(np.ones(1), np.zeros((1, 2)), np.ones(1), 1.5, rows=6, columns=8)
    )
    for i in range(6):
        for j in range(8):
            assert plane[i, j] == pytest.approx(20 + 3 * (j - 4) / 4 - 5 * (i - 3) / 3)


def test_what_the_lens_takes_along_widens_its_own_draws_and_no_more():
    """Within the model 0.04 and 0.25, by the bench's absent causes 0.05 and 0.11 on
    top, together with correlation.
    """
    from characterize.inference.asbuilt import AsBuilt, WithinModel

    built = object.__new__(AsBuilt)
    own, bench = (
        np.array([[0.04, 0.03], [0.03, 0.25]]),
        np.array([[0.05, -0.02], [-0.02, 0.11]]),
    )
    about = dict(
        design=None,
        names=("coma_x_rad", "coma_y_rad"),
        value=np.array([0.03, -0.02]),
        covariance=4 * own,
        bench=bench,
    )
    about |= dict(draws=np.empty((0, 0)), within=WithinModel(covariance=own))
    for name, value in about.items():
        object.__setattr__(built, name, value)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "characterize.inference.asbuilt._bounded", lambda names, lens, draws: draws
        )
        drawn, wide = built.lens_samples(40_000, seed=3), built.samples(40_000, seed=3)
    assert drawn.mean(0) == pytest.approx([0.03, -0.02], abs=0.01)
    assert np.cov(drawn.T) == pytest.approx(
        own + bench, rel=0.05, abs=2e-3
    )  # 40 000 draws: 0.7 %
    assert np.cov(wide.T) == pytest.approx(4 * own, rel=0.05, abs=2e-3)


def test_a_value_that_is_held_and_asked_for_begins_with_the_usual_sigma():
    from characterize.model import PARAMETERS, PLACE, Known

    known = {
        "height_nm": Known("height_nm", 4.0, 0.0),
        "index": Known("index", 0.01, 0.003),
    }
    prior = search.prior_of(
        ("height_nm", "index", "bias_nm"), known, SimpleNamespace(wavelength_um=0.85)
    )
    usual = [PARAMETERS[PLACE[name]].sigma for name in ("height_nm", "bias_nm")]
    assert prior.sigma == pytest.approx([usual[0], 0.003, usual[1]])
    assert prior.mean == pytest.approx([4.0, 0.01, PARAMETERS[PLACE["bias_nm"]].start])
