"""Captures as benches really give them: right within the intervals, or refused with the cause named."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import bench_lens as b

import characterize
from characterize.estimate import Options
from metalens.errors import FitError

USUAL = Options(scan_um=60.0)


def fit(shots, strength_rad=0.0, options=USUAL):
    return characterize.fit(shots, b.lens(strength_rad), options, response=b.RESPONSE)


def right(result, **more):
    """All fitted parameters within 4.5 sigma of the truth, and 2 sigma in the mean."""
    truth = b.VALUES | more
    pairs = [(i, n) for i, n in enumerate(result.names) if n != "log_gain"]
    z = np.array([(result.value[i] - truth.get(n, 0.0)) / result.sigma[i] for i, n in pairs])
    return result.trusted and np.abs(z).max() < 4.5 and np.sqrt((z**2).mean()) < 2


def frames_of(shots, frames):
    return dataclasses.replace(shots, frames=np.ascontiguousarray(frames))


def test_shuffled_order_is_recovered():
    shots = b.capture(b.electrons())
    found = fit(frames_of(shots, shots.frames[[2, 0, 4, 1, 3]]))
    assert any("only in the order [1, 3, 0, 4, 2]" in words for words in found.cautions)
    assert right(found)


def test_orientation_of_a_symmetric_design_is_declared_unobservable():
    found = fit(b.capture(b.electrons()))
    assert any("orientation of the frames cannot be seen" in words for words in found.cautions)


def test_too_little_light_is_refused():
    with pytest.raises(FitError, match="too little light"):
        fit(b.capture(b.electrons(50.0)))


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.01, 0.05])
def test_saturated_pixels_are_lower_bounds(share):
    bright = b.electrons()
    assert right(fit(b.capture(bright, full_well=np.quantile(bright, 1 - share))))


@pytest.mark.slow
def test_hot_pixels_and_a_dead_row_are_masked():
    shots = b.capture(b.electrons())
    hot = shots.frames.copy()
    rows, columns = np.random.default_rng(3).integers(0, 16, (2, 3))
    hot[:, rows, columns] = 4000
    assert right(fit(frames_of(shots, hot)))
    dead = shots.frames.copy()
    dead[:, 5] = 0
    assert right(fit(frames_of(shots, dead)))


@pytest.mark.slow
def test_reversed_order_is_recovered():
    shots = b.capture(b.electrons())
    assert right(fit(frames_of(shots, shots.frames[::-1])))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "value"), [("stage_zero_um", 60.0), ("stage_zero_um", -60.0), ("stage_scale", 0.02)])
def test_stage_errors_are_found(name, value):
    found = fit(b.capture(b.electrons(**{name: value})), options=Options(scan_um=100.0))
    assert right(found, **{name: value})


@pytest.mark.slow
def test_steep_background_and_vibration_are_found():
    steep = {"background_x_e": 1500.0, "background_e": 1600.0}
    assert right(fit(b.capture(b.electrons(**steep))), **steep)
    assert right(fit(b.capture(b.electrons(crosstalk_px=1.0))), crosstalk_px=1.0)


@pytest.mark.slow
def test_a_repeated_frame_is_refused():
    shots = b.capture(b.electrons())
    with pytest.raises(FitError, match="repeated frame"):
        fit(frames_of(shots, shots.frames[[0, 1, 1, 3, 4]]))
