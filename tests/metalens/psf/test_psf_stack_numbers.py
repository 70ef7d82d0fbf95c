"""What goes into a stack and comes out beside its light: directions, weights, shares
and reasons by hand.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from metalens import propagate, psf
from metalens.cell import Film, Index
from metalens.ground.errors import PropagationError
from metalens.lens import Layers, Media, Stop
from metalens.propagate import Case
from metalens.psf import metrics, stack
from metalens.psf.compute import Result

RNG = np.random.default_rng(3)
CASES = [
    Case(
        (5, 6),
        0.4,
        0.85,
        62.0,
        (0.21, -0.13),
        (1 / 400, 0.0),
        (14.0, -8.5),
        0.6,
        (3, 4),
    ),
    Case(
        (5, 6),
        0.4,
        0.85,
        62.0,
        (-0.11, 0.31),
        (1 / 400, 0.0),
        (-7.0, 19.0),
        0.6,
        (3, 4),
    ),
]


def test_one_direction_two_slopes_or_a_list_of_them():
    assert stack._directions(0.3) == (False, [0.3])
    assert stack._directions((0.3, -0.1)) == (False, [(0.3, -0.1)])
    several, found = stack._directions(np.array([[0.3, -0.1]]))
    assert several
    assert np.array_equal(found, [[0.3, -0.1]])
    for empty in (np.empty((0, 2)), np.empty((2, 0))):
        with pytest.raises(PropagationError, match="need one direction or more"):
            stack._directions(empty)


@pytest.mark.parametrize(
    ("weights", "share"),
    [(None, [0.25] * 4), ([3.0, 0.0, 1.0, 4.0], [0.375, 0.0, 0.125, 0.5])],
)
def test_maps_of_every_wavelength_have_one_shape_and_weights_of_sum_one(weights, share):
    phase, level = RNG.normal(size=(4, 3, 5)), RNG.uniform(size=(3, 5))
    (one, other), waves, found = stack._maps(
        phase, level, [0.81, 0.83, 0.85, 0.87], weights
    )
    assert waves == [0.81, 0.83, 0.85, 0.87]
    assert found == pytest.approx(share, rel=1e-12)
    assert one.numpy().tolist() == phase.tolist()
    assert other.numpy().tolist() == [level.tolist()] * 4
    (one, other), waves, found = stack._maps(phase, level, 0.85, None)
    assert (tuple(one.shape), tuple(other.shape), waves, found) == (
        (4, 1, 3, 5),
        (4, 1, 3, 5),
        [0.85],
        [1.0],
    )
    (one, _), _, _ = stack._maps(phase[:1], level, [0.85], None)
    assert tuple(one.shape) == (1, 3, 5)


@pytest.mark.parametrize(
    ("phase", "level", "serves"),
    [
        ((4, 3, 5), (3, 5), True),
        ((4, 3, 5), (1, 3, 5), True),
        ((4, 3, 5), (4, 1, 5), True),
        ((4, 3, 5), (5,), True),
        ((4, 3, 5), (2, 3, 5), False),
        ((4, 3, 5), (5, 3), False),
        ((3, 5), (1, 3, 5), False),
        ((3, 5), (3, 4), False),
    ],
)
def test_a_transmission_serves_where_it_is_that_of_the_maps_or_of_all_of_them(
    phase, level, serves
):
    assert stack._serves(torch.zeros(level), torch.zeros(phase)) is serves


@pytest.mark.parametrize(
    "weights", [[1.0], [1.0, -0.1], [0.0, 0.0], [1.0, math.nan], [[1.0, 2.0]]]
)
def test_weights_that_weigh_nothing_are_refused(weights):
    with pytest.raises(PropagationError, match="need one weight >= 0 for each"):
        stack._maps(np.zeros((2, 3, 5)), 1.0, [0.84, 0.85], weights)


@pytest.mark.parametrize(
    ("phase", "level"),
    [((3,), (3,)), ((0, 3, 5), (3, 5)), ((2, 3, 5), (3, 4)), ((3, 5), (1, 3, 5))],
)
def test_maps_that_do_not_belong_together_are_refused(phase, level):
    with pytest.raises(PropagationError, match="of both, alike"):
        stack._maps(np.zeros(phase), np.ones(level), 0.85, None)
    with pytest.raises(PropagationError, match="2 wavelengths, but maps of shape"):
        stack._maps(np.zeros((3, 4, 5)), 1.0, [0.84, 0.85], None)


def result(**more):
    return dataclasses.replace(
        Result(torch.zeros(2, 3, 4), 1e-4, "by hand", 7.0), **more
    )


def recorded(light, tolerance=1e-3, **more):
    axes = np.array([400.0, np.inf]), np.array([0.83, 0.87]), np.array([0.3, 0.7])
    return stack._record(light, CASES, axes, result(**more), tolerance)


@pytest.mark.parametrize("trained", [False, True])
def test_every_psf_is_divided_by_its_sum_whose_area_makes_its_energy(trained):
    """Samples of 0.36 um²; the angles are the arctangents of the slopes."""
    light = torch.from_numpy(RNG.uniform(1, 2, (2, 2, 3, 4))).requires_grad_(trained)
    plain = light.detach().numpy().copy()
    made = recorded(light * 1.0)
    sums = plain.sum((2, 3))
    assert made.intensity.detach().numpy() == pytest.approx(
        plain / sums[..., None, None], rel=1e-12
    )
    assert made.energy_um2.detach().numpy() == pytest.approx(sums * 0.36, rel=1e-12)
    assert made.intensity.requires_grad is trained
    assert np.tan(made.angles_rad) == pytest.approx(
        np.array([[0.21, -0.13], [-0.11, 0.31]]), rel=1e-12
    )
    assert made.centres_um.tolist() == [[14.0, -8.5], [-7.0, 19.0]]
    assert (made.step_um, made.sensor_distance_um, made.tolerance, made.error) == (
        0.6,
        62.0,
        1e-3,
        1e-4,
    )
    assert (made.depths_um.tolist(), made.wavelengths_um.tolist()) == (
        [400.0, math.inf],
        [0.83, 0.87],
    )
    assert made.weights.tolist() == [0.3, 0.7]


def test_an_error_above_the_tolerance_names_its_largest_part_and_one_at_it_none():
    light = torch.ones(2, 2, 3, 4, dtype=torch.float64)
    error = result(sampling=2e-4, source=3e-4).whole
    for tolerance, said in (
        (error, "by hand"),
        (0.999 * error, "by hand; above the tolerance by its size of the source"),
    ):
        assert (
            recorded(light.clone(), tolerance, sampling=2e-4, source=3e-4).reason
            == said
        )
    assert recorded(light.clone(), 2e-4, sampling=2e-4, source=1e-5).reason.endswith(
        "its integration over cells"
    )
    assert recorded(light.clone(), 5e-5).reason.endswith("by its sums")
    small = recorded(torch.ones(2, 2, 3, 4), 1e-9).reason
    assert "above the tolerance: float32 holds " in small
    assert small.endswith(", give float64 maps")
    fine = recorded(light.clone(), 1e-16).reason
    assert "above the tolerance: float64 holds " in fine
    assert "give float64" not in fine


def test_light_beside_the_window_is_that_of_the_depth_and_direction_that_lose_most():
    light = torch.ones(2, 2, 3, 4, dtype=torch.float64)  # 12 samples of 0.36: 4.32 um²
    made = recorded(light)
    whole = torch.tensor([[4.8, 5.4], [7.2, 4.32]], dtype=torch.float64)
    got = stack._budgeted(
        made, result(sampling=2e-4, source=3e-4, rays=5e-4), whole, CASES, None
    ).budget
    assert got.outside == pytest.approx(0.4, rel=1e-12)
    assert (got.numerical, got.sampling, got.source, got.polarisation) == (
        1e-4,
        2e-4,
        3e-4,
        5e-4,
    )
    assert math.isnan(got.stop)
    assert (
        stack._budgeted(made, result(), 0 * whole + 4.0, CASES, None).budget.outside
        == 0.0
    )


def test_geometry_moves_with_the_tensors_that_carry_gradients():
    """Slopes are tangents, sources reciprocal depths, and the window follows the chief
    ray, also into a film.
    """
    angle = torch.tensor([0.2, -0.1], dtype=torch.float64, requires_grad=True)
    made = stack._moving(angle, [400.0, math.inf], 62.0, (0.7, -1.1), CASES[0])
    assert made.tangents.tolist() == pytest.approx([math.tan(0.2), math.tan(-0.1)])
    assert made.inverse_depths.tolist() == [1 / 400, 0.0]
    assert float(made.distance) == 62.0
    want = [62 * math.tan(0.2) + 0.7, 62 * math.tan(-0.1) - 1.1]
    assert made.centre.tolist() == pytest.approx(want, rel=1e-12)
    one = stack._moving(
        0.2, 400.0, torch.tensor(62.0, requires_grad=True), (0.7, -1.1), CASES[0]
    )
    assert one.tangents.tolist() == pytest.approx([math.tan(0.2), 0.0])
    assert one.centre.tolist() == pytest.approx(
        [62 * math.tan(0.2) + 0.7, -1.1], rel=1e-12
    )
    filled = dataclasses.replace(CASES[0], behind=Media((1.0, 1.5), (40.0, 22.0)))
    inside = math.tan(math.asin(math.sin(0.2) / 1.5))
    one = stack._moving(
        0.2, torch.tensor([400.0], requires_grad=True), 62.0, (0.7, -1.1), filled
    )
    assert one.centre.tolist() == pytest.approx(
        [40 * math.tan(0.2) + 22 * inside + 0.7, -1.1], rel=1e-9
    )
    assert (
        stack._moving(0.2, torch.tensor([400.0]), 62.0, (0.7, -1.1), CASES[0]) is None
    )
    offset = torch.tensor([0.7, -1.1], requires_grad=True)
    assert stack._moving(0.2, 400.0, 62.0, offset, CASES[0]) is not None
    assert stack._moving(0.2, 400.0, 62.0, (0.7, offset[1]), CASES[0]).centre.tolist()[
        1
    ] == pytest.approx(-1.1)


@pytest.mark.parametrize("row_um", [0.0, 0.37])
def test_a_small_lens_gives_the_squares_of_the_exact_sum(row_um):
    """Of two wavelengths the heavier one has the window; a pillar's light is that of
    its cell.
    """
    y, x = (np.arange(17) - 8) * 0.4, (np.arange(22) - 10.5) * 0.4
    phase = np.stack(
        [
            -2 * np.pi / w * np.hypot(np.hypot(x - 0.3, y[:, None]), 37.0)
            for w in (0.83, 0.87)
        ]
    )
    level = RNG.uniform(0.5, 1, (17, 22))
    about = {
        "pitch_um": 0.4,
        "row_um": row_um,
        "sensor_distance_um": 37.0,
        "depths_um": [np.inf, 400.0],
    }
    about |= {
        "window_um": (9.0, 12.0),
        "samples": (9, 12),
        "angle_rad": (0.1, -0.2),
        "offset_um": (0.4, 1.3),
    }
    made = psf.psf_stack(
        phase,
        level,
        **about,
        wavelength_um=[0.83, 0.87],
        weights=[3.0, 7.0],
        tolerance=1e-3,
    )
    light = 0.0
    for k, (wave, share) in enumerate(((0.83, 0.3), (0.87, 0.7))):
        seen = propagate.case((17, 22), **about, wavelength_um=wave)
        assert seen.centre_um == pytest.approx(made.centres_um[0], rel=1e-12)
        light = (
            light
            + share
            * np.abs(propagate.exact(phase[k], level, **about, wavelength_um=wave)) ** 2
        )
    sums = light.sum((1, 2))
    assert made.energy_um2 == pytest.approx(
        sums, rel=1e-8
    )  # samples of 1 um; the exact sum, 4e-12
    assert made.intensity == pytest.approx(light / sums[:, None, None], abs=1e-9)
    whole = (level**2).sum() * 0.4 * (row_um or 0.4)
    assert made.budget.outside == pytest.approx(1 - sums.min() / whole, rel=1e-6)


def test_lenses_of_a_batch_and_angles_stand_before_the_depths():
    """Each as alone, to the rounding of sums of 374 pillars."""
    phase, level = RNG.uniform(0, 6.28, (3, 17, 22)), RNG.uniform(0.5, 1, (3, 17, 22))
    about = {
        "pitch_um": 0.4,
        "sensor_distance_um": 37.0,
        "depths_um": [400.0, np.inf],
        "wavelength_um": 0.85,
    }
    about |= {"window_um": (5.0, 4.0), "samples": (5, 4)}
    angles = [[0.1, -0.2], [0.0, 0.3]]
    made = psf.psf_stack(phase, level, **about, angle_rad=angles)
    assert made.intensity.shape == (3, 2, 2, 4, 5)
    for lens in range(3):
        for angle in range(2):
            one = psf.psf_stack(
                phase[lens], level[lens], **about, angle_rad=angles[angle]
            )
            assert made.intensity[lens, angle] == pytest.approx(
                one.intensity, abs=1e-12
            )
            assert made.energy_um2[lens, angle] == pytest.approx(
                one.energy_um2, rel=1e-12
            )


def test_the_error_of_a_stop_is_that_of_its_worst_direction_depth_and_wavelength():
    """Two lenses of lone samples and of even light, whose blur over the path to the
    window is the angle that counts;
    of both lenses the wider blur and the smaller share."""
    layers = Layers(front=(Film(Index(1.5), 30.0),), stop=Stop(20.0, 30.0))
    lone, even = np.zeros((3, 4)), np.full((3, 4), 1 / 12)
    lone[1, 2] = 1.0
    light = np.array([[[lone, lone], [lone, lone]], [[even, lone], [lone, lone]]])
    share = np.array([[[0.9, 0.8], [0.95, 0.7]], [[0.85, 0.9], [0.6, 0.99]]])
    made = dataclasses.replace(
        recorded(torch.ones(2, 2, 3, 4).double()), intensity=torch.from_numpy(light)
    )
    narrow = 0.6 / 2 / 0.404
    wide = metrics.blur_um(even, 0.6, 0.85)
    want = []
    for case, blurs, shares in zip(
        CASES,
        ((wide, narrow), (narrow, narrow)),
        ((0.85, 0.8), (0.6, 0.7)),
        strict=True,
    ):
        path = math.sqrt(62.0**2 + case.centre_um[0] ** 2 + case.centre_um[1] ** 2)
        for z, blur, held in zip((400.0, math.inf), blurs, shares, strict=True):
            want += [
                layers.shadow_error(case.tangents, z, w, blur / path, held)
                for w in (0.83, 0.87)
            ]
    assert stack._ripples(made, share, CASES, layers) == pytest.approx(
        max(want), rel=1e-3
    )  # of 0.404
    assert math.isnan(stack._ripples(made, share, CASES, None))
    assert math.isnan(
        stack._ripples(made, share, CASES, dataclasses.replace(layers, stop=None))
    )
