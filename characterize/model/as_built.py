"""Every pillar of an as-built lens: its transmission, the lens it makes, and the PSFs
of that lens.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from characterize.model.parameters import PLACE, process_state_of
from characterize.model.pillars import incidence_rad
from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.fabrication import (
    CDError,
    PairTable,
    PillarKinds,
    Sensitivity,
    WavefrontError,
    bias_ratio,
    perturbations,
    perturbed_transmission,
)
from metalens.lens import DiameterMap, Lens

_TABLE = 1 << 16
_NODES = max(
    perturbations.polynomial_coefficients(kind).shape[-1]
    for kind in (CDError, WavefrontError)
)

if TYPE_CHECKING:
    from metalens.psf import PsfStack, View


def as_built_transmission(
    lens: Lens,
    response: Sensitivity,
    x: Array,
    *,
    noise_um: Array | float = 0.0,
    angle_rad: float = 0.0,
) -> Array:
    """(y, x) complex transmission of every as-built pillar; 0 where there is none.

    Diameter, process and wave-front aberrations enter, and the geometric phase.
    Accuracy: t is a table over the diameters, linear between its 2^16 entries: 1e-9
    for 50 rad/um.

    Args:
        lens: the design.
        response: what height, index and sidewall do to the pillars.
        x: all parameters, in the order of ``parameters.NAMES``.
        noise_um: added to the diameters, pillar by pillar.
        angle_rad: of incidence, where the proxy is defined at angles.
    """
    d = lens.diameters
    state = process_state_of(x)
    bias = on_pillars(d, state.bias_um) + noise_um
    if lens.pairs is not None:
        t = _of_two_sizes(lens, response, bias, state.response_amounts())
    else:
        t = _of_one_size(lens, response, x, bias, angle_rad)
    if state.has_wavefront_error():
        t = t * np.exp(1j * on_pillars(d, state.phase_rad))
    geometric = np.exp(1j * np.asarray(lens.geometric_rad(slice(None))))
    return np.asarray(np.where(d.diameter_um > 0, t * geometric, 0))


def _of_two_sizes(
    lens: Lens, response: Sensitivity, bias_um: Array, response_amounts: Array
) -> Array:
    """(y, x) t of pillars of two sizes by the table of the lens.

    Sites without a pillar get the t of some pillar; the caller masks them.
    """
    d = lens.diameters
    kinds = PillarKinds.of(lens.diameters)
    pairs = response.pairs
    if pairs is None:
        raise FitError("pillars of two sizes: slopes of such pillars are needed")
    index = np.minimum(kinds.index(d), len(kinds.count) - 1)
    change = np.exp(
        np.tensordot(response_amounts, pairs.at(kinds.width_um, kinds.length_um), 1)
    )
    width, length = (
        size[index] + bias_um for size in (kinds.width_um, kinds.length_um)
    )
    return np.asarray(PairTable.of(lens).t(width, length) * change[index])


def _of_one_size(
    lens: Lens, response: Sensitivity, x: Array, bias_um: Array, angle_rad: float
) -> Array:
    """(y, x) t by the proxy of the lens under the process in ``x``.

    Sites without a pillar get the t of some pillar; the caller masks them.
    """
    d = lens.diameters
    response_amounts = process_state_of(x).response_amounts()
    wave = lens.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3
    grown = np.where(d.diameter_um > 0, d.diameter_um + bias_um, np.nan)
    low, high = float(np.nanmin(grown)), float(np.nanmax(grown)) + 1e-9
    diameter = np.linspace(low, high, _TABLE)
    t = perturbed_transmission(
        lens.proxy, response, diameter, wave, response_amounts, angle_rad=angle_rad
    )
    t = np.interp(grown, diameter, t)
    return np.asarray(t * bias_ratio(response, np.nan_to_num(grown, nan=low), bias_um))


def on_pillars(
    diameters: DiameterMap, low_order: Callable[[Array, Array], Array]
) -> Array:
    """(y, x) values at every pillar of a polynomial ``low_order`` in (u, v).

    Interpolated from Gauss-Legendre nodes, exact where these are one more than its
    degree along each axis.

    Args:
        diameters: map whose sites are meant.
        low_order: polynomial of places over the lens radius, along each axis.
    """
    node = legendre.gauss_legendre_nodes(_NODES)[0]
    radius_um = diameters.radius_um
    axes = (axis / radius_um for axis in (diameters.x_um, diameters.y_um))
    along_x, along_y = (legendre.interpolation_matrix(len(node), axis) for axis in axes)
    return np.asarray(along_y @ low_order(*np.meshgrid(node, node)) @ along_x.T)


def built_lens(design: Lens, x: Array) -> Lens:
    """The design with the as-built diameters, wavelength and distance.

    Diameters are clipped to the proxy's domain. Height, index, sidewall and
    wave-front errors are in :func:`as_built_transmission` and :func:`psf_stack` only.

    Args:
        x: all parameters.
    """
    d = design.diameters
    bias = on_pillars(d, process_state_of(x).bias_um)
    low, high = design.proxy.domain_um
    grown = np.clip(d.diameter_um + bias, low, min(high, 0.999 * d.pitch_um))
    built = d.diameter_um > 0
    length_um = d.length_um
    if length_um is not None:
        length_um = np.where(built, np.maximum(length_um + bias, 0.0), 0.0)
    diameters = dataclasses.replace(
        d, diameter_um=np.where(built, grown, 0.0), length_um=length_um
    )
    return dataclasses.replace(
        design,
        diameters=diameters,
        wavelength_um=design.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3,
        sensor_distance_um=design.sensor_distance_um + x[PLACE["distance_um"]],
        profile="as-built",
        neighbours=None,
    )


def psf_stack(
    lens: Lens,
    response: Sensitivity,
    x: Array,
    view: "View",
    *,
    offset_um: tuple[float, float] = (0.0, 0.0),
    tolerance: float = 1e-4,
) -> "PsfStack":
    """PSFs (angle, depth, y, x) of the as-built lens: :func:`metalens.psf.psf_stack`.

    Pillars, process, aberrations and distance enter. What belongs to one bench does
    not: stage, decentre, source size, crosstalk, gain, background. Accuracy: ``error``
    of the record, relative L2.

    Args:
        response: what height, index and sidewall do to the pillars.
        x: all parameters.
        offset_um: (x, y) of the window from the chief ray, added to that of the view.
        tolerance: relative error that is allowed.
    """
    from metalens import psf

    parts = []
    offset = {"offset_um": tuple(np.add(offset_um, view.offset_um).tolist())}
    for angle in view.angles_rad:
        t = as_built_transmission(
            lens, response, x, angle_rad=incidence_rad(lens.proxy, angle)
        )
        parts.append(
            psf.psf_stack(
                np.angle(t).astype(np.float32),
                np.abs(t).astype(np.float32),
                **lens.diameters.grid._asdict(),
                wavelength_um=lens.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3,
                sensor_distance_um=lens.sensor_distance_um + x[PLACE["distance_um"]],
                angle_rad=[list(angle)],
                tolerance=tolerance,
                **view.arguments | offset,
                layers=lens.layers,
            )
        )
    worst = max(parts, key=lambda part: part.error)
    fields = ("intensity", "energy_um2", "angles_rad", "centres_um")
    join: Any = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in fields
    }
    return dataclasses.replace(worst, **join)
