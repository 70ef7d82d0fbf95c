"""What parts the columns of a line of a table, and which commas are decimal."""

import pytest

from metalens.core import reading


@pytest.mark.parametrize(
    ("line", "told", "words"),
    [
        ("840.5 0.3", (None, True), ["840.5", "0.3"]),  # of which there are none
        ("840,5 0,3", (None, True), ["840.5", "0.3"]),
        ("840,5;0,3", (";", True), ["840.5", "0.3"]),
        ("840.5,0.3", (",", False), ["840.5", "0.3"]),
        ("840, 0.3", (",", False), ["840", "0.3"]),
        (
            "480,0.5 1.2",
            (",", False),
            ["480", "0.5", "1.2"],
        ),  # one word with a comma is no decimal notation
        (
            "wavelength,index of refraction",
            (",", False),
            ["wavelength", "index", "of", "refraction"],
        ),
    ],
)
def test_commas_are_decimal_where_every_number_has_one_or_a_semicolon_parts(
    line, told, words
):
    assert reading.column_separator(line) == told
    assert reading.split_columns(line) == words
