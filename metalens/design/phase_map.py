"""Phase maps made elsewhere: NumPy, text, MATLAB, and grid-phase files of Zemax
OpticStudio, sampled at the pillars.
"""

import math
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from metalens.design import limited
from metalens.design.profiles import PhaseMap
from metalens.ground import reading, store
from metalens.ground.arrays import Array
from metalens.ground.errors import LensError, StoreError, nearest

ZEMAX_UNIT_UM = (1e3, 1e4, 25.4e3, 1e6)  # unit flags 0 to 3: mm, cm, inch, m
CORE, MANY = (
    8,
    256,
)  # samples from a vortex to a ring that is fine enough; places in all of them
SAME_STEP = 1e-6  # relative difference within which two spacings are one


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """A phase map as it was read.

    phase_rad: (y, x), +x right, +y down; nan where the file says that there is no data.
    step_um: between samples along (x, y). centre_um: (x, y) of the middle of the map,
    seen from the lens axis.
    """

    phase_rad: Array
    step_um: tuple[float, float]
    centre_um: tuple[float, float] = (0.0, 0.0)


def read(shape: PhaseMap) -> Samples:
    """The file of a :class:`metalens.profiles.PhaseMap`, by the ending of its name.

    ``.npy``; ``.npz`` and ``.mat`` (MATLAB 4 to 7.3), the only matrix or the one named;
    ``.dat`` (Zemax grid phase,
    which brings its own spacing); anything else is text: rows of numbers parted by
    commas, or by
    semicolons, tabs or blanks with decimal commas.

    Raises:
        LensError: missing or unreadable file, no pitch, not 2-D, or a value that is not
            finite (row and column named).
    """
    path = shape.file
    if not path.is_file():
        raise LensError(
            f"{path}: {reading.absent(path)}; need a phase map (.npy, .npz, .csv, .mat or a Zemax grid phase .dat)"
        )
    ending = path.suffix.lower()
    if ending == ".dat":
        samples = _zemax(path, shape.pitch_um)
    else:
        if shape.pitch_um is None:
            raise LensError(
                f"{path}: a {ending or 'text'} file does not tell its spacing; give pitch_um"
            )
        reader = {".npy": _npy, ".npz": _npz, ".mat": _mat}.get(ending, _text)
        phase = _checked(reader(path, shape.variable), path)
        samples = Samples(phase, (shape.pitch_um, shape.pitch_um))
    return (
        Samples(-samples.phase_rad, samples.step_um, samples.centre_um)
        if shape.conjugate
        else samples
    )


def interpolate(
    samples: Samples, x_um: Array, y_um: Array, *, radius_um: float = math.inf
) -> Array:
    """Phase between the samples, (y, x), by bilinear interpolation of the phasor exp(i
    phase).

    About a vortex, whose phase goes through whole turns around a point however fine the
    map is, that of the nearest
    sample, up to CORE samples from it.

    Args:
        x_um: (x,) positions; y_um: (y,) positions, all inside the map.
        radius_um: of the aperture; outside it the map may have no data, or be too
            coarse.

    Raises:
        LensError: a position lies outside the map or where it has no data, or
            neighbouring samples differ by nearly
            half a turn, so that the phase between them is not known.
    """
    rows, columns = samples.phase_rad.shape
    (step_x, step_y), (x0, y0) = samples.step_um, samples.centre_um
    row, column = (
        (y_um - y0) / step_y + (rows - 1) / 2,
        (x_um - x0) / step_x + (columns - 1) / 2,
    )
    if (
        min(row.min(), column.min()) < -0.5
        or row.max() > rows - 0.5
        or column.max() > columns - 0.5
    ):
        raise LensError(
            f"the phase map covers {columns * step_x:.1f} x {rows * step_y:.1f} um about ({x0:.1f}, {y0:.1f}) um, "
            "less than the aperture"
        )
    between = _blend(_blend(np.exp(1j * samples.phase_rad), row).T, column).T
    inside = x_um**2 + y_um[:, None] ** 2 <= radius_um**2
    empty = np.isnan(between) & inside
    size = np.where(inside & ~empty, np.abs(between), 1.0)
    worst = np.unravel_index(int(np.where(empty, -1.0, size).argmin()), size.shape)
    place = f"near row {row[worst[0]]:.1f}, column {column[worst[1]]:.1f}"
    if empty.any():
        raise LensError(
            f"the phase map has no data {place}, inside the aperture; fill it or take a smaller aperture"
        )
    coarse = np.argwhere(size < 0.5)
    known = [
        _vortex(samples.phase_rad, float(row[i]), float(column[k]))
        for i, k in coarse[:MANY]
    ]
    if len(coarse) > MANY or None in known:
        raise LensError(
            f"the phase map turns by more than 2/3 of half a turn between samples {place}; "
            f"give it on a finer pitch than {max(step_x, step_y)} um"
        )
    found = np.angle(between)
    for (i, k), phase in zip(coarse, known, strict=True):
        found[i, k] = phase
    return np.asarray(found)


def _vortex(phase_rad: Array, row: float, column: float) -> float | None:
    """Phase of the sample nearest to a place, where a closed ring of samples around it
    is fine enough to tell that the
    phase turns about it; None where none does."""
    rows, columns = phase_rad.shape
    i, k = (
        min(max(math.floor(at), 0), n - 2) for at, n in ((row, rows), (column, columns))
    )
    for half in range(2, CORE + 1):
        if min(i, k) < half - 1 or i + half >= rows or k + half >= columns:
            return None
        block = phase_rad[i - half + 1 : i + half + 1, k - half + 1 : k + half + 1]
        ring = np.concatenate(
            [block[0, :-1], block[:-1, -1], block[-1, :0:-1], block[:0:-1, 0]]
        )
        steps = np.diff(ring, append=ring[:1]) / (2 * np.pi)
        steps = steps - np.rint(steps)
        if (
            np.abs(steps).max() < 1 / 3 and abs(steps.sum()) > 0.5
        ):  # nan compares as neither
            return float(phase_rad[round(row), round(column)])
    return None


def _blend(samples: Array, position: Array) -> Array:
    """Linear interpolation along the first axis; positions beyond the ends take the end
    sample.
    """
    low = np.clip(np.floor(position).astype(int), 0, len(samples) - 2)
    weight = np.clip(position - low, 0, 1)[:, None]
    return np.asarray(samples[low] * (1 - weight) + samples[low + 1] * weight)


def _checked(values: Any, path: Path) -> Array:
    phase = np.asarray(values)
    if phase.dtype.kind == "c":
        raise LensError(
            f"{path}: holds complex numbers, need real (y, x) radians: save the angle of them"
        )
    if phase.ndim != 2 or min(phase.shape) < 2 or phase.dtype.kind not in "fiu":
        raise LensError(
            f"{path}: holds {phase.dtype} of shape {phase.shape}, need real (y, x) of 2 by 2 or more"
        )
    if not np.isfinite(phase).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(phase))[0])
        raise LensError(
            f"{path}: phase at row {row}, column {column} is {phase[row, column]}, need finite radians"
        )
    return np.asarray(phase, float)


def _npy(path: Path, variable: str | None) -> Any:
    _no_variable(path, variable)
    try:
        # mapped, so that a header that claims more than the file holds is refused
        # before memory is taken
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except (
        *store.DAMAGE,
        EOFError,
        SyntaxError,
        RecursionError,
        tokenize.TokenError,
    ) as error:
        raise LensError(f"{path}: not a phase map: {error}") from error


def _text(path: Path, variable: str | None) -> Any:
    _no_variable(path, variable)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        first = next(
            (
                line
                for line in lines
                if line.strip() and not line.lstrip().startswith("#")
            ),
            "",
        )
        if not first:
            raise LensError(f"{path}: not a phase map: it holds no numbers")
        mark, decimal = reading.parting(first)
        return np.loadtxt(
            [line.replace(",", ".") for line in lines] if decimal else lines,
            delimiter=mark,
            ndmin=2,
        )
    except ValueError as error:
        raise LensError(f"{path}: not a phase map: {error}") from error


def _no_variable(path: Path, variable: str | None) -> None:
    if variable is not None:
        raise LensError(
            f"{path}: variable = {variable!r} is for .mat and .npz files; this one holds a single array"
        )


def _mat(path: Path, variable: str | None) -> Any:
    """A matrix of a MATLAB file; the only 2-D one where no name is given."""
    import h5py

    return _named(
        path, _mat73(path) if h5py.is_hdf5(path) else _held(path, "MATLAB"), variable
    )


def _npz(path: Path, variable: str | None) -> Any:
    """A matrix of a NumPy archive, chosen as in a MATLAB file."""
    return _named(path, _held(path, "NPZ"), variable)


def _named(path: Path, held: dict[str, Any], variable: str | None) -> Any:
    """The matrix of that name; without one the only matrix."""
    arrays = {
        k: v
        for k, v in held.items()
        if isinstance(v, np.ndarray) and v.ndim == 2 and min(v.shape) > 1
    }
    if variable is not None:
        if variable not in held:
            raise LensError(
                f"{path}: holds no variable {variable!r}{nearest(variable, held)}"
            )
        return held[variable]
    if len(arrays) != 1:
        raise LensError(
            f"{path}: holds {len(arrays)} matrices ({', '.join(sorted(arrays))}); name one: variable = ..."
        )
    return next(iter(arrays.values()))


def _held(path: Path, kind: Literal["MATLAB", "NPZ"]) -> dict[str, Any]:
    try:
        return dict(limited.arrays(path, kind))
    except StoreError as error:
        raise LensError(str(error)) from None


def _mat73(path: Path) -> dict[str, Any]:
    """Matrices at the top of an HDF5 file of MATLAB, which keeps columns first."""
    try:
        return reading.survived(path, lambda file: _matrices(path, file))
    except StoreError as error:
        raise LensError(str(error)) from None
    except store.DAMAGE as error:
        raise LensError(f"{path}: not a MATLAB file: {error}") from error


def _matrices(path: Path, file: Any) -> dict[str, Any]:
    import h5py

    inside = [
        k for k in file if isinstance(file.get(k, getlink=True), h5py.HardLink)
    ]  # links may leave the file
    held = {k: file[k] for k in inside if isinstance(file[k], h5py.Dataset)}
    for name, item in held.items():
        store.check_claim(path, item, name)
    return {k: v[...].T for k, v in held.items()}


def _zemax(path: Path, pitch_um: float | None) -> Samples:
    """A grid-phase file: ``nx ny delx dely unitflag xdec ydec``, then ``phase dx dy dxy
    [nodata]`` a point.

    Points run from the corner of least x and largest y along x, then down in y
    (OpticStudio help, Grid Sag and Grid
    Phase); phases are radians whatever the unit. Their derivatives are not used. +y of
    the file points up, ours down.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise LensError(
            f"{path}: not a text file; a binary .dat of an interferometer is no grid phase"
        ) from error
    rows = [
        (i, line.split())
        for i, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith("!")
    ]
    if not rows:
        raise LensError(f"{path}: empty; need a Zemax grid phase")
    columns, count, step, centre = _zemax_head(path, rows[0][1])
    if len(rows) - 1 != columns * count:
        raise LensError(
            f"{path}: {len(rows) - 1} points for a grid of {columns} x {count} = {columns * count}"
        )
    phase = np.array(
        [_zemax_point(path, number, words) for number, words in rows[1:]]
    ).reshape(count, columns)
    if pitch_um is not None and max(abs(s / pitch_um - 1) for s in step) > SAME_STEP:
        raise LensError(
            f"{path}: spacing of {step[0]} x {step[1]} um, but pitch_um = {pitch_um}; leave pitch_um out"
        )
    return Samples(phase, step, centre)


def _zemax_head(
    path: Path, words: list[str]
) -> tuple[int, int, tuple[float, float], tuple[float, float]]:
    try:
        columns, rows, unit = int(words[0]), int(words[1]), ZEMAX_UNIT_UM[int(words[4])]
        step_x, step_y = abs(float(words[2])) * unit, abs(float(words[3])) * unit
        right, up = (
            (float(w) * unit for w in words[5:7]) if len(words) >= 7 else (0.0, 0.0)
        )
    except (ValueError, IndexError):
        raise LensError(
            f"{path}: first line is {' '.join(words)[:60]!r}, need nx ny delx dely unitflag xdec ydec (unitflag 0 to 3)"
        ) from None
    if min(columns, rows) < 2 or not (
        0 < step_x < math.inf and 0 < step_y < math.inf and math.isfinite(right + up)
    ):
        raise LensError(
            f"{path}: grid of {columns} x {rows} points, {step_x} x {step_y} um apart: need 2 or more"
        )
    return columns, rows, (step_x, step_y), (right, -up)


def _zemax_point(path: Path, number: int, words: list[str]) -> float:
    try:
        value = float(words[0])
        missing = len(words) > 4 and int(words[4]) == 1
    except ValueError:
        raise LensError(
            f"{path}: line {number} is {' '.join(words)[:60]!r}, need phase and derivatives"
        ) from None
    if missing:
        return math.nan
    if not math.isfinite(value):
        raise LensError(
            f"{path}: line {number}: phase is {value}, need finite radians, or a nodata flag of 1"
        )
    return value
