"""The climb of a free-form design by objectives whose steps are known, and splines by
scipy's.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from metalens.design.free_form import search
from metalens.design.free_form.objective import AxialObjective, Robust, Score
from metalens.design.free_form.settings import Fisher, Variation
from metalens.design.profiles import Focus
from metalens.image import Pupil
from metalens.image import pupil as pupils

FOCUS = Focus(0.81, 1700.0, 21e3)
PUPIL = Pupil(210.0, 1700.0, 0.81, 24)
rng = np.random.default_rng(8)


def basis(position, count):
    """Cubic B-splines of uniform knots whose sums fill [-1, 1]."""
    knots = -1 + (np.arange(count + 4) - 3) * 2 / (count - 3)
    return BSpline.design_matrix(np.clip(position, -1, 1), knots, 3).toarray()


@pytest.mark.parametrize("count", [4, 5, 9])
def test_splines_are_those_of_scipy_and_are_held_beyond_the_ends(count):
    place = np.array([-1.7, -1.0, -0.999, -0.31, 0.0, 0.37, 0.5, 0.86, 1.0, 1.3])
    assert np.abs(search.spline(place, count) - basis(place, count)).max() < 1e-13
    assert search.spline(np.array([1.0, -1.0]), count)[:, -4:].round(12).tolist()[
        0
    ] == pytest.approx([0, 1 / 6, 4 / 6, 1 / 6], abs=1e-11)


def test_halves_between_knots_have_the_weights_of_the_books():
    """1/48, 23/48, 23/48, 1/48 half way, 1/6, 4/6, 1/6 on a knot."""
    got = search.spline(np.array([0.25, 0.5]), 7)  # four pieces of 0.5
    assert got[0] * 48 == pytest.approx([0, 0, 1, 23, 23, 1, 0], abs=1e-12)
    assert got[1] * 6 == pytest.approx([0, 0, 0, 1, 4, 1, 0], abs=1e-12)


def test_a_smooth_part_is_the_tensor_product_of_rows_down_and_columns_across():
    controls, x, y = (
        rng.normal(size=(6, 6)),
        np.array([-199.0, 17.0, 60.0, 230.0]),
        np.array([-260.0, 88.0, 3.0]),
    )
    want = np.einsum("yi,ij,xj->yx", basis(y / 210.0, 6), controls, basis(x / 210.0, 6))
    assert search.free_form(controls, PUPIL)(x, y) == pytest.approx(want, abs=1e-12)


def test_cells_are_equal_parts_of_direction_cosines_and_go_on_beyond_the_last():
    """Node k of 24 from (k - 12) / 12 of the rim's cosine on; x / √(x² + y² + d²) of a
    place, d below the rim.
    """
    near, controls, edge = (
        Pupil(210.0, 190.0, 0.81, 24),
        rng.normal(size=(24, 24)),
        210.0 / math.hypot(210.0, 190.0),
    )
    x, y = (
        np.array([-209.0, -52.0, 4.0, 137.0, 600.0]),
        np.array([-800.0, -33.0, 71.0, 190.0]),
    )
    path = np.sqrt(x**2 + y[:, None] ** 2 + 190.0**2)
    column = np.clip(np.floor((x / path / edge + 1) * 12), 0, 23).astype(int)
    row = np.clip(np.floor((y[:, None] / path / edge + 1) * 12), 0, 23).astype(int)
    assert column[:, 3].tolist() == [14, 21, 21, 19]
    assert (row.min(), row.max(), column.max()) == (0, 23, 23)
    assert np.array_equal(
        search.free_form(controls, near, cells=True)(x, y), controls[row, column]
    )


@pytest.mark.parametrize("zones", [1, 3])
def test_rings_of_equal_areas_carry_one_three_and_five_turns(zones):
    """Borders at √(1/3) and √(2/3) of 60: 34.641 and 48.990; inside and beyond the rim
    as in the nearest ring.
    """
    for radius, turns in (
        (0.0, 1),
        (34.64, 1),
        (34.65, 3),
        (48.98, 3),
        (49.0, 5),
        (60.0, 5),
        (77.0, 5),
    ):
        x, y = radius * math.cos(0.6), radius * math.sin(0.6)
        got = search.vortices(
            np.array([x]), np.array([[y]]), radius_um=60.0, zones=zones
        )
        assert float(got[0, 0]) == pytest.approx(
            (turns if zones == 3 else 1) * 0.6 * (radius > 0), abs=1e-12
        )
    flat = search.vortices(np.zeros(3), np.ones((2, 1)), radius_um=60.0, zones=0)
    assert flat.shape == (2, 3)
    assert not flat.any()


def test_phases_on_nodes_are_the_spline_on_its_vortices():
    x, y = (a.numpy() for a in pupils.coordinates(PUPIL))
    controls = rng.normal(size=(5, 5))
    rows, columns = basis(y.ravel() / 210.0, 5), basis(x.ravel() / 210.0, 5)
    want = np.einsum("ni,ij,nj->n", rows, controls, columns).reshape(24, 24)
    turns = np.where(x**2 + y**2 <= 210.0**2 / 2, 1, 3) * np.arctan2(y, x)
    score = Score(torch.ones(1), torch.ones(1))
    made = search.FisherPhase(
        torch.from_numpy(controls), 21e3, 2, False, score, (), True, ""
    )
    assert search.phase_on(PUPIL, made).numpy() == pytest.approx(
        want + turns, abs=1e-11
    )
    plain = dataclasses.replace(made, zones=0)
    assert search.phase_on(PUPIL, plain).numpy() == pytest.approx(want, abs=1e-11)
    nodes = torch.from_numpy(rng.normal(size=(24, 24)))
    cells = dataclasses.replace(made, controls=nodes, cells=True)
    assert search.phase_on(PUPIL, cells).numpy() == pytest.approx(
        nodes.numpy() + turns, abs=1e-12
    )


def test_a_finer_grid_holds_the_same_phase():
    """Exactly where its knots are those of the coarser one and more: 3 pieces in 6 and
    in 9.
    """
    coarse, place = torch.from_numpy(rng.normal(size=(6, 6))), np.linspace(-1, 1, 37)
    want = basis(place, 6) @ coarse.numpy() @ basis(place, 6).T
    for grid in (9, 12):
        fine = search._refined(coarse, grid)
        assert fine.shape == (grid, grid)
        assert basis(place, grid) @ fine.numpy() @ basis(
            place, grid
        ).T == pytest.approx(want, abs=1e-9)


def test_knots_that_do_not_fit_are_as_near_as_can_be():
    """Six coefficients for a random phase of five: two pieces in three are within 2 %
    of one another, and so are least
    squares over other places."""
    coarse, place = torch.from_numpy(rng.normal(size=(5, 5))), np.linspace(-1, 1, 1001)
    change = np.linalg.lstsq(basis(place, 6), basis(place, 5), rcond=None)[0]
    best = basis(place, 6) @ change - basis(place, 5)
    fine = search._refined(coarse, 6).numpy()
    few = place[::50]
    want = basis(few, 5) @ coarse.numpy() @ basis(few, 5).T
    back = np.linalg.lstsq(
        np.kron(basis(few, 6), basis(few, 6)), want.ravel(), rcond=None
    )[0]
    assert np.abs(best).max() < 0.02
    assert np.abs(fine.ravel() - back).max() < 0.02 * np.abs(back).max()


@pytest.mark.parametrize(
    ("radius", "window", "nodes"),
    [(230.0, 225.0, 160), (230.0, 230.0, 176), (91.0, 60.0, 64), (230.0, 100.0, 80)],
)
def test_nodes_hold_1_9_windows_in_blocks_of_16(radius, window, nodes):
    """2 · 0.17422 / 0.94 · 1.9 · 225 = 158.5, and 162.0 for 230; 70.4 for 100."""
    focus = Focus(0.94, 1300.0, 17e3)
    settings = dataclasses.replace(Fisher().about(focus, radius), window_um=window)
    made = search.design_pupil(focus, radius, settings)
    assert (made.radius_um, made.sensor_distance_um, made.wavelength_um) == (
        radius,
        1300.0,
        0.94,
    )
    assert made.nodes == nodes
    assert (
        nodes == 64
        or made.period_um >= 1.9 * window > made.period_um * (nodes - 16) / nodes
    )


def settings(**more):
    asked = {"grids": (5,), "iterations": 7, "encircled": 0.5, "spread_rad": 0.4} | more
    return Fisher(**asked).about(FOCUS, 210.0)


@pytest.mark.parametrize(
    ("variation", "kind"),
    [
        (Variation(), AxialObjective),
        (Variation(phase=0.01), Robust),
        (Variation(distance_um=3.0), Robust),
    ],
)
def test_either_variation_makes_the_design_robust(monkeypatch, variation, kind):
    seen = []

    def climbed(pupil, asked, objective, focus_um, zones, generator):
        seen.append(objective)
        score = Score(torch.ones(2), torch.ones(2))
        return search.FisherPhase(
            torch.zeros(4, 4), focus_um, zones, False, score, (), True, ""
        )

    monkeypatch.setattr(search, "_climb", climbed)
    search.optimise(PUPIL, settings(starts=1, variation=variation))
    assert type(seen[0]) is kind


def test_the_whole_phase_is_its_focus_its_vortices_and_its_free_form(monkeypatch):
    """-k (√(r² + d²) - d + √(r² + z²) - z) for the source that was found, not the
    design's.
    """
    controls = torch.from_numpy(rng.normal(size=(6, 6)))
    score = Score(torch.ones(2), torch.ones(2))
    made = search.FisherPhase(controls, 17e3, 2, False, score, (), True, "")
    seen = []

    def optimised(pupil, asked, *, objective):
        seen.append((pupil, asked, objective))
        return made

    monkeypatch.setattr(search, "optimise", optimised)
    phase, found = search.fisher_profile(
        FOCUS, radius_um=210.0, settings=Fisher(grids=(6,)), objective="given"
    )
    assert found is made
    pupil, asked, objective = seen[0]
    assert objective == "given"
    assert (asked.grids, asked.focus_mm) == (
        (6,),
        Fisher().about(FOCUS, 210.0).focus_mm,
    )
    assert pupil == search.design_pupil(FOCUS, 210.0, asked)
    x, y = np.array([-130.0, 20.0, 55.0]), np.array([-61.0, 149.0])
    r2 = x**2 + y[:, None] ** 2
    path = sum(np.sqrt(r2 + z**2) - z for z in (1700.0, 17e3))
    turns = np.where(r2 < 210.0**2 / 2, 1, 3) * np.arctan2(y[:, None], x)
    spline = np.einsum(
        "yi,ij,xj->yx", basis(y / 210.0, 6), controls.numpy(), basis(x / 210.0, 6)
    )
    assert phase(x, y) == pytest.approx(
        -2 * math.pi / 0.81 * path + turns + spline, abs=1e-7
    )


class Known:
    """Minus or plus the mean of the controls' phase as loss, by a list of slopes;
    energy by the mean phase.
    """

    def __init__(self, slopes, energy=lambda mean: 0.9 + 0 * mean, encircled=0.93):
        self.slopes, self.energy, self.encircled = slopes, energy, encircled
        self.asked, self.judged = [], []

    def loss(self, phase_rad, focus_um, generator):
        slope = self.slopes[len(self.asked) % len(self.slopes)]
        self.asked.append((phase_rad.detach(), focus_um, generator))
        return slope * phase_rad.sum(), self.energy(phase_rad.mean()).reshape(1)

    def judge(self, phase_rad, focus_um):
        self.judged.append((len(self.asked), phase_rad, focus_um))
        return Score(
            torch.tensor([float(len(self.judged))]), torch.tensor([self.encircled])
        )


def climb(objective, zones=0, seed=3, **more):
    made = settings(**more)
    begun = search._begun(made, zones, torch.Generator().manual_seed(seed))
    return begun, search._climb(
        PUPIL, made, objective, 19e3, zones, torch.Generator().manual_seed(seed)
    )


def test_even_slopes_take_steps_that_fall_by_half_a_cosine():
    """Adam's step is its rate where the slope stays: 0.15 (n / 2 + 1 / 2) + 0.002 n in
    n = 7 steps, 0.628 rad.
    """
    known = Known([2.7])
    begun, made = climb(known)
    assert (begun - made.controls).numpy() == pytest.approx(
        0.15 * 4 + 0.014, rel=1e-6
    )  # ε of 1e-8 by slopes of 1
    assert len(known.asked) == 7
    assert [seen for seen, *_ in known.judged] == [7]
    assert {focus for _, focus, _ in known.asked} == {19e3}
    assert known.judged[0][2] == 19e3
    assert torch.equal(known.judged[0][1], search.phase_on(PUPIL, made))
    assert (made.focus_um, made.zones, made.cells, made.starts) == (19e3, 0, False, ())
    assert made.converged
    assert made.reason == "encircled energy kept at every depth"


def test_free_nodes_take_larger_steps():
    """0.5 in place of 0.15, from a grid of four that is left at once after its one
    iteration of 8.
    """
    known = Known([2.7])
    begun, made = climb(known, grids=(4, 0), iterations=8)
    assert made.cells
    assert made.controls.shape == (24, 24)
    first = begun - 0.152
    rates = [
        0.5 * (0.5 + 0.5 * math.cos(math.pi * done / 8)) + 0.002 for done in range(1, 8)
    ]
    want = search.phase_on(
        PUPIL, dataclasses.replace(made, controls=first, cells=False)
    ).numpy() - sum(rates)
    assert made.controls.numpy() == pytest.approx(want, rel=1e-6)


def test_the_memory_of_steps_is_nine_tenths_and_of_squares_ninety_nine_hundredths():
    """Slopes 1, -3: means (0.9 · 0.1 - 0.3) / 0.19 and (0.99 · 0.01 + 0.09) / 0.0199;
    rates 0.152 and 0.077.
    """
    begun, made = climb(Known([1.0, -3.0]), iterations=2)
    second = (0.09 - 0.3) / 0.19 / math.sqrt((0.0099 + 0.09) / 0.0199)
    assert (begun - made.controls).numpy() == pytest.approx(
        0.152 + 0.077 * second, rel=1e-5
    )


def test_helices_carry_their_vortices_and_begin_with_a_tenth():
    known = Known([0.0])
    begun, made = climb(known, zones=2, iterations=1)
    assert float(begun.std()) < 0.06
    assert (made.zones, made.controls) == (2, pytest.approx(begun))
    assert torch.equal(known.asked[0][0], search.phase_on(PUPIL, made))
    assert torch.equal(known.judged[0][1], search.phase_on(PUPIL, made))


@pytest.mark.parametrize(("has", "moves"), [(0.5095, True), (0.5105, False)])
def test_a_hundredth_more_energy_is_asked_for_than_is_held(has, moves):
    """Energy that grows with the mean phase is climbed where it is below 0.51."""
    known = Known([0.0], energy=lambda mean: has + 1e-9 * (mean - mean.detach()))
    begun, made = climb(known, iterations=1)
    assert bool((made.controls > begun).all()) is moves
    assert torch.equal(made.controls, begun) is not moves


def test_penalties_grow_over_all_iterations_and_margins_follow_the_looks(monkeypatch):
    """Looks at 20, 40 and 43: 0.43 of energy, 0.07 less than 0.5, adds 0.35 (0.0015 +
    0.07) = 0.025025 to 0.01, and
    once more up to 0.05."""
    told, penalty = [], search._penalty

    def watched(missing, share):
        told.append((float(missing.detach()), share))
        return penalty(missing, share)

    monkeypatch.setattr(search, "_penalty", watched)
    known = Known([1.0], energy=lambda mean: 0.47 + 0 * mean, encircled=0.43)
    _, made = climb(known, iterations=43)
    assert [seen for seen, *_ in known.judged] == [20, 40, 43]
    assert [share for _, share in told] == pytest.approx(
        [n / 43 for n in range(43)], rel=1e-12
    )
    want = [0.04] * 20 + [0.065025] * 20 + [0.08] * 3
    assert [missing for missing, _ in told] == pytest.approx(want, rel=1e-6)
    assert not made.converged
    assert made.reason == "encircled energy missed: raise iterations"
    assert float(made.score.information) == 3.0


def test_only_the_last_grid_is_judged_and_stages_go_on_where_the_former_ended():
    """Grids of 6 and 12 share 21 iterations 7 to 14; judged at 20 and 21, not at the
    end of the first.
    """
    known = Known([0.0])
    _, made = climb(known, grids=(6, 12), iterations=21)
    assert len(known.asked) == 21
    assert [seen for seen, *_ in known.judged] == [20, 21]
    assert made.controls.shape == (12, 12)
    first, last = known.asked[0][0].numpy(), known.asked[-1][0].numpy()
    assert last == pytest.approx(first, abs=1e-9)
    same = climb(Known([0.0]), grids=(6, 6), iterations=4)
    assert torch.equal(same[0], same[1].controls)


def test_generators_reach_the_objective():
    known = Known([1.0])
    made = settings(iterations=2)
    generator = torch.Generator().manual_seed(1)
    search._climb(PUPIL, made, known, 19e3, 0, generator)
    assert all(passed is generator for *_, passed in known.asked)


def test_a_refinement_starts_from_the_best_and_is_judged_last():
    """No slope of the climb; refining a slope of 1 goes to its reach of half a radian
    below.
    """
    known = Known([0.0])

    def loss(phase_rad, focus_um, generator):
        known.asked.append((phase_rad.detach(), focus_um, generator))
        return (
            phase_rad.sum() * (generator is None)
        ), 0.9 + 0 * phase_rad.mean().reshape(1)

    known.loss = loss
    begun, made = climb(known, iterations=3, refine=9)
    assert [focus for _, focus, _ in known.asked] == [19e3] * len(known.asked)
    assert len(known.judged) == 2
    assert made.controls.numpy() == pytest.approx(begun.numpy() - 0.5, abs=1e-6)
