"""From a map to a plan by hand: steps on the grid, the first site, the radius of the
opening, the words of a label.
"""

import numpy as np
import pytest

from layout.mask import build
from layout.process.process import (
    DesignRules,
    DieSettings,
    ExposureSettings,
    LayerTable,
    Process,
)
from metalens.cell.record import Cell
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap, Lens
from metalens.pillars.proxy import Proxy

PROXY = Proxy(
    np.array([[3.3, 3.3, 0.2]]),
    np.array([[0.9, 0.05]]),
    (0.1, 0.3),
    (0.85, 0.85),
    0.0,
    0.0,
)
SIZES = np.array([[0.1, 0.2, 0.0, 0.15], [0.0, 0.0, 0.2, 0.0], [0.12, 0.0, 0.0, 0.2]])


def process(grid=1, **more):
    return Process(
        rules=DesignRules(grid_nm=grid, diameter_step_nm=2 * grid),
        exposure=ExposureSettings(correct=False),
        **more,
    )


def test_a_pitch_is_whole_steps_of_the_grid_to_a_millionth_of_one():
    assert build.pitch_units(0.405, process(5)) == 405
    assert build.pitch_units(0.405 + 4.9e-9, process(5)) == 405
    with pytest.raises(
        ProcessError, match="pitch 407 nm is no multiple of the grid of 5 nm"
    ):
        build.pitch_units(0.407, process(5))
    with pytest.raises(ProcessError, match="no multiple"):
        build.pitch_units(0.405 + 5.1e-9, process(5))


@pytest.mark.parametrize(
    ("shape", "steps", "grid", "want"),
    [
        ((3, 5), (410, 300), 1, (-820, 300, (0.0, 0.0))),
        ((4, 4), (405, 301), 1, (-608, 452, (-0.5, 0.5))),  # 607.5 and 451.5
        ((3, 4), (410, 305), 5, (-615, 305, (0.0, 0.0))),
        ((4, 2), (415, 305), 5, (-210, 460, (-2.5, 2.5))),  # 207.5 and 457.5
    ],
)
def test_the_axis_is_at_the_origin_or_half_a_step_of_the_grid_left_and_above(
    shape, steps, grid, want
):
    assert build._origin(shape, steps, grid) == want


def test_the_map_s_first_row_is_the_lowest_of_the_mask():
    """Rows 0.37 um apart; the opening reaches half a pitch beyond the farthest pillar's
    middle.
    """
    made = build.prepare_mask(
        DiameterMap(SIZES, 0.4, row_um=0.37), process(), name="A", furniture="aperture"
    )
    (lattice,) = made.plan.lattices
    assert (lattice.pitch, lattice.down, lattice.x0, lattice.y0) == (
        400,
        370,
        -600,
        370,
    )
    sizes = np.array([0, *(c.diameter_units for c in made.plan.classes)])[
        lattice.whole()
    ]
    assert sizes.tolist() == (1000 * SIZES[::-1]).round().astype(int).tolist()
    assert made.radius_um == pytest.approx(np.hypot(0.6, 0.37) + 0.2, rel=1e-12)
    assert made.cells.rounding_nm == 1.0
    assert made.dose is None
    assert made.plan.doses == {(1, 0): 1.0, (2, 0): 1.0}
    assert (made.plan.name, made.plan.unit_nm, made.plan.grid) == ("A", 1.0, 1)


def test_classes_have_polygons_of_the_rules_on_the_grid():
    made = build.prepare_mask(
        DiameterMap(SIZES, 0.4), process(2), furniture="none"
    ).plan
    assert [c.name for c in made.classes] == [
        "D100",
        "D120",
        "D152",
        "D200",
    ]  # 150 goes to a step of 4
    for c in made.classes:
        assert c.diameter_nm == c.diameter_units == int(c.name[1:])
        assert not (c.outline % 2).any()
        assert c.twice_area / 2 == pytest.approx(
            np.pi * c.diameter_nm**2 / 4, rel=0.01
        )  # a grid of 2 nm
        assert c.outline.max() <= 1.03 * c.diameter_nm / 2
    assert made.figures == ()


def lens(sizes=SIZES):
    return Lens(
        DiameterMap(sizes, 0.4), Cell(0.4), PROXY, 0.85, 200.0, 2000.0, "hyperbolic"
    )


def test_a_label_says_profile_wavelength_size_and_pitch():
    assert build._label(lens(), 614.9) == "hyperbolic 850NM 1.23MM P400"
    assert build._label(DiameterMap(SIZES, 0.4125), 50.04) == "LENS 0.1MM P412.5"


def test_surroundings_are_the_die_without_the_lens():
    about = process(die=DieSettings(verniers=False))
    made = build.die_surroundings(
        lens(), about, name="D", size_um=(1400.0, 900.0), clear_um=90.0, label="AB"
    )
    assert [lattice.name for lattice in made.plan.lattices] == ["WITNESS", "DOSETEST"]
    aperture = next(f for f in made.plan.figures if f.name == "APERTURE").polygons[2, 0]
    assert all(np.abs(shape).max(0).max() > 90_000 for shape in aperture)
    outline = next(f for f in made.plan.figures if f.name == "OUTLINE").polygons[10, 0][
        0
    ]
    assert outline.max(0).tolist() == [700_000, 450_000]
    assert made.dose is None


def test_a_wafer_s_mark_has_the_pillars_of_the_lens_as_witnesses():
    made = build.wafer_mark(lens(), process(), name="M", mark_um=400.0, width_um=20.0)
    assert [lattice.name for lattice in made.plan.lattices] == ["WITNESS"]
    assert [f.name for f in made.plan.figures] == ["APERTURE", "MARKS"]
    assert {c.diameter_units for c in made.plan.classes if c.name[0] == "W"} == {
        100,
        150,
        200,
    }


def test_doses_on_the_layer_of_something_else_are_refused():
    """Nine doses of the test array from 5/0 on meet witnesses on 5/4."""
    about = process(layers=LayerTable(witness=(5, 4)))
    with pytest.raises(
        ProcessError,
        match="layer 5/4 is a dose of the dose layer and the witness layer",
    ):
        build.prepare_mask(lens(), about)
