"""Steps, penalties, margins and starts of the climb, number by number."""

import math
from types import SimpleNamespace

import pytest
import torch

from metalens.design.free_form import search
from metalens.design.free_form.refine import refine
from metalens.design.free_form.settings import Fisher


def test_steps_fall_by_half_a_cosine_to_two_milliradians():
    """Of 300 iterations: none, a third (cos 60° = 1/2), half, two thirds, all."""
    got = [search._rate(0.4, done, 300) for done in (0, 100, 150, 200, 300)]
    assert got == pytest.approx([0.402, 0.302, 0.202, 0.102, 0.002], rel=1e-12)


def test_missing_energy_counts_by_its_mean_and_eight_times_its_mean_square_five_times_as_much_at_the_end():
    missing = torch.tensor(
        [0.0, 0.03, 0.06], dtype=torch.float64
    )  # mean 0.03, mean square 0.0015
    for share, strength in ((0.0, 10), (0.25, 20), (1.0, 50)):
        assert float(search._penalty(missing, share)) == pytest.approx(
            strength * (0.03 + 8 * 0.0015), rel=1e-12
        )


def test_the_margin_follows_what_there_is_to_spare_within_its_limits():
    assert search._margin(0.01, 0.0015) == pytest.approx(0.01)  # just enough
    assert search._margin(0.01, -0.0185) == pytest.approx(
        0.017
    )  # 0.02 too little: 0.35 of it
    assert search._margin(0.01, 0.0215) == pytest.approx(0.003)
    assert (search._margin(0.045, -0.1), search._margin(-0.02, 0.1)) == (0.05, -0.03)


def test_iterations_are_shared_by_the_size_of_the_grids():
    """Nodes count as a grid of 160; what division leaves goes to the last stage."""
    assert search._shares(Fisher(grids=(6, 10, 20), iterations=100)) == [16, 27, 57]
    assert search._shares(Fisher(grids=(8, 32, 0), iterations=500)) == [20, 80, 400]
    assert search._shares(Fisher(grids=(39, 0), iterations=500)) == [97, 403]  # 97.99
    assert search._shares(Fisher(grids=(4, 60, 60), iterations=30)) == [1, 14, 15]
    assert search._shares(Fisher(grids=(6, 6, 6), iterations=2)) == [1, 1, 1]


@pytest.mark.parametrize(("zones", "spread"), [(0, 2.3), (4, 0.23)])
def test_a_climb_begins_with_the_spread_that_was_asked_for(zones, spread):
    generator = torch.Generator().manual_seed(3)
    begun = search._begun(Fisher(grids=(50, 0), spread_rad=2.3), zones, generator)
    assert begun.shape == (50, 50)
    assert float(begun.std()) == pytest.approx(
        spread, rel=4 / math.sqrt(2 * 2500)
    )  # four sigma


def test_the_best_iterate_keeps_the_energy_first_and_then_has_most_information():
    """Energy within 5e-4 of what is asked for is kept; what was kept is not given up
    for information.
    """
    told = [
        (3.0, 0.70),
        (5.0, 0.69),
        (2.0, 0.7996),
        (9.0, 0.7994),
        (1.9, 0.83),
        (2.1, 0.81),
    ]
    seen = [
        SimpleNamespace(
            information=torch.tensor([i - 0.5, i + 0.5]),
            encircled=torch.tensor([e + 0.1, e]),
        )
        for i, e in told
    ]
    judged = iter(seen)
    best = search._Best(
        SimpleNamespace(judge=lambda phase, focus: next(judged)),
        SimpleNamespace(encircled=0.8),
        2e4,
    )
    kept = []
    for number, (_, energy) in enumerate(told):
        spare = best.look(torch.full((2, 2), float(number)), torch.zeros(3))
        assert spare == pytest.approx(energy - 0.8, abs=1e-6)
        kept.append(int(best.controls[0, 0]))
        assert best.score is seen[kept[-1]]
    assert kept == [0, 1, 2, 2, 2, 5]


def test_starts_lie_evenly_in_the_range_of_foci_with_zones_in_turn(monkeypatch):
    """Three starts from 20 to 32 mm: at 22, 26 and 30, each with numbers of its own."""
    asked, told = [], iter([(False, 9.0, 0.7), (True, 4.0, 0.82), (True, 5.0, 0.81)])

    def climb(pupil, settings, objective, focus_um, zones, generator):
        asked.append((focus_um, zones, generator.initial_seed()))
        converged, information, energy = next(told)
        score = search.Score(
            torch.tensor([information + 1, information - 1]),
            torch.tensor([energy, energy + 0.1]),
        )
        return search.FisherPhase(
            torch.full((1,), focus_um), focus_um, zones, False, score, (), converged, ""
        )

    monkeypatch.setattr(search, "_climb", climb)
    settings = Fisher(starts=3, focus_mm=(20.0, 32.0), zones=(0, 5), seed=7)
    found = search.optimise(None, settings, objective="told")
    assert asked == [
        (pytest.approx(22e3), 0, 7000),
        (pytest.approx(26e3), 5, 7001),
        (pytest.approx(30e3), 0, 7002),
    ]
    assert found.focus_um == pytest.approx(
        30e3
    )  # the most information of those that converged
    assert found.starts == (
        (9.0, pytest.approx(0.7)),
        (4.0, pytest.approx(0.82)),
        (5.0, pytest.approx(0.81)),
    )


def test_refining_goes_to_the_least_within_half_a_radian_where_the_energy_allows():
    """A parabola about (1, 2, -0.2, 0.3). Energy 0.9 - x₀ / 2 is asked to be 0.7: x₀ up
    to 0.4, less 0.002 of a margin
    of 1e-3; x₁ from 0.1 on stops at its reach; the others arrive. A start that keeps no
    energy is not kept either."""
    least = torch.tensor([[1.0, 2.0], [-0.2, 0.3]], dtype=torch.float64)

    def loss(phase, focus_um, generator):
        assert (focus_um, generator) == (2e4, None)
        return 3 * ((phase - least) ** 2).sum(), torch.stack(
            [0.9 - phase[0, 0] / 2, 0.95 + 0 * phase[0, 0]]
        )

    settings = SimpleNamespace(encircled=0.7, refine=60)
    start = torch.tensor([[0.0, 0.1], [0.05, -0.1]], dtype=torch.float64)
    found = refine(
        start, lambda controls: controls, SimpleNamespace(loss=loss), settings, 2e4
    )
    assert found.shape == (2, 2)
    assert 0.396 < float(found[0, 0]) < 0.4 + 1e-9
    assert float(found[0, 1]) == pytest.approx(0.6, abs=1e-9)
    assert found[1].tolist() == pytest.approx([-0.2, 0.3], abs=2e-3)  # 60 evaluations
    lost = start + torch.tensor([[0.45, 0.0], [0.0, 0.0]], dtype=torch.float64)
    again = refine(
        lost, lambda controls: controls, SimpleNamespace(loss=loss), settings, 2e4
    )
    assert float(again[0, 0]) < 0.4 + 1e-9
