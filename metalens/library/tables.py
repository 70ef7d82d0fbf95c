"""Unit-cell tables of other solvers (Lumerical, COMSOL, CST, Meep) as pillar libraries."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.constants import c
from scipy.interpolate import CubicSpline

from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.core.foreign_arrays import read_matlab, read_npz
from metalens.core.reading import read_text
from metalens.core.units import deg, m, mm, nm, rad, um
from metalens.library.fit import LEAST_ENTRIES
from metalens.library.proxy import MOST_ERROR
from metalens.library.record import PillarLibrary, Sweep

LENGTHS = {"nm": nm, "um": um, "mm": mm, "m": m}
ANGLES = {"deg": deg, "degrees": deg, "rad": rad}
PHASES = ANGLES | dict.fromkeys(("turns", "waves", "cycles"), math.tau)
KINDS: tuple[tuple[str, dict[str, float], str], ...] = (
    # quantity; its units in um, THz or rad; names of its column without unit
    ("size", LENGTHS, "diameter d size width"),
    ("size", {unit: 2 * length for unit, length in LENGTHS.items()}, "radius r"),
    ("wavelength", LENGTHS, "wavelength lambda wl"),
    ("frequency", {"thz": 1.0, "ghz": 1e-3, "hz": 1e-12}, "frequency freq f"),
    ("angle", ANGLES, "angle theta incidence angle_of_incidence"),
    ("phase", PHASES, "phase phi arg_t s21_phase arg_s21 phase_t"),
    ("power", {}, "transmission transmittance t power"),
    ("amplitude", {}, "amplitude abs_t t_abs abs_s21 s21_abs s21"),
    ("real", {}, "re_t t_re t_real real_t re_s21 s21_re s21_real real_s21"),
    ("imaginary", {}, "im_t t_im t_imag imag_t im_s21 s21_im s21_imag imag_s21"),
    ("error", {}, "t_error error sigma"),
)
NAMES = {name: kind[:2] for kind in KINDS for name in kind[2].split()}


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
            ``phase (deg)``, ``S21 (dB)``. Needed: a size (``diameter``, ``radius``)
            and either ``phase`` with ``transmission`` (power) or ``amplitude``, or
            ``t_re`` with ``t_im``, or complex ``t``; S21 likewise. ``t_error`` is the
            error bar of t. Arrays of several axes (a sweep over size and wavelength)
            come with one (n,) array for each axis, all of different length. The header
            of a text file may be its last comment, as COMSOL writes it.
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
    if "size" not in quantities:
        raise DomainError(
            f"{where}: no column of the size; need diameter_nm or radius_nm"
        )
    t, notes = _amplitudes(quantities, where)
    if "frequency" in quantities:
        quantities["wavelength"] = 1e-6 * c / quantities["frequency"]  # THz
    elif wavelength_um is not None:
        quantities.setdefault("wavelength", np.full(len(t), wavelength_um))
    if "wavelength" not in quantities:
        raise DomainError(
            f"{where}: no column of the wavelength; state it (wavelength_um)"
        )
    quantities.setdefault("angle", np.zeros(len(t)))
    axes, rows = _grid(quantities, where)
    t = t[rows]
    phase = np.unwrap(np.angle(t), axis=-1)
    if np.median(phase[..., -1] - phase[..., 0]) < 0:  # over wavelengths and angles
        t = t.conj()
        notes.append("phase fell with the size: conjugated to exp(-iwt)")
    else:
        notes.append("phase rises with the size, as of exp(-iwt)")
    if "error" in quantities:
        error = quantities["error"][rows]
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
        DomainError, LensError: not readable, empty, or rows that are not numbers.
    """
    ending = path.suffix.lower()
    if ending in (".npz", ".mat"):
        return dict(read_npz(path) if ending == ".npz" else read_matlab(path))
    try:
        text = read_text(path)
    except (OSError, ValueError) as error:
        raise DomainError(f"{path}: not read ({error})") from None
    filled = [line for line in text.splitlines() if line.strip()]
    lines = [line for line in filled if line[0] not in "#%"]
    if not lines:
        raise DomainError(f"{path}: empty; need a header and a row for each entry")
    separator = next((mark for mark in "\t;," if mark in lines[0]), None)
    names = list(columns)
    if not names:
        has_header = re.search(r"[a-df-hj-z]", lines[0], re.IGNORECASE)
        comments = filled[: filled.index(lines[0])]
        header = lines.pop(0) if has_header or not comments else comments[-1]
        # a unit in brackets belongs to the name before it
        names = re.split(separator or r"\s+(?![(\[])", header.strip(" #%"))
    if separator in (";", "\t"):  # commas are decimal
        lines = [line.replace(",", ".") for line in lines]
    lines = [re.sub(r"(?<=[\d.])i\b", "j", line) for line in lines]
    try:
        body = np.loadtxt(
            lines, complex, delimiter=separator, ndmin=2, comments=None, quotechar='"'
        )
    except ValueError as error:
        raise DomainError(
            f"{path}: {error}; --columns names the columns of a file without a header"
        ) from None
    if body.shape[1] != len(names):
        raise DomainError(f"{path}: rows do not match the {len(names)} columns {names}")
    values = [column if column.imag.any() else column.real for column in body.T]
    return dict(zip((name.strip(' "') for name in names), values, strict=True))


def _recognise(raw_columns: Mapping[str, Any], where: str) -> dict[str, Array]:
    """{quantity: (n,) values} of a table, in um, THz, rad and fractions.

    Args:
        raw_columns: {name: values}.
        where: names the table in errors.

    Raises:
        DomainError: an unknown or repeated column, no known unit, unequal lengths, or
            values that are not finite.
    """
    quantities: dict[str, Array] = {}
    arrays = {k: np.squeeze(np.asarray(v)) for k, v in raw_columns.items()}
    shape = max((array.shape for array in arrays.values()), key=len, default=())
    for name, array in arrays.items():
        plain = _plain_name(str(name))
        stem, _, unit = plain.rpartition("_")
        if plain in NAMES:
            stem, unit = plain, ""
        quantity, units = NAMES.get(stem, ("", {}))
        if len(shape) > 1 and array.ndim == 1 and shape.count(len(array)) == 1:
            axis = shape.index(len(array))
            array = array.reshape([-1, *[1] * (len(shape) - 1 - axis)])
        values = np.ravel(np.broadcast_to(array, shape) if len(shape) > 1 else array)
        if quantity in ("power", "amplitude") and np.iscomplexobj(values):
            quantity = "complex"
        if unit == "db" and quantity in ("power", "amplitude"):
            values = 10 ** (values / (10 if quantity == "power" else 20))
            unit = ""
        if not quantity or (unit and not units):
            known = ", ".join(names.split()[0] for *_, names in KINDS)
            raise DomainError(
                f"{where}: column {name!r} is unknown; known are {known} with a unit "
                "(diameter_nm)"
            )
        if quantity in quantities:
            raise DomainError(f"{where}: two columns of {quantity}")
        if units and unit not in units:
            raise DomainError(
                f"{where}: {name!r} states no unit; name the column {stem}_UNIT, of "
                f"{', '.join(units)}"
            )
        if not np.isfinite(values).all():
            raise DomainError(f"{where}: {quantity} holds values that are not finite")
        quantities[quantity] = values * units[unit] if units else values
    lengths = {len(values) for values in quantities.values()}
    if len(lengths) != 1:
        raise DomainError(f"{where}: columns of different lengths {sorted(lengths)}")
    return quantities


def _plain_name(name: str) -> str:
    """Name of a column in small letters with underscores, as "diameter_nm" of
    "Diameter (nm)".
    """
    plain = name.strip().lower().replace("μ", "u").replace("µ", "u").replace("°", "deg")
    plain = re.sub(r"\|t\|(\^2|²)", "transmission", plain).replace("|t|", "abs_t")
    plain = re.sub(
        r"\(1\)|\b[a-z]\w*\.(?=s\d)", "", plain
    )  # units and physics of COMSOL
    return re.sub(r"[^\w]+", "_", plain).strip("_")


def _amplitudes(quantities: dict[str, Array], where: str) -> tuple[Array, list[str]]:
    """(n,) complex t of the rows, and a note on how it was stated.

    Args:
        quantities: {quantity: (n,) values}.
        where: names the table in errors.

    Raises:
        DomainError: missing columns, or |t| above 1.
    """
    if "complex" in quantities:
        t = quantities["complex"].astype(complex)
        notes = ["complex t"]
    elif {"real", "imaginary"} <= quantities.keys():
        t = quantities["real"] + 1j * quantities["imaginary"]
        notes = ["t from its real and imaginary part"]
    elif "phase" in quantities and ("power" in quantities or "amplitude" in quantities):
        by_power = "power" in quantities
        level = quantities["power" if by_power else "amplitude"]
        if level.min() < 0:
            raise DomainError(f"{where}: transmission {level.min():g} is below 0")
        level = np.sqrt(level) if by_power else level
        t = level * np.exp(1j * quantities["phase"])
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


def _grid(
    quantities: dict[str, Array], where: str
) -> tuple[tuple[Array, Array, Array], Array]:
    """Axes (angle, wavelength, size) of the table, and the (angle, wavelength, size)
    array of row numbers.

    Args:
        quantities: {quantity: (n,) values}, in rad and um.
        where: names the table in errors.

    Raises:
        DomainError: under 12 sizes, or entries that are missing or repeated.
    """
    (angles, i), (wavelengths, j), (sizes, k) = (
        np.unique(np.round(quantities[name], 9), return_inverse=True)
        for name in ("angle", "wavelength", "size")
    )
    if len(sizes) < LEAST_ENTRIES:
        raise DomainError(f"{where}: {len(sizes)} sizes; need {LEAST_ENTRIES} at least")
    row_of = np.full((len(angles), len(wavelengths), len(sizes)), -1)
    row_of[i, j, k] = np.arange(len(k))
    missing = np.argwhere(row_of < 0)
    if len(missing):
        a, w, s = missing[0]
        raise DomainError(
            f"{where}: {len(missing)} entries are missing, the first at "
            f"{math.degrees(angles[a]):g} deg, {wavelengths[w]:g} um, size {sizes[s]:g} um"
        )
    if len(k) > row_of.size:
        raise DomainError(f"{where}: {len(k) - row_of.size} entries stand twice")
    return (angles, wavelengths, sizes), row_of


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
