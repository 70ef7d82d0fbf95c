"""Exact derivatives of t in diameter, height, index, absorption, wavelength and angle,
on the mesh of the value.

They are the derivatives of the discrete t on the rung of the ladder that ``solve``
takes (which stops at a thousandth
of its error estimate): shape derivatives move the mesh with the disc. Degenerate modes
and resonances need no special
case.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Light, Polarization, check_tolerance, index, slope
from metalens.ground.threads import one_blas_thread
from metalens.modal.case import Case, case_of
from metalens.modal.engine import basis, climb, geometric_mean, geometry
from metalens.modal.homogeneous import Basis
from metalens.modal.layer import Medium, electric_modes, magnetic_modes
from metalens.modal.match import half_space, scattering, zero_order
from metalens.modal.mesh import MeshPlan
from metalens.modal.spaces import Space, space, space_rates
from metalens.modal.variation import (
    Change,
    HalfRate,
    electric_rates,
    half_space_by_permittivity,
    half_space_rate,
    magnetic_rates,
    matrix_rate,
    waves,
)


@dataclass(frozen=True, slots=True)
class Gradient:
    """t and its derivatives (each complex, per unit of the name).

    n, k: of the pillar's index, at fixed wavelength. wavelength_um: at fixed angle,
    with the dispersion of all
    materials.
    """

    t: complex
    diameter_um: complex
    height_um: complex
    n: complex
    k: complex
    wavelength_um: complex
    angle_rad: complex


def changes(case: Case, plan: MeshPlan, b: Basis, electric: bool) -> dict[str, Change]:
    """Rates of all matrices in each parameter, in the coordinates of the homogeneous
    modes.
    """
    n, m = b.size, len(b.tm)
    zero, small, mixed = np.zeros((n, n)), np.zeros((m, m)), np.zeros((n, m))
    still = zero, zero, small, zero, zero, small, mixed
    out = {
        "k0": Change(1.0, 0.0, 0.0, 0.0, *still),
        "disc": Change(0.0, 1.0, 0.0, 0.0, *still),
        "around": Change(0.0, 0.0, 1.0, 0.0, *still),
    }
    shape = geometry(case.rho, plan)
    phase = case.bloch or None
    now = space(shape, electric=electric, half_phase_rad=phase)
    by_radius, by_phase = space_rates(shape, electric=electric, half_phase_rad=phase)

    u, f = b.vector, b.scalar

    def change(s: Space, bloch: float) -> Change:
        return Change(
            0.0,
            0.0,
            0.0,
            bloch,
            u.T @ s.cell.mass @ u,
            u.T @ s.cell.curl @ u,
            f.T @ s.cell.scalar @ f,
            u.T @ s.disc.mass @ u,
            u.T @ s.disc.curl @ u,
            f.T @ s.disc.scalar @ f,
            u.T @ now.cell.mass @ s.gradient @ f,
        )

    out["rho"] = change(by_radius, 0.0)
    if phase is not None:
        out["bloch"] = change(by_phase, 1.0)
    return out


def form_rates(
    case: Case, plan: MeshPlan, *, magnetic: bool
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Zero-order matrix of one form and its derivatives in height, both half-spaces,
    and the names of ``changes``.
    """
    electric_walls = case.p == magnetic if case.bloch else False
    te = case.p == magnetic if case.bloch else True
    b = basis(case.rho, plan, electric_walls, case.bloch)
    medium = Medium(case.k0, case.disc, case.around)
    disc, around = medium.permittivities()
    layer = (magnetic_modes if magnetic else electric_modes)(b, medium)
    below, above = (
        half_space(b, case.k0, e, magnetic=magnetic) for e in (case.below, case.above)
    )
    match = scattering(layer, case.height, below, above)
    foot, top = (
        zero_order(b, below, case.bloch, te=te),
        zero_order(b, above, case.bloch, te=te),
    )
    pick = np.ix_((foot, len(below.ports) + top), (foot, len(below.ports) + top))
    sign = np.array([[-1.0, 1.0], [1.0, -1.0]]) if magnetic else np.ones((2, 2))
    rates = {
        "height": match.rate(1j * layer.q[match.carry] * match.travel)[pick] * sign
    }
    w = waves(match, layer, case.height, foot, top)
    zero = int(below.ports[foot])
    for name, change in changes(case, plan, b, electric_walls).items():
        halves = (
            half_space_rate(
                b, below, zero, case.k0, case.below, change, magnetic=magnetic
            ),
            half_space_rate(
                b, above, zero, case.k0, case.above, change, magnetic=magnetic
            ),
        )
        inside = (magnetic_rates if magnetic else electric_rates)(
            b, case.k0, disc, around, change
        )
        rates[name] = matrix_rate(layer, w, case.height, inside, halves) * sign
    none = HalfRate(np.zeros((b.size, b.size)), np.zeros(b.size))
    nothing = np.zeros((b.size, b.size)), np.zeros((b.size, b.size))
    ends = {
        name: half_space_by_permittivity(b, half, zero, case.k0, e, magnetic=magnetic)
        for name, half, e in (
            ("below", below, case.below),
            ("above", above, case.above),
        )
    }
    for name, pair in (
        ("below", (ends["below"], none)),
        ("above", (none, ends["above"])),
    ):
        rates[name] = matrix_rate(layer, w, case.height, nothing, pair) * sign
    return match.matrix[pick] * sign, rates


def mean_rate(
    first: np.ndarray, second: np.ndarray, d_first: np.ndarray, d_second: np.ndarray
) -> np.ndarray:
    """Derivative of ``engine.geometric_mean``, by the same formula."""
    if abs(np.linalg.det(first)) <= 1e-3 * np.linalg.norm(first, 2) ** 2:
        return np.asarray((d_first + d_second) / 2)
    ratio = np.linalg.solve(first, second)
    d_ratio = np.linalg.solve(first, d_second - d_first @ ratio)
    root = np.sqrt(np.linalg.det(ratio) + 0j)
    d_root = root / 2 * np.trace(np.linalg.solve(ratio, d_ratio))
    trace = np.sqrt(np.trace(ratio) + 2 * root)
    if abs(trace) <= 0.1:
        return np.asarray((d_first + d_second) / 2)
    d_trace = (np.trace(d_ratio) + 2 * d_root) / (2 * trace)
    half = (ratio + root * np.eye(2)) / trace
    d_half = (d_ratio + d_root * np.eye(2) - half * d_trace) / trace
    return np.asarray(d_first @ half + first @ d_half)


def gradient(
    cell: Cell,
    diameter_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    polarization: Polarization = "x",
    tolerance: float = 1e-3,
) -> Gradient:
    """t of ``solve`` and its derivatives; arguments and refusals as there.

    Accuracy: they are the exact derivatives of the discrete t (1e-8 against finite
    differences), which differ from
    those of the true t by about the tolerance over the scale on which t varies.
    """
    case = case_of(
        cell, diameter_um, Light(wavelength_um, angle_rad, polarization, azimuth_rad)
    )
    check_tolerance(tolerance)
    plan = climb(case, tolerance).rung.choice(case.rho).plan
    with one_blas_thread():
        (first, d_first), (second, d_second) = (
            form_rates(case, plan, magnetic=magnetic) for magnetic in (False, True)
        )
    by = {
        name: mean_rate(first, second, d_first[name], d_second[name])[1, 0]
        for name in d_first
    }
    t = complex(geometric_mean(first, second)[1, 0])
    half = cell.pitch_um / 2
    refraction = index(cell.pillar, wavelength_um)
    parts = {
        "disc": cell.pillar,
        "around": cell.fill,
        "below": cell.substrate,
        "above": cell.cover,
    }
    dispersion = sum(
        2 * index(part, wavelength_um) * slope(part, wavelength_um) * by[name]
        for name, part in parts.items()
    )
    by_bloch = by.get("bloch", 0.0)
    sign = math.copysign(1.0, angle_rad)
    return Gradient(
        t=t,
        diameter_um=complex(by["rho"] / cell.pitch_um),
        height_um=complex(by["height"] / half),
        n=complex(2 * refraction * by["disc"]),
        k=complex(2j * refraction * by["disc"]),
        wavelength_um=complex(
            dispersion - (case.k0 * by["k0"] + case.bloch * by_bloch) / wavelength_um
        ),
        angle_rad=complex(by_bloch * case.k0 * math.cos(angle_rad) * sign),
    )
