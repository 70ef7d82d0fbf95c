"""Error bars of coupled waves from typed truncations: how far the last ones lie apart,
and what is added.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell, Incidence, Index
from metalens.cell.shapes import Rectangle
from metalens.rcwa import anchored, any_shape, solver, wall
from metalens.rcwa.anchored import ReferencePillars
from metalens.rcwa.conditions import disc_case
from metalens.rcwa.solver import TruncatedResponse

CELL = Cell(0.4, 0.5, Index(3.5), Index(1.45))
LIGHT = Incidence(0.85)


@pytest.mark.parametrize(
    ("reach", "times"), [(6, 7.2), (8, 6.0), (12, 3.6), (13, 3.0), (16, 3.0)]
)
def test_few_orders_are_trusted_less(reach, times):
    assert solver.safety_factor(reach) == pytest.approx(times, rel=1e-12)


def test_an_error_is_the_farthest_of_four_truncations_before_the_last_times_what_is_trusted():
    """t of two diameters, r that tells more of the first; the first of six truncations
    is no longer looked at.
    """
    t = np.array(
        [
            [9.0, 9j],
            [0.51, 0.3j],
            [0.55, 0.35j],
            [0.52, 0.33j],
            [0.5, 0.32j],
            [0.53, 0.31j],
        ]
    )
    apart = [max(0.02, 0.02, 0.01, 0.03), max(0.01, 0.04, 0.02, 0.01)]
    r = np.array(
        [[9j, 9.0], [0.2, 0.1], [0.2, 0.1], [0.25j, 0.1], [0.2, 0.1], [0.2, 0.11]]
    )
    apart[0] = math.hypot(0.2, 0.25)
    amplitudes = np.stack([t, r], 1)
    assert solver._estimate(amplitudes, 9, np.array([4, 4])) == pytest.approx(
        5.4 * np.array(apart), rel=1e-9
    )
    narrow = 9.0 - 0.11  # r of the second diameter, whose five before are looked at
    assert solver._estimate(amplitudes, 9, np.array([4, 5])) == pytest.approx(
        [5.4 * apart[0], 5.4 * narrow], rel=1e-9
    )
    assert np.isinf(solver._estimate(amplitudes[:1], 9, np.array([4, 4]))).all()
    both = [np.array([[a, 0.1], [0.2j, b]]) for a, b in t]
    two = (
        49 / (81 - 49) * 0.02
    )  # of nine orders, seven leave 1.5: whole; six 0.8, five 0.45, four 0.25 of the way
    assert two > 0.02
    assert any_shape.estimate_error(both, 9, 4) == pytest.approx(
        5.4 * 36 / 45 * 0.04, rel=1e-9
    )
    assert any_shape.estimate_error(both, 9, 5) == pytest.approx(
        5.4 * 16 / 65 * (9.0 - 0.31), rel=1e-9
    )
    assert any_shape.estimate_error(both, 15, 4) == pytest.approx(3 * 0.04, rel=1e-9)
    assert any_shape.estimate_error(both[:1], 9, 4) == pytest.approx(5.4)


@pytest.mark.parametrize(
    ("gap_um", "times"),
    [(0.0, 6.0), (0.0019, 4.75), (0.0057, 2.25), (0.0076, 1.0), (0.1, 1.0)],
)
def test_pillars_that_all_but_touch_are_trusted_less(gap_um, times):
    assert solver.gap_factor(gap_um, 0.38) == pytest.approx(
        times, rel=1e-12
    )  # 1 + 5 (1 - 50 gap / pitch)


@pytest.mark.parametrize(
    ("width", "count"),
    [(0.5, 4), (0.188, 4), (0.187, 5), (0.151, 5), (0.021, 6), (0.019, 4)],
)
def test_narrow_pillars_and_gaps_are_looked_at_over_three_quarters_of_a_swing(
    width, count
):
    """0.75 / width of the truncations before the last, four at least and six at most;
    touching ones have a factor.
    """
    assert solver.compared_truncations(width) == count


# cell, diameter, wavelength, orders; t and r of the modal method (mesh "fine", to 1e-5)
SLOW = [
    (
        Cell(
            0.364240498,
            0.56218211,
            Index(2.6709832118),
            Index(1.59601762),
            Index(1.03038054),
            Index(1.22127794),
        ),
        (0.05667532322, 0.88152546244, 10),
        (0.25171071 - 0.96567561j, 0.04740791 - 0.0431836j),
    ),
    (
        Cell(
            0.282190657,
            4.459343876,
            Index(1.4867993058),
            Index(1.54079380),
            Index(1.66267354),
            Index(1.18593744),
        ),
        (0.25124168475, 0.77757768238, 8),
        (0.57821583 - 0.80551312j, 0.09097735 + 0.09240233j),
    ),
]


@pytest.mark.parametrize(
    ("cell", "asked", "exact"), SLOW, ids=["thin disc", "narrow gap"]
)
def test_bars_hold_where_truncations_swing_slowly(cell, asked, exact):
    """Discs of 0.156 pitches, gaps of 0.11: over four truncations t and r move less
    than a sixth of what is left.
    """
    found = rcwa.solve(cell, asked[0], asked[1], harmonics=asked[2])
    error = max(abs(found.t - exact[0]), abs(found.r - exact[1]))
    this = disc_case(cell, Incidence(asked[1]))
    four = [
        solver.solve_truncated(this, np.array([asked[0]]), n).both
        for n in range(asked[2] - 4, asked[2] + 1)
    ]
    assert error > solver.safety_factor(asked[2]) * max(
        np.abs(four[-1] - one).max() for one in four[:-1]
    )
    assert error + 2e-5 < found.t_error


def test_pillars_between_the_orders_are_not_believed():
    """Ten orders on 0.4 um resolve 0.04 um: below, the whole effect is in doubt, where
    that is more than the error.
    """
    this = SimpleNamespace(cell=CELL)
    wide, change = np.array([0.039, 0.039, 0.041]), np.array([0.2, 0.004, 0.2])
    error = np.array([0.01, 0.013, 0.01])
    assert solver._blur(this, wide, 10, change, error) == pytest.approx(
        [0.2, 0.013, 0.01]
    )


def test_a_pillar_that_turns_light_by_more_than_a_right_angle_is_doubted_as_far_as_t_can_lie():
    """The film that would be there without it is Fresnel's face and a way through air;
    its t and the pillar's lie 1.32
    to 1.85 apart. Two amplitudes of passive cells are at most 2 apart, and no error is
    larger."""
    for height, share in ((1.4, 0.32), (1.9, 0.32)):
        cell = Cell(0.4, height, Index(3.6), Index(1.45))
        film = 2 * math.sqrt(1.45) / 2.45 * np.exp(2j * math.pi / 0.85 * height)
        for orders in (1, 2, 3):
            found = rcwa.solve(cell, 0.4 * share, 0.85, harmonics=orders)
            assert 1.25 < abs(found.t - film) <= found.t_error <= 2.0


def test_each_diameter_stops_at_the_first_truncation_that_meets_the_tolerance(
    monkeypatch,
):
    """Truncations off by a / reach², a of 0.5 and 0.1, and 2e-4 left of a wall:
    reaches, counts and errors by hand.
    """
    size = {0.11: 0.5, 0.23: 0.1}
    this = SimpleNamespace(
        cell=CELL,
        k0=2 * math.pi / 0.85,
        symmetry="x",
        between=1.0,
        pillar=3.5,
        media=None,
        wavelength_um=0.85,
    )

    def truncated(this, diameters, reach, stages):
        assert stages == 3
        t = np.array([0.6 + size[round(float(d), 3)] / reach**2 for d in diameters])
        return TruncatedResponse(t.astype(complex), 0.2j * t, np.full(len(t), 0.99))

    monkeypatch.setattr(solver, "solve_truncated", truncated)
    empty = TruncatedResponse(np.array([0.97 + 0j]), np.array([0.03 + 0j]), np.ones(1))
    monkeypatch.setattr(solver, "film_response", lambda this, index: empty)
    monkeypatch.setattr(solver, "wall_stages", lambda this, wide, tolerance: (3, 2e-4))
    found = solver.solve_case(
        this, np.array([0.11, 0.23]), tolerance=0.015, harmonics=None
    )

    def error(a, reach):
        return (3 + 0.6 * max(0, 13 - reach)) * a * (
            1 / (reach - 4) ** 2 - 1 / reach**2
        ) + 2e-4

    for one, a in zip(found, (0.5, 0.1), strict=True):
        reach = next(n for n in (*range(8, 16), 16) if error(a, n) <= 0.015 or n == 16)
        assert one.t == pytest.approx(0.6 + a / reach**2)
        assert one.t_error == pytest.approx(error(a, reach), rel=1e-9)
        assert one.converged == (error(a, reach) <= 0.015)
        orders = sum(
            i * i + j * j <= reach**2
            for i in range(-reach, reach + 1)
            for j in range(-reach, reach + 1)
        )
        assert one.orders == orders
    assert (found[0].converged, found[1].converged) == (True, True)
    fixed = solver.solve_case(this, np.array([0.23]), tolerance=1e-9, harmonics=7)[0]
    assert fixed.t_error == pytest.approx(6.6 * 0.1 * (1 / 9 - 1 / 49) + 2e-4, rel=1e-9)
    assert not fixed.converged


def test_a_layer_without_contrast_is_a_film_to_rounding():
    """The disc's share of the cell times the contrast times its phase, below 1e-13."""
    this = SimpleNamespace(cell=CELL, k0=7.4, pillar=1.3, between=1.0)
    edge = math.sqrt(1e-13 / (math.pi / 4 * 0.69 * 7.4 * 0.5)) * 0.4
    assert solver.is_homogeneous(
        this, np.array([0.99 * edge, 1.01 * edge])
    ).tolist() == [True, False]


def test_anchored_bars_add_what_truncations_modes_collocation_and_shifts_leave(
    monkeypatch,
):
    """Mean of four neighbours; the farthest of them, half of the mean rest of four
    shifts, modes, stages.
    """
    t = {4: 0.61, 5: 0.58, 6: 0.604, 7: 0.597, 8: 0.601, 9: 0.5985}
    rest = {4: 0.05, 5: 0.004, 6: 0.006, 7: 0.002, 8: 0.003, 9: 0.0014}
    asked = []

    def truncated(this, diameter, reach, stages, *, moved):
        asked.append((reach, stages, float(moved(diameter)[0])))
        return TruncatedResponse(
            np.array([t[reach] + 0j]), np.array([0.1j * t[reach]]), np.array([0.98])
        )

    monkeypatch.setattr(anchored, "disc_case", lambda cell, light: cell)
    monkeypatch.setattr(anchored, "wall_stages", lambda *_: (5, 3e-4))
    monkeypatch.setattr(anchored, "solve_truncated", truncated)
    monkeypatch.setattr(
        anchored,
        "fit_diameter_shift",
        lambda bare, anchors, reach: anchored.DiameterShift(
            lambda d: 1e-3 * reach, rest[reach]
        ),
    )
    upright = [SimpleNamespace(t=0.6, r=0.06j, t_error=e) for e in (1e-4, 7e-4)]

    def bar(reach):
        last = np.array([t[k] for k in range(reach - 3, reach + 1)])
        mean = last.mean()
        return mean, np.abs(last - mean).max() + 0.5 * np.mean(
            [rest[k] for k in range(reach - 3, reach + 1)]
        ) + 1e-3

    for tolerance, reach in ((1e-1, 7), (bar(8)[1] * 1.001, 8), (1e-6, 9)):
        asked.clear()
        found = anchored.solve_anchored(CELL, 0.2, LIGHT, upright, tolerance=tolerance)
        assert asked[-1] == (reach, 5, pytest.approx(0.2 + 1e-3 * reach))
        mean, error = bar(reach)
        assert found.t == pytest.approx(mean, rel=1e-12)
        assert found.r == pytest.approx(0.1j * mean, rel=1e-12)
        assert found.t_error == pytest.approx(error, rel=1e-9)
        assert found.converged == (error <= tolerance)
        assert found.orders == {7: 149, 8: 197, 9: 253}[reach]


def test_a_shift_is_the_least_of_squares_of_both_amplitudes_and_leaves_what_no_shift_explains(
    monkeypatch,
):
    """Amplitudes that are straight in the diameter: the truncation's are those of
    pillars 3 + 20 D nm wider, and at
    right angles to all slopes 0.004 of t are off at one node and 0.003 at the other."""
    slope = np.array([1.3 + 0.4j, -0.7 + 0.9j])
    nodes, off = np.array([0.15, 0.21]), np.array([0.004, 0.003])
    across = 1j * np.array([1.3 + 0.4j, -0.7 + 0.9j]) / abs(1.3 + 0.4j)

    def amplitudes(bare, diameter, reach):
        return (diameter[:, None] - 0.003 - 0.02 * nodes[:, None]) * slope

    monkeypatch.setattr(anchored, "_amplitudes", amplitudes)
    known = nodes[:, None] * slope + off[:, None] * across
    found = anchored.fit_diameter_shift(None, ReferencePillars(nodes, known, 0.0), 6)
    assert found.at(nodes) == pytest.approx(0.003 + 0.02 * nodes, rel=1e-6)
    assert found(np.array([0.18])) == pytest.approx([0.18 + 0.003 + 0.0036], rel=1e-6)
    assert found.left == pytest.approx(math.sqrt((0.004**2 + 0.003**2) / 2), rel=1e-6)
    far = ReferencePillars(nodes, (nodes[:, None] + 0.5) * slope, 0.0)
    assert anchored.fit_diameter_shift(None, far, 6).at(nodes) == pytest.approx(
        [0.01, 0.01]
    )  # no truncation is that far off


@pytest.mark.parametrize("stages", [4, 6])
def test_collocation_integrates_polynomials_from_the_foot_to_every_point(stages):
    c, b, a = wall.gauss_collocation(stages)
    for n in range(2 * stages):
        assert b @ c**n == pytest.approx(1 / (n + 1), rel=1e-10)
        if n < stages:
            assert a @ c**n == pytest.approx(c ** (n + 1) / (n + 1), rel=1e-9)


@pytest.mark.parametrize(("tolerance", "stages"), [(1.0, 5), (4e-4, 7), (1e-9, 10)])
def test_stages_of_a_wall_are_enough_where_one_more_changes_a_tenth_of_the_tolerance(
    tolerance, stages
):
    """Off by 10^(1 - stages) of (1, 2): the last change is 2 (10^-(m-2) - 10^-(m-1))."""
    found, left = wall.choose_stage_count(
        lambda m: np.array([0.3, 0.7j]) + 10.0 ** (1 - m) * np.array([1.0, 2.0]),
        tolerance,
    )
    assert found == stages
    assert left == pytest.approx(
        2 * (10.0 ** (2 - stages) - 10.0 ** (1 - stages)), rel=1e-6
    )
    assert (left <= tolerance / 10) is (stages < 10)


def test_shifts_are_solved_at_chebyshev_s_diameters_between_foot_and_top():
    """A wall of 0.04 rad over 0.5 um: 0.2 um at half height, 20 nm more and less at its
    ends.
    """
    leaning = Cell(0.4, 0.5, Index(3.5), Index(1.45), sidewall_rad=0.04)
    half = math.tan(0.04) * 0.5
    want = [0.2 + half * math.cos(math.pi * (n + 0.5) / 4) for n in range(4)]
    assert anchored.node_diameters(leaning, 0.2) == pytest.approx(want, rel=1e-12)
    assert anchored.node_diameters(CELL, 0.2) == (0.2,)


@pytest.mark.parametrize(
    ("gap_um", "times", "wall_rad", "cut"),
    [
        (0.0019, 1 + 5 * (1 - 0.0019 / 0.008), 0.0, 0.0),
        (0.05, 1.0, 0.0, 0.0),
        (0.05, 1.0, 0.02, 3e-3),
    ],
)
def test_a_general_cell_s_bar_is_as_wide_as_its_truncations_lie_apart(
    monkeypatch, gap_um, times, wall_rad, cut
):
    """Truncations off by 0.1 / reach², trusted less where pillars all but touch, and
    what is left of a wall: each tells
    just what is left of the last one, 0.1 / 81."""
    cell = dataclasses.replace(CELL, sidewall_rad=wall_rad)

    def truncated(this, reach, stages):
        assert stages == (5 if wall_rad else 0)
        t = np.diag([0.6 + 0.1 / reach**2, 0.5j])
        return any_shape.JonesResponse(
            ("x", "y"), t, 0.2 * t, math.nan, np.ones(2), 0, False, ""
        )

    monkeypatch.setattr(any_shape, "_truncated", truncated)
    monkeypatch.setattr(
        any_shape.wall, "choose_stage_count", lambda both, tolerance: (5, 3e-3)
    )
    found = any_shape.jones(cell, 0.4 - gap_um, 0.85, harmonics=9, tolerance=1e-9)
    want = times * (5.4 * 0.1 / 81 + 1e-13) + cut
    assert found.t_error == pytest.approx(
        want, rel=1e-3
    )  # the gap between polygons is 3 pm wider
    assert not found.converged
    assert any_shape.jones(
        cell, 0.4 - gap_um, 0.85, harmonics=9, tolerance=1.001 * want
    ).converged


@pytest.mark.parametrize(("most", "want"), [(0.7, 2.0), (4.9, 5.9)])
def test_a_bar_is_no_wider_than_to_the_farthest_that_a_passive_cell_may_be(
    monkeypatch, most, want
):
    """Coarse truncations of a metal at a resonance give |t| = 4.9, whose true t, of
    size 1 at most, may be 5.9 away.
    """

    def truncated(this, reach, stages):
        t = np.diag([most * (-1) ** reach, 0.5j])
        return any_shape.JonesResponse(
            ("x", "y"), t, 0.2 * t, math.nan, np.ones(2), 0, False, ""
        )

    monkeypatch.setattr(any_shape, "_truncated", truncated)
    found = any_shape.jones(CELL, 0.2, 0.85, harmonics=9)
    assert found.t_error == pytest.approx(want, rel=1e-12)


@pytest.mark.parametrize(("most", "want"), [(0.7, 2.0), (4.9, 5.9)])
def test_a_round_pillar_s_bar_is_no_wider_either(monkeypatch, most, want):
    def truncated(this, diameter_um, reach, stages=0, **moved):
        t = np.full(len(diameter_um), most * (-1) ** reach + 0j)
        return TruncatedResponse(t, 0.2 * t, np.ones(len(diameter_um)))

    monkeypatch.setattr(solver, "solve_truncated", truncated)
    (found,) = solver.solve_case(
        disc_case(CELL, Incidence(0.85)), np.array([0.23]), tolerance=1e-3, harmonics=9
    )
    assert found.t_error == pytest.approx(want, rel=1e-12)


@pytest.mark.parametrize(
    ("angle_rad", "azimuth_rad", "upright", "tilted"),
    [(0, 0, 15, 10), (0.2, 0, 10, 7), (0.2, 0.5, 9, 6)],
)
def test_tilted_walls_climb_as_far_as_some_seconds_allow(
    monkeypatch, angle_rad, azimuth_rad, upright, tilted
):
    """Panels of five stages cost some hundred times a layer's modes: 15 orders took
    over a minute a solve.
    """
    asked = []

    def truncated(this, reach, stages):
        asked.append((reach, bool(stages)))
        t = np.eye(2) * (0.6 + 0.3 / reach)
        return any_shape.JonesResponse(
            ("x", "y"), t, t / 2, math.inf, np.ones(2), reach, False, ""
        )

    monkeypatch.setattr(any_shape, "_truncated", truncated)
    plain = Cell(0.4, 0.5, Index(3.5), Index(1.45), shape=Rectangle(0.6))
    light = {"angle_rad": angle_rad, "azimuth_rad": azimuth_rad}
    for cell, last in (
        (plain, upright),
        (dataclasses.replace(plain, sidewall_rad=0.05), tilted),
    ):
        asked.clear()
        rcwa.jones(cell, 0.2, 0.85, tolerance=1e-9, **light)
        assert asked[-1] == (last, cell is not plain)
        assert rcwa.most_harmonics(cell, 0.2, **light) == last
