"""The virtual bench number by number: where light comes from and lands, what a camera
reads, with typed light.
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

from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.model import KnownValue


def truth(**more):
    camera = BenchCamera(
        pixels=6,
        pixel_um=1.7,
        bits=12,
        gain_e=2.6,
        offset=31.0,
        read_noise_e=4.1,
        hot_share=0.0,
    )
    return HiddenLens(**({"depths_um": (21e3, 26e3, 34e3), "camera": camera} | more))


def knows(**values):
    return tuple(KnownValue(name, value, 0.0) for name, value in values.items())


def test_every_angle_has_every_depth():
    depth, angle = truth(angles_deg=(0.0, 7.0)).stated
    assert depth.tolist() == [21e3, 26e3, 34e3] * 2
    assert angle[:, 0] == pytest.approx([0.0] * 3 + [math.radians(7.0)] * 3)
    assert not angle[:, 1].any()


def test_the_background_is_a_plane_that_is_never_below_nothing():
    made = bench.background_plane(
        truth(
            parameter=knows(background_e=4.0, background_x_e=3.0, background_y_e=-6.0)
        )
    )
    for i in range(6):
        for j in range(6):
            assert made[i, j] == pytest.approx(
                max(4 + 3 * (j - 2.5) / 3 - 6 * (i - 2.5) / 3, 0.0)
            )


def test_light_falls_with_the_square_of_its_true_distance_and_adds_over_the_line(
    monkeypatch,
):
    """Depths off by a zero of 400 and a scale of 0.02 about their mean of 27 mm; each
    line by its weight.
    """
    seen = []
    lens = b.row(300.0, sensor_distance_um=1900.0)

    def frames(lens, truth, colour, t, way, depth):
        seen.append(colour[bench.PLACE["wavelength_nm"]])
        return (
            (1 + colour[bench.PLACE["wavelength_nm"]]) ** 2
            * np.ones((len(depth), 6, 6))
            * depth[:, None, None]
        )

    monkeypatch.setattr(bench, "_frames", frames)
    monkeypatch.setattr(
        bench.made, "as_built_transmission", lambda *given, **more: None
    )
    monkeypatch.setattr(
        bench,
        "_alike",
        lambda *_: iter(
            [
                (SimpleNamespace(incidence_rad=0.0), [0, 2]),
                (SimpleNamespace(incidence_rad=0.0), [1]),
            ]
        ),
    )
    about = knows(
        stage_zero_um=400.0, stage_scale=0.02, bandwidth_nm=3.0, wavelength_nm=0.5
    )
    light = bench.bench_irradiance(lens, truth(parameter=about), None)
    mean_square = (
        1.5**2 + 3.0**2
    )  # of a Gaussian line about 1.5: exact in two lines or more
    for n, z in enumerate((21e3, 26e3, 34e3)):
        true = z + 400 + 0.02 * (z - 27e3)
        assert light[n] == pytest.approx(np.full((6, 6), mean_square / true), rel=1e-9)
    assert (
        len(seen) == 10
    )  # light at the rim turns by 0.7 rad a standard deviation: five lines, twice


def test_sources_off_the_axis_come_from_their_own_side_and_the_window_stays_with_the_stage():
    """dx/dz of the light less the source's own place over its depth; the window by what
    it was moved.
    """
    lens = b.row(sensor_distance_um=1900.0, proxy=replace(b.proxy(), max_angle_rad=0.5))
    x = truth(
        parameter=knows(
            distance_um=60.0, tilt_x_deg=0.8, tilt_y_deg=-0.5, source_x_um=300.0, source_y_um=-120.0,
            decentre_x_um=4.0, decentre_y_um=-7.0,
        )
    ).vector()  # fmt: skip
    depth, angle = (
        np.array([2e4, 3e4, 3e4]),
        np.array([[0.0, 0.0], [0.0, 0.0], [0.1, -0.2]]),
    )
    found = [
        (way, index) for way, index in bench._alike(lens, truth(), x, depth, angle)
    ]
    assert [index for _, index in found] == [[0], [1], [2]]
    for way, (n,) in found:
        chief = [
            math.tan(angle[n, 0]) + math.tan(math.radians(0.8)),
            math.tan(angle[n, 1]) + math.tan(math.radians(-0.5)),
        ]
        source = [chief[0] - 300 / depth[n], chief[1] + 120 / depth[n]]
        assert way.source == pytest.approx(tuple(source))
        assert way.shift_um == pytest.approx(
            (1960 * (chief[0] - source[0]) + 4, 1960 * (chief[1] - source[1]) - 7)
        )
        assert way.incidence_rad == pytest.approx(math.atan(math.hypot(*source)))
    plain = truth().vector()
    same = [index for _, index in bench._alike(lens, truth(), plain, depth, angle)]
    assert same == [[0, 1], [2]]  # one way in, one call
    glass = truth(parameter=knows(glass_um=150.0)).vector()
    assert [index for _, index in bench._alike(lens, truth(), glass, depth, angle)] == [
        [0],
        [1],
        [2],
    ]


def test_a_read_out_has_photon_read_and_rounding_noise_over_its_offset():
    """500 electrons at 2.6 a count and 4.1 of read noise: variance 500 + 16.81 + 2.6² /
    12 e², mean 500 / 2.6 + 31.
    """
    camera = truth().camera
    counts = bench._read(
        np.full((400, 300), 500.0),
        camera,
        np.random.default_rng(4),
        np.zeros((400, 300), bool),
    )
    assert counts.dtype == np.uint16
    assert counts.mean() == pytest.approx(
        500 / 2.6 + 31, abs=0.15
    )  # 120 000 pixels: sigma 0.025
    assert counts.astype(float).var() * 2.6**2 == pytest.approx(
        500 + 16.81 + 2.6**2 / 12, rel=0.02
    )  # sigma 0.4 %
    hot = np.zeros((4, 5), bool)
    hot[2, 3] = True
    full = bench._read(np.full((4, 5), 1e9), camera, np.random.default_rng(4), hot)
    assert full[0, 0] == 4095
    assert full[2, 3] == int(0.97 * 4095)


def test_frames_are_as_bright_as_asked_for_and_flats_half_full(monkeypatch):
    light = np.linspace(0.1, 0.9, 108).reshape(3, 6, 6)
    monkeypatch.setattr(bench, "bench_irradiance", lambda *_: light)
    made = bench.simulate_frames(
        None,
        truth(
            peak_e=3100.0,
            parameter=knows(background_e=12.0),
            dark_frames=3,
            flat_frames=5,
        ),
        None,
    )
    assert made.electrons == pytest.approx(light / 0.9 * 3100 + 12)
    assert (len(made.frames), len(made.dark), len(made.flat)) == (3, 3, 5)
    assert made.dark.mean() == pytest.approx(31, abs=1.0)
    assert made.flat.mean() == pytest.approx(31 + 0.5 * (4096 - 31), rel=0.01)
    assert made.frames[2, 5, 5] == pytest.approx(
        3112 / 2.6 + 31, abs=5 * math.sqrt(3129) / 2.6
    )


def test_as_many_frames_are_formed_at_once_as_a_million_fine_samples_hold():
    """Of 6 pixels and 4 about them, nine samples each: (14 x 9)² a frame, 62 of them.
    Through glass one by one.
    """
    lens = b.row(sensor_distance_um=1900.0, proxy=replace(b.proxy(), max_angle_rad=0.5))
    depth, angle = np.linspace(2e4, 3e4, 70), np.zeros((70, 2))
    index = [
        index
        for _, index in bench._alike(lens, truth(), truth().vector(), depth, angle)
    ]
    assert [len(some) for some in index] == [62, 8]
    assert np.concatenate(index).tolist() == list(range(70))


def test_hot_pixels_are_hot_in_every_frame_and_a_flat_is_taken_twice_at_least(
    monkeypatch,
):
    """A fifth of 900 pixels, sigma 12; 0.97 of 4095, where light and darkness lie far
    below.
    """
    monkeypatch.setattr(bench, "bench_irradiance", lambda *_: np.full((2, 30, 30), 0.7))
    camera = BenchCamera(
        pixels=30,
        pixel_um=1.7,
        bits=12,
        gain_e=2.6,
        offset=31,
        read_noise_e=4.1,
        hot_share=0.2,
    )
    made = bench.simulate_frames(
        None, truth(camera=camera, peak_e=900.0, dark_frames=1, flat_frames=1), None
    )
    assert (len(made.frames), len(made.dark), len(made.flat)) == (2, 1, 2)
    hot = made.dark[0] == 3972
    assert hot.sum() == pytest.approx(180, abs=48)
    for frame in (*made.frames, *made.flat):
        assert np.array_equal(frame == 3972, hot)
