"""Turns of placements by plain trigonometry, hierarchies taken apart by hand,
placements kept up to a number.
"""

import math

import numpy as np
import pytest

from layout.files import content
from layout.files.content import (
    QUARTERS,
    CellContent,
    Gathered,
    MaskContent,
    Placed,
    Turn,
)
from metalens.ground.errors import MaskFileError

X, Y = np.array([1000, -370, 12]), np.array([300, 45, -811])


def turned(x, y, turn):
    """Mirror at the x axis, then a complex factor."""
    z = (
        turn.scale
        * np.exp(1j * math.radians(turn.angle_deg))
        * (x + 1j * (-y if turn.mirrored else y))
    )
    return z.real, z.imag


def points(turn):
    return [v.tolist() for v in turn.apply(X, Y)]


@pytest.mark.parametrize("k", range(8))
def test_quarters_are_exact_and_numbered_by_their_turn_and_their_mirror(k):
    turn = QUARTERS[k]
    assert (turn.angle_deg, turn.mirrored, turn.scale) == (90.0 * (k % 4), k >= 4, 1.0)
    assert turn.quarter
    assert points(turn) == [[round(v) for v in some] for some in turned(X, Y, turn)]
    assert (
        turn.boxes(np.array([[10, 20, 300, 50]])).tolist()
        == {
            0: [[10, 20, 300, 50]],
            1: [[-50, 10, -20, 300]],
            2: [[-300, -50, -10, -20]],
            3: [[20, -300, 50, -10]],
            4: [[10, -50, 300, -20]],
            5: [[20, 10, 50, 300]],
            6: [[-300, 20, -10, 50]],
            7: [[-50, -300, -20, -10]],
        }[k]
    )


def test_other_turns_and_scales_go_to_the_nearest_whole_unit():
    for turn in (
        Turn(30.0, True, 2.5),
        Turn(205.0),
        Turn(90.0, False, 0.5),
        Turn(-47.0, True),
    ):
        assert points(turn) == [[round(v) for v in some] for some in turned(X, Y, turn)]
        assert not turn.quarter
    assert points(Turn(450.0)) == points(QUARTERS[1])
    assert points(Turn(-90.0, True)) == points(QUARTERS[7])
    assert Turn(-180.0).quarter


@pytest.mark.parametrize(
    "outer", [Turn(30.0, True, 2.5), Turn(205.0, False, 0.4), QUARTERS[3], QUARTERS[6]]
)
def test_turns_follow_each_other_and_are_undone(outer):
    for inner in (Turn(77.0, False, 1.25), Turn(310.0, True, 3.0)):
        both = outer.after(inner)
        step = turned(*turned(X, Y, inner), outer)
        assert np.array(turned(X, Y, both)) == pytest.approx(
            np.array(step), rel=1e-12, abs=1e-9
        )  # rounding of ten operations
        assert 0 <= both.angle_deg < 360
        back = inner.back.after(inner)
        assert (back.angle_deg % 360, back.mirrored) == (0, False)
        assert back.scale == pytest.approx(1, rel=1e-15)


def placed(children, *rows, turns=QUARTERS):
    """(child, x, y, turn) of each."""
    child, x, y, turn = np.array(rows, np.int32).reshape(-1, 4).T
    return Placed(children, child, x, y, turn.astype(np.uint8), turns)


@pytest.mark.parametrize("at_once", [1 << 20, 3])
def test_placements_are_counted_by_child_and_turn(monkeypatch, at_once):
    monkeypatch.setattr(content, "_AT_ONCE", at_once)
    some = placed(
        ("A", "B", "C"), *((0, 0, 0, 3),) * 4, (1, 0, 0, 7), (1, 0, 0, 0), (1, 5, 5, 0)
    )
    want = np.zeros((3, 8), int)
    want[0, 3], want[1, 7], want[1, 0] = 4, 1, 2
    assert some.counts().tolist() == want.tolist()
    assert CellContent("T", placed=some).counts().tolist() == [4, 3, 0]


SHAPE = np.array([[0, 0], [5, 0], [0, 7]])


def test_a_cell_is_taken_for_its_shapes_and_an_empty_one_for_one():
    drawn = CellContent(
        "A", {(1, 0): [SHAPE] * 3, (2, 0): [SHAPE]}, {(1, 0): [(0, 0, 3)] * 2}
    )
    assert drawn.taken == 6
    assert (CellContent("B").taken, CellContent("B").texts) == (1, 0)
    nothing = CellContent("B").placed
    assert [
        len(v)
        for v in (nothing.child, nothing.x, nothing.y, nothing.turn, nothing.children)
    ] == [0] * 5
    assert CellContent("C", placed=placed(("A",))).taken == 0


ODD = (*QUARTERS, Turn(30.0, True, 2.0))


def nested():
    """TOP places ROW twice (once turned by 30 degrees and doubled), and the leaf A
    between them.
    """
    cells = {
        "A": CellContent("A", {(1, 0): [SHAPE]}),
        "ROW": CellContent(
            "ROW",
            placed=placed(("B", "A"), (1, 100, 0, 0), (0, 0, 70, 5), (1, -30, 40, 6)),
        ),
        "B": CellContent("B", {(1, 0): [SHAPE]}),
        "TOP": CellContent(
            "TOP",
            placed=placed(
                ("A", "ROW"),
                (1, 900, -70, 7),
                (0, 11, 13, 1),
                (1, -500, 200, 8),
                turns=ODD,
            ),
        ),
        "ALONE": CellContent("ALONE"),
    }
    return MaskContent("GDSII", 1.0, cells)


def test_leaves_of_a_hierarchy_stand_where_its_turns_take_them():
    """QUARTERS[7] mirrors at x and turns by 270: (x, y) -> (-y, -x). The ninth mirrors,
    turns by 30 and doubles.
    """
    mask = nested()
    assert mask.tops == ["TOP", "ALONE"]
    c, s = 2 * math.cos(math.pi / 6), 1.0

    def ninth(x, y):
        return round(c * x + s * y) - 500, round(s * x - c * y) + 200

    want_a = [(900, -170), (860, -40), ninth(100, 0), ninth(-30, 40), (11, 13)]
    want_b = [(830, -70), ninth(0, 70)]
    found = mask.sites("TOP")
    assert {
        name: set(zip(x.tolist(), y.tolist(), strict=True))
        for name, (x, y) in found.items()
    } == {
        "A": set(want_a),
        "B": set(want_b),
    }
    assert mask.counts("TOP") == {"A": 5, "B": 2}
    ways = {}
    for leaf in mask.leaves("TOP"):
        for child, x, y, turn in zip(
            leaf.child, leaf.x, leaf.y, leaf.turn, strict=True
        ):
            this = leaf.turns[turn]
            ways[leaf.children[child], int(x), int(y)] = (
                this.angle_deg,
                this.mirrored,
                this.scale,
            )
    assert ways["A", 900, -170] == (270.0, True, 1.0)
    assert ways["A", 860, -40] == (
        90.0,
        False,
        1.0,
    )  # 180 after a mirror, then a mirror and 270: 270 - 180
    assert ways["B", 830, -70] == (180.0, False, 1.0)
    assert ways["A", *ninth(-30, 40)] == (210.0, False, 2.0)
    assert ways["A", 11, 13] == (90.0, False, 1.0)


def test_a_hierarchy_without_end_or_with_a_hole_is_refused():
    cells = {"A": CellContent("A", placed=placed(("B",), (0, 0, 0, 0)))}
    with pytest.raises(
        MaskFileError, match="cell 'B' is placed, but the file does not hold it"
    ):
        list(MaskContent("G", 1.0, cells).leaves("A"))
    cells["B"] = CellContent("B", placed=placed(("A",), (0, 0, 0, 0)))
    with pytest.raises(MaskFileError, match="cell 'A' places itself through A > B"):
        list(MaskContent("G", 1.0, cells).leaves("A"))


@pytest.mark.parametrize(("depth", "fits"), [(65, True), (66, False)])
def test_sixty_five_cells_may_lie_in_each_other(depth, fits):
    cells = {
        f"C{k}": CellContent(f"C{k}", placed=placed((f"C{k + 1}",), (0, 3, 1, 0)))
        for k in range(depth)
    }
    cells[f"C{depth}"] = CellContent(f"C{depth}")
    mask = MaskContent("G", 1.0, cells)
    if fits:
        assert mask.sites("C0")[f"C{depth}"][0].tolist() == [3 * depth]
    else:
        with pytest.raises(MaskFileError, match="places itself"):
            mask.sites("C0")


@pytest.mark.parametrize(
    ("x", "fits"),
    [(2**31 - 1, True), (2**31, False), (-(2**31) + 1, True), (-(2**31), False)],
)
def test_nested_places_stay_within_32_bits(x, fits):
    inner = x // 2
    cells = {
        "A": CellContent("A", placed=placed(("B",), (0, inner, 0, 0))),
        "B": CellContent("B", placed=placed(("C",), (0, x - inner, 0, 0))),
        "C": CellContent("C"),
    }
    mask = MaskContent("G", 1.0, cells)
    if fits:
        assert mask.sites("A")["C"][0].tolist() == [x]
    else:
        with pytest.raises(
            MaskFileError,
            match=f"is placed {abs(x)} units from the origin, beyond 32 bits",
        ):
            mask.sites("A")


def test_a_mapped_file_is_its_bytes_before_and_after_they_are_let_go(tmp_path):
    data = bytes(range(256)) * 70
    (tmp_path / "m").write_bytes(data)
    found = content.mapped(tmp_path / "m")
    assert (found.dtype, bytes(found)) == (np.uint8, data)
    content.forget(found, len(data))
    content.forget(found[5:], 3)
    assert bytes(found) == data
    content.forget(np.zeros(9, np.uint8), 9)  # no mapped file: nothing to do
    (tmp_path / "e").write_bytes(b"")
    with pytest.raises(MaskFileError, match="byte 0: empty file"):
        content.mapped(tmp_path / "e")


def some(first, count):
    """Placements whose columns tell their number."""
    n = np.arange(first, first + count)
    return n, 10 * n, -n, (n % 7).astype(np.uint8)


@pytest.mark.parametrize("large", [1 << 23, 5])
def test_what_is_kept_comes_back_in_its_order(monkeypatch, large):
    monkeypatch.setattr(content, "_LARGE", large)
    held, first = Gathered(), 0
    for count in (3, 1, 4, 2, 2, 9, 1):
        held.add(*some(first, count))
        first += count
        if large == 5:
            assert (
                sum(len(part[0]) for part in held.parts[held.merged :])
                == held.small
                < 5
            )
    assert (held.count, held.digest) == (22, None)
    if large == 5:
        assert [len(part[0]) for part in held.parts] == [
            8,
            13,
            1,
        ]  # 3 + 1 + 4, then 2 + 2 + 9
    assert [v.tolist() for v in held.columns()] == [v.tolist() for v in some(0, 22)]
    assert held.parts == []


def test_as_many_are_kept_as_was_said_and_none_of_more():
    held = Gathered(keep=7)
    held.add(*some(0, 4))
    held.add(*some(4, 3))
    assert (held.count, len(held.parts), held.digest) == (7, 2, None)
    six = Gathered(keep=6)
    for _ in range(3):
        six.add(
            np.array([2, 5]), np.array([11, -3]), np.array([7, 1]), np.array([0, 3])
        )
    assert (six.digest, six.count) == (None, 6)
    six.add(np.array([5]), np.array([1]), np.array([-9]), np.array([0]))
    assert (six.count, six.parts) == (7, [])
    sums = six.digest.of(np.array([2, 5]))
    assert [v.tolist() for v in (sums.count, sums.x, sums.y, sums.turned)] == [
        [3, 4],
        [33, -8],
        [21, -6],
        [0, 3],
    ]
