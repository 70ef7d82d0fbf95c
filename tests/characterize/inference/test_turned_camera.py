"""A camera that is turned against the lens: as the lens's aberrations turned the other
way, reckoned with and told.
"""

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import causes
from characterize.inference.search import SearchTask
from characterize.model import parameter_vector

WAYS = {"coma": (1, 0.23, -0.11), "trefoil": (3, -0.12, 0.17)}
DATA, MODEL = b.near_focus((420.0, 760.0))
TASK = SearchTask(MODEL, DATA, parameter_vector(), {}, None)


def bent(turn_deg):
    """Coma, trefoil and astigmatism of a lens turned from +x to +y: by one, three and
    two times the angle.
    """
    out = {"astigmatism_rad": 0.0, "oblique_astigmatism_rad": 0.0}
    for name, (times, x, y) in WAYS.items():
        turned = complex(x, y) * np.exp(1j * times * math.radians(turn_deg))
        out |= {f"{name}_x_rad": turned.real, f"{name}_y_rad": turned.imag}
    both = complex(0.19, -0.14) * np.exp(2j * math.radians(turn_deg))
    return parameter_vector(
        out
        | {
            "astigmatism_rad": both.real,
            "oblique_astigmatism_rad": both.imag,
            "crosstalk_px": 0.2,
        }
    )


@pytest.mark.parametrize("turn_deg", [24.0, -35.0])
def test_frames_of_a_turned_camera_are_those_of_a_lens_turned_back(turn_deg):
    """A fifth of the change: the square lattice of 100 pillars across is not quite
    round, nor are the pixels.
    """
    plain, want = (MODEL.images(bent(angle))[0] for angle in (0.0, -turn_deg))
    (found,) = causes.seen_at(MODEL, bent(0.0), [causes._turn(turn_deg)])
    changed = np.linalg.norm(plain - want)
    assert np.linalg.norm(found - want) < 0.2 * changed
    assert changed > 0.02 * np.linalg.norm(want)


def test_light_is_not_turned_by_nothing_and_turns_with_the_pixels_by_a_quarter():
    upright, quarter = causes.seen_at(
        MODEL, bent(0.0), [causes._turn(angle) for angle in (0.0, 90.0)]
    )
    assert np.abs(upright - MODEL.images(bent(0.0))[0]).max() < 1e-3 * upright.max()
    # what lies at +y is seen at +x
    assert np.abs(quarter - np.rot90(upright, 1, (1, 2))).max() < 1e-3 * upright.max()


@pytest.mark.parametrize(
    ("stated", "wanted"), [({}, 2.0), ({"camera_turn_deg": 0.2}, 0.4)]
)
def test_it_is_reckoned_with_at_one_degree_or_as_stated(stated, wanted):
    task = dataclasses.replace(TASK, unfitted=stated)
    slopes = {"stage_zero_um": np.zeros_like(DATA.electrons)}
    (turned,) = [
        one
        for one in causes.systematic_changes(task, bent(0.0), slopes)
        if one.cause == "a camera that is turned"
    ]
    assert turned.sigma == pytest.approx(wanted)  # of half a degree
    assert turned.amount == 0.5
    assert not [
        one
        for one in causes.systematic_changes(task, parameter_vector(), slopes)
        if one.cause == "a camera that is turned"
    ]
