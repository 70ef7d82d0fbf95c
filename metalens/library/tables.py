"""Unit-cell tables of other solvers (Lumerical, COMSOL, CST, Meep) as pillar libraries."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library.proxy import MOST_ERROR
from metalens.library.record import PillarLibrary, Sweep

LIGHT_UM_THZ = 299.792458  # speed of light: wavelength in um times frequency in THz
LENGTHS = {"nm": 1e-3, "um": 1.0, "mm": 1e3, "m": 1e6}
FREQUENCIES = {"thz": 1.0, "ghz": 1e-3, "hz": 1e-12}
ANGLES = {"deg": math.pi / 180, "degrees": math.pi / 180, "rad": 1.0}
PHASES = ANGLES | {"turns": 2 * math.pi, "waves": 2 * math.pi, "cycles": 2 * math.pi}
KINDS = {  # quantity: names of its column, without unit
    "diameter": ("diameter", "d", "size", "width"),
    "radius": ("radius", "r"),
    "wavelength": ("wavelength", "lambda", "wl"),
    "frequency": ("frequency", "freq", "f"),
    "angle": ("angle", "theta", "incidence", "angle_of_incidence"),
    "phase": ("phase", "phi", "arg_t", "s21_phase", "arg_s21", "phase_t"),
    "power": ("transmission", "transmittance", "t", "power"),
    "amplitude": ("amplitude", "abs_t", "t_abs", "abs_s21", "s21_abs", "s21"),
    "real": ("re_t", "t_re", "t_real", "real_t", "re_s21", "s21_re", "s21_real"),
    "imaginary": ("im_t", "t_im", "t_imag", "imag_t", "im_s21", "s21_im", "s21_imag"),
    "error": ("t_error", "error", "sigma"),
}
LEAST_SIZES = 12  # that a smooth proxy needs


@dataclass(frozen=True, slots=True)
class _Column:
    kind: str
    scale: float
    values: Array


def from_table(
    table: str | Path | Mapping[str, Any],
    cell: Cell,
    *,
    columns: Sequence[str] = (),
    wavelength_um: float | None = None,
) -> PillarLibrary:
    """Pillar library from a unit-cell table: complex t over size, wavelength and angle.

    t is turned to the convention of this package: time factor exp(-iωt), so that the
    phase rises with the size, and |t|² is a share of power. The notes of the library
    say what was recognised.

    Args:
        table: CSV, TSV, NPZ or MAT file, or a mapping {column: (n,) array}; a row for
            each entry. Names carry units: ``diameter_nm``, ``Wavelength (um)``,
            ``phase (deg)``, ``angle_deg``. Needed: a size (``diameter``, ``radius``)
            and either ``phase`` with ``transmission`` (power) or ``amplitude``, or
            ``t_re`` with ``t_im`` (S21 likewise), or complex ``t`` of a mapping.
            ``t_error`` is the error bar of t.
        cell: the unit cell of which the table is.
        columns: names in place of the header of a file.
        wavelength_um: of a table without a wavelength column.

    Returns:
        A library with engine ``table``. Without ``t_error``, bars are the distance of
        each entry from a cubic through its neighbours (leaving one out).

    Raises:
        DomainError: an unknown or missing column or unit, values that are not finite,
            entries missing from the grid, |t|² above 1, or fewer than 12 sizes.

    Example:
        >>> import numpy as np
        >>> from metalens.cell import Cell
        >>> from metalens.library import from_table
        >>> d = np.linspace(80, 200, 25)
        >>> arrays = {"diameter_nm": d, "phase_deg": 3.0 * d, "transmission": 0.9 + 0 * d}
        >>> library = from_table(arrays, Cell(0.3), wavelength_um=0.85)
        >>> round(float(abs(library.t[0, 0, 0, 3])), 4)
        0.9487
    """
    where = "the table" if isinstance(table, Mapping) else str(table)
    raw_columns = table if isinstance(table, Mapping) else _read(Path(table), columns)
    quantities = _recognise(raw_columns, where)
    t, notes = _amplitudes(quantities, where)
    size_um = _sizes(quantities, where)
    wavelengths_um = _wavelengths(quantities, wavelength_um, len(size_um), where)
    angles_rad = (
        quantities["angle"].values if "angle" in quantities else np.zeros(len(size_um))
    )
    error = (
        quantities["error"].values if "error" in quantities else np.full(len(t), np.nan)
    )
    axes, rows = _grid(angles_rad, wavelengths_um, size_um, where)
    t, error = t[rows], error[rows]
    t, conjugated = _with_rising_phase(t)
    notes.append(
        "phase fell with the size: conjugated to exp(-iwt)"
        if conjugated
        else "phase rises with the size, as of exp(-iwt)"
    )
    if "error" in quantities:
        notes.append("error bars from their column")
    else:
        error = _left_out_errors(axes[2], t)
        notes.append("error bars from a cubic that leaves each entry out")
    return _library(cell, axes, t, np.maximum(error, 0.0), tuple(notes))


def _library(
    cell: Cell,
    axes: tuple[Array, Array, Array],
    t: Array,
    error: Array,
    notes: tuple[str, ...],
) -> PillarLibrary:
    """Library of engine ``table`` from gridded entries.

    Args:
        cell: of which the table is.
        axes: angles (rad), wavelengths (um) and sizes (um).
        t: (angle, wavelength, size) complex amplitudes.
        error: error bars, as t.
        notes: what was recognised, in words.
    """
    angles, wavelengths, sizes = axes
    polarizations = ("x",) if len(angles) == 1 and angles[0] == 0 else ("s", "p")
    entries = np.broadcast_to(t, (len(polarizations), *t.shape)).copy()
    sweep = Sweep(
        wavelengths_um=tuple(map(float, wavelengths)),
        angles_deg=tuple(map(float, np.degrees(angles))),
        diameters_um=(float(sizes[0]), float(sizes[-1])),
        samples=max(20, len(sizes)),
        tolerance=float(np.clip(error.max(), 1e-8, MOST_ERROR)),
    )
    return PillarLibrary(
        cell,
        sweep,
        polarizations,
        angles,
        wavelengths,
        sizes,
        entries,
        np.zeros_like(entries),
        np.broadcast_to(error, entries.shape).copy(),
        np.ones(entries.shape),
        np.zeros((0, 5)),
        "table",
        0,
        notes=notes,
    )


def _read(path: Path, columns: Sequence[str]) -> dict[str, Any]:
    """{column: (n,) values} of a CSV, TSV, NPZ or MAT file.

    Args:
        path: of the file.
        columns: names in place of the header of a text file.

    Raises:
        DomainError: not readable, empty, or rows that are not numbers.
    """
    try:
        if path.suffix.lower() == ".npz":
            with np.load(path, allow_pickle=False) as content:
                return {name: np.ravel(content[name]) for name in content.files}
        if path.suffix.lower() == ".mat":
            from scipy.io import loadmat

            content = loadmat(path)
            return {
                k: np.ravel(v) for k, v in content.items() if not k.startswith("__")
            }
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError, NotImplementedError) as error:
        raise DomainError(
            f"{path}: not read ({error}); give CSV, TSV, NPZ or MAT of version 5"
        ) from None
    lines = [ln for ln in text.splitlines() if ln.strip() and ln[0] not in "#%"]
    if not lines:
        raise DomainError(f"{path}: empty; need a header and a row for each entry")
    separator = next((m for m in "\t;," if m in lines[0]), None)
    if separator in (";", "\t"):
        lines = [line.replace(",", ".") for line in lines]
    rows = (
        [ln.split() for ln in lines]
        if separator is None
        else [*csv.reader(lines, delimiter=separator)]
    )
    header = list(columns) or rows.pop(0)
    try:
        body = np.array([[float(field) for field in row] for row in rows])
    except ValueError:
        bad = next(i for i, row in enumerate(rows) if not _numbers(row))
        raise DomainError(
            f"{path}, row {bad + 1}: {rows[bad]} is not numbers; --columns names the "
            "columns of a file without a header"
        ) from None
    if body.ndim != 2 or body.shape[1] != len(header):
        raise DomainError(
            f"{path}: rows do not match the {len(header)} columns {header}"
        )
    return dict(zip(header, body.T, strict=True))


def _numbers(row: list[str]) -> bool:
    """Whether every field of a row is a number."""
    try:
        list(map(float, row))
    except ValueError:
        return False
    return True


def _recognise(raw_columns: Mapping[str, Any], where: str) -> dict[str, _Column]:
    """{quantity: column} of a table, in um, rad and fractions.

    Args:
        raw_columns: {name: values}.
        where: names the table in errors.

    Raises:
        DomainError: an unknown or repeated column, unequal lengths, or values that are
            not finite.
    """
    quantities: dict[str, _Column] = {}
    for name, content in raw_columns.items():
        kind, unit = _quantity(str(name))
        values = np.ravel(np.asarray(content))
        if kind == "power" and np.iscomplexobj(values):
            kind = "complex"
        if not kind:
            raise DomainError(
                f"{where}: column {name!r} is unknown; known are "
                f"{', '.join(n[0] for n in KINDS.values())} with a unit (diameter_nm)"
            )
        if kind in quantities:
            raise DomainError(f"{where}: two columns of {kind}")
        quantities[kind] = _Column(
            kind, *_scaled(kind, unit, values, f"{where}: {name!r}")
        )
    lengths = {len(column.values) for column in quantities.values()}
    if len(lengths) != 1:
        raise DomainError(f"{where}: columns of different lengths {sorted(lengths)}")
    for kind, column in quantities.items():
        if not np.isfinite(column.values).all():
            raise DomainError(f"{where}: {kind} holds values that are not finite")
    return quantities


def _quantity(name: str) -> tuple[str, str]:
    """(kind, unit) of a column's name, as ("diameter", "nm") of "Diameter (nm)"; the
    kind is empty where it is not known.
    """
    plain = name.strip().lower().replace("μ", "u").replace("µ", "u").replace("°", "deg")
    plain = re.sub(r"\|t\|(\^2|²)", "transmission", plain).replace("|t|", "abs_t")
    plain = re.sub(r"[^\w]+", "_", plain).strip("_")
    stem, _, last = plain.rpartition("_")
    units = {*LENGTHS, *FREQUENCIES, *PHASES}
    for candidate, unit in ((plain, ""), (stem, last if last in units else "-")):
        for kind, names in KINDS.items():
            if candidate in names and unit != "-":
                return kind, unit
    return "", ""


def _scaled(kind: str, unit: str, values: Array, where: str) -> tuple[float, Array]:
    """(scale, scaled values) of a column in um, THz or rad; scale 1 for quantities
    without a unit.

    Raises:
        DomainError: no unit that this kind has.
    """
    units: dict[str, dict[str, float]] = {
        "diameter": LENGTHS,
        "radius": LENGTHS,
        "wavelength": LENGTHS,
        "frequency": FREQUENCIES,
        "angle": ANGLES,
        "phase": PHASES,
    }
    if kind not in units:
        return 1.0, values
    if unit not in units[kind]:
        raise DomainError(
            f"{where} states no unit; name the column {kind}_UNIT, of "
            f"{', '.join(units[kind])}"
        )
    return units[kind][unit], values * units[kind][unit]


def _amplitudes(quantities: dict[str, _Column], where: str) -> tuple[Array, list[str]]:
    """(n,) complex t of the rows, and a note on how it was stated.

    Args:
        quantities: {quantity: column}.
        where: names the table in errors.

    Raises:
        DomainError: missing columns, or |t| above 1.
    """
    if "complex" in quantities:
        t = quantities["complex"].values.astype(complex)
        notes = ["complex t"]
    elif {"real", "imaginary"} <= quantities.keys():
        t = quantities["real"].values + 1j * quantities["imaginary"].values
        notes = ["t from its real and imaginary part"]
    elif "phase" in quantities and ("power" in quantities or "amplitude" in quantities):
        by_power = "power" in quantities
        level = quantities["power" if by_power else "amplitude"].values
        if level.min() < 0:
            raise DomainError(f"{where}: transmission {level.min():g} is below 0")
        level = np.sqrt(level) if by_power else level
        t = level * np.exp(1j * quantities["phase"].values)
        notes = [f"|t| from {'a share of power' if by_power else 'an amplitude'}"]
    else:
        raise DomainError(
            f"{where}: columns of {', '.join(sorted(quantities))}; need phase with "
            "transmission or amplitude, or t_re with t_im"
        )
    peak = float(np.abs(t).max())
    if peak > 1.001:
        raise DomainError(
            f"{where}: |t| reaches {peak:.4g}; t is normalised to power, so that |t|² "
            "is the share that passes (n_cover cos / n_substrate cos times |E|²)"
        )
    return t / max(1.0, peak), notes


def _sizes(quantities: dict[str, _Column], where: str) -> Array:
    """(n,) sizes of the rows, um: diameters, or twice the radii."""
    if "diameter" in quantities:
        return np.asarray(quantities["diameter"].values)
    if "radius" in quantities:
        return np.asarray(2 * quantities["radius"].values)
    raise DomainError(f"{where}: no column of the size; need diameter_nm or radius_nm")


def _wavelengths(
    quantities: dict[str, _Column], stated_um: float | None, rows: int, where: str
) -> Array:
    """(n,) wavelengths of the rows, um: their column, 299.79 um THz / frequency, or the
    stated one.
    """
    if "wavelength" in quantities:
        return np.asarray(quantities["wavelength"].values)
    if "frequency" in quantities:
        return np.asarray(LIGHT_UM_THZ / quantities["frequency"].values)
    if stated_um is None:
        raise DomainError(
            f"{where}: no column of the wavelength; state it (wavelength_um)"
        )
    return np.full(rows, float(stated_um))


def _grid(
    angles: Array, wavelengths: Array, sizes: Array, where: str
) -> tuple[tuple[Array, Array, Array], Array]:
    """Axes (angle, wavelength, size) of the table, and the (angle, wavelength, size)
    array of row numbers.

    Args:
        angles: (n,) rad of the rows.
        wavelengths: (n,) wavelengths, um.
        sizes: (n,) um.
        where: names the table in errors.

    Raises:
        DomainError: under 12 sizes, or entries that are missing or repeated.
    """
    axes = tuple(np.unique(np.round(v, 9)) for v in (angles, wavelengths, sizes))
    shape = tuple(map(len, axes))
    if shape[2] < LEAST_SIZES:
        raise DomainError(f"{where}: {shape[2]} sizes; need {LEAST_SIZES} at least")
    row_of = np.full(shape, -1)
    positions = tuple(
        np.searchsorted(axis, np.round(v, 9))
        for axis, v in zip(axes, (angles, wavelengths, sizes), strict=True)
    )
    row_of[positions] = np.arange(len(sizes))
    if (row_of < 0).any():
        a, w, s = np.argwhere(row_of < 0)[0]
        raise DomainError(
            f"{where}: {int((row_of < 0).sum())} entries are missing, the first at "
            f"{math.degrees(axes[0][a]):g} deg, {axes[1][w]:g} um, size {axes[2][s]:g} um"
        )
    if len(sizes) > row_of.size:
        raise DomainError(f"{where}: {len(sizes) - row_of.size} entries stand twice")
    return (axes[0], axes[1], axes[2]), row_of


def _with_rising_phase(t: Array) -> tuple[Array, bool]:
    """t, conjugated where its phase falls with the size (median over wavelengths and
    angles), and whether it was.
    """
    phase = np.unwrap(np.angle(t), axis=-1)
    falls = float(np.median(phase[..., -1] - phase[..., 0])) < 0
    return (t.conj() if falls else t), falls


def _left_out_errors(sizes: Array, t: Array) -> Array:
    """Error bars from interpolation: distance of each entry from a cubic spline through
    the entries of the other parity of place.

    Args:
        sizes: (n,) um.
        t: (angle, wavelength, n) complex amplitudes.
    """
    error = np.empty(t.shape)
    index = np.arange(len(sizes))
    for parity in (0, 1):
        tested = index[index % 2 == parity]
        others = index[index % 2 != parity]
        spline = CubicSpline(sizes[others], t[..., others], axis=-1)
        error[..., tested] = np.abs(spline(sizes[tested]) - t[..., tested])
    return error
