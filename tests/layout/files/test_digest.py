"""Sums of placements: the same for the same places in any order, different for any one
change, in both formats.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import layout
from layout.files import flat
from layout.files.content import Gathered
from layout.files.digest import Digest
from layout.mask.plan import Lattice
from metalens.ground.errors import MaskFileError


def splitmix(x, y):
    """In plain integers, from Steele, Lea, Flood 2014."""
    mask = (1 << 64) - 1
    z = ((x & 0xFFFFFFFF) << 32 | y & 0xFFFFFFFF) + 0x9E3779B97F4A7C15 & mask
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 & mask
    z = (z ^ z >> 27) * 0x94D049BB133111EB & mask
    return z ^ z >> 31


NUMBERS = st.integers(-7, 9) | st.sampled_from(
    [-4001, -129, 127, 128, 129, 9003]
)  # there is room for 127 at first
PLACES = st.integers(-(2**31), 2**31 - 1)


@given(st.lists(st.tuples(NUMBERS, PLACES, PLACES)))
def test_sums_are_those_of_plain_integers_in_any_order(places):
    child, x, y = (np.array([p[k] for p in places], np.int32) for k in range(3))
    turn = (np.arange(len(places)) % 11).astype(
        np.uint8
    )  # 8 and beyond are no quarter turns
    forward, back = Digest(), Digest()
    forward.take(child, x, y, turn)
    for n in reversed(range(len(places))):
        back.take(child[n : n + 1], x[n : n + 1], y[n : n + 1], turn[n : n + 1])
    for digest in (forward, back):
        numbers = digest.children
        assert sorted(numbers.tolist()) == sorted({p[0] for p in places})
        for k, *found in zip(numbers.tolist(), *digest.of(numbers), strict=True):
            mine = [
                (a, b, 2 * min(n % 11, 8) + 1)
                for n, (c, a, b) in enumerate(places)
                if c == k
            ]
            turned = int(((turn != 0) & (child == k)).sum())
            want = [
                len(mine),
                sum(a for a, _, _ in mine),
                sum(b for _, b, _ in mine),
                turned,
            ]
            assert [int(f) for f in found] == [
                *want,
                sum(splitmix(a, b) * w for a, b, w in mine) % 2**64,
            ]


def test_no_more_is_kept_than_was_allowed():
    held = Gathered(keep=5)
    part = (np.zeros(3, np.int32), np.arange(3), np.arange(3), np.zeros(3, np.uint8))
    held.add(*part)
    assert len(held.parts) == 1
    held.add(*part)
    held.add(*part)
    assert not held.parts
    assert held.count == int(held.digest.of(np.array([0])).count[0]) == 9


@pytest.fixture(params=["gds", "oas", "reader"])
def both(request, tmp_path):
    """(write a plan and read it back with sums alone)."""
    path = tmp_path / f"m.{request.param[:3]}"

    def again(plan):
        if request.param == "gds":
            layout.write_gdsii(plan, path)
            return layout.read_gdsii(path, keep=50)
        layout.write_oasis(
            plan,
            path,
            fold=False,
            form="reader" if request.param == "reader" else "small",
        )
        return layout.read_oasis(path, keep=50)

    return again


def changed(plan, sites):
    lattice = plan.lattices[0]
    return plan.replace(
        lattices=(
            Lattice.of(
                "LENS", sites, pitch=lattice.pitch, x0=lattice.x0, y0=lattice.y0
            ),
        )
    )


def test_a_file_as_planned_agrees_and_every_change_is_found(plan, both):
    sites = plan.lattices[0].whole()
    read = both(plan)
    assert read.cells["LENS"].sums is not None
    found = layout.compare(plan, read)
    assert found.ok
    assert found.pillars == np.count_nonzero(sites)
    row, column = np.argwhere(sites == 3)[2]
    fewer = sites.copy()
    fewer[row, column] = 0
    lattice = plan.lattices[0]
    place = (
        f"({lattice.x0 + column * lattice.pitch}, {lattice.y0 - row * lattice.pitch})"
    )
    (text,) = layout.compare(plan, both(changed(plan, fewer))).differences
    assert "one pillar is missing" in text
    assert place in text
    (text,) = layout.compare(changed(plan, fewer), both(plan)).differences
    assert "too many" in text
    assert place in text
    one, two = np.argwhere(sites == 2)[0], np.argwhere(sites == 5)[1]
    swapped = sites.copy()
    swapped[tuple(one)], swapped[tuple(two)] = 5, 2
    texts = layout.compare(plan, both(changed(plan, swapped))).differences
    assert len(texts) == 2
    assert all("not all at their places" in text for text in texts)


def test_turned_pillars_are_found(plan, both):
    read = both(plan)
    cell = read.cells["LENS"]
    turned = dataclasses.replace(
        cell.sums, turned=cell.sums.turned + np.arange(len(cell.sums.turned)) // 6
    )
    read.cells["LENS"] = dataclasses.replace(cell, sums=turned)
    assert any("turned" in text for text in layout.compare(plan, read).differences)


def test_what_needs_the_places_says_that_they_were_not_kept(plan, both):
    read = both(plan)
    with pytest.raises(MaskFileError, match="only the sums were kept"):
        list(flat.shapes(read, "TOP"))
    with pytest.raises(MaskFileError, match="only the sums were kept"):
        read.counts("TOP")
