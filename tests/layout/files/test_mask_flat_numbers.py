"""A hierarchy taken apart by hand: outlines turned and counter-clockwise, equal ones
together, cells kept whole.
"""

import math

import numpy as np
import pytest

from layout.files import QUARTERS, CellContent, MaskContent, Placed, Turn, flat
from metalens.ground.errors import MaskFileError

WEDGE = np.array([[0, 0], [30, 4], [7, 50]])
BAR = np.array([[-5, 0], [25, 0], [25, 8], [-5, 8]])
ODD = (*QUARTERS, Turn(30.0, False, 2.0))


def placed(children, *rows):
    """(child, x, y, turn) of each; turn 8 is by 30 degrees and doubles."""
    child, x, y, turn = np.array(rows, np.int32).reshape(-1, 4).T
    return Placed(children, child, x, y, turn.astype(np.uint8), ODD)


def mask():
    cells = {
        "A": CellContent(
            "A",
            {(1, 0): [WEDGE, BAR, WEDGE + 100], (2, 5): [WEDGE]},
            {(3, 0): [(4, -7, 90)]},
        ),
        "MID": CellContent(
            "MID", placed=placed(("A",), (0, 10, 20, 0), (0, -40, 3, 5), (0, 11, 21, 0))
        ),
        "TOP": CellContent(
            "TOP",
            {(1, 0): [BAR]},
            placed=placed(("MID",), (0, 1000, -200, 1), (0, 0, 0, 8)),
        ),
    }
    return MaskContent("OASIS", 1.0, cells)


def turned(points, quarters, mirrored):
    z = points[:, 0] + 1j * (-points[:, 1] if mirrored else points[:, 1])
    z = z * 1j**quarters
    made = np.column_stack([np.rint(z.real), np.rint(z.imag)]).astype(int)
    return made[::-1] if mirrored else made


def canonical(points):
    rows = [tuple(p) for p in np.asarray(points).tolist()]
    first = rows.index(min(rows))
    return tuple(rows[first:] + rows[:first])


def told(content, top="TOP", **more):
    """{(cell, layer, corners from the smallest on): sorted places}."""
    found = {}
    for shape in flat.shapes(content, top, **more):
        key = shape.cell, shape.layer, canonical(shape.outline)
        found.setdefault(key, []).extend(
            zip(shape.x.tolist(), shape.y.tolist(), strict=True)
        )
    return {key: sorted(at) for key, at in found.items()}


def test_polygons_stand_where_turns_take_them_and_run_counter_clockwise():
    """MID by a quarter at (1000, -200): A at (10, 20) goes to (980, -190) and (979,
    -189), turned by a quarter; that at
    (-40, 3), mirrored and turned by a quarter there, to (997, -240) with half a turn
    after its mirror."""
    found = told(mask())
    assert found["TOP", (1, 0), canonical(BAR)] == [(0, 0)]
    assert found["A", (2, 5), canonical(turned(WEDGE, 1, False))] == [
        (979, -189),
        (980, -190),
    ]
    assert found["A", (2, 5), canonical(turned(WEDGE, 2, True))] == [(997, -240)]
    assert found["A", (1, 0), canonical(turned(WEDGE + 100, 1, False))] == [
        (979, -189),
        (980, -190),
    ]
    assert found["A", (1, 0), canonical(turned(BAR, 2, True))] == [(997, -240)]
    c, s = 2 * math.cos(math.pi / 6), 1.0
    askew = np.rint(
        np.column_stack(
            [c * WEDGE[:, 0] - s * WEDGE[:, 1], s * WEDGE[:, 0] + c * WEDGE[:, 1]]
        )
    ).astype(int)
    assert found["A", (2, 5), canonical(askew)] == sorted(
        (round(c * x - s * y), round(s * x + c * y)) for x, y in ((10, 20), (11, 21))
    )
    for _, _, corners in found:
        x, y = np.array(corners).T
        assert (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() > 0


def test_polygons_of_one_cell_and_layer_with_equally_many_corners_are_a_stack():
    stacks = [s for s in flat.stacks(mask(), "MID") if s.layer == (1, 0)]
    upright = [s for s in stacks if len(s.x) == 2]
    assert {s.outlines.shape for s in upright} == {(2, 3, 2), (1, 4, 2)}
    assert {tuple(zip(s.x.tolist(), s.y.tolist(), strict=True)) for s in upright} == {
        ((10, 20), (11, 21))
    }
    assert len(stacks) == 4


@pytest.mark.parametrize("at_once", [1 << 22, 1])
def test_cells_that_are_kept_whole_are_left_out_but_where_they_stand_askew(
    monkeypatch, at_once
):
    monkeypatch.setattr(flat, "_AT_ONCE", at_once)
    assert set(told(mask(), whole={"A"})) >= {("TOP", (1, 0), canonical(BAR))}
    left = {key for key in told(mask(), whole={"A"}) if key[0] == "A"}
    assert canonical(turned(WEDGE, 1, False)) not in {corners for _, _, corners in left}
    assert len(left) == 2 * 5  # five shapes by 30 degrees, and those mirrored before
    kept = [
        (
            name,
            turn.angle_deg,
            turn.mirrored,
            list(zip(x.tolist(), y.tolist(), strict=True)),
        )
        for name, turn, x, y in flat.places(mask(), "TOP", {"A"})
    ]
    places = {
        (name, angle, mirror, at) for name, angle, mirror, every in kept for at in every
    }
    assert places == {
        ("A", 90.0, False, (980, -190)),
        ("A", 90.0, False, (979, -189)),
        ("A", 180.0, True, (997, -240)),
    }
    whole = [
        (name, turn.angle_deg, x.tolist(), y.tolist())
        for name, turn, x, y in flat.places(mask(), "TOP", {"MID"})
    ]
    assert whole == [("MID", 90.0, [1000], [-200])]


def test_shapes_of_one_key_and_outline_come_together_from_all_top_cells():
    content = mask()
    content.cells["ALONE"] = CellContent("ALONE", {(1, 0): [BAR], (9, 0): [BAR]})
    found = flat.alike(content, lambda s: s.layer[0] if s.layer[0] != 9 else None)
    bars = [
        group
        for (key, _), group in found.items()
        if key == 1 and np.array_equal(group[0].outline, BAR)
    ]
    assert [[s.cell for s in group] for group in bars] == [["TOP", "ALONE"]]
    assert {key for key, _ in found} == {1, 2, 3}
    alone = flat.alike(content, lambda s: s.layer[0], tops=["ALONE"])
    assert sorted(key for key, _ in alone) == [1, 9]


def test_true_circles_are_polygons_of_64_corners_and_their_area():
    (shape,) = (s for s in flat.shapes(mask(), "A") if s.layer == (3, 0))
    x, y = shape.outline.T
    assert len(shape.outline) == 64
    area = 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    assert area == pytest.approx(math.pi * 90**2, rel=5e-3)  # corners on whole units
    assert (x.min() + x.max(), y.min() + y.max()) == (2 * 4, -2 * 7)


@pytest.mark.parametrize(
    ("x", "fits"),
    [(2**31 - 1, True), (2**31, False), (-(2**31) + 1, True), (-(2**31), False)],
)
def test_places_stay_within_32_bits(x, fits):
    cells = {
        "A": CellContent("A", placed=placed(("B",), (0, x // 2, 0, 0))),
        "B": CellContent("B", placed=placed(("C",), (0, x - x // 2, 0, 0))),
        "C": CellContent("C", {(1, 0): [BAR]}),
    }
    if fits:
        assert [
            at
            for every in told(MaskContent("G", 1.0, cells), "A").values()
            for at in every
        ] == [(x, 0)]
    else:
        with pytest.raises(MaskFileError, match="beyond 32 bits"):
            told(MaskContent("G", 1.0, cells), "A")


def test_a_hierarchy_may_be_sixty_five_deep_and_not_without_end():
    cells = {
        f"C{k}": CellContent(f"C{k}", placed=placed((f"C{k + 1}",), (0, 3, 1, 0)))
        for k in range(66)
    }
    cells["C66"] = CellContent("C66", {(1, 0): [BAR]})
    cells["C65"] = CellContent("C65", {(1, 0): [BAR]})
    assert [
        at
        for every in told(MaskContent("G", 1.0, cells), "C0").values()
        for at in every
    ] == [(195, 65)]
    cells["C65"] = CellContent(
        "C65", placed=placed(("C66", "C0"), (0, 0, 0, 0), (1, 0, 0, 0))
    )
    with pytest.raises(MaskFileError, match="places itself through C0 > C1"):
        told(MaskContent("G", 1.0, cells), "C0")
    with pytest.raises(MaskFileError, match="'NONE' is placed"):
        told(
            MaskContent(
                "G",
                1.0,
                {"T": CellContent("T", placed=placed(("NONE",), (0, 0, 0, 0)))},
            ),
            "T",
        )
