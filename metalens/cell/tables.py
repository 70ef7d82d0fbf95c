"""Own tables of n and k: CSV, or semicolons or tabs with decimal commas; # opens
comments.
"""

import csv
import math
import re

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import MaterialError

COLUMNS = "wavelength_um (or wavelength_nm), n and, where it absorbs, k"
_SCALES = {"wavelength_um": 1.0, "wl": 1.0, "wavelength_nm": 1e-3}


def parse_table(text: str, where: str) -> tuple[Array, str]:
    """(3, rows) wavelength_um, n, k, rising; and the comments of a table.

    Args:
        text: of the table. where: its name, for messages.

    Raises:
        MaterialError: a missing column or a bad row; the message gives the line.
    """
    lines = text.splitlines()
    comments = [line.lstrip("# ").strip() for line in lines if line.startswith("#")]
    body = [
        (i, line)
        for i, line in enumerate(lines, 1)
        if line.strip() and not line.startswith("#")
    ]
    if not body:
        raise MaterialError(
            f"{where}: empty; need columns {COLUMNS}, and at least two rows"
        )
    separator = next(
        (mark for mark in ";\t" if mark in body[0][1] and "," not in body[0][1]), ","
    )
    if separator != ",":
        body = [(i, line.replace(",", ".").replace(separator, ",")) for i, line in body]
    body = _join_stacked_tables(body, where)
    names = [_column(field) for field in next(csv.reader([body[0][1]]))]
    wavelength_column = next(
        (names.index(column) for column in _SCALES if column in names), -1
    )
    if wavelength_column < 0 or "n" not in names:
        raise MaterialError(
            f"{where}, line {body[0][0]}: columns {', '.join(names)}; need {COLUMNS}"
        )
    order = [
        wavelength_column,
        names.index("n"),
        names.index("k") if "k" in names else -1,
    ]
    rows = [
        _row(
            line,
            order,
            len(names),
            f"{where}, line {i}",
            _SCALES[names[wavelength_column]],
        )
        for i, line in body[1:]
    ]
    return np.array(_rising(rows, [i for i, _ in body[1:]], where)).T, " ".join(
        comments
    )


def _column(field: str) -> str:
    """``Wavelength (nm)``, ``wavelength, nm`` and ``wavelength [nm]`` are
    ``wavelength_nm``.
    """
    plain = field.strip().lower().replace("μ", "u").replace("µ", "u")
    return re.sub(r"[\s,()\[\]/]+", "_", plain).strip("_")


def _join_stacked_tables(
    body: list[tuple[int, str]], where: str
) -> list[tuple[int, str]]:
    """Rows of a file with n and k in one table.

    refractiveindex.info exports k as a second table after n, each with a header "wl,…".
    Other files are returned as they are.

    Args:
        body: (line number, line). where: name for messages.

    Raises:
        MaterialError: the two tables have different wavelengths.
    """
    heads = [
        i
        for i, (_, line) in enumerate(body)
        if line.replace(" ", "").lower().startswith("wl,")
    ]
    if len(heads) != 2:
        return body
    n_table, k_table = body[: heads[1]], body[heads[1] + 1 :]
    wavelengths = [line.split(",")[0].strip() for _, line in n_table[1:]]
    if wavelengths != [line.split(",")[0].strip() for _, line in k_table]:
        raise MaterialError(
            f"{where}, line {body[heads[1]][0]}: n and k stand at different wavelengths; need the same"
        )
    rows = [
        (i, f"{n_line},{k_line.split(',')[1]}")
        for (i, n_line), (_, k_line) in zip(n_table[1:], k_table, strict=True)
    ]
    return [(n_table[0][0], "wl,n,k"), *rows]


def _row(
    line: str, order: list[int], width: int, where: str, scale: float
) -> list[float]:
    """Wavelength in um, n and k of one line.

    Args:
        line: of the file. order: columns of the three; -1: none, 0.
        width: number of fields. where: line, for messages. scale: wavelength to um.

    Raises:
        MaterialError: not numbers, or out of range.
    """
    fields = next(csv.reader([line]))
    if len(fields) != width:
        raise MaterialError(f"{where}: {len(fields)} fields, the header has {width}")
    try:
        values = [float(fields[column]) if column >= 0 else 0.0 for column in order]
    except ValueError:
        raise MaterialError(
            f"{where}: {line!r} is not numbers; need {COLUMNS}"
        ) from None
    wavelength_um, n, k = values = [values[0] * scale, *values[1:]]
    if not (
        all(math.isfinite(v) for v in values) and wavelength_um > 0 and n > 0 and k >= 0
    ):
        raise MaterialError(
            f"{where}: {line!r}; need finite wavelengths > 0, n > 0 and k >= 0 (exp(-iwt))"
        )
    return values


def _rising(
    rows: list[list[float]], numbers: list[int], where: str
) -> list[list[float]]:
    """The rows as they are, or all of them turned round."""
    if len(rows) < 2:
        raise MaterialError(f"{where}: {len(rows)} rows of numbers; need at least two")
    falls = rows[-1][0] < rows[0][0]
    for before, after, number in zip(rows, rows[1:], numbers[1:], strict=False):
        if (after[0] >= before[0]) if falls else (after[0] <= before[0]):
            raise MaterialError(
                f"{where}, line {number}: wavelength {after[0]:g} um follows {before[0]:g} um; need distinct "
                "wavelengths that rise or fall from row to row"
            )
    return rows[::-1] if falls else rows
