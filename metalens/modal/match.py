"""Two interfaces: from the modes of a layer between half-spaces to the scattering
matrix of its orders.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.modal.case import Films
from metalens.modal.few_modes import FewModes, LayerPencil
from metalens.modal.homogeneous import HomogeneousBasis
from metalens.modal.layer import LayerModes, axial_wavenumber

# relative distance of k² from its cutoff within which an order takes its exact
# wavenumber
NEAR = 0.4
KNOWN = 0.02  # relative error of k² up to which a mode of the mesh is that order
# modes that decay below this over the height cannot change a result of double precision
CARRY = 1e-13


@dataclass(frozen=True, eq=False, slots=True)
class HalfSpace:
    """A homogeneous half-space seen through its films, in the homogeneous modes.

    Waves that go away have p = Y u. Of the orders that propagate (``ports``), incoming
    power-normalised amplitudes a add -2 T a to p, and leaving ones are b = T u + R a.

    admittance: (n,) Y. ports: (m,) places. transfer, reflection: (m,) T and R, of a bare
    half-space sqrt(Y) and -1. lossless: whether no film absorbs.
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
        near = self.admittance.real.copy()
        size = np.abs(self.admittance[self.ports])
        near[self.ports] = size if dual else -size
        return near


def half_space(
    basis: HomogeneousBasis,
    k0: float,
    permittivity: float,
    films: Films = (),
    *,
    magnetic: bool,
    bloch: float | None = None,
) -> HalfSpace:
    """Admittances p / u: electric form i kz (TE), i k0^2 eps / kz (TM); magnetic form
    i kz / eps, i k0^2 / kz.

    Args:
        basis: homogeneous modes. k0: vacuum wavenumber. permittivity: of the half-space.
        films: those on it, nearest first.
        magnetic: the form.
        bloch: if given, orders near their cut-off get the wavenumbers of the lattice
            with this kx, see :func:`near_cutoff`.

    A wavenumber exactly at cut-off is moved off it by 1e-8 k0, so that the admittance
    stays finite.
    """
    square = np.concatenate([basis.te_exact, basis.tm_exact])
    if bloch is not None:
        square = near_cutoff(square, k0**2 * permittivity, bloch)
    is_te = np.arange(len(square)) < len(basis.te)

    def wave(eps: complex) -> tuple[np.ndarray, np.ndarray]:
        """kz, and c of p = c du/dz."""
        kz = axial_wavenumber(k0**2 * eps - square)
        kz = np.where(np.abs(kz) < 1e-8 * k0, 1e-8 * k0, kz)
        te, tm = (1 / eps, 1.0) if magnetic else (1.0, eps)
        return kz, np.where(is_te, te, k0**2 * tm / kz**2)

    kz, factor = wave(permittivity)
    ports = np.flatnonzero(kz.real > 0)
    y = 1j * kz * factor
    transfer, reflection = np.sqrt(y), -np.ones(len(y), complex)
    for eps, thickness in films:
        kz, factor = wave(eps)
        once = np.exp(1j * kz * thickness)
        cosine = (1 + once**2) / 2
        sine = (once**2 - 1) / (2j * kz * factor)
        through = cosine - y * sine  # all times exp(i kz d), so that nothing grows
        reflection = reflection - 2 * transfer**2 * sine / through
        transfer = once * transfer / through
        y = (y * cosine + (kz * factor) ** 2 * sine) / through
    return HalfSpace(
        y,
        ports,
        transfer[ports],
        reflection[ports],
        all(complex(eps).imag == 0 for eps, _ in films),
    )


def near_cutoff(square: np.ndarray, cutoff: float, bloch: float) -> np.ndarray:
    """Transverse wavenumbers squared (n,), those within ``NEAR`` of the cutoff as the
    lattice has them: (bloch + pi m)^2 + (pi n)^2, each the nearest.

    Near its cutoff an order's admittance is the root of a small difference, in which the
    error of the mesh weighs as one over the axial wavenumber.

    Args:
        square: of the mesh. cutoff: k0^2 times the permittivity. bloch: kx.
    """
    close = np.flatnonzero(
        (np.abs(square - cutoff) < NEAR * cutoff) & (square > bloch**2 * (1 + 1e-9))
    )
    if not len(close):
        return square
    exact = lattice_wavenumbers(cutoff, bloch)
    nearest = exact[np.abs(square[close, None] - exact).argmin(axis=1)]
    known = np.abs(nearest - square[close]) < KNOWN * nearest
    out = square.copy()
    out[close[known]] = nearest[known]
    return out


def lattice_wavenumbers(cutoff: float, bloch: float) -> np.ndarray:
    """(bloch + pi m)² + (pi n)², at least up to twice the cutoff."""
    reach = math.ceil((math.sqrt(2 * cutoff) + abs(bloch)) / math.pi) + 1
    along = bloch + np.pi * np.arange(-reach, reach + 1)
    across = np.pi * np.arange(reach + 1)
    wavenumbers: np.ndarray = (along[:, None] ** 2 + across**2).ravel()
    return wavenumbers


@dataclass(frozen=True, eq=False, slots=True)
class LayerInterface:
    """Scattering at one end of the layer, between the modes that carry light over it and
    the propagating orders (power-normalised).

    reflect: (carry, carry) of layer modes. enter: (carry, ports). leave: (ports,
        carry). back: (ports, ports).
    """

    reflect: np.ndarray
    enter: np.ndarray
    leave: np.ndarray
    back: np.ndarray


def interface_blocks(
    green: np.ndarray, norm: np.ndarray, rate: np.ndarray, half: HalfSpace
) -> LayerInterface:
    """Blocks of an interface from G = columns^T (Y_layer + Y_half)^-1 columns, with the
    partners of the carrying modes and the ports as columns.

    Args:
        green: (carry + ports, carry + ports) G. norm: (carry, carry) partners with fields.
        rate: (carry,) i q. half: the half-space.
    """
    c, through = len(rate), half.transfer
    weight = 2 * np.concatenate([rate, through])
    arrive = np.linalg.solve(norm, green[:c]) * weight
    leaving = through[:, None] * green[c:] * weight
    return LayerInterface(
        reflect=arrive[:, :c] - np.eye(c),
        enter=arrive[:, c:],
        leave=leaving[:, :c],
        back=leaving[:, c:] + np.diag(half.reflection),
    )


def layer_interface(
    layer: LayerModes, carry: np.ndarray, half: HalfSpace
) -> LayerInterface:
    """Scattering at a half-space, from all modes of the layer.

    Args:
        layer: modes. carry: places of those that travel. half: the half-space.
    """
    rate = 1j * layer.q
    columns = np.concatenate(
        [layer.partner[:, carry], np.eye(len(half.admittance))[:, half.ports]], 1
    )
    inward = np.linalg.solve(
        layer.partner * rate + half.admittance[:, None] * layer.field, columns
    )
    green = columns.T @ (layer.field @ inward)
    norm = columns[:, : len(carry)].T @ layer.field[:, carry]
    return interface_blocks(green, norm, rate[carry], half)


def few_interface(
    pencil: LayerPencil, modes: FewModes, half: HalfSpace
) -> LayerInterface:
    """Scattering at a half-space, from the modes that carry and the real admittance of
    all others; what is real in place of the travelling waves is corrected after
    (Woodbury).

    Args:
        pencil: of the layer. modes: those that carry. half: the half-space.
    """
    half = half.dual if pencil.dual else half
    near, ports = half.real_admittance(dual=pencil.dual), half.ports
    a, c = len(pencil.te), len(modes.q)
    operator = modes.near.copy()
    pencil.te_turn.add_congruence(operator[:a, :a], near[:a])
    pencil.tm_turn.add_congruence(operator[a:, a:], near[a:])
    fed = np.zeros((len(operator), len(ports)))
    te = ports < a
    fed[:a, te] = pencil.te_turn.take_rows(ports[te]).T
    fed[a:, ~te] = pencil.tm_turn.take_rows(ports[~te] - a).T
    columns = np.concatenate([modes.partner, fed], 1)
    green = columns.T @ solve_real(operator, columns)
    norm = modes.partner.T @ modes.field
    rate = 1j * modes.q
    correction = np.zeros((c + len(ports), c + len(ports)), complex)
    correction[:c, :c] = np.linalg.solve(norm.T, np.diag(rate - modes.near_rate)).T
    correction[c:, c:] = np.diag(half.admittance[ports] - near[ports])
    green = green @ np.linalg.inv(np.eye(c + len(ports)) + correction @ green)
    return interface_blocks(green, norm, rate, half)


def solve_real(operator: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """operator^-1 columns of a real operator, for columns that may be complex."""
    if not np.iscomplexobj(columns):
        return np.linalg.solve(operator, columns)
    both = np.linalg.solve(operator, np.concatenate([columns.real, columns.imag], 1))
    half = columns.shape[1]
    return np.asarray(both[:, :half] + 1j * both[:, half:])


def scattering_matrix(
    layer: LayerModes, height: float, below: HalfSpace, above: HalfSpace
) -> np.ndarray:
    """Scattering matrix of a layer between half-spaces, from all its modes, over the ports
    of both sides, below first: symmetric, and unitary where lossless.

    Args:
        layer: modes. height: of the layer. below, above: half-spaces.
    """
    travel = np.exp(1j * layer.q * height)
    carry = np.flatnonzero(np.abs(travel) > CARRY)
    return join_interfaces(
        layer_interface(layer, carry, below),
        layer_interface(layer, carry, above),
        travel[carry],
    )


def few_scattering(
    pencil: LayerPencil,
    modes: FewModes,
    height: float,
    below: HalfSpace,
    above: HalfSpace,
) -> np.ndarray:
    """As :func:`scattering_matrix`, from the few modes that carry.

    Args:
        pencil, modes: of the layer. height: of the layer. below, above: half-spaces.
    """
    foot, top = (few_interface(pencil, modes, half) for half in (below, above))
    return join_interfaces(foot, top, np.exp(1j * modes.q * height))


def join_interfaces(
    foot: LayerInterface, top: LayerInterface, x: np.ndarray
) -> np.ndarray:
    """Scattering matrix of a layer from both its interfaces, by the round trips of the
    carrying modes.

    Args:
        foot, top: interfaces. x: (c,) factors exp(iqh) of the modes.
    """
    c, n = len(x), len(foot.back)

    def cross(up: np.ndarray, down: np.ndarray) -> np.ndarray:
        """[[0, up x], [down x, 0]]: waves that crossed the layer meet the other end."""
        out = np.zeros((len(up) + len(down), 2 * c), complex)
        out[: len(up), c:], out[len(up) :, :c] = up * x, down * x
        return out

    source = np.zeros((2 * c, n + len(top.back)), complex)
    source[:c, :n], source[c:, n:] = foot.enter, top.enter
    round_trip = np.eye(2 * c) - cross(foot.reflect, top.reflect)
    matrix = cross(foot.leave, top.leave) @ np.linalg.solve(round_trip, source)
    matrix[:n, :n] += foot.back
    matrix[n:, n:] += top.back
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
