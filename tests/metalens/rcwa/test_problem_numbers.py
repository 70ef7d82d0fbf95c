"""Light, media and symmetries of small cells, and waves beside the plane waves they
are, order by order.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Film, Index, Lattice
from metalens.cell.shapes import Polygon, Rectangle
from metalens.core.errors import CellError
from metalens.rcwa import pattern, problem
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import FLIP_X, FLIP_Y, HALF_TURN, IDENTITY

WAVE = 0.73
OBLONG = Lattice("rectangular", 1.3)
TRIANGLE = Polygon(((-0.5, -0.3), (0.5, -0.3), (0.0, 0.6)))  # its mirror turns x about
ABOUT = {
    "height_um": 0.53,
    "pillar": Index(2.7),
    "substrate": Index(1.45),
    "cover": Index(1.2),
}


def cell(shape, **more):
    return Cell(0.41, shape=shape, lattice=OBLONG, **ABOUT, **more)


def test_the_tangential_wave_vector_is_the_sine_in_its_azimuth():
    light = problem.tangential_wave(WAVE, 0.3, 0.7)
    assert (light.kx, light.ky) == pytest.approx(
        (math.sin(0.3) * math.cos(0.7), math.sin(0.3) * math.sin(0.7))
    )
    assert (light.azimuth_rad, light.wavelength_um, light.normal) == (0.7, WAVE, False)
    along_y = problem.tangential_wave(WAVE, 0.3, math.pi / 2)
    assert along_y.kx == 0.0
    assert along_y.ky == pytest.approx(math.sin(0.3))
    assert not along_y.normal
    assert problem.tangential_wave(WAVE, 0.3, 0.0).normal is False
    straight = problem.tangential_wave(WAVE, 0.0, 0.7)
    assert (straight.kx, straight.ky, straight.azimuth_rad, straight.normal) == (
        0.0,
        0.0,
        0.0,
        True,
    )
    for angle, zero in ((0.9e-12, True), (1.1e-12, False)):
        assert problem.tangential_wave(WAVE, angle, 0.0).normal is zero


def test_films_are_as_thick_as_the_phase_of_vacuum_in_them():
    films = {
        "under": (Film(Index(1.9, 0.02), 0.07), Film(Index(1.6), 0.25)),
        "over": (Film(Index(1.3), 0.31),),
    }
    found = problem.stack_media(
        cell(Rectangle(0.6), **films), problem.tangential_wave(WAVE, 0.3, 0.7)
    )
    k0 = 2 * math.pi / WAVE
    assert (found.substrate, found.cover) == (1.45, 1.2)
    assert [index for index, _ in found.under] == [1.9 + 0.02j, 1.6]
    assert [thick for _, thick in found.under] == pytest.approx([0.07 * k0, 0.25 * k0])
    assert found.over == ((1.3, pytest.approx(0.31 * k0)),)


def test_light_comes_from_a_substrate_that_is_denser_than_its_sine():
    """sin 1.2 = 0.932."""
    thin = Cell(0.41, shape=Rectangle(0.6), **(ABOUT | {"substrate": Index(0.94)}))
    light = problem.tangential_wave(WAVE, 1.2, 0.7)
    assert problem.stack_media(thin, light).substrate == 0.94
    thinner = Cell(0.41, shape=Rectangle(0.6), **(ABOUT | {"substrate": Index(0.93)}))
    with pytest.raises(
        CellError, match=r"sin\(angle_rad\) = 0\.932039 in a substrate of n = 0\.93:"
    ):
        problem.stack_media(thinner, light)


BOTH = tuple((IDENTITY, FLIP_X[way], FLIP_Y[way], HALF_TURN) for way in "xy")
OF_X, OF_Y = (
    tuple((IDENTITY, table[way]) for way in "xy") for table in (FLIP_X, FLIP_Y)
)
HALF, NONE = ((IDENTITY, HALF_TURN),), ((IDENTITY,),)


@pytest.mark.parametrize(
    ("shape", "light", "want"),
    [
        (Rectangle(0.6), (0.0, 0.0), BOTH),
        (
            Rectangle(0.6),
            (0.2, 0.0),
            OF_Y,
        ),  # light in the plane of x and z is kept by the mirror of y
        (Rectangle(0.6), (0.2, math.pi / 2), OF_X),
        (Rectangle(0.6), (0.2, 0.5), NONE),
        (Rectangle(0.6, 0.2), (0.0, 0.0), HALF),
        (Rectangle(0.6, 0.2), (0.2, 0.0), NONE),
        (TRIANGLE, (0.0, 0.0), OF_X),
        (TRIANGLE, (0.2, 0.0), NONE),
        (TRIANGLE, (0.2, math.pi / 2), OF_X),
        (Polygon(((-0.5, -0.3), (0.5, -0.35), (0.1, 0.6))), (0.0, 0.0), NONE),
    ],
)
def test_fields_have_the_symmetries_that_shape_and_light_share(shape, light, want):
    found = problem.cell_problem(cell(shape), 0.25, WAVE, *light)
    assert found.classes == want
    assert (found.size_um, found.light) == (0.25, problem.tangential_wave(WAVE, *light))


def whole(this, operations, reach=2):
    space = mirrors.reduced_orders(reach, pattern.lattice_frame(this, operations))
    return space, *problem.waves_of(
        space, this, problem.tangential_wave(WAVE, 0.3, 0.7)
    )


def test_p_waves_lie_along_the_wave_vector_of_their_order_and_s_waves_across():
    this = cell(TRIANGLE)
    x, y = OBLONG.periods_um(0.41)
    space, ways, places = whole(this, (IDENTITY,))
    orders = list(zip(space.ex.m.tolist(), space.ex.n.tolist(), strict=True))
    count = len(orders)
    assert (ways.p_count, ways.bare, len(ways.m)) == (count, 0, 2 * count)
    kx, ky = math.sin(0.3) * math.cos(0.7), math.sin(0.3) * math.sin(0.7)
    for i, (m, n) in enumerate(orders):
        k = np.array([kx + WAVE / x * m, ky + WAVE / y * n])
        size = np.linalg.norm(k)
        for place, e in ((i, k / size), (count + i, np.array([-k[1], k[0]]) / size)):
            want = np.zeros(2 * count)
            want[[i, count + i]] = e
            assert ways.fold[:, place] == pytest.approx(want, abs=1e-14)
            assert ways.kappa[place] == pytest.approx(size, rel=1e-12)
            assert (ways.m[place], ways.n[place]) == (m, n)
    zero = orders.index((0, 0))
    assert places == {
        1: (zero, 1.0),
        0: (count + zero, 1.0),
    }  # s is the first polarisation, p the second


@pytest.mark.parametrize("operations", [*BOTH, *OF_X, *OF_Y, *HALF, *NONE])
def test_waves_are_an_orthogonal_basis_and_straight_light_has_its_place_in_it(
    operations,
):
    """Light along x is one wave of the zero order, times its sign, with Ex there and
    nothing elsewhere.
    """
    this = cell(Rectangle(0.6))
    space = mirrors.reduced_orders(3, pattern.lattice_frame(this, operations))
    ways, places = problem.waves_of(
        space, this, problem.tangential_wave(WAVE, 0.0, 0.0)
    )
    count = len(space.ex.m)
    assert ways.fold.shape == (count + len(space.ey.m),) * 2
    assert ways.fold.T @ ways.fold == pytest.approx(np.eye(len(ways.m)), abs=1e-12)
    held = [
        axis
        for axis, rows in enumerate((space.ex, space.ey))
        if ((rows.m == 0) & (rows.n == 0)).any()
    ]
    assert sorted(places) == held
    for axis, (place, sign) in places.items():
        rows = (space.ex, space.ey)[axis]
        want = np.zeros(count + len(space.ey.m))
        want[axis * count + int(np.flatnonzero((rows.m == 0) & (rows.n == 0))[0])] = 1.0
        assert sign * ways.fold[:, place] == pytest.approx(want, abs=1e-14)
        assert ways.kappa[place] == 0
    assert (
        ways.p_count - len(space.ez.m)
        == ways.bare
        == int(((ways.m == 0) & (ways.n == 0))[: ways.bare].sum())
    )
    assert len(ways.m) - ways.p_count - len(space.hz.m) in (0, 1)


@pytest.mark.parametrize(
    ("angle", "azimuth", "operations"), [(0.3, 0.0, OF_Y), (0.3, math.pi / 2, OF_X)]
)
def test_light_in_a_mirror_is_p_in_one_class_and_s_in_the_other(
    angle, azimuth, operations
):
    this, found = cell(Rectangle(0.6)), {}
    for some in operations:
        space = mirrors.reduced_orders(3, pattern.lattice_frame(this, some))
        ways, places = problem.waves_of(
            space, this, problem.tangential_wave(WAVE, angle, azimuth)
        )
        ((kind, (place, sign)),) = places.items()
        found[kind] = place < ways.p_count
        assert sign == 1.0
        assert ways.kappa[place] == pytest.approx(math.sin(angle))
        assert (ways.m[place], ways.n[place], ways.bare) == (0, 0, 0)
        assert ways.fold.T @ ways.fold == pytest.approx(np.eye(len(ways.m)), abs=1e-12)
    assert found == {0: False, 1: True}
