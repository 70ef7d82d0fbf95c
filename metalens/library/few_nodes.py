"""Few nodes in wavelength and angle: the other curves of a sweep by polynomials between
them, with error estimates.
"""

import math

import numpy as np
from scipy.ndimage import maximum_filter1d

from metalens.cell import Incidence, Polarization
from metalens.core.arrays import Array
from metalens.library.record import Sweep

Normal = dict[str, Polarization]
Rows = dict[Incidence, Array]  # (3, diameter) complex: t, r, error estimate
ALL_UP_TO = 6  # values of an axis that are all solved
# half-width of a resonance that may lie between two nodes and show at neither
NARROW_UM = 0.005
MOVES_UM = 0.02  # how far it may move between two nodes
FIRST = 5  # nodes to begin with where there are more
NEIGHBOURS = 4  # diameters on either side whose changes count
SAFETY = 3.0  # on the extrapolated error of a polynomial


def pick_nodes(values: tuple[float, ...]) -> tuple[float, ...]:
    """The values to solve first: all of a few, else five Leja points.

    Each is where the product of the distances to those before it is largest, which
    keeps that product, the factor of the error of the polynomial through them, small
    everywhere.
    """
    if len(values) <= ALL_UP_TO:
        return values
    x = np.array(values)
    chosen = [0, len(x) - 1]
    while len(chosen) < FIRST:
        chosen.append(int(np.argmax(np.prod(np.abs(x[:, None] - x[chosen]), axis=1))))
    return tuple(values[i] for i in sorted(chosen))


ALIKE: dict[str, Polarization] = {
    "s": "x",
    "p": "x",
    "x": "x",
    "y": "y",
}  # light along x and y meets the same cell
UNLIKE: dict[str, Polarization] = {
    **ALIKE,
    "s": "y",
}  # planes of incidence along x: s is the light along y


def sweep_plane_waves(
    sweep: Sweep,
    wavelengths_um: tuple[float, ...],
    angles_deg: tuple[float, ...],
    normal: Normal = ALIKE,
) -> list[Incidence]:
    """Every distinct plane wave; ``normal``: what the polarisations are at normal
    incidence.

    Args:
        sweep: settings of the library.
        wavelengths_um: vacuum wavelengths, um.
        angles_deg: angles of incidence in air.
    """
    found = [
        plane_wave(w, a, p, normal)
        for a in angles_deg
        for p in sweep.polarizations
        for w in wavelengths_um
    ]
    return list(dict.fromkeys(found))


def plane_wave(
    wavelength_um: float,
    angle_deg: float,
    polarization: Polarization,
    normal: Normal = ALIKE,
) -> Incidence:
    """The plane wave of an entry.

    Args:
        wavelength_um: vacuum wavelength, um.
        angle_deg: angle of incidence in air.
        polarization: s or p; x or y at normal incidence.
        normal: polarisation at normal incidence that stands for s and for p.
    """
    return Incidence(
        wavelength_um,
        math.radians(angle_deg),
        polarization if angle_deg else normal[polarization],
    )


def complete_sweep(
    sweep: Sweep,
    solved: Rows,
    poles: dict[Incidence, Array],
    diameters: Array,
    normal: Normal = ALIKE,
) -> Rows:
    """All rows of the sweep: the solved ones, then between wavelengths, then between
    angles.

    poles: (k, 2) diameter and half-width of the resonances of every solved curve. Where
        a narrow one moves from one node to the next, the diameters it passes have an
        error of 1: they must be solved.

    Args:
        normal: polarisation at normal incidence that stands for s and for p.
    """
    rows = dict(solved)
    sharp = {light: found[found[:, 1] < NARROW_UM] for light, found in poles.items()}
    for polarization in sweep.polarizations:
        for angle in sweep.angles_deg:
            family = {
                w: plane_wave(w, angle, polarization, normal)
                for w in sweep.wavelengths_um
            }
            _fill(rows, family, sharp, diameters)
        for wavelength in sweep.wavelengths_um:
            at = {math.sin(math.radians(a)) ** 2: a for a in sweep.angles_deg}
            family = {
                x: plane_wave(wavelength, a, polarization, normal)
                for x, a in at.items()
            }
            _fill(rows, family, sharp, diameters)
    return rows


def _fill(
    rows: Rows,
    family: dict[float, Incidence],
    sharp: dict[Incidence, Array],
    diameters: Array,
) -> None:
    """Add the rows of a family (position: light) that are missing, where at least five
    are there.
    """
    have = {x: wave for x, wave in family.items() if wave in rows}
    if len(have) < FIRST:
        return
    nodes, table = (
        np.array(list(have)),
        np.stack([rows[wave] for wave in have.values()]),
    )
    for x, wave in family.items():
        if wave not in rows:
            row = interpolate_row(nodes, table, x)
            right = int(np.searchsorted(nodes, x))
            first, second = (
                sharp.get(have[float(nodes[i])], np.empty((0, 2)))
                for i in (right - 1, right)
            )
            passed = _passed(first, second, diameters)
            row[2] = np.where(passed, 1.0, row[2])
            rows[wave] = row


def _passed(first: Array, second: Array, diameters: Array) -> Array:
    """Mask of the diameters that narrow resonances may pass between two neighbouring
    nodes.
    """
    mask = np.zeros(len(diameters), bool)
    for here, there in ((first, second), (second, first)):
        for centre, width in here:
            gap = np.abs(there[:, 0] - centre)
            end = (
                float(there[np.argmin(gap), 0])
                if gap.size and gap.min() < MOVES_UM
                else None
            )
            low, high = (
                (centre - MOVES_UM, centre + MOVES_UM)
                if end is None
                else sorted((centre, end))
            )
            mask |= (diameters >= low - 4 * width) & (diameters <= high + 4 * width)
    return mask


def interpolate_row(nodes: Array, table: Array, x: float) -> Array:
    """(3, diameter) row at ``x`` by the polynomial through all nodes.

    The error is extrapolated. Leaving out one node changes the row by the error of the
    next lower degree, leaving out two by that of the degree below; where the second is
    less than the first by some factor, the polynomial through all nodes is better by
    that factor again. Changes are taken as the largest of neighbouring diameters, as
    any one may vanish by chance; the result is trebled, and the errors of the nodes are
    added as they enter.

    nodes: (m,). table: (m, 3, diameter).
    """
    weights = lagrange_weights(nodes, x)
    row: Array = np.tensordot(weights, table, 1)
    one, two = np.zeros(table.shape[2]), np.zeros(table.shape[2])
    for k in range(len(nodes)):
        keep = np.arange(len(nodes)) != k
        without = np.tensordot(lagrange_weights(nodes[keep], x), table[keep, 0], 1)
        one = np.maximum(one, np.abs(without - row[0]))
        for j in range(k):
            fewer = keep & (np.arange(len(nodes)) != j)
            two = np.maximum(
                two,
                np.abs(
                    np.tensordot(lagrange_weights(nodes[fewer], x), table[fewer, 0], 1)
                    - without
                ),
            )
    one, two = (maximum_filter1d(change, 2 * NEIGHBOURS + 1) for change in (one, two))
    gain = np.minimum(1.0, one / np.maximum(two, 1e-300))
    row[2] = SAFETY * gain * one + np.abs(weights) @ table[:, 2].real
    return row


def lagrange_weights(nodes: Array, x: float) -> Array:
    """(m,) weights of the values at the nodes in the polynomial through them at ``x``."""
    ratio = (x - nodes[None, :]) / (
        nodes[:, None] - nodes[None, :] + np.eye(len(nodes))
    )
    return np.asarray(
        np.prod(np.where(np.eye(len(nodes), dtype=bool), 1.0, ratio), axis=1)
    )
