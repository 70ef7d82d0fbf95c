"""Neighbours in spaces of one and of two members."""

import numpy as np
import pytest

from codesign.network import (
    SearchSpace,
    canonical_architecture,
    mutate_architecture,
    smallest_architecture,
)
from codesign.train import evolution
from metalens.core.errors import ConfigError

ONE = SearchSpace(
    kernels=(3,), expansions=(3,), depths=(2,), widths=(0.25,), resolution=(1.0, 1.0)
)


def test_the_only_member_of_a_space_is_its_own_neighbour():
    only = smallest_architecture(ONE)
    assert mutate_architecture(ONE, only, np.random.default_rng(0)) == only


def test_a_search_over_one_member_ends():
    found = evolution.search(
        ONE,
        evolution.EvolutionSettings(population=2, tournament=1, rounds=5),
        lambda a: 0.7,
        lambda a: 10.0,
        budget=20.0,
        seed=3,
    )
    assert [c.architecture for c in found] == [smallest_architecture(ONE)] * 5


@pytest.mark.parametrize("rate", [0.0, 0.15, 1.0])
def test_a_neighbour_differs_whatever_the_rate(rate):
    space = SearchSpace(
        kernels=(3,), expansions=(3,), depths=(2,), widths=(0.25, 0.5),
        resolution=(1.0, 1.0),
    )  # fmt: skip
    here = smallest_architecture(space)
    for seed in range(8):
        there = mutate_architecture(space, here, np.random.default_rng(seed), rate=rate)
        assert canonical_architecture(space, there) != canonical_architecture(
            space, here
        )
        assert there.width == 0.5


def test_no_resolution_beyond_the_space_is_tried():
    """0.44 and steps of 0.1 up to 1: 0.94 is the last one within."""
    space = SearchSpace(resolution=(0.44, 1.0))
    tried = {
        mutate_architecture(
            space, smallest_architecture(space), np.random.default_rng(s), rate=1.0
        ).resolution
        for s in range(40)
    }
    assert max(tried) == pytest.approx(0.94)
    with pytest.raises(ConfigError, match="resolution"):
        SearchSpace(resolution=(0.5, 1.2))
