"""Formulas of database pages with the fewest coefficients and the most, their slopes,
tables at and between rows.
"""

import math

import numpy as np
import pytest

from metalens.cell import database
from metalens.cell.database import DispersionFormula, TabulatedIndex
from metalens.core.errors import MaterialError

W = 0.73


def page(number, coefficients, span="0.4 1.1", key="wavelength_range"):
    words = " ".join(map(str, coefficients))
    return f"DATA:\n  - type: formula {number}\n    {key}: {span}\n    coefficients: {words}\n"


FEWEST = [
    (1, (0.2, 0.9, 0.15), lambda w: math.sqrt(1.2 + 0.9 * w**2 / (w**2 - 0.0225))),
    (2, (0.2, 0.9, 0.15), lambda w: math.sqrt(1.2 + 0.9 * w**2 / (w**2 - 0.15))),
    (3, (2.1, 0.3, -1.7), lambda w: math.sqrt(2.1 + 0.3 * w**-1.7)),
    (
        4,
        (2.1, 0.3, 1.4, 0.35, 2.6),
        lambda w: math.sqrt(2.1 + 0.3 * w**1.4 / (w**2 - 0.35**2.6)),
    ),
    (5, (1.4, 0.03, -2.2), lambda w: 1.4 + 0.03 * w**-2.2),
    (6, (0.3, 0.07, 41.0), lambda w: 1.3 + 0.07 / (41.0 - 1 / w**2)),
    (7, (1.7, 0.09), lambda w: 1.7 + 0.09 / (w**2 - 0.028)),
    (
        8,
        (0.21, 0.06, 0.03),
        lambda w: (lambda p: math.sqrt((1 + 2 * p) / (1 - p)))(
            0.21 + 0.06 * w**2 / (w**2 - 0.03)
        ),
    ),
    (9, (2.3, 0.04, 0.05), lambda w: math.sqrt(2.3 + 0.04 / (w**2 - 0.05))),
]
MORE = [
    (1, (0.2, 0.9, 0.15, -0.3, 0.22, 0.07, 6.0), lambda w: math.sqrt(
        1.2 + 0.9 * w**2 / (w**2 - 0.15**2) - 0.3 * w**2 / (w**2 - 0.22**2) + 0.07 * w**2 / (w**2 - 36))),
    (4, (2.1, 0.3, 1.4, 0.35, 2.6, -0.2, 0.6, 0.31, 1.9), lambda w: math.sqrt(
        2.1 + 0.3 * w**1.4 / (w**2 - 0.35**2.6) - 0.2 * w**0.6 / (w**2 - 0.31**1.9))),
    (4, (2.1, 0.3, 1.4, 0.35, 2.6, -0.2, 0.6, 0.31, 1.9, 0.11, 1.3, -0.05, 2.7), lambda w: math.sqrt(
        2.1 + 0.3 * w**1.4 / (w**2 - 0.35**2.6) - 0.2 * w**0.6 / (w**2 - 0.31**1.9) + 0.11 * w**1.3 - 0.05 * w**2.7)),
    (7, (1.7, 0.09, -0.013, 0.02), lambda w: 1.7 + 0.09 / (w**2 - 0.028) - 0.013 / (w**2 - 0.028) ** 2 + 0.02 * w**2),
    (9, (2.3, 0.04, 0.05, 0.6, 0.9, 0.4), lambda w: math.sqrt(
        2.3 + 0.04 / (w**2 - 0.05) + 0.6 * (w - 0.9) / ((w - 0.9) ** 2 + 0.4))),
]  # fmt: skip


@pytest.mark.parametrize(("number", "coefficients", "plain"), FEWEST + MORE)
def test_a_formula_is_that_of_the_database_with_its_slope(number, coefficients, plain):
    """Differences of 1e-5 lose 1e-10 of their third derivative, and 1e-11 to rounding."""
    n, k, _ = database.parse_page(page(number, coefficients), "here")
    assert k is None
    assert n.range_um == (0.4, 1.1)
    value, slope = n.at(W)
    assert value == pytest.approx(plain(W), rel=1e-13)
    assert slope.real == pytest.approx(
        (plain(W + 1e-5) - plain(W - 1e-5)) / 2e-5, rel=1e-7, abs=1e-9
    )
    assert (value.imag, slope.imag) == (0, 0)


@pytest.mark.parametrize(
    ("number", "coefficients"), [(number, given) for number, given, _ in FEWEST]
)
def test_one_coefficient_fewer_says_nothing(number, coefficients):
    with pytest.raises(
        MaterialError,
        match=f"{len(coefficients) - 1} coefficients, range .* need formula 1 to 9",
    ):
        database.parse_page(page(number, coefficients[:-1]), "here")


@pytest.mark.parametrize(("number", "most"), [(7, 6), (8, 4), (9, 6)])
def test_as_many_coefficients_as_a_formula_has_are_taken_and_no_more(number, most):
    given = (1.2, 0.01, 0.02, 0.03, 0.9, 0.4, 0.1)
    assert (
        database.parse_page(page(number, given[:most]), "here")[0].coefficients
        == given[:most]
    )
    with pytest.raises(
        MaterialError,
        match=f"{most + 1} coefficients, the last of them of no whole term",
    ):
        database.parse_page(page(number, given[: most + 1]), "here")


def test_ranges_come_from_either_word_in_either_order():
    for key in ("wavelength_range", "range"):
        n, *_ = database.parse_page(page(5, (1.4, 0.03, -2.2), "1.3 0.45", key), "here")
        assert n.range_um == (0.45, 1.3)
        assert n.where == "here, formula 5"
    with pytest.raises(MaterialError, match=r"range \['1.3'\]"):
        database.parse_page(page(5, (1.4, 0.03, -2.2), "1.3"), "here")


@pytest.mark.parametrize("square", [-0.2, 0.0])
def test_no_real_index_is_no_index(square):
    """n² = square at any wavelength."""
    formula = DispersionFormula(3, (square, 0.0, 1.0), (0.4, 0.9), "here, formula 3")
    with pytest.raises(MaterialError, match="here, formula 3 gives n = "):
        formula.at(0.6)
    assert DispersionFormula(3, (0.04, 0.0, 1.0), (0.4, 0.9), "here").at(0.6)[
        0
    ] == pytest.approx(0.2, rel=1e-12)


def test_tables_are_straight_between_rows_and_take_the_slope_of_the_piece_that_begins():
    """At the last row, that of the last piece."""
    table = TabulatedIndex(np.array([[0.4, 0.5, 0.8], [2.0, 1.7, 1.1]]))
    assert table.range_um == (0.4, 0.8)
    for wavelength, value, slope in (
        (0.4, 2.0, -3),
        (0.46, 1.82, -3),
        (0.5, 1.7, -2),
        (0.7, 1.3, -2),
        (0.8, 1.1, -2),
    ):
        got = table.at(wavelength)
        assert got[0] == pytest.approx(value, rel=1e-12)
        assert got[1] == pytest.approx(slope, rel=1e-12)


def nk(rows):
    lines = "".join(f"        {row}\n" for row in rows)
    return f"DATA:\n  - type: tabulated nk\n    data: |\n{lines}"


def test_tables_of_two_and_three_columns_are_told_apart_and_sorted():
    text = (
        "DATA:\n  - type: tabulated k\n    data: |\n        0.9, 0.07\n        0.5, 0.01\n"
        "  - type: tabulated n\n    data: |\n        0.8 1.6\n\n        0.4 1.9\n        0.6 1.7\n"
    )
    n, k, source = database.parse_page(text, "here")
    assert n.rows.tolist() == [[0.4, 0.6, 0.8], [1.9, 1.7, 1.6]]
    assert k.rows.tolist() == [[0.5, 0.9], [0.01, 0.07]]
    assert source == "a page of refractiveindex.info"
    both = nk(["0.5 1.5 0.2", "0.4 1.6 0.1"])
    n, k, source = database.parse_page(
        "COMMENTS: at <b>20</b> C\nREFERENCES: A. B,\n" + both, "here"
    )
    assert n.rows.tolist() == [[0.4, 0.5], [1.6, 1.5]]
    assert k.rows.tolist() == [[0.4, 0.5], [0.1, 0.2]]
    assert source == "A. B, at 20 C"


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        (["0.5 1.5 0.1", "0.6 1.4"], "row 2: '0.6 1.4'; need 3 finite numbers"),
        (["0.5 1.5 0.1", "0.6 inf 0.1"], "row 2"),
        (["0.0 1.5 0.1", "0.6 1.4 0.1"], "row 1"),
        (["0.5 1.5 0.1", "0.5 1.4 0.1"], "1 good rows; need two or more at distinct"),
        (["0.5 1.5 0.1"], "1 good rows; need two"),
        ([], "0 good rows"),
        (["0.5 0.0 0.1", "0.6 1.4 0.1"], "n = 0; need n above 0"),
        (["0.5 1.5 -0.0011", "0.6 1.4 0.1"], "k = -0.0011; need k"),
    ],
)
def test_bad_rows_are_named(rows, told):
    with pytest.raises(MaterialError, match=told):
        database.parse_page(nk(rows), "here")


def test_noise_down_to_a_thousandth_below_nothing_and_two_rows_are_taken():
    n, k, _ = database.parse_page(nk(["0.5 1e-9 -0.001", "0.5000001 1.4 0.1"]), "here")
    assert n.rows[1].tolist() == [1e-9, 1.4]
    assert k.rows[1].tolist() == [-0.001, 0.1]
