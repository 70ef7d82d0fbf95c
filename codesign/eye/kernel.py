"""What a pixel sees, compiled for float32: lids, skin and eye in front of a pinhole."""

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
    DISC, PUPIL, BROWN, VIRTUAL, R, WHITE, NEAR, FAR, BARE, SEEN, FRONT, BACK, HOLE,
    PLACE,
) = (LANES * k for k in range(36))  # fmt: skip
PLANES = 7
TILE, WORDS = PLACE + 2 * SAMPLES * LANES, 2 * SAMPLES * LANES


@_inlined  # type: ignore[untyped-decorator]
def _load(x: Any, at: Any) -> Any:
    """(3,) vector at lane ``at`` of tile ``x``: one plane of lanes a component."""
    return x[at], x[at + LANES], x[at + 2 * LANES]


@_inlined  # type: ignore[untyped-decorator]
def _store(x: Any, at: Any, v: Any) -> None:
    """Write vector ``v`` to lane ``at`` of tile ``x``."""
    x[at], x[at + LANES], x[at + 2 * LANES] = v


@_inlined  # type: ignore[untyped-decorator]
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_inlined  # type: ignore[untyped-decorator]
def _add_scaled(a: Any, k: Any, b: Any) -> Any:
    """a + k b."""
    return a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]


@_inlined  # type: ignore[untyped-decorator]
def _scaled(k: Any, a: Any) -> Any:
    return k * a[0], k * a[1], k * a[2]


@_inlined  # type: ignore[untyped-decorator]
def _clip01(x: Any) -> Any:
    """x clipped to [0, 1]."""
    return min(max(x, f32(0)), f32(1))


@_inlined  # type: ignore[untyped-decorator]
def _smooth_step(x: Any) -> Any:
    """Cubic step t² (3 - 2 t), t = (1 + x) / 2: 0 at x = -1, 1 at x = 1."""
    t = _clip01(f32(0.5) + f32(0.5) * x)
    return t * t * (f32(3) - f32(2) * t)


@_inlined  # type: ignore[untyped-decorator]
def _lorentzian(x: Any) -> Any:
    """1 / (1 + x²)."""
    return f32(1) / (f32(1) + x * x)


@_inlined  # type: ignore[untyped-decorator]
def _bounded_sqrt(x: Any, least: Any) -> Any:
    """sqrt(max(x, least))."""
    return math.sqrt(max(x, f32(least)))


@_inlined  # type: ignore[untyped-decorator]
def _texture_indices(
    index: Any, u: Any, v: Any, x: Any, words: Any, k: Any, lane: Any
) -> None:
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


@_inlined  # type: ignore[untyped-decorator]
def _fetch_texels(t: Any, words: Any, samples: Any) -> None:
    """Replace texel indices in ``words`` by the packed texel pairs of bank ``t``.

    A pair is a pixel and its right neighbour, as in
    :func:`codesign.eye.textures.packed_bank`.
    """
    for at in range(2 * samples * LANES):
        words[at] = t[np.uint32(words[at])]


@_inlined  # type: ignore[untyped-decorator]
def _interpolate_texel(x: Any, words: Any, k: Any, lane: Any) -> Any:
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


@_inlined  # type: ignore[untyped-decorator]
def _intersect_sphere(centre: Any, radius: Any, least: Any, d: Any) -> Any:
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
    return distance, discriminant, _scaled(f32(1) / radius, out)


@_inlined  # type: ignore[untyped-decorator]
def _lamp_irradiance(light: Any, at: Any, n: Any, wrap: Any) -> Any:
    """Irradiance of a surface of normal ``n`` at ``at`` by a point lamp at ``light``.

    max(cos + wrap, 0) (20 mm / r)²: 1 at 20 mm and normal incidence. ``wrap`` softens
    the terminator.
    """
    to_lamp = _add_scaled(light, f32(-1), at)
    inverse_distance = f32(1) / math.sqrt(_dot(to_lamp, to_lamp) + f32(1e6))
    return max(_dot(to_lamp, n) * inverse_distance + wrap, f32(0)) * (
        inverse_distance * inverse_distance * f32(4e8)
    )


@_inlined  # type: ignore[untyped-decorator]
def _total_irradiance(p: Any, at: Any, n: Any, wrap: Any) -> Any:
    """Irradiance of a surface of normal ``n`` at ``at``: lamps and ambient light.

    The ambient light a (0.6 - 0.4 n·y) is stronger from above than from below.
    """
    light = _lamp_irradiance(p.lamp_a, at, n, wrap)
    light += _lamp_irradiance(p.lamp_b, at, n, wrap)
    light += _lamp_irradiance(p.lamp_c, at, n, wrap)
    ambient = p.ambient * (f32(0.6) - f32(0.4) * _dot(n, p.face_y))
    return light / (f32(1) + wrap) + ambient


@_inlined  # type: ignore[untyped-decorator]
def _skin_radiance(
    p: Any, distance: Any, d: Any, n: Any, face: Any, pictures: Any
) -> Any:
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
    albedo = p.skin * (f32(1) + p.pores * (coarse + f32(0.7) * fine))
    albedo *= (f32(1) - f32(0.42) * _lorentzian(fold)) * (
        f32(1) - f32(0.20) * _lorentzian(pouch)
    )
    albedo *= f32(1) - f32(0.25) * _lorentzian(rim_up)
    albedo += f32(0.10) * _lorentzian(rim_low * rim_low)
    upper_lash *= _smooth_step(_clip01(-upper / f32(3800)) * f32(20) - f32(1))
    lower_lash *= _smooth_step(_clip01(-lower / f32(2600)) * f32(8) - f32(1))
    lash = _clip01(p.lashes * (upper_lash + f32(0.5) * lower_lash))
    band = (gy + f32(17000) + gx * gx / f32(60000)) / f32(2600)
    brow = _clip01(p.brow * (f32(0.8) + f32(1.6) * fine) * _lorentzian(band * band))
    albedo *= (f32(1) - f32(0.85) * lash) * (f32(1) - f32(0.75) * brow)
    return albedo * _total_irradiance(p, _scaled(distance, d), n, f32(0.35)) * p.gain


@_inlined  # type: ignore[untyped-decorator]
def _refract_to_iris(p: Any, tc: Any, n: Any, d: Any) -> Any:
    """Intersection of the refracted ray with the iris plane, and its path inside, um.

    Snell's law at the cornea, distance ``tc`` along ray ``d``, of normal ``n``. Returns
    iris coordinates x and y and the path.

    Rays at a glancing angle to the plane have their slope set to 0.05: they land well
    outside the iris.
    """
    eta = f32(1) / p.index
    cosine = -_dot(n, d)
    bend = eta * cosine - _bounded_sqrt(
        f32(1) - eta * eta * (f32(1) - cosine * cosine), 1e-4
    )
    ray = _add_scaled(_scaled(eta, d), bend, n)
    offset = _add_scaled(
        _scaled(tc, d), f32(-1), _add_scaled(p.centre, p.pupil_d, p.axis)
    )
    slope = max(-_dot(ray, p.axis), f32(0.05))
    path = max(_dot(offset, p.axis) / slope, f32(0))
    hit = _add_scaled(offset, path, ray)
    return _dot(hit, p.iris_x), _dot(hit, p.iris_y), path


@_inlined  # type: ignore[untyped-decorator]
def _specular_lobe(light: Any, at: Any, n: Any, d: Any, sharp: Any) -> Any:
    """Reflection of a lamp by a glossy surface: 1 / (1 + sharp sin² / 2)², peak 1.

    The angle is between the normal and the half vector of lamp and camera directions.
    """
    to_lamp = _add_scaled(light, f32(-1), at)
    inverse_distance = f32(1) / math.sqrt(_dot(to_lamp, to_lamp) + f32(1e6))
    half = _add_scaled(_scaled(inverse_distance, to_lamp), f32(-1), d)
    cosine = max(_dot(half, n), f32(0))
    sine2 = f32(1) - cosine * cosine / (_dot(half, half) + f32(1e-3))
    fall = f32(1) + sharp * f32(0.5) * sine2
    return f32(1) / (fall * fall)


@_inlined  # type: ignore[untyped-decorator]
def _shade_face(p: Any, x: Any) -> None:
    """Rays of the tile, and where they meet the face: distance, normal, lid gaps,
    openness.

    The face is the smooth minimum of lid shell and face plane over ``p.blend`` um.
    Openness is 1 where the eye is visible; a gap to a lid margin in um is above 0 inside
    the opening.
    """
    for i in range(LANES):
        u, w = x[U + i], x[W + i]
        cosine = f32(1) / math.sqrt(u * u + w * w + f32(1))
        d = u * cosine, w * cosine, cosine
        shell = _intersect_sphere(p.centre, p.lid_r, 1e6, d)[0]
        facing = max(-_dot(d, p.face_z), f32(0.05))
        plane = -_dot(p.plane, p.face_z) / facing
        share = _clip01(f32(0.5) + f32(0.5) * (plane - shell) / p.blend)
        distance = (
            plane
            + (shell - plane) * share
            - f32(0.5) * p.blend * share * (f32(1) - share)
        )
        point = _add_scaled(_scaled(distance, d), f32(-1), p.centre)
        n = _add_scaled(_scaled(share / p.lid_r, point), f32(1) - share, p.face_z)
        n = _scaled(f32(1) / math.sqrt(_dot(n, n) + f32(1e-6)), n)
        gx, gy = _dot(point, p.face_x), _dot(point, p.face_y)
        across = (gx - p.middle) / p.half
        arch = f32(1) - across * across
        upper = gy + arch * (p.upper + p.skew * across)
        lower = arch * (p.lower - p.skew * across) - gy
        edges = _smooth_step(upper / p.edge) * _smooth_step(lower / p.edge)
        openness = edges * _smooth_step((upper + lower) / p.edge - f32(1))
        _store(x, D + i, d)
        _store(x, N + i, n)
        x[S + i] = distance
        x[SEEN + i] = openness
        x[BARE + i] = f32(1) - openness
        x[FRONT + i] = distance * cosine
        x[GX + i] = gx
        x[GY + i] = gy
        x[UPPER + i] = upper
        x[LOWER + i] = lower


@_inlined  # type: ignore[untyped-decorator]
def _shade_skin(p: Any, t: Any, x: Any, words: Any) -> None:
    """Radiance of the near sheet, times its coverage, from four texture samples."""
    for i in range(LANES):
        gx, gy = x[GX + i], x[GY + i]
        coarse_u, coarse_v = gx * f32(0.010), gy * f32(0.012)
        fine_u, fine_v = gx * f32(0.030), gy * f32(0.036)
        upper_row = f32(255) * _clip01(-x[UPPER + i] / f32(3800))
        lower_row = f32(255) * _clip01(-x[LOWER + i] / f32(2600))
        shift_x, shift_y = p.offset_x, p.offset_y
        _texture_indices(
            p.t_skin, coarse_u + shift_x, coarse_v + shift_y, x, words, 0, i
        )
        _texture_indices(p.t_fine, fine_u + shift_y, fine_v + shift_x, x, words, 1, i)
        _texture_indices(p.t_lash, gx * f32(0.016) + shift_x, upper_row, x, words, 2, i)
        _texture_indices(p.t_lash, gx * f32(0.011) + shift_y, lower_row, x, words, 3, i)
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


@_inlined  # type: ignore[untyped-decorator]
def _shade_globe(p: Any, x: Any) -> None:
    """Intersections of the rays with sclera and cornea: distances, normals, cornea
    share.

    ``INSIDE`` is the cornea's share of a pixel: 1 in front of the limbus.
    """
    cornea_centre = _add_scaled(p.centre, p.cornea_d, p.axis)
    for i in range(LANES):
        d = _load(x, D + i)
        ts, _, m = _intersect_sphere(p.centre, p.sclera_r, 1e6, d)
        tc, free, c = _intersect_sphere(cornea_centre, p.cornea_r, 1e4, d)
        forward = _dot(c, p.axis) * p.cornea_r + p.cornea_d - p.limbus_d
        cornea = _smooth_step(forward / (f32(2) * p.edge)) * _clip01(free / f32(2e5))
        _store(x, M + i, m)
        _store(x, C + i, c)
        x[TS + i], x[TC + i], x[INSIDE + i] = ts, tc, cornea


@_inlined  # type: ignore[untyped-decorator]
def _shade_iris(p: Any, t: Any, x: Any, words: Any) -> None:
    """Shares of iris and pupil, iris albedo, and depth of the virtual image behind the
    cornea.

    The refracted path s appears at s / (n - (n - 1) s / R) (paraxial refraction at the
    cornea of radius R and index n). The texture stretches with the pupil.
    """
    width = max(p.limbus_r - p.pupil_r, f32(300))
    for i in range(LANES):
        d, c = _load(x, D + i), _load(x, C + i)
        a, b, path = _refract_to_iris(p, x[TC + i], c, d)
        r = math.sqrt(a * a + b * b + f32(1))
        rim = f32(3) * p.edge + f32(120)
        disc = x[INSIDE + i] * _smooth_step((p.limbus_r - r) / rim)
        x[DISC + i], x[R + i] = disc, r
        x[PUPIL + i] = disc * _smooth_step((p.pupil_r - r) / p.edge)
        denominator = p.index - (p.index - f32(1)) * path / p.cornea_r
        x[VIRTUAL + i] = path / denominator
        span = _clip01((r - p.pupil_r) / width)
        scale = (f32(40) + f32(84) * span) / r
        u, v = a * scale, b * scale
        across = f32(128) + p.turn_x * u - p.turn_y * v
        down = f32(128) + p.turn_y * u + p.turn_x * v
        _texture_indices(p.t_iris, across, down, x, words, 0, i)
    _fetch_texels(t, words, 1)
    for i in range(LANES):
        span = _clip01((x[R + i] - p.pupil_r) / width)
        outer = f32(0.45) * _smooth_step((span - f32(0.94)) * f32(9))
        inner = f32(0.35) * _smooth_step((f32(0.03) - span) * f32(25))
        pattern = f32(1) + p.iris_contrast * _interpolate_texel(x, words, 0, i)
        x[BROWN + i] = p.iris * pattern * (f32(1) - outer) * (f32(1) - inner)


@_inlined  # type: ignore[untyped-decorator]
def _shade_sclera(p: Any, t: Any, x: Any, words: Any) -> None:
    """Albedo of sclera, vessels, limbal ring, caruncle and tear film."""
    for i in range(LANES):
        m = _load(x, M + i)
        u = _dot(m, p.iris_x) * f32(190) + p.offset_x
        v = _dot(m, p.iris_y) * f32(190) + p.offset_y
        _texture_indices(p.t_vein, u, v, x, words, 0, i)
    _fetch_texels(t, words, 1)
    for i in range(LANES):
        vein = _interpolate_texel(x, words, 0, i)
        ring = (
            f32(0.25) * x[INSIDE + i] * _lorentzian((x[R + i] - p.limbus_r) / f32(1300))
        )
        white = p.sclera * (f32(1) - p.veins * vein) * (f32(1) - ring)
        dx, dy = x[GX + i] - p.caruncle, x[GY + i] - f32(500)
        radius2 = (dx * dx + dy * dy) / f32(3.2e6)
        red = f32(0.8) * p.skin * (f32(1) + f32(0.3) * vein)
        white += (red - white) / (f32(1) + radius2 * radius2 * radius2)
        tear = (x[LOWER + i] - f32(120)) / f32(150)
        x[WHITE + i] = white + f32(0.12) * _lorentzian(tear * tear)


@_inlined  # type: ignore[untyped-decorator]
def _shade_light(p: Any, x: Any) -> None:
    """Radiance and depth of the far sheet (the eye), and visible share of the pupil.

    Lambert shading of the albedos by the lamps, darkened below the lids, plus glints.
    The depth of the iris is that of its virtual image.
    """
    for i in range(LANES):
        cornea, disc, pupil = x[INSIDE + i], x[DISC + i], x[PUPIL + i]
        d = _load(x, D + i)
        m = _load(x, M + i)
        c = _load(x, C + i)
        ts, tc, openness = x[TS + i], x[TC + i], x[SEEN + i]
        point = _scaled(ts + cornea * (tc - ts), d)
        normal = _add_scaled(_scaled(f32(1) - cornea, m), cornea, c)
        sharp = f32(250) + f32(1750) * cornea
        specular = _specular_lobe(p.lamp_a, point, normal, d, sharp)
        specular += _specular_lobe(p.lamp_b, point, normal, d, sharp)
        outer = _total_irradiance(p, point, normal, f32(0.3))
        inner = _total_irradiance(p, point, p.axis, f32(0.15))
        upper_gap = f32(1) + max(x[UPPER + i], f32(0)) / f32(900)
        lower_gap = f32(1) + max(x[LOWER + i], f32(0)) / f32(500)
        occlusion = f32(1) - f32(0.50) / (upper_gap * upper_gap) - f32(0.15) / lower_gap
        stroma = x[BROWN + i] * inner * (f32(1) - pupil / max(disc, f32(1e-3)))
        radiance = x[WHITE + i] * outer * (f32(1) - disc) + disc * stroma
        radiance = (radiance + p.pupil * pupil) * occlusion
        x[FAR + i] = (radiance + p.glint * specular) * p.gain * openness
        x[BACK + i] = (ts + disc * (tc + x[VIRTUAL + i] - ts)) * d[2]
        x[HOLE + i] = pupil * openness


@_inlined  # type: ignore[untyped-decorator]
def _tile_range(x: Any, at: Any) -> Any:
    """Least and largest value over the tile of the quantity at offset ``at``."""
    least = largest = x[at]
    for i in range(1, LANES):
        least, largest = min(least, x[at + i]), max(largest, x[at + i])
    return least, largest


@_inlined  # type: ignore[untyped-decorator]
def _shade(p: Any, t: Any, x: Any, words: Any) -> None:
    """Shade one tile: every pass runs only if some pixel needs it; the others leave 0.

    ``p``: parameters of the frame. ``t``: packed texture bank. ``x``: planes of the
    tile, float32. ``words``: texel scratch, int32.
    """
    for i in range(DISC, PLACE):
        x[i] = f32(0)
    _shade_face(p, x)
    least, largest = _tile_range(x, SEEN)
    if least < f32(1):
        _shade_skin(p, t, x, words)
    if largest > f32(0):
        _shade_globe(p, x)
        if _tile_range(x, INSIDE)[1] > f32(0):
            _shade_iris(p, t, x, words)
        if _tile_range(x, DISC)[0] < f32(1):
            _shade_sclera(p, t, x, words)
        _shade_light(p, x)


@numba.njit(nogil=True, cache=True, **SETTINGS)  # type: ignore[untyped-decorator]
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
