"""The negative tone by hand, units of 2 nm on a grid of 4: squares, runs of empty
sites, windows, what is left.
"""

import numpy as np
import pytest

from layout.mask import FigureCell, MaskPlan, PillarClass, PillarLattice, tone
from layout.process.process import Process
from metalens.core.errors import ProcessError

SITES = np.array(
    [[1, 0, 0, 1, 0], [0, 0, 0, 2, 0], [0, 0, 0, 2, 2], [1, 0, 0, 0, 0]], np.uint8
)


def lattice(sites=SITES, **more):
    rows, columns = sites.shape
    about = {"row_pitch": 300} | more
    return PillarLattice(
        "LENS", rows, columns, 412, -8, 1008, lambda a, b: sites[a:b], sites, **about
    )


def box(left, bottom, right, top):
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def edges(shape):
    left, bottom = shape.min(0).tolist()
    right, top = shape.max(0).tolist()
    assert sorted(shape.tolist()) == sorted(box(left, bottom, right, top).tolist())
    return left, bottom, right, top


def area(shape):
    x, y = np.asarray(shape).T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def total(shapes):
    return sum(area(shape) for shape in shapes)


def pillar(name, *around):
    return PillarClass(name, 100.0, 50, (1, 0), box(*around))


def plan(
    *figures, made=(("A", (-60, -48, 64, 80)), ("B", (-100, -80, 100, 88))), **more
):
    classes = tuple(pillar(name, *around) for name, around in made)
    return MaskPlan("TOP", classes, (lattice(**more),), figures, unit_nm=2.0, grid=4)


def test_squares_abut_and_lie_on_the_grid_about_their_site():
    """412 by 300: 206 and 150 down to the grid, 204 and 148, on the left and below; of
    bricks 412 of 824.
    """
    assert tone._square(lattice(), 4) == (-204, -148, 208, 152)
    assert tone._square(lattice(row_pitch=0), 4) == (-204, -204, 208, 208)
    assert tone._square(lattice(centred=True), 4) == (-412, -148, 412, 152)
    assert edges(tone.lattice_box(lattice(), 4)) == (
        -212,
        1008 - 900 - 148,
        -8 + 4 * 412 + 208,
        1160,
    )


def test_what_is_left_of_a_square_has_a_slit_at_the_pillar_s_middle():
    left = tone._around(pillar("A", -60, -48, 64, 80), (-204, -148, 208, 152), 4).drawn
    assert total(left) == 412 * 300 - 124 * 128
    assert len(left) == 2
    assert {int(shape[:, 0].max()) for shape in left} == {
        0,
        208,
    }  # (64 - 60) / 2 is half a step


@pytest.mark.parametrize("side", range(4))
def test_a_pillar_as_wide_as_its_square_is_drawn_and_a_wider_one_refused(side):
    around = [-100, -100, 100, 100]
    around[side] = (-204, -148, 208, 152)[side]
    assert tone._around(pillar("A", *around), (-204, -148, 208, 152), 4).drawn
    around[side] += (-4, -4, 4, 4)[side]
    with pytest.raises(
        ProcessError, match="wider than the lattice square of 412 by 300"
    ):
        tone._around(pillar("A", *around), (-204, -148, 208, 152), 4)


@pytest.mark.parametrize("sites", [1 << 20, 5])
def test_empty_sites_are_few_rectangles_from_edge_to_edge(monkeypatch, sites):
    """Columns 1 and 2 of the first row; 0 to 2 of the two below, 4 of the first two; 1
    to 4 of the last.
    """
    monkeypatch.setattr(tone, "_BLOCK_SITES", sites)

    def around(columns, rows):
        (a, b), (c, d) = columns, rows
        return (
            -8 + 412 * a - 204,
            1008 - 300 * d + 152,
            -8 + 412 * b - 204,
            1008 - 300 * c + 152,
        )

    got = {edges(shape) for shape in tone._empty(lattice(), -204, 152)}
    assert got == {
        around((1, 3), (0, 1)),
        around((4, 5), (0, 2)),
        around((0, 3), (1, 3)),
        around((1, 5), (3, 4)),
    }


def test_of_a_hexagonal_lattice_a_brick_covers_two_columns():
    """Pillars at columns 0 and 2 of a row of three leave nothing of its four columns;
    one at 1 leaves both ends.
    """
    sites = np.array([[1, 0, 1], [0, 2, 0]], np.uint8)
    got = {
        edges(shape) for shape in tone._empty(lattice(sites, centred=True), -412, 152)
    }
    low, high = 1008 - 600 + 152, 1008 - 300 + 152
    assert got == {
        (-420, low, -8, high),
        (-8 + 3 * 412 - 412, low, -8 + 4 * 412 - 412, high),
    }


def test_without_a_die_a_rim_of_one_pitch_goes_around():
    made = tone.reverse_tone(plan(), Process())
    rim, clear = made.figures
    assert (rim.name, clear.name, list(rim.polygons), list(clear.polygons)) == (
        "RIM",
        "CLEAR",
        [(1, 0)],
        [(1, 0)],
    )
    left, bottom, right, top = -212, -40, 1848, 1160
    assert [edges(shape) for shape in rim.polygons[1, 0]] == [
        (left - 412, bottom - 412, right + 412, bottom),
        (left - 412, top, right + 412, top + 412),
        (left - 412, bottom, left, top),
        (right, bottom, right + 412, top),
    ]
    assert len(clear.polygons[1, 0]) == 4
    assert made.standing is not None
    assert (made.standing.figures, made.name) == ((), "TOP")


DIE = FigureCell("OUTLINE", {(10, 0): (box(-20_000, -16_000, 24_000, 18_000),)})
MARKS = FigureCell(
    "MARKS",
    {(3, 0): (box(-18_000, 8000, -13_000, 10_000), box(-10_500, 9000, -9000, 9500))},
)
LABEL = FigureCell("LABEL", {(4, 0): (box(12_000, -15_000, 15_000, -14_000),)})
APERTURE = FigureCell("APERTURE", {(2, 0): (box(-900, -900, 900, 900),)})


def test_windows_of_5_um_are_cut_at_the_die_and_at_each_other():
    """2500 units around: the first mark's window ends 500 beyond the die, the second's
    begins 2500 units within the
    first's; the label's ends 1500 beyond."""
    process = Process()
    made = {
        f.name: f
        for f in tone.reverse_tone(plan(MARKS, LABEL, DIE, APERTURE), process).figures
    }
    assert set(made) == {"MARKS", "LABEL", "OUTLINE", "APERTURE", "FRAME", "CLEAR"}
    first = (20_000 - 10_500) * 7000
    second = (10_500 - 6500) * 5500
    standing = 5000 * 2000 + 1500 * 500
    assert total(made["MARKS"].polygons[3, 0]) == first + second - standing
    assert total(made["LABEL"].polygons[4, 0]) == 8000 * (6000 - 1500) - 3000 * 1000
    lens = 5 * 412 * 4 * 300
    rest = 44_000 * 34_000 - first - second - 8000 * 4500 - lens
    assert total(made["FRAME"].polygons[1, 0]) == rest
    assert made["APERTURE"] is APERTURE
    assert made["OUTLINE"] is DIE


def test_two_figures_share_no_window_and_lattices_stay_as_they_are():
    """The second figure's window, 3000 units to the right of the first's bar, begins
    where the first's ends.
    """
    one = FigureCell("MARKS", {(3, 0): (box(-12_000, 8000, -11_000, 9000),)})
    two = FigureCell("LABEL", {(4, 0): (box(-8000, 8000, -7000, 9000),)})
    made = {
        f.name: f for f in tone.reverse_tone(plan(one, two, DIE), Process()).figures
    }
    assert total(made["MARKS"].polygons[3, 0]) == 6000 * 6000 - 1000 * 1000
    assert total(made["LABEL"].polygons[4, 0]) == 4000 * 6000 - 1000 * 1000
    near = FigureCell(
        "MARKS", {(3, 0): (box(-1000, 1600, 1000, 2000),)}
    )  # its window reaches over the lens from above
    made = {f.name: f for f in tone.reverse_tone(plan(near, DIE), Process()).figures}
    over = (1848 + 212) * (1160 + 40)
    window = 7000 * (4500 + 900)
    assert total(made["MARKS"].polygons[3, 0]) == window - 2000 * 400 - over


def test_lattices_of_two_pitches_are_refused():
    two = plan().replace(
        lattices=(lattice(), PillarLattice.of("MORE", SITES, pitch=500, x0=9000, y0=0))
    )
    with pytest.raises(ProcessError, match=r"lattices of pitches \[412, 500\]"):
        tone.reverse_tone(two, Process())
