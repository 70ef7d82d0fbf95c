"""The arithmetic of the scene model in compiled kernels: on float32, and on dual
numbers (value, tangent, tangent).

A tile ``x`` is a flat array of float32 lanes; ``words`` are the integers of its texture
samples. Dual numbers take
three runs of lanes: their values, then both tangents.
"""

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from codesign.eye.textures import SIZE, STEPS

SETTINGS: dict[str, Any] = {"fastmath": True, "error_model": "numpy"}
f32, i32 = np.float32, np.int32
inside = numba.njit(forceinline=True, **SETTINGS)
Operations = dict[str, Callable[..., Any]]


@inside  # type: ignore[untyped-decorator]
def locate(index: Any, u: Any, v: Any, words: Any, to: Any, lanes: Any) -> Any:
    """Leave the places of the pairs of texture pixels above and below (u, v), and
    return the parts of a pixel.

    Textures repeat; their size is a power of two. The casts keep numba from widening to
    64 bits.
    """
    first, last = i32(index) * i32(SIZE * SIZE), i32(SIZE - 1)
    fu, fv = np.floor(u), np.floor(v)
    i, j = i32(i32(fu) & last), i32(i32(fv) & last)
    below = i32(i32(j + i32(1)) & last)
    words[to] = i32(first + i32(i32(j * i32(SIZE)) + i))
    words[to + lanes] = i32(first + i32(i32(below * i32(SIZE)) + i))
    return u - fu, v - fv


@inside  # type: ignore[untyped-decorator]
def look_up(t: Any, words: Any, count: Any) -> None:
    """Put the pairs of texture pixels in place of where they are found."""
    for lane in range(count):
        words[lane] = t[np.uint32(words[lane])]


@inside  # type: ignore[untyped-decorator]
def blend(s: Any, t: Any, top: Any, bottom: Any) -> Any:
    """A sample between four pixels, and its slopes; see :func:`codesign.eye.ops.tex`."""
    half, k = i32(16), f32(1 / STEPS)
    a, b = f32(i32(i32(top << half) >> half)), f32(i32(top >> half))
    c, d = f32(i32(i32(bottom << half) >> half)), f32(i32(bottom >> half))
    ds, dt = f32(6) * s * (f32(1) - s) * k, f32(6) * t * (f32(1) - t) * k
    s, t = s * s * (f32(3) - f32(2) * s), t * t * (f32(3) - f32(2) * t)
    above, below = a + (b - a) * s, c + (d - c) * s
    return (
        (above + (below - above) * t) * k,
        ds * ((b - a) + ((d - c) - (b - a)) * t),
        dt * (below - above),
    )


@inside  # type: ignore[untyped-decorator]
def smooth(x: Any) -> Any:
    """Smooth step from 0 at x = -1 to 1 at x = 1, and its slope."""
    t = min(max(f32(0.5) + f32(0.5) * x, f32(0)), f32(1))
    return t * t * (f32(3) - f32(2) * t), f32(3) * t * (f32(1) - t)


def plain(lanes: int) -> Operations:
    """On float32; operators are Python's own."""

    def store(value: Any, x: Any, at: Any) -> None:
        x[at] = value

    def placed(
        index: Any, u: Any, v: Any, x: Any, at: Any, words: Any, to: Any
    ) -> None:
        x[at], x[at + lanes] = locate(index, u, v, words, to, lanes)

    def sampled(x: Any, at: Any, words: Any, to: Any) -> Any:
        return blend(x[at], x[at + lanes], words[to], words[to + lanes])[0]

    return {
        "number": lambda value: f32(value),
        "load": lambda p, i: p[i],
        "fixed": lambda p, i: p[i],
        "fetch": lambda x, at: x[at],
        "store": store,
        "sqrt": lambda x: math.sqrt(x),
        "unit": lambda x: min(max(x, f32(0)), f32(1)),
        "above": lambda x, least: max(x, least),
        "step": lambda x: smooth(x)[0],
        "placed": placed,
        "sampled": sampled,
    }


def dual(lanes: int) -> Operations:
    """On dual numbers."""
    two, three, four, five = (k * lanes for k in (2, 3, 4, 5))

    def div(a: Any, b: Any) -> Any:
        k = f32(1) / b[0]
        v = a[0] * k
        return (v, (a[1] - v * b[1]) * k, (a[2] - v * b[2]) * k)

    def sqrt(x: Any) -> Any:
        v = math.sqrt(x[0])
        k = f32(0.5) / v
        return (v, k * x[1], k * x[2])

    def unit(x: Any) -> Any:
        k = f32(1) if f32(0) < x[0] < f32(1) else f32(0)
        return (min(max(x[0], f32(0)), f32(1)), k * x[1], k * x[2])

    def above(x: Any, least: Any) -> Any:
        k = f32(1) if x[0] > least[0] else f32(0)
        return (max(x[0], least[0]), k * x[1], k * x[2])

    def step(x: Any) -> Any:
        value, k = smooth(x[0])
        return (value, k * x[1], k * x[2])

    def store(value: Any, x: Any, at: Any) -> None:
        x[at], x[at + lanes], x[at + two] = value

    def placed(
        index: Any, u: Any, v: Any, x: Any, at: Any, words: Any, to: Any
    ) -> None:
        x[at], x[at + three] = locate(index[0], u[0], v[0], words, to, lanes)
        x[at + lanes], x[at + two] = u[1], u[2]
        x[at + four], x[at + five] = v[1], v[2]

    def sampled(x: Any, at: Any, words: Any, to: Any) -> Any:
        value, du, dv = blend(x[at], x[at + three], words[to], words[to + lanes])
        first, second = (
            du * x[at + lanes] + dv * x[at + four],
            du * x[at + two] + dv * x[at + five],
        )
        return (value, first, second)

    return {
        "add": lambda a, b: (a[0] + b[0], a[1] + b[1], a[2] + b[2]),
        "sub": lambda a, b: (a[0] - b[0], a[1] - b[1], a[2] - b[2]),
        "mul": lambda a, b: (
            a[0] * b[0],
            a[0] * b[1] + a[1] * b[0],
            a[0] * b[2] + a[2] * b[0],
        ),
        "div": div,
        "neg": lambda a: (-a[0], -a[1], -a[2]),
        "number": lambda value: (f32(value), f32(0), f32(0)),
        "load": lambda p, i: (p[0, i], p[1, i], p[2, i]),
        "fixed": lambda p, i: (p[0, i], f32(0), f32(0)),
        "fetch": lambda x, at: (x[at], x[at + lanes], x[at + two]),
        "store": store,
        "sqrt": sqrt,
        "unit": unit,
        "above": above,
        "step": step,
        "placed": placed,
        "sampled": sampled,
    }
