"""What a pixel sees, compiled for float32: lids, skin and eye in front of a pinhole."""

import math
from collections import namedtuple
from typing import Any

import numba
import numpy as np

from codesign.eye import model
from codesign.eye.textures import SIZE, STEPS
from metalens.core import threads
from metalens.core.arrays import Array

f32, i32 = np.float32, np.int32
SETTINGS: dict[str, Any] = {"fastmath": True, "error_model": "numpy"}
_inlined = numba.njit(forceinline=True, **SETTINGS)

COLUMNS, ROWS = 16, 4  # of a tile: vector registers, and independent work to fill them
LANES = ROWS * COLUMNS
SAMPLES = 4  # textures that one pass samples, at most
# vectors are tuples of three
Parameters: Any = namedtuple("Parameters", model.NAMES)  # type: ignore[misc]

# first lane of every quantity in a tile; three quantities for a vector
(
    U, W, D, _, _, S, GX, GY, UPPER, LOWER, N, _, _, TS, M, _, _, TC, C, _, _, INSIDE,
    SEEN, BARE, FRONT, NEAR, DISC, PUPIL, BROWN, VIRTUAL, R, WHITE, FAR, BACK, HOLE,
    PLACE,
) = (LANES * k for k in range(36))  # fmt: skip
TILE, WORDS = PLACE + 2 * SAMPLES * LANES, 2 * SAMPLES * LANES


@_inlined  # type: ignore[untyped-decorator]
def _vector(a: Any, at: Any, step: Any) -> Any:
    return a[at], a[at + step], a[at + 2 * step]


@_inlined  # type: ignore[untyped-decorator]
def _put(x: Any, at: Any, v: Any) -> None:
    x[at], x[at + LANES], x[at + 2 * LANES] = v


@_inlined  # type: ignore[untyped-decorator]
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_inlined  # type: ignore[untyped-decorator]
def _blended(a: Any, k: Any, b: Any) -> Any:
    """a + k b."""
    return a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]


@_inlined  # type: ignore[untyped-decorator]
def _scaled(k: Any, a: Any) -> Any:
    return k * a[0], k * a[1], k * a[2]


@_inlined  # type: ignore[untyped-decorator]
def _unit(x: Any) -> Any:
    return min(max(x, f32(0)), f32(1))


@_inlined  # type: ignore[untyped-decorator]
def _step(x: Any) -> Any:
    """Smooth step from 0 at x = -1 to 1 at x = 1."""
    t = _unit(f32(0.5) + f32(0.5) * x)
    return t * t * (f32(3) - f32(2) * t)


@_inlined  # type: ignore[untyped-decorator]
def _bell(x: Any) -> Any:
    """1 / (1 + x²)."""
    return f32(1) / (f32(1) + x * x)


@_inlined  # type: ignore[untyped-decorator]
def _root(x: Any, least: Any) -> Any:
    return math.sqrt(max(x, f32(least)))


@_inlined  # type: ignore[untyped-decorator]
def _locate(index: Any, u: Any, v: Any, x: Any, words: Any, k: Any, lane: Any) -> None:
    """Note the texture pixels about (u, v) for sample k, and the parts of a pixel.

    Textures repeat; their size is a power of two. The casts keep numba from widening to
    64 bits.
    """
    first, last = i32(index) * i32(SIZE * SIZE), i32(SIZE - 1)
    fu, fv = np.floor(u), np.floor(v)
    i, j = i32(i32(fu) & last), i32(i32(fv) & last)
    below = i32(i32(j + i32(1)) & last)
    at = 2 * k * LANES + lane
    words[at] = i32(first + i32(i32(j * i32(SIZE)) + i))
    words[at + LANES] = i32(first + i32(i32(below * i32(SIZE)) + i))
    x[PLACE + at], x[PLACE + at + LANES] = u - fu, v - fv


@_inlined  # type: ignore[untyped-decorator]
def _look_up(t: Any, words: Any, samples: Any) -> None:
    """Put pairs of texture pixels (:func:`codesign.eye.textures.packed_bank`) in place
    of where they are.
    """
    for at in range(2 * samples * LANES):
        words[at] = t[np.uint32(words[at])]


@_inlined  # type: ignore[untyped-decorator]
def _sampled(x: Any, words: Any, k: Any, lane: Any) -> Any:
    """Sample k, blended between four pixels by smooth steps."""
    at, half = 2 * k * LANES + lane, i32(16)
    s, t = x[PLACE + at], x[PLACE + at + LANES]
    top, bottom = words[at], words[at + LANES]
    a, b = f32(i32(i32(top << half) >> half)), f32(i32(top >> half))
    c = f32(i32(i32(bottom << half) >> half))
    d = f32(i32(bottom >> half))
    s, t = s * s * (f32(3) - f32(2) * s), t * t * (f32(3) - f32(2) * t)
    above, below = a + (b - a) * s, c + (d - c) * s
    return (above + (below - above) * t) * f32(1 / STEPS)


@_inlined  # type: ignore[untyped-decorator]
def _sphere(centre: Any, radius: Any, least: Any, d: Any) -> Any:
    """Distance at which a ray meets a sphere, what lies under the root, and the
    direction there from its centre; :data:`least` keeps the root real.
    """
    b = _dot(centre, d)
    off = _blended(centre, -b, d)
    free = radius * radius - _dot(off, off)
    s = b - _root(free, least)
    return s, free, _scaled(f32(1) / radius, _blended(_scaled(s, d), f32(-1), centre))


@_inlined  # type: ignore[untyped-decorator]
def _lids(p: Any, d: Any) -> Any:
    """Front of the face: lid shell and face plane in a smooth union.

    Returns: distance, openness of the lids (1 where the eye is seen), face coordinates
    x and y, gap to the upper and lower margin (above 0 inside the opening), normal.
    """
    shell = _sphere(p.centre, p.lid_r, 1e6, d)[0]
    facing = max(-_dot(d, p.face_z), f32(0.05))
    plane = -_dot(p.plane, p.face_z) / facing
    h = _unit(f32(0.5) + f32(0.5) * (plane - shell) / p.blend)
    s = plane + (shell - plane) * h - f32(0.5) * p.blend * h * (f32(1) - h)
    q = _blended(_scaled(s, d), f32(-1), p.centre)
    n = _blended(_scaled(h / p.lid_r, q), f32(1) - h, p.face_z)
    n = _scaled(f32(1) / math.sqrt(_dot(n, n) + f32(1e-6)), n)
    gx, gy = _dot(q, p.face_x), _dot(q, p.face_y)
    along = (gx - p.middle) / p.half
    arch = f32(1) - along * along
    upper = gy + arch * (p.upper + p.skew * along)
    lower = arch * (p.lower - p.skew * along) - gy
    edges = _step(upper / p.edge) * _step(lower / p.edge)
    return s, edges * _step((upper + lower) / p.edge - f32(1)), gx, gy, upper, lower, n


@_inlined  # type: ignore[untyped-decorator]
def _ambient(p: Any, n: Any) -> Any:
    """Diffuse irradiance: more from above than from below."""
    return p.ambient * (f32(0.6) - f32(0.4) * _dot(n, p.face_y))


@_inlined  # type: ignore[untyped-decorator]
def _lamp(light: Any, at: Any, n: Any, wrap: Any) -> Any:
    """Irradiance of a surface by a small lamp, 1 at 20 mm straight on; it wraps around
    the terminator.
    """
    v = _blended(light, f32(-1), at)
    k = f32(1) / math.sqrt(_dot(v, v) + f32(1e6))
    return max(_dot(v, n) * k + wrap, f32(0)) * (k * k * f32(4e8))


@_inlined  # type: ignore[untyped-decorator]
def _lit_by(p: Any, at: Any, n: Any, wrap: Any) -> Any:
    """Irradiance of a surface of normal n by the three lamps and from above."""
    light = _lamp(p.lamp_a, at, n, wrap) + _lamp(p.lamp_b, at, n, wrap)
    light += _lamp(p.lamp_c, at, n, wrap)
    return light / (f32(1) + wrap) + _ambient(p, n)


@_inlined  # type: ignore[untyped-decorator]
def _skin(p: Any, s: Any, d: Any, n: Any, face: Any, pictures: Any) -> Any:
    """Radiance of skin, lid margins, creases, lashes and brow at distance ``s``."""
    gx, gy, upper, lower = face
    coarse, fine, hair, short = pictures
    fold = (upper + p.crease + f32(160) * coarse) / f32(260)
    pouch = (lower + f32(2600) + f32(350) * coarse) / f32(420)
    rim_up = (upper + f32(250)) / f32(260)
    rim_low = (lower + f32(330)) / f32(330)
    albedo = p.skin * (f32(1) + p.pores * (coarse + f32(0.7) * fine))
    albedo *= (f32(1) - f32(0.42) * _bell(fold)) * (f32(1) - f32(0.20) * _bell(pouch))
    albedo *= f32(1) - f32(0.25) * _bell(rim_up)
    albedo += f32(0.10) * _bell(rim_low * rim_low)
    hair *= _step(_unit(-upper / f32(3800)) * f32(20) - f32(1))
    short *= _step(_unit(-lower / f32(2600)) * f32(8) - f32(1))
    lash = _unit(p.lashes * (hair + f32(0.5) * short))
    band = (gy + f32(17000) + gx * gx / f32(60000)) / f32(2600)
    brow = _unit(p.brow * (f32(0.8) + f32(1.6) * fine) * _bell(band * band))
    albedo *= (f32(1) - f32(0.85) * lash) * (f32(1) - f32(0.75) * brow)
    return albedo * _lit_by(p, _scaled(s, d), n, f32(0.35)) * p.gain


@_inlined  # type: ignore[untyped-decorator]
def _refract(p: Any, tc: Any, n: Any, d: Any) -> Any:
    """Where the refracted ray meets the iris plane, in iris coordinates, and its path
    inside the eye.

    Rays that meet the plane at a glancing angle are held at a slope of 0.05: they land
    far outside the iris.
    """
    eta = f32(1) / p.index
    c = -_dot(n, d)
    k = eta * c - _root(f32(1) - eta * eta * (f32(1) - c * c), 1e-4)
    r = _blended(_scaled(eta, d), k, n)
    f = _blended(_scaled(tc, d), f32(-1), _blended(p.centre, p.pupil_d, p.axis))
    slope = max(-_dot(r, p.axis), f32(0.05))
    path = max(_dot(f, p.axis) / slope, f32(0))
    g = _blended(f, path, r)
    return _dot(g, p.iris_x), _dot(g, p.iris_y), path


@_inlined  # type: ignore[untyped-decorator]
def _sclera(p: Any, gx: Any, gy: Any, lower: Any, r: Any, met: Any, vein: Any) -> Any:
    """Albedo of sclera, vessels, limbal ring, caruncle and tear film; ``r`` is from the
    axis in the iris plane.
    """
    ring = f32(0.25) * met * _bell((r - p.limbus_r) / f32(1300))
    white = p.sclera * (f32(1) - p.veins * vein) * (f32(1) - ring)
    x, y = gx - p.caruncle, gy - f32(500)
    flesh = (x * x + y * y) / f32(3.2e6)
    red = f32(0.8) * p.skin * (f32(1) + f32(0.3) * vein)
    white += (red - white) / (f32(1) + flesh * flesh * flesh)
    tear = (lower - f32(120)) / f32(150)
    return white + f32(0.12) * _bell(tear * tear)


@_inlined  # type: ignore[untyped-decorator]
def _mirrored(light: Any, at: Any, n: Any, d: Any, sharp: Any) -> Any:
    """Reflection of a lamp: a lobe about the mirror direction, of peak 1."""
    v = _blended(light, f32(-1), at)
    k = f32(1) / math.sqrt(_dot(v, v) + f32(1e6))
    h = _blended(_scaled(k, v), f32(-1), d)
    along = max(_dot(h, n), f32(0))
    apart = f32(1) - along * along / (_dot(h, h) + f32(1e-3))
    off = f32(1) + sharp * f32(0.5) * apart
    return f32(1) / (off * off)


@_inlined  # type: ignore[untyped-decorator]
def _shade_face(p: Any, x: Any) -> None:
    for i in range(LANES):
        u, w = x[U + i], x[W + i]
        k = f32(1) / math.sqrt(u * u + w * w + f32(1))
        d = u * k, w * k, k
        s, seen, gx, gy, upper, lower, n = _lids(p, d)
        _put(x, D + i, d)
        _put(x, N + i, n)
        x[S + i], x[SEEN + i], x[BARE + i], x[FRONT + i] = s, seen, f32(1) - seen, s * k
        x[GX + i], x[GY + i], x[UPPER + i], x[LOWER + i] = gx, gy, upper, lower


@_inlined  # type: ignore[untyped-decorator]
def _shade_skin(p: Any, t: Any, x: Any, words: Any) -> None:
    for i in range(LANES):
        gx, gy = x[GX + i], x[GY + i]
        coarse_u, coarse_v = gx * f32(0.010), gy * f32(0.012)
        fine_u, fine_v = gx * f32(0.030), gy * f32(0.036)
        hair = f32(255) * _unit(-x[UPPER + i] / f32(3800))
        short = f32(255) * _unit(-x[LOWER + i] / f32(2600))
        a, b = p.offset_x, p.offset_y
        _locate(p.t_skin, coarse_u + a, coarse_v + b, x, words, 0, i)
        _locate(p.t_fine, fine_u + b, fine_v + a, x, words, 1, i)
        _locate(p.t_lash, gx * f32(0.016) + a, hair, x, words, 2, i)
        _locate(p.t_lash, gx * f32(0.011) + b, short, x, words, 3, i)
    _look_up(t, words, 4)
    for i in range(LANES):
        d, n = _vector(x, D + i, LANES), _vector(x, N + i, LANES)
        face = x[GX + i], x[GY + i], x[UPPER + i], x[LOWER + i]
        pictures = (
            _sampled(x, words, 0, i),
            _sampled(x, words, 1, i),
            _sampled(x, words, 2, i),
            _sampled(x, words, 3, i),
        )
        x[NEAR + i] = _skin(p, x[S + i], d, n, face, pictures) * x[BARE + i]


@_inlined  # type: ignore[untyped-decorator]
def _shade_globe(p: Any, x: Any) -> None:
    """Where rays meet sclera and cornea; ``INSIDE`` is 1 in front of the limbus."""
    ball = _blended(p.centre, p.cornea_d, p.axis)
    for i in range(LANES):
        d = _vector(x, D + i, LANES)
        ts, _, m = _sphere(p.centre, p.sclera_r, 1e6, d)
        tc, free, c = _sphere(ball, p.cornea_r, 1e4, d)
        forward = _dot(c, p.axis) * p.cornea_r + p.cornea_d - p.limbus_d
        met = _step(forward / (f32(2) * p.edge)) * _unit(free / f32(2e5))
        _put(x, M + i, m)
        _put(x, C + i, c)
        x[TS + i], x[TC + i], x[INSIDE + i] = ts, tc, met


@_inlined  # type: ignore[untyped-decorator]
def _shade_iris(p: Any, t: Any, x: Any, words: Any) -> None:
    """Shares of iris and pupil, distance from the axis, albedo, and how far behind the
    cornea the virtual image lies; the picture stretches with the pupil.
    """
    wide = max(p.limbus_r - p.pupil_r, f32(300))
    for i in range(LANES):
        d, c = _vector(x, D + i, LANES), _vector(x, C + i, LANES)
        a, b, path = _refract(p, x[TC + i], c, d)
        r = math.sqrt(a * a + b * b + f32(1))
        rim = f32(3) * p.edge + f32(120)
        disc = x[INSIDE + i] * _step((p.limbus_r - r) / rim)
        x[DISC + i], x[R + i] = disc, r
        x[PUPIL + i] = disc * _step((p.pupil_r - r) / p.edge)
        bent = p.index - (p.index - f32(1)) * path / p.cornea_r
        x[VIRTUAL + i] = path / bent
        span = _unit((r - p.pupil_r) / wide)
        place = (f32(40) + f32(84) * span) / r
        u, v = a * place, b * place
        across = f32(128) + p.turn_x * u - p.turn_y * v
        down = f32(128) + p.turn_y * u + p.turn_x * v
        _locate(p.t_iris, across, down, x, words, 0, i)
    _look_up(t, words, 1)
    for i in range(LANES):
        span = _unit((x[R + i] - p.pupil_r) / wide)
        outer = f32(0.45) * _step((span - f32(0.94)) * f32(9))
        inner = f32(0.35) * _step((f32(0.03) - span) * f32(25))
        figure = f32(1) + p.iris_contrast * _sampled(x, words, 0, i)
        x[BROWN + i] = p.iris * figure * (f32(1) - outer) * (f32(1) - inner)


@_inlined  # type: ignore[untyped-decorator]
def _shade_sclera(p: Any, t: Any, x: Any, words: Any) -> None:
    for i in range(LANES):
        m = _vector(x, M + i, LANES)
        u = _dot(m, p.iris_x) * f32(190) + p.offset_x
        v = _dot(m, p.iris_y) * f32(190) + p.offset_y
        _locate(p.t_vein, u, v, x, words, 0, i)
    _look_up(t, words, 1)
    for i in range(LANES):
        vein = _sampled(x, words, 0, i)
        gx, gy, lower = x[GX + i], x[GY + i], x[LOWER + i]
        x[WHITE + i] = _sclera(p, gx, gy, lower, x[R + i], x[INSIDE + i], vein)


@_inlined  # type: ignore[untyped-decorator]
def _shade_light(p: Any, x: Any) -> None:
    """Radiance of the eye from its albedos and shares, under the lamps and below the
    lids, and the depth of what is seen: of the iris, its virtual image.
    """
    for i in range(LANES):
        met, disc, pupil = x[INSIDE + i], x[DISC + i], x[PUPIL + i]
        d = _vector(x, D + i, LANES)
        m = _vector(x, M + i, LANES)
        c = _vector(x, C + i, LANES)
        ts, tc, seen = x[TS + i], x[TC + i], x[SEEN + i]
        near = _scaled(ts + met * (tc - ts), d)
        n = _blended(_scaled(f32(1) - met, m), met, c)
        sharp = f32(250) + f32(1750) * met
        shine = _mirrored(p.lamp_a, near, n, d, sharp)
        shine += _mirrored(p.lamp_b, near, n, d, sharp)
        outer = _lit_by(p, near, n, f32(0.3))
        inner = _lit_by(p, near, p.axis, f32(0.15))
        lid = f32(1) + max(x[UPPER + i], f32(0)) / f32(900)
        low = f32(1) + max(x[LOWER + i], f32(0)) / f32(500)
        dim = f32(1) - f32(0.50) / (lid * lid) - f32(0.15) / low
        stroma = x[BROWN + i] * inner * (f32(1) - pupil / max(disc, f32(1e-3)))
        lit = x[WHITE + i] * outer * (f32(1) - disc) + disc * stroma
        lit = (lit + p.pupil * pupil) * dim
        x[FAR + i] = (lit + p.glint * shine) * p.gain * seen
        x[BACK + i] = (ts + disc * (tc + x[VIRTUAL + i] - ts)) * d[2]
        x[HOLE + i] = pupil * seen


@_inlined  # type: ignore[untyped-decorator]
def _extremes(x: Any, at: Any) -> Any:
    """Least and largest of a quantity over the tile."""
    least = most = x[at]
    for i in range(1, LANES):
        least, most = min(least, x[at + i]), max(most, x[at + i])
    return least, most


@_inlined  # type: ignore[untyped-decorator]
def _shade(p: Any, t: Any, x: Any, words: Any) -> None:
    """All passes over a tile, each where a pixel needs it; what is left out is 0."""
    for i in range(NEAR, PLACE):
        x[i] = f32(0)
    _shade_face(p, x)
    least, most = _extremes(x, SEEN)
    if least < f32(1):
        _shade_skin(p, t, x, words)
    if most > f32(0):
        _shade_globe(p, x)
        if _extremes(x, INSIDE)[1] > f32(0):
            _shade_iris(p, t, x, words)
        if _extremes(x, DISC)[0] < f32(1):
            _shade_sclera(p, t, x, words)
        _shade_light(p, x)


@_inlined  # type: ignore[untyped-decorator]
def _copy_out(x: Any, at: Any, out: Any, row: Any, column: Any) -> None:
    """The part of a tile's lanes that lies in the frame, to a plane (y, x)."""
    for j in range(min(ROWS, out.shape[0] - row)):
        for i in range(min(COLUMNS, out.shape[1] - column)):
            out[row + j, column + i] = x[at + j * COLUMNS + i]


@_inlined  # type: ignore[untyped-decorator]
def _unpack(row: Any) -> Any:
    """The parameters of a frame by name."""
    v = row
    return Parameters(  # type: ignore[call-arg]
        _vector(v, 0, 1), _vector(v, 3, 1), _vector(v, 6, 1), _vector(v, 9, 1),
        _vector(v, 12, 1), _vector(v, 15, 1), _vector(v, 18, 1), _vector(v, 21, 1),
        _vector(v, 24, 1), _vector(v, 27, 1), _vector(v, 30, 1),
        v[33], v[34], v[35], v[36], v[37], v[38], v[39], v[40], v[41], v[42], v[43],
        v[44], v[45], v[46], v[47], v[48], v[49], v[50], v[51], v[52], v[53], v[54],
        v[55], v[56], v[57], v[58], v[59], v[60], v[61], v[62], v[63], v[64], v[65],
        v[66], v[67], v[68], v[69], v[70], v[71],
    )  # fmt: skip


@numba.njit(nogil=True, cache=True, **SETTINGS)  # type: ignore[untyped-decorator]
def frames(
    first: int, end: int, parameters: Array, scale: Array, bank: Array, u: Array,
    w: Array, light: Array, cover: Array, depth: Array, pupil: Array,
) -> None:  # fmt: skip
    """Strips of frames from the first to before the end; see :func:`render_rows`.

    Args:
        parameters: (n, COUNT) of the frames. scale: (n,) factor of the depths.
        bank: packed textures. u: (x,) tangents of the rays across.
        w: (y,) tangents of the rays down. light: (n, 2, y, x) radiance to fill.
        cover: (n, 2, y, x) coverage to fill. depth: (n, 2, y, x) depth to fill, um.
        pupil: (n, 1, y, x) share of pupil to fill.
    """
    strips = (len(w) + ROWS - 1) // ROWS
    x, words = np.empty(TILE, np.float32), np.empty(WORDS, np.int32)
    for job in range(first, end):
        n, row = job // strips, job % strips * ROWS
        p = _unpack(parameters[n])
        for column in range(0, len(u), COLUMNS):
            for j in range(ROWS):  # beyond the frame its last row and column repeat
                for i in range(COLUMNS):
                    x[U + j * COLUMNS + i] = u[min(column + i, len(u) - 1)]
                    x[W + j * COLUMNS + i] = w[min(row + j, len(w) - 1)]
            _shade(p, bank, x, words)
            for i in range(LANES):
                x[FRONT + i] *= scale[n]
                x[BACK + i] *= scale[n]
            _copy_out(x, NEAR, light[n, 0], row, column)
            _copy_out(x, FAR, light[n, 1], row, column)
            _copy_out(x, BARE, cover[n, 0], row, column)
            _copy_out(x, SEEN, cover[n, 1], row, column)
            _copy_out(x, FRONT, depth[n, 0], row, column)
            _copy_out(x, BACK, depth[n, 1], row, column)
            _copy_out(x, HOLE, pupil[n, 0], row, column)


def render_rows(
    parameters: Array, scale: Array, bank: Array, u: Array, w: Array, light: Array,
    cover: Array, depth: Array, pupil: Array,
) -> None:  # fmt: skip
    """Render frames (float32), on all threads.

    Sheet 0 is skin, sheet 1 the eye; light is multiplied by the coverage. What is
    hidden is not shaded.

    Args:
        parameters: (n, :data:`codesign.eye.model.COUNT`). scale: (n,) of the depths.
        bank: of :func:`codesign.eye.textures.packed_bank`. u, w: (x,) and (y,) tangents
            of the rays.
        light, cover, depth: (n, 2, y, x) to fill, radiance 1, share and um. pupil: (n,
            1, y, x) to fill, share.

    Accuracy: 1e-3 of full light against float64, at edges a pixel wide.
    """
    rest = (parameters, scale, bank, u, w, light, cover, depth, pupil)
    threads.run_split(
        len(parameters) * -(-len(w) // ROWS),
        lambda first, end: frames(first, end, *rest),
    )
