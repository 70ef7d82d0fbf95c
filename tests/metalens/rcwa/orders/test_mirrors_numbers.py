"""Orders reduced by mirrors: circles counted by hand, and products with functions
beside those of all orders.
"""

import itertools

import numpy as np
import pytest

from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import (
    FLIP_X,
    FLIP_Y,
    HALF_TURN,
    IDENTITY,
    LatticeFrame,
)

RNG = np.random.default_rng(7)


def mirrored(sx, sy, way):
    """Signs of Ex, Ey, Ez, Hz: a polar vector E and an axial one H, of which the field
    along ``way`` is even.
    """
    e = np.array([sx, sy, 1])
    h = sx * sy * e  # H turns with the mirror's determinant besides
    signs = np.array([*e, h[2]])
    return tuple((signs * e["xy".index(way)]).tolist())


def test_signs_are_those_of_electric_and_magnetic_fields_in_a_mirror():
    for way in "xy":
        assert FLIP_X[way] == (-1, 1, mirrored(-1, 1, way))
        assert FLIP_Y[way] == (1, -1, mirrored(1, -1, way))
        assert mirrored(-1, -1, way) == HALF_TURN[2]
    assert HALF_TURN[:2] == (-1, -1)
    assert IDENTITY == (1, 1, (1, 1, 1, 1))


@pytest.mark.parametrize(
    ("harmonics", "along", "across", "centred", "count", "reach"),
    [
        (
            2,
            1.0,
            1.0,
            False,
            13,
            (2, 2),
        ),  # 0, ±1, ±2 along the axes and (±1, ±1); (2, 0) lies on the circle itself
        (5, 1.0, 1.0, False, 81, (5, 5)),  # (3, 4) and (4, 3) lie on it
        (
            3,
            1.3,
            1.0,
            False,
            None,
            (3, 2),
        ),  # radius 2.631: 3.42 orders along x, 2.63 along y
        (3, 1.0, 1.7, False, None, (2, 3)),
        (4, 1.0, 3**0.5, True, None, (4, 7)),
    ],
)
def test_orders_fill_a_circle_of_the_area_of_as_many_square_ones(
    harmonics, along, across, centred, count, reach
):
    space = mirrors.reduced_orders(
        harmonics, LatticeFrame(along, across, centred, (IDENTITY,))
    )
    assert space.reach == reach
    area = along * across / (2 if centred else 1)
    want = {
        (m, n)
        for m, n in itertools.product(range(-9, 10), repeat=2)
        if ((m / along) ** 2 + (n / across) ** 2) * area <= harmonics**2 + 1e-6
        and not (centred and (m + n) % 2)
    }
    for field in (space.ex, space.ey, space.ez, space.hz):
        assert set(zip(field.m.tolist(), field.n.tolist(), strict=True)) == want
        assert len(field.m) == len(want)
        assert set(field.size.tolist()) == {1}
        assert field.signs == (1,)
    assert count in (None, len(want))


CLASSES = {
    "none": (IDENTITY,),
    "half turn": (IDENTITY, HALF_TURN),
    "x, fields along x": (IDENTITY, FLIP_X["x"]),
    "x, fields along y": (IDENTITY, FLIP_X["y"]),
    "y, fields along x": (IDENTITY, FLIP_Y["x"]),
    "all, fields along x": (IDENTITY, FLIP_X["x"], FLIP_Y["x"], HALF_TURN),
    "all, fields along y": (IDENTITY, FLIP_X["y"], FLIP_Y["y"], HALF_TURN),
}


def orbits(orders, operations, field):
    """(orders, k) unit vectors of the fields that every operation carries into
    themselves, one for each orbit.
    """
    found, seen = {}, set()
    places = {order: i for i, order in enumerate(orders)}
    for m, n in orders:
        if (m, n) in seen:
            continue
        vector = np.zeros(len(orders))
        for sx, sy, signs in operations:
            vector[places[sx * m, sy * n]] += signs[field]
            seen.add((sx * m, sy * n))
        if np.abs(vector).any():
            found[m, n] = vector / np.linalg.norm(vector)
    return found


@pytest.mark.parametrize("name", CLASSES)
def test_one_amplitude_stands_for_an_orbit_and_products_are_those_of_all_orders(name):
    """Of a function that every operation leaves as it is, or turns as Ex over Ey, by
    its matrix over all orders.
    """
    operations, frame = CLASSES[name], (1.3, 1.0, False)
    space, whole = (
        mirrors.reduced_orders(3, LatticeFrame(*frame, some))
        for some in (operations, (IDENTITY,))
    )
    orders = list(zip(whole.ex.m.tolist(), whole.ex.n.tolist(), strict=True))
    r, q = space.reach
    m, n = np.arange(-2 * r, 2 * r + 1), np.arange(-2 * q, 2 * q + 1)
    table = RNG.normal(size=(len(m), len(n))) + 1j * RNG.normal(size=(len(m), len(n)))
    for pair, (rows, columns) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1))):
        alike = np.mean(
            [g[2][rows] * g[2][columns] * table[:: g[0], :: g[1]] for g in operations],
            axis=0,
        )
        full = np.array(
            [
                [alike[a - c + 2 * r, b - d + 2 * q] for c, d in orders]
                for a, b in orders
            ]
        )
        sides = [orbits(orders, operations, field) for field in (rows, columns)]
        sets = [(space.ex, space.ey, space.ez)[field] for field in (rows, columns)]
        vectors = []
        for side, field, kind in zip(sides, sets, (rows, columns), strict=True):
            assert len(side) == len(field.m)
            assert field.signs == tuple(g[2][kind] for g in operations)
            found = []
            for a, b, size in zip(
                field.m.tolist(), field.n.tolist(), field.size.tolist(), strict=True
            ):
                (own,) = [v for order, v in side.items() if v[orders.index((a, b))]]
                assert np.count_nonzero(own) == size
                found.append(
                    own * np.sign(own[orders.index((a, b))])
                )  # a representative counts as itself
            vectors.append(np.array(found).reshape(len(found), len(orders)))
        got = mirrors.toeplitz_product(space, alike, pair)
        assert got == pytest.approx(vectors[0] @ full @ vectors[1].T, abs=1e-12)


def test_a_function_that_turns_one_class_into_another_couples_them():
    """f(g r) = s(g) f(r), s = -1 for both mirrors: fields along x into those along y."""
    sides = [CLASSES["all, fields along y"], CLASSES["all, fields along x"]]
    rows, columns = (
        mirrors.reduced_orders(3, LatticeFrame(1.3, 1.0, False, some)) for some in sides
    )
    whole = mirrors.reduced_orders(3, LatticeFrame(1.3, 1.0, False, (IDENTITY,)))
    orders = list(zip(whole.ex.m.tolist(), whole.ex.n.tolist(), strict=True))
    r, q = rows.reach
    table = RNG.normal(size=(4 * r + 1, 4 * q + 1))
    odd = (table - table[::-1] - table[:, ::-1] + table[::-1, ::-1]) / 4
    full = np.array(
        [[odd[a - c + 2 * r, b - d + 2 * q] for c, d in orders] for a, b in orders]
    )
    for field, (row, column) in enumerate(
        ((rows.ex, columns.ex), (rows.ey, columns.ey), (rows.ez, columns.ez))
    ):
        vectors = []
        for kept, operations in ((row, sides[0]), (column, sides[1])):
            side = orbits(orders, operations, field)
            found = []
            for a, b in zip(kept.m.tolist(), kept.n.tolist(), strict=True):
                (own,) = [v for v in side.values() if v[orders.index((a, b))]]
                found.append(own * np.sign(own[orders.index((a, b))]))
            vectors.append(np.array(found))
        got = mirrors.product_by(
            mirrors.link_sets(row, column, sides[1], rows.reach), odd
        )
        assert got == pytest.approx(vectors[0] @ full @ vectors[1].T, abs=1e-12)
        assert np.abs(got).max() > 0.1
