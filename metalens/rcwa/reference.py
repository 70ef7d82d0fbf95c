"""Textbook RCWA: the engine's result in one page, without its shortcuts."""

import math
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, index
from metalens.core.arrays import Array
from metalens.rcwa.permittivity import PillarSection, pillar_section, staircase_layers


@dataclass(frozen=True, eq=False, slots=True)
class OrderResponse:
    """Amplitudes and powers of all retained diffraction orders.

    m, n: (k,) orders along x and y.
    t, r: (2, 2) power-normalised zero-order Jones matrices, row: leaving, column:
        incident; x, y at normal incidence, else s, p (as in
        ``metalens.rcwa.JonesResponse``).
    transmitted, reflected: (k, 2) power of each order for unit power incident.
    """

    m: Array
    n: Array
    t: Array
    r: Array
    transmitted: Array
    reflected: Array


def solve_textbook_rcwa(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    *,
    harmonics: int,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    steps: int = 8,
) -> OrderResponse:
    """Rigorous coupled-wave analysis by Laurent's rule (Moharam et al., J. Opt. Soc.
    Am. A 12, 1068 and 1077 (1995)), exp(-iwt), light from the substrate.

    In each layer e' = i P h, h' = i Q e with tangential fields e, h; layers are matched
    by one linear system for all amplitudes.

    Args:
        wavelength_um: vacuum wavelength, um.
        size_um: of the shape (its diameter).
        harmonics: M; orders -M to M along x and y.
        angle_rad: outside, in vacuum. azimuth_rad: of the plane of incidence.
        steps: layers of equal height that a tilted wall is cut into (staircase).

    Accuracy: error of t falls slowly, as 1/M for high contrast; the engine's normal
        vectors (``metalens.rcwa.jones``) have the same limit.

    >>> from metalens.cell import Cell, Index
    >>> cell = Cell(0.35, 0.5, pillar=Index(2.0), substrate=Index(1.45))
    >>> orders = solve_textbook_rcwa(cell, 0.2, 0.85, harmonics=3)
    >>> round(float((orders.transmitted + orders.reflected)[:, 0].sum()), 9)
    1.0
    """
    k0 = 2 * math.pi / wavelength_um
    px, py = cell.lattice.periods_um(cell.pitch_um)
    span = np.arange(-harmonics, harmonics + 1)
    m, n = (order.ravel() for order in np.meshgrid(span, span, indexing="ij"))
    sine = math.sin(angle_rad)
    kx = sine * math.cos(azimuth_rad) + m * wavelength_um / px
    ky = sine * math.sin(azimuth_rad) + n * wavelength_um / py
    identity = np.eye(len(m))

    def matrices(eps: Array) -> tuple[Array, Array]:
        """P and Q of a layer with the Toeplitz matrix eps."""
        inverse = np.linalg.inv(eps)
        x, y = np.diag(kx), np.diag(ky)
        P = [
            [x @ inverse @ y, identity - x @ inverse @ x],
            [y @ inverse @ y - identity, -y @ inverse @ x],
        ]
        Q = [[-x @ y, x @ x - eps], [eps - y @ y, y @ x]]
        return np.block(P), np.block(Q)

    def modes(eps: Array) -> tuple[Array, Array, Array]:
        """q (n,), and columns e (W) and h (V) of the upward modes: P Q W = W q^2."""
        P, Q = matrices(eps)
        square, W = np.linalg.eig(P @ Q)
        q = np.sqrt(square.astype(complex))
        q = np.where((q.imag < 0) | ((abs(q.imag) < 1e-12) & (q.real < 0)), -q, q)
        return q, W, Q @ W / q

    def half_space(index_of: complex) -> tuple[Array, Array]:
        """kz of the orders, and V with h = V e of waves that leave."""
        kz = np.sqrt(index_of**2 - kx**2 - ky**2 + 0j)
        kz = np.where(kz == 0, 1e-9, kz)
        return kz, matrices(index_of**2 * identity)[1] / np.concatenate([kz, kz])

    gx, gy = (
        2 * np.pi / period * (order[:, None] - order)
        for period, order in ((px, m), (py, n))
    )
    sites = 1 + np.exp(1j * (gx * px + gy * py) / 2) if cell.lattice.centred else 1

    def toeplitz(section: PillarSection) -> Array:
        """Toeplitz matrix of the permittivity of a section (Laurent's rule)."""
        eps = section.outside * identity + 0j
        outer = (*section.inside[1:], section.outside)
        for outline, inside, around in zip(
            section.outlines, section.inside, outer, strict=True
        ):
            eps += (inside - around) * sites * outline.fourier(gx, gy) / (px * py)
        return eps

    under, over = (
        [(index(f.material, wavelength_um) ** 2 * identity, f.thickness_um) for f in s]
        for s in (cell.under, cell.over)
    )
    patterned = [
        (toeplitz(pillar_section(cell, layer, size_um, wavelength_um)), layer.height_um)
        for layer in staircase_layers(cell, steps)
    ]
    slabs = [(modes(eps), height) for eps, height in (*under, *patterned, *over)]

    (kz_s, V_s), (kz_c, V_c) = (
        half_space(index(side, wavelength_um)) for side in (cell.substrate, cell.cover)
    )
    size = 2 * len(m)
    unity = np.eye(size)
    # unknowns: reflected e, (up, down) amplitudes of each slab, transmitted e
    total = size * (2 + 2 * len(slabs))
    system = np.zeros((total, total), complex)
    system[: 2 * size, :size] = np.vstack([-unity, V_s])
    for i, ((q, W, V), height) in enumerate(slabs):
        decay = np.exp(1j * q * height * k0)
        row, column = 2 * size * i, size * (1 + 2 * i)
        foot = np.block([[W, W * decay], [V, -V * decay]])
        top = np.block([[W * decay, W], [V * decay, -V]])
        system[row : row + 2 * size, column : column + 2 * size] = foot
        system[row + 2 * size : row + 4 * size, column : column + 2 * size] = -top
    system[-2 * size :, -size:] += np.vstack([unity, V_c])

    zero = int(np.flatnonzero((m == 0) & (n == 0))[0])
    direction = np.eye(2)
    if angle_rad:
        c, s = math.cos(azimuth_rad), math.sin(azimuth_rad)
        direction = np.array([[-s, c], [c, s]])  # s, then p along the layers
    incoming = np.zeros((size, 2), complex)
    incoming[[zero, zero + len(m)]] = direction.T
    source = np.zeros((total, 2), complex)
    source[: 2 * size] = np.vstack([incoming, V_s @ incoming])
    amplitudes = np.linalg.solve(system, source)
    reflected_e, transmitted_e = amplitudes[:size], amplitudes[-size:]

    def power(e: Array, V: Array) -> Array:
        """(k, 2) power of each order along z, Re(ex hy* - ey hx*)."""
        h = V @ e
        k = len(m)
        return np.asarray((e[:k] * h[k:].conj() - e[k:] * h[:k].conj()).real)

    incident = power(incoming, V_s)[zero]
    zero_pair = [zero, zero + len(m)]
    from_substrate = _admittance(
        index(cell.substrate, wavelength_um), kz_s[zero], angle_rad
    )
    into_cover = _admittance(index(cell.cover, wavelength_um), kz_c[zero], angle_rad)
    t = np.sqrt(into_cover[:, None] / from_substrate) * (
        direction @ transmitted_e[zero_pair]
    )
    r = np.sqrt(from_substrate[:, None] / from_substrate) * (
        direction @ reflected_e[zero_pair]
    )
    reflected = -power(reflected_e, -V_s) / incident
    return OrderResponse(m, n, t, r, power(transmitted_e, V_c) / incident, reflected)


def _admittance(medium: complex, kz: complex, angle_rad: float) -> Array:
    """(2,) h over e along the layers of x and y at normal incidence, else of s and p."""
    return np.array([kz, medium**2 / kz] if angle_rad else [kz, kz])
