"""What a process does to a pillar, in closed form; which exposures are known and
corrected.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from layout.process import process
from layout.process.process import DesignRules, EtchProfile, ExposureSettings, Process
from metalens.fabrication import Bias


def octagon(corner_nm, **more):
    return Process(
        rules=DesignRules(vertices=8),
        etch=EtchProfile(corner_radius_nm=corner_nm),
        **more,
    )


@pytest.mark.parametrize(
    ("written", "radius"), [(200.0, 27.0), (130.0, 41.0), (60.0, 30.0), (34.0, 17.0)]
)
def test_corners_round_off_to_their_radius_or_to_that_of_the_pillar(written, radius):
    """Each of eight corners loses r² (tan 22.5 deg - pi / 8); the last two pillars are
    narrower than two corner radii
    of 30 and of 50. The diameter is that of the area to first order: the next is (lost
    / area)² d / 8."""
    lost = 8 * radius**2 * (math.sqrt(2) - 1 - math.pi / 8)
    area = math.pi * written**2 / 4
    want = 2 * math.sqrt((area - lost) / math.pi)
    corner = {27.0: 27.0, 41.0: 41.0, 30.0: 30.0, 17.0: 50.0}[radius]
    made = float(octagon(corner).made_diameter_nm(written))
    assert made == pytest.approx(want, abs=1.2 * (lost / area) ** 2 * written / 8)
    assert made < written - 0.9 * lost / area * written / 2


def test_what_is_drawn_makes_the_design_to_a_millionth_of_a_picometre():
    """Large corners, a bias that changes with the size, and a pillar that stands half
    alone.
    """
    some = octagon(
        60.0, bias=Bias(table_nm=((80.0, -9.0), (220.0, 12.0)), isolated_nm=7.0)
    )
    design = np.array([[61.0, 133.7], [180.2, 299.0]])
    for alone in (0.0, 0.5):
        written = some.written_diameter_nm(design, alone)
        assert written.shape == (2, 2)
        assert some.made_diameter_nm(written, alone) == pytest.approx(design, abs=1e-9)
    assert some.made_diameter_nm(200.0, 0.5) - some.made_diameter_nm(
        200.0
    ) == pytest.approx(3.5, abs=1e-12)


def test_a_tilted_wall_takes_from_the_top_what_it_gives_to_the_foot():
    """45 deg would give the whole height; tan 26.565 deg is a half."""
    top, foot = Process(
        etch=EtchProfile(sidewall_deg=math.degrees(math.atan(0.5)))
    ).top_foot_nm(np.array([500.0, 900.0]), 320.0)
    assert top == pytest.approx(np.array([340.0, 740.0]), rel=1e-12)
    assert foot == pytest.approx(np.array([660.0, 1060.0]), rel=1e-12)


@pytest.mark.parametrize(
    ("given", "known", "missing"),
    [
        ({}, False, "alpha_um, beta_um, eta (or csv)"),
        ({"alpha_um": 0.01, "beta_um": 9.0}, False, "eta (or csv)"),
        ({"alpha_um": 0.01, "eta": 0.6}, False, "beta_um (or csv)"),
        ({"alpha_um": 0.01, "beta_um": 9.0, "eta": 0.6}, True, " (or csv)"),
        ({"alpha_um": 0.01, "beta_um": 9.0, "eta": 0.0}, True, " (or csv)"),
        ({"csv": Path("p.csv")}, True, "alpha_um, beta_um, eta (or csv)"),
    ],
)
def test_an_exposure_is_known_by_three_numbers_or_a_table_and_then_corrected(
    given, known, missing
):
    made = ExposureSettings(**given)
    assert (made.known, made.corrected, made.missing) == (known, known, missing)
    assert not ExposureSettings(correct=False, **given).corrected
    if known:
        assert ExposureSettings(correct=True, **given).corrected


def test_the_defaults_of_a_process_are_those_of_its_docstring():
    """100 kV lithography of 700 nm amorphous silicon: what the guide tells."""
    made = process.Process()
    rules, exposure, die = made.rules, made.exposure, made.die
    assert (
        rules.minimum_feature_nm,
        rules.minimum_gap_nm,
        rules.minimum_foot_gap_nm,
    ) == (80.0, 70.0, 50.0)
    assert (
        rules.grid_nm,
        rules.diameter_step_nm,
        rules.angle_step_deg,
        rules.vertices,
    ) == (1, 2, 1.0, 32)
    assert (rules.maximum_density, rules.density_window_um) == (0.75, 20.0)
    assert (
        exposure.base_uC_cm2,
        exposure.tolerance,
        exposure.maximum_classes,
        exposure.nu,
    ) == (300.0, 0.01, 255, 0.0)
    assert (made.write_field.size_um, made.write_field.stitching_nm) == (500.0, 20.0)
    assert (die.margin_um, die.street_um, die.mark_um, die.mark_width_um) == (
        500.0,
        50.0,
        100.0,
        5.0,
    )
    assert (die.vernier_pitch_um, die.vernier_step_nm, die.thickness_um) == (
        8.0,
        50.0,
        500.0,
    )
    assert (made.etch.sidewall_deg, made.etch.corner_radius_nm) == (0.0, 10.0)
    layers = made.layers
    numbers = [
        layers.pillar,
        layers.aperture,
        layers.marks,
        layers.labels,
        layers.dose,
        layers.witness,
        layers.fields,
    ]
    assert numbers == [(n, 0) for n in range(1, 8)]
    assert layers.outline == (10, 0)
