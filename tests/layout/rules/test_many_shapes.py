"""Memory that a check takes for each of many shapes, and placements that are taken up
in blocks.
"""

import tracemalloc

import numpy as np
import pytest

from layout.files import (
    QUARTERS,
    CellContent,
    Gathered,
    MaskContent,
    Placed,
    content,
    flat,
)
from layout.oasis import cells
from layout.process import Rules
from layout.rules import DrcReport, foreign, near

SQUARE = np.array([[-70, -50], [60, -50], [60, 50], [-70, 50]])


def lattice(columns, rows, kinds=3):
    """A lens of boxes of some sizes, 410 and 370 units apart."""
    i, j = (v.ravel() for v in np.meshgrid(np.arange(columns), np.arange(rows)))
    child = ((3 * i + 5 * j) % kinds).astype(np.int32)
    names = tuple(f"P{k}" for k in range(kinds))
    placed = Placed(
        names,
        child,
        (410 * i).astype(np.int32),
        (370 * j).astype(np.int32),
        (child % 4).astype(np.uint8),
    )
    made = {"LENS": CellContent("LENS", placed=placed)}
    made |= {
        name: CellContent(name, {(1, 0): [SQUARE + np.array([0, k])]})
        for k, name in enumerate(names)
    }
    return MaskContent("OASIS", 1.0, made)


def test_a_check_takes_some_twenty_bytes_a_shape(monkeypatch):
    """12 for places and kinds of the layer, 8 for places that wait to be gathered, 3
    for the bands of a large mask.
    """
    monkeypatch.setattr(near, "_BAND", 1 << 14)
    for module in (near, flat, content, foreign):
        monkeypatch.setattr(module, "_AT_ONCE", 1 << 14)
    foreign.check(lattice(90, 190), Rules(), last=True)  # compiles the loops
    some = lattice(1000, 600)
    tracemalloc.start()
    found = foreign.check(
        some, Rules(minimum_gap_nm=200, minimum_feature_nm=90), last=True
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.ok
    assert found.pillars == 600_000
    assert peak < 26 * 600_000
    assert not some.cells  # let go


def test_places_are_the_same_in_any_blocks(monkeypatch):
    rng = np.random.default_rng(7)
    child, turn = (
        rng.integers(0, 3, 101).astype(np.int32),
        rng.integers(0, 8, 101).astype(np.uint8),
    )
    x, y = rng.integers(-(10**6), 10**6, (2, 101)).astype(np.int32)
    made = {"A": CellContent("A", placed=Placed(("P", "Q", "R"), child, x, y, turn))}
    made |= {
        name: CellContent(name, {(1, k): [SQUARE + 3 * k]})
        for k, name in enumerate("PQR")
    }
    monkeypatch.setattr(flat, "_AT_ONCE", 9)
    monkeypatch.setattr(content, "_AT_ONCE", 7)
    seen = sorted(
        (shape.layer[1], *map(tuple, np.sort(shape.outline, 0)[[0, -1]] + [px, py]))
        for shape in flat.shapes(MaskContent("GDSII", 1.0, made), "A")
        for px, py in zip(shape.x.tolist(), shape.y.tolist(), strict=True)
    )
    corners = (
        np.column_stack(QUARTERS[t].apply(*(SQUARE + 3 * k).T))
        for k, t in zip(child, turn, strict=True)
    )
    ends = (
        np.sort(own, 0)[[0, -1]] + [px, py]
        for own, px, py in zip(corners, x, y, strict=True)
    )
    assert seen == sorted(
        (int(k), *map(tuple, end)) for k, end in zip(child, ends, strict=True)
    )
    counts = made["A"].placed.counts()
    assert counts.shape == (3, 8)
    assert all(
        counts[k, t] == ((child == k) & (turn == t)).sum()
        for k in range(3)
        for t in range(8)
    )


@pytest.mark.parametrize("large", [1, 40, 1 << 23])
def test_placements_keep_their_order_however_they_are_gathered(monkeypatch, large):
    monkeypatch.setattr(content, "_LARGE", large)
    rng, held, every = np.random.default_rng(11), Gathered(), []
    for count in (3, 1, 30, 30, 2, 90, 1):
        part = rng.integers(0, 200, (4, count))
        every.append(part)
        held.add(
            part[0].astype(np.int32),
            *part[1:3].astype(np.int32),
            part[3].astype(np.uint8),
        )
    columns = held.columns()
    assert np.array_equal(np.array(columns), np.hstack(every))
    assert [column.dtype.itemsize for column in columns] == [4, 4, 4, 1]


@pytest.mark.parametrize("spread", [50, 1 << 23])
def test_cells_are_numbered_by_those_that_occur(spread):
    child = np.random.default_rng(3).integers(-40, spread, 700).astype(np.int32)
    used, index = cells._numbered(child.copy())
    assert used.tolist() == sorted(set(child.tolist()))
    assert np.array_equal(used[index], child)
    assert index.dtype == np.int32


def test_counts_of_broken_rules_are_parted_by_thousands():
    report = DrcReport.empty(MaskContent("OASIS", 1.0, {}), Rules())
    assert report.broken == ""
    report.counts |= {"gap": 8_721_433, "feature": 907}
    assert report.broken == "8,721,433 gap, 907 feature"
    assert report.summary.endswith("violations: 8,721,433 gap, 907 feature")
