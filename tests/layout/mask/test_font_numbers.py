"""Letters as rectangles: bits of some glyphs drawn here, places and lengths of lines,
joints of half a square.
"""

import numpy as np
import pytest

from layout.mask import font
from metalens.core.errors import ProcessError

DRAWN = {
    "F": ["#####", "#....", "#....", "####.", "#....", "#....", "#...."],
    "4": ["...#.", "..##.", ".#.#.", "#..#.", "#####", "...#.", "...#."],
    "R": ["####.", "#...#", "#...#", "####.", "#.#..", "#..#.", "#...#"],
    "/": [".....", "....#", "...#.", "..#..", ".#...", "#....", "....."],
    ",": [".....", ".....", ".....", ".....", "..#..", "..#..", ".#..."],
}


def filled(words, square, x, y):
    """(7, 6 n) halves of squares that the rectangles cover, doubled both ways, row 0
    the topmost; nothing twice.
    """
    half = square // 2
    image = np.zeros((14, 12 * len(words)), int)
    for box in font.text_rectangles(words, x=x, y=y, square=square):
        (left, bottom), (right, top) = box.min(0).tolist(), box.max(0).tolist()
        sides = [left - x, right - x, bottom - y, top - y]
        assert not any(side % half for side in sides)
        a, b, c, d = (side // half for side in sides)
        image[14 - d : 14 - c, a:b] += 1
    assert image.max() == 1
    return image


def expected(words):
    image = np.zeros((14, 12 * len(words)), int)
    for n, letter in enumerate(words):
        for row, bits in enumerate(DRAWN[letter]):
            for column, bit in enumerate(bits):
                if bit == "#":
                    image[
                        2 * row : 2 * row + 2,
                        12 * n + 2 * column : 12 * n + 2 * column + 2,
                    ] = 1
    return image


@pytest.mark.parametrize("words", ["F", "4", "F4", "R/,4F"])
def test_letters_are_their_bits_and_small_squares_where_corners_meet(words):
    """Where two squares meet at a corner alone, a half square on either side of it
    joins them: of the two empty squares
    at the corner the upper one's lower inner half, and the lower one's upper inner
    half."""
    bits = expected(words)
    want = bits.copy()
    for row in range(1, 7):
        for column in range(1, 6 * len(words)):
            if column % 6 in (0, 5):
                continue
            square = bits[
                2 * row - 2 : 2 * row + 1 : 2, 2 * column - 2 : 2 * column + 1 : 2
            ].tolist()
            if square == [[0, 1], [1, 0]]:
                want[2 * row - 1, 2 * column - 1] = want[2 * row, 2 * column] = 1
            if square == [[1, 0], [0, 1]]:
                want[2 * row - 1, 2 * column] = want[2 * row, 2 * column - 1] = 1
    assert np.array_equal(filled(words, 14, -37, 211), want)


def test_small_letters_are_capitals_and_unknown_ones_are_named():
    assert [b.tolist() for b in font.text_rectangles("f4", x=5, y=7, square=6)] == [
        b.tolist() for b in font.text_rectangles("F4", x=5, y=7, square=6)
    ]
    with pytest.raises(
        ProcessError, match="label 'A!': no '!' in the font; use letters, digits and # "
    ):
        font.text_rectangles("A!", x=0, y=0, square=2)
    assert font.text_rectangles(" ", x=0, y=0, square=2) == ()


@pytest.mark.parametrize(
    ("words", "squares"), [("", 0), ("A", 5), ("AB", 11), ("A LONG LINE", 65)]
)
def test_a_line_is_as_long_as_its_letters_of_five_squares_and_the_gaps_between(
    words, squares
):
    assert font.text_width(words, 34) == 34 * squares


def test_every_letter_stands_in_five_columns_of_seven_rows():
    for letter in "ABCDEGHIJKLMNOPQSTUVWXYZ0123456789":
        image = filled(letter, 2, 0, 0)
        assert not image[:, 10:].any()
        assert image[:2].any()
        assert image[12:].any()
