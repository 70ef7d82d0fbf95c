"""Changes of a layer's operators: differences of the operators, and K and R written out
order by order.
"""

from dataclasses import replace

import numpy as np
import pytest

from metalens.cell.light import Light
from metalens.cell.record import Cell, Index
from metalens.rcwa import changes
from metalens.rcwa.conditions import case, case_waves
from metalens.rcwa.derivative import differentiate
from metalens.rcwa.layer import operators
from metalens.rcwa.orders import basis
from metalens.rcwa.solver import truncated

CELL = Cell(
    0.43, 0.7, pillar=Index(3.1, 0.2), substrate=Index(1.4525), between=Index(1.3, 0.05)
)
THIS = case(CELL, Light(0.81, angle_rad=0.3, azimuth_rad=0.7, polarization="p"))
WAYS, _ = case_waves(THIS, 2)
STRAIGHT, _ = case_waves(
    case(CELL, Light(0.81)), 3
)  # of one symmetry: a wave without Ez, Ez and Hz of unlike orders
DIAMETER = np.array(0.227)
RNG = np.random.default_rng(4)


def made(ways, diameter=DIAMETER, pillar=THIS.pillar, between=THIS.between):
    return operators(ways, diameter, CELL.pitch_um, pillar, between)


def close(got, up, down, step):
    """Central differences: errors of step² and rounding / step, each some 1e-9 of the
    largest.
    """
    for one, a, b in zip(got, up, down, strict=True):
        want = (a - b) / (2 * step)
        assert np.abs(one - want).max() < 1e-7 * np.abs(want).max()


@pytest.mark.parametrize("ways", [WAYS, STRAIGHT], ids=["aslant", "straight"])
def test_a_wider_pillar(ways):
    step = 1e-6
    close(
        changes.rim(THIS, ways, DIAMETER),
        *(made(ways, DIAMETER + s) for s in (step, -step)),
        step,
    )


@pytest.mark.parametrize("ways", [WAYS, STRAIGHT], ids=["aslant", "straight"])
@pytest.mark.parametrize("rate", [(1.0, 0.0), (0.0, 1.0), (0.7 + 0.2j, -0.4 + 0.6j)])
def test_other_indices_of_pillar_and_surroundings(ways, rate):
    step = 1e-5
    ends = [
        made(ways, pillar=THIS.pillar + s * rate[0], between=THIS.between + s * rate[1])
        for s in (step, -step)
    ]
    close(changes.indices(THIS, ways, DIAMETER, *rate), *ends, step)


def lengths(kx, ky):
    """K from (Ex, Ey) and R, of every order of the circle, in the waves of WAYS as they
    are.
    """
    n = len(kx)
    K, R = np.zeros((2 * n, n)), np.zeros((2 * n, n))
    i = np.arange(n)
    K[i, i], K[n + i, i], R[i, i], R[n + i, i] = kx, ky, -ky, kx
    return WAYS.fold.T @ K, WAYS.fold.T @ R


ORDERS = WAYS.space.ex
STEP = 0.81 / 0.43
KX, KY = THIS.kx + STEP * ORDERS.m, THIS.ky + STEP * ORDERS.n
TURN_X, TURN_Y = RNG.normal(size=(2, len(KX)))  # of every order its own


def turning():
    return changes.turning(WAYS, np.stack([np.tile(TURN_X, 2), np.tile(TURN_Y, 2)]))


def test_wave_vectors_change_k_and_r_of_waves_that_stay():
    for one, want in zip(turning(), lengths(TURN_X, TURN_Y), strict=True):
        assert one == pytest.approx(want, abs=1e-13)


def test_a_turn_changes_the_operators_of_a_pillar():
    """P = 1 - K [eps]^-1 K^T and Q = E - R R^T: of second order in the turn, so that
    differences are exact.
    """
    eps = basis.products(
        WAYS.space,
        (THIS.pillar**2 - THIS.between**2)
        * basis.disc(WAYS.space, DIAMETER, CELL.pitch_um)
        + THIS.between**2 * (WAYS.space.shells == 0),
        basis.EZ,
    )

    def turned(share):
        K, R = lengths(KX + share * TURN_X, KY + share * TURN_Y)
        return -K @ np.linalg.inv(eps) @ K.T, -R @ R.T

    close(
        changes.turned_pattern(THIS, WAYS, DIAMETER, turning()),
        turned(0.5),
        turned(-0.5),
        0.5,
    )


def test_a_medium_of_another_permittivity_and_another_direction():
    """P = 1 - K K^T / eps and Q = eps - R R^T."""
    index, rate, step = 1.7 + 0.3j, 0.4 - 0.7j, 1e-5

    def medium(share):
        K, R = lengths(KX + share * TURN_X, KY + share * TURN_Y)
        eps = index**2 + share * rate
        return -K @ K.T / eps, eps * np.eye(2 * len(KX)) - R @ R.T

    close(
        changes.medium(WAYS, index, rate, turning()), medium(step), medium(-step), step
    )


def test_changes_add_part_by_part():
    one, two = (
        changes.rim(THIS, WAYS, DIAMETER),
        changes.indices(THIS, WAYS, DIAMETER, 0.3, 0.8j),
    )
    both = changes.add(one, two)
    assert both[0] == pytest.approx(one[0] + two[0], abs=1e-12)
    assert both[1] == pytest.approx(one[1] + two[1], abs=1e-12)


def test_a_layer_without_contrast_changes_as_its_surroundings_do():
    """Pillar and surroundings of one index, changed alike: n² changes by 2 n, in every
    order for itself.
    """
    plain = replace(THIS, pillar=THIS.between)
    dP, dQ = changes.indices(plain, WAYS, DIAMETER, 1.0, 1.0)
    assert dQ == pytest.approx(2 * THIS.between * np.eye(len(WAYS.kappa)), abs=1e-12)
    p = np.where(np.arange(len(WAYS.kappa)) < WAYS.p_count, WAYS.kappa, 0)
    assert dP == pytest.approx(np.diag(2 * p**2 / THIS.between**3), abs=1e-12)


@pytest.mark.parametrize(
    ("cell", "angle_rad"),
    [
        (
            Cell(
                0.4, 0.6, pillar="SiO2", substrate=Index(1.45), between=Index(2.1, 0.03)
            ),
            0.25,
        ),
        (Cell(0.4, 0.6, pillar=Index(3.1), substrate=Index(1.45), between="SiO2"), 0.0),
    ],
)
def test_dispersion_of_pillar_and_of_surroundings_is_part_of_the_slope_with_wavelength(
    cell, angle_rad
):
    """Central differences of fourth order: 1e-3 of the wavelength to the fourth, 3e-10
    of the fifth derivative.
    """

    def at(wavelength):
        light = Light(
            wavelength, angle_rad=angle_rad, polarization="p" if angle_rad else "x"
        )
        return case(cell, light)

    def t(wavelength):
        return truncated(at(wavelength), np.array([0.21]), 3).t[0]

    step = 8e-4
    want = (
        8 * (t(0.85 + step) - t(0.85 - step)) - t(0.85 + 2 * step) + t(0.85 - 2 * step)
    ) / (12 * step)
    got = differentiate(
        at(0.85), 0.21, harmonics=3, steps=0, angle_rad=angle_rad
    ).wavelength_um
    assert abs(got - want) < 1e-6 * abs(want)
