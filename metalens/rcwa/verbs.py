"""Rigorous coupled-wave analysis of one pillar: round on a square lattice by the fast
way, any other by ``jones``.

``solve`` gives the zero-order response of one cell with an error estimate,
``solve_many`` shares the work over
diameters. Light comes from the substrate, phases run from the foot of the pillar (or
the outer face of the films under
it) to its top, time factor exp(-iwt).
"""

from collections.abc import Iterable

import numpy as np

from metalens.cell import Cell, Incidence, Polarization, Response, check_tolerance
from metalens.core.errors import CellError
from metalens.rcwa.any_shape import co_polarised
from metalens.rcwa.conditions import check_diameter, disc_case
from metalens.rcwa.solver import solve_case


def solve(
    cell: Cell,
    diameter_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    polarization: Polarization = "x",
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> Response:
    """Zero-order response of a pillar, at the least number of harmonics that meets the
    tolerance.

    Args:
        diameter_um: at half height, 0 (no pillar) to the pitch (touching pillars); of
            another shape its size.
        angle_rad: of the light outside, in vacuum: its tangential wave vector is k0
            sin(angle_rad).
        azimuth_rad: of the plane of incidence, from +x to +y.
        polarization: s or p; x and y where the plane of incidence contains an axis. At
            normal incidence all are
            the same.
        tolerance: wanted bound of |t - exact|; beyond what the largest truncation
            reaches, the result comes with its
            larger ``t_error`` and ``converged`` False.
        harmonics: fix the largest order instead, and take the estimate there.

    Accuracy: ``t_error`` estimates the truncation, from how t moves between
    truncations; the number of
        steps of a tilted wall is chosen likewise. Lossless energy and reciprocity hold
        to rounding.

    Raises:
        CellError: an impossible diameter, angle, polarisation or tolerance.
        MaterialError: a wavelength outside the range of a material.
    """
    return solve_many(
        cell,
        (diameter_um,),
        wavelength_um,
        angle_rad=angle_rad,
        azimuth_rad=azimuth_rad,
        polarization=polarization,
        tolerance=tolerance,
        harmonics=harmonics,
    )[0]


def solve_many(
    cell: Cell,
    diameter_um: Iterable[float],
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    polarization: Polarization = "x",
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> list[Response]:
    """As :func:`solve`, for several diameters at once; each stops at its own
    truncation.
    """
    check_tolerance(tolerance)
    if harmonics is not None and harmonics < 1:
        raise CellError(f"harmonics = {harmonics}: need at least 1")
    diameters = np.array([float(diameter) for diameter in diameter_um])
    for diameter in diameters if cell.round else ():
        check_diameter(cell, float(diameter))
    light = Incidence(
        float(wavelength_um), float(angle_rad), polarization, float(azimuth_rad)
    )
    if not cell.round:
        return [
            co_polarised(
                cell, float(d), light, tolerance=tolerance, harmonics=harmonics
            )
            for d in diameters
        ]
    this = disc_case(cell, light)
    return solve_case(this, diameters, tolerance=tolerance, harmonics=harmonics)
