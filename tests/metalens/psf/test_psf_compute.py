"""The parts of a stack's error: rounding at the pillars as it adds up at the sensor,
and the documented default.
"""

import inspect

import numpy as np
import torch

from metalens import propagate, psf


def test_a_stack_is_to_a_ten_thousandth_on_axis_unless_said_otherwise():
    told = inspect.signature(psf.psf_stack).parameters
    assert (told["tolerance"].default, told["angle_rad"].default) == (1e-4, 0.0)


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
