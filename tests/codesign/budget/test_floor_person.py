"""What no setting and no reader changes: the scatter of a gaze told the truth, and
goals that lie below it.
"""

import math
from dataclasses import replace

import pytest

from codesign.budget import floor
from codesign.budget.entry import Entry
from codesign.budget.person import person
from codesign.evaluate import ExperimentConfig
from codesign.eye import Rig
from metalens.ground.errors import ConfigError

FRAMES = ExperimentConfig(
    subjects=4,
    grid=(6, 5),
    share=0.3,
    axial_mm=(-2.5, 3.0),
    lateral_mm=(1.5,),
    hidden=0,
    people=9,
    fixation_deg=0.6,
)


def test_fixation_alone_is_its_own_scatter():
    """Told the truth, a person errs by the scatter of the gaze: two normal angles have
    a mean of sd sqrt(pi / 2).

    Budget: calibration on 9 stimuli of the same scatter, 7 unknowns each: up to 30 %.
    """
    subject, fixation = person(FRAMES, Rig())
    assert math.degrees(fixation.gaze_rad) == pytest.approx(
        0.6 * math.sqrt(math.pi / 2), rel=0.3
    )
    assert 0 < math.degrees(subject.gaze_rad) < 1.5
    still, none = floor.floor(Rig(), None, replace(FRAMES, fixation_deg=0.0))
    assert (
        still.gaze_rad == subject.gaze_rad
    )  # whoever calibrates looks where told, in both
    assert none.gaze_rad == 0
    assert (still.link, none.link) == ("subject and calibration", "fixation")


def test_a_goal_below_the_floor_is_refused_with_its_largest_link():
    """3 and 4 mrad are 5 together; of 13 they leave 12."""
    links = (
        Entry("subject and calibration", math.nan, math.nan, 3e-3, ""),
        Entry("fixation", 0, 0, 4e-3, ""),
        Entry("sensor noise", 0, 0, 70e-3, "", counted=False),
    )
    with pytest.raises(
        ConfigError, match=r"0.286 deg, most of it fixation with 0.229 deg"
    ):
        floor.allowance_rad(4.9e-3, links[:2])
    assert floor.allowance_rad(13e-3, links) == pytest.approx(12e-3)
