"""Two interfaces: from the modes of a layer between half-spaces to the scattering
matrix of its orders.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.modal.case import Films
from metalens.modal.dense import cholesky_factor, solve_lower
from metalens.modal.few_modes import FewModes
from metalens.modal.homogeneous import HomogeneousBasis
from metalens.modal.layer import LayerModes, axial_wavenumber
from metalens.modal.pencil import LayerPencil

# relative distance of k² from its cutoff within which an order takes its exact
# wavenumber
NEAR = 0.4
AT = 0.1  # and within which it counts as at its cutoff
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
        cosine, sine = (1 + once**2) / 2, (once**2 - 1) / (2j * kz * factor)
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


def cutoff_proximity(cutoff: float, bloch: float) -> float:
    """1 where an order but zero lies within ``AT`` of its cutoff; beyond, as one over the
    distance, to 0 at ``NEAR``.

    Args:
        cutoff: k0^2 times the permittivity. bloch: kx.
    """
    exact = lattice_wavenumbers(cutoff, bloch)
    apart = float(np.abs(exact[exact > bloch**2 * (1 + 1e-9)] / cutoff - 1).min())
    return min(1.0, max(0.0, (NEAR / max(apart, AT) - 1) / (NEAR / AT - 1)))


def lattice_wavenumbers(cutoff: float, bloch: float) -> np.ndarray:
    """(bloch + pi m)² + (pi n)², at least up to twice the cutoff."""
    reach = math.ceil((math.sqrt(2 * cutoff) + abs(bloch)) / math.pi) + 1
    along, across = (
        bloch + np.pi * np.arange(-reach, reach + 1),
        np.pi * np.arange(reach + 1),
    )
    wavenumbers: np.ndarray = (along[:, None] ** 2 + across**2).ravel()
    return wavenumbers


@dataclass(frozen=True, eq=False, slots=True)
class LayerInterface:
    """One end of the layer, seen by its carrying modes and by the propagating orders
    (power-normalised).

    reflect: (carry, carry) of layer modes; enter: (carry, ports); leave: (ports,
    carry); back: (ports, ports).
    inward: (n, carry + ports) amplitudes of all layer modes going in, per carrying mode
    that arrives (its own
    incoming amplitude left out) and per order that arrives.
    """

    reflect: np.ndarray
    enter: np.ndarray
    leave: np.ndarray
    back: np.ndarray
    inward: np.ndarray


def layer_interface(
    layer: LayerModes, carry: np.ndarray, half: HalfSpace
) -> LayerInterface:
    """Blocks of the scattering at a half-space, from all modes of the layer.

    Args:
        layer: modes. carry: places of those that travel. half: the half-space.
    """
    ports = half.ports
    rate, c = 1j * layer.q, len(carry)
    columns = np.concatenate(
        [layer.partner[:, carry], np.eye(len(half.admittance))[:, ports]], 1
    )
    real = np.isrealobj(layer.field) and half.lossless
    near_rate = -np.abs(rate) if real else rate
    near = half.real_admittance() if real else half.admittance
    inward = np.linalg.solve(
        layer.partner * near_rate + near[:, None] * layer.field, columns
    )
    return correct_stand_ins(
        columns.T @ (layer.field @ inward),
        inward,
        columns[:, :c].T @ layer.field[:, carry],
        InterfaceRates(rate[carry], near_rate[carry], near[ports], half),
    )


def few_interface(
    pencil: LayerPencil, modes: FewModes, half: HalfSpace
) -> LayerInterface:
    """Blocks of the scattering at a half-space, from the modes that carry and the real
    admittance of all others.

    Args:
        pencil: of the layer. modes: those that carry. half: the half-space.
    """
    half = half.dual if pencil.dual else half
    near, ports = half.real_admittance(dual=pencil.dual), half.ports
    a, c = len(pencil.te), len(modes.q)
    operator = modes.near.copy()
    pencil.te_turn.onto(operator[:a, :a], near[:a])
    pencil.tm_turn.onto(operator[a:, a:], near[a:])
    fed = np.zeros((len(operator), len(ports)))
    te = ports < a
    fed[:a, te], fed[a:, ~te] = (
        pencil.te_turn.rows(ports[te]).T,
        pencil.tm_turn.rows(ports[~te] - a).T,
    )
    partner = modes.partner
    parts = [partner.real, partner.imag] if np.iscomplexobj(partner) else [partner]
    columns = np.concatenate([*parts, fed], 1)
    found = solve_symmetric(operator, a, columns, first=not pencil.dual)
    green = columns.T @ found
    if len(parts) == 2:
        whole = np.zeros((2 * c + len(ports), c + len(ports)), complex)
        whole[:c, :c], whole[c : 2 * c, :c], whole[2 * c :, c:] = (
            np.eye(c),
            1j * np.eye(c),
            np.eye(len(ports)),
        )
        green, found = whole.T @ green @ whole, found @ whole
    return correct_stand_ins(
        green,
        found,
        partner.T @ modes.field,
        InterfaceRates(1j * modes.q, np.full(c, modes.near_rate), near[ports], half),
    )


def solve_symmetric(
    operator: np.ndarray, a: int, columns: np.ndarray, *, first: bool
) -> np.ndarray:
    """operator⁻¹ columns, symmetric: the definite block goes first, in three quarters
    of the time of a plain solve.

    The first ``a`` unknowns are negative definite (``first``), or the others positive
    definite; if not, the plain way.
    """
    if not first:
        swapped, fed = np.roll(-operator, (-a, -a), (0, 1)), np.roll(-columns, -a, 0)
        return np.roll(
            solve_symmetric(swapped, len(operator) - a, fed, first=True), a, 0
        )
    try:
        lower = cholesky_factor(-operator[:a, :a])
    except np.linalg.LinAlgError:
        return np.linalg.solve(operator, columns)
    across, fed = (
        solve_lower(lower, operator[:a, a:]),
        solve_lower(lower, columns[:a]),
    )
    rest = np.linalg.solve(
        operator[a:, a:] + across.T @ across, columns[a:] + across.T @ fed
    )
    return np.concatenate(
        [solve_lower(lower, across @ rest - fed, transposed=True), rest]
    )


@dataclass(frozen=True, eq=False, slots=True)
class InterfaceRates:
    """i q of the carrying modes, true and as the operator holds them; admittances of
    the ports as it holds them; the half-space.
    """

    mode: np.ndarray
    near_mode: np.ndarray
    near_port: np.ndarray
    half: HalfSpace


def correct_stand_ins(
    green: np.ndarray, inward: np.ndarray, norm: np.ndarray, rates: InterfaceRates
) -> LayerInterface:
    """Blocks from (Y_layer + Y_half)^-1 with its real stand-ins corrected (Woodbury).

    Args:
        green: of partners and ports with the solution; inward: the solution.
        norm: partners with fields. rates: true values and stand-ins.
    """
    c, m = len(rates.mode), len(green)
    port = rates.half.admittance[rates.half.ports]
    if (rates.mode != rates.near_mode).any() or (port != rates.near_port).any():
        correction = np.zeros((m, m), complex)
        correction[:c, :c] = np.linalg.solve(
            norm.T, np.diag(rates.mode - rates.near_mode)
        ).T
        correction[c:, c:] = np.diag(port - rates.near_port)
        mend = np.linalg.inv(np.eye(m) + correction @ green)
        green, inward = green @ mend, inward @ mend
    through = rates.half.transfer
    weight = 2 * np.concatenate([rates.mode, through])
    arrive = np.linalg.solve(norm, green[:c]) * weight
    return LayerInterface(
        reflect=arrive[:, :c] - np.eye(c),
        enter=arrive[:, c:],
        leave=through[:, None] * green[c:, :c] * weight[:c],
        back=through[:, None] * green[c:, c:] * weight[c:]
        + np.diag(rates.half.reflection),
        inward=inward * weight,
    )


@dataclass(frozen=True, eq=False, slots=True)
class ScatteringMatch:
    """Scattering matrix over the ports of both sides, below first, and what it was made
    from.

    carry: the modes that travel; round_trip: (2 carry, 2 carry) system of their
    amplitudes, waves up at the foot
    first, then waves down at the top; amplitude: (2 carry, ports) its solution for unit
    power into each port.
    travel: (carry,) their factors exp(i q h).
    """

    matrix: np.ndarray
    carry: np.ndarray
    travel: np.ndarray
    foot: LayerInterface
    top: LayerInterface
    round_trip: np.ndarray
    amplitude: np.ndarray

    @property
    def damping(self) -> float:
        """Least singular value of the round trip: what the waves least damped lose, or
        come back out of step by.
        """
        return float(np.linalg.svd(self.round_trip, compute_uv=False).min(initial=1.0))

    def rate(self, moved: np.ndarray) -> np.ndarray:
        """Derivatives (..., ports, ports) of the scattering matrix, given those (...,
        carry) of the factors exp(i q h)
        of the carrying modes."""
        c, x = len(self.carry), self.travel[:, None]
        down, up = (
            moved[..., None] * self.amplitude[c:],
            moved[..., None] * self.amplitude[:c],
        )
        push = np.concatenate([self.foot.reflect @ down, self.top.reflect @ up], -2)
        echo = np.linalg.solve(self.round_trip, push)
        down, up = down + x * echo[..., c:, :], up + x * echo[..., :c, :]
        out: np.ndarray = np.concatenate(
            [self.foot.leave @ down, self.top.leave @ up], -2
        )
        return out


def exchange_waves(foot: np.ndarray, top: np.ndarray, x: np.ndarray) -> np.ndarray:
    """[[0, foot x], [top x, 0]]: waves that crossed the layer meet the other end."""
    c = len(x)
    out = np.zeros((len(foot) + len(top), 2 * c), complex)
    out[: len(foot), c:], out[len(foot) :, :c] = foot * x, top * x
    return out


def scattering_matrix(
    layer: LayerModes, height: float, below: HalfSpace, above: HalfSpace
) -> ScatteringMatch:
    """Scattering matrix of a layer between half-spaces, from all its modes: symmetric, and
    unitary where lossless.

    Args:
        layer: modes. height: of the layer. below, above: half-spaces.
    """
    travel = np.exp(1j * layer.q * height)
    carry = np.flatnonzero(np.abs(travel) > CARRY)
    return join_interfaces(
        layer_interface(layer, carry, below),
        layer_interface(layer, carry, above),
        carry,
        travel[carry],
    )


def few_scattering(
    pencil: LayerPencil,
    modes: FewModes,
    height: float,
    below: HalfSpace,
    above: HalfSpace,
) -> ScatteringMatch:
    """As :func:`scattering_matrix`, from few modes; ``carry`` counts them, and ``inward``
    is in the pencil's coordinates.

    Args:
        pencil, modes: of the layer. height: of the layer. below, above: half-spaces.
    """
    foot, top = few_interface(pencil, modes, below), few_interface(pencil, modes, above)
    return join_interfaces(
        foot, top, np.arange(len(modes.q)), np.exp(1j * modes.q * height)
    )


def join_interfaces(
    foot: LayerInterface, top: LayerInterface, carry: np.ndarray, x: np.ndarray
) -> ScatteringMatch:
    """Scattering matrix of a layer from both its interfaces, by the round trips of the
    carrying modes.

    Args:
        foot, top: interfaces. carry: places of the modes. x: (c,) factors exp(iqh).
    """
    c, n = len(carry), len(foot.back)
    round_trip = np.eye(2 * c) - exchange_waves(foot.reflect, top.reflect, x)
    source = np.zeros((2 * c, n + len(top.back)), complex)
    source[:c, :n], source[c:, n:] = foot.enter, top.enter
    amplitude = np.linalg.solve(round_trip, source)
    matrix = exchange_waves(foot.leave, top.leave, x) @ amplitude
    matrix[:n, :n] += foot.back
    matrix[n:, n:] += top.back
    return ScatteringMatch(matrix, carry, x, foot, top, round_trip, amplitude)


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
