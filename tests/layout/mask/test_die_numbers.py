"""Test structures of a die by hand: which pillars in which dose, block by block, and
the cross of a wafer.
"""

import itertools
import math

import numpy as np
import pytest

from layout.mask import MaskPlan, PillarClass, PillarLattice, die
from layout.mask.marks import DatabaseUnits, MarkBox
from layout.process.process import DieSettings, LayerTable, Process
from metalens.core.errors import ProcessError

SIZES = (150, 110, 170, 130)  # not in order
PROCESS = Process(
    layers=LayerTable(dose=(5, 7), witness=(6, 2)),
    die=DieSettings(size_um=(1300.0, 900.0), label="AB", verniers=False),
)


def square(half):
    return np.array([[-half, -half], [half, -half], [half, half], [-half, half]])


def plan(sizes=SIZES, **more):
    """A lens of 3 x 4 sites, 402 apart and rows 300, on a grid of 4."""
    classes = [
        PillarClass(f"D{d:03}", float(d), d, (1, 0), square(d // 2)) for d in sizes
    ]
    lattice = PillarLattice(
        "LENS",
        3,
        4,
        402,
        -600,
        300,
        lambda a, b: np.ones((b - a, 4), np.uint8),
        row_pitch=300,
        **more,
    )
    return MaskPlan(
        "TOP",
        tuple(classes),
        (lattice,),
        grid=4,
        layer_names={(1, 0): "pillar"},
        doses={(1, 0): 1.1},
    )


def furnished(sizes=SIZES):
    return die.add_die_frame(plan(sizes), PROCESS, radius_um=40.0, label="default")


def blocks(sites, side):
    """Class number of each block, row by row, and whether all else is empty."""
    step = side + 8
    rows, columns = (n // step + 1 for n in sites.shape)
    found = [
        [np.unique(sites[i * step :, j * step :][:side, :side]) for j in range(columns)]
        for i in range(rows)
    ]
    assert all(len(one) == 1 for row in found for one in row)
    numbers = np.array([[int(one[0]) for one in row] for row in found])
    assert np.count_nonzero(sites) == side * side * np.count_nonzero(numbers)
    assert sites.shape == (rows * step - 8, columns * step - 8)
    return numbers


def test_the_dose_test_has_nine_doses_of_each_size_thinnest_first():
    """From 0.8 by twentieths to 1.2 of dose-to-size, a datatype each; blocks of 16 x 16
    pillars, 8 sites apart.
    """
    made = furnished()
    assert (
        pytest.approx([0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2], rel=1e-12)
        == die.DOSES
    )
    lattice = made.lattices[1]
    assert (lattice.name, lattice.pitch, lattice.down, lattice.centred) == (
        "DOSETEST",
        402,
        300,
        False,
    )
    numbers = blocks(lattice.array, 16)
    assert numbers.tolist() == [[5 + 4 * k + n for n in range(4)] for k in range(9)]
    for k, row in enumerate(numbers):
        some = [made.classes[number - 1] for number in row]
        assert [c.diameter_units for c in some] == [110, 130, 150, 170]
        assert {c.layer for c in some} == {(5, 7 + k)}
        assert {(c.dose, c.goal) for c in some} == {(die.DOSES[k], die.DOSES[k])}
        assert made.layer_names[5, 7 + k] == f"dose_test_dose_{0.8 + 0.05 * k:.2f}"
        assert made.doses[5, 7 + k] == die.DOSES[k]
    assert [c.name for c in made.classes[4:8]] == ["T000", "T001", "T002", "T003"]
    assert made.classes[40].name == "W036"


def test_witnesses_stand_in_two_columns_of_forty_pillars():
    made = furnished()
    assert blocks(made.lattices[2].array, 40).tolist() == [[41, 42], [43, 44]]
    some = made.classes[40:]
    assert [(c.diameter_units, c.layer, c.dose) for c in some] == [
        (d, (6, 2), 1.0) for d in (110, 130, 150, 170)
    ]
    three = furnished(SIZES[:3])
    assert blocks(three.lattices[2].array, 40).tolist() == [[31, 32], [33, 0]]
    assert blocks(furnished(SIZES[:1]).lattices[2].array, 40).tolist() == [[11]]


@pytest.mark.parametrize(
    ("count", "most", "want"),
    [(11, 6, [0, 2, 4, 6, 8, 10]), (10, 3, [0, 4, 9]), (5, 8, range(5))],
)
def test_of_many_sizes_some_are_taken_evenly_from_first_to_last(count, most, want):
    assert [c for c in die._spread(list(range(count)), most)] == list(want)


def test_a_lens_of_many_sizes_has_six_in_the_dose_test_and_eight_witnesses():
    """Of 15 sizes the sixths (0, 2.8, 5.6, 8.4, 11.2, 14) and the eighths (every
    second).
    """
    made = furnished([100 + 10 * k for k in range(15)])
    assert len(made.classes) == 15 + 9 * 6 + 8
    doses, witnesses = made.classes[15:69], made.classes[69:]
    assert [c.diameter_units for c in doses[:6]] == [100, 130, 160, 180, 210, 240]
    assert [c.diameter_units for c in witnesses] == list(range(100, 250, 20))
    assert blocks(made.lattices[1].array, 16).shape == (9, 6)
    assert blocks(made.lattices[2].array, 40).shape == (4, 2)


def test_what_is_not_corrected_has_dose_one_and_every_layer_its_name():
    made = furnished()
    layers = PROCESS.layers
    assert {
        layer: made.doses[layer]
        for layer in (layers.aperture, layers.marks, layers.labels)
    } == {(2, 0): 1.0, (3, 0): 1.0, (4, 0): 1.0}
    assert made.doses[1, 0] == 1.1
    names = {
        (2, 0): "aperture",
        (3, 0): "marks",
        (4, 0): "label",
        (6, 2): "witness",
        (10, 0): "outline",
    }
    assert {layer: made.layer_names[layer] for layer in names} == names
    assert [f.name for f in made.figures] == ["APERTURE", "MARKS", "LABEL", "OUTLINE"]
    (outline,) = made.figures[3].polygons[10, 0]
    assert (
        outline.tolist()
        == MarkBox(-650_000, -450_000, 650_000, 450_000).polygon.tolist()
    )


def test_an_aperture_without_furniture_has_the_area_of_its_circle():
    made = die.open_aperture(plan(), PROCESS, radius_um=40.0)
    (figure,) = made.figures
    (disc,) = figure.polygons[2, 0]
    x, y = disc.T
    assert 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() == pytest.approx(
        math.pi * 40_000**2, rel=2e-5
    )  # grid
    assert not (disc % 4).any()
    assert (
        len(disc) == 316
    )  # pi sqrt(40 000 / 4) = 314.2: edges of fewer sink in by more than half a step of 4 nm
    assert (made.doses, made.layer_names) == (
        {(1, 0): 1.1, (2, 0): 1.0},
        {(1, 0): "pillar", (2, 0): "aperture"},
    )


def test_a_die_without_a_size_leaves_its_margin_around_the_aperture():
    unit = DatabaseUnits(plan())
    assert die._outline(
        Process(die=DieSettings(margin_um=70.0)), unit, 40.0
    ) == MarkBox(-110_000, -110_000, 110_000, 110_000)
    assert die._outline(PROCESS, unit, 40.0) == MarkBox(
        -650_000, -450_000, 650_000, 450_000
    )


def test_blocks_on_a_hexagonal_lattice_take_twice_the_columns_and_every_other_site():
    lattice = plan(centred=True).lattices[0]
    sites = die._blocks(np.array([[3, 4], [0, 6]]), 5, lattice)
    step = 13
    assert sites.shape == (2 * step - 8, 2 * (2 * step - 8))
    for row, column in itertools.product(range(18), range(36)):
        i, u = divmod(row, step)
        j, v = divmod(column, 2 * step)
        inside = u < 5 and v < 10 and (row + column) % 2 == 0
        assert sites[row, column] == (((3, 4), (0, 6))[i][j] if inside else 0)


def test_a_block_is_centred_to_the_grid_below_and_its_cells_reach_half_a_step_beyond():
    """7 columns of 402 are 2412 from first to last, 5 rows of 300 are 1200; 8 of 402
    are 2814.
    """
    made = die._centred("X", np.ones((5, 7), np.uint8), plan(), 10_003)
    assert (made.x0, made.y0) == (8796, 600)  # 10 003 - 1206 = 8797
    assert (
        die._centred("X", np.ones((4, 8), np.uint8), plan(), -9999).x0 == -11_408
    )  # -9999 - 1407 = -11 406
    assert die._centred("X", np.ones((4, 8), np.uint8), plan(), 0).y0 == 448  # 450
    assert die._extent(made) == MarkBox(
        8796 - 201, 600 - 1200 - 201, 8796 + 2412 + 201, 600 + 201
    )
    hexagonal = die._centred("X", np.ones((5, 7), np.uint8), plan(centred=True), 0)
    assert hexagonal.centred
    assert die._extent(hexagonal) == MarkBox(
        -1208 - 402, -600 - 402, -1208 + 2412 + 402, 600 + 402
    )


def test_a_wafer_mark_has_sixteen_by_sixteen_pillars_of_three_sizes_between_two_arms():
    """Sizes 110, 150 (of four the middle one rounds up) and 170; the middle of the
    blocks is 100 um right and up.
    """
    made = die.wafer_mark(plan(), PROCESS, mark_um=400.0, width_um=20.0)
    (lattice,) = made.lattices
    assert blocks(lattice.array, 16).tolist() == [[5, 6, 7]]
    assert [(c.name, c.diameter_units, c.layer) for c in made.classes[4:]] == [
        ("W000", 110, (6, 2)),
        ("W001", 150, (6, 2)),
        ("W002", 170, (6, 2)),
    ]
    x = lattice.x0 + (lattice.columns - 1) * 402 / 2
    y = lattice.y0 - (lattice.rows - 1) * 300 / 2
    assert (x, y) == (
        pytest.approx(100_000, abs=4),
        pytest.approx(100_000, abs=4),
    )  # the grid
    (window,) = made.figures[0].polygons[2, 0]
    assert (
        window.tolist()
        == MarkBox(-205_000, -205_000, 205_000, 205_000).polygon.tolist()
    )
    assert len(made.figures[1].polygons[3, 0]) == 5
    assert made.doses == {(2, 0): 1.0, (3, 0): 1.0, (6, 2): 1.0}
    assert made.layer_names == {(2, 0): "aperture", (3, 0): "marks", (6, 2): "witness"}


def refused(boxes, aperture, half=5000):
    with pytest.raises(ProcessError) as told:
        die._refuse_overlaps(
            boxes,
            aperture,
            DatabaseUnits(plan()),
            MarkBox(-half, -half - 1000, half, half + 1000),
        )
    return str(told.value)


def test_overlaps_are_found_with_the_disc_and_with_each_other_and_touching_is_none():
    """A box whose corner is 300 and 400 from the middle of an aperture of 500."""
    apart = {
        "DOSETEST": [MarkBox(310, 420, 900, 800)],
        "MARKS": [MarkBox(900, 0, 990, 420), MarkBox(-70, 800, 310, 950)],
    }
    die._refuse_overlaps(
        apart, ((10.0, 20.0), 500.0), DatabaseUnits(plan()), MarkBox(-1, -1, 1, 1)
    )
    near = apart | {"DOSETEST": [MarkBox(309, 420, 900, 800)]}
    assert "DOSETEST and the aperture overlap on a die of 10 x 12 um" in refused(
        near, ((10.0, 20.0), 500.0)
    )
    for corner in (
        MarkBox(-900, -800, -289, -380),
        MarkBox(309, -800, 900, -380),
        MarkBox(-900, 420, -289, 800),
    ):
        assert "DOSETEST and the aperture" in refused(
            {"DOSETEST": [corner]}, ((10.0, 20.0), 500.0)
        )
    on = apart | {"LABEL": [MarkBox(5000, 0, 5100, 10), MarkBox(980, 400, 1000, 500)]}
    assert "MARKS and LABEL overlap" in refused(on, ((10.0, 20.0), 0.0))
    assert "draw smaller marks" in refused(on, ((10.0, 20.0), 0.0))
