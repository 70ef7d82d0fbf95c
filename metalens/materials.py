"""Refractive index of the materials of a cell: tables with source and range, a user's CSV, or plain numbers.

Time factor exp(-iwt): an absorbing material has k > 0. Nothing is extrapolated.
"""

import csv
import importlib.resources
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from metalens import cell
from metalens.errors import MaterialError, nearest

Array = np.ndarray[Any, np.dtype[np.float64]]
COLUMNS = ("wavelength_um", "n", "k")


@dataclass(frozen=True, eq=False, slots=True)
class Material:
    """Optical constants of one material.

    name, source: what it is, and where the numbers come from.
    range_um: shortest and longest vacuum wavelength for which they hold.
    table: (3, rows) wavelength_um, n, k; empty for a Sellmeier material.
    sellmeier: ((B, resonance_um), ...) of n² = 1 + sum B l² / (l² - resonance²); empty for a table.
    """

    name: str
    source: str
    range_um: tuple[float, float]
    table: Array
    sellmeier: tuple[tuple[float, float], ...] = ()


_TABLES = {
    "a-Si": "a-Si.csv",
    "Si": "Si.csv",
}
_NO_TABLE = np.empty((3, 0))
_FORMULAS = {
    "air": Material("air", "vacuum: n = 1 by definition", (0.0, math.inf), _NO_TABLE),
    "SiO2": Material(
        "SiO2",
        "fused silica at 20 C: I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965); used up to 3.71 um",
        (0.21, 3.71),
        _NO_TABLE,
        ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161)),
    ),
}
NAMES = tuple(sorted((*_TABLES, *_FORMULAS)))


def index(material: cell.Material | Material, wavelength_um: float) -> complex:
    """Refractive index n + ik at a vacuum wavelength.

    Args:
        material: a name of ``NAMES``, the path of a CSV file (:func:`read_csv`), plain numbers (``cell.Index``),
            or a ``Material``.
        wavelength_um: vacuum wavelength.

    Accuracy: that of the source. Between the rows of a table n and k are straight lines in the wavelength (the
        slope jumps at the rows).

    Raises:
        MaterialError: unknown name, unreadable CSV, or a wavelength outside the range of the source.

    >>> round(index("SiO2", 0.85).real, 4)
    1.4525
    """
    return _index_and_slope(material, wavelength_um)[0]


def slope(material: cell.Material | Material, wavelength_um: float) -> complex:
    """Dispersion d(n + ik)/d(wavelength_um), with the arguments and errors of :func:`index`."""
    return _index_and_slope(material, wavelength_um)[1]


def material(name: str) -> Material:
    """The record behind a name of ``NAMES`` or behind the path of a CSV file.

    Raises:
        MaterialError: the name is unknown, or the file cannot be used.
    """
    if name in _FORMULAS:
        return _FORMULAS[name]
    if name in _TABLES:
        return _shipped(name)
    path = Path(name)
    if path.suffix.lower() == ".csv" or len(path.parts) > 1:
        return read_csv(path)
    raise MaterialError(f"unknown material {name!r}{nearest(name, NAMES)}; or give the path of a CSV file")


def read_csv(path: str | Path) -> Material:
    """A material from a CSV file with the columns wavelength_um, n, k; lines that open with # are comments.

    Raises:
        MaterialError: no such file, a missing column, or a bad row; the message gives the line.
    """
    path = Path(path)
    try:
        stat = path.stat()
    except OSError:
        raise MaterialError(f"{path}: no such file; need a CSV with columns {', '.join(COLUMNS)}") from None
    return _read_csv(path, (stat.st_mtime_ns, stat.st_size))


@lru_cache(maxsize=64)
def _read_csv(path: Path, stamp: tuple[int, int]) -> Material:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise MaterialError(f"{path}: not a readable text file ({error}); need a CSV table") from None
    return _parse(text, name=str(path), where=str(path))


@lru_cache(maxsize=8)
def _shipped(name: str) -> Material:
    text = (importlib.resources.files("metalens") / "data" / _TABLES[name]).read_text(encoding="utf-8")
    return _parse(text, name=name, where=_TABLES[name])


def _parse(text: str, *, name: str, where: str) -> Material:
    lines = text.splitlines()
    comments = [line.lstrip("# ").strip() for line in lines if line.startswith("#")]
    body = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not body:
        raise MaterialError(f"{where}: empty; need a header {','.join(COLUMNS)} and at least two rows")
    header = [field.strip() for field in body[0][1].split(",")]
    missing = [column for column in COLUMNS if column not in header]
    if missing:
        raise MaterialError(f"{where}, line {body[0][0]}: no column {', '.join(missing)} in {header}; need {COLUMNS}")
    order = [header.index(column) for column in COLUMNS]
    rows = [_row(line, order, len(header), f"{where}, line {i}") for i, line in body[1:]]
    _check_rows(rows, [i for i, _ in body[1:]], where)
    table = np.array(rows).T
    return Material(name, " ".join(comments) or f"the file {where}", (table[0, 0], table[0, -1]), table)


def _row(line: str, order: list[int], width: int, where: str) -> list[float]:
    fields = next(csv.reader([line]))
    if len(fields) != width:
        raise MaterialError(f"{where}: {len(fields)} fields, the header has {width}")
    try:
        values = [float(fields[column]) for column in order]
    except ValueError:
        raise MaterialError(f"{where}: {line!r} is not numbers; need wavelength_um, n, k") from None
    wavelength_um, n, k = values
    if not (all(math.isfinite(v) for v in values) and wavelength_um > 0 and n > 0 and k >= 0):
        raise MaterialError(f"{where}: {line!r}; need finite wavelength_um > 0, n > 0 and k >= 0 (exp(-iwt))")
    return values


def _check_rows(rows: list[list[float]], numbers: list[int], where: str) -> None:
    if len(rows) < 2:
        raise MaterialError(f"{where}: {len(rows)} rows of numbers; need at least two")
    for before, after, number in zip(rows, rows[1:], numbers[1:], strict=False):
        if after[0] <= before[0]:
            raise MaterialError(
                f"{where}, line {number}: wavelength {after[0]} um follows {before[0]} um; need increasing wavelengths"
            )


def _index_and_slope(wanted: cell.Material | Material, wavelength_um: float) -> tuple[complex, complex]:
    if not (math.isfinite(wavelength_um) and wavelength_um > 0):
        raise MaterialError(f"wavelength {wavelength_um} um: need a finite length above 0")
    if isinstance(wanted, cell.Index):
        return complex(wanted.n, wanted.k), 0j
    record = material(wanted) if isinstance(wanted, str) else wanted
    low, high = record.range_um
    if not low <= wavelength_um <= high:
        raise MaterialError(
            f"{record.name} at {wavelength_um} um: its source holds from {low} to {high} um ({record.source}); "
            "choose a wavelength inside, another material, or plain n and k"
        )
    if record.table.size:
        return _from_table(record, wavelength_um)
    return _from_sellmeier(record, wavelength_um)


def _from_sellmeier(record: Material, wavelength_um: float) -> tuple[complex, complex]:
    """n² = 1 + sum B l² / (l² - c²), and d(n²)/dl = -2 l sum B c² / (l² - c²)²."""
    l2 = wavelength_um**2
    n = math.sqrt(1 + sum(b * l2 / (l2 - c * c) for b, c in record.sellmeier))
    rate = -wavelength_um / n * sum(b * c * c / (l2 - c * c) ** 2 for b, c in record.sellmeier)
    return complex(n), complex(rate)


def _from_table(record: Material, wavelength_um: float) -> tuple[complex, complex]:
    x, n, k = record.table
    i = int(np.clip(np.searchsorted(x, wavelength_um, side="right") - 1, 0, len(x) - 2))
    rate = complex(n[i + 1] - n[i], k[i + 1] - k[i]) / (x[i + 1] - x[i])
    share = (wavelength_um - x[i]) / (x[i + 1] - x[i])
    return complex(n[i] + share * (n[i + 1] - n[i]), (1 - share) * k[i] + share * k[i + 1]), rate
