"""Pages of the refractiveindex.info database in YAML: dispersion formulas 1 to 9 and
tables nk, n or k.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import DAMAGE, MaterialError

# least number of coefficients of each formula
LEAST = {1: 3, 2: 3, 3: 3, 4: 5, 5: 3, 6: 3, 7: 2, 8: 3, 9: 3}
# largest number of coefficients; terms of the other formulas go on in pairs, after one
# alone
MOST = {7: 6, 8: 4, 9: 6}
_NOISE = 1e-3  # k of a measured table may lie below 0 by this; it counts as 0


@dataclass(frozen=True, slots=True)
class DispersionFormula:
    """n of a wavelength by one of the nine formulas; it holds from range_um[0] to
    range_um[1].

    where: file and formula, in the words of a refusal.
    """

    number: int
    coefficients: tuple[float, ...]
    range_um: tuple[float, float]
    where: str

    def at(self, wavelength_um: float) -> tuple[complex, complex]:
        """n and dn/d(wavelength_um), the latter by a complex step (exact to rounding).

        Raises:
            MaterialError: the formula gives no real index there.
        """
        step = 1e-20
        n = self._index(complex(wavelength_um, step))
        if not (math.isfinite(n.real) and n.real > 0 and abs(n.imag) < 1e-6):
            raise MaterialError(
                f"{self.where} gives n = {n.real:g} at {wavelength_um} um: no real index there"
            )
        return complex(n.real), complex(n.imag / step)

    def _index(self, w: complex) -> complex:
        """Refractive index at w (um): formulas 1 (Sellmeier), 2 (Sellmeier-2), 3
        (polynomial), 5 (Cauchy) and 6 (gases); the others by their own methods.
        """
        c = self.coefficients
        first, pairs = c[0], list(zip(c[1::2], c[2::2], strict=False))
        w2 = w * w
        if self.number == 1:
            return complex(
                np.sqrt(1 + first + sum(b * w2 / (w2 - e * e) for b, e in pairs))
            )
        if self.number == 2:
            return complex(
                np.sqrt(1 + first + sum(b * w2 / (w2 - e) for b, e in pairs))
            )
        if self.number == 3:
            return complex(np.sqrt(first + sum(b * w**e for b, e in pairs)))
        if self.number == 4:
            return self._rational(w)
        if self.number == 5:
            return complex(first + sum(b * w**e for b, e in pairs))
        if self.number == 6:
            return complex(1 + first + sum(b / (e - w**-2) for b, e in pairs))
        return self._other_formula(w)

    def _rational(self, w: complex) -> complex:
        """n² = c1 + c2 w^c3 / (w² - c4^c5) + c6 w^c7 / (w² - c8^c9) + c10 w^c11 + ..."""
        c = self.coefficients
        square: complex = complex(c[0])
        for start in (1, 5):
            if len(c) > start:
                a, p, b, q = (*c[start : start + 4], 0.0, 0.0, 0.0)[:4]
                square += a * w**p / (w * w - b**q)
        return complex(
            np.sqrt(
                square + sum(a * w**p for a, p in zip(c[9::2], c[10::2], strict=False))
            )
        )

    def _other_formula(self, w: complex) -> complex:
        """Formulas 7 (Herzberger), 8 (Lorentz-Lorenz) and 9."""
        c = (*self.coefficients, *(0.0,) * 6)
        w2 = w * w
        if self.number == 7:
            inverse = 1 / (w2 - 0.028)
            return (
                c[0]
                + c[1] * inverse
                + c[2] * inverse**2
                + c[3] * w2
                + c[4] * w2**2
                + c[5] * w2**3
            )
        if self.number == 8:
            polar = c[0] + c[1] * w2 / (w2 - c[2]) + c[3] * w2
            return complex(np.sqrt((1 + 2 * polar) / (1 - polar)))
        square = c[0] + c[1] / (w2 - c[2])
        if len(self.coefficients) > 3:
            square += c[3] * (w - c[4]) / ((w - c[4]) ** 2 + c[5])
        return complex(np.sqrt(square))


@dataclass(frozen=True, eq=False, slots=True)
class TabulatedIndex:
    """Linear interpolation between the rows of a tabulated n or k.

    rows: (2, rows) wavelength_um, rising, and value. Two rows at one wavelength are a
    step.
    faults: (low_um, high_um, what is wrong) of the intervals that a bad row spoils.
    """

    rows: Array
    faults: tuple[tuple[float, float, str], ...] = ()

    @property
    def range_um(self) -> tuple[float, float]:
        """First and last wavelength."""
        return float(self.rows[0, 0]), float(self.rows[0, -1])

    def at(self, wavelength_um: float) -> tuple[complex, complex]:
        """Value and slope.

        Raises:
            MaterialError: the value there would come from a bad row.
        """
        x, y = self.rows
        good = bool((x == wavelength_um).any())
        for low, high, fault in self.faults:
            if (
                low < wavelength_um < high and not good
            ) or low == wavelength_um == high:
                raise MaterialError(
                    f"{fault}; the page says nothing usable at {wavelength_um} um: "
                    "mend the row, or take a wavelength of other rows"
                )
        i = int(
            np.clip(np.searchsorted(x, wavelength_um, side="right") - 1, 0, len(x) - 2)
        )
        rate = (y[i + 1] - y[i]) / (x[i + 1] - x[i])
        return complex(y[i] + rate * (wavelength_um - x[i])), complex(rate)


Part = DispersionFormula | TabulatedIndex


def parse_page(text: str, where: str) -> tuple[Part, Part | None, str]:
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
    n: Part | None = None
    k: Part | None = None
    for i, block in enumerate(blocks, 1):
        if not isinstance(block, dict):
            raise MaterialError(
                f"{where}: entry {i} of DATA is no table; need type and data, or type and coefficients"
            )
        real, absorption = _parts(block, where)
        if (n and real) or (k and absorption):
            raise MaterialError(
                f"{where}: entry {i} of DATA gives {'n' if n and real else 'k'} a second time; need one"
            )
        n, k = n or real, k or absorption
    if n is None:
        raise MaterialError(
            f"{where}: neither a formula nor a table of n; need one of them"
        )
    return n, k, _source(page)


def _parts(block: dict[str, Any], where: str) -> tuple[Part | None, Part | None]:
    """n and k of an entry, None for each that it lacks."""
    kind = _words(block, "type")
    if kind.startswith("formula"):
        return _formula(block, kind, where), None
    if not kind.startswith("tabulated"):
        return None, None
    columns = kind.split()[-1]
    if columns not in ("nk", "n", "k"):
        raise MaterialError(f"{where}: type {kind!r}, need tabulated nk, n or k")
    tables = _tables(_words(block, "data"), columns, f"{where}, {kind}")
    return tables.get("n"), tables.get("k")


def _words(block: dict[str, Any], key: str) -> str:
    """A text or number; '' for anything else, such as lists of lists by reference,
    whose text would have no end.
    """
    value = block.get(key, "")
    return str(value) if isinstance(value, str | int | float) else ""


def _formula(block: dict[str, Any], kind: str, where: str) -> DispersionFormula:
    """Formula of an entry of type ``kind``, checked for its coefficients and range.

    Raises:
        MaterialError: with the name ``where``.
    """
    numbers = _words(block, "coefficients").split()
    span = (_words(block, "wavelength_range") or _words(block, "range")).split()
    try:
        number = int(kind.split()[-1])
        values = tuple(map(float, numbers))
        ends = tuple(map(float, span))
    except ValueError:
        raise MaterialError(
            f"{where}, {kind}: coefficients or wavelength_range are not numbers"
        ) from None
    if number not in LEAST or len(values) < LEAST[number] or len(ends) != 2:
        raise MaterialError(
            f"{where}, {kind}: {len(values)} coefficients, range {span}; need formula 1 to 9 with its coefficients and "
            "two ends of wavelength_range"
        )
    _check_complete(number, len(values), f"{where}, {kind}")
    return DispersionFormula(number, values, (min(ends), max(ends)), f"{where}, {kind}")


def _check_complete(number: int, count: int, where: str) -> None:
    """Refuses coefficients without their partners, and more than a formula has.

    Raises:
        MaterialError: with the number found.
    """
    is_complete = count <= MOST[number] if number in MOST else count % 2 == 1
    if number == 4:
        # its first two terms have four coefficients each
        is_complete = is_complete and count != 7
    if not is_complete:
        raise MaterialError(
            f"{where}: {count} coefficients, the last of them of no whole term; need whole terms"
        )


def _tables(text: str, columns: str, where: str) -> dict[str, TabulatedIndex]:
    """Tables of n and k by column name.

    A bad row becomes a fault of the interval between its good neighbours. Rows are
    sorted by wavelength, without duplicates.

    Args:
        text: rows of numbers. columns: "nk", "n" or "k". where: name for messages.

    Raises:
        MaterialError: fewer than two good rows.
    """
    rows: list[list[float]] = []
    # wavelength and what is wrong
    bad_rows: list[tuple[float, str]] = []
    # number of good rows before it, and what is wrong
    unreadable: list[tuple[int, str]] = []
    for i, line in enumerate(filter(str.strip, text.splitlines()), 1):
        fault = f"{where}, row {i}: {line.strip()!r}"
        row = _numbers(line)
        if len(row) != len(columns) + 1 or not row[0] > 0:
            message = (
                f"{fault}; need {len(columns) + 1} finite numbers, wavelength in um"
            )
            unreadable.append((len(rows), message))
        elif "n" in columns and row[1] <= 0:
            bad_rows.append((row[0], f"{fault}: n = {row[1]:g}; need n above 0"))
        elif "k" in columns and row[-1] < -_NOISE:
            message = f"{fault}: k = {row[-1]:g}; need k of 0 or above (exp(-iwt))"
            bad_rows.append((row[0], message))
        else:
            rows.append(row)
    distinct = {row[0] for row in rows}
    if len(distinct) < 2:
        messages = [message for _, message in (*unreadable, *bad_rows)][:3]
        raise MaterialError(
            f"{where}: {len(distinct)} good rows; need two or more at distinct "
            "wavelengths" + "".join(f" ({message})" for message in messages)
        )
    faults = []
    for position, message in unreadable:
        neighbours = [row[0] for row in rows[max(position - 1, 0) : position + 1]]
        if len(neighbours) == 2:
            faults.append((min(neighbours), max(neighbours), message))
    for wavelength, message in bad_rows:
        low = max(
            (other for other in distinct if other < wavelength), default=wavelength
        )
        high = min(
            (other for other in distinct if other > wavelength), default=wavelength
        )
        if wavelength not in distinct:
            faults.append((low, high, message))
    rows = sorted(dict.fromkeys(map(tuple, rows)), key=lambda row: row[0])  # type: ignore[arg-type]
    rows, steps = _merge_rows(rows, where)
    table = np.array(rows).T
    return {
        name: TabulatedIndex(table[[0, 1 + columns.index(name)]], (*faults, *steps))
        for name in columns
    }


def _numbers(line: str) -> list[float]:
    """The finite numbers of a row; empty where it holds anything else."""
    try:
        row = [float(v) for v in line.replace(",", " ").split()]
    except ValueError:
        return []
    return row if all(map(math.isfinite, row)) else []


def _merge_rows(
    rows: list[list[float]], where: str
) -> tuple[list[list[float]], list[tuple[float, float, str]]]:
    """Rows with at most two at one wavelength, and a fault at each such step.

    Of three or more rows at one wavelength the first and the last remain.

    Args:
        rows: sorted by wavelength. where: name for messages.
    """
    distinct: list[list[float]] = []
    faults = []
    for row in rows:
        if len(distinct) > 1 and distinct[-1][0] == distinct[-2][0] == row[0]:
            distinct[-1] = row
            continue
        if distinct and distinct[-1][0] == row[0]:
            values = f"{distinct[-1][1:]} and {row[1:]}"
            faults.append(
                (row[0], row[0], f"{where}: two rows at {row[0]} um, {values}")
            )
        distinct.append(row)
    return distinct, faults


def _source(page: dict[str, Any]) -> str:
    """References and comments without markup, in one line."""
    import re

    parts = [_words(page, key) for key in ("REFERENCES", "COMMENTS")]
    plain = re.sub(r"<[^>]+>", "", " ".join(parts))
    return " ".join(plain.split()) or "a page of refractiveindex.info"


def load_page(path: Path, where: str) -> tuple[Part, Part | None, str]:
    """As :func:`parse_page`, from the file at ``path``, which messages call ``where``.

    Raises:
        MaterialError: also where the file is missing or no text.
    """
    try:
        return parse_page(reading.read_text(path), where)
    except (OSError, UnicodeDecodeError) as error:
        raise MaterialError(
            f"{where}: not a readable text file ({error}); need a YAML page"
        ) from None
