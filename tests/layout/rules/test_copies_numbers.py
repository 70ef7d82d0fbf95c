"""Cells that are looked at once: how often each is drawn, what is left to be taken
apart, where copies stand.
"""

import numpy as np
import pytest

from layout.files import QUARTERS, CellContent, MaskContent, Placed, Turn
from layout.rules import copies
from layout.rules.copies import ROOT
from metalens.ground.errors import MaskFileError

BAR = np.array([[0, 0], [30, 0], [30, 4], [0, 4]])
ODD = (*QUARTERS, Turn(30.0))


def placed(children, *rows):
    """(child, x, y, turn) of each; turn 8 is by 30 degrees."""
    child, x, y, turn = np.array(rows, np.int32).reshape(-1, 4).T
    return Placed(children, child, x, y, turn.astype(np.uint8), ODD)


def mask():
    """LEAF of 5 shapes; ROW places it 3 times and holds 2; TOP places ROW twice upright
    and once askew, LEAF once.
    """
    cells = {
        "LEAF": CellContent("LEAF", {(1, 0): [BAR] * 5}),
        "ROW": CellContent(
            "ROW",
            {(1, 0): [BAR] * 2},
            placed=placed(("LEAF",), (0, 10, 3, 0), (0, -20, 7, 1), (0, 41, -8, 4)),
        ),
        "TOP": CellContent(
            "TOP",
            {(2, 0): [BAR]},
            placed=placed(
                ("ROW", "LEAF"),
                (0, 100, -7, 0),
                (0, 300, 40, 3),
                (0, 900, 0, 8),
                (1, 5, 6, 2),
            ),
        ),
    }
    return MaskContent("GDSII", 1.0, cells)


def test_large_cells_that_are_placed_more_than_once_are_looked_at_once(monkeypatch):
    """LEAF is drawn 7 times upright or by quarters (2 x 3 + 1), ROW twice. Apart:
    LEAF's 5, ROW's 2 and 3 copies; TOP's
    1, 2 copies of ROW, 1 of LEAF, and all 17 shapes of the ROW that stands askew."""
    monkeypatch.setattr(copies, "_LEAST", 5)
    found = copies.found(mask())
    assert found.times == {ROOT: 1, "ROW": 2, "LEAF": 7}
    assert list(found.times) == [ROOT, "ROW", "LEAF"]
    assert found.apart == 5 + (2 + 3) + (1 + 2 + 1 + 17)
    monkeypatch.setattr(copies, "_LEAST", 6)
    some = copies.found(mask())
    assert some.times == {ROOT: 1, "ROW": 2}
    assert some.apart == (2 + 15) + (1 + 2 + 5 + 17)
    monkeypatch.setattr(copies, "_LEAST", 18)
    none = copies.found(mask())
    assert (none.times, none.apart) == ({ROOT: 1}, 1 + 3 * 17 + 5)


def test_cells_of_4096_shapes_are_large():
    assert copies._LEAST == 4096
    for count in (4095, 4096):
        cells = {
            "A": CellContent("A", {(1, 0): [BAR] * count}),
            "T": CellContent("T", placed=placed(("A",), (0, 0, 0, 0), (0, 50, 0, 0))),
        }
        assert copies.found(MaskContent("G", 1.0, cells)).times == {ROOT: 1} | (
            {"A": 2} if count == 4096 else {}
        )


def test_a_cell_that_is_placed_once_is_taken_apart(monkeypatch):
    monkeypatch.setattr(copies, "_LEAST", 2)
    cells = {
        "A": CellContent("A", {(1, 0): [BAR] * 3}),
        "B": CellContent("B", placed=placed(("A",), (0, 0, 0, 0), (0, 9, 9, 0))),
        "T": CellContent("T", placed=placed(("B",), (0, 0, 0, 0))),
        "LOOSE": CellContent("LOOSE", {(1, 0): [BAR]}),
    }
    found = copies.found(MaskContent("G", 1.0, cells))
    assert (found.times, found.apart) == ({ROOT: 1, "A": 2}, 2 + 3 + 1)
    assert found.tops(MaskContent("G", 1.0, cells), ROOT) == ["T", "LOOSE"]
    assert found.tops(MaskContent("G", 1.0, cells), "A") == ["A"]


@pytest.fixture
def parts(monkeypatch):
    monkeypatch.setattr(copies, "_LEAST", 5)
    return copies.with_places(copies.found(mask()), mask())


def test_copies_stand_where_turns_and_steps_take_them(parts):
    """ROW upright at (100, -7) and by 270 degrees at (300, 40), where (x, y) -> (y,
    -x).
    """
    assert {(t.angle_deg, x, y) for t, x, y in parts.copies("ROW", 9)} == {
        (0.0, 100, -7),
        (270.0, 300, 40),
    }
    leaves = {(t.angle_deg, t.mirrored, x, y) for t, x, y in parts.copies("LEAF", 99)}
    assert leaves == {
        (0.0, False, 110, -4),
        (90.0, False, 80, 0),
        (0.0, True, 141, -15),
        (270.0, False, 303, 30),
        (0.0, False, 307, 60),
        (270.0, True, 292, -1),
        (180.0, False, 5, 6),
    }
    assert len(parts.copies("LEAF", 3)) == 3
    assert {
        (x, y) for _, x, y in parts.copies("ROW", 9, step=50.0, offset=(0.0, 43.0))
    } == {(100, -7)}
    assert parts.copies("ROW", 9, step=50.0, offset=(0.0, 42.0)) == []


def test_offsets_on_a_grid_are_seen_by_the_cell_that_is_turned_there(parts):
    """ROW by 270 degrees at (300, 40): turned back by 90, (-40, 300), which is (10, 0)
    on a grid of 50. Of LEAF (80, 0)
    by 90 is (0, -80), (303, 30) by 270 is (-30, 303), a mirror turns y about, and by
    270 after it (292, -1) is (1, 292)
    turned about: x and y change places with their signs."""
    found = parts.offsets(50.0)
    assert found[ROOT] == {(0.0, 0.0): 1}
    assert found["ROW"] == {(0.0, 43.0): 1, (10.0, 0.0): 1}
    want = [(10, 46), (0, 20), (41, 15), (20, 3), (7, 10), (1, 8), (45, 44)]
    counted = {}
    for x, y in want:
        counted[float(x), float(y)] = counted.get((float(x), float(y)), 0) + 1
    assert found["LEAF"] == counted
    assert parts.offsets(1.0)["LEAF"] == {(0.0, 0.0): 7}


def test_more_shapes_than_may_be_taken_are_refused_with_the_number(monkeypatch):
    monkeypatch.setattr(copies, "_LEAST", 5)
    found = copies.found(mask())
    copies.refuse_beyond(found, mask(), 31)
    with pytest.raises(
        MaskFileError, match=r"draws 57 shapes; .* 31 are left .* at most 30 are taken"
    ):
        copies.refuse_beyond(found, mask(), 30)
    text = copies.advice(2_000_000)
    assert (
        "--most-shapes 2000000 takes them, with some 0.2 GB of memory" in text
    )  # 0.15 and 25 bytes for each
    assert "up to 0.45 GB" in text  # 150 bytes
