"""Two interfaces: from the modes of a layer between half-spaces to the scattering matrix of its orders.

Semi-infinite layer and half-space meet in the symmetric operator G = (Y_layer + Y_half)⁻¹. Only layer modes that
survive the height (|exp(i q h)| above a threshold) travel between the interfaces; everything else is local to G.
So each interface is one linear solve with a few right-hand sides, kept real where the case is lossless: what
propagates enters through a small complex correction (Woodbury).
"""

from dataclasses import dataclass

import numpy as np

from metalens.modal.homogeneous import Basis
from metalens.modal.layer import LayerModes, Medium, axial

CARRY = 1e-13  # modes that decay below this over the height cannot change a result of double precision


@dataclass(frozen=True, eq=False, slots=True)
class HalfSpace:
    """Admittances (n,) of the homogeneous modes (p = Y u going away), and which of them propagate."""

    admittance: np.ndarray
    ports: np.ndarray


def half_space(basis: Basis, k0: float, permittivity: float, *, magnetic: bool) -> HalfSpace:
    """Admittances p / u: electric form i kz (TE), i k0² eps / kz (TM); magnetic form i kz / eps, i k0² / kz.

    A wavenumber exactly at cut-off is moved off it by 1e-8 k0, so that the admittance stays finite.
    """
    kz = axial(np.concatenate([k0**2 * permittivity - basis.te, k0**2 * permittivity - basis.tm]))
    kz = np.where(np.abs(kz) < 1e-8 * k0, 1e-8 * k0, kz)
    a = len(basis.te)
    te, tm = (1 / permittivity, 1.0) if magnetic else (1.0, permittivity)
    admittance = np.concatenate([1j * kz[:a] * te, 1j * k0**2 * tm / kz[a:]])
    return HalfSpace(admittance, np.flatnonzero(kz.real > 0))


@dataclass(frozen=True, eq=False, slots=True)
class Interface:
    """One end of the layer, seen by its carrying modes and by the propagating orders (power-normalised).

    reflect: (carry, carry) of layer modes; enter: (carry, ports); leave: (ports, carry); back: (ports, ports).
    """

    reflect: np.ndarray
    enter: np.ndarray
    leave: np.ndarray
    back: np.ndarray


def interface(layer: LayerModes, carry: np.ndarray, half: HalfSpace) -> Interface:
    """Reflect, enter and leave blocks at a half-space, from G applied to carrying partners and ports."""
    admittance, ports = half.admittance, half.ports
    rate = 1j * layer.q
    norm = layer.partner[:, carry].T @ layer.field[:, carry]
    columns = np.concatenate([layer.partner[:, carry], np.eye(len(admittance))[:, ports]], 1)
    c = len(carry)
    base_rate, base_admittance = rate, admittance
    lossless = np.isrealobj(layer.field)
    if lossless:
        base_rate, base_admittance = -np.abs(rate), np.where(admittance.real == 0, -np.abs(admittance), admittance.real)
        columns = columns.real
    operator = layer.partner * base_rate + base_admittance[:, None] * layer.field
    green = columns.T @ (layer.field @ np.linalg.solve(operator, columns))
    if lossless:
        correction = np.zeros((len(green), len(green)), complex)
        correction[:c, :c] = np.linalg.solve(norm.T, np.diag(rate[carry] - base_rate[carry]).T).T
        correction[c:, c:] = np.diag(admittance[ports] - base_admittance[ports])
        green = np.linalg.solve(np.eye(len(green)) + green @ correction, green)
    root = np.sqrt(admittance[ports])
    inward = np.linalg.solve(norm, green[:c])
    return Interface(
        reflect=2 * inward[:, :c] * rate[carry] - np.eye(c),
        enter=2 * inward[:, c:] * root,
        leave=2 * root[:, None] * green[c:, :c] * rate[carry],
        back=2 * root[:, None] * green[c:, c:] * root - np.eye(len(ports)),
    )


def scattering(layer: LayerModes, height: float, below: HalfSpace, above: HalfSpace) -> np.ndarray:
    """Scattering matrix over the ports of both sides, below first, power-normalised: unitary where lossless."""
    travel = np.exp(1j * layer.q * height)
    carry = np.flatnonzero(np.abs(travel) > CARRY)
    foot, top = interface(layer, carry, below), interface(layer, carry, above)
    x, c = travel[carry], len(carry)
    round_trip = np.eye(2 * c, dtype=complex)
    round_trip[:c, c:] = -foot.reflect * x
    round_trip[c:, :c] = -top.reflect * x
    n_below, n_above = len(below.ports), len(above.ports)
    source = np.zeros((2 * c, n_below + n_above), complex)
    source[:c, :n_below], source[c:, n_below:] = foot.enter, top.enter
    up_down = np.linalg.solve(round_trip, source)
    out = np.zeros((n_below + n_above,) * 2, complex)
    out[:n_below, :n_below], out[n_below:, n_below:] = foot.back, top.back
    out[:n_below] += (foot.leave * x) @ up_down[c:]
    out[n_below:] += (top.leave * x) @ up_down[:c]
    return out


def zero_order(basis: Basis, half: HalfSpace, wavenumber: float, *, te: bool) -> int:
    """Position among the ports of the order with the given transverse wavenumber."""
    a = len(basis.te)
    family = basis.te if te else basis.tm
    mode = int(np.argmin(np.abs(family - wavenumber**2))) + (0 if te else a)
    return int(np.flatnonzero(half.ports == mode)[0])


def medium_of(k0: float, disc: complex, around: complex) -> Medium:
    return Medium(k0, complex(disc), complex(around))
