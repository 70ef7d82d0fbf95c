"""How frames lie, read off the frames."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures.electrons import clean
from characterize.inference import arrange as arranging
from characterize.inference.prepare import data_of, setting_of
from characterize.model.forward import ForwardModel


@pytest.mark.parametrize("side", [4, 6, 16])
def test_frames_in_order_stay_so_in_windows_that_the_light_fills(side):
    """Less a plane through their rim, such frames may sum to nothing or less; no number may grow beyond bounds."""
    shots = b.capture(b.electrons())
    middle = slice(8 - side // 2, 8 + side // 2)
    shots = dataclasses.replace(shots, frames=shots.frames[:, middle, middle])
    frames = clean(shots)
    setting, window = setting_of(shots, 64)
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        found = arranging.arrange(model, data_of(frames, window), scan_um=20.0)
    assert not found.reordered
    assert not found.clearly
