"""Slabs, heights, incident waves and sums of orders of a near field, piece by piece, by
hand.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens.cell import Cell, Film, Incidence, Index, Lattice
from metalens.cell.record import Layer
from metalens.cell.shapes import Ellipse, Polygon, Rectangle
from metalens.core.errors import CellError
from metalens.rcwa import near, near_waves, pattern
from metalens.rcwa.near import FieldGrid
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import FLIP_X, FLIP_Y, HALF_TURN, IDENTITY
from metalens.rcwa.orders.waves import half_space
from metalens.rcwa.problem import cell_problem, waves_of

WAVE, SIZE = 0.81, 0.21
K0 = 2 * math.pi / WAVE
FILMS = {
    "under": (Film(Index(1.9), 0.07), Film(Index(1.6), 0.05)),
    "over": (Film(Index(1.3, 0.2), 0.11),),
}
ABOUT = {
    "height_um": 0.45,
    "pillar": Index(2.3),
    "substrate": Index(1.46),
    "cover": Index(1.1),
    "between": Index(1.05),
}
CELL = Cell(0.36, lattice=Lattice("rectangular", 1.3), shape=Rectangle(0.6), layers=(Layer(0.15, 0.02), Layer(0.3)),
            sidewall_rad=0.03, **FILMS, **ABOUT)  # fmt: skip
THIS = cell_problem(CELL, SIZE, WAVE, 0.3, 0.7)


def test_slabs_are_films_sections_in_equal_steps_and_films():
    """Layers of 0.15 and 0.3 um in three steps each; their walls lean by 2 tan(0.03) of
    height about the middle.
    """
    slabs = near_waves.slabs_of(THIS, 3)
    heights = [0.07, 0.05, *[0.05] * 3, *[0.1] * 3, 0.11]
    assert [slab.height for slab in slabs] == pytest.approx([K0 * h for h in heights])
    assert [slab.index for slab in slabs] == [1.9, 1.6, 0, 0, 0, 0, 0, 0, 1.3 + 0.2j]
    assert [slab.section is None for slab in slabs] == [True, True, *[False] * 6, True]
    lean = -2 * math.tan(0.03)
    middles = [0.025, 0.075, 0.125, 0.2, 0.3, 0.4]
    for slab, middle, own in zip(
        slabs[2:8], middles, (0.02, 0.02, 0.02, 0.0, 0.0, 0.0), strict=True
    ):
        wide = own + lean * (middle - 0.225)
        assert slab.section.outlines[0].area_um2 == pytest.approx(
            CELL.outline(SIZE, grow_um=wide).area_um2, rel=1e-9
        )
    assert near_waves.interface_heights(THIS, slabs) == pytest.approx(
        K0 * (np.cumsum([0, *heights]) - 0.12)
    )


def test_heights_belong_to_the_slab_above_an_interface():
    """The foot lies at 0; a point that rounding puts below an interface lies on it."""
    slabs = near_waves.slabs_of(THIS, 1)  # films, two sections, a film
    z = np.array(
        [
            -0.5,
            -0.1200001,
            -0.12,
            -0.06,
            -0.05,
            -1e-6,
            0.0,
            0.149,
            0.15,
            0.15 * (1 - 1e-13),
            0.45,
            0.56,
            0.9,
        ]
    )
    assert near_waves.slab_indices(THIS, slabs, z).tolist() == [
        0,
        0,
        1,
        1,
        2,
        2,
        3,
        3,
        4,
        4,
        5,
        6,
        6,
    ]


@pytest.mark.parametrize(
    ("polarization", "angle", "azimuth", "want"),
    [
        ("x", 0.0, 0.0, (1.0, 0.0)),
        ("y", 0.0, 0.0, (0.0, 1.0)),
        ("p", 0.0, 0.4, (math.cos(0.4), math.sin(0.4))),
        ("s", 0.0, 0.4, (-math.sin(0.4), math.cos(0.4))),
        ("s", 0.3, 0.4, (1.0, 0.0)),
        ("p", 0.3, 0.4, (0.0, 1.0)),
        (
            "x",
            0.3,
            0.0,
            (0.0, 1.0),
        ),  # in the plane of x and z: p, whose unit vector is +x
        ("x", 0.3, math.pi, (0.0, -1.0)),  # -x
        ("y", 0.3, 0.0, (1.0, 0.0)),  # s = z x k is +y
        ("y", 0.3, math.pi, (-1.0, 0.0)),
        ("x", 0.3, math.pi / 2, (-1.0, 0.0)),  # s is -x
        ("y", 0.3, math.pi / 2, (0.0, 1.0)),
    ],
)
def test_the_wave_that_comes_has_its_field_along_the_axis_that_is_named(
    polarization, angle, azimuth, want
):
    assert near_waves.incident_amplitudes(
        Incidence(WAVE, angle, polarization, azimuth)
    ) == pytest.approx(want, abs=1e-15)


def test_a_film_has_the_operators_of_plane_waves():
    """Q P of a wave is eps - kappa², its kz²; P of p waves and Q of s waves alone know
    kappa.
    """
    space = mirrors.reduced_orders(2, pattern.lattice_frame(CELL, (IDENTITY,)))
    ways, _ = waves_of(space, CELL, THIS.light)
    for index in (1.9, 1.3 + 0.2j):
        P, Q = near_waves.film_operators(ways, index)
        assert np.diag(P @ Q) == pytest.approx(index**2 - ways.kappa**2)
        p = ways.p_count
        assert np.diag(Q)[:p] == pytest.approx(np.full(p, index**2))
        assert np.diag(P)[p:] == pytest.approx(np.ones(len(ways.kappa) - p))
        assert np.iscomplexobj(Q) is (index == 1.3 + 0.2j)


@pytest.mark.parametrize(
    "operations",
    [
        (IDENTITY,),
        (IDENTITY, HALF_TURN),
        (IDENTITY, FLIP_X["x"]),
        (IDENTITY, FLIP_X["y"], FLIP_Y["y"], HALF_TURN),
    ],
)
def test_sums_over_orders_unfold_the_symmetries(operations):
    """Every order of an orbit has the amplitude over the root of their number, with the
    sign of its operation.
    """
    straight = len(operations) > 1
    this = cell_problem(CELL, SIZE, WAVE, 0.0, 0.0) if straight else THIS
    space = mirrors.reduced_orders(3, pattern.lattice_frame(CELL, operations))
    x, y = np.array([0.03, -0.11, 0.2]), np.array([0.17, -0.05])
    points = near_waves.PointSums(this, operations, space.reach, (x, y))
    px, py = CELL.lattice.periods_um(0.36)
    rng = np.random.default_rng(2)
    for part in (space.ex, space.ey, space.hz):
        amplitude = rng.normal(size=(2, len(part.m))) + 1j * rng.normal(
            size=(2, len(part.m))
        )
        want = np.zeros((2, 2, 3), complex)
        for i, (m, n, size) in enumerate(
            zip(part.m.tolist(), part.n.tolist(), part.size.tolist(), strict=True)
        ):
            orbit = {
                (g[0] * m, g[1] * n): sign
                for g, sign in zip(operations, part.signs, strict=True)
            }
            assert len(orbit) == size
            for (a, b), sign in orbit.items():
                phase = (K0 * this.light.kx + 2 * np.pi / px * a) * x + (
                    (K0 * this.light.ky + 2 * np.pi / py * b) * y
                )[:, None]
                want += (sign / math.sqrt(size) * amplitude[:, i])[
                    :, None, None
                ] * np.exp(1j * phase)
        assert points(part, amplitude) == pytest.approx(want, abs=1e-12)


def test_a_class_that_the_light_has_no_part_in_is_left_out():
    this = cell_problem(CELL, SIZE, WAVE, 0.0, 0.0)
    slabs = near_waves.slabs_of(this, 1)
    for operations, held in zip(this.classes, ("x", "y"), strict=True):
        space = mirrors.reduced_orders(1, pattern.lattice_frame(CELL, operations))
        for polarization in "xy":
            one = near_waves.solve_class(
                this, slabs, Incidence(WAVE, 0.0, polarization), space
            )
            assert (one is not None) is (polarization == held)


def test_fields_below_and_above_are_plane_waves_and_continuous_at_every_interface():
    """Tangential u and w from both sides of all interfaces; the incident wave has
    amplitude 1 at the lowest one.
    """
    upright = dataclasses.replace(
        CELL, sidewall_rad=0.0, shape=Polygon(((-0.5, -0.3), (0.5, -0.35), (0.1, 0.6)))
    )
    this = cell_problem(upright, SIZE, WAVE, 0.3, 0.7)
    slabs = near_waves.slabs_of(this, 1)
    space = mirrors.reduced_orders(1, pattern.lattice_frame(upright, (IDENTITY,)))
    one = near_waves.solve_class(this, slabs, Incidence(WAVE, 0.3, "s", 0.7), space)
    ends = near_waves.interface_heights(this, slabs) / K0
    gap = 1e-9
    below = near_waves._heights(this, slabs, one, ends - gap)
    above = near_waves._heights(this, slabs, one, ends + gap)
    for low, high in zip(below, above, strict=True):
        assert low == pytest.approx(
            high, abs=1e-6
        )  # of fields that turn by 2 pi n gap / wave
    place = int(np.flatnonzero(one.incident)[0])
    assert np.flatnonzero(one.incident).tolist() == [place]
    assert one.incident[place] == 1.0
    U, V = half_space(one.ways, 1.46)
    z = np.array([-0.4, -0.25])
    u, w = near_waves._heights(this, slabs, one, z)
    kz = math.sqrt(1.46**2 - math.sin(0.3) ** 2)
    comes = (u / U + w / V)[:, place] / 2  # what goes up
    assert comes == pytest.approx(np.exp(1j * K0 * kz * (z - ends[0])), abs=1e-12)
    back = (u / U - w / V) / 2
    below = np.sqrt(1.46**2 - one.ways.kappa**2 + 0j)
    assert back[0] == pytest.approx(
        back[1] * np.exp(1j * K0 * below * 0.15), abs=1e-12
    )  # later by 0.15 um
    assert np.abs(back[1]).max() > 1e-2
    U, V = half_space(one.ways, 1.1)
    u, w = near_waves._heights(this, slabs, one, np.array([0.6, 0.9]))
    assert u / U == pytest.approx(w / V, abs=1e-12)  # nothing comes down
    top = np.sqrt(1.1**2 - one.ways.kappa**2 + 0j)
    assert (u / U)[1] == pytest.approx(
        (u / U)[0] * np.exp(1j * K0 * top * 0.3), abs=1e-12
    )


def test_the_displacement_across_interfaces_is_continuous():
    """eps Ez of all orders from both sides: between films, from a film into a section,
    and at the half-spaces.
    """
    upright = dataclasses.replace(
        CELL, sidewall_rad=0.0, shape=Polygon(((-0.5, -0.3), (0.5, -0.35), (0.1, 0.6)))
    )
    this = cell_problem(upright, SIZE, WAVE, 0.3, 0.7)
    slabs = near_waves.slabs_of(this, 1)
    space = mirrors.reduced_orders(1, pattern.lattice_frame(upright, (IDENTITY,)))
    one = near_waves.solve_class(this, slabs, Incidence(WAVE, 0.3, "p", 0.7), space)
    ends, gap = near_waves.interface_heights(this, slabs) / K0, 1e-9
    sections = [
        mirrors.toeplitz_product(
            space,
            pattern.permittivity_coefficients(s.section, upright, space.reach)[0],
            2,
        )
        for s in slabs[2:4]
    ]
    unit = np.eye(len(space.ez.m))
    eps = [
        1.46**2 * unit,
        1.9**2 * unit,
        1.6**2 * unit,
        *sections,
        (1.3 + 0.2j) ** 2 * unit,
        1.1**2 * unit,
    ]
    below = near_waves.orders_at(this, slabs, one, ends - gap)
    above = near_waves.orders_at(this, slabs, one, ends + gap)
    for k in range(6):
        assert eps[k] @ below.ez[k] == pytest.approx(eps[k + 1] @ above.ez[k], abs=1e-6)
        assert np.abs(below.ez[k]).max() > 1e-2
        assert below.hz[k] == pytest.approx(above.hz[k], abs=1e-6)
        if k in (1, 2, 5):  # within a film D is eps times E
            assert above.dx[k - 1] == pytest.approx(
                eps[k][0, 0] * above.ex[k - 1], abs=1e-9
            )
            assert above.dy[k - 1] == pytest.approx(
                eps[k][0, 0] * above.ey[k - 1], abs=1e-9
            )


def test_the_jump_takes_the_normal_part_of_the_field_from_d():
    rng = np.random.default_rng(3)
    angle, weight, eps = 0.7, 0.6, 2.3 - 0.4j
    n = np.array([math.cos(angle), math.sin(angle)])
    normal = tuple(
        np.full((1, 1), v)
        for v in (weight * n[0] ** 2, weight * n[1] ** 2, weight * n[0] * n[1])
    )
    e, d = (
        rng.normal(size=(2, 1, 1)) + 1j * rng.normal(size=(2, 1, 1)) for _ in range(2)
    )
    got = near._jump(near._Look(np.full((1, 1), eps), normal), e, d)[:, 0, 0]
    assert got == pytest.approx(
        weight * n * (n @ (d[:, 0, 0] / eps - e[:, 0, 0])), rel=1e-12
    )
    assert not near._jump(near._Look(np.full((1, 1), eps), None), e, d).any()


def test_distances_between_truncations_are_relative_to_the_second_grid_by_grid():
    one = [(np.array([3.0, 4.0j]), None), (np.array([2.0]), None)]
    other = [(np.array([3.0, 1.0j]), None), (np.array([-0.5]), None)]
    assert near._apart(one, other) == pytest.approx([3 / math.sqrt(10), 5.0])
    assert near._apart(other, one) == pytest.approx([0.6, 1.25])


def test_points_see_the_media_that_they_lie_in():
    """Of a grid of two rows and three columns: substrate, films, sections and cover,
    from below.
    """
    slabs = near_waves.slabs_of(THIS, 1)
    grid = FieldGrid(
        np.array([0.0, 0.08, 0.15]),
        np.array([0.03, -0.1]),
        np.array([-0.5, -0.07, 0.05, 0.3, 0.5, 0.7]),
    )
    assert grid.shape == (6, 2, 3)
    looks = near._looks(THIS, slabs, grid)
    assert [look.normal is None for look in looks] == [
        True,
        True,
        True,
        False,
        False,
        True,
        True,
    ]
    index = near._index(THIS, slabs, looks, grid)
    for z, want in ((0, 1.46), (1, 1.9), (4, 1.3 + 0.2j), (5, 1.1)):
        assert index[z] == pytest.approx(np.full((2, 3), want))
    # the foot, about 0.244 x 0.16 um: of its six points two columns of the first row
    # are within
    assert index[2] == pytest.approx(np.array([[2.3, 2.3, 1.05], [1.05, 1.05, 1.05]]))
    n, weight = pattern.normals_at(
        slabs[2].section.outlines, CELL, *np.meshgrid([0.0, 0.08, 0.15], [0.03, -0.1])
    )
    for got, part in zip(
        looks[3].normal,
        (n[..., 0] ** 2, n[..., 1] ** 2, n[..., 0] * n[..., 1]),
        strict=True,
    ):
        assert got == pytest.approx(weight * part)


def test_normals_that_lie_between_the_axes_have_all_three_products():
    this = cell_problem(
        dataclasses.replace(CELL, shape=Ellipse(0.7, 0.2), sidewall_rad=0.0),
        SIZE,
        WAVE,
        0.0,
        0.0,
    )
    slabs = near_waves.slabs_of(this, 1)
    x, y = np.array([0.07, -0.1, 0.02]), np.array([0.06, -0.03])
    looks = near._looks(this, slabs, FieldGrid(x, y, [0.1]))
    n, weight = pattern.normals_at(
        slabs[2].section.outlines, this.cell, *np.meshgrid(x, y)
    )
    assert (np.abs(n).min((0, 1)) > 0.03).all()
    for got, part in zip(
        looks[3].normal,
        (n[..., 0] ** 2, n[..., 1] ** 2, n[..., 0] * n[..., 1]),
        strict=True,
    ):
        assert got == pytest.approx(weight * part)


@pytest.mark.parametrize("axis", ["x_um", "y_um", "z_um"])
def test_axes_of_points_are_lists_of_finite_lengths(axis):
    good = {"x_um": [0.0], "y_um": [0.1], "z_um": [0.2]}
    for wrong in ([], [[0.0]], [math.nan], [0.0, math.inf]):
        with pytest.raises(CellError, match=f"{axis} has shape"):
            FieldGrid(**(good | {axis: wrong}))


def test_the_error_of_a_field_is_the_farthest_truncation_before_times_its_factor():
    """Each truncation by itself; at least of them nothing is known but that it is below
    the field, doubled.
    """
    cell = Cell(0.36, shape=Rectangle(0.6), **ABOUT)
    light, grid = Incidence(WAVE, 0.0, "x"), FieldGrid([0.02, 0.09], [0.05], [0.1, 0.5])
    fields = {
        n: near.near_fields(cell, SIZE, light, [grid], harmonics=n)[0]
        for n in (1, 2, 3)
    }
    this = cell_problem(cell, SIZE, WAVE, 0.0, 0.0)
    crowded = near.truncation_sequence(this, 3).crowded
    last = fields[3].e
    farthest = max(np.linalg.norm(fields[n].e - last) for n in (1, 2)) / np.linalg.norm(
        last
    )
    assert fields[3].error == pytest.approx(
        min(crowded * near.safety_factor(3) * farthest, 2.0), rel=1e-9
    )
    assert fields[1].error == pytest.approx(min(crowded * near.safety_factor(1), 2.0))
    assert [fields[n].orders for n in (1, 2, 3)] == [5, 13, 29]
    assert [fields[n].converged for n in (1, 2, 3)] == [
        fields[n].error <= 0.05 for n in (1, 2, 3)
    ]


@pytest.mark.parametrize(("harmonics", "factor"), [(6, None), (7, 2.5)])
def test_from_seven_orders_on_the_error_is_two_and_a_half_times_the_farthest_of_four(
    harmonics, factor
):
    cell = Cell(0.36, shape=Rectangle(0.6), **ABOUT)
    light, grid = Incidence(WAVE, 0.0, "x"), FieldGrid([0.02, 0.09], [0.05], [0.1, 0.5])
    this = cell_problem(cell, SIZE, WAVE, 0.0, 0.0)
    stack = near._stack(this, 1, [grid])
    every = [
        near._fields(this, stack, light, [grid], n)[0][0]
        for n in range(harmonics - 4, harmonics + 1)
    ]
    farthest = max(
        np.linalg.norm(one - every[-1]) for one in every[:-1]
    ) / np.linalg.norm(every[-1])
    found = near.near_fields(
        cell, SIZE, light, [grid], harmonics=harmonics, tolerance=1e-6
    )[0]
    crowded = near.truncation_sequence(this, harmonics).crowded
    assert found.error == pytest.approx(
        crowded * (factor or near.safety_factor(6)) * farthest, rel=1e-9
    )
    assert found.e == pytest.approx(every[-1], abs=1e-12)
    assert near.safety_factor(6) > 2.6


def test_a_field_on_one_grid_is_that_of_its_axes():
    cell, axes = (
        Cell(0.36, shape=Rectangle(0.6), **ABOUT),
        ([0.02, 0.09, -0.1], [0.05], [0.1, 0.5]),
    )
    light = Incidence(WAVE, 0.3, "p", 0.7)
    one = near.near_field(
        cell,
        SIZE,
        light,
        x_um=axes[0],
        y_um=axes[1],
        z_um=axes[2],
        harmonics=1,
        tolerance=0.3,
    )
    (same,) = near.near_fields(
        cell, SIZE, light, [FieldGrid(*axes)], harmonics=1, tolerance=0.3
    )
    assert one.e.shape == (3, 2, 1, 3)
    assert np.array_equal(one.e, same.e)
    assert np.array_equal(one.h, same.h)
    assert one.error == same.error


def test_the_error_of_a_leaning_wall_has_what_half_as_many_steps_change(monkeypatch):
    """Of two steps, whose normals are quickly found."""
    monkeypatch.setattr(near, "_STEPS", 2)
    cell = Cell(0.36, shape=Rectangle(0.6), sidewall_rad=0.04, **ABOUT)
    light, grid = Incidence(WAVE, 0.0, "x"), FieldGrid([0.02], [0.05], [0.1, 0.5])
    this = cell_problem(cell, SIZE, WAVE, 0.0, 0.0)
    fields = {
        (steps, n): near._fields(
            this, near._stack(this, steps, [grid]), light, [grid], n
        )[0][0]
        for steps, n in ((1, 2), (2, 2), (2, 1))
    }
    found = near.near_fields(cell, SIZE, light, [grid], harmonics=2, tolerance=1e-6)[0]
    assert found.e == pytest.approx(fields[2, 2], abs=1e-12)
    size = np.linalg.norm(fields[2, 2])
    cut = np.linalg.norm(fields[1, 2] - fields[2, 2]) / size
    moved = np.linalg.norm(fields[2, 1] - fields[2, 2]) / size
    want = (
        near.truncation_sequence(this, 2).crowded * near.safety_factor(2) * moved + cut
    )
    assert cut > 1e-5
    stacks = [near._stack(this, steps, [grid]) for steps in (1, 2)]
    half, full = (
        near._fields(this, stack, light, [grid], 3)[0][0] for stack in stacks
    )  # the least of five, and two more
    told = near._staircase(
        this, stacks[1], 2, light, [grid], near.TruncationSequence(range(1, 6), 4, 1.0)
    )
    assert told == pytest.approx(
        [np.linalg.norm(half - full) / np.linalg.norm(full)], rel=1e-9
    )
    assert found.error == pytest.approx(min(want, 2.0), rel=1e-9)
    assert want < 2
