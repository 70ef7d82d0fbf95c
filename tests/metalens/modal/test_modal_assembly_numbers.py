"""Matrices of one element by their definition, on a patch drawn at will, and of a cell
by closed forms of its areas.
"""

import math

import numpy as np
import pytest

from metalens.ground.errors import CellError
from metalens.modal import assembly, mesh, shapes
from metalens.modal.assembly import Metric
from metalens.modal.mesh import MeshPlan, Patch

BASIS = shapes.square(shapes.plain(2, 3), shapes.plain(1, 4))
POINTS = len(BASIS.weight)


def patch(side=1.0):
    """Two elements of Jacobians drawn about a stretched square, of either handedness."""
    rng = np.random.default_rng(3)
    base = {
        "rho_xi": (0.9, 0.2),
        "rho_eta": (-0.1, side * 0.7),
        "rest_xi": (0.4, 0.1),
        "rest_eta": (0.2, side * 0.5),
    }
    parts = {
        name: value + 0.05 * rng.normal(size=(2, POINTS, 2))
        for name, value in base.items()
    }
    number = np.zeros((1, 2, 1), int)
    return Patch(
        BASIS,
        True,
        parts["rho_xi"],
        parts["rho_eta"],
        parts["rest_xi"],
        parts["rest_eta"],
        number,
        number,
    )


def jacobian(one, rho):
    """(elements, points, 2, 2): columns along xi and eta."""
    return np.stack(
        [rho * one.rho_xi + one.rest_xi, rho * one.rho_eta + one.rest_eta], -1
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_metric_is_the_inverse_of_the_jacobians_square_times_the_area(side):
    one = patch(side)
    j = jacobian(one, 0.6)
    area = np.abs(np.linalg.det(j))
    inverse = np.linalg.inv(j.swapaxes(-1, -2) @ j) * area[..., None, None]
    found = assembly.metric(one, 0.6)
    assert np.sign(np.linalg.det(j)).tolist() == [[side] * POINTS] * 2
    assert found.area == pytest.approx(area)
    assert found.inverse_area == pytest.approx(1 / area)
    assert found.xi_xi == pytest.approx(inverse[..., 0, 0])
    assert found.eta_eta == pytest.approx(inverse[..., 1, 1])
    assert found.xi_eta == pytest.approx(inverse[..., 0, 1])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_rates_of_the_metric_are_differences(side):
    one, step = patch(side), 1e-5
    high, low = (assembly.metric(one, 0.6 + d) for d in (step, -step))
    found = assembly.metric_rate(one, 0.6)
    for name in ("xi_xi", "eta_eta", "xi_eta", "inverse_area", "area"):
        want = (getattr(high, name) - getattr(low, name)) / (2 * step)
        assert getattr(found, name) == pytest.approx(
            want, rel=1e-6, abs=1e-7
        )  # third derivative: 1e-9 of some tens


def test_matrices_of_an_element_are_integrals_of_its_fields():
    """Covariant fields: N = J⁻ᵀ (a, b), rot N = curl / area; sums over the points of
    the rule.
    """
    one = patch()
    j = jacobian(one, 0.6)
    mass, curl, scalar = assembly.element_matrices(one, assembly.metric(one, 0.6))
    along, many = (
        np.zeros((2, len(BASIS.along_xi) + len(BASIS.along_eta), POINTS)),
        len(BASIS.along_xi),
    )
    along[0, :many], along[1, many:] = BASIS.along_xi, BASIS.along_eta
    turn = BASIS.curl.T @ BASIS.turn
    for e in range(2):
        area = np.abs(np.linalg.det(j[e])) * BASIS.weight
        field = np.einsum("pdc,cfp->dfp", np.linalg.inv(j[e]).swapaxes(-1, -2), along)
        assert mass[e] == pytest.approx(
            np.einsum("dfp,dgp,p->fg", field, field, area), abs=1e-12
        )
        rotation = turn / np.abs(np.linalg.det(j[e]))
        assert curl[e] == pytest.approx(
            np.einsum("fp,gp,p->fg", rotation, rotation, area), abs=1e-12
        )
        assert scalar[e] == pytest.approx(
            np.einsum("fp,gp,p->fg", BASIS.scalar, BASIS.scalar, area), abs=1e-12
        )


def test_fields_of_a_metric_by_hand():
    """Even fields of unlike size at every point, so that none can be taken for another."""
    flat = np.ones((1, POINTS))
    mass, curl, scalar = assembly.element_matrices(
        patch(), Metric(2 * flat, 3 * flat, 0.7 * flat, 5 * flat, 11 * flat)
    )
    many = len(BASIS.along_xi)
    w = BASIS.weight
    assert mass[0, :many, :many] == pytest.approx(
        2 * (BASIS.along_xi * w) @ BASIS.along_xi.T
    )
    assert mass[0, many:, many:] == pytest.approx(
        3 * (BASIS.along_eta * w) @ BASIS.along_eta.T
    )
    assert mass[0, :many, many:] == pytest.approx(
        0.7 * (BASIS.along_xi * w) @ BASIS.along_eta.T
    )
    assert mass[0, many:, :many] == pytest.approx(mass[0, :many, many:].T)
    assert curl[0] == pytest.approx(
        5 * BASIS.curl.T @ (BASIS.turn * w) @ BASIS.turn.T @ BASIS.curl
    )
    assert scalar[0] == pytest.approx(11 * (BASIS.scalar * w) @ BASIS.scalar.T)


def test_blocks_are_summed_where_their_functions_meet():
    """Two elements of two functions, each for itself and for a mirror image."""
    numbers = np.array([[[0, 2], [2, 1]], [[3, 2], [2, 0]]])
    blocks = np.array([[[1.0, 2], [3, 4]], [[10, 20], [30, 40]]])
    want = np.zeros((4, 4))
    for copy in numbers:
        for places, block in zip(copy, blocks, strict=True):
            for i, row in zip(places, block, strict=True):
                for j, value in zip(places, row, strict=True):
                    want[i, j] += value
    assert assembly.scatter(numbers, blocks, 4).tolist() == want.tolist()


PLAN = MeshPlan(
    2, 3, 2, inner=(0.6, 1.0), outer=(0.4, 1.0), sectors=(0.45, 1.0), core=0.55
)


@pytest.fixture(scope="module")
def made():
    return assembly.assemble(0.63, PLAN)


def test_constant_fields_have_the_areas_of_cell_and_disc(made):
    """1 and x̂ = grad x, both in the element space: scalars add up to 1, and x is the
    sum of the scalars' own x.
    """
    ones = partition(made)
    assert ones @ made.cell.scalar @ ones == pytest.approx(1.0, rel=1e-9)
    quarter = math.pi * 0.63**2 / 4
    assert ones @ made.disc.scalar @ ones == pytest.approx(
        quarter, rel=1e-5
    )  # cosines on three degrees
    assert np.abs(made.gradient @ ones).max() < 1e-12
    assert np.abs(made.cell.curl @ made.gradient).max() < 1e-9  # gradients have no curl
    assert np.abs(made.disc.curl @ made.gradient).max() < 1e-9


def partition(made):
    """The scalar functions of the vertices, which add up to 1 everywhere."""
    out = np.zeros(len(made.mesh.scalar_wall))
    for one in made.mesh.patches:
        total = np.linalg.lstsq(
            one.basis.scalar.T, np.ones(one.basis.scalar.shape[1]), rcond=None
        )[0]
        for copy in one.scalar:
            for places in copy:
                out[places] = np.rint(total)
    return out


def test_the_cell_holds_the_disc_and_what_is_around_it(made):
    """Functions of the disc alone have the same matrices in both, those beyond it none
    in the disc.
    """
    for kind, names in (("vector", ("mass", "curl")), ("scalar", ("scalar",))):
        seen = {
            side: np.unique(
                np.concatenate(
                    [
                        getattr(p, kind).ravel()
                        for p in made.mesh.patches
                        if p.inside is side
                    ]
                )
            )
            for side in (True, False)
        }
        only, never = (
            np.setdiff1d(seen[True], seen[False]),
            np.setdiff1d(seen[False], seen[True]),
        )
        for name in names:
            cell, disc = getattr(made.cell, name), getattr(made.disc, name)
            assert np.array_equal(cell[only], disc[only])
            assert not disc[never].any()
            assert (cell.diagonal() > disc.diagonal())[seen[False]].all()
            assert (disc.diagonal()[seen[True]] > 0).all()


def test_what_is_not_strictly_inside_the_cell_is_refused(made):
    assert made.rho == 0.63
    for rho in (0.0, 1.0, -0.2, math.nan, math.inf):
        with pytest.raises(CellError, match="above 0 and below 1"):
            assembly.assemble(rho, PLAN)


def test_rates_in_the_radius_are_differences(made):
    step = 1e-5
    high, low = (assembly.integrate(made.mesh, 0.63 + d) for d in (step, -step))
    found = assembly.integrate(made.mesh, 0.63, rate=True)
    for part in (0, 1):
        for name in ("mass", "curl", "scalar"):
            want = (getattr(high[part], name) - getattr(low[part], name)) / (2 * step)
            got = getattr(found[part], name)
            size = np.abs(getattr(made.cell if part == 0 else made.disc, name)).max()
            assert (
                np.abs(got - want).max() < 1e-8 * size
            )  # third derivatives: some tens of 1e-10; rounding 1e-11
    plain = assembly.integrate(made.mesh, 0.63)
    assert np.array_equal(plain[0].mass, made.cell.mass)
    assert np.array_equal(plain[1].curl, made.disc.curl)
    assert mesh.build(PLAN) is made.mesh
