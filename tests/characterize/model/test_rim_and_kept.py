"""What the rim of a window costs and saves, and how many places of a fit keep their
operators.
"""

import sys
import threading
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import explore
from characterize.model import gather
from characterize.model.glass import BenchGeometry
from characterize.model.kernel import extra_digits
from characterize.model.pillars import PillarChange, PillarResponse
from characterize.model.reduced import CompressedLens
from metalens import design, profiles
from metalens.cell.record import Cell
from metalens.core import legendre

AXIS = np.linspace(-12, 12, 49)
INSIDE = np.ix_(np.abs(AXIS) <= 7, np.abs(AXIS) <= 7)


@pytest.fixture(scope="module")
def lens():
    focus = profiles.Focus(0.85, 9.2, 138.0)
    phase = design.phase_of(None, focus, radius_um=4.6)
    return design.make(
        phase, focus, aperture_um=9.2, cell=Cell(pitch_um=0.4), proxy=b.proxy()
    )[0]


def test_a_rim_seen_by_its_blur_errs_by_twice_the_tolerance_at_most_and_saves_a_fifth_of_the_terms(
    lens,
):
    """Root mean squares over the field's, against a field of 1e-5; the rest of the
    window keeps to the tolerance.
    """
    pillars, tolerance, made = PillarResponse(lens, b.RESPONSE), 1e-3, {}
    for name, (edge, asked) in {
        "best": (0.0, 1e-5),
        "plain": (0.0, tolerance),
        "rim": (5.0, tolerance),
    }.items():
        bench = BenchGeometry(lens.sensor_distance_um, 0.85, 138.0, (0.21, -0.1))
        reduced = CompressedLens(
            lens,
            pillars,
            bench,
            window_um=24.0,
            depths_um=np.array([100.0, 170.0]),
            tolerance=asked,
        )
        found = reduced.operators(
            wavelength_um=0.85,
            distance_um=lens.sensor_distance_um,
            axes_um=(AXIS, AXIS),
            edge_um=edge,
        )
        light = np.tensordot(
            pillars.coefficients(PillarChange())[0], reduced.gathered, 1
        )
        made[name] = found.field(light), found.rest.window.shape[1]
    best, whole = made["best"][0], np.sqrt((np.abs(made["best"][0]) ** 2).mean())
    rim = np.ones(best.shape, bool)
    rim[INSIDE] = False
    for name, most in (("plain", 1.0), ("rim", 2.0)):
        field = made[name][0]
        off = (
            np.abs(field * np.vdot(field, best) / np.abs(np.vdot(field, best)) - best)
            / whole
        )
        assert np.sqrt((off[INSIDE] ** 2).mean()) < tolerance
        assert np.sqrt((off[rim] ** 2).mean()) < most * tolerance
    assert made["rim"][1] < 0.82 * made["plain"][1]


def reduced_of(lens, tolerance):
    bench = BenchGeometry(lens.sensor_distance_um, 0.85, 138.0, (0.21, -0.1))
    pillars, depths = PillarResponse(lens, b.RESPONSE), np.array([100.0, 170.0])
    made = CompressedLens(
        lens, pillars, bench, window_um=24.0, depths_um=depths, tolerance=tolerance
    )
    return made, np.tensordot(pillars.coefficients(PillarChange())[0], made.gathered, 1)


def test_a_window_off_the_chief_ray_sees_the_same_field_where_it_is(lens):
    """Samples that end at -12 and 8 um along y, at -5 and 12 along x, beside those from
    -12 to 12: a tolerance each.
    """
    reduced, light = reduced_of(lens, 1e-4)
    some = slice(0, 41), slice(14, 49)
    whole, part = (
        reduced.operators(
            wavelength_um=0.85, distance_um=lens.sensor_distance_um, axes_um=axes
        ).field(light)
        for axes in ((AXIS, AXIS), (AXIS[some[0]], AXIS[some[1]]))
    )
    whole = whole[some]
    off = np.linalg.norm(
        part * np.vdot(part, whole) / np.abs(np.vdot(part, whole)) - whole
    )
    assert off < 2e-4 * np.linalg.norm(whole)


def test_coarse_samples_stay_where_they_are_over_the_distances_of_a_fit(lens):
    """A place that jumps makes the images jump by a tenth of the tolerance, which a
    search sees: 3 % to either side.
    """
    reduced, _ = reduced_of(lens, 1e-3)
    d, axis = lens.sensor_distance_um, np.linspace(-12, 12, 97)
    steps = [
        reduced.operators(
            wavelength_um=0.85, distance_um=share * d, axes_um=(axis, axis)
        ).x.fine
        for share in (0.97, 1.0, 1.03)
    ]
    assert len(steps[1][0]) < len(axis)
    assert all(np.array_equal(one, steps[1]) for one in steps)


@pytest.mark.parametrize(
    ("count", "tolerance"), [(40, 5e-4), (131, 5e-4), (400, 5e-4), (67, 1e-6)]
)
def test_nodes_that_are_nearly_even_hold_steeper_waves_than_gauss_legendre_nodes(
    count, tolerance
):
    """exp(i slope t) of the slope that they are made for: to the tolerance where
    Gauss-Legendre nodes fail.
    """
    held = (
        count * gather.node_density(count, tolerance)
        - 8
        - 1.5 * extra_digits(tolerance)
    )
    slope = next(
        s for s in np.arange(held, 0, -0.1) if s + 2 * (s + 1) ** (1 / 3) <= held
    )
    t, pull, wave = (
        np.linspace(-1, 1, 1901),
        gather.node_stretch(count, tolerance),
        lambda t: np.exp(1j * slope * t),
    )
    even = gather.even_interpolation(count, pull, (-1.0, 1.0), t) @ wave(
        gather.even_nodes(count, pull, -1.0, 1.0)
    ) - wave(t)
    plain = legendre.interpolation_matrix(count, t) @ wave(
        legendre.gauss_legendre_nodes(count)[0]
    ) - wave(t)
    assert np.sqrt((np.abs(even) ** 2).mean()) < tolerance
    assert np.sqrt((np.abs(plain) ** 2).mean()) > 10 * np.sqrt(
        (np.abs(even) ** 2).mean()
    )


def test_profiles_side_by_side_find_their_operators_again_and_older_places_let_go_of_theirs():
    """An image and then its derivatives at each place: made once; of a few megabytes
    each at most sixteen are held.
    """
    reduced, made = object.__new__(CompressedLens), []
    reduced._operators, reduced._changing = {}, threading.Lock()
    reduced._operators_of = lambda _wave, distance_um, *_: (
        made.append(distance_um) or distance_um
    )
    places = [900.0 + 0.37 * k for k in range(explore._BESIDE)]
    for _ in range(2):
        for place in places:
            found = reduced.operators(
                wavelength_um=0.85, distance_um=place, axes_um=(AXIS, AXIS)
            )
            assert found == place
    assert made == places
    for k in range(40):
        reduced.operators(
            wavelength_um=0.85, distance_um=1000.0 + k, axes_um=(AXIS, AXIS)
        )
    assert len(reduced._operators) <= 16
    assert len(made) == len(places) + 40
