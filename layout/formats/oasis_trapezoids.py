"""The trapezoids of OASIS: three records with two slopes, and 26 compact ones (SEMI
P39, figures of CTRAPEZOID).
"""

import numpy as np

from metalens.core.arrays import Array

# corners of the compact trapezoids as (x, y), each a sum of w and h: "w-h" or "2h"
_TABLE = """
0,0 0,h w-h,h w,0
0,0 0,h w,h w-h,0
0,0 h,h w,h w,0
h,0 0,h w,h w,0
0,0 h,h w-h,h w,0
h,0 0,h w,h w-h,0
0,0 h,h w,h w-h,0
h,0 0,h w-h,h w,0
0,0 0,h w,h-w w,0
0,0 0,h-w w,h w,0
0,0 0,h w,h w,w
0,w 0,h w,h w,0
0,0 0,h w,h-w w,w
0,w 0,h-w w,h w,0
0,0 0,h-w w,h w,w
0,w 0,h w,h-w w,0
0,0 0,w w,0
0,0 0,w w,w
0,0 w,w w,0
0,w w,w w,0
0,0 h,h 2h,0
0,h 2h,h h,0
0,0 0,2w w,w
0,w w,2w w,0
0,0 0,h w,h w,0
0,0 0,w w,w w,0
"""
_CORNERS = _TABLE.strip().splitlines()
KINDS = len(_CORNERS)


def compact_trapezoid(kind: int, w: int, h: int) -> Array:
    """(n, 2) corners of a compact trapezoid.

    Args:
        kind: 0 to 25.
        w: width.
        h: height.
    """
    value = {
        "0": 0,
        "w": w,
        "h": h,
        "w-h": w - h,
        "h-w": h - w,
        "2h": 2 * h,
        "2w": 2 * w,
    }
    return np.array(
        [[value[c] for c in corner.split(",")] for corner in _CORNERS[kind].split()],
        np.int64,
    )


def required_sides(kind: int) -> tuple[bool, bool]:
    """Whether kind needs a width and a height of its own."""
    text = _CORNERS[kind]
    return "w" in text, "h" in text


def dependent_size(kind: int, w: int, h: int) -> tuple[int, int]:
    """Width and height, of which a compact trapezoid of one size sets the other.

    Args:
        kind: 0 to 25.
        w: width; not used by kinds 20 and 21.
        h: height; not used by kinds 16 to 19, 22, 23 and 25.
    """
    if kind in (16, 17, 18, 19, 25):
        return w, w
    if kind in (20, 21):
        return 2 * h, h
    if kind in (22, 23):
        return w, 2 * w
    return w, h


def slanted_trapezoid(w: int, h: int, a: int, b: int, *, upright: bool) -> Array:
    """(4, 2) corners of a trapezoid within a box.

    Args:
        w: width of the box.
        h: height of the box.
        a: offset of one end of the first slanted side from the other.
        b: the same of the second slanted side.
        upright: whether the parallel sides are upright.
    """
    if upright:
        corners = [
            (0, max(a, 0)),
            (0, h + min(b, 0)),
            (w, h - max(b, 0)),
            (w, -min(a, 0)),
        ]
    else:
        corners = [
            (max(a, 0), h),
            (w + min(b, 0), h),
            (w - max(b, 0), 0),
            (-min(a, 0), 0),
        ]
    return np.array(corners, np.int64)
