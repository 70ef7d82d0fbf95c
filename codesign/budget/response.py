"""Arithmetic of pillar tables t(D), of numbers: between the diameters of a library, put
right, compared.
"""

import numpy as np

from metalens.core.arrays import Array


def interpolate_response(t: Array, diameter_um: Array, at_um: Array) -> Array:
    """(*at) complex t between the diameters of a library: level and unwound phase are
    straight in between.

    Args:
        t: (diameters,) complex, of ascending ``diameter_um``.
    """
    phase, level = np.unwrap(np.angle(t)), np.abs(t)
    return np.asarray(
        np.interp(at_um, diameter_um, level)
        * np.exp(1j * np.interp(at_um, diameter_um, phase))
    )


def put_right(table: Array, diameter_um: Array, at_um: Array, ratio: Array) -> Array:
    """(entries,) the table t of ``diameter_um`` times a ratio that is known at some
    diameters.

    Level and phase of the ratio are taken by its logarithm, which is straight in
    between and ends beyond.
    """
    log = np.log(np.abs(ratio)) + 1j * np.unwrap(np.angle(ratio))
    return np.asarray(
        table
        * np.exp(
            np.interp(diameter_um, at_um, log.real)
            + 1j * np.interp(diameter_um, at_um, log.imag)
        )
    )


def scatter_rad(turn_rad: Array, share: Array) -> float:
    """Standard deviation of a phase over the pillars, by their share of 1: a common
    phase is no error.
    """
    mean = np.angle((np.exp(1j * turn_rad) * share).sum())
    off = np.angle(np.exp(1j * (turn_rad - mean)))
    return float(np.sqrt((off**2 * share).sum()))
