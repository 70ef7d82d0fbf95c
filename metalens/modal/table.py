"""Many responses of one cell: what they share is computed once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Polarization
from metalens.modal.engine import solve


@dataclass(frozen=True, eq=False, slots=True)
class Table:
    """Responses over (polarisation, angle, wavelength, diameter).

    t, r: complex amplitudes. t_error: estimates, not below the true errors. energy: of all propagating orders.
    converged: whether the estimate met the tolerance.
    """

    t: np.ndarray
    r: np.ndarray
    t_error: np.ndarray
    energy: np.ndarray
    converged: np.ndarray


def solve_many(
    cell: Cell,
    diameters_um: Sequence[float] | np.ndarray,
    wavelengths_um: Sequence[float] | np.ndarray,
    *,
    angles_rad: Sequence[float] | np.ndarray = (0.0,),
    polarizations: Sequence[Polarization] = ("s", "p"),
    tolerance: float = 1e-3,
    progress: Callable[[int], object] | None = None,
) -> Table:
    """``solve`` for every combination; plane of incidence along x.

    A diameter is assembled once for all wavelengths and angles; at normal incidence its empty-cell modes serve all
    wavelengths, and one polarisation stands for all; both polarisations of an oblique case share theirs.
    progress: called with the number of responses found, after each wavelength and angle of each diameter.

    Raises:
        CellError, MaterialError: as ``solve``; nothing is left out silently.
    """
    shape = (len(polarizations), len(angles_rad), len(wavelengths_um), len(diameters_um))
    t, r = np.empty(shape, complex), np.empty(shape, complex)
    t_error, energy, converged = np.empty(shape), np.empty(shape), np.empty(shape, bool)
    for d, diameter in enumerate(diameters_um):
        for a, angle in enumerate(angles_rad):
            for w, wavelength in enumerate(wavelengths_um):
                for p, polarization in enumerate(polarizations):
                    at = (p, a, w, d)
                    if p and angle == 0.0:
                        for array in (t, r, t_error, energy, converged):
                            array[at] = array[0, a, w, d]
                        continue
                    found = solve(
                        cell,
                        float(diameter),
                        float(wavelength),
                        angle_rad=float(angle),
                        polarization=polarization,
                        tolerance=tolerance,
                    )
                    t[at], r[at], t_error[at] = found.t, found.r, found.t_error
                    energy[at], converged[at] = found.energy, found.converged
                if progress is not None:
                    progress(len(polarizations))
    return Table(t, r, t_error, energy, converged)
