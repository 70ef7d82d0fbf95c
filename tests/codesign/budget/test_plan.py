"""The planner on a pilot whose optimum is known, and its words and files."""

import math

import numpy as np
import pytest

from codesign.budget import plan
from codesign.budget.plan import Pilot, PlanConfig
from codesign.budget.task import TaskSetting
from codesign.commands import plan as command_plan
from metalens.ground.errors import ConfigError

CONFIG = PlanConfig(stacks=10, frames=100)


def _pilot(**changed):
    """Every knob has two levels: coarse errs by its own share along gaze x and costs 1, fine is exact and costs 10."""
    levels = {name: (row[0], row[-1]) for name, row in plan.LEVELS.items()}
    levels["depth_count"], levels["wavelength_count"] = (4, 12), (1, 2)
    levels["psf_tolerance"] = (1e-2, 1e-4)
    errors = {name: np.zeros((2, 3, 2)) for name in levels}
    for k, name in enumerate(levels):
        errors[name][0, :, 0] = (k + 1) * 1e-4
    seconds = {name: np.array([1.0, 10.0]) for name in levels}
    return Pilot(levels, errors | changed, seconds, 1e-3, 5.0)


def test_a_loose_goal_takes_the_coarsest_of_everything():
    best = plan.choose(_pilot(), 1.0, CONFIG)
    assert best.met
    assert best.choice.library_tolerance == plan.LEVELS["library_tolerance"][0]
    assert best.choice.depth_count == 4
    assert best.predicted_rad == pytest.approx(21e-4)  # the errors add in one direction
    assert best.seconds < best.finest_seconds


def test_an_impossible_goal_is_said_to_be_missed():
    errors = {name: np.full((2, 3, 2), 1e-3) for name in plan.LEVELS}
    best = plan.choose(_pilot(**errors), 1e-6, CONFIG)
    assert not best.met
    assert best.choice.depth_count == 12


def test_the_cheapest_combination_of_all_is_found():
    """Against a search by hand over every combination."""
    measured = _pilot()
    names = list(measured.levels)
    for goal in (3.5e-4, 7.5e-4, 15.5e-4):
        best = plan.choose(measured, goal, CONFIG)
        costs = []
        for code in range(2 ** len(names)):
            at = [(code >> k) & 1 for k in range(len(names))]
            error = sum((k + 1) * 1e-4 for k in range(len(names)) if at[k] == 0)
            cost = {n: measured.seconds[n][i] for n, i in zip(names, at, strict=True)}
            stack = cost["depth_count"] * cost["wavelength_count"] / 1.0 * cost["psf_tolerance"] / 10.0
            total = cost["library_tolerance"] + 10 * stack + 100 * cost["kernel_tolerance"] + cost["diameter_step_nm"]
            if error <= goal + 1e-15:
                costs.append(total)
        assert best.predicted_rad <= goal + 1e-12
        assert best.seconds == pytest.approx(min(costs))


def test_errors_that_happen_to_cancel_are_not_relied_on():
    measured = _pilot()
    measured.errors["depth_count"][0] = -measured.errors["library_tolerance"][0]
    tight = plan.choose(measured, 1e-9, CONFIG)
    assert tight.choice.depth_count == 12
    loose = plan.choose(measured, 1.5e-4, CONFIG)  # one of the two alone, or both: sqrt(2) of 1e-4 together
    assert (loose.choice.depth_count, loose.choice.library_tolerance) == (4, plan.LEVELS["library_tolerance"][0])
    assert loose.predicted_rad == pytest.approx(math.sqrt(2) * 1e-4)


@pytest.mark.parametrize(
    ("text", "rad"), [("0.1deg", math.radians(0.1)), ("6 arcmin", math.radians(0.1)), ("2e-3rad", 2e-3)]
)
def test_angles_carry_their_unit(text, rad):
    assert command_plan.angle_rad(text) == pytest.approx(rad)


@pytest.mark.parametrize("text", ["0.1", "deg", "-1deg", "0deg", "1furlong", "nandeg", "", "1e400deg", "1.2.3deg"])
def test_angles_without_a_unit_or_a_value_are_refused(text):
    with pytest.raises(ConfigError, match="gaze error"):
        command_plan.angle_rad(text)


def test_impossible_runs_are_refused():
    with pytest.raises(ConfigError, match="aperture_mm"):
        PlanConfig(aperture_mm=0)
    with pytest.raises(ConfigError, match="stacks"):
        PlanConfig(stacks=0)


def test_the_words_say_what_was_chosen(tmp_path):
    best, measured = plan.choose(_pilot(), 1.0, CONFIG), _pilot()
    text = command_plan.text(best, measured, tmp_path)
    assert "library tolerance" in text
    assert "NOT MET" not in text
    assert command_plan.values(best, measured)["met"] is True


def test_a_run_at_one_wavelength_is_planned():
    """The pilot of a lens of 0.1 mm with few settings; one knob has a single one."""
    config = PlanConfig(aperture_mm=0.1, stacks=2, frames=10, task=TaskSetting(scenes=1, pixels=32, margin=4))
    chain = plan.Chain(config)
    chain.levels |= {"library_tolerance": (3e-2, 1e-2), "depth_count": (4, 12), "psf_tolerance": (1e-2, 1e-4)}
    chain.levels |= {"kernel_tolerance": (1e-1, 1e-4), "diameter_step_nm": (20, 1)}
    measured = plan.pilot(chain)
    best = plan.choose(measured, math.radians(0.1), config)
    assert best.met
    assert best.choice.wavelength_count == 1
    assert 0 < best.predicted_rad < math.radians(0.1)


def test_the_cost_of_a_run_is_a_library_its_stacks_its_images_and_its_mask():
    """Unlike seconds for every knob: times of a stack multiply, relative to the pilot's; a goal that all meet."""
    measured = _pilot()
    seconds = {name: np.array([0.3 + k, 5.0 + 2 * k]) for k, name in enumerate(measured.levels)}
    measured = Pilot(measured.levels, measured.errors, seconds, 1e-3, 5.0)
    names = list(measured.levels)
    places = np.array([[1, 0, 1, 0, 1, 0][: len(names)], [0, 1, 1, 1, 0, 1][: len(names)]])
    got = plan._cost(measured, places, names, CONFIG)
    for found, place in zip(got, places, strict=True):
        cost = {n: seconds[n][i] for n, i in zip(names, place, strict=True)}
        pilot = {
            n: seconds[n][measured.levels[n].index(getattr(plan.PILOT, n))]
            for n in ("wavelength_count", "psf_tolerance")
        }
        stack = cost["depth_count"] * cost["wavelength_count"] / pilot["wavelength_count"]
        stack *= cost["psf_tolerance"] / pilot["psf_tolerance"]
        want = cost["library_tolerance"] + 10 * stack + 100 * cost["kernel_tolerance"] + cost["diameter_step_nm"]
        assert found == pytest.approx(want, rel=1e-12)


def test_errors_count_over_both_angles_and_all_scenes():
    """Vectors of all knobs added scene by scene, squared over both angles, averaged; and no less than apart."""
    measured = _pilot()
    rng = np.random.default_rng(2)
    for name in measured.errors:
        measured.errors[name][0] = rng.normal(0, 1e-3, (3, 2))
    best = plan.choose(measured, 1.0, CONFIG)
    total = sum(measured.errors[n][0] for n in measured.levels)
    together = (total**2).sum(1).mean()
    apart = sum((measured.errors[n][0] ** 2).sum(1).mean() for n in measured.levels)
    assert best.predicted_rad == pytest.approx(math.sqrt(max(together, apart)), rel=1e-12)
