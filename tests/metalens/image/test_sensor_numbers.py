"""The sensor, number by number: shares of samples by the cubic through four points,
electrons and noise by hand.
"""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from metalens.core.errors import SceneError
from metalens.image import sensor as sensors
from metalens.image.sensor import Sensor

ODD = Sensor(
    pitch_um=3.7,
    base_pitch_um=2.9,
    exposure_e=1700.0,
    ambient_e=130.0,
    full_well_e=5100.0,
    read_noise_e=2.3,
    bits=7,
)
AREA = (3.7 / 2.9) ** 2


def cumulative(count, sample, place):
    """Catmull-Rom through the running sum of one unit of light in a sample, in the
    textbook's matrix form.
    """
    first = math.floor(place)
    t = place - first
    known = [
        float(k > sample) if -5 <= k <= count + 5 else None
        for k in range(first - 1, first + 3)
    ]
    matrix = [[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]
    return sum(0.5 * t**power * np.dot(row, known) for power, row in enumerate(matrix))


def shares(count, edges):
    """(pixels, samples) from the places of (low, high) edges, in samples."""
    return np.array(
        [
            [cumulative(count, k, b) - cumulative(count, k, a) for k in range(count)]
            for a, b in edges
        ]
    )


def test_shares_of_every_sample_follow_the_edges():
    """5 samples of 0.8 um, 2 pixels of 1.3 um, moved by 0.35 um: edges at -1.3, 0 and
    1.3 about the middle.
    """
    edges = [(0.35 + x) / 0.8 + 2.5 for x in (-1.3, 0.0, 1.3)]
    found = sensors.pixel_weights(5, 0.8, pitch_um=1.3, count=2, shift_um=0.35)
    assert found.numpy() == pytest.approx(shares(5, [edges[:2], edges[1:]]), abs=1e-13)
    assert found.dtype == torch.float64
    three = sensors.pixel_weights(
        5, 0.8, pitch_um=1.37
    )  # 4 um in 1.37: three pixels, half a pixel on either side
    edges = [x * 1.37 / 0.8 + 2.5 for x in (-1.5, -0.5, 0.5, 1.5)]
    assert three.numpy() == pytest.approx(
        shares(5, list(itertools.pairwise(edges))), abs=1e-13
    )


def test_boxes_narrower_than_their_distance_are_scaled_to_its_light():
    """Middles 1.3 um apart, each 0.9 um wide, in the light of 1.3 um."""
    ends = [[(x + side * 0.45) / 0.8 + 2.5 for side in (-1, 1)] for x in (-0.65, 0.65)]
    found = sensors.pixel_weights(5, 0.8, pitch_um=0.9, count=2, grid_um=1.3)
    assert found.numpy() == pytest.approx(shares(5, ends) * 1.3 / 0.9, abs=1e-13)
    assert sensors.pixel_weights(5, 0.8, pitch_um=0.9, grid_um=1.3).shape == (
        4,
        5,
    )  # 4 um in 1.3: 3.08 of them


def test_slopes_of_the_shares_are_those_of_differences():
    pitch = torch.tensor(1.23, dtype=torch.float64, requires_grad=True)
    weight = torch.tensor(np.random.default_rng(3).normal(size=(4, 5)))
    found = torch.autograd.grad(
        (weight * sensors.pixel_weights(5, 0.8, pitch_um=pitch)).sum(), pitch
    )[0]
    low, high = (
        float((weight * sensors.pixel_weights(5, 0.8, pitch_um=1.23 + d)).sum())
        for d in (-1e-6, 1e-6)
    )
    assert float(found) == pytest.approx(
        (high - low) / 2e-6, rel=1e-6
    )  # third derivative: 1e-12; rounding 1e-9


@pytest.mark.parametrize(
    ("samples", "sample_um", "pitch_um", "cover", "inside"),
    [
        (10, 0.7, 2.0, 4, 3),
        (6, 0.5, 1.5, 2, 2),
        (3, 0.1, 0.1, 3, 3),
        (30, 0.1, 0.3, 10, 10),
        (1, 0.3, 0.1, 3, 3),
        (4, 0.5, 7.0, 1, 0),
    ],
)
def test_counts_of_pixels_ignore_rounding(samples, sample_um, pitch_um, cover, inside):
    """0.1 three times is 3.0000000000000004 of 0.1, and 0.3 is 2.9999999999999996 of
    it.
    """
    assert sensors.pixel_count(samples, sample_um, pitch_um) == cover
    assert sensors.whole_pixels(samples, sample_um, pitch_um) == inside
    for off, more in ((1e-10, 1), (-1e-10, 0)):  # what is no rounding counts
        assert sensors.pixel_count(6, 0.5 * (1 + off), 1.5) == 2 + more
        assert sensors.whole_pixels(6, 0.5 * (1 + off), 1.5) == 1 + more


def test_light_of_rows_and_columns_takes_its_own_shift_and_count():
    image = torch.tensor(np.random.default_rng(4).uniform(0.2, 3.0, (2, 5, 7)))
    found = sensors.integrate(
        image, 0.8, pitch_um=1.3, shape=(3, 2), shift_um=(0.35, -0.2)
    )
    rows = sensors.pixel_weights(5, 0.8, pitch_um=1.3, count=3, shift_um=0.35)
    columns = sensors.pixel_weights(7, 0.8, pitch_um=1.3, count=2, shift_um=-0.2)
    assert found.shape == (2, 3, 2)
    assert found.numpy() == pytest.approx(
        np.einsum("ij,njk,lk->nil", rows, image, columns), rel=1e-12
    )
    single = sensors.integrate(image.float(), 0.8, pitch_um=1.3)
    assert single.dtype == torch.float32


def test_an_image_in_pixels_of_one_sample_is_itself():
    image = torch.rand(9, 11, dtype=torch.float64)
    assert sensors.integrate(image, 0.8, pitch_um=0.8) is image
    assert (
        sensors.integrate(image, 0.8, pitch_um=torch.tensor(0.8, dtype=torch.float64))
        is image
    )
    assert (
        sensors.integrate(image, 0.8, pitch_um=0.8, grid_um=0.8, shape=(9, 11)) is image
    )
    changed = (
        {"shift_um": (0.0, 1e-9)},
        {"shape": (9, 9)},
        {"grid_um": 0.8 + 1e-9},
        {"pitch_um": 0.8 + 1e-9},
    )
    changed += ({"pitch_um": 0.8 - 1e-9, "shape": (9, 11)},)
    for other in changed:
        assert sensors.integrate(image, 0.8, **{"pitch_um": 0.8} | other) is not image
    asked = torch.tensor(0.8, dtype=torch.float64, requires_grad=True)
    assert sensors.integrate(image, 0.8, pitch_um=asked).requires_grad
    with torch.no_grad():
        assert sensors.integrate(image, 0.8, pitch_um=asked) is image
    # at the edges of 11 samples an error of the pitch counts eleven halves: 5e-12
    # samples is the limit
    for relative, same in ((0.8e-12, True), (1.0e-12, False)):
        assert (
            sensors.integrate(image, 0.8, pitch_um=0.8 * (1 + relative)) is image
        ) is same
    for moved, same in ((4.5e-12, True), (5.5e-12, False)):
        assert (
            sensors.integrate(image, 0.8, pitch_um=0.8, shift_um=(moved * 0.8, 0.0))
            is image
        ) is same


def test_electrons_are_those_of_the_area_for_light_and_ambient():
    """Even light of 0.6: 0.6 1700 + 130 electrons in a base pixel, times the area in
    base pixels.
    """
    even = torch.full((40, 36), 0.6, dtype=torch.float64)
    found = sensors.mean_electrons(even, 0.7, sensor=ODD, count=3)
    assert found.shape == (3, 3)
    assert found.numpy() == pytest.approx(
        np.full((3, 3), AREA * (0.6 * 1700 + 130)), rel=1e-12
    )
    pitch = torch.tensor(2.3, dtype=torch.float64)
    other = sensors.mean_electrons(even, 0.7, sensor=ODD, count=3, pitch_um=pitch)
    assert other[1, 2] == pytest.approx((2.3 / 2.9) ** 2 * 1150, rel=1e-12)
    box = sensors.mean_electrons(
        even, 0.7, sensor=ODD, count=3, pitch_um=pitch, grid_um=3.1
    )
    assert box[1, 2] == pytest.approx(
        (3.1 / 2.9) ** 2 * 1150, rel=1e-7
    )  # the area of the box comes in float32
    dark = dataclasses.replace(ODD, ambient_e=0.0)
    assert (
        sensors.mean_electrons(-even, 0.7, sensor=dark, count=3).tolist()
        == [[0.0] * 3] * 3
    )
    assert sensors.kappa(3.7, 2.9) == pytest.approx(1.627824, rel=1e-6)  # 13.69 / 8.41


def test_photon_counts_have_half_the_slope_of_one_and_half_of_their_share():
    mean = torch.tensor([7.3, 0.4, 0.0, 250.0], dtype=torch.float64, requires_grad=True)
    counts = sensors.photons(mean, torch.Generator().manual_seed(5))
    slope = torch.autograd.grad(counts.sum(), mean)[0]
    found, m = counts.detach().numpy(), mean.detach().numpy()
    assert (found == np.rint(found)).all()
    assert found[2] == 0
    assert slope.numpy()[[0, 1, 3]] == pytest.approx(
        (m + found)[[0, 1, 3]] / (2 * m[[0, 1, 3]]), rel=1e-12
    )
    assert slope[2] == 1.0


def test_what_is_read_has_photon_and_read_noise_below_the_well():
    """Read noise of 2.3 electrons a read. 2e5 samples: the spread of a variance is
    0.003 of it.
    """
    generator = torch.Generator().manual_seed(6)
    light = sensors.expose(
        torch.full((200_000,), 57.3, dtype=torch.float64),
        sensor=ODD,
        generator=generator,
    )
    assert float(light.mean()) == pytest.approx(57.3, abs=0.1)  # 0.018 of spread
    assert float(light.var()) == pytest.approx(57.3 + 2.3**2, rel=0.015)
    mean = torch.full((200_000,), 1e6, dtype=torch.float64, requires_grad=True)
    for reads in (3.0, torch.full((200_000,), 3.0)):
        full = sensors.expose(mean, sensor=ODD, generator=generator, reads=reads)
        assert float(full.detach().mean()) == pytest.approx(
            5100 * AREA, abs=0.05
        )  # 0.009 of spread
        assert float(full.detach().std()) == pytest.approx(
            2.3 * math.sqrt(3), rel=0.015
        )
    assert float(
        sensors.expose(mean.detach(), sensor=ODD, generator=generator).std()
    ) == pytest.approx(2.3, rel=0.015)
    assert torch.autograd.grad(full.sum(), mean)[0].abs().max() == 0


def test_numbers_run_to_the_top_of_the_bits_at_the_full_well():
    well = 5100 * AREA
    electrons = (
        torch.tensor([-4.0, 0.3, 0.51, 61.4, 127, 140], dtype=torch.float64)
        * well
        / 127
    )
    asked = electrons.requires_grad_()
    numbers = sensors.digitise(asked, sensor=ODD)
    assert numbers.tolist() == [0, 0, 1, 61, 127, 127]
    slope = torch.autograd.grad(numbers.sum(), asked)[0]
    assert slope[1:4].tolist() == pytest.approx([127 / well] * 3)
    assert slope[[0, 5]].tolist() == [0, 0]


def test_variance_adds_photons_reads_and_a_twelfth_of_a_step_squared():
    step = 5100 * AREA / 127
    found = sensors.variance(torch.tensor([57.3, 0.0], dtype=torch.float64), sensor=ODD)
    assert found.tolist() == pytest.approx(
        [57.3 + 5.29 + step**2 / 12, 5.29 + step**2 / 12], rel=1e-12
    )


@pytest.mark.parametrize(
    ("asked", "want"),
    [({}, (15.0, 4.0)), ({"snr_db": 7.0, "ambient_ratio": 0.6}, (7.0, 0.6))],
)
def test_dim_light_has_the_ratio_that_is_asked_at_the_sensors_own_pitch(asked, want):
    dim = sensors.low_snr(ODD, 0.37, **asked)
    signal = dim.exposure_e * 0.37 * AREA
    noise = math.sqrt(signal + dim.ambient_e * AREA + 2.3**2)
    assert 20 * math.log10(signal / noise) == pytest.approx(want[0], abs=1e-9)
    assert dim.ambient_e * AREA == pytest.approx(want[1] * signal)
    assert dataclasses.replace(dim, exposure_e=1700.0, ambient_e=130.0) == ODD


def test_plain_sensors_are_as_promised():
    plain = Sensor()
    assert (plain.pitch_um, plain.base_pitch_um, plain.exposure_e, plain.ambient_e) == (
        3.0,
        3.0,
        4000.0,
        0.0,
    )
    assert (plain.full_well_e, plain.read_noise_e, plain.bits) == (8000.0, 3.0, 10)


@pytest.mark.parametrize(
    "wrong",
    [
        *(
            {name: value}
            for name in ("pitch_um", "base_pitch_um", "full_well_e")
            for value in (0.0, math.inf)
        ),
        *(
            {name: value}
            for name in ("exposure_e", "ambient_e", "read_noise_e")
            for value in (-0.1, math.nan)
        ),
        {"bits": 0},
        {"bits": 17},
    ],
)
def test_what_no_sensor_has_is_refused(wrong):
    with pytest.raises(SceneError, match=next(iter(wrong))):
        Sensor(**wrong)


def test_the_ends_that_a_sensor_may_have_are_taken():
    for name in ("exposure_e", "ambient_e", "read_noise_e"):
        assert getattr(Sensor(**{name: 0.0}), name) == 0
    assert [Sensor(bits=bits).bits for bits in (1, 16)] == [1, 16]
    for name, value in (("mean_irradiance", 0.0), ("ambient_ratio", -0.1)):
        with pytest.raises(SceneError, match=name):
            sensors.low_snr(ODD, **{"mean_irradiance": 0.37} | {name: value})
    assert sensors.low_snr(ODD, 0.37, ambient_ratio=0.0).ambient_e == 0
