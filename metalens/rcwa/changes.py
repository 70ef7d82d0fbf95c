"""How the operators of a layer change with pattern, indices and wave vector."""

import numpy as np

from metalens.ground.arrays import Array
from metalens.rcwa.conditions import Case
from metalens.rcwa.layer import factored, join
from metalens.rcwa.orders import basis as fourier
from metalens.rcwa.orders.waves import Waves

Change = tuple[Array, Array]  # dP, dQ of a layer; dK, dR of the wave vectors


def rim(this: Case, ways: Waves, diameter_um: Array) -> Change:
    """dP and dQ for each micrometre of diameter."""
    rate = fourier.disc_rate(ways.space, diameter_um, this.cell.pitch_um)
    inside, outside = this.pillar**2, this.between**2
    normal = fourier.normals_rate(ways.space, diameter_um, this.cell.pitch_um)
    direct, inverse = (inside - outside) * rate, (1 / inside - 1 / outside) * rate
    return _pattern(this, ways, diameter_um, (direct, inverse), normal)


def indices(
    this: Case, ways: Waves, diameter_um: Array, pillar: complex, between: complex
) -> Change:
    """dP and dQ when the indices of pillar and surroundings change by these amounts."""
    shape = fourier.disc(ways.space, diameter_um, this.cell.pitch_um)
    rest = (ways.space.shells == 0) - shape
    inside, outside = 2 * this.pillar * pillar, 2 * this.between * between
    direct = inside * shape + outside * rest
    inverse = -(inside / this.pillar**4 * shape + outside / this.between**4 * rest)
    return _pattern(this, ways, diameter_um, (direct, inverse), None)


def _pattern(
    this: Case,
    ways: Waves,
    diameter_um: Array,
    change: Change,
    normal: tuple[Array, Array, Array] | None,
) -> Change:
    """dP and dQ for changes of the Fourier coefficients of (eps, 1/eps), and of the
    normal field.
    """
    space = ways.space
    (direct, inverse), (now, now_inverse) = (
        change,
        _coefficients(this, ways, diameter_um),
    )
    laurent, delta_rate, delta = [], [], []
    for link in (fourier.EX, fourier.EY):
        plain, bend = (
            fourier.products(space, direct, link),
            fourier.products(space, inverse, link),
        )
        impermeability = np.linalg.inv(fourier.products(space, now_inverse, link))
        laurent.append(plain)
        delta_rate.append(plain + impermeability @ bend @ impermeability)
        delta.append(factored(space, now, now_inverse, link)[1])
    field = fourier.normals(space, diameter_um, this.cell.pitch_um)
    dQ = join(ways, (laurent[0], laurent[1]), (delta_rate[0], delta_rate[1]), field)
    if normal is not None:
        none = np.zeros_like(laurent[0]), np.zeros_like(laurent[1])
        dQ = dQ + join(ways, none, (delta[0], delta[1]), normal)
    z = slice(ways.bare, ways.p_count)
    inner = np.linalg.inv(fourier.products(space, now, fourier.EZ)) * ways.kappa[z]
    dP = np.zeros_like(dQ)
    dP[z, z] = inner.T @ fourier.products(space, direct, fourier.EZ) @ inner
    return dP, dQ


def _coefficients(this: Case, ways: Waves, diameter_um: Array) -> tuple[Array, Array]:
    shape = fourier.disc(ways.space, diameter_um, this.cell.pitch_um)
    inside, outside, start = this.pillar**2, this.between**2, ways.space.shells == 0
    return (inside - outside) * shape + outside * start, (
        1 / inside - 1 / outside
    ) * shape + start / outside


def turning(ways: Waves, change: Array) -> Change:
    """Changes of K (waves, Ez orders) and R (waves, Hz orders) for changes (2, n) of k,
    the waves held as they are.
    """
    along = (change * ways.along).sum(axis=0)
    across = change[1] * ways.along[0] - change[0] * ways.along[1]
    p, s = np.arange(ways.bare, ways.p_count), np.arange(ways.p_count, len(ways.kappa))
    same = (
        (ways.m[s][:, None] == ways.m[p]) & (ways.n[s][:, None] == ways.n[p])
    ).astype(float)
    dK, dR = np.zeros((len(ways.kappa), len(p))), np.zeros((len(ways.kappa), len(s)))
    dK[p, np.arange(len(p))] = along[p]
    dK[s] = same * across[p]
    dR[s, np.arange(len(s))] = along[s]
    dR[p] = -same.T * across[s]
    return dK, dR


def _lengths(ways: Waves) -> Change:
    """K and R themselves."""
    p, s = np.arange(ways.bare, ways.p_count), np.arange(ways.p_count, len(ways.kappa))
    K, R = np.zeros((len(ways.kappa), len(p))), np.zeros((len(ways.kappa), len(s)))
    K[p, np.arange(len(p))], R[s, np.arange(len(s))] = ways.kappa[p], ways.kappa[s]
    return K, R


def turned_pattern(this: Case, ways: Waves, diameter_um: Array, turn: Change) -> Change:
    """dP and dQ of a pillar layer for changes of K and R."""
    direct, _ = _coefficients(this, ways, diameter_um)
    inner = np.linalg.inv(fourier.products(ways.space, direct, fourier.EZ))
    (dK, dR), (K, R) = turn, _lengths(ways)
    half_p, half_q = dK @ inner @ K.T, dR @ R.T
    return -(half_p + half_p.T), -(half_q + half_q.T)


def medium(ways: Waves, index: complex, permittivity: complex, turn: Change) -> Change:
    """dP and dQ of a homogeneous medium for changes of its permittivity and of K and R."""
    (dK, dR), (K, R) = turn, _lengths(ways)
    eps = index**2
    half_p, half_q = dK @ K.T / eps, dR @ R.T
    dP = permittivity / eps**2 * (K @ K.T) - half_p - half_p.T
    return dP, permittivity * np.eye(len(ways.kappa)) - half_q - half_q.T


def add(one: Change, other: Change) -> Change:
    """The sum of two changes."""
    return one[0] + other[0], one[1] + other[1]
