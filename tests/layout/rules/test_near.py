"""Pairs of circles that are near, against every pair looked at one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from layout.rules import near
from metalens.ground.errors import MaskFileError


def every(discs, gap):
    """All pairs (smaller number first) whose circles are nearer than a gap, by the
    table of all distances.
    """
    at = np.column_stack([discs.x, discs.y]) + discs.middle[discs.kind]
    away = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    reach = discs.reach[discs.kind]
    one, two = np.nonzero(away < reach[:, None] + reach[None] + gap)
    return {(i, j) for i, j in zip(one.tolist(), two.tolist(), strict=True) if i < j}


def found(discs, gap):
    one, two = near.pairs(discs, gap)
    pairs = [
        tuple(sorted(pair)) for pair in zip(one.tolist(), two.tolist(), strict=True)
    ]
    assert len(set(pairs)) == len(pairs)  # none twice
    return set(pairs)


def discs(seed, count, spread, reach):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(-spread, 2 * spread, (2, count)).astype(np.int32)
    middle = rng.uniform(-40, 70, (len(reach), 2))
    return near.Discs(
        x,
        y,
        rng.integers(0, len(reach), count).astype(np.int32),
        middle,
        np.array(reach),
    )


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 90),
    spread=st.integers(3, 3000),
    gap=st.floats(0.5, 300),
    sizes=st.lists(st.floats(0.4, 4000), min_size=1, max_size=6),
)
def test_pairs_of_any_sizes_are_those_of_all_distances(seed, count, spread, gap, sizes):
    some = discs(seed, count, spread, sizes)
    assert found(some, gap) == every(some, gap)


def test_a_lattice_has_the_neighbours_that_its_gap_says():
    i, j = (v.ravel().astype(np.int32) for v in np.meshgrid(np.arange(9), np.arange(7)))
    some = near.Discs(
        410 * i - 2000,
        370 * j - 1111,
        np.zeros(63, np.int32),
        np.zeros((1, 2)),
        np.array([150.0]),
    )
    assert not found(some, 69.9)  # 370 - 300
    assert len(found(some, 70.1)) == 9 * 6
    assert len(found(some, 110.1)) == 9 * 6 + 8 * 7
    assert len(found(some, np.hypot(370, 410) - 300 + 0.1)) == 9 * 6 + 8 * 7 + 2 * 8 * 6


@given(
    seed=st.integers(0, 10_000),
    band=st.integers(8, 60),
    spread=st.integers(100, 9000),
    gap=st.floats(0.5, 90),
    far=st.floats(0, 4000),
)
def test_pairs_are_the_same_by_bands_of_rows(seed, band, spread, gap, far):
    some = discs(seed, 90, spread, [4.0, 9.0, 31.0, 30.0, 700.0])
    some.middle[3] += far  # circles far from their places
    most = near._BAND
    try:
        near._BAND = band
        assert found(some, gap) == every(some, gap)
    finally:
        near._BAND = most


def test_several_bands_are_made_of_a_tall_lens_and_each_pair_counts_once(monkeypatch):
    monkeypatch.setattr(near, "_BAND", 100)
    i, j = (
        v.ravel().astype(np.int32) for v in np.meshgrid(np.arange(12), np.arange(100))
    )
    kind = np.zeros(1201, np.int32)
    kind[-1] = 1  # one wide shape beside all of them
    x, y = (
        np.append(410 * i, -30_200).astype(np.int32),
        np.append(370 * j - 999, 17_000).astype(np.int32),
    )
    some = near.Discs(x, y, kind, np.zeros((2, 2)), np.array([150.0, 30_000.0]))
    wide, edges, reach = near._bands(some, 80.0)
    assert wide.tolist() == [False, True]
    assert len(edges) == 14
    assert reach == 380
    beside = np.hypot(x[:-1] + 30_200.0, y[:-1] - 17_000.0) < 30_000 + 150 + 80
    assert len(found(some, 80.0)) == 12 * 99 + beside.sum()
    assert 0 < beside.sum() < 100


@pytest.mark.parametrize("room", [7, 64])
def test_pairs_are_the_same_however_many_are_taken_at_once(monkeypatch, room):
    some = discs(5, 120, 700, [9.0, 14.0, 130.0])
    wanted = every(some, 20.0)
    monkeypatch.setattr(
        near, "_AT_ONCE", max(room, 40)
    )  # no shape here has more than 40
    assert found(some, 20.0) == wanted


def test_far_apart_shapes_take_no_memory_for_the_room_between():
    x = np.array([-(2**31) + 9, 2**31 - 9, 40, 40 + 25], np.int32)
    y = np.array([2**31 - 9, -(2**31) + 9, 40, 40 + 25], np.int32)
    some = near.Discs(x, y, np.zeros(4, np.int32), np.zeros((1, 2)), np.array([3.0]))
    assert found(some, 30.0) == {(2, 3)}


def test_shapes_that_lie_on_each_other_are_refused_by_number(monkeypatch):
    many = near.Discs(
        *(np.zeros(60, np.int32) for _ in range(3)), np.zeros((1, 2)), np.array([3.0])
    )
    monkeypatch.setattr(near, "MOST_PAIRS", 1000)
    with pytest.raises(
        MaskFileError,
        match="more than 1,000 pairs of shapes can be closer than the rule",
    ):
        near.pairs(many, 5.0)
    monkeypatch.setattr(near, "_AT_ONCE", 40)
    with pytest.raises(MaskFileError, match="more than 40 shapes lie on one"):
        near.pairs(many, 5.0)


def test_pairs_beside_some_kinds_have_one_of_them_each():
    some = discs(8, 90, 500, [9.0, 12.0, 40.0, 130.0])
    beside = np.array([False, True, False, True])
    one, two = near.pairs(some, 25.0, beside=beside)
    pairs = [
        tuple(sorted(pair)) for pair in zip(one.tolist(), two.tolist(), strict=True)
    ]
    wanted = {
        (i, j)
        for i, j in every(some, 25.0)
        if beside[some.kind[i]] or beside[some.kind[j]]
    }
    assert len(pairs) == len(set(pairs))
    assert set(pairs) == wanted < every(some, 25.0)


def test_as_many_pairs_as_are_allowed_are_found(monkeypatch):
    some = discs(8, 90, 500, [9.0, 12.0, 40.0, 130.0])
    count = len(every(some, 25.0))
    monkeypatch.setattr(near, "MOST_PAIRS", count)
    assert len(found(some, 25.0)) == count
    monkeypatch.setattr(near, "MOST_PAIRS", count - 1)
    with pytest.raises(MaskFileError, match="pairs of shapes"):
        near.pairs(some, 25.0)
