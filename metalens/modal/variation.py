"""First-order change of the scattering matrix when the matrices of the problem change.

With u_i the field for unit power into port i, and K the symmetric operator of layer and
half-spaces on the two
interfaces, the scattering matrix is s_i·u_j - 1, u_j = 2 K⁻¹ s_j, so (fields held
fixed: K is variational)

    d S_ij = ds_i·u_j + u_i·ds_j - 1/2 u_i·dK u_j,
    u_i·dK u_j = ∫ (p_i·dN p_j - u_i·dS u_j) dz + u_i·dY u_j on both interfaces,   N = 1 / growth, S = stiffness.

The integrals of products of modes are closed forms without a pole at equal wavenumbers,
so degenerate modes need no
care. All matrices are in the coordinates of the homogeneous modes; lengths are in half
pitches.
"""

from dataclasses import dataclass, replace

import numpy as np

from metalens.modal.homogeneous import Basis
from metalens.modal.layer import LayerModes, axial
from metalens.modal.match import HalfSpace, Match


@dataclass(frozen=True, eq=False, slots=True)
class Change:
    """Rates of everything in one parameter.

    k0, disc, around: of the wavenumber and the permittivities of the layer. bloch: of
    kx. mass, curl (n, n) and scalar
    (b, b): of the cell; disc_mass, disc_curl, disc_scalar: of the disc; gradient: (n,
    b).
    """

    k0: float
    disc: float
    around: float
    bloch: float
    mass: np.ndarray
    curl: np.ndarray
    scalar: np.ndarray
    disc_mass: np.ndarray
    disc_curl: np.ndarray
    disc_scalar: np.ndarray
    gradient: np.ndarray


def raise_gradient(basis: Basis) -> np.ndarray:
    """(n, b) coordinates of the gradients of the TM scalars."""
    out = np.zeros((basis.size, len(basis.tm)))
    out[len(basis.te) :] = np.diag(np.sqrt(basis.tm))
    return out


def electric_rates(
    basis: Basis, k0: float, disc: complex, around: complex, change: Change
) -> tuple[np.ndarray, np.ndarray]:
    """Rates of stiffness and 1 / growth of the electric form."""
    n, b = basis.size, len(basis.tm)
    step = disc - around
    mass = step * basis.disc_mass + around * np.eye(n)
    d_step = change.disc - change.around
    d_mass = (
        step * change.disc_mass
        + around * change.mass
        + d_step * basis.disc_mass
        + change.around * np.eye(n)
    )
    stiffness = change.curl - k0**2 * d_mass - 2 * k0 * change.k0 * mass
    scalar = step * basis.disc_scalar + around * np.eye(b)
    d_scalar = (
        step * change.disc_scalar + around * change.scalar + d_step * basis.disc_scalar
    )
    d_scalar = d_scalar + change.around * np.eye(b)
    raised = raise_gradient(basis)
    lower = np.linalg.solve(k0**2 * scalar, raised.T)
    turn = change.gradient @ lower
    inverse = (
        -change.mass
        + lower.T @ (k0**2 * d_scalar + 2 * k0 * change.k0 * scalar) @ lower
        - turn
        - turn.T
    )
    return stiffness, inverse


def magnetic_rates(
    basis: Basis, k0: float, disc: complex, around: complex, change: Change
) -> tuple[np.ndarray, np.ndarray]:
    """Rates of stiffness and 1 / growth of the magnetic form."""
    n, b = basis.size, len(basis.tm)
    outer, step = 1 / around, 1 / disc - 1 / around
    d_outer = -change.around / around**2
    d_step = -change.disc / disc**2 - d_outer
    stiffness = (
        step * change.disc_curl
        + outer * change.curl
        - k0**2 * change.mass
        - 2 * k0 * change.k0 * np.eye(n)
    )
    a = len(basis.te)
    stiffness[:a, :a] = (
        stiffness[:a, :a] + d_step * basis.disc_curl + d_outer * np.diag(basis.te)
    )
    weighted = np.linalg.inv(step * basis.disc_mass + outer * np.eye(n))
    d_weighted = (
        step * change.disc_mass
        + outer * change.mass
        + d_step * basis.disc_mass
        + d_outer * np.eye(n)
    )
    raised = raise_gradient(basis)
    lower = raised.T / k0**2
    turn = change.gradient @ lower
    inverse = (
        lower.T @ (k0**2 * change.scalar + 2 * k0 * change.k0 * np.eye(b)) @ lower
        - turn
        - turn.T
    )
    return stiffness, inverse - weighted @ d_weighted @ weighted


@dataclass(frozen=True, eq=False, slots=True)
class HalfRate:
    """Rates of the admittance operator (n, n) of a half-space and of its source vector
    (n,) of the zero order.
    """

    admittance: np.ndarray
    source: np.ndarray


def half_space_rate(
    basis: Basis,
    half: HalfSpace,
    zero: int,
    k0: float,
    permittivity: float,
    change: Change,
    *,
    magnetic: bool,
) -> HalfRate:
    """A half-space is a layer of infinite height with the homogeneous modes; its zero
    order has its own wavenumber.
    """
    a, change = len(basis.te), replace(change, disc=0.0, around=0.0)
    discrete = axial(k0**2 * permittivity - np.concatenate([basis.te, basis.tm]))
    factor = np.ones(basis.size, complex)
    factor[a:] = k0**2 * permittivity / discrete[a:] ** 2
    if magnetic:
        factor /= permittivity
    stiffness, inverse = (magnetic_rates if magnetic else electric_rates)(
        basis, k0, permittivity, permittivity, change
    )
    y = 1j * discrete * factor
    operator = (
        (y[:, None] * y * inverse - stiffness) * 1j / (discrete[:, None] + discrete)
    )
    # the zero order turns within the basis, and its exact wavenumber replaces the
    # discrete one
    column = (
        stiffness[:, zero]
        - discrete[zero] ** 2 * factor * factor[zero] * inverse[:, zero]
    )
    gap = factor * (discrete[zero] ** 2 - discrete**2)
    gap[zero] = 1.0
    dual = change.mass[:, zero] - column / gap
    dual[zero] = change.mass[zero, zero] / 2
    y_exact = half.admittance[zero]
    kz = axial(
        k0**2 * permittivity - np.concatenate([basis.te_exact, basis.tm_exact])[zero]
    )
    bloch = np.sqrt(np.concatenate([basis.te_exact, basis.tm_exact])[zero])
    d_kz = (k0 * permittivity * change.k0 - bloch * change.bloch) / kz
    d_exact = y_exact * (d_kz / kz if zero < a else 2 * change.k0 / k0 - d_kz / kz)
    d_discrete = operator[zero, zero] - y[zero] * change.mass[zero, zero]
    operator[zero, zero] += d_exact - d_discrete
    operator[:, zero] += (y_exact - y[zero]) * dual
    operator[zero, :] += (y_exact - y[zero]) * dual
    source = np.sqrt(y_exact) * dual
    source[zero] += d_exact / (2 * np.sqrt(y_exact))
    return HalfRate(operator, source)


def half_space_by_permittivity(
    basis: Basis,
    half: HalfSpace,
    zero: int,
    k0: float,
    permittivity: float,
    *,
    magnetic: bool,
) -> HalfRate:
    """Derivative of ``match.half_space`` in its permittivity, at fixed kx: closed
    forms, mode by mode.
    """
    a, e = len(basis.te), permittivity
    kz = axial(k0**2 * e - np.concatenate([basis.te_exact, basis.tm_exact]))
    by_kz = k0**2 / (2 * kz)
    te = by_kz[:a] / e - kz[:a] / e**2 if magnetic else by_kz[:a]
    tm = (
        -by_kz[a:] / kz[a:] ** 2
        if magnetic
        else 1 / kz[a:] - e * by_kz[a:] / kz[a:] ** 2
    )
    rate = 1j * np.concatenate([te, k0**2 * tm])
    source = np.zeros(basis.size, complex)
    source[zero] = rate[zero] / (2 * np.sqrt(half.admittance[zero]))
    return HalfRate(np.diag(rate), source)


@dataclass(frozen=True, eq=False, slots=True)
class Waves:
    """Amplitudes of all layer modes, up from the foot and down from the top: (n, 2), a
    column per zero-order port.
    """

    up: np.ndarray
    down: np.ndarray


def waves(
    match: Match, layer: LayerModes, height: float, foot_port: int, top_port: int
) -> Waves:
    """All amplitudes for unit power into the zero order from below and from above;
    ports counted on each side.
    """
    c, below = len(match.carry), match.foot.back.shape[0]
    x = np.exp(1j * layer.q[match.carry] * height)[:, None]
    amplitude = match.amplitude[:, [foot_port, below + top_port]]
    down_at_foot, up_at_top = x * amplitude[c:], x * amplitude[:c]
    up = match.foot.inward[:, :c] @ down_at_foot
    down = match.top.inward[:, :c] @ up_at_top
    up[match.carry] -= down_at_foot
    down[match.carry] -= up_at_top
    up[:, 0] += match.foot.inward[:, c + foot_port]
    down[:, 1] += match.top.inward[:, c + top_port]
    return Waves(up, down)


def overlaps(q: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """∫ exp(i (qm + qn) z) dz and ∫ exp(i qm z + i qn (h - z)) dz over the height, (n,
    n) each.
    """

    def mean_exponential(z: np.ndarray) -> np.ndarray:
        small = np.abs(z) < 1e-5
        safe = np.where(small, 1.0, z)
        mean: np.ndarray = np.where(small, 1 + z / 2 + z * z / 6, np.expm1(safe) / safe)
        return mean

    first, second = (
        np.where(q.imag[:, None] >= q.imag, q[:, None], q),
        np.where(q.imag[:, None] >= q.imag, q, q[:, None]),
    )
    along = height * mean_exponential(1j * height * (q[:, None] + q))
    against = (
        height
        * np.exp(1j * second * height)
        * mean_exponential(1j * height * (first - second))
    )
    return along, against


def layer_rate(
    layer: LayerModes, w: Waves, height: float, rates: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """(2, 2) of ∫ (p_i·dN p_j - u_i·dS u_j) dz."""
    along, against = overlaps(layer.q, height)
    stiffness = layer.field.T @ rates[0] @ layer.field
    inverse = layer.partner.T @ rates[1] @ layer.partner
    rate = 1j * layer.q[:, None]

    def total(matrix: np.ndarray, up: np.ndarray, down: np.ndarray) -> np.ndarray:
        same, other = matrix * along, matrix * against
        sum_: np.ndarray = (
            up.T @ same @ up
            + down.T @ same @ down
            + up.T @ other @ down
            + down.T @ other @ up
        )
        return sum_

    out: np.ndarray = total(inverse, rate * w.up, -rate * w.down) - total(
        stiffness, w.up, w.down
    )
    return out


def matrix_rate(
    layer: LayerModes,
    w: Waves,
    height: float,
    rates: tuple[np.ndarray, np.ndarray],
    halves: tuple[HalfRate, HalfRate],
) -> np.ndarray:
    """Derivative of the (2, 2) zero-order scattering matrix."""
    travel = np.exp(1j * layer.q * height)[:, None]
    foot = layer.field @ (w.up + travel * w.down)
    top = layer.field @ (travel * w.up + w.down)
    inner = layer_rate(layer, w, height, rates)
    for field, half in zip((foot, top), halves, strict=True):
        inner = inner + field.T @ half.admittance @ field
    sources = np.stack([halves[0].source @ foot, halves[1].source @ top])
    out: np.ndarray = sources + sources.T - inner / 2
    return out
