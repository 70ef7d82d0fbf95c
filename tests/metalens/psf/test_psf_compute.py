"""The parts of a stack's error: rounding at the pillars as it adds up at the sensor,
and the documented default.
"""

import inspect
import math

import numpy as np
import pytest
import torch

from metalens import propagate, psf
from metalens.psf import compute


def test_a_stack_is_to_a_ten_thousandth_on_axis_unless_said_otherwise():
    told = inspect.signature(psf.psf_stack).parameters
    assert (told["tolerance"].default, told["angle_rad"].default) == (1e-4, 0.0)


@pytest.mark.parametrize("tilt_rad", [0.0, 0.3])
def test_noise_of_the_pillars_adds_up_as_random_phases_do(monkeypatch, tilt_rad):
    """The exact sum of 400 maps of random phase at the chief ray: its rms is the noise
    of one phasor times this.

    400 draws of |E|² scatter by 5 %; over the lens the distance changes by 2 % about
    the chief ray's.
    """
    seen = []
    monkeypatch.setattr(
        compute,
        "relative_error",
        lambda samples, light: seen.append(samples[0][0]) or 1e-9,
    )
    rng = np.random.default_rng(6)
    level = rng.uniform(0.2, 0.9, (12, 15))
    place = {
        "pitch_um": 0.41,
        "wavelength_um": 0.85,
        "sensor_distance_um": 90.0,
        "angle_rad": (tilt_rad, 0.0),
    }
    case = propagate.make_case(
        level.shape, **place, depths_um=[4000.0], window_um=130.0, samples=128
    )
    maps = torch.zeros(1, 12, 15, dtype=torch.float64), torch.from_numpy(level)[None]
    compute._windowed(
        compute.IntensityRequest(*maps, [case], [1.0]), torch.float64, 1e-5, None
    )
    [sample] = seen
    power = []
    for _ in range(400):
        phases = rng.uniform(0, 2 * np.pi, level.shape)
        field = propagate.exact(
            phases, level, **place, depths_um=[4000.0], window_um=0.1, samples=1
        )
        power.append(float(np.abs(field[0, 0, 0]) ** 2))
    phasor = math.hypot(
        1e-11, 1e-5 / 40
    )  # rounding of float64, and the share of the tolerance
    assert sample.noise == pytest.approx(phasor * math.sqrt(np.mean(power)), rel=0.08)


def test_single_maps_are_summed_in_double_a_few_rows_at_a_time_as_if_they_were_double():
    """No second copy of a map of gigabytes: sums as of maps that are double all over,
    not as of single ones, 1e-7.
    """
    rng = np.random.default_rng(8)
    phase, level = (
        torch.from_numpy(rng.uniform(0, 1, (300, 211)).astype("f4")) for _ in range(2)
    )
    case = propagate.make_case(phase.shape, pitch_um=0.4, wavelength_um=0.85, sensor_distance_um=150.0,
                          depths_um=[900.0], window_um=9.0, samples=11)  # fmt: skip
    made = propagate.plan_window(case, 1e-6, torch.float64)
    one = propagate.field_windowed(phase, level, made)
    other = propagate.field_windowed(phase.double(), level.double(), made)
    assert one.dtype == torch.complex128
    assert float((one - other).abs().max()) < 1e-12 * float(
        other.abs().max()
    )  # blocks of rows, summed in any order
