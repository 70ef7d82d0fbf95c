"""Blocks, choices and neighbours of architectures in a space of unlike numbers, by
hand.
"""

from dataclasses import replace

import numpy as np
import pytest

from codesign.network import architecture as nets
from codesign.network.architecture import (
    Architecture,
    BlockSpec,
    SearchSpace,
    StageSpace,
)
from metalens.core.errors import ConfigError

SPACE = SearchSpace(
    stem_channels=20,
    stages=(StageSpace(24, 2, False, "relu"), StageSpace(50, 1, True, "hardswish")),
    kernels=(5, 3, 7),
    expansions=(4, 2, 6),
    depths=(2, 1, 3),
    widths=(1.0, 0.5),
    resolution=(0.4, 0.8),
)
ONE = Architecture(
    (2, 3), (3, 5, 7, 5, 3, 7), (2, 4, 6, 6, 2, 4), width=0.5, resolution=0.6
)


@pytest.mark.parametrize(
    ("channels", "rounded"),
    [
        (1, 8),
        (8, 8),
        (11.9, 16),
        (12, 16),
        (17, 16),
        (17.7, 16),
        (17.8, 24),
        (20, 24),
        (35, 32),
        (36, 40),
    ],
)
def test_channels_are_multiples_of_eight_that_lose_a_tenth_at_most(channels, rounded):
    """12 and more of 8 to 16 go up; 11.9 would lose a third as 8, and 17.8 more than a
    tenth as 16.
    """
    assert nets.round_channels(channels) == rounded
    assert rounded >= 0.9 * channels
    assert nets.round_channels(21, 10) == 20


def test_blocks_take_their_slot_of_the_deepest_stage():
    """Half as wide: 20, 24 and 50 channels are 16 (not 8 of 10), 16 (12) and 24 (25);
    hidden ones are e times the
    inputs, a quarter of them squeeze."""
    first, second = nets.active_blocks(SPACE, ONE)
    assert first == [
        BlockSpec(3, 16, 32, 16, 2, 0, "relu"),
        BlockSpec(5, 16, 64, 16, 1, 0, "relu"),
    ]
    assert second == [
        BlockSpec(5, 16, 96, 24, 1, 24, "hardswish"),
        BlockSpec(3, 24, 48, 24, 1, 16, "hardswish"),
        BlockSpec(7, 24, 96, 24, 1, 24, "hardswish"),
    ]
    assert [block.residual for block in (*first, *second)] == [
        False,
        True,
        False,
        True,
        True,
    ]
    assert nets.stem_channels(SPACE, ONE) == 16
    assert nets.stem_channels(SPACE, replace(ONE, width=1.0)) == 24


def test_the_largest_the_smallest_and_their_slots():
    assert SPACE.slots == 6
    assert nets.largest_architecture(SPACE) == Architecture(
        (3, 3), (7,) * 6, (6,) * 6, 1.0, 0.8
    )
    assert nets.smallest_architecture(SPACE) == Architecture(
        (1, 1), (3,) * 6, (2,) * 6, 0.5, 0.4
    )
    assert nets.search_resolutions(SPACE) == (0.4, 0.5, 0.6, 0.7, 0.8)
    assert nets.search_resolutions(replace(SPACE, resolution=(0.35, 0.5))) in (
        (0.35, 0.45),
        (0.35, 0.45, 0.55),
    )


def test_idle_slots_are_the_least_choice():
    same = replace(ONE, kernels=(3, 5, 5, 5, 3, 7), expansions=(2, 4, 4, 6, 2, 4))
    assert nets.canonical_architecture(SPACE, ONE) == nets.canonical_architecture(
        SPACE, same
    )
    assert nets.canonical_architecture(SPACE, ONE).kernels == (3, 5, 3, 5, 3, 7)
    assert nets.canonical_architecture(SPACE, ONE).expansions == (2, 4, 2, 6, 2, 4)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"depths": (2, 3, 1)}, "3 depths, need 2"),
        ({"kernels": (3,) * 5}, "5 kernels, need 6"),
        ({"expansions": (2, 4, 6, 5, 2, 4)}, r"expansions\[3\] is 5"),
        ({"width": 0.75}, "width is 0.75"),
        ({"resolution": 0.39}, "resolution is 0.39, need 0.4 to 0.8"),
        ({"resolution": 0.81}, "resolution is 0.81"),
    ],
)
def test_a_stranger_to_the_space_is_named(change, said):
    assert nets.check_architecture(SPACE, ONE) is ONE
    assert (
        nets.check_architecture(SPACE, replace(ONE, resolution=0.4)).resolution == 0.4
    )
    assert (
        nets.check_architecture(SPACE, replace(ONE, resolution=0.8)).resolution == 0.8
    )
    with pytest.raises(ConfigError, match=said):
        nets.check_architecture(SPACE, replace(ONE, **change))


@pytest.mark.parametrize("rate", [0.15, 0.6])
def test_neighbours_change_each_entry_as_often_as_told_and_one_at_least(rate):
    """A kernel that is drawn anew is another in two of three draws: 1000 of them, to 4
    sigma of 0.5 / √1000, beside
    the few neighbours that were drawn once more as nothing had changed."""
    generator = np.random.default_rng(4)
    made = [
        nets.mutate_architecture(SPACE, ONE, generator, rate=rate) for _ in range(250)
    ]
    assert all(
        nets.canonical_architecture(SPACE, one)
        != nets.canonical_architecture(SPACE, ONE)
        for one in made
    )
    assert all(nets.check_architecture(SPACE, one) for one in made)
    used = [0, 1, 3, 4]
    changed = np.mean(
        [[one.kernels[k] != ONE.kernels[k] for k in used] for one in made]
    )
    same = (
        (1 - 2 / 3 * rate) ** 10 * (1 - rate / 2) * (1 - 0.8 * rate)
    )  # two depths, eight slots, width, resolution
    assert changed == pytest.approx(2 / 3 * rate / (1 - same), abs=4 * 0.5 / 1000**0.5)
    assert {one.width for one in made} == {0.5, 1.0}
    assert {one.resolution for one in made} == set(nets.search_resolutions(SPACE))


def test_members_are_drawn_evenly_over_every_choice():
    generator = np.random.default_rng(9)
    made = [nets.sample_architecture(SPACE, generator) for _ in range(300)]
    assert all(nets.check_architecture(SPACE, one) for one in made)
    for name, choices in (("depths", 3), ("kernels", 3), ("expansions", 3)):
        counts = np.unique([getattr(one, name)[1] for one in made], return_counts=True)[
            1
        ]
        assert counts == pytest.approx(
            np.full(choices, 300 / choices), abs=4 * (300 * 2 / 9) ** 0.5
        )  # 4 sigma
    widths = np.unique([one.width for one in made], return_counts=True)[1]
    assert widths == pytest.approx([150, 150], abs=4 * 75**0.5)
