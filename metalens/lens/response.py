"""Phase and transmission of all pillars for light of one wavelength and angle, by compiled loops that
read each diameter once.
"""

import numba
import numpy as np

from metalens.core.arrays import Array
from metalens.core.threads import run_split
from metalens.lens.record import Lens
from metalens.library import Proxy

# scale, shift, power, ceiling, monomials of φ and of |T|
Polynomials = tuple[float, float, int, float, Array, Array]
PART = 512  # pillars of a row per pass
FASTMATH: set[str] = {"contract", "nsz", "reassoc"}


def fill_response(
    lens: Lens, at: tuple[float, float], phase: Array, level: Array
) -> None:
    """Fill (y, x) arrays with the phase wrapped to ±π and the transmission of every
    pillar, in their dtype; 0 where there is none.

    Args:
        lens: whose pillars respond.
        at: wavelength in um, angle of incidence in rad.
        phase: (y, x) array that is filled, rad.
        level: (y, x) array that is filled.

    Raises:
        DomainError: a diameter, the wavelength or the angle lies outside the proxy's
            domain.
    """
    d = np.asarray(lens.diameters.diameter_um)
    if lens.pairs is not None:
        phase[:] = _wrap(lens.phase_rad(at[0], at[1]))
        level[:] = lens.transmission(at[0], at[1])
        return
    fill_response_of(lens.proxy, d, at, phase, level)
    if lens.diameters.angle_rad is not None:
        turned = _wrap(phase + lens.geometric_rad(slice(None)))
        phase[:] = np.where(d > 0, turned, 0)


def _wrap(phase_rad: Array) -> Array:
    """Phase within ±π, rad."""
    turns = phase_rad / (2 * np.pi)
    return np.asarray((turns - np.rint(turns)) * 2 * np.pi)


def fill_response_of(
    proxy: Proxy, d: Array, at: tuple[float, float], phase: Array, level: Array
) -> None:
    """As :func:`fill_response`, for a map of diameters and a proxy.

    Args:
        proxy: phase and |T| over the diameter.
        d: (y, x) sizes, um; 0 where there is no pillar.
        at: wavelength in um, angle of incidence in rad.
        phase: (y, x) array that is filled, rad.
        level: (y, x) array that is filled.
    """
    loop, numbers = _fill, response_polynomials(proxy, d, at)
    run_split(len(d), lambda a, b: loop(d[a:b], numbers, phase[a:b], level[a:b]))


def response_polynomials(
    proxy: Proxy, diameter_um: Array, at: tuple[float, float]
) -> Polynomials:
    """Numbers of the phase and |T| polynomials for :func:`evaluate_row`, after the
    diameters are checked; raises as :func:`fill_response`.

    Args:
        proxy: phase and |T| over the diameter.
        diameter_um: (y, x) sizes, um; 0 where there is no pillar.
        at: wavelength in um and angle in rad.
    """
    phase, level = proxy.at(*at), proxy.level_at(*at)
    most = float(np.max(diameter_um, initial=0.0))
    if most > 0:
        proxy.phase_rad(
            np.array([np.min(diameter_um, where=diameter_um > 0, initial=most), most]),
            *at,
        )  # raises outside the domain
    inner = phase.scale, phase.shift, phase.power, level.ceiling
    return (*inner, np.array(phase.monomials), np.array(level.monomials))


@numba.njit(
    fastmath=FASTMATH, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def evaluate_row(d, numbers, x, phase, level):  # type: ignore[no-untyped-def]
    """Fill the phase in rad and |T| of a part of a row, by Horner's rule in x = scale
    d^power + shift.

    Args:
        d: (n,) diameters, um.
        numbers: scale, shift, power, ceiling and monomials of phase and |T|.
        x: (n,) work array.
        phase: (n,) that is filled, rad.
        level: (n,) that is filled; 0 where there is no pillar.
    """
    scale, shift, power, ceiling, in_phase, in_level = numbers
    for j in range(d.size):
        x[j] = scale * d[j]
    for _ in range(power - 1):
        for j in range(d.size):
            x[j] *= d[j]
    for j in range(d.size):
        x[j] += shift
        phase[j], level[j] = in_phase[-1], in_level[-1]
    for k in range(in_phase.size - 2, -1, -1):
        for j in range(d.size):
            phase[j] = phase[j] * x[j] + in_phase[k]
    for k in range(in_level.size - 2, -1, -1):
        for j in range(d.size):
            level[j] = level[j] * x[j] + in_level[k]
    for j in range(d.size):
        level[j] = min(level[j], ceiling) if d[j] > 0 else 0.0


@numba.njit(fastmath=FASTMATH, nogil=True, error_model="numpy", cache=True)
def _fill(d, numbers, out_phase, out_level):  # type: ignore[no-untyped-def]
    """Fill some rows of :func:`fill_response`, in parts of 512 pillars.

    Args:
        d: (rows, x) diameters, um.
        numbers: as for :func:`evaluate_row`.
        out_phase: (rows, x) that is filled, rad within ±π.
        out_level: (rows, x) that is filled.
    """
    x, phase, level = np.empty(PART), np.empty(PART), np.empty(PART)
    for i in range(d.shape[0]):
        for start in range(0, d.shape[1], PART):
            row = d[i, start : start + PART]
            n = row.size
            evaluate_row(row, numbers, x[:n], phase[:n], level[:n])
            for j in range(n):
                t = phase[j] / (2 * np.pi)
                out_phase[i, start + j] = (
                    (t - np.rint(t)) * (2 * np.pi) if row[j] > 0 else 0.0
                )
                out_level[i, start + j] = level[j]
