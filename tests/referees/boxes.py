"""Cells of boxes along x and y by coupled waves: own code, exact factorisation for
edges along the axes; exp(-iwt).

The referee of ``rcwa.jones``: it shares nothing with it but Maxwell's equations. Orders
stand in a rectangle, products
are factorised edge by edge (L. Li, J. Opt. Soc. Am. A 14, 2758 (1997), by strips: the
inverse rule across an edge,
Laurent's along it), modes are joined by scattering matrices (Redheffer's star). Lengths
in um; E and H times the
impedance of vacuum; no symmetry is used.
"""

from dataclasses import dataclass

import numpy as np

Film = tuple[float, complex]  # thickness, index


@dataclass(frozen=True)
class Boxes:
    """A layer: permittivity (y, x) between the lines x_um and y_um, which begin and end
    one period apart.
    """

    thickness_um: float
    x_um: np.ndarray
    y_um: np.ndarray
    permittivity: np.ndarray


def boxes(thickness_um, periods_um, around, *rectangles):
    """A layer of rectangles (x0, x1, y0, y1, index), later ones over earlier ones, in a
    material of index around.
    """
    ends = [np.array([-p / 2, p / 2]) for p in periods_um]
    x, y = (
        np.unique(
            np.round(
                np.concatenate(
                    [
                        ends[k],
                        *(np.clip(r[2 * k : 2 * k + 2], *ends[k]) for r in rectangles),
                    ]
                ),
                12,
            )
        )
        for k in (0, 1)
    )
    made = np.full((len(y) - 1, len(x) - 1), complex(around) ** 2)
    across, down = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
    for x0, x1, y0, y1, index in rectangles:
        made[np.ix_((down > y0) & (down < y1), (across > x0) & (across < x1))] = (
            complex(index) ** 2
        )
    return Boxes(thickness_um, x, y, made)


def _toeplitz(lines, reach):
    """(strip, order, order) of the Fourier coefficients of every strip between lines."""
    period = lines[-1] - lines[0]
    m = np.arange(-2 * reach, 2 * reach + 1)
    middle = (lines[1:] + lines[:-1])[:, None] / 2
    width = np.diff(lines)[:, None]
    c = (
        width
        / period
        * np.sinc(m * width / period)
        * np.exp(-2j * np.pi * m * middle / period)
    )
    i = np.arange(2 * reach + 1)
    return c[:, i[:, None] - i + 2 * reach]


def _products(layer, reach):
    """Operators D = [e] E of Ex, Ey and Ez: across edges the inverse rule, along them
    Laurent's.
    """
    e = layer.permittivity
    x = _toeplitz(layer.x_um, reach[0])
    y = _toeplitz(layer.y_um, reach[1])
    size = x.shape[1] * y.shape[1]
    of_x = np.array([np.linalg.inv(np.einsum("i,iab->ab", 1 / row, x)) for row in e])
    of_y = np.array(
        [np.linalg.inv(np.einsum("j,jcd->cd", 1 / column, y)) for column in e.T]
    )
    ex = np.einsum("jab,jcd->acbd", of_x, y)
    ey = np.einsum("iab,icd->acbd", x, of_y)
    ez = np.einsum("ji,iab,jcd->acbd", e, x, y)
    return [part.reshape(size, size) for part in (ex, ey, ez)]


def _rows(kx, ky, ex, ey):
    """dH/dz = i Q E of (Ex, Ey)."""
    return np.block(
        [
            [-np.diag(kx * ky), np.diag(kx**2) - ey],
            [ex - np.diag(ky**2), np.diag(kx * ky)],
        ]
    )


def _upward(square):
    root = np.sqrt(square.astype(complex))
    return np.where(
        (root.imag < -1e-12) | ((np.abs(root.imag) <= 1e-12) & (root.real < 0)),
        -root,
        root,
    )


def _uniform(index, kx, ky):
    e = complex(index) ** 2
    along = np.tile(_upward(e - kx**2 - ky**2), 2)
    unit = np.eye(len(kx))
    return (
        np.eye(2 * len(kx), dtype=complex),
        _rows(kx, ky, e * unit, e * unit) / along,
        along,
    )


def _modes(layer, reach, kx, ky):
    ex, ey, ez = _products(layer, reach)
    inverse, unit = np.linalg.inv(ez), np.eye(len(kx))
    p = np.block(
        [
            [kx[:, None] * inverse * ky, unit - kx[:, None] * inverse * kx],
            [ky[:, None] * inverse * ky - unit, -ky[:, None] * inverse * kx],
        ]
    )
    q = _rows(kx, ky, ex, ey)
    square, electric = np.linalg.eig(p @ q)
    along = _upward(square)
    return electric, q @ electric / along, along


def _star(first, second):
    a11, a12, a21, a22 = first
    b11, b12, b21, b22 = second
    unit = np.eye(len(a11))
    there = np.linalg.solve((unit - b11 @ a22).T, a12.T).T
    back = np.linalg.solve((unit - a22 @ b11).T, b21.T).T
    return a11 + there @ b11 @ a21, there @ b12, back @ a21, b22 + back @ a22 @ b12


def _face(before, after):
    electric = np.linalg.solve(before[0], after[0])
    magnetic = np.linalg.solve(before[1], after[1])
    both, apart = (electric + magnetic) / 2, (electric - magnetic) / 2
    inverse = np.linalg.inv(both)
    return apart @ inverse, both - apart @ inverse @ apart, inverse, -inverse @ apart


def jones(
    layers,
    periods_um,
    wavelength_um,
    substrate,
    cover,
    *,
    reach,
    angle_rad=0.0,
    azimuth_rad=0.0,
):
    """(t, r), each (2, 2), column the light that comes: s and p (x and y at normal
    incidence), power-normalised.

    layers: films and boxes as the light meets them. reach: largest orders (along x,
    along y).
    """
    m, n = (
        part.ravel()
        for part in np.meshgrid(*(np.arange(-k, k + 1) for k in reach), indexing="ij")
    )
    u = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    kx, ky = (
        np.sin(angle_rad) * u[k] + i * wavelength_um / periods_um[k]
        for k, i in ((0, m), (1, n))
    )
    now, whole = _uniform(substrate, kx, ky), None
    for layer in layers:
        made = (
            _modes(layer, reach, kx, ky)
            if isinstance(layer, Boxes)
            else _uniform(layer[1], kx, ky)
        )
        face = _face(now, made)
        whole = face if whole is None else _star(whole, face)
        turn = np.exp(
            2j
            * np.pi
            / wavelength_um
            * made[2]
            * (layer.thickness_um if isinstance(layer, Boxes) else layer[0])
        )
        whole = (
            whole[0],
            whole[1] * turn,
            turn[:, None] * whole[2],
            turn[:, None] * whole[3] * turn,
        )
        now = made
    face = _face(now, _uniform(cover, kx, ky))
    whole = face if whole is None else _star(whole, face)
    zero, count = int(np.flatnonzero((m == 0) & (n == 0))[0]), len(m)
    across = np.array([-u[1], u[0]]) if angle_rad else np.array([1.0, 0.0])
    waves = np.stack([across, u if angle_rad else np.array([0.0, 1.0])])

    def power(index):  # of unit tangential fields: s, then p
        square = complex(index) ** 2
        z = np.sqrt(square - np.sin(angle_rad) ** 2)
        return np.sqrt([z.real, (square / z).real])

    places = np.array([zero, count + zero])
    come, leave = power(substrate), power(cover)
    t, r = (
        waves @ part[np.ix_(places, places)] @ waves.T / come
        for part in (whole[2], whole[0])
    )
    return t * leave[:, None], r * come[:, None]
