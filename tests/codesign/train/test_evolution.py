"""Regularised evolution: finds the optimum of a known landscape, keeps the budget, goes
on exactly after a stop.
"""

import dataclasses
import json

import numpy as np
import pytest

from codesign.network import architecture as arch
from codesign.network import cost
from codesign.train import evolution
from codesign.train.evolution import EvaluatedCandidate, EvolutionSettings
from metalens.core.errors import ConfigError, TrainingError

SPACE = arch.SearchSpace()
TARGET = arch.sample_architecture(SPACE, np.random.default_rng(42))
PLAN = EvolutionSettings(population=12, tournament=4, rounds=200)


def _distance(architecture):
    """Entries that differ from a hidden target, over the slots that the target uses:
    zero only at the target.
    """
    used = [j < d for d in TARGET.depths for j in range(max(SPACE.depths))]
    pairs = zip(architecture.kernels, TARGET.kernels, used, strict=True)
    return float(
        sum(a != b for a, b in zip(architecture.depths, TARGET.depths, strict=True))
        + sum(a != b for a, b, u in pairs if u)
        + (architecture.width != TARGET.width)
    )


def _count(architecture):
    return float(cost.network_cost(SPACE, architecture).at(128))


def _run(plan=PLAN, budget=1e12, start=None, evaluate=_distance):
    return list(
        evolution.evolve_population(
            SPACE, plan, evaluate, _count, budget=budget, seed=1, start=start
        )
    )


def test_evolution_descends_a_known_landscape_below_random_search():
    generator = np.random.default_rng(7)
    drawn = min(
        _distance(arch.sample_architecture(SPACE, generator))
        for _ in range(PLAN.rounds)
    )
    found = evolution.best_candidate(_run()[-1].history).error
    assert found < 0.7 * drawn


def test_no_candidate_is_beyond_the_budget():
    budget = 3 * _count(arch.smallest_architecture(SPACE))
    assert (
        max(
            c.macs
            for c in _run(budget=budget, plan=EvolutionSettings(8, 2, 40))[-1].history
        )
        <= budget
    )


def test_a_stopped_search_goes_on_as_if_it_had_not_stopped():
    states = _run(plan=EvolutionSettings(8, 3, 30))
    middle = evolution.state_from_json(
        json.loads(json.dumps(evolution.state_to_json(states[12])))
    )
    assert _run(plan=EvolutionSettings(8, 3, 30), start=middle)[-1] == states[-1]


def test_candidates_born_together_do_not_know_of_each_other():
    """Four at once: the population of the first four births is the same as one at a
    time, and rounds are kept.
    """
    one = _run(plan=EvolutionSettings(8, 3, 30))
    four = _run(plan=EvolutionSettings(8, 3, 30, together=4))
    assert [len(s.history) for s in four] == [4, 8, 12, 16, 20, 24, 28, 30]
    # the first population is drawn, whoever is judged when
    assert four[1].history == one[7].history
    middle = evolution.state_from_json(evolution.state_to_json(four[3]))
    assert (
        _run(plan=EvolutionSettings(8, 3, 30, together=4), start=middle)[-1] == four[-1]
    )
    with pytest.raises(ConfigError, match="together = 0"):
        EvolutionSettings(together=0)


def test_equal_networks_are_evaluated_once():
    seen = []

    def count_calls(architecture):
        seen.append(arch.canonical_architecture(SPACE, architecture))
        return _distance(architecture)

    _run(plan=EvolutionSettings(8, 3, 60), evaluate=count_calls)
    assert len(seen) == len(set(seen))


def test_a_network_that_diverged_is_never_the_best():
    bad = EvaluatedCandidate(arch.smallest_architecture(SPACE), float("nan"), 1.0)
    good = EvaluatedCandidate(arch.largest_architecture(SPACE), 5.0, 2.0)
    assert evolution.best_candidate([bad, good]) == good


def test_budget_below_the_smallest_network_is_refused():
    with pytest.raises(TrainingError, match="below the smallest network"):
        _run(budget=1e5)


@pytest.mark.parametrize("share", [0.01, 0.03, 0.1, 0.3, 0.9])
def test_the_largest_network_uses_its_budget(share):
    """A finer pitch or a smaller budget takes resolution first, then depth and width;
    one pixel more may cost a third,
    where it adds a row to every late feature map.
    """
    budget = share * _at_resolution(arch.largest_architecture(SPACE))
    made, least = evolution.largest_and_smallest(SPACE, _at_resolution, budget)
    assert 0.65 * budget < _at_resolution(made) <= budget
    assert (
        len(set(made.kernels))
        == len(set(made.expansions))
        == len(set(made.depths))
        == 1
    )
    assert _at_resolution(least) <= budget
    assert least.resolution >= made.resolution
    assert dataclasses.replace(
        least, resolution=SPACE.resolution[0]
    ) == arch.smallest_architecture(SPACE)


def test_a_whole_search_is_the_end_of_its_states_and_public():
    import codesign

    plan = EvolutionSettings(4, 2, 12)
    assert (
        codesign.search(SPACE, plan, _distance, _count, budget=1e12, seed=1)
        == _run(plan)[-1].history
    )


def test_a_search_begins_with_the_networks_that_every_step_trains():
    budget = 20 * _at_resolution(arch.smallest_architecture(SPACE))
    found = evolution.search(
        SPACE,
        EvolutionSettings(2, 1, 2),
        _distance,
        _at_resolution,
        budget=budget,
        seed=1,
    )
    trained = evolution.sample_sandwich(
        SPACE, _at_resolution, budget, np.random.default_rng(0), subnets=0
    )
    assert [c.architecture for c in found] == trained


def _at_resolution(architecture):
    return float(cost.macs_of_size(SPACE, architecture, 128 * architecture.resolution))


def test_a_network_is_fitted_by_resolution_alone():
    space = SPACE
    count = _at_resolution
    top = arch.largest_architecture(SPACE)
    assert evolution.fit_resolution(space, top, count, 2 * count(top)) == top
    budget = 0.4 * count(top)
    made = evolution.fit_resolution(space, top, count, budget)
    # steps of a hundredth of the range, and of whole pixels
    assert 0.95 * budget < count(made) <= budget
    assert dataclasses.replace(made, resolution=1.0) == top
    least = evolution.fit_resolution(space, top, count, 1.0)
    assert least.resolution == pytest.approx(space.resolution[0])


@pytest.mark.parametrize("share", [1e-3, 0.03, 0.2, 0.6, 2.0])
def test_members_of_a_step_keep_the_budget_where_anything_does(share):
    space, count = SPACE, _at_resolution
    budget = share * count(arch.largest_architecture(space))
    members = evolution.sample_sandwich(
        space, count, budget, np.random.default_rng(1), subnets=6
    )
    assert len(members) == 8
    if budget >= count(arch.smallest_architecture(space)):
        assert all(count(a) <= budget for a in members)
    else:
        assert all(a == arch.smallest_architecture(space) for a in members)
    if share == 2.0:
        assert members[0] == arch.largest_architecture(space)
    free = evolution.sample_sandwich(
        space, count, 0.0, np.random.default_rng(1), subnets=6
    )
    assert free[:2] == [
        arch.largest_architecture(space),
        arch.smallest_architecture(space),
    ]
