"""Regularised evolution over architectures under a compute budget, with ageing (Real et
al. 2019), and Pareto sets.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from codesign.batches import parallel
from codesign.network import (
    Architecture,
    SearchSpace,
    canonical_architecture,
    largest_architecture,
    mutate_architecture,
    sample_architecture,
    smallest_architecture,
)
from codesign.settings import LARGEST, check_ranges
from metalens.core.errors import TrainingError


@dataclass(frozen=True, slots=True)
class EvaluatedCandidate:
    """An evaluated architecture: ``error`` is to be small, ``macs`` within the budget."""

    architecture: Architecture
    error: float
    macs: float


@dataclass(frozen=True, slots=True)
class EvolutionSettings:
    """Settings of the search.

    population: members alive; the oldest dies with every birth.
    tournament: members that compete to be the parent.
    rounds: evaluations in all, the first population included.
    inner_steps: of the inner optimisation of Eq. 10: optics, pitch and weights of every
    candidate, from those of the supernet, before it is judged. 0 judges candidates with
    the supernet's weights behind one lens and pitch.
    mutation: chance that one entry changes.
    together: candidates that are born before any of them is judged, so that the
    processes of ``torchrun`` can share
        them. The result depends on this number, not on how many processes there are.
    """

    population: int = 16
    tournament: int = 4
    rounds: int = 64
    mutation: float = 0.15
    together: int = 1
    inner_steps: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            inner_steps=(0, LARGEST),
            together=(1, LARGEST),
            population=(1, self.rounds),
            tournament=(1, self.population),
        )


@dataclass(frozen=True, slots=True)
class EvolutionState:
    """State of a search: everything that is needed to go on after a stop.

    history: every candidate in order of birth; the last ``population`` are alive.
    generator: state of the random generator.
    """

    history: tuple[EvaluatedCandidate, ...] = ()
    generator: dict[str, Any] = field(default_factory=dict)


Count = Callable[[Architecture], float]


def evolve_population(
    space: SearchSpace,
    plan: EvolutionSettings,
    evaluate: Count,
    count: Count,
    *,
    budget: float,
    seed: int,
    start: EvolutionState | None = None,
) -> Iterator[EvolutionState]:
    """Regularised evolution: the search state after every round of births.

    Passing the last state as ``start`` continues exactly where the search stopped. The
    first two candidates are those that :func:`sample_sandwich` trains at every step
    (:func:`largest_and_smallest`).

    Args:
        space: architectures to choose from. plan: of the search.
        evaluate: error of an architecture; each different network is evaluated once.
        count: multiply-accumulates of an architecture; only candidates within
            ``budget`` are evaluated.
        seed: of the random generator. start: state to continue from.

    Raises:
        TrainingError: the smallest network of the space is beyond the budget.
    """
    least = count(smallest_architecture(space))
    if least > budget:
        raise TrainingError(
            f"budget of {budget / 1e6:g} MMACs is below the smallest network, {least / 1e6:.1f} MMACs; "
            "raise the budget or the pixel pitch"
        )
    state = start or EvolutionState(
        generator=dict(np.random.default_rng(seed).bit_generator.state)
    )
    errors = {
        canonical_architecture(space, c.architecture): c.error for c in state.history
    }
    while len(state.history) < plan.rounds:
        generator = np.random.default_rng()
        generator.bit_generator.state = state.generator
        evaluated = len(state.history)
        births = min(plan.together, plan.rounds - evaluated)
        newborn: list[Architecture] = []
        if evaluated < 2:
            extremes = largest_and_smallest(space, count, budget)
            newborn += extremes[evaluated : evaluated + births]
        while len(newborn) < births:
            newborn.append(
                _next_candidate(space, plan, state, count, budget, generator)
            )
        new_networks = {
            canonical_architecture(space, a): a
            for a in newborn
            if canonical_architecture(space, a) not in errors
        }
        values = parallel.share_work(evaluate, list(new_networks.values()))
        errors |= dict(zip(new_networks, values, strict=True))
        candidates = (
            EvaluatedCandidate(
                a, errors[canonical_architecture(space, a)], float(count(a))
            )
            for a in newborn
        )
        state = EvolutionState(
            (*state.history, *candidates), dict(generator.bit_generator.state)
        )
        yield state


def search(
    space: SearchSpace,
    plan: EvolutionSettings,
    evaluate: Count,
    count: Count,
    *,
    budget: float,
    seed: int,
) -> tuple[EvaluatedCandidate, ...]:
    """A whole search: every candidate in order of birth (:func:`best_candidate`).

    Args:
        plan: of the search. evaluate: error of an architecture.
        count: multiply-accumulates of an architecture. seed: of the random generator.

    Raises:
        TrainingError: the smallest network of the space is beyond the budget.
    """
    *_, last = evolve_population(space, plan, evaluate, count, budget=budget, seed=seed)
    return last.history


def _next_candidate(
    space: SearchSpace,
    plan: EvolutionSettings,
    state: EvolutionState,
    count: Count,
    budget: float,
    generator: np.random.Generator,
) -> Architecture:
    """The next architecture: random while the first population grows, later a mutation.

    The parent is the best of a random tournament of the living; of equal errors the
    cheapest. Where no draw is within the budget: the smallest network, or the parent.
    """
    if len(state.history) < plan.population:
        drawn = _draw_within_budget(
            lambda: sample_architecture(space, generator), count, budget
        )
        return drawn or smallest_architecture(space)
    alive = state.history[-plan.population :]
    rivals = generator.choice(len(alive), plan.tournament, replace=False)
    parent = best_candidate([alive[i] for i in rivals]).architecture
    child = _draw_within_budget(
        lambda: mutate_architecture(space, parent, generator, rate=plan.mutation),
        count,
        budget,
    )
    return child or parent


def _draw_within_budget(
    draw: Callable[[], Architecture], count: Count, budget: float, *, tries: int = 200
) -> Architecture | None:
    """First drawn architecture within the budget; None after ``tries`` draws beyond
    it.
    """
    for _ in range(tries):
        drawn = draw()
        if count(drawn) <= budget:
            return drawn
    return None


def best_candidate(candidates: Sequence[EvaluatedCandidate]) -> EvaluatedCandidate:
    """The candidate of least error; of equals, the cheapest.

    Args:
        candidates: with error and cost.
    """
    return min(candidates, key=lambda c: (not np.isfinite(c.error), c.error, c.macs))


def sample_sandwich(
    space: SearchSpace,
    count: Count,
    budget: float,
    generator: np.random.Generator,
    *,
    subnets: int,
) -> list[Architecture]:
    """Members of one training step: the largest, the smallest and ``subnets`` random
    members.

    With a budget above 0 each has the highest resolution that the budget allows
    (:func:`largest_and_smallest`), so that training sees what the search can choose. A
    draw that does not fit within 20 tries is replaced by the smallest.

    Args:
        space: architectures to choose from.
        count: multiply-accumulates of an architecture. budget: of them; 0 for none.
        generator: of the draws. subnets: random members.
    """
    if not budget:
        return [
            largest_architecture(space),
            smallest_architecture(space),
            *(sample_architecture(space, generator) for _ in range(subnets)),
        ]
    large, small = largest_and_smallest(space, count, budget)
    drawn = [
        _draw_within_budget(
            lambda: fit_resolution(
                space, sample_architecture(space, generator), count, budget
            ),
            count,
            budget,
            tries=20,
        )
        for _ in range(subnets)
    ]
    return [large, small, *(member or small for member in drawn)]


def largest_and_smallest(
    space: SearchSpace, count: Count, budget: float
) -> tuple[Architecture, Architecture]:
    """The largest uniform network that fits at any resolution, and the smallest
    network.

    Both at the highest resolution that the budget allows; the smallest at least
    resolution where nothing fits.

    Args:
        space: architectures to choose from.
        count: multiply-accumulates of an architecture. budget: of them.
    """
    largest, smallest = largest_architecture(space), smallest_architecture(space)
    shallow = dataclasses.replace(largest, depths=smallest.depths)
    small = fit_resolution(space, smallest, count, budget)
    # equal in all stages: by width, then depth, then kernel and expansion
    fitted = (
        fit_resolution(space, dataclasses.replace(base, width=width), count, budget)
        for width in sorted(space.widths, reverse=True)
        for base in (largest, shallow, smallest)
    )
    large = next((a for a in fitted if count(a) <= budget), small)
    return large, small


def fit_resolution(
    space: SearchSpace, architecture: Architecture, count: Count, budget: float
) -> Architecture:
    """The architecture at the highest resolution that the budget allows, by bisection.

    At the least resolution if none is within the budget.

    Args:
        space: architectures to choose from.
        count: multiply-accumulates of an architecture. budget: of them.
    """
    low, high = space.resolution
    largest = dataclasses.replace(architecture, resolution=high)
    if count(largest) <= budget:
        return largest
    for _ in range(7):  # to a hundredth of the range
        middle = (low + high) / 2
        fits = count(dataclasses.replace(architecture, resolution=middle)) <= budget
        low, high = (middle, high) if fits else (low, middle)
    return dataclasses.replace(architecture, resolution=low)


def state_to_json(search: EvolutionState) -> dict[str, Any]:
    """The state as a table for JSON.

    Args:
        search: with its history.
    """
    history = [candidate_to_json(c) for c in search.history]
    return {"history": history, "generator": search.generator}


def candidate_to_json(candidate: EvaluatedCandidate) -> dict[str, Any]:
    """Architecture sizes, error and cost of a ``candidate`` for the state's JSON."""
    sizes = dataclasses.asdict(candidate.architecture)
    return {**sizes, "error": candidate.error, "macs": candidate.macs}


def state_from_json(table: dict[str, Any]) -> EvolutionState:
    """State from its table.

    Args:
        table: of :func:`state_to_json`.
    """
    history = tuple(candidate_from_json(entry) for entry in table["history"])
    return EvolutionState(history, table["generator"])


def candidate_from_json(entry: dict[str, Any]) -> EvaluatedCandidate:
    """Evaluated candidate from its entry in the state or in result.json.

    Args:
        entry: sizes of the architecture, error and cost.

    Raises:
        KeyError, TypeError: a missing or an unknown entry.
    """
    values: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in entry.items()
    }
    error, macs = float(values.pop("error")), float(values.pop("macs"))
    return EvaluatedCandidate(Architecture(**values), error, macs)
