"""Backgrounds that belong to the wanted doses, against a dense linear system; doses and
uniformity by hand.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.pec import correct
from layout.pec.psf import THRESHOLD
from layout.pec.uniformity import ErrorTally

RNG = np.random.default_rng(13)
SHAPE = (4, 5)
PLACE = np.stack(
    np.meshgrid(np.arange(4.0), np.arange(5.0), indexing="ij"), -1
).reshape(-1, 2)
KERNEL = 0.09 * np.exp(-(((PLACE[:, None] - PLACE) ** 2).sum(-1)) / 3.1)
MASS = RNG.uniform(0.5, 1.9, 20)
DRIVE = RNG.uniform(0.2, 1.1, 20)


def reach(masses):
    return (KERNEL @ masses.ravel()).reshape(SHAPE)


def test_a_background_is_that_of_the_doses_that_it_asks_for():
    """(1 + K M) B = K drive, all at once."""
    want = np.linalg.solve(np.eye(20) + KERNEL * MASS, KERNEL @ DRIVE)
    got = correct._relaxed(reach, MASS.reshape(SHAPE), DRIVE.reshape(SHAPE))
    assert got.ravel() == pytest.approx(want, rel=1e-6)


def test_neighbours_without_the_site_itself_converge_as_well():
    """A hollow kernel has eigenvalues below 0, here down to -0.3."""
    hollow = KERNEL - np.diag(np.diag(KERNEL))
    low = float(np.linalg.eigvals(hollow * MASS).real.min())
    assert -0.9 < low < -0.05
    want = np.linalg.solve(np.eye(20) + hollow * MASS, hollow @ DRIVE)
    got = correct._relaxed(
        lambda m: (hollow @ m.ravel()).reshape(SHAPE),
        MASS.reshape(SHAPE),
        DRIVE.reshape(SHAPE),
        bound_below=0.9,
    )
    assert got.ravel() == pytest.approx(want, rel=1e-6)


def test_the_slowest_that_the_bound_allows_still_comes_within_1e_8():
    """All give to all alike, three times the mean: of the error 3 / 5 stay each time. B
    = 3 drive / (1 + 3).
    """
    drive = DRIVE.reshape(SHAPE)
    got = correct._relaxed(
        lambda m: np.full(SHAPE, 3 * m.mean()), np.ones(SHAPE), drive
    )
    assert got == pytest.approx(np.full(SHAPE, 0.75 * drive.mean()), rel=1.1e-8)


def test_pieces_of_marks_ask_for_their_own_dose_in_the_mean_of_their_edges():
    """Two pieces of goal 1 and 0.8 and own exposure 0.9 and 0.4, with two and one edges
    on nodes of the grid.
    """
    own, goal, area = np.array([0.9, 0.4]), np.array([1.0, 0.8]), np.array([1.3, 0.6])
    nodes = [7, 12, 3]
    spots = np.zeros((20, 2))
    spots[8], spots[3] = (area[0], 0), (0, area[1])

    grid = SimpleNamespace(
        shape=SHAPE,
        sample=lambda field, x, y: field.ravel()[nodes],
        deposit=lambda x, y, mass: (spots @ (mass / area)).reshape(SHAPE),
    )
    points = np.zeros((2, 2)), area, np.array([0, 1])
    edges = np.zeros((3, 2)), np.array([0, 0, 1])
    pads = correct._Pads(SimpleNamespace(goal=goal), own, edges, points, grid)
    field = RNG.uniform(0.1, 0.3, SHAPE)
    around = np.array([(field.ravel()[7] + field.ravel()[12]) / 2, field.ravel()[3]])
    dose = (THRESHOLD * goal - around) / own
    assert pads.wanted(field).ravel() == pytest.approx(spots @ dose, rel=1e-12)
    # in the background: (1 + K (M + S E / own)) B = K (drive + S THRESHOLD goal / own)
    mean = np.zeros((2, 20))
    mean[0, [7, 12]], mean[1, 3] = 0.5, 1.0
    system = np.eye(20) + KERNEL @ (np.diag(MASS) + spots @ (mean / own[:, None]))
    want = np.linalg.solve(system, KERNEL @ (DRIVE + spots @ (THRESHOLD * goal / own)))
    got = correct._relaxed(reach, MASS.reshape(SHAPE), DRIVE.reshape(SHAPE), pads=pads)
    assert got.ravel() == pytest.approx(want, rel=1e-6)


def test_half_a_unit_of_exposure_clears_a_straight_edge():
    assert THRESHOLD == 0.5


def test_worst_and_rms_are_over_all_that_was_taken_in_and_become_a_diameter_by_the_slope():
    """Errors of -0.03 and 0.02 in two parts, squares over 7 edges; a background that is
    off by 0.004; 9.1 per um.
    """
    tally = ErrorTally()
    tally.merge(np.array([-0.03, 0.01, 0.0019, 3.0]))
    tally.merge(np.array([-0.01, 0.02, 0.0008, 4.0]))
    assert tally.worst == pytest.approx(0.03)
    found = tally.result(9.1, 0.004)
    assert found.worst == pytest.approx(0.034)
    assert found.rms == pytest.approx((0.0027 / 7) ** 0.5 + 0.004)
    assert found.diameter_nm == pytest.approx(2 * 0.034 / 9.1 * 1e3)  # both edges, nm
    assert ErrorTally().worst == 0
