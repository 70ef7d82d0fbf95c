"""What is propagated: pillars, one direction of light at several depths, and the window
on the sensor.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics import Layers, Media, media


@dataclass(frozen=True, slots=True)
class PropagationCase:
    """Geometry of one propagation; hashable, so that plans can be kept.

    shape: (y, x) sites of the map; pitch_um: from column to column; row_um: from row to
    row (0: as the columns).
    site_um2: area of the cell of one pillar (0: of the map's own; on a hexagonal
    lattice every other site is empty).
    wavelength_um: in the medium on both sides of the lens; in vacuum where films are
    given.
    sensor_distance_um: lens plane to sensor plane.
    tangents: (x, y) tangents of the field angle; in air where films are given.
    inverse_depths_per_um: 1/z of every source, 0 for a source at infinity.
    centre_um: (x, y) of the window on the sensor; step_um: its sampling; samples: (y,
    x) points of the window.
    front: (index, thickness) of the films between source and lens, the rest air;
    behind: the media from lens to sensor,
        the one that fills the gap first, their thicknesses adding up to the distance;
        None for one medium.

    Raises:
        PropagationError: a length that is not positive and finite, no depth, no sample.
    """

    shape: tuple[int, int]
    pitch_um: float
    wavelength_um: float
    sensor_distance_um: float
    tangents: tuple[float, float]
    inverse_depths_per_um: tuple[float, ...]
    centre_um: tuple[float, float]
    step_um: float
    samples: tuple[int, int]
    front: tuple[tuple[float, float], ...] = ()
    behind: Media | None = None
    row_um: float = 0.0
    site_um2: float = 0.0

    def __post_init__(self) -> None:
        for name in ("pitch_um", "wavelength_um", "sensor_distance_um", "step_um"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise PropagationError(
                    f"{name} is {value}, need a positive length in um"
                )
        if not all(
            np.isfinite(length) and length >= 0
            for length in (self.row_um, self.site_um2)
        ):
            raise PropagationError(
                f"row_um = {self.row_um}, site_um2 = {self.site_um2}: need finite values, 0 or more"
            )
        if min(self.shape) < 1 or min(self.samples) < 1:
            raise PropagationError(
                f"{self.shape} pillars and {self.samples} samples, need at least one of each"
            )
        inverse = np.array(self.inverse_depths_per_um)
        if inverse.size == 0 or not (np.isfinite(inverse) & (inverse >= 0)).all():
            raise PropagationError(
                "depths_um must hold at least one source depth above 0 (inf for a far source)"
            )
        if not np.isfinite([*self.tangents, *self.centre_um]).all():
            raise PropagationError(
                f"field angle or window centre is not finite: {self.tangents}, {self.centre_um}"
            )
        if inverse.max() * sum(thickness for _, thickness in self.front) > 1:
            raise PropagationError(
                f"layers: films of {sum(t for _, t in self.front):g} um in the {1 / inverse.max():g} um from source to "
                "lens; need films no thicker than the gap"
            )

    @property
    def wavenumber(self) -> float:
        """k = 2π/λ in rad/um."""
        return 2 * np.pi / self.wavelength_um

    @property
    def media(self) -> Media:
        """Media from lens to sensor; one medium of index 1 without films."""
        return self.behind or Media((1.0,), (self.sensor_distance_um,))

    @property
    def steps_um(self) -> tuple[float, float]:
        """(y, x) distance of neighbouring rows and columns."""
        return self.row_um or self.pitch_um, self.pitch_um

    @property
    def area_um2(self) -> float:
        """Area of the cell of one pillar, the weight of its light in the sum."""
        return self.site_um2 or self.steps_um[0] * self.steps_um[1]

    @property
    def half_size_um(self) -> tuple[float, float]:
        """(y, x) distance from the axis to the outermost site, at least half a step."""
        y, x = (
            max(n - 1, 1) / 2 * step
            for n, step in zip(self.shape, self.steps_um, strict=True)
        )
        return y, x

    @property
    def half_window_um(self) -> tuple[float, float]:
        """(y, x) distance from the window centre to its outermost sample, at least a
        hundredth of a step.
        """
        y, x = (max(count - 1, 0.02) / 2 * self.step_um for count in self.samples)
        return y, x

    @property
    def reach_um(self) -> float:
        """Upper bound of the lateral distance between a site and a window sample."""
        parts = zip(
            self.centre_um[::-1], self.half_window_um, self.half_size_um, strict=True
        )
        sums = (abs(centre) + window + lens for centre, window, lens in parts)
        return math.hypot(*sums)

    @property
    def pillars_um(self) -> tuple[Array, Array]:
        """(y,), (x,) positions of the pillar rows and columns."""
        y, x = (
            axis_positions(n, step)
            for n, step in zip(self.shape, self.steps_um, strict=True)
        )
        return y, x

    @property
    def window_um(self) -> tuple[Array, Array]:
        """(y,), (x,) positions of the window samples from the window centre."""
        y, x = (axis_positions(count, self.step_um) for count in self.samples)
        return y, x


def axis_positions(count: int, step: float) -> Array:
    """(count,) positions about the centre of the row.

    Args:
        step: distance of neighbours.
    """
    return (np.arange(count) - (count - 1) / 2) * step


def window_tiles(case: PropagationCase, parts: int) -> list[list[PropagationCase]]:
    """Rows of tiles that cut the window into at most ``parts`` along each axis.

    Args:
        case: geometry of the propagation.
        parts: tiles along an axis with as many samples or more.
    """
    rows, columns = (
        np.array_split(axis + centre, min(parts, len(axis)))
        for axis, centre in zip(case.window_um, case.centre_um[::-1], strict=True)
    )
    return [
        [
            replace(
                case,
                centre_um=(float(x[0] + x[-1]) / 2, float(y[0] + y[-1]) / 2),
                samples=(len(y), len(x)),
            )
            for x in columns
        ]
        for y in rows
    ]


def check_aperture(phase_rad: Any, transmission: Any, case: PropagationCase) -> None:
    """Raise for maps of another shape, of no transmission, or with NaN or infinity.

    Args:
        phase_rad, transmission: (y, x) numpy arrays of float.
        case: whose shape they must have.

    Raises:
        PropagationError: naming row and column.
    """
    for name, array in (("phase_rad", phase_rad), ("transmission", transmission)):
        if array.shape != case.shape:
            raise PropagationError(
                f"{name} has shape {array.shape}, need {case.shape} (y, x)"
            )
    total = float(phase_rad.sum(dtype=float)) + float(transmission.sum(dtype=float))
    if not np.isfinite(total):  # NaN and infinity survive a sum
        invalid = ~np.isfinite(phase_rad) | ~np.isfinite(transmission)
        row, column = np.unravel_index(int(invalid.argmax()), case.shape)
        raise PropagationError(
            f"phase or transmission at row {row}, column {column} is not finite"
        )
    if not transmission.any():
        raise PropagationError(
            "empty aperture: transmission is 0 everywhere; check the aperture and the lens"
        )


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
    step_um, counts = window_of(window_um, samples)
    ax, ay = to_angle_pair(angle_rad)
    tangents = float(np.tan(ax)), float(np.tan(ay))
    depths = np.atleast_1d(np.asarray(depths_um, float))
    if depths.ndim != 1 or not (depths > 0).all() or np.shape(offset_um) != (2,):
        raise PropagationError(
            f"depths_um = {depths_um}, offset_um = {offset_um}: need source depths above "
            "0 (inf for a far source), and a pair (x, y)"
        )
    distance_um = float(sensor_distance_um)
    films = _films(layers, distance_um, float(wavelength_um))
    centre_um = [
        chief_ray_offset(films.get("behind"), distance_um, tangents, axis)
        + float(offset_um[axis])
        for axis in (0, 1)
    ]
    case = PropagationCase(
        shape=(int(shape[-2]), int(shape[-1])),
        pitch_um=float(pitch_um),
        wavelength_um=float(wavelength_um),
        sensor_distance_um=distance_um,
        tangents=tangents,
        inverse_depths_per_um=tuple((1 / depths).tolist()),
        centre_um=(centre_um[0], centre_um[1]),
        step_um=step_um,
        samples=counts,
        row_um=float(row_um),
        site_um2=float(site_um2),
        **films,
    )
    _check_rays(case)
    return case


def _films(
    layers: Layers | None, sensor_distance_um: float, wavelength_um: float
) -> dict[str, Any]:
    """Keywords ``front`` and ``behind`` of a case with films; empty without films.

    Raises:
        PropagationError: the layers have a stop.
    """
    if layers is not None and layers.stop is not None:
        raise PropagationError(
            "layers: a stop is no part of a propagation from the pillars on; put Layers.stop_share onto their transmission "
            "and give Layers.open (psf_stack does both)"
        )
    if layers is None or layers.plain or not sensor_distance_um > 0:
        return {}
    in_front = layers.before(math.inf, wavelength_um)
    pairs = zip(in_front.index[1:], in_front.thickness_um[1:], strict=True)
    front = tuple((n, t) for n, t in pairs if t > 0)
    return {"front": front, "behind": layers.after(sensor_distance_um, wavelength_um)}


def _check_rays(case: PropagationCase) -> None:
    """Raise for rays beyond the critical angle of the cover, if films fill the gap.

    The steepest ray runs from the rim of a round lens to the opposite window corner.
    """
    if case.behind is None or case.behind.thickness_um[0] > 0:
        return
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    lens_y, lens_x = case.half_size_um
    half_y, half_x = case.half_window_um
    x = np.abs(
        np.abs(case.centre_um[0]) + half_x + lens_x * np.cos(angles)
    )  # the rim of a round lens, the far corner
    y = np.abs(np.abs(case.centre_um[1]) + half_y + lens_y * np.sin(angles))
    steepest = float(media.ray_direction(case.behind, np.hypot(x, y).max()))
    cover_index = min(case.behind.order)
    if steepest >= cover_index:
        raise PropagationError(
            f"layers: the films fill the way from lens to sensor, and rays of n sin θ = {steepest:.3g} from the rim to "
            f"the window do not leave the cover of index {cover_index:g}: need a gap, a nearer window or a smaller angle"
        )


def window_of(window_um: Any, samples: Any) -> tuple[float, tuple[int, int]]:
    """Sampling step (um) and (y, x) samples of a window.

    Args:
        window_um: full width, or a pair (x, y).
        samples: cells along the width, or a pair (x, y).

    Raises:
        PropagationError: no number and no pair, parts of samples, or cells that are not
            square to 1e-6.
    """
    widths = np.ravel(np.asarray(window_um, float))
    counts = np.ravel(np.asarray(samples, float))
    if (
        widths.size not in (1, 2)
        or counts.size not in (1, 2)
        or (counts % 1 != 0).any()
    ):
        raise PropagationError(
            f"window_um = {window_um}, samples = {samples}: need a number or a pair (x, y) of each, samples whole"
        )
    width, height = np.resize(widths, 2).tolist()
    columns, rows = np.resize(counts.astype(int), 2).tolist()
    step = width / max(columns, 1)
    if abs(height / max(rows, 1) - step) > 1e-6 * abs(step):
        raise PropagationError(
            f"window of {width:g} x {height:g} um with {columns} x {rows} samples: cells of {step:g} x "
            f"{height / max(rows, 1):g} um; need square ones"
        )
    return step, (rows, columns)


def chief_ray_offset(
    behind: Media | None,
    sensor_distance_um: float,
    tangents: tuple[float, float],
    axis: int,
) -> float:
    """Lateral position of the chief ray on the sensor, along x (axis 0) or y (1), um.

    Args:
        behind: media from lens to sensor; None: air.
        sensor_distance_um: from lens to sensor.
        tangents: (x, y) of the field angle, in air.
    """
    if behind is None:
        return sensor_distance_um * tangents[axis]
    secant_squared = 1 + tangents[0] ** 2 + tangents[1] ** 2
    reach_per_p = media.reach_per_direction(behind.layers, 1 - 1 / secant_squared)
    return float(reach_per_p * tangents[axis] / math.sqrt(secant_squared))


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
