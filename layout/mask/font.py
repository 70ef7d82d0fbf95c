"""Letters of 5 x 7 squares for labels: rectangles only, so that any writer draws them
exactly.
"""

import itertools
from collections.abc import Iterator

import numpy as np

from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

# seven rows from top to bottom, five bits each, leftmost highest, as two hexadecimal
# digits a row
_GLYPHS = {
    "A": "0e11111f111111", "B": "1e11111e11111e", "C": "0e11101010110e", "D": "1e11111111111e",
    "E": "1f10101e10101f", "F": "1f10101e101010", "G": "0e11101713110f", "H": "1111111f111111",
    "I": "0e04040404040e", "J": "0702020202120c", "K": "11121418141211", "L": "1010101010101f",
    "M": "111b1515111111", "N": "11191915131311", "O": "0e11111111110e", "P": "1e11111e101010",
    "Q": "0e11111115120d", "R": "1e11111e141211", "S": "0f10100e01011e", "T": "1f040404040404",
    "U": "1111111111110e", "V": "11111111110a04", "W": "1111111515150a", "X": "11110a040a1111",
    "Y": "11110a04040404", "Z": "1f01020408101f", "0": "0e11131519110e", "1": "040c040404040e",
    "2": "0e11010204081f", "3": "1f02040201110e", "4": "02060a121f0202", "5": "1f101e0101110e",
    "6": "0608101e11110e", "7": "1f010204080808", "8": "0e11110e11110e", "9": "0e11110f01020c",
    "-": "0000001f000000", "+": "0004041f040400", ".": "00000000000c0c", ",": "00000000040408",
    ":": "000c0c000c0c00", "/": "00010204081000", "_": "0000000000001f", "=": "00001f001f0000",
    "(": "02040808080402", ")": "08040202020408", "#": "0a0a1f0a1f0a0a", " ": "00000000000000",
}  # fmt: skip


def text_rectangles(words: str, *, x: int, y: int, square: int) -> tuple[Array, ...]:
    """Rectangles of a line of text, small letters as capitals.

    Args:
        words: the line of text.
        x, y: lower left corner, database units.
        square: side of one square of the letters, even, database units.

    Raises:
        ProcessError: a character that the font does not hold.
    """
    return tuple(_rectangles(words, x, y, square))


def text_width(words: str, square: int) -> int:
    """Length of the line.

    Args:
        words: the line of text.
        square: side of one square of the letters.
    """
    return max(len(words) * 6 - 1, 0) * square


def _rectangles(words: str, x: int, y: int, square: int) -> Iterator[Array]:
    """Rectangles of a line of text: runs of squares in each row of a letter.

    Where two rows meet at a corner alone, two half squares join them.

    Args:
        words: the line of text.
        x, y: lower left corner, database units.
        square: side of one square, even.

    Raises:
        ProcessError: a character that the font does not hold.
    """
    for position, letter in enumerate(words.upper()):
        if letter not in _GLYPHS:
            raise ProcessError(
                f"label {words!r}: no {letter!r} in the font; use letters, digits and {_others()}"
            )
        rows = bytes.fromhex(_GLYPHS[letter])
        for row, bits in enumerate(rows):
            bottom = y + (6 - row) * square
            for first, end in _runs(bits):
                yield _box(
                    x + (position * 6 + first) * square,
                    bottom,
                    (end - first) * square,
                    square,
                )
        for row, (above, below) in enumerate(itertools.pairwise(rows)):
            for column, rises in _joints(above, below):
                left = x + (position * 6 + column) * square
                border = y + (6 - row) * square
                half = square // 2
                yield _box(left - half * rises, border, half, half)
                yield _box(left - half * (not rises), border - half, half, half)


def _box(left: int, bottom: int, width: int, height: int) -> Array:
    """(4, 2) corners of a rectangle."""
    return rectilinear.box_corners(
        np.array([left, bottom, left + width, bottom + height])
    )


def _joints(above: int, below: int) -> Iterator[tuple[int, bool]]:
    """Columns at whose left end two rows meet at a corner alone, and whether the upper
    square is the right one.
    """
    for column in range(1, 5):
        left_bit, right_bit = 5 - column, 4 - column
        upper, lower = (
            (bits >> left_bit & 1, bits >> right_bit & 1) for bits in (above, below)
        )
        if {upper, lower} == {(0, 1), (1, 0)}:
            yield column, upper == (0, 1)


def _runs(bits: int) -> Iterator[tuple[int, int]]:
    """(first column, column after the last) of the runs of set bits of a row."""
    columns = [column for column in range(5) if bits >> (4 - column) & 1]
    for column in columns:
        if column - 1 not in columns:
            end = column
            while end in columns:
                end += 1
            yield column, end


def _others() -> str:
    """Characters of the font that are no letters, digits or space."""
    return " ".join(
        sorted(
            character
            for character in _GLYPHS
            if not character.isalnum() and character != " "
        )
    )
