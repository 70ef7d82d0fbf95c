"""Fields of both polarisations on unlike nodes: across their rays, of the power that
was given, steep ones cut.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.field.polarised import OF_ENERGY, OF_FLUX, STEEPEST, factors

TANGENTS = torch.tensor([0.31, -0.17], dtype=torch.float64)


def nodes(aside, middle):
    return SimpleNamespace(
        aside=torch.tensor(aside, dtype=torch.float64),
        middle=torch.tensor(middle, dtype=torch.float64),
    )


SEEN = nodes([-0.3, -0.02, 0.11, 0.25, 0.4], (0.07, -0.13))
Q, P = np.meshgrid(SEEN.aside.numpy() - 0.13, SEEN.aside.numpy() + 0.07, indexing="ij")


def directions(n):
    return np.stack([P / n, Q / n, np.sqrt(1 - (P**2 + Q**2) / n**2)])


def electric(seen, order):
    """(polarisation, xyz, y, x)."""
    found = factors(seen, TANGENTS, order, flux=False)
    assert found.signs == (1.0,) * 6
    return found.pupils.numpy().reshape(2, 3, *found.pupils.shape[-2:])


@pytest.mark.parametrize("order", [(1.0,), (1.45,), (1.0, 1.6)])
def test_fields_are_across_their_rays_in_the_last_medium(order):
    """p across, q down, each over the index; squares of both add up to 2 / cos θ there
    where no face is passed.
    """
    found, b = electric(SEEN, order), directions(order[-1])
    assert np.abs(np.einsum("pcyx,cyx->pyx", found, b)).max() < 1e-12
    if len(order) == 1:
        assert (found**2).sum((0, 1)) == pytest.approx(2 / b[2], rel=1e-12)
        flux = factors(SEEN, TANGENTS, order, flux=True)
        signs = np.array(flux.signs)
        assert len(signs) == 8
        assert np.einsum("c,cyx->yx", signs, flux.pupils.numpy() ** 2) == pytest.approx(
            np.full((5, 5), 2), rel=1e-12
        )


@pytest.mark.parametrize("n", [1.0, 1.45])
def test_a_ray_that_goes_straight_on_has_the_fields_that_came(n):
    """Of the node whose direction in the cover is that of the chief ray: orthogonal,
    across the ray, 1 / cos each.
    """
    steep = math.sqrt(1 + 0.31**2 + 0.17**2)
    found = electric(nodes([0.0, 0.2], (n * 0.31 / steep, -n * 0.17 / steep)), (n,))[
        ..., 0, 0
    ]
    assert found @ found.T == pytest.approx(np.eye(2) * steep, abs=1e-12)


def test_a_turned_ray_is_turned_by_the_least_angle():
    """Rodrigues about a x b: what is along the axis stays, the rest turns by the angle
    between both.
    """
    a = np.array([0.31, -0.17, 1.0])
    a /= np.linalg.norm(a)
    b = directions(1.3)[:, 1, 3]
    axis = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    sine, cosine = np.linalg.norm(np.cross(a, b)), a @ b
    cross = np.array(
        [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]
    )
    turn = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
    came = electric(nodes([0.0], (1.3 * a[0], 1.3 * a[1])), (1.3,))[
        ..., 0, 0
    ] * math.sqrt(a[2])
    found = electric(SEEN, (1.3,))[..., 1, 3] * math.sqrt(b[2])
    assert found == pytest.approx(came @ turn.T, abs=1e-12)


def test_flux_and_energy_are_those_of_the_same_fields():
    """Σ s f² of the flux is Σ Ex Hy - Ey Hx with H = b x E, of both polarisations,
    behind a face too.
    """
    order = (1.0, 1.6)
    found, b = electric(SEEN, order), directions(1.6)
    magnetic = np.stack([np.cross(b, e, axis=0) for e in found])
    want = (found[:, 0] * magnetic[:, 1] - found[:, 1] * magnetic[:, 0]).sum(0)
    flux = factors(SEEN, TANGENTS, order, flux=True)
    assert np.einsum(
        "c,cyx->yx", np.array(flux.signs), flux.pupils.numpy() ** 2
    ) == pytest.approx(want, rel=1e-12)


@pytest.mark.parametrize("order", [(1.0,), (1.7,), (1.4, 1.2, 1.9)])
def test_nodes_beyond_the_rim_go_along_the_steepest_ray_in_their_direction(order):
    """cos² of a thousandth in the rarest medium: the direction across stays, its size
    is cut to √0.999 of the index.
    """
    rare = min(order)
    found = electric(nodes([-0.4, 0.9], (0.8 * rare, 0.5 * rare)), order)
    p, q = 0.9 + 0.8 * rare, 0.9 + 0.5 * rare
    cut = math.sqrt(0.999) * rare / math.hypot(p, q)
    b = np.array([p * cut, q * cut, 0.0]) / order[-1]
    b[2] = math.sqrt(1 - b @ b)
    assert np.isfinite(found).all()
    assert np.abs(found[..., 1, 1] @ b).max() < 1e-11 * np.abs(found).max()
    if len(order) == 1:
        assert (found[..., 1, 1] ** 2).sum() == pytest.approx(
            2 / math.sqrt(1e-3), rel=1e-9
        )


def test_components_that_leave_nothing_out_and_the_steepest_node():
    assert (OF_FLUX, OF_ENERGY, STEEPEST) == (4, 6, 1e-3)
    flux, energy = (
        factors(SEEN, TANGENTS, (1.0,), flux=kind).pupils.reshape(-1, 25)
        for kind in (True, False)
    )
    assert (len(flux), len(energy)) == (8, 6)
    assert np.linalg.matrix_rank(np.asarray(energy)) <= 6
