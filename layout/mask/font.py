"""Letters of 5 x 7 squares for labels: rectangles only, so that any writer draws them
exactly.
"""

import numpy as np

from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

# seven rows from top to bottom, five bits each, leftmost highest, as two hexadecimal
# digits a row
_TABLE = """
A0e11111f111111 B1e11111e11111e C0e11101010110e D1e11111111111e
E1f10101e10101f F1f10101e101010 G0e11101713110f H1111111f111111
I0e04040404040e J0702020202120c K11121418141211 L1010101010101f
M111b1515111111 N11191915131311 O0e11111111110e P1e11111e101010
Q0e11111115120d R1e11111e141211 S0f10100e01011e T1f040404040404
U1111111111110e V11111111110a04 W1111111515150a X11110a040a1111
Y11110a04040404 Z1f01020408101f 00e11131519110e 1040c040404040e
20e11010204081f 31f02040201110e 402060a121f0202 51f101e0101110e
60608101e11110e 71f010204080808 80e11110e11110e 90e11110f01020c
-0000001f000000 +0004041f040400 .00000000000c0c ,00000000040408
:000c0c000c0c00 /00010204081000 _0000000000001f =00001f001f0000
(02040808080402 )08040202020408 #0a0a1f0a1f0a0a
"""
_GLYPHS = {" ": 14 * "0"} | {word[0]: word[1:] for word in _TABLE.split()}


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
