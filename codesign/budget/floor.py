"""What no setting of the numerics changes: the least gaze error that a plan can
promise.
"""

import math

from codesign.adapt import Source
from codesign.budget.entry import Entry, total
from codesign.budget.person import person
from codesign.budget.reading import Reading
from codesign.evaluate import ExperimentConfig
from codesign.eye import Rig
from metalens.ground.errors import ConfigError


def floor(
    rig: Rig, run: Source | None, frames: ExperimentConfig, *, fwhm_nm: float = 0.0
) -> tuple[Entry, ...]:
    """Links of the error budget that no setting changes; with a run those of its
    reader, measured on its frames.
    """
    if run is None:
        return tuple(person(frames, rig))
    return tuple(
        entry for entry in Reading(run, frames, fwhm_nm=fwhm_nm).path() if entry.counted
    )


def allowance_rad(goal_rad: float, links: tuple[Entry, ...]) -> float:
    """What settings may add to a floor so that the root of the sum of squares meets the
    goal.

    Raises:
        ConfigError: the goal is not above the floor; it names the floor and its largest
            link.
    """
    least = total(list(links)).gaze_rad
    if goal_rad <= least:
        worst = max(links, key=lambda e: e.gaze_rad)
        raise ConfigError(
            f"gaze error {math.degrees(goal_rad):.3g} deg: no setting reaches it; what no setting changes errs by "
            f"{math.degrees(least):.3g} deg, most of it {worst.link} with {math.degrees(worst.gaze_rad):.3g} deg; "
            f"ask for more than {math.degrees(least):.3g} deg"
        )
    return math.sqrt(goal_rad**2 - least**2)
