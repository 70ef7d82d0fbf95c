"""Sections in closed form: Fourier coefficients of rectangles, normals of discs, and
operators order by order.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.record import Layer
from metalens.cell.shapes import Ellipse, Polygon, Rectangle
from metalens.rcwa import pattern, problem
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import FLIP_X, FLIP_Y, HALF_TURN, IDENTITY

PITCH, WAVE = 0.41, 0.73
ABOUT = {
    "height_um": 0.53,
    "pillar": Index(2.7),
    "substrate": Index(1.45),
    "cover": Index(1.2),
}
OBLONG = Cell(PITCH, lattice=Lattice("rectangular", 1.3), shape=Rectangle(0.6), **ABOUT)
X, Y = OBLONG.lattice.periods_um(PITCH)
INNER, FILM, OUTER = (2.7 + 0.1j) ** 2, 1.9**2, 1.1**2


def box(wide, high, m, n):
    """Fourier coefficients of what is 1 on a rectangle about the middle."""
    return (
        wide * high / (X * Y) * np.sinc(m[:, None] * wide / X) * np.sinc(n * high / Y)
    )


def test_coefficients_of_a_coated_rectangle_are_sincs():
    """Steps of permittivity and of its inverse, from the inside out, up to twice the
    reach along each axis.
    """
    outlines = (
        OBLONG.outline(0.2),
        OBLONG.outline(0.2, grow_um=0.03),
    )  # 0.2 x 0.12 and 0.23 x 0.15
    m, n = np.arange(-4, 5), np.arange(-6, 7)
    none = (m[:, None] == 0) & (n == 0)
    direct, inverse = pattern.permittivity_coefficients(
        pattern.PillarSection(outlines, (INNER, FILM), OUTER), OBLONG, (2, 3)
    )
    for got, power in ((direct, 1), (inverse, -1)):
        a, b, c = INNER**power, FILM**power, OUTER**power
        want = (
            c * none + (a - b) * box(0.2, 0.12, m, n) + (b - c) * box(0.23, 0.15, m, n)
        )
        assert got.shape == (9, 13)
        assert got == pytest.approx(want, abs=1e-12)


def test_coefficients_of_a_hexagonal_cell_are_over_the_area_of_one_pillar():
    """Its rectangle holds two: only orders of even sums count, to which both add alike."""
    this = Cell(PITCH, lattice=Lattice("hexagonal"), shape=Rectangle(0.6), **ABOUT)
    slab = pattern.PillarSection((this.outline(0.2),), (INNER,), OUTER)
    direct, _ = pattern.permittivity_coefficients(slab, this, (2, 3))
    area = PITCH**2 * math.sqrt(3) / 2
    assert direct[4, 6] == pytest.approx(
        OUTER + (INNER - OUTER) * 0.2 * 0.12 / area, rel=1e-12
    )
    x, y = PITCH, math.sqrt(3) * PITCH
    want = (
        (INNER - OUTER)
        * 0.2
        * 0.12
        / area
        * np.sinc(1 * 0.2 / x)
        * np.sinc(-3 * 0.12 / y)
    )
    assert direct[5, 3] == pytest.approx(want, rel=1e-12)
    for one, along, across, centred in (
        (this, 1.0, math.sqrt(3), True),
        (OBLONG, 1.0, 1.3, False),
    ):
        found = pattern.lattice_frame(one, (IDENTITY,))
        assert (found.along, found.across) == pytest.approx((along, across), rel=1e-12)
        assert (found.centred, found.operations) == (centred, (IDENTITY,))


def test_numbers_are_real_where_only_rounding_is_imaginary():
    for size, kept in ((0.9e-12, False), (1.1e-12, True)):
        assert (
            np.iscomplexobj(
                pattern.without_rounding(np.array([3.0, -1.0 + 3.0j * size]))
            )
            is kept
        )


def test_the_weight_of_normals_is_one_at_the_wall_and_a_half_half_way_to_the_farthest_point():
    """A disc of 0.23 um on a square of 0.41: the corners lie 0.175 um off, where it is
    1 / 17; radial normals.
    """
    this = Cell(PITCH, **ABOUT)
    outlines = (this.outline(0.23),)
    far = (PITCH / math.sqrt(2) - 0.115) / 2
    turn = 0.4
    radii = np.array([0.115, 0.115 - far / 2, 0.115 + far / 3])
    x, y = radii * math.cos(turn), radii * math.sin(turn)
    n, weight = pattern.normals_at(outlines, this, x, y)
    # the wall is drawn in steps of pitch / 200: 1e-3 um, of which a point lies half a
    # step off at most
    assert n == pytest.approx(
        np.tile([math.cos(turn), math.sin(turn)], (3, 1)), abs=0.01
    )
    assert weight == pytest.approx(
        1 / (1 + np.array([0.0, 1 / 2, 1 / 3]) ** 4), abs=2e-3
    )
    corner = np.array([PITCH / 2])
    assert pattern.normals_at(outlines, this, corner, corner)[1] == pytest.approx(
        [1 / 17], rel=2e-3
    )
    moved = pattern.normals_at(outlines, this, x + 3 * PITCH, y - 2 * PITCH)
    assert moved[0] == pytest.approx(n, abs=1e-9)
    assert moved[1] == pytest.approx(weight, abs=1e-9)
    # beside the neighbour its own wall is the nearest
    n, _ = pattern.normals_at(
        outlines, this, np.array([PITCH / 2 + 0.02]), np.array([0.01])
    )
    assert n[0] @ [1, 0] == pytest.approx(-1, abs=0.01)


@pytest.mark.parametrize("reach", [(2, 3), (17, 2)])
def test_tables_of_normals_are_means_of_the_field_over_the_cell(reach):
    """An ellipse that no mirror keeps, summed as it is at 150 x 190 places: the field
    is smooth but where two walls are
    equally near, which a grid takes to a step of it; of coefficients up to 0.4."""
    this = Cell(
        PITCH, lattice=Lattice("rectangular", 1.3), shape=Ellipse(0.7, 0.2), **ABOUT
    )
    outlines = (this.outline(0.24),)
    found = pattern.normal_tables(outlines, this, reach)
    x, y = (
        (np.arange(count) / count - 0.5) * edge for count, edge in ((150, X), (190, Y))
    )
    px, py = np.meshgrid(x, y, indexing="ij")
    n, weight = pattern.normals_at(outlines, this, px, py)
    m, k = (
        np.arange(-2 * reach[0], 2 * reach[0] + 1),
        np.arange(-2 * reach[1], 2 * reach[1] + 1),
    )
    turns = (
        np.exp(-2j * np.pi * np.outer(m, x) / X),
        np.exp(-2j * np.pi * np.outer(k, y) / Y),
    )
    for table, values in zip(
        found, (n[..., 0] ** 2, n[..., 1] ** 2, n[..., 0] * n[..., 1]), strict=True
    ):
        assert table.shape == (len(m), len(k))
        assert (
            np.abs(table - turns[0] @ (weight * values) @ turns[1].T / px.size).max()
            < 4e-3
        )


def test_permittivity_is_that_of_the_innermost_outline_about_any_pillar():
    """Points on the lattice of rectangles, 0.41 by 0.533 um apart, and on a hexagonal
    one.
    """
    slab = pattern.PillarSection(
        (OBLONG.outline(0.2), OBLONG.outline(0.2, grow_um=0.03)), (INNER, FILM), OUTER
    )
    places = {
        (0.09, 0.05): INNER,
        (0.11, 0.05): FILM,
        (0.09, 0.07): FILM,
        (0.12, 0.0): OUTER,
        (0.0, 0.08): OUTER,
    }
    for (x, y), eps in places.items():
        for a, b in ((0, 0), (1, 0), (-2, 3)):
            got = pattern.permittivity_at(
                slab, OBLONG, np.array([x + a * X]), np.array([y + b * Y])
            )
            assert got == pytest.approx([eps])
    this = Cell(PITCH, lattice=Lattice("hexagonal"), shape=Rectangle(0.6), **ABOUT)
    slab = pattern.PillarSection((this.outline(0.2),), (INNER,), OUTER)
    half = [edge / 2 for edge in this.lattice.periods_um(PITCH)]
    for (x, y), eps in {
        (0.09, 0.05): INNER,
        (0.11, 0.0): OUTER,
        (0.0, 0.07): OUTER,
    }.items():
        for a, b in ((0, 0), (1, 1), (-1, 1), (1, -1), (2, 0)):
            got = pattern.permittivity_at(
                slab, this, np.array([x + a * half[0]]), np.array([y + b * half[1]])
            )
            assert got == pytest.approx([eps])


TRIANGLE = Polygon(((-0.5, -0.3), (0.5, -0.35), (0.1, 0.6)), 0.2)
LIGHT = problem.tangential_wave(WAVE, 0.3, 0.4)


def toeplitz(table, orders, reach):
    return np.array(
        [
            [table[a - c + 2 * reach[0], b - d + 2 * reach[1]] for c, d in orders]
            for a, b in orders
        ]
    )


def test_operators_are_those_of_maxwells_equations_in_all_orders():
    """E = [eps] - (D N + N D) / 2, D = [eps] - [1/eps]^-1; Q = E - r r^T and P = 1 - k
    [eps]^-1 k^T in x and y.
    """
    this = Cell(PITCH, shape=TRIANGLE, lattice=Lattice("rectangular", 1.3), **ABOUT)
    slab = pattern.PillarSection((this.outline(0.24),), (INNER,), OUTER)
    space = mirrors.reduced_orders(2, pattern.lattice_frame(this, (IDENTITY,)))
    ways, _ = problem.waves_of(space, this, LIGHT)
    P, Q = pattern.section_operators(space, ways, slab, this)
    orders = list(zip(space.ex.m.tolist(), space.ex.n.tolist(), strict=True))
    parts = (
        *pattern.permittivity_coefficients(slab, this, space.reach),
        *pattern.normal_tables(slab.outlines, this, space.reach),
    )
    eps, inverse, xx, yy, xy = (toeplitz(table, orders, space.reach) for table in parts)
    delta = np.kron(np.eye(2), eps - np.linalg.inv(inverse))
    normals = np.block([[xx, xy], [xy.conj().T, yy]])
    electric = np.kron(np.eye(2), eps) - (delta @ normals + normals @ delta) / 2
    kx = np.diag([LIGHT.kx + WAVE / X * m for m, _ in orders])
    ky = np.diag([LIGHT.ky + WAVE / Y * n for _, n in orders])
    across, along = np.vstack([-ky, kx]), np.vstack([kx, ky])
    want_p = np.eye(2 * len(orders)) - along @ np.linalg.inv(eps) @ along.T
    assert ways.fold @ Q @ ways.fold.T == pytest.approx(
        electric - across @ across.T, abs=1e-10
    )
    assert ways.fold @ P @ ways.fold.T == pytest.approx(want_p, abs=1e-10)


def test_classes_of_mirrors_share_out_the_modes_of_all_orders():
    """Squares of the propagation constants, eigenvalues of P Q: of a rectangle in
    straight light, and all of them.
    """
    slab, light = (
        pattern.PillarSection((OBLONG.outline(0.2),), (INNER,), OUTER),
        problem.tangential_wave(WAVE, 0.0, 0.0),
    )
    found = []
    for some in (
        (IDENTITY,),
        *((IDENTITY, FLIP_X[w], FLIP_Y[w], HALF_TURN) for w in "xy"),
    ):
        space = mirrors.reduced_orders(2, pattern.lattice_frame(OBLONG, some))
        P, Q = pattern.section_operators(
            space, problem.waves_of(space, OBLONG, light)[0], slab, OBLONG
        )
        found.append(np.linalg.eigvals(P @ Q))
    every, *classes = found
    for one in np.concatenate(classes):
        assert np.abs(every - one).min() < 1e-9 * abs(one)
    assert len(np.concatenate(classes)) < len(every)


def test_a_section_of_a_layer_takes_its_own_materials_or_those_of_the_cell():
    this = Cell(
        PITCH,
        shape=Ellipse(0.7),
        between=Index(1.1),
        layers=(Layer(0.2), Layer(0.33, 0.02)),
        **ABOUT,
    )
    plain = pattern.pillar_section(this, this.layers[1], 0.2, WAVE, grow_um=0.01)
    assert plain.inside == (pytest.approx(2.7**2),)
    assert plain.outside == pytest.approx(1.1**2)
    assert plain.outlines[0].area_um2 == pytest.approx(
        this.outline(0.2, grow_um=0.03).area_um2
    )
    assert pattern.pillar_section(this, this.layers[1], 0.2, WAVE).outlines[
        0
    ].area_um2 == pytest.approx(this.outline(0.2, grow_um=0.02).area_um2)
