"""Circular light on turned pillars: the wave plate of the textbooks, the symmetries of
the lattice, bars by hand.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens import library, rcwa
from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Circle, Cross, Ellipse, Polygon, Rectangle, Square
from metalens.core.errors import CellError, ConfigError
from metalens.library import ProxyTolerances, Sweep, fit
from metalens.library.geometric_phase import (
    GeometricPhase,
    check_geometric_phase,
    solve_rotations,
    to_circular_basis,
)
from tests.referees.turned_pillar import isolated

# low contrast, so that few harmonics suffice; far enough apart that the neighbours
# hardly see the turn
WEAK = Cell(
    0.3, 0.4, Index(1.6), Index(1.33), Index(1.1), Index(1.1), shape=Rectangle(0.45)
)
R = lambda a: np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])  # noqa: E731


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_the_other_hand_leaves_with_twice_the_turn(hand):
    t_x, t_y = 0.8 * np.exp(0.4j), 0.9 * np.exp(-1.3j)
    angle = np.array([0.0, 0.37, -1.2])
    kept, other = to_circular_basis(isolated(t_x, t_y, angle), hand)
    assert np.allclose(kept, (t_x + t_y) / 2)
    assert np.allclose(other, (t_x - t_y) / 2 * np.exp(2j * hand * angle))
    come = np.array([1, 1j * hand]) / math.sqrt(2)
    leave = isolated(t_x, t_y, 0.37) @ come
    # nothing else leaves
    assert np.allclose(leave, kept[1] * come + other[1] * come.conj())


def test_solved_turns_have_the_symmetries_of_the_lattice():
    found = solve_rotations(WEAK, 0.24, 0.74, tolerance=3e-2)
    assert np.degrees(found.angle_rad).tolist() == pytest.approx(
        [0, 15, 30, 45, -30, -15]
    )
    for k, angle in ((1, 15.0), (4, -30.0)):
        shape = Rectangle(0.45, angle_rad=math.radians(angle))
        own = rcwa.jones(
            dataclasses.replace(WEAK, shape=shape), 0.24, 0.74, tolerance=3e-2
        )
        assert abs(own.t - found.t[k]).max() <= own.t_error + found.t_error[k]
    across = dataclasses.replace(WEAK, shape=Rectangle(0.45, angle_rad=math.pi / 2))
    along = rcwa.jones(across, 0.24, 0.74, tolerance=3e-2)
    assert (
        abs(R(math.pi / 2) @ found.t[0] @ R(-math.pi / 2) - along.t).max()
        < along.t_error + found.t_error[0]
    )
    # low contrast: what the neighbours see of the turn is small
    assert found.model_error < 0.05
    assert found.model_error > 1e-5  # but not nothing


@pytest.mark.parametrize(
    "shape",
    [Circle(), Square(), Cross(0.4), Rectangle(1.0), Rectangle(0.5, angle_rad=0.2)],
)
def test_shapes_without_a_long_axis_along_x_or_y_are_refused(shape):
    with pytest.raises(CellError, match="circular light"):
        check_geometric_phase(dataclasses.replace(WEAK, shape=shape), 0.2)


def test_ellipses_and_own_polygons_are_taken():
    own = Polygon(((-0.5, -0.2), (0.5, -0.2), (0.5, 0.2), (-0.5, 0.2)))
    for shape in (Ellipse(0.5), own):
        check_geometric_phase(
            dataclasses.replace(WEAK, shape=shape, lattice=Lattice("hexagonal")), 0.25
        )


@pytest.fixture(scope="module")
def made():
    sweep = Sweep(
        (0.74,), diameters_um=(0.16, 0.25), samples=40, tolerance=4e-2, light="circular"
    )
    return library.sweep(WEAK, sweep)


def test_a_library_for_circular_light_holds_both_axes(made, tmp_path):
    assert made.polarization == ("x", "y")
    for i in (5, 20):
        own = rcwa.jones(WEAK, float(made.diameter_um[i]), 0.74, tolerance=5e-3)
        for k in (0, 1):
            assert (
                abs(made.t[k, 0, 0, i] - own.t[k, k])
                <= made.t_error[k, 0, 0, i] + own.t_error
            )


def test_its_proxy_is_that_of_the_converted_light(made, tmp_path):
    """Closed form: two axes whose phases part with the size, half a turn apart at 0.197
    um.
    """
    d = made.diameter_um
    t = np.stack(
        [
            0.98 * np.exp(40j * d),
            0.96 * np.exp(1j * (40 * d + np.pi + 17 * (d - 0.197))),
        ]
    )
    known = dataclasses.replace(made, t=t[:, None, None])
    fitted = fit.fit(
        known, ProxyTolerances(phase_tolerance_rad=1e-4, transmission_tolerance=1e-4)
    )
    size = known.best_converting_um
    assert size == pytest.approx(0.197, abs=0.0012)  # half a step of the sizes
    low, high = fitted.proxy.domain_um
    at = np.linspace(low, high, 31)
    want = (
        0.98 * np.exp(40j * at)
        - 0.96 * np.exp(1j * (40 * at + np.pi + 17 * (at - 0.197)))
    ) / 2
    got = fitted.proxy.transmission(at, 0.74) * np.exp(
        1j * fitted.proxy.phase_rad(at, 0.74)
    )
    assert abs(got - want).max() < 2e-4  # both tolerances
    assert high - low > 0.05
    turned = GeometricPhase(
        size,
        0.74,
        np.zeros(1),
        np.zeros((1, 2, 2), complex),
        np.ones(1),
        np.zeros((1, 0, 2, 2)),
    )
    library.save(
        tmp_path / "a.h5", dataclasses.replace(known, proxy=fitted.proxy, turned=turned)
    )
    read = library.load(tmp_path / "a.h5")
    assert read.turned is not None
    assert (read.turned.size_um, read.sweep.light) == (size, "circular")


def test_circular_light_at_an_angle_is_refused():
    with pytest.raises(ConfigError, match="circular light"):
        Sweep((0.74,), angles_deg=(0.0, 10.0), light="circular")


def test_s_and_p_of_an_unlike_cell_are_its_axes_at_normal_incidence():
    """The plane of incidence holds x: s is the light along y there, p the light along
    x.
    """
    sweep = Sweep((0.74,), (0.0, 4.0), (0.16, 0.25), samples=20, tolerance=1e-1)
    made = library.sweep(WEAK, sweep)
    own = rcwa.jones(WEAK, float(made.diameter_um[7]), 0.74, tolerance=1e-2)
    bar = made.t_error[:, 0, 0, 7].max() + own.t_error
    assert abs(made.t[0, 0, 0, 7] - own.t[1, 1]) <= bar  # s
    assert abs(made.t[1, 0, 0, 7] - own.t[0, 0]) <= bar  # p
    assert abs(own.t[0, 0] - own.t[1, 1]) > 1.5 * bar  # they differ
