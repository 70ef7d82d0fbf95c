"""Light from a point source through the pillars to the sensor window: the exact sum,
and faster ways to the same field.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from metalens.core.arrays import Array, to_tensor
from metalens.core.errors import PropagationError
from metalens.optics import Layers, Media, media
from metalens.propagate.choice import MethodChoice, choose_method
from metalens.propagate.direct import angular_spectrum as _angular_spectrum
from metalens.propagate.direct import field_at, field_exact
from metalens.propagate.geometry import PropagationCase

__all__ = [
    "MethodChoice",
    "PropagationCase",
    "angular_spectrum",
    "choose_method",
    "exact",
    "field_at",
    "field_exact",
    "make_case",
    "windowed",
]


def make_case(
    shape: Sequence[int],
    *,
    pitch_um: float,
    wavelength_um: float,
    sensor_distance_um: float,
    depths_um: Any,
    angle_rad: Any = 0.0,
    window_um: float | Sequence[float],
    samples: int | Sequence[int],
    offset_um: tuple[float, float] = (0.0, 0.0),
    layers: Layers | None = None,
    row_um: float = 0.0,
    site_um2: float = 0.0,
) -> PropagationCase:
    """Geometry of one propagation.

    Args:
        pitch_um: distance of neighbouring columns.
        sensor_distance_um: from lens to sensor.
        shape: (y, x) pillars.
        depths_um: source depths, any sequence or a number; inf for a collimated beam.
        angle_rad: field angle along x, or the pair (x, y), arctangents of the light's
            slopes dx/dz and dy/dz (those in
            air): light of a positive angle moves to +x (+y).
        window_um, samples: full width of the window, and cells along it; pairs (x, y)
            where it is not square.
        offset_um: (x, y) of the window centre from the chief ray.
        layers: films around the lens; ``wavelength_um`` is then that in vacuum, and
            ``angle_rad`` that in air.
        row_um: distance of the rows, 0 for that of the columns; site_um2: area of the
            cell of one pillar, 0 for that
            of the grid. On a hexagonal lattice of pitch p: p / 2 from column to column,
            p sqrt(3) / 2 from row to row,
            an area of p² sqrt(3) / 2, and 0 transmission at every other site.

    Raises:
        PropagationError: a length that is not positive, an angle of 90° or more, no
            depth, an offset that is no pair,
            films without a gap and rays beyond their critical angle, a stop in front.
    """
    step_um, cells = window_of(window_um, samples)
    ax, ay = to_angle_pair(angle_rad)
    tangents = float(np.tan(ax)), float(np.tan(ay))
    depths = _depths(depths_um, offset_um)
    d = sensor_distance_um
    films = _films(layers, float(d), float(wavelength_um))
    meets = [
        chief_ray_offset(films.get("behind"), float(d), tangents, i)
        + float(offset_um[i])
        for i in (0, 1)
    ]
    made = PropagationCase(
        shape=(int(shape[-2]), int(shape[-1])),
        pitch_um=float(pitch_um),
        wavelength_um=float(wavelength_um),
        sensor_distance_um=float(sensor_distance_um),
        tangents=tangents,
        inverse_depths_per_um=tuple((1 / depths).tolist()),
        centre_um=(meets[0], meets[1]),
        step_um=step_um,
        samples=cells,
        row_um=float(row_um),
        site_um2=float(site_um2),
        **films,
    )
    _check_rays(made)
    return made


def _films(
    layers: Layers | None, sensor_distance_um: float, wavelength_um: float
) -> dict[str, Any]:
    """What films add to a case."""
    if layers is not None and layers.stop is not None:
        raise PropagationError(
            "layers: a stop is no part of a propagation from the pillars on; put Layers.stop_share onto their transmission "
            "and give Layers.open (psf_stack does both)"
        )
    if layers is None or layers.plain or not sensor_distance_um > 0:
        return {}
    return film_settings(layers, sensor_distance_um, wavelength_um)


def _check_rays(case: PropagationCase) -> None:
    """Refuse rays that no face lets through: where films fill the whole gap, those that
    its cover cannot hold.
    """
    if case.behind is None or case.behind.thickness_um[0] > 0:
        return
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    (high, wide), (down, across) = case.half_size_um, case.half_window_um
    x = np.abs(
        np.abs(case.centre_um[0]) + across + wide * np.cos(turn)
    )  # the rim of a round lens, the far corner
    y = np.abs(np.abs(case.centre_um[1]) + down + high * np.sin(turn))
    steepest, most = (
        float(media.ray_direction(case.behind, np.hypot(x, y).max())),
        min(case.behind.order),
    )
    if steepest >= most:
        raise PropagationError(
            f"layers: the films fill the way from lens to sensor, and rays of n sin θ = {steepest:.3g} from the rim to "
            f"the window do not leave the cover of index {most:g}: need a gap, a nearer window or a smaller angle"
        )


def _depths(depths_um: Any, offset_um: Any) -> Array:
    """(depth,) of the sources; nan, which a case refuses, for one that is not above 0."""
    depths = np.atleast_1d(np.asarray(depths_um, float))
    if depths.ndim != 1 or np.shape(offset_um) != (2,):
        words = f"depths_um of shape {depths.shape}, offset_um of {np.shape(offset_um)}"
        raise PropagationError(f"{words}: need (depth,) and a pair (x, y)")
    return depths if (depths > 0).all() else np.array([np.nan])


def window_of(window_um: Any, samples: Any) -> tuple[float, tuple[int, int]]:
    """(step_um, (y, x) samples) of a window: widths and samples are numbers, or pairs
    (x, y).

    Args:
        window_um: width, or a pair (x, y).

    Raises:
        PropagationError: no number and no pair, parts of samples, or cells that are not
            square to 1e-6.
    """
    wide, many = (
        np.ravel(np.asarray(window_um, float)),
        np.ravel(np.asarray(samples, float)),
    )
    if wide.size not in (1, 2) or many.size not in (1, 2) or (many % 1 != 0).any():
        raise PropagationError(
            f"window_um = {window_um}, samples = {samples}: need a number or a pair (x, y) of each, samples whole"
        )
    (width, height), (across, down) = (
        np.resize(wide, 2).tolist(),
        np.resize(many.astype(int), 2).tolist(),
    )
    step = width / max(across, 1)
    if abs(height / max(down, 1) - step) > 1e-6 * abs(step):
        raise PropagationError(
            f"window of {width:g} x {height:g} um with {across} x {down} samples: cells of {step:g} x "
            f"{height / max(down, 1):g} um; need square ones"
        )
    return step, (down, across)


def film_settings(
    layers: Layers, sensor_distance_um: float, wavelength_um: float
) -> dict[str, Any]:
    """``front`` and ``behind`` of a :class:`Case` with these films.

    Args:
        layers: films around the lens.
        sensor_distance_um: from lens to sensor.
        wavelength_um: in vacuum.

    Raises:
        PropagationError: films thicker than the distance, or of metal.
    """
    before = layers.before(math.inf, wavelength_um)
    films = tuple(
        (n, t)
        for n, t in zip(before.index[1:], before.thickness_um[1:], strict=True)
        if t > 0
    )
    return {"front": films, "behind": layers.after(sensor_distance_um, wavelength_um)}


def chief_ray_offset(
    behind: Media | None, sensor_distance_um: Any, tangents: Any, axis: int
) -> Any:
    """Where the chief ray of these tangents (in air) meets the sensor, along x (axis 0)
    or y (1), um.

    Operands may be torch tensors: behind films the cover takes what the distance gains.

    Args:
        sensor_distance_um: from lens to sensor.
    """
    if behind is None:
        return sensor_distance_um * tangents[axis]
    steep = 1 + tangents[0] * tangents[0] + tangents[1] * tangents[1]
    value = (
        sensor_distance_um.detach()
        if hasattr(sensor_distance_um, "detach")
        else sensor_distance_um
    )
    gained = [
        (n, t) for n, t in zip(behind.index, behind.thickness_um, strict=True) if t > 0
    ]
    pairs = [*gained, (behind.index[0], sensor_distance_um - value)]
    return media.reach_per_direction(pairs, 1 - 1 / steep) * tangents[axis] / steep**0.5


def to_angle_pair(angle_rad: Any) -> tuple[float, float]:
    """(x, y) field angle from a number or a pair.

    Args:
        angle_rad: one angle or a pair (x, y).

    Raises:
        PropagationError: not one or two finite numbers within ±90°.
    """
    pair = np.atleast_1d(np.asarray(angle_rad, float))
    if pair.shape == (1,):
        pair = np.array([pair[0], 0.0])
    if pair.shape != (2,) or not (np.abs(pair) < np.pi / 2).all():
        raise PropagationError(
            f"angle_rad is {angle_rad}, need one angle or a pair (x, y) within ±pi/2"
        )
    return float(pair[0]), float(pair[1])


def exact(phase_rad: Array, transmission: Array, **geometry: Any) -> Array:
    """Field on a window by direct Rayleigh-Sommerfeld summation over all pillars.

        U(X) = Σ p² T exp(iφ) U_in d / (2π r²) (1/r - ik) exp(ikr)

    in float64, |U_in| = 1 with phase 0 at the lens centre (Goodman, Introduction to
    Fourier Optics, eq. 3-43, time factor exp(-iωt)). Through films d/(2πr²)(1/r - ik)
    exp(ikr) becomes the stationary phase of the plane waves along the refracted ray.
    The
    reference for every faster method; its time grows as pillars times samples.

    Args:
        phase_rad: (y, x) phase of every pillar.
        transmission: (y, x) magnitude |T| of every pillar.
        geometry: pitch, wavelength, distances, angle and window by name, as
            :func:`make_case`.

    Returns:
        (depth, y, x) complex128 field; its square is the irradiance for unit irradiance
        of the lens.

    Raises:
        PropagationError: empty aperture, NaN, or maps and geometry that do not fit.

    Accuracy: rounding, 1e-12 of the sum of the pillars' magnitudes.

    >>> one_pillar = np.ones((1, 1))
    >>> u = exact(0 * one_pillar, one_pillar, pitch_um=0.4, wavelength_um=0.85,
    ...           sensor_distance_um=50.0, depths_um=np.inf, window_um=1.0, samples=1)
    >>> round(float(abs(u[0, 0, 0])), 6)  # p² / (wavelength d)
    0.003765
    """
    phase, level = np.asarray(phase_rad), np.asarray(transmission)
    return field_exact(phase, level, make_case(phase.shape, **geometry))


def angular_spectrum(
    phase_rad: Array,
    transmission: Array,
    *,
    pad: int = 2,
    band_limited: bool = False,
    single: bool = False,
    **geometry: Any,
) -> Array:
    """Textbook angular spectrum on the zero-padded pillar lattice (see
    :mod:`metalens.propagate.direct`).

    Args:
        phase_rad: (y, x) phase of every pillar.
        transmission: (y, x) magnitude |T| of every pillar.
        pad, band_limited, single: padding factor, band limit, complex64.
        geometry: as :func:`make_case`; the window must lie on the pillars' lattice.
    """
    phase, level = np.asarray(phase_rad), np.asarray(transmission)
    one = make_case(phase.shape, **geometry)
    return _angular_spectrum(
        phase, level, one, pad=pad, band_limited=band_limited, single=single
    )


def windowed(
    phase_rad: Any, transmission: Any, *, tolerance: float = 1e-4, **geometry: Any
) -> Any:
    """Windowed propagation: only the field on the window, differentiable in torch phase
    and transmission.

    Args:
        phase_rad, transmission: (y, x) torch tensors or numpy arrays, float32 or
            float64.
        tolerance: relative error of the field that the node counts are chosen for.
        geometry: as :func:`make_case`.

    Returns:
        (depth, y, x) complex, of the kind that came in.

    Raises:
        PropagationError: the window is too large for the method, a tolerance that is
            not above 0 and below 1;
            otherwise as :func:`exact`.

    Sums are in float64 whatever comes in, so that a tighter tolerance is not lost in
    rounding.
    """
    import torch

    from metalens.propagate.window import field_windowed, plan_window

    if not 0 < tolerance < 1:
        raise PropagationError(
            f"tolerance is {tolerance}, need a relative error above 0 and below 1"
        )
    phase = to_tensor(phase_rad)
    level = to_tensor(transmission).to(phase)
    made = plan_window(make_case(phase.shape, **geometry), tolerance, torch.float64)
    field = field_windowed(phase.double(), level.double(), made)
    field = field.to(torch.complex(phase.new_zeros(()), phase.new_zeros(())).dtype)
    return field if isinstance(phase_rad, torch.Tensor) else field.detach().numpy()
