"""The planner on a pilot whose optimum is known, and its words and files."""

import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.budget import chain, plan
from codesign.budget.plan import Pilot, PlanConfig
from codesign.budget.task import TaskSetting
from codesign.commands import plan as command_plan
from codesign.train import run as runs
from metalens.cell import Cell, Layer
from metalens.cell.shapes import Square
from metalens.commands.library import CellFile
from metalens.commands.psf import Settings
from metalens.ground import config as config_file
from metalens.ground.errors import ConfigError

CONFIG = PlanConfig(stacks=10, frames=100)


def _pilot(**changed):
    """Every knob has two levels: coarse errs by its own share along gaze x and costs 1,
    fine is exact and costs 10.
    """
    levels = {name: (row[0], row[-1]) for name, row in plan.LEVELS.items()}
    levels["depth_count"], levels["wavelength_count"] = (4, 12), (1, 2)
    levels["psf_tolerance"] = (1e-2, 1e-4)
    errors = {name: np.zeros((2, 3, 2)) for name in levels}
    for k, name in enumerate(levels):
        errors[name][0, :, 0] = (k + 1) * 1e-4
    seconds = {name: np.array([1.0, 10.0]) for name in levels}
    return Pilot(levels, errors | changed, seconds, 1e-3, 5.0)


@pytest.mark.parametrize("table", ["LEVELS", "TRUE_LEVELS"])
def test_levels_go_from_the_coarsest_to_the_finest(table):
    """Tolerances and steps fall, counts rise."""
    for name, row in getattr(chain, table).items():
        steps = np.diff(row) * (1 if name.endswith("_count") else -1)
        assert (steps > 0).all(), name


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
    assert (best.choice.depth_count, best.choice.diameter_step_nm) == (12, 1)
    assert best.seconds == best.finest_seconds


def test_a_goal_that_is_just_met_is_met():
    """Powers of two, whose squares and roots are exact."""
    errors = {name: np.zeros((2, 3, 2)) for name in _pilot().levels}
    errors["library_tolerance"][0, :, 0] = 2.0**-12
    best = plan.choose(_pilot(**errors), 2.0**-12, CONFIG)
    assert best.choice.library_tolerance == plan.LEVELS["library_tolerance"][0]


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
            stack = (
                cost["depth_count"]
                * cost["wavelength_count"]
                / 1.0
                * cost["psf_tolerance"]
                / 10.0
            )
            total = (
                cost["library_tolerance"]
                + 10 * stack
                + 100 * cost["kernel_tolerance"]
                + cost["diameter_step_nm"]
            )
            if error <= goal + 1e-15:
                costs.append(total)
        assert best.predicted_rad <= goal + 1e-12
        assert best.seconds == pytest.approx(min(costs))


def test_errors_that_happen_to_cancel_are_not_relied_on():
    measured = _pilot()
    measured.errors["depth_count"][0] = -measured.errors["library_tolerance"][0]
    tight = plan.choose(measured, 1e-9, CONFIG)
    assert tight.choice.depth_count == 12
    loose = plan.choose(
        measured, 1.5e-4, CONFIG
    )  # one of the two alone, or both: sqrt(2) of 1e-4 together
    assert (loose.choice.depth_count, loose.choice.library_tolerance) == (
        4,
        plan.LEVELS["library_tolerance"][0],
    )
    assert loose.predicted_rad == pytest.approx(math.sqrt(2) * 1e-4)


@pytest.mark.parametrize(
    ("text", "rad"),
    [("0.1deg", math.radians(0.1)), ("6 arcmin", math.radians(0.1)), ("2e-3rad", 2e-3)],
)
def test_angles_carry_their_unit(text, rad):
    assert command_plan.angle_rad(text) == pytest.approx(rad)


@pytest.mark.parametrize(
    "text",
    [
        "0.1",
        "deg",
        "-1deg",
        "0deg",
        "1furlong",
        "nandeg",
        "",
        "1e400deg",
        "1.2.3deg",
        "1e9deg",
        "90deg",
    ],
)
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


@pytest.mark.slow
def test_a_run_at_one_wavelength_is_planned():
    """The pilot of a lens of 0.1 mm with few settings; one knob has a single one."""
    small = TaskSetting(scenes=1, pixels=32, margin=4)
    config = PlanConfig(
        aperture_mm=0.1, stacks=2, frames=10, image="uniform", task=small
    )
    chain = plan.Chain(config)
    chain.levels |= {
        "library_tolerance": (3e-2, 1e-2),
        "depth_count": (4, 12),
        "psf_tolerance": (1e-2, 1e-4),
    }
    chain.levels |= {"kernel_tolerance": (1e-1, 1e-4), "diameter_step_nm": (20, 1)}
    measured = plan.pilot(chain)
    best = plan.choose(measured, math.radians(0.1), config)
    assert best.met
    assert best.choice.wavelength_count == 1
    assert 0 < best.predicted_rad < math.radians(0.1)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            'spectrum = ["led.csv"]',
            "measured curves, single lines and sources of finite size are for metalens psf",
        ),
        ("wavelengths_nm = [850.0, 905.0]", "one wavelength or a diode about it"),
        (
            "[[layers.behind]]\nmaterial = 'N-BK7'\nthickness_um = 100.0",
            "metalens budget LENS reckons with them",
        ),
        (
            "led_fwhm_nm = 300.0",
            "reaches to 100 nm, where the sensor's silicon is not known",
        ),
        (
            "[cell]\npitch_um = 0.35\n[cell.lattice]\nkind = 'hexagonal'",
            "cell.lattice: circle on a hexagonal lattice: ",
        ),
        (
            "[cell]\npitch_um = 0.4\n[cell.shape]\nkind = 'rectangle'\nratio = 0.6",
            "cell.shape: rectangle 1:0.6 on a square lattice: ",
        ),
        ("led_fwhm_nm = 1e-9", "is one wavelength; give no width for it"),
    ],
)
def test_light_and_lenses_that_no_plan_knows_are_refused_with_where_to_go(
    tmp_path, text, told
):
    (tmp_path / "plan.toml").write_text(text + "\n")
    with pytest.raises(ConfigError, match=re.escape(told)):
        config_file.load(tmp_path / "plan.toml", PlanConfig)


@pytest.mark.slow
def test_a_run_of_true_images_is_planned():
    """A lens of 0.1 mm, tolerances of 0.3 and 0.2: off the axis its image differs from
    that of the axial PSF.
    """
    small = TaskSetting(scenes=1, pixels=32, margin=4)
    config = PlanConfig(
        aperture_mm=0.1, stacks=2, frames=10, led_fwhm_nm=30.0, task=small
    )
    chain = plan.Chain(config)
    assert chain.true
    chain.levels |= {
        "library_tolerance": (3e-2, 1e-2),
        "image_tolerance": (0.3, 0.2),
        "diameter_step_nm": (20, 1),
    }
    measured = plan.pilot(chain)
    best = plan.choose(measured, math.radians(1.0), config)
    assert set(measured.levels) == {
        "library_tolerance",
        "image_tolerance",
        "diameter_step_nm",
    }
    assert best.met
    assert 0 < best.predicted_rad < math.radians(1.0)
    table = chain.table(3e-2)
    optics = chain.optics(table, 0.2)
    assert plan.nodes_of(optics) == measured.nodes[1]
    assert chain.device(0.2) is chain.device(0.2)  # all pillars share its nodes
    one = chain.electrons(chain.device(0.2).one_psf())
    assert float((chain.electrons(optics) - one).norm() / one.norm()) > 1e-4


def test_files_of_a_plan_of_true_images(tmp_path):
    """Seven columns of nodes: axis, two between, edge of 20 pixels of 18 um beside the
    middle.
    """
    layered = Cell(
        0.32, 0.7, shape=Square(), layers=(Layer(0.6), Layer(0.1, material="SiO2"))
    )
    config = PlanConfig(
        aperture_mm=0.3,
        led_fwhm_nm=30.0,
        source_distance_mm=33.0,
        task=TaskSetting(pixels=32, margin=4),
        cell=layered,
    )
    eyes, lens = (
        SimpleNamespace(depths_um=(15e3, 27e3)),
        SimpleNamespace(sensor_distance_um=2000.0),
    )
    chain = SimpleNamespace(config=config, eyes=eyes, lens=lens)
    levels = {
        "library_tolerance": (3e-2,),
        "image_tolerance": (0.3, 0.12),
        "diameter_step_nm": (20,),
    }
    nothing = {name: np.zeros((len(row), 3, 2)) for name, row in levels.items()}
    nodes = ((3, 3, 5, 1), (7, 7, 9, 5))
    measured = Pilot(
        levels,
        nothing,
        {n: np.ones(len(row)) for n, row in levels.items()},
        1e-3,
        5.0,
        nodes=nodes,
    )
    best = plan.Plan(0.01, plan.TrueChoice(3e-2, 0.12, 20), 0.008, 3.0, 9.0, True)
    command_plan.write(tmp_path, best, measured, chain)
    made = runs.load(tmp_path / "run.toml").optics
    assert (made.image, made.image_tolerance, made.fwhm_nm) == ("true", 0.12, 30.0)
    assert (made.aperture_mm, made.focus_mm, made.depths_mm) == (
        0.3,
        33.0,
        (15.0, 27.0),
    )
    seen = config_file.load(tmp_path / "psf.toml", Settings)
    edge = math.degrees(math.atan(20 * 18.0 / 2000))
    assert seen.angles_deg == pytest.approx([0, edge / 3, 2 * edge / 3, edge], abs=1e-3)
    assert (seen.tolerance, seen.led_fwhm_nm) == (
        0.04,
        0.0,
    )  # as the library of cell.toml: metalens psf takes it
    swept = config_file.load(tmp_path / "cell.toml", CellFile)
    assert (swept.cell, swept.sweep.wavelengths_um, swept.sweep.tolerance) == (
        layered,
        (0.85,),
        3e-2,
    )
    told = " ".join(
        (tmp_path / "psf.toml").read_text().splitlines()[:2]
    )  # 2.5 widths to either side
    assert "led_fwhm_nm = 30 here" in told
    assert told.endswith("wavelengths_um = [0.775, 0.85, 0.925]")
    assert seen.depths_mm == pytest.approx((15.0, 27.0, 1.5))
    assert "7 rows, 7 columns, 9 depths, 5 wavelengths" in command_plan.text(
        best, measured, tmp_path
    )
    assert json.loads((tmp_path / "plan.json").read_text())["nodes"]["wavelengths"] == 5


def test_a_plan_of_one_psf_a_depth_says_so(tmp_path):
    """Its run would otherwise be one of true images, whose settings nobody chose."""
    config = PlanConfig(image="uniform", led_fwhm_nm=30.0)
    eyes = SimpleNamespace(depths_um=(15e3, 27e3))
    best = plan.choose(_pilot(), 1.0, config)
    (tmp_path / "run.toml").write_text(
        command_plan.run_text(best, SimpleNamespace(config=config, eyes=eyes))
    )
    made = runs.load(tmp_path / "run.toml").optics
    assert (made.image, made.depth_count, made.tolerance) == ("uniform", 4, 0.1)
    assert command_plan.values(best, _pilot())["nodes"] == {}


def test_seconds_of_a_run_of_true_images_add():
    levels = {
        "library_tolerance": (3e-2, 1e-2),
        "image_tolerance": (0.3, 0.1),
        "diameter_step_nm": (20, 1),
    }
    seconds = {"library_tolerance": np.array([1.0, 3.0]), "image_tolerance": np.array([70.0, 500.0]),
               "diameter_step_nm": np.array([0.2, 0.9])}  # fmt: skip
    errors = {name: np.array([[[3e-3, 0.0]], [[0.0, 0.0]]]) for name in levels}
    measured = Pilot(
        levels, errors, seconds, 1e-3, 5.0, nodes=((3, 3, 5, 1), (9, 9, 9, 1))
    )
    best = plan.choose(
        measured, 6.1e-3, CONFIG
    )  # two of the three may stay coarse: the images are the dear ones
    assert best.choice == plan.TrueChoice(3e-2, 0.3, 1)
    assert best.seconds == pytest.approx(1.0 + 70.0 + 0.9)
    assert best.finest_seconds == pytest.approx(503.9)
    assert command_plan.chosen_nodes(best, measured) == {
        "rows": 3,
        "columns": 3,
        "depths": 5,
        "wavelengths": 1,
    }


def test_the_cost_of_a_run_is_a_library_its_stacks_its_images_and_its_mask():
    """Unlike seconds for every knob: times of a stack multiply, relative to the
    pilot's; a goal that all meet.
    """
    measured = _pilot()
    seconds = {
        name: np.array([0.3 + k, 5.0 + 2 * k]) for k, name in enumerate(measured.levels)
    }
    measured = Pilot(measured.levels, measured.errors, seconds, 1e-3, 5.0)
    names = list(measured.levels)
    places = np.array(
        [[1, 0, 1, 0, 1, 0][: len(names)], [0, 1, 1, 1, 0, 1][: len(names)]]
    )
    got = plan.cost_s(measured, places, names, CONFIG)
    for found, place in zip(got, places, strict=True):
        cost = {n: seconds[n][i] for n, i in zip(names, place, strict=True)}
        pilot = {
            n: seconds[n][measured.levels[n].index(getattr(plan.PILOT, n))]
            for n in ("wavelength_count", "psf_tolerance")
        }
        stack = (
            cost["depth_count"] * cost["wavelength_count"] / pilot["wavelength_count"]
        )
        stack *= cost["psf_tolerance"] / pilot["psf_tolerance"]
        want = (
            cost["library_tolerance"]
            + 10 * stack
            + 100 * cost["kernel_tolerance"]
            + cost["diameter_step_nm"]
        )
        assert found == pytest.approx(want, rel=1e-12)


def test_errors_count_over_both_angles_and_all_scenes():
    """Vectors of all knobs added scene by scene, squared over both angles, averaged;
    and no less than apart.
    """
    measured = _pilot()
    rng = np.random.default_rng(2)
    for name in measured.errors:
        measured.errors[name][0] = rng.normal(0, 1e-3, (3, 2))
    best = plan.choose(measured, 1.0, CONFIG)
    total = sum(measured.errors[n][0] for n in measured.levels)
    together = (total**2).sum(1).mean()
    apart = sum((measured.errors[n][0] ** 2).sum(1).mean() for n in measured.levels)
    assert best.predicted_rad == pytest.approx(
        math.sqrt(max(together, apart)), rel=1e-12
    )
