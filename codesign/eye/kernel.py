"""What a pixel sees, compiled for float32: lids, skin and eye in front of a pinhole."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

import math
from collections import namedtuple
from typing import Any

import numba
import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple

from codesign.eye.textures import SIZE, STEPS
from metalens.core import threads
from metalens.core.arrays import Array

f32, i32 = np.float32, np.int32
ZERO, HALF, ONE = f32(0), f32(0.5), f32(1)  # literals would widen to float64
SETTINGS: dict[str, Any] = {"fastmath": True, "error_model": "numpy"}
_inlined = numba.njit(forceinline=True, **SETTINGS)
_to_tuple: Any = to_fixed_tuple

COLUMNS, ROWS = 16, 4  # of a tile: vector registers, and independent work to fill them
LANES = ROWS * COLUMNS
SAMPLES = 4  # textures that one pass samples, at most
# what a frame is rendered from; lengths in um, the camera at the origin looks along
# +z, x to the right, y down
VECTORS = (
    "centre", "face_x", "face_y", "face_z", "axis", "iris_x", "iris_y", "plane",
    "lamp_a", "lamp_b", "lamp_c",
)  # fmt: skip
NUMBERS = (
    "sclera_r", "cornea_r", "cornea_d", "limbus_r", "limbus_d", "pupil_r", "pupil_d",
    "index", "lid_r", "blend", "edge", "upper", "lower", "skew", "middle", "half",
    "crease", "iris", "iris_contrast", "sclera", "veins", "skin", "pores", "lashes",
    "pupil", "glint", "ambient", "gain", "brow", "t_iris", "t_vein", "t_skin", "t_fine",
    "t_lash", "offset_x", "offset_y", "turn_x", "turn_y", "caruncle",
)  # fmt: skip
# vectors are tuples of three
Parameters: Any = namedtuple("Parameters", VECTORS + NUMBERS)  # type: ignore[misc]
COUNT = 3 * len(VECTORS) + len(NUMBERS)

# first lane of every quantity in a tile; three quantities for a vector. The last seven
# are the planes of a rendered frame
(
    U, W, D, _, _, S, GX, GY, UPPER, LOWER, N, _, _, TS, M, _, _, TC, C, _, _, INSIDE,
    DISC, PUPIL, VIRTUAL, R, NEAR, FAR, BARE, OPENNESS, FRONT, BACK, HOLE, PLACE,
) = (LANES * k for k in range(34))  # fmt: skip
PLANES = 7
TILE, WORDS = PLACE + 2 * SAMPLES * LANES, 2 * SAMPLES * LANES


@_inlined
def _load(x, at):
    """(3,) vector at lane ``at`` of tile ``x``: one plane of lanes a component."""
    return x[at], x[at + LANES], x[at + 2 * LANES]


@_inlined
def _store(x, at, v):
    """Write vector ``v`` to lane ``at`` of tile ``x``."""
    x[at], x[at + LANES], x[at + 2 * LANES] = v


@_inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_inlined
def _add_scaled(a, k, b):
    """a + k b."""
    return a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]


@_inlined
def _scaled(k, a):
    return k * a[0], k * a[1], k * a[2]


@_inlined
def _clip01(x):
    """x clipped to [0, 1]."""
    return min(max(x, ZERO), ONE)


@_inlined
def _smooth_step(x):
    """Cubic step t² (3 - 2 t), t = (1 + x) / 2: 0 at x = -1, 1 at x = 1."""
    t = _clip01(HALF + HALF * x)
    return t * t * (f32(3) - f32(2) * t)


@_inlined
def _lorentzian(x):
    """1 / (1 + x²)."""
    return ONE / (ONE + x * x)


@_inlined
def _bounded_sqrt(x, least):
    """sqrt(max(x, least))."""
    return math.sqrt(max(x, f32(least)))


@_inlined
def _texture_indices(index, u, v, x, words, k, lane):
    """Indices and fractions for bilinear sample ``k`` of one texture at (u, v) pixels.

    Writes to ``words`` the flat indices of the pixels at (floor u, floor v) and one row
    below, and to ``x[PLACE + ...]`` the fractions u - floor(u), v - floor(v). ``index``
    is the number of the texture in the bank.

    Textures are periodic; their size is a power of two. The casts keep numba from
    widening to 64 bits.
    """
    first, last = i32(index) * i32(SIZE * SIZE), i32(SIZE - 1)
    fu, fv = np.floor(u), np.floor(v)
    i, j = i32(i32(fu) & last), i32(i32(fv) & last)
    below = i32(i32(j + i32(1)) & last)
    slot = 2 * k * LANES + lane
    words[slot] = i32(first + i32(i32(j * i32(SIZE)) + i))
    words[slot + LANES] = i32(first + i32(i32(below * i32(SIZE)) + i))
    x[PLACE + slot], x[PLACE + slot + LANES] = u - fu, v - fv


@_inlined
def _fetch_texels(t, words, samples):
    """Replace texel indices in ``words`` by the packed texel pairs of bank ``t``.

    A pair is a pixel and its right neighbour, as in
    :func:`codesign.eye.textures.packed_bank`.
    """
    for at in range(2 * samples * LANES):
        words[at] = t[np.uint32(words[at])]


@_inlined
def _interpolate_texel(x, words, k, lane):
    """Value of texture sample ``k`` in [-1, 1], interpolated between four texels.

    The weights are cubic steps t² (3 - 2 t) of the fractions. Each int32 of ``words``
    holds a texel in its low 16 bits and the right neighbour in its high 16 bits.
    """
    slot = 2 * k * LANES + lane
    bits = i32(16)
    s, t = x[PLACE + slot], x[PLACE + slot + LANES]
    top, bottom = words[slot], words[slot + LANES]
    top_left = f32(i32(i32(top << bits) >> bits))
    top_right = f32(i32(top >> bits))
    bottom_left = f32(i32(i32(bottom << bits) >> bits))
    bottom_right = f32(i32(bottom >> bits))
    s = s * s * (f32(3) - f32(2) * s)
    t = t * t * (f32(3) - f32(2) * t)
    above = top_left + (top_right - top_left) * s
    below = bottom_left + (bottom_right - bottom_left) * s
    return (above + (below - above) * t) * f32(1 / STEPS)


@_inlined
def _intersect_sphere(centre, radius, least, d):
    """First intersection of the ray s d from the origin with a sphere.

    Returns: distance s in um, discriminant r² - |c - (c·d) d|² in um², unit normal
    there. The discriminant is at least ``least`` under the square root, so that s is
    real.
    """
    along = _dot(centre, d)
    closest = _add_scaled(centre, -along, d)
    discriminant = radius * radius - _dot(closest, closest)
    distance = along - _bounded_sqrt(discriminant, least)
    out = _add_scaled(_scaled(distance, d), f32(-1), centre)
    return distance, discriminant, _scaled(ONE / radius, out)


@_inlined
def _lamp_irradiance(light, at, n, wrap):
    """Irradiance of a surface of normal ``n`` at ``at`` by a point lamp at ``light``.

    max(cos + wrap, 0) (20 mm / r)²: 1 at 20 mm and normal incidence. ``wrap`` softens
    the terminator.
    """
    to_lamp = _add_scaled(light, f32(-1), at)
    inverse_distance = ONE / math.sqrt(_dot(to_lamp, to_lamp) + f32(1e6))
    return max(_dot(to_lamp, n) * inverse_distance + wrap, ZERO) * (
        inverse_distance * inverse_distance * f32(4e8)
    )


@_inlined
def _total_irradiance(p, at, n, wrap):
    """Irradiance of a surface of normal ``n`` at ``at``: lamps and ambient light.

    The ambient light a (0.6 - 0.4 n·y) is stronger from above than from below.
    """
    light = _lamp_irradiance(p.lamp_a, at, n, wrap)
    light += _lamp_irradiance(p.lamp_b, at, n, wrap)
    light += _lamp_irradiance(p.lamp_c, at, n, wrap)
    ambient = p.ambient * (f32(0.6) - f32(0.4) * _dot(n, p.face_y))
    return light / (ONE + wrap) + ambient


@_inlined
def _skin_radiance(p, distance, d, n, face, pictures):
    """Radiance of skin, lid margins, creases, lashes and brow at ``distance`` along d.

    ``face``: face coordinates x, y and gaps to the upper and lower margin, um.
    ``pictures``: samples of coarse skin, pores, upper and lower lashes, each in [-1,
    1].
    """
    gx, gy, upper, lower = face
    coarse, fine, upper_lash, lower_lash = pictures
    fold = (upper + p.crease + f32(160) * coarse) / f32(260)
    pouch = (lower + f32(2600) + f32(350) * coarse) / f32(420)
    rim_up = (upper + f32(250)) / f32(260)
    rim_low = (lower + f32(330)) / f32(330)
    albedo = p.skin * (ONE + p.pores * (coarse + f32(0.7) * fine))
    albedo *= (ONE - f32(0.42) * _lorentzian(fold)) * (
        ONE - f32(0.20) * _lorentzian(pouch)
    )
    albedo *= ONE - f32(0.25) * _lorentzian(rim_up)
    albedo += f32(0.10) * _lorentzian(rim_low * rim_low)
    upper_lash *= _smooth_step(_clip01(-upper / f32(3800)) * f32(20) - ONE)
    lower_lash *= _smooth_step(_clip01(-lower / f32(2600)) * f32(8) - ONE)
    lash = _clip01(p.lashes * (upper_lash + HALF * lower_lash))
    band = (gy + f32(17000) + gx * gx / f32(60000)) / f32(2600)
    brow = _clip01(p.brow * (f32(0.8) + f32(1.6) * fine) * _lorentzian(band * band))
    albedo *= (ONE - f32(0.85) * lash) * (ONE - f32(0.75) * brow)
    return albedo * _total_irradiance(p, _scaled(distance, d), n, f32(0.35)) * p.gain


@_inlined
def _refract_to_iris(p, tc, n, d):
    """Intersection of the refracted ray with the iris plane, and its path inside, um.

    Snell's law at the cornea, distance ``tc`` along ray ``d``, of normal ``n``. Returns
    iris coordinates x and y and the path.

    Rays at a glancing angle to the plane have their slope set to 0.05: they land well
    outside the iris.
    """
    eta = ONE / p.index
    cosine = -_dot(n, d)
    bend = eta * cosine - _bounded_sqrt(ONE - eta * eta * (ONE - cosine * cosine), 1e-4)
    ray = _add_scaled(_scaled(eta, d), bend, n)
    offset = _add_scaled(
        _scaled(tc, d), f32(-1), _add_scaled(p.centre, p.pupil_d, p.axis)
    )
    slope = max(-_dot(ray, p.axis), f32(0.05))
    path = max(_dot(offset, p.axis) / slope, ZERO)
    hit = _add_scaled(offset, path, ray)
    return _dot(hit, p.iris_x), _dot(hit, p.iris_y), path


@_inlined
def _specular_lobe(light, at, n, d, sharp):
    """Reflection of a lamp by a glossy surface: 1 / (1 + sharp sin² / 2)², peak 1.

    The angle is between the normal and the half vector of lamp and camera directions.
    """
    to_lamp = _add_scaled(light, f32(-1), at)
    inverse_distance = ONE / math.sqrt(_dot(to_lamp, to_lamp) + f32(1e6))
    half = _add_scaled(_scaled(inverse_distance, to_lamp), f32(-1), d)
    cosine = max(_dot(half, n), ZERO)
    sine2 = ONE - cosine * cosine / (_dot(half, half) + f32(1e-3))
    fall = ONE + sharp * HALF * sine2
    return ONE / (fall * fall)


@_inlined
def _shade_face(p, x, words):
    """Rays of the tile, where they meet the face (distance, normal, lid gaps,
    openness), and the skin's texture indices.

    The face is the smooth minimum of lid shell and face plane over ``p.blend`` um.
    Openness is 1 where the eye is visible; a gap to a lid margin in um is above 0 inside
    the opening.
    """
    for i in range(LANES):
        u, w = x[U + i], x[W + i]
        cosine = ONE / math.sqrt(u * u + w * w + ONE)
        d = u * cosine, w * cosine, cosine
        shell = _intersect_sphere(p.centre, p.lid_r, 1e6, d)[0]
        facing = max(-_dot(d, p.face_z), f32(0.05))
        plane = -_dot(p.plane, p.face_z) / facing
        share = _clip01(HALF + HALF * (plane - shell) / p.blend)
        distance = (
            plane + (shell - plane) * share - HALF * p.blend * share * (ONE - share)
        )
        point = _add_scaled(_scaled(distance, d), f32(-1), p.centre)
        n = _add_scaled(_scaled(share / p.lid_r, point), ONE - share, p.face_z)
        n = _scaled(ONE / math.sqrt(_dot(n, n) + f32(1e-6)), n)
        gx, gy = _dot(point, p.face_x), _dot(point, p.face_y)
        across = (gx - p.middle) / p.half
        arch = ONE - across * across
        upper = gy + arch * (p.upper + p.skew * across)
        lower = arch * (p.lower - p.skew * across) - gy
        edges = _smooth_step(upper / p.edge) * _smooth_step(lower / p.edge)
        openness = edges * _smooth_step((upper + lower) / p.edge - ONE)
        _store(x, D + i, d)
        _store(x, N + i, n)
        x[S + i] = distance
        x[OPENNESS + i] = openness
        x[BARE + i] = ONE - openness
        x[FRONT + i] = distance * cosine
        x[GX + i] = gx
        x[GY + i] = gy
        x[UPPER + i] = upper
        x[LOWER + i] = lower
        shift_x, shift_y = p.offset_x, p.offset_y
        u, v = gx * f32(0.010) + shift_x, gy * f32(0.012) + shift_y
        _texture_indices(p.t_skin, u, v, x, words, 0, i)
        u, v = gx * f32(0.030) + shift_y, gy * f32(0.036) + shift_x
        _texture_indices(p.t_fine, u, v, x, words, 1, i)
        u, v = gx * f32(0.016) + shift_x, f32(255) * _clip01(-upper / f32(3800))
        _texture_indices(p.t_lash, u, v, x, words, 2, i)
        u, v = gx * f32(0.011) + shift_y, f32(255) * _clip01(-lower / f32(2600))
        _texture_indices(p.t_lash, u, v, x, words, 3, i)


@_inlined
def _shade_skin(p, t, x, words):
    """Radiance of the near sheet, times its coverage, from four texture samples."""
    _fetch_texels(t, words, 4)
    for i in range(LANES):
        d, n = _load(x, D + i), _load(x, N + i)
        face = x[GX + i], x[GY + i], x[UPPER + i], x[LOWER + i]
        pictures = (
            _interpolate_texel(x, words, 0, i),
            _interpolate_texel(x, words, 1, i),
            _interpolate_texel(x, words, 2, i),
            _interpolate_texel(x, words, 3, i),
        )
        x[NEAR + i] = _skin_radiance(p, x[S + i], d, n, face, pictures) * x[BARE + i]


@_inlined
def _intersect_globe(p, x, words):
    """Where the rays meet sclera, cornea and, refracted, the iris; texture indices of
    iris and vessels.

    ``INSIDE`` is the cornea's share of a pixel: 1 in front of the limbus. ``DISC`` and
    ``PUPIL`` are those of iris and pupil. The refracted path s appears at
    s / (n - (n - 1) s / R) (paraxial refraction at the cornea of radius R and index n).
    The iris texture stretches with the pupil.
    """
    cornea_centre = _add_scaled(p.centre, p.cornea_d, p.axis)
    width = max(p.limbus_r - p.pupil_r, f32(300))
    rim = f32(3) * p.edge + f32(120)
    for i in range(LANES):
        d = _load(x, D + i)
        ts, _, m = _intersect_sphere(p.centre, p.sclera_r, 1e6, d)
        tc, free, c = _intersect_sphere(cornea_centre, p.cornea_r, 1e4, d)
        forward = _dot(c, p.axis) * p.cornea_r + p.cornea_d - p.limbus_d
        cornea = _smooth_step(forward / (f32(2) * p.edge)) * _clip01(free / f32(2e5))
        a, b, path = _refract_to_iris(p, tc, c, d)
        r = math.sqrt(a * a + b * b + ONE)
        disc = cornea * _smooth_step((p.limbus_r - r) / rim)
        _store(x, M + i, m)
        _store(x, C + i, c)
        x[TS + i], x[TC + i], x[INSIDE + i], x[DISC + i] = ts, tc, cornea, disc
        x[R + i] = r
        x[PUPIL + i] = disc * _smooth_step((p.pupil_r - r) / p.edge)
        x[VIRTUAL + i] = path / (p.index - (p.index - ONE) * path / p.cornea_r)
        scale = (f32(40) + f32(84) * _clip01((r - p.pupil_r) / width)) / r
        u, v = a * scale, b * scale
        across = f32(128) + p.turn_x * u - p.turn_y * v
        down = f32(128) + p.turn_y * u + p.turn_x * v
        _texture_indices(p.t_iris, across, down, x, words, 0, i)
        u = _dot(m, p.iris_x) * f32(190) + p.offset_x
        v = _dot(m, p.iris_y) * f32(190) + p.offset_y
        _texture_indices(p.t_vein, u, v, x, words, 1, i)


@_inlined
def _iris_albedo(p, r, texel):
    """Albedo of the iris at radius ``r``, darker at the limbus and the pupil."""
    span = _clip01((r - p.pupil_r) / max(p.limbus_r - p.pupil_r, f32(300)))
    outer = f32(0.45) * _smooth_step((span - f32(0.94)) * f32(9))
    inner = f32(0.35) * _smooth_step((f32(0.03) - span) * f32(25))
    return p.iris * (ONE + p.iris_contrast * texel) * (ONE - outer) * (ONE - inner)


@_inlined
def _sclera_albedo(p, gx, gy, lower, limbus, vein):
    """Albedo of sclera, vessels, limbal ring, caruncle and tear film.

    ``limbus``: share of the ring.
    """
    white = p.sclera * (ONE - p.veins * vein) * (ONE - f32(0.25) * limbus)
    dx, dy = gx - p.caruncle, gy - f32(500)
    radius2 = (dx * dx + dy * dy) / f32(3.2e6)
    red = f32(0.8) * p.skin * (ONE + f32(0.3) * vein)
    white += (red - white) / (ONE + radius2 * radius2 * radius2)
    tear = (lower - f32(120)) / f32(150)
    return white + f32(0.12) * _lorentzian(tear * tear)


@_inlined
def _shade_eye(p, t, x, words):
    """Radiance and depth of the far sheet (the eye), and visible share of the pupil.

    Lambert shading of the albedos by the lamps, darkened below the lids, plus glints.
    The depth of the iris is that of its virtual image.
    """
    _fetch_texels(t, words, 2)
    for i in range(LANES):
        cornea, disc, pupil = x[INSIDE + i], x[DISC + i], x[PUPIL + i]
        d, m, c = _load(x, D + i), _load(x, M + i), _load(x, C + i)
        ts, tc, openness = x[TS + i], x[TC + i], x[OPENNESS + i]
        lower = x[LOWER + i]
        brown = _iris_albedo(p, x[R + i], _interpolate_texel(x, words, 0, i))
        limbus = cornea * _lorentzian((x[R + i] - p.limbus_r) / f32(1300))
        vein = _interpolate_texel(x, words, 1, i)
        white = _sclera_albedo(p, x[GX + i], x[GY + i], lower, limbus, vein)
        point = _scaled(ts + cornea * (tc - ts), d)
        normal = _add_scaled(_scaled(ONE - cornea, m), cornea, c)
        sharp = f32(250) + f32(1750) * cornea
        specular = _specular_lobe(p.lamp_a, point, normal, d, sharp)
        specular += _specular_lobe(p.lamp_b, point, normal, d, sharp)
        outer = _total_irradiance(p, point, normal, f32(0.3))
        inner = _total_irradiance(p, point, p.axis, f32(0.15))
        upper_gap = ONE + max(x[UPPER + i], ZERO) / f32(900)
        lower_gap = ONE + max(lower, ZERO) / f32(500)
        occlusion = ONE - HALF / (upper_gap * upper_gap) - f32(0.15) / lower_gap
        stroma = brown * inner * (ONE - pupil / max(disc, f32(1e-3)))
        radiance = white * outer * (ONE - disc) + disc * stroma
        radiance = (radiance + p.pupil * pupil) * occlusion
        x[FAR + i] = (radiance + p.glint * specular) * p.gain * openness
        x[BACK + i] = (ts + disc * (tc + x[VIRTUAL + i] - ts)) * d[2]
        x[HOLE + i] = pupil * openness


@_inlined
def _shade(p, t, x, words):
    """Shade one tile: skin and eye only if some pixel shows them; else they are 0.

    ``p``: parameters of the frame. ``t``: packed texture bank. ``x``: planes of the
    tile, float32. ``words``: texel scratch, int32.
    """
    for i in range(NEAR, PLACE):
        x[i] = ZERO
    _shade_face(p, x, words)
    least = largest = x[OPENNESS]
    for i in range(1, LANES):
        least, largest = min(least, x[OPENNESS + i]), max(largest, x[OPENNESS + i])
    if least < ONE:
        _shade_skin(p, t, x, words)
    if largest > ZERO:
        _intersect_globe(p, x, words)
        _shade_eye(p, t, x, words)


@numba.njit(nogil=True, cache=True, **SETTINGS)
def render_strips(
    first: int, end: int, rows: Array, bank: Array, rays: Array, out: Array
) -> None:
    """Render jobs ``first`` to ``end`` - 1, each a strip of ROWS rows of one frame.

    Job number j is strip j mod S of frame j // S, of S strips a frame. See
    :func:`render_frames`.

    Args:
        rows: (n, COUNT) parameters. bank: packed textures. rays: (pixels,) tangents.
        out: (n, PLANES, y, x) to fill.
    """
    pixels = len(rays)
    strips = (pixels + ROWS - 1) // ROWS
    tile, words = np.empty(TILE, np.float32), np.empty(WORDS, np.int32)
    for job in range(first, end):
        frame, row = job // strips, job % strips * ROWS
        v = _to_tuple(rows[frame], COUNT)
        named = Parameters(  # type: ignore[call-arg]
            v[0:3], v[3:6], v[6:9], v[9:12], v[12:15], v[15:18], v[18:21], v[21:24],
            v[24:27], v[27:30], v[30:33], *v[33:],
        )  # fmt: skip
        for column in range(0, pixels, COLUMNS):
            for j in range(ROWS):  # beyond the frame its last row and column repeat
                for i in range(COLUMNS):
                    tile[U + j * COLUMNS + i] = rays[min(column + i, pixels - 1)]
                    tile[W + j * COLUMNS + i] = rays[min(row + j, pixels - 1)]
            _shade(named, bank, tile, words)
            for plane in range(PLANES):
                lane = NEAR + plane * LANES
                for j in range(min(ROWS, pixels - row)):
                    for i in range(min(COLUMNS, pixels - column)):
                        out[frame, plane, row + j, column + i] = tile[
                            lane + j * COLUMNS + i
                        ]


def render_frames(rows: Array, bank: Array, rays: Array) -> Array:
    """(n, PLANES, y, x) float32 square frames of a pinhole camera, on all threads.

    The planes: radiance of skin and eye, times their coverage, 1 for full light; their
    coverage; their depth in um; the share of pupil. What is hidden is not shaded.

    Args:
        rows: (n, COUNT) float32 parameters, in the order of VECTORS and NUMBERS.
        bank: of :func:`codesign.eye.textures.packed_bank`.
        rays: (pixels,) float32 tangents across, and down.

    Accuracy: 1e-3 of full light against float64, at edges a pixel wide.
    """
    out = np.empty((len(rows), PLANES, len(rays), len(rays)), np.float32)
    threads.run_split(
        len(rows) * -(-len(rays) // ROWS),
        lambda first, end: render_strips(first, end, rows, bank, rays, out),
    )
    return out
