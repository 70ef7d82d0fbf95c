"""The quarter cell's mesh: curves in closed form, Jacobians by differences of the map,
counts and walls by hand.
"""

import math

import numpy as np
import pytest

from metalens.modal import mesh
from metalens.modal.mesh import X0, X1, Y0, Y1, MeshPlan
from metalens.modal.shapes import polynomial_interval

PLAN = MeshPlan(
    2, 3, 4, inner=(0.6, 1.0), outer=(0.35, 1.0), sectors=(0.45, 1.0), core=0.55
)


def curve(name, v):
    """Points of the three curves from the x axis to the diagonal, half pitches; the
    core and the circle per radius.
    """
    phi = v * math.pi / 4
    if name == "core":
        return np.stack(
            [0.55 + (0.44 - 0.55) * v, 0.44 * v], -1
        )  # a quadrilateral: its corner at four fifths
    if name == "circle":
        return np.stack([np.cos(phi), np.sin(phi)], -1)
    return np.stack([1 + 0 * v, np.tan(phi)], -1)


@pytest.mark.parametrize(
    ("inside", "names"), [(True, ("core", "circle")), (False, ("circle", "edge"))]
)
def test_rings_run_between_their_curves(inside, names):
    v, step = np.array([0.0, 0.3, 0.77, 1.0]), 1e-6
    found = mesh.ring_curves(PLAN, inside, v)
    for at, name in enumerate(names):
        assert found[2 * at] == pytest.approx(curve(name, v))
        want = (curve(name, v + step) - curve(name, v - step)) / (2 * step)
        assert found[2 * at + 1] == pytest.approx(
            want, abs=1e-9
        )  # third derivative: 1e-12, rounding 1e-10


def jacobians(place, xi, eta):
    """(points, 2) derivatives along xi and eta of a map of the unit square, by
    differences.
    """
    a, b = np.meshgrid(xi, eta, indexing="ij")
    a, b, step = a.ravel(), b.ravel(), 1e-6
    return (
        (place(a + step, b) - place(a - step, b)) / (2 * step),
        (place(a, b + step) - place(a, b - step)) / (2 * step),
    )


RHO = 0.63


def test_jacobians_of_every_element_are_those_of_the_map():
    """Rings, then sectors; the parts that grow with the radius and those that do not
    together.
    """
    core, rings, rim, near, far = mesh.build_mesh(PLAN).patches
    cuts, line = (0.0, 0.45, 1.0), polynomial_interval(3, 7).point
    across = polynomial_interval(3, 8).point
    for at, (i, j) in enumerate((i, j) for i in (0, 1) for j in (0, 1)):

        def inner(a, b, i=i, j=j):
            u, v = (
                cuts[i] + (cuts[i + 1] - cuts[i]) * a,
                cuts[j] + (cuts[j + 1] - cuts[j]) * b,
            )
            # corners (0, 0), (a, 0), (0, a) and four fifths of (a, a)
            return np.stack([0.55 * u * (1 - 0.2 * v), 0.55 * v * (1 - 0.2 * u)], -1)

        for got, want in zip(
            (core.rho_xi[at], core.rho_eta[at]),
            jacobians(inner, line, line),
            strict=True,
        ):
            assert got == pytest.approx(want, abs=1e-9)
        assert not core.rest_xi.any()
        assert not core.rest_eta.any()
    whole = [
        (rings, 0.0, 0.6, True),
        (rim, 0.6, 1.0, True),
        (near, 0.0, 0.35, False),
        (far, 0.35, 1.0, False),
    ]
    for patch, low, high, inside in whole:
        radial = radial_points(patch)
        for j in (0, 1):

            def place(a, b, j=j, low=low, high=high, inside=inside):
                g, v = (
                    (low + (high - low) * a)[:, None],
                    cuts[j] + (cuts[j + 1] - cuts[j]) * b,
                )
                ends = ("core", "circle") if inside else ("circle", "edge")
                start, end = (
                    curve(name, v) * (1.0 if name == "edge" else RHO) for name in ends
                )
                return (1 - g) * start + g * end

            want = jacobians(place, radial, across)
            found = (
                RHO * patch.rho_xi[j] + patch.rest_xi[j],
                RHO * patch.rho_eta[j] + patch.rest_eta[j],
            )
            for got, of in zip(found, want, strict=True):
                assert got == pytest.approx(
                    of, abs=1e-9
                )  # third derivative: 1e-12, rounding 1e-10
        assert patch.inside is inside
        assert patch.vector.shape[:2] == (2, 2)


def radial_points(patch):
    """Places along xi, from the linear functions of the basis: the sum over eta of
    those that grow along xi.
    """
    high = len(polynomial_interval(3, 8).value)
    rising = patch.basis.scalar[high : high + 2].sum(0)
    return rising.reshape(-1, 8)[:, 0]


def test_functions_are_counted_once_and_know_their_walls():
    """Vertices, edges and inside by Euler: 3 x 3 of the core, rings of 2 x 2 elements
    on both sides.
    """
    made = mesh.build_mesh(PLAN)
    elements = 4 + 4 * 2 * 2
    # vertices: core 2 x 2 off its rim, and of 5 rings of ends 2 on either side and the
    # diagonal between
    rim, vertices = 5, 4 + 5 * 5
    edges = vertices + elements - 1  # one face outside
    assert rim * 5 + 4 == vertices
    # scalars: vertices; along an edge one less than its degree; inside the product of
    # both
    along = {"angular": 3, "inside": 2, "towards": 3, "away": 5, "outside": 4}
    across = {"angular": 3}
    count = vertices
    # edges around: those of the core, 12, and the arcs of 4 circles beyond it, 4 each,
    # of the third degree
    count += (12 + 16) * (along["angular"] - 1)
    spokes = [
        along["inside"],
        along["towards"],
        along["away"],
        along["outside"],
    ]  # five of each ring
    count += sum(5 * (degree - 1) for degree in spokes)
    count += 4 * (across["angular"] - 1) ** 2 + sum(
        4 * (degree - 1) * (across["angular"] - 1) for degree in spokes
    )
    assert edges == 12 + 16 + 20
    assert len(made.scalar_wall) == count
    vectors = (12 + 16) * 3 + sum(5 * degree for degree in spokes)
    vectors += 4 * 2 * 3 * 2 + sum(
        4 * (degree * 2 + (degree - 1) * 3) for degree in spokes
    )
    assert len(made.vector_wall) == vectors
    for wall, pieces in (
        (X0, (3, 3, *spokes)),
        (Y0, (3, 3, *spokes)),
        (X1, (3, 3)),
        (Y1, (3, 3)),
    ):
        assert np.count_nonzero(made.vector_wall & wall) == sum(pieces)
        assert np.count_nonzero(made.scalar_wall & wall) == sum(pieces) + 1
    for corner in (X0 | Y0, X1 | Y0, X0 | Y1, X1 | Y1):
        assert np.count_nonzero((made.scalar_wall & corner) == corner) == 1
        assert np.count_nonzero((made.vector_wall & corner) == corner) == 0


def test_rules_have_four_or_five_points_more_than_degrees_and_two_dozen_at_the_rim():
    """(3 + 4)² of the core; 3 + 5 along every ring, across it 2 + 5, 2 + 24 on both
    sides of the rim, 4 + 5.
    """
    points = [len(patch.basis.weight) for patch in mesh.build_mesh(PLAN).patches]
    assert points == [49, 7 * 8, 26 * 8, 26 * 8, 9 * 8]


def test_every_function_is_had_by_as_many_elements_as_meet_there():
    made = mesh.build_mesh(PLAN)
    for name, wall in (("vector", made.vector_wall), ("scalar", made.scalar_wall)):
        seen = np.concatenate([getattr(patch, name).ravel() for patch in made.patches])
        times = np.bincount(seen, minlength=len(wall))
        assert times.min() == 1
        assert times.max() == (2 if name == "vector" else 4)
        if name == "vector":
            assert (times[wall != 0] == 1).all()  # nothing lies beyond a wall


def test_one_ring_and_one_sector_are_the_plain_plan():
    plan = MeshPlan(2, 3, 4)
    assert (plan.exponents, plan.inner, plan.outer, plan.sectors, plan.core) == (
        (0.7,),
        (1.0,),
        (1.0,),
        (1.0,),
        0.5,
    )
    made = mesh.build_mesh(plan)
    assert [patch.inside for patch in made.patches] == [True, True, False]
    assert [len(patch.basis.along_xi) for patch in made.patches] == [
        3 * 4,
        3 * 4,
        5 * 4,
    ]  # bubbles of the rim: one more
    assert (X0, X1, Y0, Y1) == (1, 2, 4, 8)
