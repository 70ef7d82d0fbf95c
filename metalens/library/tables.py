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

LIGHT_UM_THZ = 299.792458  # wavelength in um times frequency in THz
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
LEAST_SIZES = 12  # of a smooth proxy


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
        >>> made = from_table(arrays, Cell(0.3), wavelength_um=0.85)
        >>> round(float(abs(made.t[0, 0, 0, 3])), 4)
        0.9487
    """
    where = "the table" if isinstance(table, Mapping) else str(table)
    named = table if isinstance(table, Mapping) else _read(Path(table), columns)
    found = _recognise(named, where)
    t, words = _amplitudes(found, where)
    size_um = _sizes(found, where)
    waves_um = _wavelengths(found, wavelength_um, len(size_um), where)
    angles_rad = found["angle"].values if "angle" in found else np.zeros(len(size_um))
    error = found["error"].values if "error" in found else np.full(len(t), np.nan)
    axes, place = _grid(angles_rad, waves_um, size_um, where)
    t, error = t[place], error[place]
    t, turned = _with_rising_phase(t)
    words.append(
        "phase fell with the size: conjugated to exp(-iwt)"
        if turned
        else "phase rises with the size, as of exp(-iwt)"
    )
    if "error" in found:
        words.append("error bars from their column")
    else:
        error = _left_out_errors(axes[2], t)
        words.append("error bars from a cubic that leaves each entry out")
    return _library(cell, axes, t, np.maximum(error, 0.0), tuple(words))


def _library(
    cell: Cell,
    axes: tuple[Array, Array, Array],
    t: Array,
    error: Array,
    notes: tuple[str, ...],
) -> PillarLibrary:
    angles, waves, sizes = axes
    lights = ("x",) if len(angles) == 1 and angles[0] == 0 else ("s", "p")
    entries = np.broadcast_to(t, (len(lights), *t.shape)).copy()
    sweep = Sweep(
        wavelengths_um=tuple(map(float, waves)),
        angles_deg=tuple(map(float, np.degrees(angles))),
        diameters_um=(float(sizes[0]), float(sizes[-1])),
        samples=max(20, len(sizes)),
        tolerance=float(np.clip(error.max(), 1e-8, MOST_ERROR)),
    )
    return PillarLibrary(
        cell,
        sweep,
        lights,
        angles,
        waves,
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
    """{column: values} of a file."""
    try:
        if path.suffix.lower() == ".npz":
            with np.load(path, allow_pickle=False) as held:
                return {name: np.ravel(held[name]) for name in held.files}
        if path.suffix.lower() == ".mat":
            from scipy.io import loadmat

            held = loadmat(path)
            return {k: np.ravel(v) for k, v in held.items() if not k.startswith("__")}
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError, NotImplementedError) as fault:
        raise DomainError(
            f"{path}: not read ({fault}); give CSV, TSV, NPZ or MAT of version 5"
        ) from None
    lines = [ln for ln in text.splitlines() if ln.strip() and ln[0] not in "#%"]
    if not lines:
        raise DomainError(f"{path}: empty; need a header and a row for each entry")
    mark = next((m for m in "\t;," if m in lines[0]), None)
    if mark in (";", "\t"):
        lines = [line.replace(",", ".") for line in lines]
    rows = (
        [ln.split() for ln in lines]
        if mark is None
        else [*csv.reader(lines, delimiter=mark)]
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
    try:
        return all(map(float, row)) or True
    except ValueError:
        return False


def _recognise(named: Mapping[str, Any], where: str) -> dict[str, _Column]:
    """Columns by quantity, in um, rad and shares."""
    found: dict[str, _Column] = {}
    for name, given in named.items():
        kind, unit = _quantity(str(name))
        values = np.ravel(np.asarray(given))
        if kind == "power" and np.iscomplexobj(values):
            kind = "complex"
        if not kind:
            raise DomainError(
                f"{where}: column {name!r} is unknown; known are "
                f"{', '.join(n[0] for n in KINDS.values())} with a unit (diameter_nm)"
            )
        if kind in found:
            raise DomainError(f"{where}: two columns of {kind}")
        found[kind] = _Column(kind, *_scaled(kind, unit, values, f"{where}: {name!r}"))
    lengths = {len(column.values) for column in found.values()}
    if len(lengths) != 1:
        raise DomainError(f"{where}: columns of different lengths {sorted(lengths)}")
    for kind, column in found.items():
        if not np.isfinite(column.values).all():
            raise DomainError(f"{where}: {kind} holds values that are not finite")
    return found


def _quantity(name: str) -> tuple[str, str]:
    """(kind, unit) of a column's name; the kind is empty where it is not known."""
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
    known: dict[str, dict[str, float]] = {
        "diameter": LENGTHS,
        "radius": LENGTHS,
        "wavelength": LENGTHS,
        "frequency": FREQUENCIES,
        "angle": ANGLES,
        "phase": PHASES,
    }
    if kind not in known:
        return 1.0, values
    if unit not in known[kind]:
        raise DomainError(
            f"{where} states no unit; name the column {kind}_UNIT, of "
            f"{', '.join(known[kind])}"
        )
    return known[kind][unit], values * known[kind][unit]


def _amplitudes(found: dict[str, _Column], where: str) -> tuple[Array, list[str]]:
    """Complex t of the rows, and how it was stated."""
    if "complex" in found:
        t = found["complex"].values.astype(complex)
        words = ["complex t"]
    elif {"real", "imaginary"} <= found.keys():
        t = found["real"].values + 1j * found["imaginary"].values
        words = ["t from its real and imaginary part"]
    elif "phase" in found and ("power" in found or "amplitude" in found):
        by_power = "power" in found
        level = found["power" if by_power else "amplitude"].values
        if level.min() < 0:
            raise DomainError(f"{where}: transmission {level.min():g} is below 0")
        level = np.sqrt(level) if by_power else level
        t = level * np.exp(1j * found["phase"].values)
        words = [f"|t| from {'a share of power' if by_power else 'an amplitude'}"]
    else:
        raise DomainError(
            f"{where}: columns of {', '.join(sorted(found))}; need phase with "
            "transmission or amplitude, or t_re with t_im"
        )
    most = float(np.abs(t).max())
    if most > 1.001:
        raise DomainError(
            f"{where}: |t| reaches {most:.4g}; t is normalised to power, so that |t|² "
            "is the share that passes (n_cover cos / n_substrate cos times |E|²)"
        )
    return t / max(1.0, most), words


def _sizes(found: dict[str, _Column], where: str) -> Array:
    if "diameter" in found:
        return np.asarray(found["diameter"].values)
    if "radius" in found:
        return np.asarray(2 * found["radius"].values)
    raise DomainError(f"{where}: no column of the size; need diameter_nm or radius_nm")


def _wavelengths(
    found: dict[str, _Column], stated_um: float | None, rows: int, where: str
) -> Array:
    if "wavelength" in found:
        return np.asarray(found["wavelength"].values)
    if "frequency" in found:
        return np.asarray(LIGHT_UM_THZ / found["frequency"].values)
    if stated_um is None:
        raise DomainError(
            f"{where}: no column of the wavelength; state it (wavelength_um)"
        )
    return np.full(rows, float(stated_um))


def _grid(
    angles: Array, waves: Array, sizes: Array, where: str
) -> tuple[tuple[Array, Array, Array], Array]:
    """Axes and (angle, wavelength, size) places of the rows."""
    axes = tuple(np.unique(np.round(v, 9)) for v in (angles, waves, sizes))
    shape = tuple(map(len, axes))
    if shape[2] < LEAST_SIZES:
        raise DomainError(f"{where}: {shape[2]} sizes; need {LEAST_SIZES} at least")
    place = np.full(shape, -1)
    spots = tuple(
        np.searchsorted(axis, np.round(v, 9))
        for axis, v in zip(axes, (angles, waves, sizes), strict=True)
    )
    place[spots] = np.arange(len(sizes))
    if (place < 0).any():
        a, w, s = np.argwhere(place < 0)[0]
        raise DomainError(
            f"{where}: {int((place < 0).sum())} entries are missing, the first at "
            f"{math.degrees(axes[0][a]):g} deg, {axes[1][w]:g} um, size {axes[2][s]:g} um"
        )
    if len(sizes) > place.size:
        raise DomainError(f"{where}: {len(sizes) - place.size} entries stand twice")
    return (axes[0], axes[1], axes[2]), place


def _with_rising_phase(t: Array) -> tuple[Array, bool]:
    """t with a phase that rises with the size, and whether it had to be conjugated."""
    rise = np.unwrap(np.angle(t), axis=-1)
    falls = float(np.median(rise[..., -1] - rise[..., 0])) < 0
    return (t.conj() if falls else t), falls


def _left_out_errors(sizes: Array, t: Array) -> Array:
    """Distance of each entry from a cubic spline through the entries of other parity."""
    error = np.empty(t.shape)
    every = np.arange(len(sizes))
    for parity in (0, 1):
        mine = every[every % 2 == parity]
        others = every[every % 2 != parity]
        spline = CubicSpline(sizes[others], t[..., others], axis=-1)
        error[..., mine] = np.abs(spline(sizes[mine]) - t[..., mine])
    return error
