"""Letters of 5 x 7 squares for labels: rectangles only, so that any writer draws them
exactly.
"""

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

    Where two squares meet at a corner alone, two half squares join them.

    Args:
        words: the line of text.
        x, y: lower left corner, database units.
        square: side of one square of the letters, even, database units.

    Raises:
        ProcessError: a character that the font does not hold.
    """
    letters = words.upper()
    unknown = sorted(set(letters) - set(_GLYPHS))
    if unknown:
        others = " ".join(sorted(c for c in _GLYPHS if not c.isalnum() and c != " "))
        raise ProcessError(
            f"label {words!r}: no {unknown[0]!r} in the font; use letters, digits and "
            f"{others}"
        )
    rows = np.array([list(bytes.fromhex(_GLYPHS[c])) for c in letters], np.uint8)
    bits = np.unpackbits(rows.reshape(-1, 7, 1), axis=2)[..., 3:].astype(bool)
    bits = np.pad(bits, ((0, 0), (0, 0), (0, 1))).transpose(1, 0, 2).reshape(7, -1)
    upper_left, upper_right = bits[:-1, :-1], bits[:-1, 1:]
    lower_left, lower_right = bits[1:, :-1], bits[1:, 1:]
    rises = upper_right & lower_left & ~upper_left & ~lower_right
    falls = upper_left & lower_right & ~upper_right & ~lower_left
    halves = bits.repeat(2, axis=0).repeat(2, axis=1)
    above, below = slice(1, -1, 2), slice(2, None, 2)
    halves[above, above] |= rises
    halves[below, below] |= rises
    halves[above, below] |= falls
    halves[below, above] |= falls
    runs = rectilinear.merge_runs(halves) * (square // 2)
    left, top, right, bottom = runs.T
    boxes = np.column_stack([x + left, -bottom, x + right, -top])
    return tuple(
        rectilinear.box_corners(box + [0, y + 7 * square] * 2) for box in boxes
    )


def text_width(words: str, square: int) -> int:
    """Length of the line.

    Args:
        words: the line of text.
        square: side of one square of the letters.
    """
    return max(len(words) * 6 - 1, 0) * square
