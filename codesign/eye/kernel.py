"""The scene model compiled: float32 for frames, dual numbers of two tangents for exact
derivatives.

The source of :mod:`codesign.eye.model` is compiled twice by numba, with two sets of
elementary functions. Pixels are
shaded in tiles, in passes over all lanes of a tile; a pass that no pixel of the tile
needs is left out.

All passes are put into the one function that loops over tiles. A function that is
called is optimised by itself, and
once more inside the library of its caller; a process that has just compiled them runs
the first, one that takes them
from the cache the second, and with sums in any order (``fastmath``) these round
otherwise.
"""

import inspect
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from codesign.eye import inline as render_inline
from codesign.eye import lanes as render_lanes
from codesign.eye import model
from codesign.eye.lanes import SETTINGS, f32, inside
from metalens.core import threads
from metalens.core.arrays import Array

COLUMNS = 16  # of a tile: a vector register of float32, or two
ROWS, DUAL_ROWS = (
    4,
    2,
)  # of a tile: independent work for a processor's pipelines, within its nearest cache
SAMPLES = 4  # texture samples in a pass, at most

# what a tile holds, in this order, and the assignments between these names
NAMES = (
    "u", "w", "dx", "dy", "dz", "s", "gx", "gy", "upper", "lower", "nx", "ny", "nz", "ts", "mx", "my", "mz",
    "tc", "cx", "cy", "cz", "inside", "seen", "bare", "front", "near", "disc", "pupil", "brown", "virtual", "r",
    "white", "far", "back", "hole", *(f"{axis} of sample {k}" for k in range(SAMPLES) for axis in "uv"),
)  # fmt: skip
FIRST_SHADED, LAST_SHADED = (
    "near",
    "u of sample 0",
)  # from the first to before the last: 0 where nothing shades
FACE = """
dx, dy, dz = ray(u, w)
s, seen, gx, gy, upper, lower, nx, ny, nz = lids(p, dx, dy, dz)
bare, front = 1.0 - seen, s * dz
"""
SKIN = "near = skin(p, t, s, gx, gy, upper, lower, dx, dy, dz, nx, ny, nz) * bare"
GLOBE = """
ts, mx, my, mz = globe(p, dx, dy, dz)
tc, cx, cy, cz, inside = cornea(p, dx, dy, dz)
"""
IRIS = "disc, pupil, r, brown, virtual = iris(p, t, tc, cx, cy, cz, inside, dx, dy, dz)"
WHITE = "white = sclera(p, t, gx, gy, lower, mx, my, mz, r, inside)"
LIGHT = """
far = shade(p, white, brown, disc, pupil, inside, upper, lower, ts, mx, my, mz, tc, cx, cy, cz, dx, dy, dz) * seen
back, hole = (ts + disc * (tc + virtual - ts)) * dz, pupil * seen
"""


@dataclass(frozen=True, eq=False, slots=True)
class _Tile:
    """The shading of a tile, compiled on some operations.

    lanes: pixels in a tile. at: first lane of every name. size: lanes of all names.
    words: integers of the samples.
    shade: function of parameters, textures, tile and words; finds all that follows from
    the rays in the tile.
    """

    lanes: int
    at: dict[str, int]
    size: int
    words: int
    shade: Any


def _tile(
    operations: Callable[[int], render_lanes.Operations], rows: int, *, dual: bool
) -> _Tile:
    lanes = rows * COLUMNS
    width = (3 if dual else 1) * lanes
    at = {name: k * width for k, name in enumerate(NAMES)}
    space = {name: inside(function) for name, function in operations(lanes).items()}
    space["look_up"] = render_lanes.look_up
    passes = []
    for source in (FACE, SKIN, GLOBE, IRIS, WHITE, LIGHT):
        scope = dict(space)
        text = render_inline.loops(source, at, lanes=lanes, dual=dual)
        exec(compile(text, "<pass of the scene model>", "exec"), scope)
        passes.append(inside(scope["run"]))
    return _Tile(
        lanes, at, len(NAMES) * width, 2 * SAMPLES * lanes, _shading(passes, at, lanes)
    )


def _shading(passes: list[Any], at: dict[str, int], lanes: int) -> Any:
    """All passes over a tile, each where a pixel needs it; what is left out is 0."""
    face, skin, globe, iris, white, light = passes
    seen, met, disc, first, last = (
        at[name] for name in ("seen", "inside", "disc", FIRST_SHADED, LAST_SHADED)
    )

    @inside  # type: ignore[untyped-decorator]
    def shade(p: Any, t: Any, x: Any, words: Any) -> None:
        for lane in range(first, last):
            x[lane] = f32(0)
        face(p, t, x, words)
        if _least(x, seen, lanes) < f32(1):
            skin(p, t, x, words)
        if _most(x, seen, lanes) > f32(0):
            globe(p, t, x, words)
            if _most(x, met, lanes) > f32(0):
                iris(p, t, x, words)
            if _least(x, disc, lanes) < f32(1):
                white(p, t, x, words)
            light(p, t, x, words)

    return shade


@inside  # type: ignore[untyped-decorator]
def _least(x: Any, at: Any, lanes: Any) -> Any:
    value = x[at]
    for lane in range(1, lanes):
        value = min(value, x[at + lane])
    return value


@inside  # type: ignore[untyped-decorator]
def _most(x: Any, at: Any, lanes: Any) -> Any:
    value = x[at]
    for lane in range(1, lanes):
        value = max(value, x[at + lane])
    return value


@inside  # type: ignore[untyped-decorator]
def _aim(u: Any, w: Any, row: Any, column: Any, x: Any, width: Any, rows: Any) -> None:
    """Tangents of the rays of a tile; lanes beyond the frame repeat its last row and
    column.
    """
    for j in range(rows):
        y = w[min(row + j, len(w) - 1)]
        for i in range(COLUMNS):
            x[j * COLUMNS + i] = u[min(column + i, len(u) - 1)]
            x[width + j * COLUMNS + i] = y


@inside  # type: ignore[untyped-decorator]
def _put(
    x: Any, at: Any, rows: Any, out: Any, n: Any, k: Any, row: Any, column: Any
) -> None:
    """Copy the part of a tile's lanes that lies in the frame to plane (n, k) of
    ``out``.
    """
    for j in range(min(rows, out.shape[2] - row)):
        if column + COLUMNS <= out.shape[3]:
            for i in range(COLUMNS):
                out[n, k, row + j, column + i] = x[at + j * COLUMNS + i]
        else:
            for i in range(out.shape[3] - column):
                out[n, k, row + j, column + i] = x[at + j * COLUMNS + i]


_PLAIN = _tile(render_lanes.plain, ROWS, dual=False)
_DUAL = _tile(render_lanes.dual, DUAL_ROWS, dual=True)
# globals: a compiled function that a loop closes over enters the key of numba's cache
# by a name that is never the same
_shade, _shade_dual = _PLAIN.shade, _DUAL.shade


def _frames(stamp: int) -> Any:
    """The loop over tiles; ``stamp`` of the sources enters the key of numba's cache on
    disk.
    """
    tile = _PLAIN
    size, count, lanes = tile.size, tile.words, tile.lanes
    seen, bare, front, near, far, back, hole = (
        tile.at[name]
        for name in ("seen", "bare", "front", "near", "far", "back", "hole")
    )

    @numba.njit(nogil=True, cache=True, **SETTINGS)  # type: ignore[untyped-decorator]
    def frames(
        first: int, end: int, parameters: Array, scale: Array, bank: Array, u: Array, w: Array,
        light: Array, cover: Array, depth: Array, pupil: Array,
    ) -> None:  # fmt: skip
        """Strips of frames from the first to before the end; see :func:`render`. What
        is hidden is not shaded.
        """
        if stamp == 0:
            return
        strips = (len(w) + ROWS - 1) // ROWS
        for job in range(first, end):
            n, row = job // strips, job % strips * ROWS
            x, words = np.empty(size, np.float32), np.empty(count, np.int32)
            for column in range(0, len(u), COLUMNS):
                _aim(u, w, row, column, x, lanes, ROWS)
                _shade(parameters[n], bank, x, words)
                for lane in range(lanes):
                    x[front + lane] *= scale[n]
                    x[back + lane] *= scale[n]
                _put(x, near, ROWS, light, n, 0, row, column)
                _put(x, far, ROWS, light, n, 1, row, column)
                _put(x, bare, ROWS, cover, n, 0, row, column)
                _put(x, seen, ROWS, cover, n, 1, row, column)
                _put(x, front, ROWS, depth, n, 0, row, column)
                _put(x, back, ROWS, depth, n, 1, row, column)
                _put(x, hole, ROWS, pupil, n, 0, row, column)

    return frames


def _tangents(stamp: int) -> Any:
    tile = _DUAL
    size, count, lanes = tile.size, tile.words, tile.lanes
    near, far, seen, front, back = (
        tile.at[name] for name in ("near", "far", "seen", "front", "back")
    )

    @numba.njit(nogil=True, cache=True, **SETTINGS)  # type: ignore[untyped-decorator]
    def tangents(
        first: int,
        end: int,
        parameters: Array,
        bank: Array,
        u: Array,
        w: Array,
        out: Array,
    ) -> None:
        """Strips of frames from the first to before the end; see :func:`differentiate`."""
        if stamp == 0:
            return
        strips = (len(w) + DUAL_ROWS - 1) // DUAL_ROWS
        for job in range(first, end):
            n, row = job // strips, job % strips * DUAL_ROWS
            x, words = np.zeros(size, np.float32), np.empty(count, np.int32)
            for column in range(0, len(u), COLUMNS):
                _aim(u, w, row, column, x, 3 * lanes, DUAL_ROWS)
                _shade_dual(parameters[n], bank, x, words)
                for k in range(3):
                    _put(x, near + k * lanes, DUAL_ROWS, out, n, 5 * k, row, column)
                    _put(x, far + k * lanes, DUAL_ROWS, out, n, 5 * k + 1, row, column)
                    _put(x, seen + k * lanes, DUAL_ROWS, out, n, 5 * k + 2, row, column)
                    _put(
                        x, front + k * lanes, DUAL_ROWS, out, n, 5 * k + 3, row, column
                    )
                    _put(x, back + k * lanes, DUAL_ROWS, out, n, 5 * k + 4, row, column)

    return tangents


_stamp = 1 + zlib.crc32(
    "".join(map(inspect.getsource, (model, render_inline, render_lanes))).encode()
)
frames, tangents = _frames(_stamp), _tangents(_stamp)


def render(
    parameters: Array, scale: Array, bank: Array, u: Array, w: Array, light: Array, cover: Array, depth: Array,
    pupil: Array,
) -> None:  # fmt: skip
    """Render frames: parameters (n, COUNT), scale (n,) of the depths, tangents u (x,),
    w (y,).

    Fills light, cover, depth (n, 2, y, x) and pupil (n, 1, y, x). Sheet 0 is skin,
    sheet 1 the eye; light is
    multiplied by the coverage.
    """
    rest = (parameters, scale, bank, u, w, light, cover, depth, pupil)
    threads.run_split(
        len(parameters) * -(-len(w) // ROWS),
        lambda first, end: frames(first, end, *rest),
    )


def differentiate(
    parameters: Array, bank: Array, u: Array, w: Array, out: Array
) -> None:
    """Frames and two directional derivatives: parameters (n, 3, COUNT) hold values and
    two tangents.

    Fills out (n, 3 * 5, y, x): light of skin and eye, coverage of the eye, depth of
    skin and eye; their tangents.
    """
    rest = (parameters, bank, u, w, out)
    threads.run_split(
        len(parameters) * -(-len(w) // DUAL_ROWS),
        lambda first, end: tangents(first, end, *rest),
    )
