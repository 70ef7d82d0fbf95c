"""Arrays found among placements by hand: runs, what is too short for one, and lattices
in other numbers.
"""

import numpy as np
import pytest

from layout.files import QUARTERS, Copies, Digest, Placed, Sites, Turn, arrays, assembly
from layout.mask import Lattice

ODD = (*QUARTERS, Turn(30.0))


def placed(*rows, children=("A", "B", "C")):
    """(child, x, y, turn) of each."""
    child, x, y, turn = np.array(rows, np.int32).reshape(-1, 4).T
    return Placed(children, child, x, y, turn.astype(np.uint8), ODD)


def told(*rows):
    made, left = arrays(placed(*rows))
    loose = zip(
        *(v.tolist() for v in (left.child, left.x, left.y, left.turn)), strict=True
    )
    return sorted(made, key=lambda c: (c.child, c.x, c.y)), sorted(loose)


def row(child, x, y, turn, count, step):
    return [(child, x + step * k, y, turn) for k in range(count)]


def test_copies_stand_at_their_steps_row_by_row():
    one = Copies(
        "A", 5, -7, QUARTERS[3], columns=3, rows=2, across=(10, 1), up=(-2, 100)
    )
    assert one.count == 6
    x, y = one.places()
    assert (x.tolist(), y.tolist()) == (
        [5, 15, 25, 3, 13, 23],
        [-7, -6, -5, 93, 94, 95],
    )
    assert [v.tolist() for v in Copies("A", 5, -7).places()] == [[5], [-7]]


def test_four_in_a_row_or_a_column_are_an_array_and_three_are_not():
    assert told(*row(1, -40, 9, 6, 4, 30)) == (
        [Copies("B", -40, 9, Turn(180.0, True), 4, 1, (30, 0), (0, 0))],
        [],
    )
    upright = [(2, 9, -40 + 25 * k, 8) for k in range(4)]
    assert told(*upright) == (
        [Copies("C", 9, -40, Turn(30.0), 1, 4, (0, 0), (0, 25))],
        [],
    )
    three = row(1, -40, 9, 6, 3, 30)
    assert told(*three) == ([], sorted(three))
    loose = (0, 500, 600, 0)
    assert told(*three, loose) == ([], sorted([*three, loose]))


def test_equal_rows_at_equal_distances_are_one_array():
    rows = [one for k in range(3) for one in row(0, 7, -50 + 80 * k, 5, 5, 30)]
    want = [Copies("A", 7, -50, Turn(90.0, True), 5, 3, (30, 0), (0, 80))]
    assert told(*rows) == (want, [])
    assert told(*rows[::-1]) == (want, [])
    odd = [*rows, (0, 7 + 150, -50, 5)]  # a sixth copy in the first row
    made, left = told(*odd)
    assert [(c.x, c.y, c.columns, c.rows, c.up) for c in made] == [
        (7, -50, 6, 1, (0, 0)),
        (7, 30, 5, 1, (0, 0)),
        (7, 110, 5, 1, (0, 0)),
    ]
    assert left == []


def test_copies_of_another_cell_turn_or_line_are_in_no_run():
    """Three each of what is alike: B's at two turns, A's on two lines."""
    rows = [
        *row(1, 0, 5, 0, 3, 30),
        *row(1, 90, 5, 1, 3, 30),
        *row(0, 0, 5, 0, 3, 30),
        *row(0, 90, 6, 0, 3, 30),
    ]
    made, left = told(*rows)
    assert (made, left) == ([], sorted(rows))


def test_a_run_ends_where_its_step_changes_and_copies_on_each_other_are_left():
    """Steps of 10, then 25 from the fifth on: the fifth is of the first run alone."""
    some = [*row(0, 0, 0, 0, 5, 10), *row(0, 65, 0, 0, 4, 25)]
    assert told(*some) == (
        [
            Copies("A", 0, 0, QUARTERS[0], 5, 1, (10, 0), (0, 0)),
            Copies("A", 65, 0, QUARTERS[0], 4, 1, (25, 0), (0, 0)),
        ],
        [],
    )
    twice = [(0, 3, 4, 0)] * 5
    assert told(*twice) == ([], twice)
    double = [*row(0, 0, 0, 0, 4, 10), (0, 20, 0, 0)]  # one of four twice
    made, left = told(*double)
    places = [
        (0, x, y, 0)
        for c in made
        for x, y in zip(*(v.tolist() for v in c.places()), strict=True)
    ]
    assert sorted([*places, *left]) == sorted(double)


def test_cells_of_fewer_than_four_or_more_than_a_million_stay_as_they_are(monkeypatch):
    some = placed(*row(0, 0, 0, 0, 6, 10))
    monkeypatch.setattr(assembly, "_MOST", 5)
    made, left = arrays(some)
    assert made == ()
    assert left is some
    monkeypatch.setattr(assembly, "_MOST", 6)
    assert len(arrays(some)[0]) == 1
    nothing = placed()
    assert arrays(nothing)[1] is nothing


BLOCK = np.array([[1, 0, 3], [2, 3, 3]], np.uint8)


def sites():
    lattice = Lattice(
        "OWN", 2, 3, 410, -7, 9, lambda a, b: BLOCK[a:b], BLOCK, row_pitch=300
    )
    return Sites(lattice, ("X", "", "Z"))


def test_sites_are_numbered_by_the_cells_of_a_file():
    """One more than the number of each cell; classes without a cell are nowhere."""
    made = sites().numbered({"X": 0, "Z": 41})
    assert made.whole().tolist() == [[1, 0, 42], [0, 42, 42]]
    assert made.source(1, 2).tolist() == [[0, 42, 42]]
    renamed = sites().renamed({"X": "P_X", "Q": "P_Q"})
    assert (renamed.children, renamed.lattice) == (("P_X", "", ""), renamed.lattice)


@pytest.mark.parametrize("most", [1 << 20, 3])
def test_sums_of_sites_are_those_of_their_places(monkeypatch, most):
    monkeypatch.setattr(assembly, "_MOST", most)
    digest = Digest()
    x, y = np.array([813, 403, 813]), np.array([9, -291, -291])
    digest.take(np.zeros(3, int), x, y, np.zeros(3, int))
    hashed = int(digest.of(np.array([0])).hashed[0])
    found = sites().sums()
    assert found["Z"] == (3, 2029, -573, 0, hashed)
    assert found["X"][:4] == (1, -7, 9, 0)
    assert set(found) == {"X", "", "Z"}
