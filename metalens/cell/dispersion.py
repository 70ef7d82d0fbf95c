"""Readers of optical constants: pages of the refractiveindex.info database in YAML
(dispersion formulas 1 to 9, tables nk, n or k), and tables in CSV.
"""

import cmath
import csv
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import yaml

from metalens.core.arrays import Array
from metalens.core.errors import DAMAGE, MaterialError
from metalens.core.units import nm, um

# possible numbers of coefficients of each formula: whole terms
_PAIRS = range(3, 100, 2)
_COUNTS = {
    **dict.fromkeys((1, 2, 3, 5, 6), _PAIRS),
    4: (5, 9, *_PAIRS[4:]),
    7: range(2, 7),
    8: range(3, 5),
    9: range(3, 7),
}
_COLUMNS = "wavelength_um (or wavelength_nm), n and, where it absorbs, k"
_SCALES = {"wavelength_um": um, "wl": um, "wavelength_nm": nm}


@dataclass(frozen=True, slots=True)
class DispersionFormula:
    """n of a wavelength by one of the nine formulas of refractiveindex.info; it holds
    from range_um[0] to range_um[1].

    number: of the formula. coefficients: c1, c2, ... where: file and formula, in the
        words of a refusal.
    """

    number: int
    coefficients: tuple[float, ...]
    range_um: tuple[float, float]
    where: str = ""

    def at(self, wavelength_um: float) -> float:
        """n at a wavelength.

        Raises:
            MaterialError: the formula gives no real index there.
        """
        try:
            n = self._index(wavelength_um)
        except ZeroDivisionError:
            n = cmath.nan
        if not (cmath.isfinite(n) and n.real > 0 and abs(n.imag) < 1e-6):
            raise MaterialError(
                f"{self.where} gives n = {n.real:g} at {wavelength_um} um: no real "
                "index there"
            )
        return float(n.real)

    def _index(self, w: float) -> complex:
        """Formulas 1 (Sellmeier), 2 (Sellmeier-2), 3 (polynomial), 4 (rational), 5
        (Cauchy), 6 (gases), 7 (Herzberger), 8 (retro) and 9 (exotic) at ``w`` um.
        """
        first, *rest = self.coefficients
        w2 = w * w
        pairs = list(zip(rest[::2], rest[1::2], strict=False))
        if self.number == 1:
            return cmath.sqrt(1 + first + sum(b * w2 / (w2 - e * e) for b, e in pairs))
        if self.number == 2:
            return cmath.sqrt(1 + first + sum(b * w2 / (w2 - e) for b, e in pairs))
        if self.number == 3:
            return cmath.sqrt(first + sum(b * w**e for b, e in pairs))
        if self.number == 4:
            poles, powers = [rest[i : i + 4] for i in (0, 4) if rest[i:]], pairs[4:]
            square = sum(a * w**p / (w2 - b**q) for a, p, b, q in poles)
            return cmath.sqrt(first + square + sum(b * w**e for b, e in powers))
        if self.number == 5:
            return complex(first + sum(b * w**e for b, e in pairs))
        if self.number == 6:
            return 1 + first + sum(b / (e - 1 / w2) for b, e in pairs)
        a, b, c, d, e = (*rest, *[0.0] * 5)[:5]
        if self.number == 7:
            pole = 1 / (w2 - 0.028)
            return first + a * pole + b * pole**2 + c * w2 + d * w2**2 + e * w2**3
        if self.number == 8:
            polar = first + a * w2 / (w2 - b) + c * w2
            return cmath.sqrt((1 + 2 * polar) / (1 - polar))
        square = first + a / (w2 - b)
        if len(rest) > 2:
            square += c * (w - d) / ((w - d) ** 2 + e)
        return cmath.sqrt(square)


@dataclass(frozen=True, eq=False, slots=True)
class TabulatedIndex:
    """Linear interpolation between the rows of a tabulated n or k.

    rows: (2, rows) wavelength_um, not falling, and value. Two rows at one wavelength
        are a step.
    faults: (low_um, high_um, what is wrong) of the open intervals that a bad row or a
        step spoils.
    """

    rows: Array
    faults: tuple[tuple[float, float, str], ...] = ()

    @property
    def range_um(self) -> tuple[float, float]:
        """First and last wavelength."""
        return float(self.rows[0, 0]), float(self.rows[0, -1])

    def at(self, wavelength_um: float) -> float:
        """Value at a wavelength.

        Raises:
            MaterialError: it would come from a bad row.
        """
        for low, high, fault in self.faults:
            if low < wavelength_um < high:
                raise MaterialError(
                    f"{fault}; the page says nothing usable at {wavelength_um} um: "
                    "mend the row, or take a wavelength of other rows"
                )
        return float(np.interp(wavelength_um, *self.rows))


Dispersion = DispersionFormula | TabulatedIndex


def tabulate(
    rows: Iterable[tuple[str, list[float]]],
    columns: str,
    where: str,
    *,
    strict: bool = False,
) -> dict[str, TabulatedIndex]:
    """Tables of n and k by column name, sorted by wavelength, without duplicates.

    A bad row is a fault of the interval between its good neighbours.

    Args:
        rows: place in the file, and wavelength (um) with the values; no numbers where
            the row has anything else.
        columns: "nk", "n" or "k". where: name for messages.
        strict: whether a fault is refused here.

    Raises:
        MaterialError: fewer than two good rows; a fault, if ``strict``.
    """
    good: list[list[float]] = []
    bad: list[str] = []
    faults: list[tuple[float, float, str]] = []
    waiting: list[str] = []  # bad rows since the last good one
    for place, row in rows:
        problem = _row_problem(row, columns)
        if problem:
            waiting.append(f"{place}{problem}")
            bad.append(waiting[-1])
            continue
        if good:
            low, high = sorted((good[-1][0], row[0]))
            faults += [(low, high, message) for message in waiting]
        good.append(row)
        waiting = []
    if len({row[0] for row in good}) < 2:
        raise MaterialError(
            f"{where}: {len(good)} rows of numbers; need two or more at distinct "
            "wavelengths" + "".join(f" ({message})" for message in bad[:3])
        )
    if good[0][0] > good[-1][0]:
        good.reverse()
    distinct = sorted(dict.fromkeys(map(tuple, good)), key=lambda row: row[0])
    for before, after in pairwise(distinct):
        w = before[0]
        if w == after[0]:
            bad.append(f"{where}: two rows at {w} um, {before[1:]} and {after[1:]}")
            faults.append((np.nextafter(w, 0), np.nextafter(w, math.inf), bad[-1]))
    if strict and bad:
        raise MaterialError(bad[0])
    table = np.array(distinct).T
    return {
        name: TabulatedIndex(table[[0, column]], tuple(faults))
        for column, name in enumerate(columns, 1)
    }


def _row_problem(row: list[float], columns: str, noise: float = 1e-3) -> str:
    """What is wrong with a row of wavelength and values; empty where nothing is.

    Args:
        row, columns: of a table, as for :func:`tabulate`.
        noise: k of a measured table may lie below 0 by this; it counts as 0.
    """
    if len(row) != len(columns) + 1 or not all(map(math.isfinite, row)) or row[0] <= 0:
        return f"; need {len(columns) + 1} finite numbers, wavelength in um above 0"
    if "n" in columns and row[1] <= 0:
        return f": n = {row[1]:g}; need n above 0"
    if "k" in columns and row[-1] < -noise:
        return f": k = {row[-1]:g}; need k of 0 or above (exp(-iwt))"
    return ""


def _numbers(fields: list[str]) -> list[float]:
    """The ``fields`` as numbers; empty where one is none."""
    try:
        return [float(field) for field in fields]
    except ValueError:
        return []


def parse_page(text: str, where: str) -> tuple[Dispersion, Dispersion | None, str]:
    """n, k (None: transparent) and the source in words of a page of
    refractiveindex.info.

    Args:
        text: the page, YAML. where: its name, for messages.

    Raises:
        MaterialError: not such a page, an unknown formula, a bad row.
    """
    try:
        page = yaml.safe_load(text)
    except (
        yaml.YAMLError,
        *DAMAGE,
    ) as error:  # nested too deep, endless integers and dates that are none as well
        raise MaterialError(
            f"{where}: not YAML: {next(iter(str(error).splitlines()), 'no words')}"
        ) from None
    blocks = page.get("DATA") if isinstance(page, dict) else None
    if not isinstance(blocks, list):
        raise MaterialError(
            f"{where}: no list DATA; need a page of refractiveindex.info"
        )
    parts: dict[str, Dispersion] = {}
    for i, block in enumerate(blocks, 1):
        if not isinstance(block, dict):
            raise MaterialError(
                f"{where}: entry {i} of DATA is no table; need type and data, or type "
                "and coefficients"
            )
        for name, part in _parse_entry(block, where).items():
            if name in parts:
                raise MaterialError(
                    f"{where}: entry {i} of DATA gives {name} a second time; need one"
                )
            parts[name] = part
    if "n" not in parts:
        raise MaterialError(
            f"{where}: neither a formula nor a table of n; need one of them"
        )
    source = " ".join(_scalar_text(page, key) for key in ("REFERENCES", "COMMENTS"))
    plain = " ".join(re.sub(r"<[^>]+>", "", source).split())
    return parts["n"], parts.get("k"), plain or "a page of refractiveindex.info"


def _parse_entry(block: dict[str, Any], where: str) -> dict[str, Dispersion]:
    """n and k of an entry of a page, as far as it has them.

    Raises:
        MaterialError: with the name ``where``.
    """
    kind = _scalar_text(block, "type")
    where = f"{where}, {kind}"
    if kind.startswith("formula"):
        span = _scalar_text(block, "wavelength_range") or _scalar_text(block, "range")
        ends = _numbers(span.split())
        words = _scalar_text(block, "coefficients").split()
        number, *values = _numbers([kind.split()[-1], *words]) or [0.0]
        if len(values) != len(words):
            raise MaterialError(f"{where}: type or coefficients are not numbers")
        if len(values) not in _COUNTS.get(int(number), ()) or len(ends) != 2:
            raise MaterialError(
                f"{where}: {len(values)} coefficients, range {span!r}; need formula 1 "
                "to 9 with coefficients of whole terms, and two ends of "
                "wavelength_range"
            )
        low, high = sorted(ends)
        return {"n": DispersionFormula(int(number), tuple(values), (low, high), where)}
    if not kind.startswith("tabulated"):
        return {}
    columns = kind.split()[-1]
    if columns not in ("nk", "n", "k"):
        raise MaterialError(f"{where}: need tabulated nk, n or k")
    lines = filter(str.strip, _scalar_text(block, "data").splitlines())
    rows = (
        (
            f"{where}, row {i}: {line.strip()!r}",
            _numbers(line.replace(",", " ").split()),
        )
        for i, line in enumerate(lines, 1)
    )
    return {**tabulate(rows, columns, where)}


def _scalar_text(block: dict[str, Any], key: str) -> str:
    """A text or number; '' for anything else, such as lists of lists by reference,
    whose text would have no end.
    """
    value = block.get(key, "")
    return str(value) if isinstance(value, str | int | float) else ""


def parse_csv(text: str, where: str) -> tuple[Dispersion, Dispersion | None, str]:
    """n, k (None: transparent) and the comments (after #) of a table of ``_COLUMNS`` in
    any order; semicolons or tabs may stand between decimal commas.

    A table of k may follow that of n, as refractiveindex.info exports them.

    Args:
        text: of the table. where: its name, for messages.

    Raises:
        MaterialError: a missing column or a bad row; the message gives the line.
    """
    lines = list(enumerate(text.splitlines(), 1))
    comments = [line.lstrip("# ").strip() for _, line in lines if line.startswith("#")]
    body = [(i, line) for i, line in lines if line.strip() and line[0] != "#"]
    if not body:
        raise MaterialError(
            f"{where}: empty; need columns {_COLUMNS}, and at least two rows"
        )
    header = body[0][1]
    separator = next(
        (mark for mark in ";\t" if mark in body[0][1] and "," not in body[0][1]), ","
    )

    def fields(line: str) -> list[str]:
        """Fields of a line, with decimal points."""
        row = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
        return row if separator == "," else [field.replace(",", ".") for field in row]

    starts = [
        j
        for j, (_, line) in enumerate(body)
        if not j or {"n", "k"} & set(map(_column_name, fields(line)))
    ]
    parts: dict[str, TabulatedIndex] = {}
    for start, end in pairwise([*starts, len(body)]):
        line_number, header = body[start]
        names = [_column_name(field) for field in fields(header)]
        wavelength = next((name for name in names if name in _SCALES), "")
        columns = "".join(name for name in "nk" if name in names)
        if not wavelength or not columns:
            raise MaterialError(
                f"{where}, line {line_number}: columns {', '.join(names)}; need "
                f"{_COLUMNS}"
            )
        order = [names.index(name) for name in (wavelength, *columns)]
        rows = []
        for i, line in body[start + 1 : end]:
            values = fields(line)
            row = _numbers([values[j] for j in order if len(values) == len(names)])
            row[:1] = [w * _SCALES[wavelength] for w in row[:1]]
            rows.append((f"{where}, line {i}: {line!r}", row))
        parts.update(tabulate(rows, columns, where, strict=True))
    if "n" not in parts:
        raise MaterialError(f"{where}: no column n; need {_COLUMNS}")
    return parts["n"], parts.get("k"), " ".join(comments) or f"the file {where}"


def _column_name(field: str) -> str:
    """``Wavelength (nm)``, ``wavelength, nm`` and ``wavelength [nm]`` are
    ``wavelength_nm``.
    """
    plain = field.strip().lower().replace("μ", "u").replace("µ", "u")
    return re.sub(r"[\s,()\[\]/]+", "_", plain).strip("_")
