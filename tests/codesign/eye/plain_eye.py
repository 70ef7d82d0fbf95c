"""The scene model on torch tensors: exact, differentiable and slow. What the compiled
renderer (:mod:`codesign.eye.kernel`) is compared with.

``p`` holds the parameters of a frame at the indices of :mod:`tests.codesign.eye.model`, ``t``
the bank of textures.
"""

from typing import Any

import torch
from torch import Tensor

from codesign.eye import textures
from codesign.eye.population import CameraRig
from codesign.eye.renderer import PinholeCamera
from tests.codesign.eye.model import (
    AMBIENT,
    AXIS,
    BLEND,
    BROW,
    CARUNCLE,
    CENTRE,
    CORNEA_D,
    CORNEA_R,
    CREASE,
    EDGE,
    FACE_X,
    FACE_Y,
    FACE_Z,
    GAIN,
    GLINT,
    HALF,
    INDEX,
    IRIS,
    IRIS_CONTRAST,
    IRIS_X,
    IRIS_Y,
    LASHES,
    LED,
    LID_R,
    LIMBUS_D,
    LIMBUS_R,
    LOWER,
    MIDDLE,
    OFFSET_X,
    OFFSET_Y,
    PLANE,
    PORES,
    PUPIL,
    PUPIL_D,
    PUPIL_R,
    SCLERA,
    SCLERA_R,
    SKEW,
    SKIN,
    T_FINE,
    T_IRIS,
    T_LASH,
    T_SKIN,
    T_VEIN,
    TURN_X,
    TURN_Y,
    UPPER,
    VEINS,
)

Real = Any  # a torch tensor


def sqrt(x: Tensor) -> Tensor:
    """Square root of a value kept above 0 by the caller."""
    return torch.sqrt(x)


def unit(x: Tensor) -> Tensor:
    """x held in [0, 1]."""
    return x.clamp(0, 1)


def above(x: Tensor, least: float) -> Tensor:
    """x, at least ``least``."""
    return x.clamp_min(least)


def step(x: Tensor) -> Tensor:
    """Smooth step from 0 at x = -1 to 1 at x = 1."""
    t = (0.5 + 0.5 * x).clamp(0, 1)
    return t * t * (3 - 2 * t)


def tex(bank: Tensor, index: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample of picture ``index`` of ``bank`` (pictures, size, size), periodic; u, v in
    pixels.

    Blended by smooth steps between the pixels: bilinear blending would have derivatives
    that jump.
    """
    size = bank.shape[-1]
    fu, fv = torch.floor(u.detach()), torch.floor(v.detach())
    i, j, k = fu.long() % size, fv.long() % size, index.long()
    a, b = bank[k, j, i], bank[k, j, (i + 1) % size]
    c = bank[k, (j + 1) % size, i]
    d = bank[k, (j + 1) % size, (i + 1) % size]
    s, t = u - fu, v - fv
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    return (a + (b - a) * s) * (1 - t) + (c + (d - c) * s) * t


def ray(u: Real, w: Real) -> tuple[Real, Real, Real]:
    """Unit direction of the ray through the tangents (u, w)."""
    k = 1.0 / sqrt(u * u + w * w + 1.0)
    return u * k, w * k, k


def lids(
    p: Real, dx: Real, dy: Real, dz: Real
) -> tuple[Real, Real, Real, Real, Real, Real, Real, Real, Real]:
    """Front of the face along a ray: lid shell and face plane in a smooth union.

    Returns:
        distance, openness of the lids (1 where the eye is seen), face coordinates x and
        y from the eye's centre,
        gap to the upper and lower lid margin (above 0 inside the opening), and the
        normal.
    """
    b = p[CENTRE] * dx + p[CENTRE + 1] * dy + p[CENTRE + 2] * dz
    ex = p[CENTRE] - b * dx
    ey = p[CENTRE + 1] - b * dy
    ez = p[CENTRE + 2] - b * dz
    shell = b - sqrt(above(p[LID_R] * p[LID_R] - ex * ex - ey * ey - ez * ez, 1e6))
    facing = above(-(dx * p[FACE_Z] + dy * p[FACE_Z + 1] + dz * p[FACE_Z + 2]), 0.05)
    height = -(
        p[PLANE] * p[FACE_Z]
        + p[PLANE + 1] * p[FACE_Z + 1]
        + p[PLANE + 2] * p[FACE_Z + 2]
    )
    plane = height / facing
    h = unit(0.5 + 0.5 * (plane - shell) / p[BLEND])
    s = plane + (shell - plane) * h - 0.5 * p[BLEND] * h * (1.0 - h)
    qx = s * dx - p[CENTRE]
    qy = s * dy - p[CENTRE + 1]
    qz = s * dz - p[CENTRE + 2]
    nx = h * qx / p[LID_R] + (1.0 - h) * p[FACE_Z]
    ny = h * qy / p[LID_R] + (1.0 - h) * p[FACE_Z + 1]
    nz = h * qz / p[LID_R] + (1.0 - h) * p[FACE_Z + 2]
    n = 1.0 / sqrt(nx * nx + ny * ny + nz * nz + 1e-6)
    gx = qx * p[FACE_X] + qy * p[FACE_X + 1] + qz * p[FACE_X + 2]
    gy = qx * p[FACE_Y] + qy * p[FACE_Y + 1] + qz * p[FACE_Y + 2]
    along = (gx - p[MIDDLE]) / p[HALF]
    arch = 1.0 - along * along
    upper = gy + arch * (p[UPPER] + p[SKEW] * along)
    lower = arch * (p[LOWER] - p[SKEW] * along) - gy
    openness = (
        step(upper / p[EDGE])
        * step(lower / p[EDGE])
        * step((upper + lower) / p[EDGE] - 1.0)
    )
    return s, openness, gx, gy, upper, lower, nx * n, ny * n, nz * n


def skin(
    p: Real, t: Real, s: Real, gx: Real, gy: Real, upper: Real, lower: Real, dx: Real, dy: Real, dz: Real,
    nx: Real, ny: Real, nz: Real,
) -> Real:  # fmt: skip
    """Radiance of skin, lid margins, creases, lashes and brow at distance ``s``."""
    coarse = tex(t, p[T_SKIN], gx * 0.010 + p[OFFSET_X], gy * 0.012 + p[OFFSET_Y])
    fine = tex(t, p[T_FINE], gx * 0.030 + p[OFFSET_Y], gy * 0.036 + p[OFFSET_X])
    fold = (upper + p[CREASE] + 160.0 * coarse) / 260.0
    pouch = (lower + 2600.0 + 350.0 * coarse) / 420.0
    rim_up = (upper + 250.0) / 260.0
    rim_low = (lower + 330.0) / 330.0
    albedo = p[SKIN] * (1.0 + p[PORES] * (coarse + 0.7 * fine))
    albedo = (
        albedo
        * (1.0 - 0.42 / (1.0 + fold * fold))
        * (1.0 - 0.20 / (1.0 + pouch * pouch))
    )
    albedo = albedo * (1.0 - 0.25 / (1.0 + rim_up * rim_up)) + 0.10 / (
        1.0 + rim_low * rim_low * rim_low * rim_low
    )
    above_lid = unit(-upper / 3800.0)
    below_lid = unit(-lower / 2600.0)
    hair = tex(t, p[T_LASH], gx * 0.016 + p[OFFSET_X], 255.0 * above_lid)
    short = tex(t, p[T_LASH], gx * 0.011 + p[OFFSET_Y], 255.0 * below_lid)
    lash = unit(
        p[LASHES]
        * (
            hair * step(above_lid * 20.0 - 1.0)
            + 0.5 * short * step(below_lid * 8.0 - 1.0)
        )
    )
    band = (gy + 17000.0 + gx * gx / 60000.0) / 2600.0
    brow = unit(p[BROW] * (0.8 + 1.6 * fine) / (1.0 + band * band * band * band))
    albedo = albedo * (1.0 - 0.85 * lash) * (1.0 - 0.75 * brow)
    light = lamps(p, s * dx, s * dy, s * dz, nx, ny, nz, 0.35)
    return albedo * light * p[GAIN]


def globe(p: Real, dx: Real, dy: Real, dz: Real) -> tuple[Real, Real, Real, Real]:
    """Distance and normal where the ray meets the sclera's sphere."""
    b = p[CENTRE] * dx + p[CENTRE + 1] * dy + p[CENTRE + 2] * dz
    ex = p[CENTRE] - b * dx
    ey = p[CENTRE + 1] - b * dy
    ez = p[CENTRE + 2] - b * dz
    ts = b - sqrt(above(p[SCLERA_R] * p[SCLERA_R] - ex * ex - ey * ey - ez * ez, 1e6))
    mx = (ts * dx - p[CENTRE]) / p[SCLERA_R]
    my = (ts * dy - p[CENTRE + 1]) / p[SCLERA_R]
    mz = (ts * dz - p[CENTRE + 2]) / p[SCLERA_R]
    return ts, mx, my, mz


def iris(
    p: Real, t: Real, tc: Real, cx: Real, cy: Real, cz: Real, inside: Real, dx: Real, dy: Real, dz: Real
) -> tuple[Real, Real, Real, Real, Real]:  # fmt: skip
    """Share of iris and of pupil, distance from the axis, albedo, and distance behind
    the cornea of the virtual image.

    Without cornea on the ray (``inside`` 0) both shares are 0.
    """
    x, y, path = refract(p, tc, cx, cy, cz, dx, dy, dz)
    r = sqrt(x * x + y * y + 1.0)
    disc = inside * step((p[LIMBUS_R] - r) / (3.0 * p[EDGE] + 120.0))
    pupil = disc * step((p[PUPIL_R] - r) / p[EDGE])
    brown = pigment(p, t, x, y, r)
    virtual = path / (p[INDEX] - (p[INDEX] - 1.0) * path / p[CORNEA_R])
    return disc, pupil, r, brown, virtual


def pigment(p: Real, t: Real, x: Real, y: Real, r: Real) -> Real:
    """Albedo of the iris at (x, y) in its plane, ``r`` from the axis; the picture
    stretches with the pupil.
    """
    span = unit((r - p[PUPIL_R]) / above(p[LIMBUS_R] - p[PUPIL_R], 300.0))
    place = (40.0 + 84.0 * span) / r
    tu = x * place
    tv = y * place
    figure = tex(
        t,
        p[T_IRIS],
        128.0 + p[TURN_X] * tu - p[TURN_Y] * tv,
        128.0 + p[TURN_Y] * tu + p[TURN_X] * tv,
    )
    brown = p[IRIS] * (1.0 + p[IRIS_CONTRAST] * figure)
    return (
        brown
        * (1.0 - 0.45 * step((span - 0.94) * 9.0))
        * (1.0 - 0.35 * step((0.03 - span) * 25.0))
    )


def sclera(
    p: Real, t: Real, gx: Real, gy: Real, lower: Real, mx: Real, my: Real, mz: Real, r: Real, inside: Real
) -> Real:  # fmt: skip
    """Albedo of sclera, vessels, limbal ring, caruncle and tear film; ``r`` is from the
    axis in the iris plane.
    """
    su = mx * p[IRIS_X] + my * p[IRIS_X + 1] + mz * p[IRIS_X + 2]
    sv = mx * p[IRIS_Y] + my * p[IRIS_Y + 1] + mz * p[IRIS_Y + 2]
    vein = tex(t, p[T_VEIN], su * 190.0 + p[OFFSET_X], sv * 190.0 + p[OFFSET_Y])
    rim = (r - p[LIMBUS_R]) / 1300.0
    white = (
        p[SCLERA] * (1.0 - p[VEINS] * vein) * (1.0 - 0.25 * inside / (1.0 + rim * rim))
    )
    flesh = (
        (gx - p[CARUNCLE]) * (gx - p[CARUNCLE]) + (gy - 500.0) * (gy - 500.0)
    ) / 3.2e6
    white = white + (0.8 * p[SKIN] * (1.0 + 0.3 * vein) - white) / (
        1.0 + flesh * flesh * flesh
    )
    tear = (lower - 120.0) / 150.0
    return white + 0.12 / (1.0 + tear * tear * tear * tear)


def shade(
    p: Real, white: Real, brown: Real, disc: Real, pupil: Real, inside: Real, upper: Real, lower: Real,
    ts: Real, mx: Real, my: Real, mz: Real, tc: Real, cx: Real, cy: Real, cz: Real, dx: Real, dy: Real, dz: Real,
) -> Real:  # fmt: skip
    """Radiance of the eye from its albedos and shares, under the lamps and below the
    lids.
    """
    near = ts + inside * (tc - ts)
    nx = mx + inside * (cx - mx)
    ny = my + inside * (cy - my)
    nz = mz + inside * (cz - mz)
    sharp = 250.0 + 1750.0 * inside
    outer, inner, shine = wet_lamps(
        p, near * dx, near * dy, near * dz, nx, ny, nz, dx, dy, dz, sharp
    )
    lid = above(upper, 0.0) / 900.0
    dim = (
        1.0
        - 0.50 / ((1.0 + lid) * (1.0 + lid))
        - 0.15 / (1.0 + above(lower, 0.0) / 500.0)
    )
    lit = white * outer * (1.0 - disc) + disc * (
        brown * inner * (1.0 - pupil / above(disc, 1e-3))
    )
    lit = (lit + p[PUPIL] * pupil) * dim
    return (lit + p[GLINT] * shine) * p[GAIN]


def eye(
    p: Real,
    t: Real,
    gx: Real,
    gy: Real,
    upper: Real,
    lower: Real,
    dx: Real,
    dy: Real,
    dz: Real,
) -> tuple[Real, Real, Real]:
    """Radiance of the eye along a ray, distance of what is seen (the iris at its
    virtual image), share of pupil.
    """
    ts, mx, my, mz = globe(p, dx, dy, dz)
    tc, cx, cy, cz, inside = cornea(p, dx, dy, dz)
    disc, pupil, r, brown, virtual = iris(p, t, tc, cx, cy, cz, inside, dx, dy, dz)
    white = sclera(p, t, gx, gy, lower, mx, my, mz, r, inside)
    light = shade(
        p, white, brown, disc, pupil, inside, upper, lower, ts, mx, my, mz, tc, cx, cy, cz, dx, dy, dz
    )  # fmt: skip
    return light, ts + disc * (tc + virtual - ts), pupil


def cornea(
    p: Real, dx: Real, dy: Real, dz: Real
) -> tuple[Real, Real, Real, Real, Real]:
    """Distance and normal where the ray meets the cornea's sphere, and 1 where that is
    in front of the limbus.
    """
    ox = p[CENTRE] + p[CORNEA_D] * p[AXIS]
    oy = p[CENTRE + 1] + p[CORNEA_D] * p[AXIS + 1]
    oz = p[CENTRE + 2] + p[CORNEA_D] * p[AXIS + 2]
    b = ox * dx + oy * dy + oz * dz
    ex = ox - b * dx
    ey = oy - b * dy
    ez = oz - b * dz
    free = p[CORNEA_R] * p[CORNEA_R] - ex * ex - ey * ey - ez * ez
    tc = b - sqrt(above(free, 1e4))
    cx = (tc * dx - ox) / p[CORNEA_R]
    cy = (tc * dy - oy) / p[CORNEA_R]
    cz = (tc * dz - oz) / p[CORNEA_R]
    forward = (
        (cx * p[AXIS] + cy * p[AXIS + 1] + cz * p[AXIS + 2]) * p[CORNEA_R]
        + p[CORNEA_D]
        - p[LIMBUS_D]
    )
    inside = step(forward / (2.0 * p[EDGE])) * unit(free / 2e5)
    return tc, cx, cy, cz, inside


def refract(
    p: Real, tc: Real, cx: Real, cy: Real, cz: Real, dx: Real, dy: Real, dz: Real
) -> tuple[Real, Real, Real]:
    """Where the refracted ray meets the iris plane, in iris coordinates, and its path
    inside the eye.

    Rays that meet the plane at a glancing angle are held at a slope of 0.05: they land
    far outside the iris.
    """
    eta = 1.0 / p[INDEX]
    c = -(cx * dx + cy * dy + cz * dz)
    k = eta * c - sqrt(above(1.0 - eta * eta * (1.0 - c * c), 1e-4))
    rx = eta * dx + k * cx
    ry = eta * dy + k * cy
    rz = eta * dz + k * cz
    fx = tc * dx - p[CENTRE] - p[PUPIL_D] * p[AXIS]
    fy = tc * dy - p[CENTRE + 1] - p[PUPIL_D] * p[AXIS + 1]
    fz = tc * dz - p[CENTRE + 2] - p[PUPIL_D] * p[AXIS + 2]
    slope = above(-(rx * p[AXIS] + ry * p[AXIS + 1] + rz * p[AXIS + 2]), 0.05)
    path = above((fx * p[AXIS] + fy * p[AXIS + 1] + fz * p[AXIS + 2]) / slope, 0.0)
    gx = fx + path * rx
    gy = fy + path * ry
    gz = fz + path * rz
    x = gx * p[IRIS_X] + gy * p[IRIS_X + 1] + gz * p[IRIS_X + 2]
    y = gx * p[IRIS_Y] + gy * p[IRIS_Y + 1] + gz * p[IRIS_Y + 2]
    return x, y, path


def lamps(
    p: Real, px: Real, py: Real, pz: Real, nx: Real, ny: Real, nz: Real, wrap: Real
) -> Real:
    """Irradiance of the three flood LEDs and of ambient light from above; 1 is a LED at
    20 mm, normal incidence.
    """
    first = lamp(p[LED] - px, p[LED + 1] - py, p[LED + 2] - pz, nx, ny, nz, wrap)
    second = lamp(p[LED + 3] - px, p[LED + 4] - py, p[LED + 5] - pz, nx, ny, nz, wrap)
    third = lamp(p[LED + 6] - px, p[LED + 7] - py, p[LED + 8] - pz, nx, ny, nz, wrap)
    return (first + second + third) / (1.0 + wrap) + ambient(p, nx, ny, nz)


def ambient(p: Real, nx: Real, ny: Real, nz: Real) -> Real:
    """Diffuse irradiance: more from above than from below."""
    up = nx * p[FACE_Y] + ny * p[FACE_Y + 1] + nz * p[FACE_Y + 2]
    return p[AMBIENT] * (0.6 - 0.4 * up)


def lamp(
    vx: Real, vy: Real, vz: Real, nx: Real, ny: Real, nz: Real, wrap: Real
) -> Real:
    """Irradiance of a small lamp at v from the point; ``wrap`` lets skin glow past the
    terminator.
    """
    k = 1.0 / sqrt(vx * vx + vy * vy + vz * vz + 1e6)
    return above((vx * nx + vy * ny + vz * nz) * k + wrap, 0.0) * (k * k * 4e8)


def wet_lamps(
    p: Real, px: Real, py: Real, pz: Real, nx: Real, ny: Real, nz: Real, dx: Real, dy: Real, dz: Real, sharp: Real
) -> tuple[Real, Real, Real]:  # fmt: skip
    """Irradiance of the outer surface (normal n), of the iris behind it, and mirror
    reflections of two lamps.
    """
    a, b, c = wet_lamp(
        p, p[LED] - px, p[LED + 1] - py, p[LED + 2] - pz, nx, ny, nz, dx, dy, dz, sharp
    )
    d, e, f = wet_lamp(
        p,
        p[LED + 3] - px,
        p[LED + 4] - py,
        p[LED + 5] - pz,
        nx,
        ny,
        nz,
        dx,
        dy,
        dz,
        sharp,
    )
    g, h, _ = wet_lamp(
        p,
        p[LED + 6] - px,
        p[LED + 7] - py,
        p[LED + 8] - pz,
        nx,
        ny,
        nz,
        dx,
        dy,
        dz,
        sharp,
    )
    outer = (a + d + g) / 1.3 + ambient(p, nx, ny, nz)
    inner = (b + e + h) / 1.15 + ambient(p, p[AXIS], p[AXIS + 1], p[AXIS + 2])
    return outer, inner, c + f


def wet_lamp(
    p: Real, vx: Real, vy: Real, vz: Real, nx: Real, ny: Real, nz: Real, dx: Real, dy: Real, dz: Real, sharp: Real
) -> tuple[Real, Real, Real]:  # fmt: skip
    """One lamp at v from the point: light on the surface, on the iris, and its lobe
    about the mirror direction.
    """
    k = 1.0 / sqrt(vx * vx + vy * vy + vz * vz + 1e6)
    fall = k * k * 4e8
    outer = above((vx * nx + vy * ny + vz * nz) * k + 0.3, 0.0) * fall
    inner = (
        above((vx * p[AXIS] + vy * p[AXIS + 1] + vz * p[AXIS + 2]) * k + 0.15, 0.0)
        * fall
    )
    hx = vx * k - dx
    hy = vy * k - dy
    hz = vz * k - dz
    along = above(hx * nx + hy * ny + hz * nz, 0.0)
    off = 1.0 + sharp * 0.5 * (
        1.0 - along * along / (hx * hx + hy * hy + hz * hz + 1e-3)
    )
    return outer, inner, 1.0 / (off * off)


def render_in_torch(
    p: Tensor, rig: CameraRig, camera: PinholeCamera, *, texture_seed: int = 0
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The compiled frames again, in torch and the dtype of ``p``: exact,
    differentiable, and slow.

    Args:
        p: (n, COUNT) parameters.

    Returns:
        light, coverage, depth (n, 2, y, x) and pupil (n, y, x).
    """
    bank = torch.tensor(textures.texture_bank(texture_seed), dtype=p.dtype)
    t = torch.from_numpy(camera.tangents(rig)).to(p)
    q = p.mT[:, :, None, None]
    dx, dy, dz = ray(t, t[:, None])
    s, seen, gx, gy, upper, lower, nx, ny, nz = lids(q, dx, dy, dz)
    near = skin(q, bank, s, gx, gy, upper, lower, dx, dy, dz, nx, ny, nz)
    far, z, hole = eye(q, bank, gx, gy, upper, lower, dx, dy, dz)
    light = torch.stack([near * (1 - seen), far * seen], 1)
    return (
        light,
        torch.stack([1 - seen, seen], 1),
        torch.stack([s * dz, z * dz], 1),
        hole * seen,
    )
