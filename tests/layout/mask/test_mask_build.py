"""From diameters to the plan of a mask: quantisation, bias, doses, die features;
impossible input is refused.
"""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import layout
from layout.mask import cells, die, font
from layout.pec import psf
from layout.process.process import (
    DesignRules,
    DieSettings,
    ExposureSettings,
    LayerTable,
    Process,
)
from layout.shapes import polygon
from metalens.core.errors import LensError, ProcessError
from metalens.fabrication import Bias
from metalens.lens.record import DiameterMap
from tests.referees import rims

PLAIN = Process(exposure=ExposureSettings(correct=False))


def disc_map(n=41, pitch=0.4, seed=0):
    """A round lens of random diameters, without symmetry."""
    axis = np.arange(n) - (n - 1) / 2
    d = np.random.default_rng(seed).uniform(0.1, 0.3, (n, n))
    d[axis**2 + axis[:, None] ** 2 > (n / 2) ** 2] = 0
    return DiameterMap(d, pitch)


@given(step=st.integers(1, 10), seed=st.integers(0, 99))
def test_drawn_diameters_are_within_half_a_step(step, seed):
    source = disc_map(15, seed=seed)
    found = cells.quantise_diameters(
        source, Process(rules=DesignRules(diameter_step_nm=step))
    )
    there = source.diameter_um > 0
    assert np.array_equal(found.classes > 0, there)
    drawn = found.diameters_nm[found.classes[there].astype(int) - 1]
    wanted = Process().written_diameter_nm(source.diameter_um[there] * 1e3)
    # the table of designed diameters has 1/16 nm
    assert np.abs(drawn - wanted).max() <= step / 2 + 1 / 16
    assert np.array_equal(np.bincount(found.classes.ravel())[1:], found.counts)


def test_bias_is_taken_off():
    process = Process(bias=Bias(table_nm=((50.0, -10.0), (400.0, -10.0))))
    one = cells.quantise_diameters(DiameterMap(np.array([[0.2]]), 0.4), Process())
    other = cells.quantise_diameters(DiameterMap(np.array([[0.2]]), 0.4), process)
    assert other.diameters_nm[0] - one.diameters_nm[0] == 10


def test_a_pillar_at_the_rim_is_drawn_wider_where_isolated_ones_come_out_thin():
    process = Process(bias=Bias(isolated_nm=-10.0))
    ((_, drawn),) = cells.drawn_blocks(
        DiameterMap(np.full((31, 31), 0.2), 0.4), process
    )
    ((_, alone),) = cells.drawn_blocks(DiameterMap(np.array([[0.2]]), 0.4), Process())
    assert drawn[0, 0] > drawn[15, 15]
    assert drawn[15, 15] == alone[0, 0]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -0.1, 0.4, 0.5])
def test_impossible_diameters_are_refused_with_row_and_column(bad):
    d = np.full((5, 7), 0.2)
    d[3, 4] = bad
    with pytest.raises(LensError, match="row 3, column 4"):
        layout.plan(DiameterMap(d, 0.4), PLAIN)


def test_a_bias_that_makes_pillars_touch_is_refused_with_row_and_column():
    d = np.full((5, 7), 0.2)
    d[2, 6] = 0.39
    process = Process(bias=Bias(table_nm=((50.0, -30.0), (400.0, -30.0))))
    with pytest.raises(ProcessError, match="row 2, column 6"):
        layout.plan(DiameterMap(d, 0.4), process)


def test_a_pillar_that_vanishes_is_refused():
    d = np.full((3, 3), 0.2)
    d[1, 2] = 0.0004
    with pytest.raises(ProcessError, match="row 1, column 2"):
        layout.plan(DiameterMap(d, 0.4), PLAIN)


def test_an_empty_lens_is_refused():
    with pytest.raises(LensError, match="no pillar"):
        layout.plan(DiameterMap(np.zeros((4, 4)), 0.4), PLAIN)


def test_a_pitch_off_the_grid_is_refused():
    with pytest.raises(ProcessError, match="no multiple of the grid"):
        layout.plan(disc_map(pitch=0.4005), PLAIN)
    with pytest.raises(ProcessError, match="no multiple of the grid"):
        layout.plan(
            disc_map(pitch=0.402),
            Process(rules=DesignRules(grid_nm=5, diameter_step_nm=10)),
        )


@pytest.mark.parametrize("n", [1, 2, 9, 10])
def test_the_axis_of_the_lens_is_the_origin_and_coordinates_are_those_of_the_lens(n):
    d = np.zeros((n, n))
    d[0, n - 1] = 0.2
    plan = layout.plan(DiameterMap(d, 0.4), PLAIN, furnished=False)
    lattice = plan.lattices[0]
    half = (n - 1) * 200
    assert (lattice.x0, lattice.y0) == (-half, half)
    # the map's first row, at negative y, is the lowest of the mask
    assert lattice.whole()[n - 1, n - 1] == 1
    assert plan.axis == (0, 0)


def test_an_even_lens_on_an_odd_pitch_lies_half_a_step_off_and_says_so():
    plan = layout.plan(disc_map(10, pitch=0.401), PLAIN, furnished=False)
    assert plan.axis == (-0.5, 0.5)
    assert isinstance(plan.lattices[0].x0, int)


def test_a_coarse_grid_holds_for_everything():
    process = Process(
        rules=DesignRules(grid_nm=5, diameter_step_nm=10),
        exposure=ExposureSettings(correct=False),
    )
    plan = layout.plan(disc_map(31), process)
    assert plan.grid == 5
    assert layout.check_plan(plan, process.rules).counts["off-grid"] == 0


BEAM = {"alpha_um": 0.012, "beta_um": 27.0, "eta": 0.65}


def test_doses_become_named_datatypes_and_every_shape_has_one():
    plan = layout.plan(disc_map(61), Process())
    made = layout.correct(plan, ExposureSettings(**BEAM, tolerance=0.02))
    drawn = {c.layer for c in made.classes} | {
        layer for f in made.figures for layer in f.polygons
    }
    assert drawn - set(made.doses) == {(10, 0)}
    for c in made.classes:
        assert made.doses[c.layer] == c.dose
        assert made.layer_names[c.layer].endswith(f"dose_{c.dose:.4f}")
    assert len({c.layer for c in made.classes if c.layer[0] == 1}) > 1


def test_everything_on_the_die_is_exposed_right_by_the_exact_sum():
    """Pillars of lens, dose test and witness cells, and a mark: the direct sum over all
    of them, at some edges.
    """
    settings = ExposureSettings(**BEAM, tolerance=0.01)
    plan = layout.correct(layout.plan(disc_map(41), Process()), settings)
    point = psf.point_exposure(settings)
    centres, wide, dose, goal = [], [], [], []
    for lattice in plan.lattices:
        rows, columns = np.nonzero(lattice.whole())
        centres.append(
            np.stack([lattice.x0 + columns * 400, lattice.y0 - rows * 400], -1) * 1e-3
        )
        kinds = [plan.classes[k - 1] for k in lattice.whole()[rows, columns]]
        wide += [c.diameter_nm * 1e-3 for c in kinds]
        dose += [c.dose for c in kinds]
        goal += [c.goal for c in kinds]
    centres = np.concatenate(centres)
    wide = np.array(wide)
    dose = np.array(dose)
    goal = np.array(goal)
    which = np.linspace(0, len(wide) - 1, 24).astype(int)
    beside = [f.polygons.items() for f in plan.figures if f.name in ("MARKS", "LABEL")]
    shapes = [
        (p, plan.doses[layer]) for items in beside for layer, ps in items for p in ps
    ]
    edges = rims.at_edges(centres, wide, dose, point, which=which, rim_points=8)
    box = np.array([[*p.min(0), *p.max(0)] for p, _ in shapes]) * 1e-3
    level = np.array([dose for _, dose in shapes])
    area = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])
    for n, index in enumerate(
        which
    ):  # marks and label: small beside the width of the beam that reaches this far
        away = np.hypot(*(((box[:, :2] + box[:, 2:]) / 2 - centres[index]).T))
        edges[n] += (level * area * point.density(away)).sum()
    assert abs(edges / (0.5 * goal[which]) - 1).max() < 0.01 + 2e-3
    assert set(np.round(goal[which], 2)) >= {0.8, 1.0, 1.2}


def test_the_die_holds_everything_within_its_street_and_apart():
    process = Process(exposure=ExposureSettings(correct=False))
    plan = layout.plan(disc_map(101), process, name="LENS_7")
    names = {figure.name for figure in plan.figures} | {
        lattice.name for lattice in plan.lattices
    }
    assert names == {
        "APERTURE",
        "MARKS",
        "VERNIERS",
        "LABEL",
        "OUTLINE",
        "LENS",
        "DOSETEST",
        "WITNESS",
    }
    assert layout.check_plan(plan, process.rules).ok
    outline = next(f for f in plan.figures if f.name == "OUTLINE").polygons[
        process.layers.outline
    ][0]
    edge = outline.max() - 1000 * process.die.street_um
    for figure in plan.figures:
        if figure.name != "OUTLINE":
            assert (
                max(np.abs(p).max() for ps in figure.polygons.values() for p in ps)
                <= edge
            )
    doses = {c.dose for c in plan.classes if c.layer[0] == process.layers.dose[0]}
    assert doses == set(die.BLOCKS.doses)


def test_the_aperture_opens_the_lens_and_the_test_structures():
    plan = layout.plan(disc_map(101), PLAIN)
    openings = next(f for f in plan.figures if f.name == "APERTURE").polygons[
        PLAIN.layers.aperture
    ]
    radius = 1000 * (disc_map(101).radius_um + 0.2)
    assert polygon.twice_area(openings[0]) / 2 == pytest.approx(
        math.pi * radius**2, rel=1e-4
    )
    for lattice in plan.lattices[1:]:
        corners = (
            (lattice.x0, lattice.y0),
            (lattice.x0 + (lattice.columns - 1) * lattice.pitch, lattice.y0),
        )
        assert any(
            all(
                p[:, 0].min() < x < p[:, 0].max() and p[:, 1].min() < y < p[:, 1].max()
                for x, y in corners
            )
            for p in openings[1:]
        )


@given(radius=st.floats(1e3, 5e6), grid=st.sampled_from([1, 5]))
def test_the_aperture_disc_keeps_its_area_and_fits_gdsii(radius, grid):
    shape = die.aperture_polygon(radius, (0.0, 0.0), grid)
    assert len(shape) <= 8000
    assert (shape % grid == 0).all()
    # rounding moves each vertex by at most 0.71 grid steps, its edge by as much: 1.5 g
    # / R of the area
    assert polygon.twice_area(shape) / 2 == pytest.approx(
        math.pi * radius**2, rel=1.5 * grid / radius + 1e-9
    )


def test_a_die_without_room_is_refused_with_what_it_needs():
    with pytest.raises(ProcessError, match=r"\d+ um are needed"):
        layout.plan(
            disc_map(101), dataclasses.replace(PLAIN, die=DieSettings(margin_um=60))
        )


def test_letters_are_upright_and_unknown_ones_are_refused():
    shapes = font.text_rectangles("L", x=0, y=0, square=10)
    heights = {
        (int(s[:, 0].min()), int(s[:, 0].max())) for s in shapes if s[:, 1].min() == 0
    }
    assert heights == {(0, 50)}  # the foot of an L is at the bottom
    assert max(int(s[:, 1].max()) for s in shapes) == 70
    with pytest.raises(ProcessError, match="font"):
        font.text_rectangles("Ä", x=0, y=0, square=10)


def test_dose_test_layers_keep_clear_of_the_others():
    with pytest.raises(ProcessError, match="marks and dose are both on number 5"):
        LayerTable(marks=(5, 3))  # the dose array uses 5/0 to 5/8


def test_doses_of_the_test_array_are_datatypes_of_one_layer():
    """From 0.8 in steps of 0.05, on 16/20 and the eight that follow."""
    plan = layout.plan(
        disc_map(101), dataclasses.replace(PLAIN, layers=LayerTable(dose=(16, 20)))
    )
    found = {made.layer: made.dose for made in plan.classes if made.layer[0] == 16}
    assert found == pytest.approx({(16, 20 + k): 0.8 + 0.05 * k for k in range(9)})


def test_a_lens_without_symmetry_is_drawn_in_its_own_coordinates_as_an_independent_reader_sees_them(
    tmp_path,
):
    """One pillar right of the axis and one at positive y, read back by KLayout: neither
    axis is mirrored.
    """
    db = pytest.importorskip("klayout.db")
    d = np.zeros((21, 21))
    d[10, 15], d[18, 10] = 0.20, 0.30  # (x, y) = (+2.0, 0) and (0, +3.2) um
    mask = layout.plan(DiameterMap(d, 0.4), PLAIN, furnished=False)
    for write, name in ((layout.write_oasis, "m.oas"), (layout.write_gdsii, "m.gds")):
        write(mask, tmp_path / name)
        read = db.Layout()
        read.read(str(tmp_path / name))
        region = db.Region(read.top_cell().begin_shapes_rec(read.layer(1, 0)))
        found = {
            (round(p.bbox().center().x), round(p.bbox().center().y)): p.bbox().width()
            for p in region.each()
        }
        assert found.keys() == {(2000, 0), (0, 3200)}
        assert found[2000, 0] == pytest.approx(200, abs=4)
        assert found[0, 3200] == pytest.approx(300, abs=4)
