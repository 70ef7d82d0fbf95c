"""Phase and transmission of all pillars for light of one wavelength and angle, by compiled loops that
read each diameter once.
"""

import numba
import numpy as np

from metalens.core.arrays import Array
from metalens.core.threads import run_split
from metalens.lens.record import Lens
from metalens.library import Proxy

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
    in_phase, in_level = proxy.at(*at), proxy.level_at(*at)
    most = float(np.max(d, initial=0.0))
    if most > 0:  # raises outside the domain
        sizes = np.array([np.min(d, where=d > 0, initial=most), most])
        proxy.phase_rad(sizes, *at)
    numbers = (
        *(in_phase.scale, in_phase.shift, in_phase.power, in_level.ceiling),
        *(np.array(part.monomials) for part in (in_phase, in_level)),
    )
    loop = _fill
    run_split(len(d), lambda a, b: loop(d[a:b], numbers, phase[a:b], level[a:b]))


@numba.njit(fastmath=FASTMATH, nogil=True, error_model="numpy", cache=True)
def _fill(d, numbers, out_phase, out_level):  # type: ignore[no-untyped-def]
    """Fill some rows of :func:`fill_response`, in parts of 512 pillars, by Horner's
    rule in x = scale d^power + shift.

    Args:
        d: (rows, x) diameters, um.
        numbers: scale, shift, power, ceiling and monomials of phase and |T|.
        out_phase: (rows, x) that is filled, rad within ±π.
        out_level: (rows, x) that is filled.
    """
    scale, shift, power, ceiling, in_phase, in_level = numbers
    x, phase, level = np.empty(PART), np.empty(PART), np.empty(PART)
    for i in range(d.shape[0]):
        for start in range(0, d.shape[1], PART):
            row = d[i, start : start + PART]
            n = row.size
            for j in range(n):
                x[j] = scale * row[j]
            for _ in range(power - 1):
                for j in range(n):
                    x[j] *= row[j]
            for j in range(n):
                x[j] += shift
                phase[j], level[j] = in_phase[-1], in_level[-1]
            for k in range(in_phase.size - 2, -1, -1):
                for j in range(n):
                    phase[j] = phase[j] * x[j] + in_phase[k]
            for k in range(in_level.size - 2, -1, -1):
                for j in range(n):
                    level[j] = level[j] * x[j] + in_level[k]
            for j in range(n):
                t = phase[j] / (2 * np.pi)
                has_pillar = row[j] > 0
                out_phase[i, start + j] = (
                    (t - np.rint(t)) * (2 * np.pi) if has_pillar else 0.0
                )
                out_level[i, start + j] = min(level[j], ceiling) if has_pillar else 0.0
