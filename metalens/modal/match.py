"""Two interfaces: from the modes of a layer between half-spaces to the scattering
matrix of its orders.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.modal.case import Films
from metalens.modal.layer import LayerModes, axial_wavenumber
from metalens.modal.spaces import HomogeneousBasis


@dataclass(frozen=True, eq=False, slots=True)
class HalfSpace:
    """A homogeneous half-space behind its films, in the homogeneous modes.

    Waves that go away have p = Y u. Of the orders that propagate (``ports``), incoming
    power-normalised amplitudes a add -2 T a to p, and leaving ones are b = T u + R a.

    admittance: (n,) Y. ports: (m,) places. transfer, reflection: (m,) T and R, of a
    bare half-space sqrt(Y) and -1. lossless: whether no film absorbs.
    """

    admittance: np.ndarray
    ports: np.ndarray
    transfer: np.ndarray
    reflection: np.ndarray
    lossless: bool

    @property
    def dual(self) -> "HalfSpace":
        """The same for the unknown p in place of u."""
        y, t = self.admittance[self.ports], self.transfer
        turned = -(self.reflection + 2 * t**2 / y)
        return HalfSpace(1 / self.admittance, self.ports, t / y, turned, self.lossless)

    def real_admittance(self, *, dual: bool = False) -> np.ndarray:
        """Real stand-in for the admittances of a half-space without loss.

        The admittances that decay, and of the ports their size with the sign that the
        stand-in of a travelling layer mode has, so that the two cannot cancel: plus in
        the dual unknown, else minus.
        """
        stand_in = self.admittance.real.copy()
        size = np.abs(self.admittance[self.ports])
        stand_in[self.ports] = size if dual else -size
        return stand_in


def half_space(
    basis: HomogeneousBasis,
    k0: float,
    permittivity: float,
    films: Films,
    *,
    magnetic: bool,
    bloch: float,
) -> HalfSpace:
    """Admittances p / u: electric form i kz (TE), i k0^2 eps / kz (TM); magnetic form
    i kz / eps, i k0^2 / kz.

    Args:
        basis: homogeneous modes. k0: vacuum wavenumber. permittivity: of the
            half-space.
        films: those on it, nearest first.
        magnetic: the form.
        bloch: kx; orders near their cut-off get the wavenumbers of the lattice, see :func:`near_cutoff`.

    A wavenumber exactly at cut-off is moved off it by 1e-8 k0, so that the admittance
    stays finite.
    """
    squares = np.concatenate([basis.te_exact, basis.tm_exact])
    squares = near_cutoff(squares, k0**2 * permittivity, bloch)
    is_te = np.arange(len(squares)) < len(basis.te)

    def wave(eps: complex) -> tuple[np.ndarray, np.ndarray]:
        """kz, and c of p = c du/dz."""
        kz = axial_wavenumber(k0**2 * eps - squares)
        kz = np.where(np.abs(kz) < 1e-8 * k0, 1e-8 * k0, kz)
        te, tm = (1 / eps, 1.0) if magnetic else (1.0, eps)
        return kz, np.where(is_te, te, k0**2 * tm / kz**2)

    kz, factor = wave(permittivity)
    ports = np.flatnonzero(kz.real > 0)
    y = 1j * kz * factor
    transfer, reflection = np.sqrt(y), -np.ones(len(y), complex)
    for eps, thickness in films:
        kz, factor = wave(eps)
        phase_factor = np.exp(1j * kz * thickness)
        cosine = (1 + phase_factor**2) / 2
        sine = (phase_factor**2 - 1) / (2j * kz * factor)
        denominator = cosine - y * sine  # all times exp(i kz d), so that nothing grows
        reflection = reflection - 2 * transfer**2 * sine / denominator
        transfer = phase_factor * transfer / denominator
        y = (y * cosine + (kz * factor) ** 2 * sine) / denominator
    return HalfSpace(
        y,
        ports,
        transfer[ports],
        reflection[ports],
        all(complex(eps).imag == 0 for eps, _ in films),
    )


def near_cutoff(
    square: np.ndarray,
    cutoff: float,
    bloch: float,
    *,
    near: float = 0.4,
    known: float = 0.02,
) -> np.ndarray:
    """Transverse wavenumbers squared (n,), those near the cutoff as the
    lattice has them: (bloch + pi m)^2 + (pi n)^2, each the nearest.

    Near its cutoff an order's admittance is the root of a small difference, in which
    the error of the mesh weighs as one over the axial wavenumber.

    Args:
        square: of the mesh. cutoff: k0^2 times the permittivity. bloch: kx.
        near: relative distance from the cutoff within which an order is replaced.
        known: relative error up to which a mode of the mesh counts as an order.
    """
    close = np.flatnonzero(
        (np.abs(square - cutoff) < near * cutoff) & (square > bloch**2 * (1 + 1e-9))
    )
    if not len(close):
        return square
    # the orders of the lattice at least up to twice the cutoff
    reach = math.ceil((math.sqrt(2 * cutoff) + bloch) / math.pi) + 1
    along = bloch + np.pi * np.arange(-reach, reach + 1)
    exact = (along[:, None] ** 2 + (np.pi * np.arange(reach + 1)) ** 2).ravel()
    nearest = exact[np.abs(square[close, None] - exact).argmin(axis=1)]
    reliable = np.abs(nearest - square[close]) < known * nearest
    corrected = square.copy()
    corrected[close[reliable]] = nearest[reliable]
    return corrected


@dataclass(frozen=True, eq=False, slots=True)
class LayerInterface:
    """Scattering at one end of the layer, between the modes that carry light over it
    and the propagating orders (power-normalised).

    reflect: (carry, carry) of layer modes. enter: (carry, ports). leave: (ports,
        carry). back: (ports, ports).
    """

    reflect: np.ndarray
    enter: np.ndarray
    leave: np.ndarray
    back: np.ndarray


def layer_interface(layer: LayerModes, half: HalfSpace) -> LayerInterface:
    """Scattering at a half-space, from G = columns^T (Y_layer + Y_half)^-1 columns, with
    the partners of the carrying modes and the ports as columns.

    Of a lossless layer a real operator is solved first, with real stand-ins for the
    travelling waves. The Woodbury identity then replaces them by the complex values.

    Args:
        layer: its modes. half: the half-space.
    """
    half = half.dual if layer.dual else half
    ports, rate, norm = half.ports, 1j * layer.q, layer.partner.T @ layer.field
    admittance = (
        half.real_admittance(dual=layer.dual)
        if np.isrealobj(layer.near)
        else half.admittance
    )
    columns = np.concatenate([layer.partner, layer.turn[ports].T], 1)
    operator = layer.near + layer.congruence(admittance)
    green = columns.T @ solve_real(operator, columns)
    count = len(rate)
    correction = np.zeros(green.shape, complex)
    correction[:count, :count] = np.linalg.solve(
        norm.T, np.diag(rate - layer.near_rate)
    ).T
    correction[count:, count:] = np.diag((half.admittance - admittance)[ports])
    green = green @ np.linalg.inv(np.eye(len(green)) + correction @ green)
    weight = 2 * np.concatenate([rate, half.transfer])
    arriving = np.linalg.solve(norm, green[:count]) * weight
    leaving = half.transfer[:, None] * green[count:] * weight
    return LayerInterface(
        reflect=arriving[:, :count] - np.eye(count),
        enter=arriving[:, count:],
        leave=leaving[:, :count],
        back=leaving[:, count:] + np.diag(half.reflection),
    )


def solve_real(operator: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """operator^-1 columns, in real arithmetic where the operator is real."""
    if np.iscomplexobj(operator) or np.isrealobj(columns):
        return np.linalg.solve(operator, columns)
    parts = np.linalg.solve(operator, np.concatenate([columns.real, columns.imag], 1))
    count = columns.shape[1]
    return np.asarray(parts[:, :count] + 1j * parts[:, count:])


def scattering_matrix(
    layer: LayerModes, height: float, below: HalfSpace, above: HalfSpace
) -> np.ndarray:
    """Scattering matrix of a layer between half-spaces, over the ports of both sides,
    below first: symmetric, and unitary where lossless.

    Args:
        layer: its modes. height: of the layer. below, above: half-spaces.
    """
    foot, top = (layer_interface(layer, half) for half in (below, above))
    return join_interfaces(foot, top, np.exp(1j * layer.q * height))


def join_interfaces(
    foot: LayerInterface, top: LayerInterface, x: np.ndarray
) -> np.ndarray:
    """Scattering matrix of a layer from both its interfaces, by the round trips of the
    carrying modes.

    Args:
        foot, top: interfaces. x: (c,) factors exp(iqh) of the modes.
    """
    carry_count, foot_ports = len(x), len(foot.back)

    def cross(up: np.ndarray, down: np.ndarray) -> np.ndarray:
        """[[0, up x], [down x, 0]]: waves that crossed the layer meet the other end."""
        out = np.zeros((len(up) + len(down), 2 * carry_count), complex)
        out[: len(up), carry_count:], out[len(up) :, :carry_count] = up * x, down * x
        return out

    source = np.zeros((2 * carry_count, foot_ports + len(top.back)), complex)
    source[:carry_count, :foot_ports], source[carry_count:, foot_ports:] = (
        foot.enter,
        top.enter,
    )
    round_trip = np.eye(2 * carry_count) - cross(foot.reflect, top.reflect)
    matrix = cross(foot.leave, top.leave) @ np.linalg.solve(round_trip, source)
    matrix[:foot_ports, :foot_ports] += foot.back
    matrix[foot_ports:, foot_ports:] += top.back
    return matrix


def zero_order(
    basis: HomogeneousBasis, half: HalfSpace, wavenumber: float, *, te: bool
) -> int:
    """Position among the ports of a half-space of the order with a given transverse
    wavenumber.

    Args:
        basis: homogeneous modes. half: the half-space.
        wavenumber: of the order. te: its family.
    """
    a = len(basis.te)
    family = basis.te_exact if te else basis.tm_exact
    mode = int(np.argmin(np.abs(family - wavenumber**2))) + (0 if te else a)
    return int(np.flatnonzero(half.ports == mode)[0])
