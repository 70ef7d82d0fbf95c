"""Phase maps of other programs (NumPy, text, MATLAB, Zemax grid phase)."""

import math
import re
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from metalens.core import reading, store
from metalens.core.arrays import Array
from metalens.core.errors import LensError, nearest_name_hint
from metalens.core.foreign_arrays import read_matlab, read_npz
from metalens.design.profiles import PhaseMap

ZEMAX_UNIT_UM = (1e3, 1e4, 25.4e3, 1e6)  # unit flags 0 to 3: mm, cm, inch, m
CORE = 8  # samples, largest half width of a spot around a vortex
_COMMENT = re.compile(r"\s*(#|%|//)")
SAME_STEP = 1e-6  # relative difference at which two spacings still agree
EVEN_STEP = 1e-3  # of a step: tolerance of printed coordinates of an even grid
PERIODS = {  # value of a full turn in other units: the setting that states it
    360.0: "degrees: unit = 'deg'",
    256.0: "levels of 8 bits: levels = 256",
    1.0: "waves: unit = 'waves'",
}


@dataclass(frozen=True, eq=False, slots=True)
class PhaseSamples:
    """A phase map in the sampling of its file.

    phase_rad: (y, x), +x right, +y down; nan without data.
    step_um: spacing of the samples along (x, y).
    centre_um: (x, y) of the middle of the map from the lens axis.
    """

    phase_rad: Array
    step_um: tuple[float, float]
    centre_um: tuple[float, float] = (0.0, 0.0)


def read_phase_map(shape: PhaseMap) -> PhaseSamples:
    """Phase map of a file in radians; by the ending of its name.

    ``.npy``; ``.npz`` and ``.mat`` (MATLAB 5 to 7.3), the only matrix or the named one;
    ``.dat`` (Zemax grid phase, with its own spacing); anything else is text. Text is a
    matrix of numbers, or three columns x (um), y (um, down) and phase. Columns are
    separated by commas, or by semicolons, tabs or blanks with decimal commas; lines
    after #, % or // are comments. A first row or column that counts (0, 1, 2 ... of a
    table) is no phase.

    Args:
        shape: file, spacing and unit.

    Returns:
        Phase in radians with nan where there is no data.

    Raises:
        LensError: missing or unreadable file, no pitch, not 2-D, an infinite value, or
            values that look like another unit than radians and none is stated.
    """
    path = shape.file if isinstance(shape.file, Path) else Path("the array")
    if path is shape.file and not path.is_file():
        raise LensError(
            f"{path}: {reading.missing_reason(path)}; need a phase map (.npy, .npz, .csv, .mat or a Zemax grid phase .dat)"
        )
    ending = path.suffix.lower()
    if path is not shape.file:
        samples = _square(shape.file, path, shape)
    elif ending == ".dat":
        samples = _zemax(path, shape)
    elif ending == ".npy":
        samples = _square(_npy(path, shape.variable), path, shape)
    elif ending in (".npz", ".mat"):
        _require_pitch(path, shape)
        arrays = read_npz(path) if ending == ".npz" else read_matlab(path)
        samples = _square(_named(path, arrays, shape.variable), path, shape)
    else:
        samples = _text(path, shape)
    phase = samples.phase_rad if ending == ".dat" else _radians(samples, path, shape)
    phase = -phase if shape.conjugate else phase
    return PhaseSamples(phase, samples.step_um, samples.centre_um)


def _require_pitch(path: Path, shape: PhaseMap) -> tuple[float, float]:
    """Stated spacing along x and y, um."""
    if shape.pitch_um is None:
        raise LensError(
            f"{path}: a {path.suffix.lower() or 'text'} file does not tell its spacing; give pitch_um"
        )
    x, y = np.broadcast_to(shape.pitch_um, 2).tolist()
    return x, y


def _square(values: Any, path: Path, shape: PhaseMap) -> PhaseSamples:
    """Samples of a matrix with the stated spacing along x and y."""
    steps = _require_pitch(path, shape)
    return PhaseSamples(_checked(values, path, shape), steps)


def _radians(samples: PhaseSamples, path: Path, shape: PhaseMap) -> Array:
    """Values of a file in radians, by the stated unit.

    Raises:
        LensError: no unit is stated and the values look like another one.
    """
    values = samples.phase_rad
    if shape.levels is not None:
        return values * (2 * np.pi / shape.levels)
    if shape.unit is None:
        _refuse_other_unit(values, path)
    scale = {None: 1.0, "rad": 1.0, "deg": np.pi / 180, "waves": 2 * np.pi}
    return values * scale[shape.unit]


def _refuse_other_unit(values: Array, path: Path) -> None:
    """Refuse samples that look like another unit than radians.

    These are whole numbers throughout, or a phase that wraps by 360, 256 or 1. A wrap
    means: span within 10 % below the period, one step above 3/4 of the span, and a
    median step below 1/4.

    Args:
        values: (y, x) samples of the file.
        path: of the file, for messages.

    Raises:
        LensError: with the setting that states the unit.
    """
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    if high > low and (finite == np.rint(finite)).all():
        raise LensError(
            f"{path}: holds whole numbers from {low:g} to {high:g}, which are rarely "
            "radians; state levels = 256 (8 bits; phase = 2 pi value / levels) or "
            "unit = 'deg', 'waves' or 'rad'"
        )
    steps = np.concatenate(
        [np.abs(np.diff(values, axis=axis)).ravel() for axis in (0, 1)]
    )
    steps = steps[np.isfinite(steps)]
    span = high - low
    for period, words in PERIODS.items():
        wraps = 0.9 * period < span <= 1.001 * period
        if wraps and steps.max() > 0.75 * span and np.median(steps) < 0.25 * span:
            raise LensError(
                f"{path}: the phase wraps by {span:.4g}, as in {words}; state that, or "
                "unit = 'rad'"
            )


def interpolate_phase(
    samples: PhaseSamples, x_um: Array, y_um: Array, *, radius_um: float = math.inf
) -> Array:
    """Phase in rad at positions, (y, x): bilinear interpolation of the phasor exp(i
    phase).

    Around a vortex the phase passes whole turns however fine the map is. In round spots
    of up to 16 samples across, the phase of the nearest sample is taken.

    Args:
        samples: the phase map.
        x_um: (x,) positions, all inside the map.
        y_um: (y,) positions, all inside the map.
        radius_um: of the aperture; outside it the map may have no data, or be too
            coarse.

    Raises:
        LensError: a position lies outside the map or where it has no data, or
            neighbouring samples differ by nearly half a turn, so that the phase between
            them is not known.
    """
    rows, columns = samples.phase_rad.shape
    (step_x, step_y), (x0, y0) = samples.step_um, samples.centre_um
    row = (y_um - y0) / step_y + (rows - 1) / 2
    column = (x_um - x0) / step_x + (columns - 1) / 2
    if (
        min(row.min(), column.min()) < -0.5
        or row.max() > rows - 0.5
        or column.max() > columns - 0.5
    ):
        raise LensError(
            f"the phase map covers {columns * step_x:.1f} x {rows * step_y:.1f} um about ({x0:.1f}, {y0:.1f}) um, "
            "less than the aperture"
        )
    phasor, data_weight = _interpolated_phasor(samples.phase_rad, row, column)
    radius2 = x_um**2 + y_um[:, None] ** 2
    inside = radius2 <= radius_um**2
    nearest_row = np.clip(np.rint(row).astype(int), 0, rows - 1)
    nearest_column = np.clip(np.rint(column).astype(int), 0, columns - 1)
    nearest = samples.phase_rad[np.ix_(nearest_row, nearest_column)]
    no_data = np.isnan(nearest)
    at_rim = radius2 > max(radius_um - math.hypot(step_x, step_y), 0.0) ** 2
    empty = inside & (data_weight == 0) | inside & no_data & ~at_rim
    size = np.where(inside & ~empty, np.abs(phasor), 1.0)
    worst = np.unravel_index(int(np.where(empty, -1.0, size).argmin()), size.shape)
    place = f"near row {row[worst[0]]:.1f}, column {column[worst[1]]:.1f}"
    if empty.any():
        raise LensError(
            f"the phase map has no data {place}, inside the aperture; fill it or take a smaller aperture"
        )
    coarse = size < 0.5  # neighbours differ by over 2/3 of half a turn
    spots = ndimage.find_objects(ndimage.label(coarse, np.ones((3, 3)))[0])
    sides = [(np.ptp(row[a]), np.ptp(column[b])) for a, b in spots]
    if any(max(side) > 2 * CORE or max(side) - min(side) > CORE / 2 for side in sides):
        raise LensError(
            f"the phase map turns by more than 2/3 of half a turn between samples {place}; "
            f"give it on a finer pitch than {max(step_x, step_y)} um, or state the unit "
            "of its phase if that is not radians"
        )
    return np.where(coarse, nearest, np.angle(phasor))


def _interpolated_phasor(
    phase_rad: Array, row: Array, column: Array
) -> tuple[Array, Array]:
    """Bilinear mean of exp(i phase) over the samples with data, and their weight, (y,
    x).

    Args:
        phase_rad: (rows, columns) samples, nan without data.
        row: (y,) fractional rows.
        column: (x,) fractional columns.
    """
    finite = np.isfinite(phase_rad)
    phasor = np.where(finite, np.exp(1j * np.where(finite, phase_rad, 0.0)), 0.0)
    places = np.meshgrid(row, column, indexing="ij")
    total, weight = (
        ndimage.map_coordinates(values, places, order=1, mode="nearest")
        for values in (phasor, finite.astype(float))
    )
    return total / np.where(weight > 0, weight, 1.0), weight


def _checked(values: Any, path: Path, shape: PhaseMap) -> Array:
    """Samples of a phase map as (y, x) float64.

    Args:
        values: array of the file.
        path: of the file, for messages.
        shape: stated settings of the map.

    Raises:
        LensError: complex of several magnitudes, not 2-D, smaller than 2 by 2, infinite values, no finite
            value, or a value above the stated ``levels``.
    """
    phase = np.asarray(values)
    if phase.dtype.kind == "c":
        level = np.abs(phase[phase != 0])
        if (
            shape.unit
            or shape.levels
            or not level.max(initial=0) < 1.01 * level.min(initial=math.inf)
        ):
            raise LensError(
                f"{path}: holds complex numbers, of which pillars make the phase alone; "
                "need exp(i phase) of one magnitude, 0 where there is no data, no unit"
            )
        phase = np.where(phase == 0, np.nan, np.angle(phase))
    if phase.ndim != 2 or min(phase.shape) < 2 or phase.dtype.kind not in "fiu":
        raise LensError(
            f"{path}: holds {phase.dtype} of shape {phase.shape}, need real (y, x) of 2 by 2 or more"
        )
    if np.isinf(phase).any() or not np.isfinite(phase).any():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(phase))[0])
        raise LensError(
            f"{path}: phase at row {row}, column {column} is {phase[row, column]}, need numbers (nan where there is no data)"
        )
    if shape.levels is not None and np.nanmax(phase) > shape.levels:
        raise LensError(
            f"{path}: holds {np.nanmax(phase):g}, but levels = {shape.levels}"
        )
    return np.asarray(phase, float)


def _npy(path: Path, variable: str | None) -> Any:
    """The array of a .npy file, memory-mapped first.

    A header that claims more than the file holds is refused before memory is taken.
    """
    _no_variable(path, variable)
    try:
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except (
        *store.DAMAGE,
        EOFError,
        SyntaxError,
        RecursionError,
        tokenize.TokenError,
    ) as error:
        raise LensError(f"{path}: not a phase map: {error}") from error


def _text(path: Path, shape: PhaseMap) -> PhaseSamples:
    """A phase map of a text file: a matrix, or rows of x, y and phase.

    Args:
        path: of the file.
        shape: stated spacing and unit of the map.

    Raises:
        LensError: not text, fewer than two rows, or values that are no numbers.
    """
    _no_variable(path, shape.variable)
    try:
        lines = reading.read_text(path).splitlines()
    except UnicodeDecodeError as error:
        raise LensError(f"{path}: not a phase map: {error}") from error
    rows = [line for line in lines if line.strip() and not _COMMENT.match(line)]
    if len(rows) < 2:
        raise LensError(
            f"{path}: not a phase map: it holds {len(rows)} rows of numbers"
        )
    separator, decimal_comma = reading.column_separator(
        max(*rows[:2], rows[-1], key=len)
    )
    if decimal_comma:
        rows = [line.replace(",", ".") for line in rows]
    if separator and rows[0].startswith(
        separator
    ):  # the corner of a table with named rows
        rows[0] = "nan" + rows[0]
    header = _header(rows[0].split(separator))
    try:
        table = np.loadtxt(rows[1:] if header else rows, delimiter=separator, ndmin=2)
    except ValueError as error:
        raise LensError(
            f"{path}: not a phase map: {error}; need rows of numbers, or columns x, y "
            "and phase"
        ) from error
    if table.shape[1] == 3 and len(table) > 3 and _is_triple(header, table):
        return _gridded(path, table, header, shape)
    return _square(_without_counts(table), path, shape)


def _header(words: list[str]) -> list[str]:
    """Names of the columns of a table, where its first row holds such."""
    names = [word.strip().strip('"').strip() for word in words]
    return names if any(name and not _is_number(name) for name in names) else []


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _counts(values: Array) -> bool:
    """Whether numbers are 0, 1, 2 ... or 1, 2, 3 ..., three or more."""
    start = values[0] if values[0] in (0, 1) else 0
    return len(values) > 2 and bool((values == start + np.arange(len(values))).all())


def _without_counts(table: Array) -> Array:
    """A matrix without a leading row and column of counts (0, 1, 2 ...), as tables are
    saved.

    A table of whole numbers throughout is left as it is.
    """
    if len(table) > 2 and min(table.shape) > 2:
        body = table[1:, 1:]
        if (body == np.rint(body)).all():
            return table
        if _counts(table[0]) or (np.isnan(table[0, 0]) and _counts(table[0, 1:])):
            table = table[1:]
        if _counts(table[:, 0]):
            table = table[:, 1:]
    return table


def _is_triple(header: list[str], table: Array) -> bool:
    """Whether three columns are x, y and phase: by their names, or by a grid of x,
    y.
    """
    if header:
        return header[0][:1].lower() == "x" and header[1][:1].lower() == "y"
    x, y = np.unique(table[:, 0]), np.unique(table[:, 1])
    # a round aperture fills pi / 4 of its square
    return min(len(x), len(y)) > 1 and len(x) * len(y) <= 2 * len(table)


def _length_scale(name: str) -> float:
    """um in the unit that the name of a column ends in; um where it names none."""
    unit = re.search(r"(?<![a-zA-Z])_?(nm|mm|m)[)\]\s]*$", name)
    return {"nm": 1e-3, "mm": 1e3, "m": 1e6}[unit.group(1)] if unit else 1.0


def _gridded(
    path: Path, table: Array, header: list[str], shape: PhaseMap
) -> PhaseSamples:
    """Samples on an even grid from rows of x, y (down) and phase in any order.

    x and y are in um, or in the unit that their names end in: x (nm), x_mm.

    Args:
        path: of the file, for messages.
        table: (rows, 3) x, y and phase.
        header: names of the columns; empty for none.
        shape: stated spacing and unit.

    Raises:
        LensError: not one phase at every place of an even grid.
    """
    scales = [_length_scale(name) for name in header[:2]] or [1.0, 1.0]
    places = [np.unique(table[:, k], return_inverse=True) for k in (0, 1)]
    axes = [values * scale for (values, _), scale in zip(places, scales, strict=True)]
    for name, axis in zip("xy", axes, strict=True):
        if len(axis) < 2 or np.ptp(np.diff(axis)) > EVEN_STEP * np.diff(axis).mean():
            raise LensError(
                f"{path}: {len(axis)} values of {name}, not evenly spaced; need x, y and "
                "phase on an even grid, or a matrix of the phase"
            )
    x, y = axes
    column, row = (index.ravel() for _, index in places)
    if len(np.unique(row * len(x) + column)) < len(table):
        raise LensError(f"{path}: two rows have the same x and y; need one phase each")
    phase = np.full((len(y), len(x)), np.nan)
    phase[row, column] = table[:, 2]
    steps = float(np.ptp(x) / (len(x) - 1)), float(np.ptp(y) / (len(y) - 1))
    stated = shape.pitch_um
    if stated is not None and np.abs(np.divide(steps, stated) - 1).max() > EVEN_STEP:
        raise LensError(
            f"{path}: spacing of {steps[0]:g} x {steps[1]:g} um, but pitch_um = "
            f"{stated}; leave pitch_um out (x and y are um)"
        )
    centre = (float(x[0] + x[-1]) / 2, float(y[0] + y[-1]) / 2)
    return PhaseSamples(_checked(phase, path, shape), steps, centre)


def _no_variable(path: Path, variable: str | None) -> None:
    if variable is not None:
        raise LensError(
            f"{path}: variable = {variable!r} is for .mat and .npz files; this one holds a single array"
        )


def _named(path: Path, arrays: dict[str, Array], variable: str | None) -> Array:
    """The matrix of a name; without a name the only matrix.

    Args:
        path: of the file, for messages.
        arrays: arrays of the file by name.
        variable: name of the matrix; None for the only one.

    Raises:
        LensError: no such name, or not exactly one matrix.
    """
    if variable is not None:
        if variable not in arrays:
            raise LensError(
                f"{path}: holds no variable {variable!r}"
                f"{nearest_name_hint(variable, arrays)}"
            )
        return arrays[variable]
    arrays = {k: v for k, v in arrays.items() if v.ndim == 2 and min(v.shape) > 1}
    if len(arrays) != 1:
        raise LensError(
            f"{path}: holds {len(arrays)} matrices ({', '.join(sorted(arrays))}); name one: variable = ..."
        )
    return next(iter(arrays.values()))


def _zemax(path: Path, shape: PhaseMap) -> PhaseSamples:
    """Samples of a Zemax grid-phase file, rad.

    Head ``nx ny delx dely unitflag xdec ydec``, then ``phase dx dy dxy [nodata]`` for
    every point. Points run from the corner of least x and largest y along x, then down
    in y (OpticStudio help, Grid Sag and Grid Phase). Phases are radians in any unit of
    length; derivatives are not used. +y of the file points up, here down.

    Args:
        path: of the file.
        shape: stated settings; its spacing is compared with that of the file.

    Raises:
        LensError: not text, empty, damaged, or of another spacing than stated.
    """
    try:
        lines = reading.read_text(path).splitlines()
    except UnicodeDecodeError as error:
        raise LensError(
            f"{path}: not a text file; a binary .dat of an interferometer is no grid phase"
        ) from error
    rows = [line.split() for line in lines if not line.lstrip().startswith("!")]
    head, *points = [words for words in rows if words] or [[]]
    if not head:
        raise LensError(f"{path}: empty; need a Zemax grid phase")
    try:
        columns, count = int(head[0]), int(head[1])
        unit = ZEMAX_UNIT_UM[int(head[4])]
        step = abs(float(head[2])) * unit, abs(float(head[3])) * unit
        right, up = (float(w) * unit for w in [*head[5:7], "0", "0"][:2])
    except (ValueError, IndexError):
        raise LensError(
            f"{path}: first line is {' '.join(head)[:60]!r}, need nx ny delx dely unitflag xdec ydec (unitflag 0 to 3)"
        ) from None
    if min(columns, count) < 2 or not (
        0 < min(step) <= max(step) < math.inf and math.isfinite(right + up)
    ):
        raise LensError(
            f"{path}: grid of {columns} x {count} points, {step[0]} x {step[1]} um apart: need 2 or more"
        )
    if len(points) != columns * count:
        raise LensError(
            f"{path}: {len(points)} points for a grid of {columns} x {count} = {columns * count}"
        )
    try:
        phase = np.array(
            [math.nan if point[4:5] == ["1"] else float(point[0]) for point in points]
        )
    except ValueError as error:
        raise LensError(f"{path}: not a grid phase: {error}") from None
    stated = shape.pitch_um
    if stated is not None and np.abs(np.divide(step, stated) - 1).max() > SAME_STEP:
        raise LensError(
            f"{path}: spacing of {step[0]} x {step[1]} um, but pitch_um = {stated}; leave pitch_um out"
        )
    samples = _checked(phase.reshape(count, columns), path, shape)
    return PhaseSamples(samples, step, (right, -up))
