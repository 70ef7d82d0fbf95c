"""A virtual experiment's points, groups of frames and errors, by numbers that are typed
in.
"""

import math

import numpy as np
import pytest

from codesign.evaluate.shown import AXIAL, LATERAL, ExperimentConfig, Result, Trial
from metalens.ground.errors import ConfigError

SLIP_MM = np.array(
    [
        [0, 0, 0],
        [-3, 0, 0],
        [0, 0, 2],
        [0, 1, 2],
        [0, 4, 0],
        [0, 0, 5],
        [2, 0, 5],
        [0, 0, math.nan],
    ],
    float,
)
READ_MM = SLIP_MM + np.array(
    [
        [1, -2, 3],
        [4, 1, -1],
        [2, 2, 7],
        [0, 0, 1],
        [-5, 3, 2],
        [6, 1, 1],
        [1, 1, 1],
        [1, 2, 3],
    ]
)
GAZE_DEG = np.array([math.nan, math.nan, 0.25, 4.0, math.nan, 2.75, math.nan, 8.0])
SUBJECT = np.array([3, 3, 3, 3, 5, 5, 7, 7])


def result(**about):
    trial = Trial(SUBJECT, np.arange(8), np.arange(8), np.zeros((8, 2)), SLIP_MM)
    rest = (np.zeros((8, 2)), np.ones(8), GAZE_DEG, np.zeros((8, 2)), GAZE_DEG)
    return Result("a", 2.0, trial, READ_MM, *rest, **about)


def test_a_share_is_of_all_points_of_an_oblong_grid():
    """18 points: 0.17 of them are three, enough to calibrate on; 0.05 are one."""
    for grid in ((2, 9), (9, 2)):
        assert len(ExperimentConfig(grid=grid, share=0.17).stimuli_deg) == 18
        with pytest.raises(ConfigError, match="3 or more stimuli"):
            ExperimentConfig(grid=grid, share=0.05)
    config = ExperimentConfig(
        subjects=3, grid=(2, 9), axial_mm=(1.0, 2.0, 4.0), lateral_mm=(-3.0,)
    )
    assert config.frames == 3 * 18 * (1 + 3 + 1)
    assert config.slips_mm.tolist() == [
        [0, 0, 0],
        [-3, 0, 0],
        [0, 0, 1],
        [0, 0, 2],
        [0, 0, 4],
    ]


def test_groups_hold_frames_that_slip_along_one_axis_and_the_origin():
    trial = result().trial
    assert np.flatnonzero(trial.group(AXIAL)).tolist() == [0, 2, 5]
    assert np.flatnonzero(trial.group(LATERAL)).tolist() == [0, 1]
    assert result().gaze(AXIAL) == pytest.approx((0.25 + 2.75) / 2)
    slips = np.array([[math.nan, 0, 0], [1, 0, 0], [0, 0, math.nan], [0, math.nan, 0]])
    unread = Trial(SUBJECT[:4], np.arange(4), np.arange(4), np.zeros((4, 2)), slips)
    assert unread.group(LATERAL).tolist() == [False, True, False, False]
    assert not unread.group(AXIAL).any()


def test_errors_of_slippage_are_beside_those_of_the_frames_that_calibrated():
    """Subject 3 calibrated on its first two frames, the others on the first of theirs."""
    found = result(reach_mm=(2.5, 3.9, 2.0), visible_mm=READ_MM + 1.0)
    error = READ_MM - SLIP_MM
    assert found.slip_error_mm == pytest.approx(np.abs(error), nan_ok=True)
    assert found.slip_visible_mm == pytest.approx(np.abs(error + 1), nan_ok=True)
    assert np.isnan(result().slip_visible_mm).all()
    assert found.within.tolist() == [
        True,
        False,
        True,
        True,
        False,
        False,
        False,
        False,
    ]
    calibrated = {3: error[:2].mean(0), 5: error[4], 7: error[6]}
    want = np.array(
        [np.full(3, math.nan) if math.isnan(g) else np.abs(e - calibrated[s])
         for s, g, e in zip(SUBJECT.tolist(), GAZE_DEG.tolist(), error, strict=True)]
    )  # fmt: skip
    assert found.slip_rest_mm == pytest.approx(want, nan_ok=True)


def test_means_of_a_subject_leave_out_what_is_unknown():
    found = result()
    assert found.per_subject(GAZE_DEG) == pytest.approx([(0.25 + 4.0) / 2, 2.75, 8.0])
    axial = found.trial.group(AXIAL)
    assert found.per_subject(GAZE_DEG, axial) == pytest.approx(
        [0.25, 2.75, math.nan], nan_ok=True
    )
    lateral = found.trial.group(LATERAL)
    assert found.per_subject(READ_MM[:, 0], lateral) == pytest.approx(
        [1.0, math.nan, math.nan], nan_ok=True
    )


def test_points_span_the_field_across_and_down():
    found = ExperimentConfig(grid=(3, 2), share=0.5, field_deg=(30.0, 8.0)).stimuli_deg
    assert found.tolist() == [[-15, -4], [0, -4], [15, -4], [-15, 4], [0, 4], [15, 4]]
