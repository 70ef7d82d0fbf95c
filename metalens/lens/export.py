"""A lens for other programs: arrays with axes (NPZ, MATLAB), and a smooth phase for ray
tracers (Zemax grid phase, Binary 2).
"""

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.core.store import write_bytes, write_text
from metalens.lens.record import Lens

ARRAYS, GRID, RADIAL = (".npz", ".mat"), ".dat", ".json"
SUFFIXES = (*ARRAYS, GRID, RADIAL)
TERMS = 8  # of a Binary 2 surface: r² to r¹⁶
# grid-phase file: mm per um (unit flag 0), and the flag of a point without data
_MM, _NO_DATA = 1e-3, 1
# points beyond the rim to which a phase is extended: a cubic spline then reads the rim
_RIM = 4


def check_export_format(path: str | Path) -> None:
    """Refuse a file name whose ending is no known format.

    Args:
        path: whose ending selects the format.

    Raises:
        LensError: naming the known formats.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise LensError(
            f"{path}: cannot write this format; name it {', '.join(SUFFIXES)}"
        )


def export_lens(path: str | Path, lens: Lens, *, samples: int = 501) -> float:
    """Write a lens in the format of the name's ending.

    ``.npz``, ``.mat``: x_um, y_um, diameter_um, phase_rad (wrapped), transmission,
    pitch_um, wavelength_um; where pillars are turned angle_rad; where they have two
    sizes length_um, phase and transmission for light along x. ``.dat``: Zemax grid
    phase of ``samples`` by ``samples`` points across the aperture, unwrapped, in mm.
    ``.json``: :func:`radial_phase`.

    Args:
        path: target; its ending selects the format.
        lens: the lens.
        samples: points of a grid phase along a side.

    Returns:
        Largest difference in phase (rad) between the pillars and what a program
            interpolates; 0 for the arrays.

    Raises:
        LensError: another ending, or a phase that no smooth map has (see
            :func:`unwrap_phase`).
    """
    check_export_format(path)
    suffix = Path(path).suffix.lower()
    if suffix == GRID:
        grid = grid_phase(lens, samples)
        write_bytes(path, grid.text().encode("ascii"))
        return grid.error_rad
    if suffix == RADIAL:
        surface = radial_phase(lens)
        write_text(path, json.dumps(surface, indent=1) + "\n")
        return float(surface["residual_rad"])
    values = lens_arrays(lens)
    file = io.BytesIO()
    head = b""
    if suffix == ".npz":
        np.savez_compressed(file, allow_pickle=False, **values)
    else:
        from scipy.io import savemat

        savemat(file, values, oned_as="column")
        head = b"MATLAB 5.0 MAT-file, um and rad".ljust(116)  # in place of the date
    write_bytes(path, head + file.getvalue()[len(head) :])
    return 0.0


def lens_arrays(lens: Lens) -> dict[str, Array]:
    """{name: array} of axes, diameters, wrapped phase and magnitude of every pillar, in
    um and rad.

    Args:
        lens: the lens.
    """
    d = lens.diameters
    return {
        "x_um": d.x_um,
        "y_um": d.y_um,
        "diameter_um": np.asarray(d.diameter_um),
        "phase_rad": np.mod(lens.phase_rad(), 2 * np.pi),
        "transmission": lens.transmission(),
        "pitch_um": np.array(d.pitch_um),
        "wavelength_um": np.array(lens.wavelength_um),
    } | {
        name: np.asarray(values)
        for name, values in (("angle_rad", d.angle_rad), ("length_um", d.length_um))
        if values is not None
    }


def radial_phase(lens: Lens) -> dict[str, Any]:
    """Binary 2 surface of OpticStudio: phase Σ A_i ρ^(2i), ρ = r / norm radius.

    Least squares over all pillars; a constant is left out.

    Args:
        lens: the lens, of one phase at any azimuth.

    Returns:
        wavelength, norm radius, coefficients A_1 to A_8 in rad (diffraction order 1),
            and ``residual_rad``, the largest difference of a pillar from the sum.

    Raises:
        LensError: pillars differ by more than a quarter wave from any such sum; see
            :func:`unwrap_phase`.
    """
    phase = unwrap_phase(lens)
    d = lens.diameters
    square = ((d.x_um**2 + d.y_um[:, None] ** 2) / d.radius_um**2)[np.isfinite(phase)]
    phase = phase[np.isfinite(phase)]
    fit = np.polynomial.Chebyshev.fit(square, phase, TERMS, domain=[0, 1])
    residual = float(np.abs(fit(square) - phase).max())
    if residual > math.pi / 2:
        raise LensError(
            f"pillars differ by {residual:.3g} rad from any radial polynomial of {TERMS} "
            "terms, need a quarter wave: write a grid phase (.dat)"
        )
    coefficients = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1]).coef
    return {
        "surface": "Binary 2",
        "wavelength_um": lens.wavelength_um,
        "norm_radius_mm": d.radius_um * _MM,
        "coefficients_rad": coefficients[1:].tolist(),
        "residual_rad": residual,
    }


@dataclass(frozen=True, eq=False, slots=True)
class GridPhase:
    """Phase on a square grid, +y down as everywhere here.

    phase_rad: (n, n), extended a few points beyond the lens, so that its rim can be
        interpolated; nan further out.
    step_um: spacing of the points.
    error_rad: largest difference between the pillars and the linear interpolation of
        the points.
    """

    phase_rad: Array
    step_um: float
    error_rad: float

    def text(self) -> str:
        """Text of the file: ``nx ny delx dely unitflag xdec ydec``, then ``phase dx dy
        dxy nodata`` per point, largest y first.

        Format: OpticStudio help, Grid Phase. Derivatives are 0 at all points: the
            program then takes differences.
        """
        n, step = len(self.phase_rad), repr(self.step_um * _MM)
        lines = [f"{n} {n} {step} {step} 0 0 0"]
        lines += [
            f"0 0 0 0 {_NO_DATA}" if math.isnan(value) else f"{value!r} 0 0 0 0"
            for value in self.phase_rad.ravel().tolist()
        ]
        return "\n".join(lines) + "\n"


def grid_phase(lens: Lens, samples: int = 501) -> GridPhase:
    """Unwrapped phase of a lens on ``samples`` by ``samples`` points across its
    aperture, and its interpolation error.

    The phase is interpolated linearly between pillars, and extrapolated beyond the rim
    by a parabola. The error compares it, interpolated back linearly, with the pillars.

    Args:
        lens: on a square lattice.
        samples: points along a side.

    Raises:
        LensError: fewer than 5 samples, or another lattice than a square one; see
            :func:`unwrap_phase`.
    """
    from scipy.ndimage import map_coordinates

    if lens.diameters.lattice.kind != "square":
        raise LensError(
            f"grid phase of a {lens.diameters.lattice.kind} lattice: need a square one; write .npz or .mat"
        )
    if samples < 5:
        raise LensError(f"{samples} samples across the aperture: need 5 or more")
    phase = unwrap_phase(lens)
    d = lens.diameters
    step = 2 * d.radius_um / (samples - 1)
    centre = [(n - 1) / 2 for n in phase.shape]
    offset = (np.arange(samples) - (samples - 1) / 2) * step / d.pitch_um
    sample_sites = np.meshgrid(offset + centre[0], offset + centre[1], indexing="ij")
    extended = _continued(phase, _RIM * step / d.pitch_um + 1)
    grid = map_coordinates(extended, sample_sites, order=1, cval=np.nan)
    if np.isfinite(grid).sum() < samples:
        raise LensError(
            f"{samples} samples find hardly a point with pillars all around; need a wider lens"
        )
    rows, columns = np.nonzero(np.isfinite(phase))
    pillar_points = [
        (site - middle) * d.pitch_um / step + (samples - 1) / 2
        for site, middle in zip((rows, columns), centre, strict=True)
    ]
    read_back = map_coordinates(grid, pillar_points, order=1, mode="nearest")
    error = np.abs(read_back - phase[rows, columns])
    return GridPhase(grid, step, float(np.nanmax(error, initial=0)))


def _continued(phase: Array, reach: float) -> Array:
    """Phase extended by up to ``reach`` sites beyond its data, by parabolas; nan
    elsewhere.

    A parabola runs through the closest site with data and two sites behind it: 3 a - 3
    b + c. Without the third site it is a line, without the second a constant.
    """
    from scipy.ndimage import distance_transform_edt

    distance, nearest = distance_transform_edt(np.isnan(phase), return_indices=True)
    sites = np.argwhere((distance > 0) & (distance <= reach))
    rim = nearest[:, sites[:, 0], sites[:, 1]].T
    first, second, third = (_at(phase, rim - k * (sites - rim)) for k in range(3))
    straight = np.where(np.isnan(second), first, 2 * first - second)
    out = phase.copy()
    out[sites[:, 0], sites[:, 1]] = np.where(
        np.isnan(second + third), straight, 3 * first - 3 * second + third
    )
    return out


def _at(grid: Array, places: Array) -> Array:
    """(n,) values of a grid at (n, 2) integer places; nan outside."""
    inside = ((places >= 0) & (places < grid.shape)).all(1)
    row, column = np.where(inside[:, None], places, 0).T
    return np.where(inside, grid[row, column], np.nan)


def unwrap_phase(lens: Lens) -> Array:
    """(y, x) phase that is continuous from pillar to pillar, rad; nan without a pillar,
    and 0 in the middle.

    Unwrapped along the middle column, then along every row to both sides. This is exact
    where neighbours differ by less than half a turn.

    Args:
        lens: the lens.

    Raises:
        LensError: gaps in the middle column, or neighbours that differ by half a turn
            after unwrapping: a vortex, a spiral or zones with steps have no smooth
            phase.
    """
    d = lens.diameters.diameter_um
    has_pillar = np.asarray(d) > 0
    phase = np.where(has_pillar, lens.phase_rad(), np.nan)
    middle = len(phase) // 2
    column = phase.shape[1] // 2
    column_rows = np.nonzero(has_pillar[:, column])[0]
    if (
        len(column_rows) == 0
        or len(column_rows) != column_rows[-1] - column_rows[0] + 1
        or column_rows[0] != np.nonzero(has_pillar.any(1))[0][0]
    ):
        raise LensError(
            "the middle column of the lens has gaps; its phase cannot be followed from row to row"
        )
    first, last = int(column_rows[0]), int(column_rows[-1]) + 1
    right = np.unwrap(phase[first:last, column:], axis=1)
    left = np.unwrap(phase[first:last, column::-1], axis=1)[:, ::-1]
    rows = np.concatenate([left[:, :-1], right], axis=1)
    unwrapped = np.full(phase.shape, np.nan)
    middle_phase = phase[first:last, column]
    unwrapped[first:last] = rows + (np.unwrap(middle_phase) - middle_phase)[:, None]
    jump = max(
        float(np.nanmax(np.abs(np.diff(unwrapped, axis=axis)), initial=0))
        for axis in (0, 1)
    )
    if jump > math.pi or (np.isnan(unwrapped) & has_pillar).any():
        raise LensError(
            f"neighbouring pillars differ by {jump:.3g} rad whichever way the phase is followed, need below pi: a "
            "vortex, a spiral or zones with steps have no smooth phase; write .npz or .mat"
        )
    return np.asarray(unwrapped - unwrapped[min(max(middle, first), last - 1), column])
