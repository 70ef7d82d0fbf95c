"""Stage table (stage.csv, stage.json) and description (capture.toml, capture.json) of a
capture folder.
"""

import csv
import difflib
import json
import math
import re
import tomllib
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from characterize.captures import folder as naming
from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError, nearest_name_hint

_LENGTHS = {"um": 1.0, "nm": 1e-3, "mm": 1e3, "cm": 1e4, "m": 1e6}
_TAGGED = {**_LENGTHS, "micron": 1.0, "microns": 1.0, "inch": 25400.0}
_BARE = ("depth", "z", "position", "exposure")
# column of a stage table: (quantity, value of its unit in um, rad or s)
_COLUMNS = {
    **{
        f"{name}_{unit}": ("position", scale)
        for name in _BARE[:3]
        for unit, scale in _LENGTHS.items()
    },
    "angle_deg": ("angle", math.pi / 180),
    "angle_rad": ("angle", 1.0),
    "angle_y_deg": ("angle along y", math.pi / 180),
    "angle_y_rad": ("angle along y", 1.0),
    "exposure_s": ("exposure", 1.0),
    "exposure_ms": ("exposure", 1e-3),
    "exposure_us": ("exposure", 1e-6),
    "file": ("file", 1.0),
    "page": ("page", 1.0),
}
# of a plan (metalens capture --protocol): in proportion, no times
_PLANNED = "relative_exposure"
_ALIASES = {
    f"{name}_{unit}": (entry, scale)
    for entry, names in {
        "pixel_um": ("pixel", "pixel_size"),
        "step_um": ("step", "z_step"),
        "wavelength_um": ("wavelength", "emission"),
    }.items()
    for name in names
    for unit, scale in (("um", 1.0), ("nm", 1e-3))
    if f"{name}_{unit}" != entry
}
_ABOVE = ("above 0", lambda v: v > 0)
_FROM_0 = ("from 0 on", lambda v: v >= 0)
_TILT = ("between -90 and 90", lambda v: abs(v) < 90)
_NUMBERS: dict[str, tuple[str, Callable[[float], bool]]] = {
    "pixel_um": _ABOVE,
    "wavelength_um": _ABOVE,
    "gain_e": _ABOVE,
    "step_um": ("above 0, or below", lambda v: v != 0),
    "bits": ("above 0, whole, at most 32", lambda v: v == round(v) and 0 < v <= 32),
    "offset": ("of counts", lambda v: True),
    "glass_tilt_x_deg": _TILT,
    "glass_tilt_y_deg": _TILT,
    **dict.fromkeys(
        (
            "read_noise_e",
            "wavelength_sigma_nm",
            "pixel_sigma_um",
            "pinhole_um",
            "glass_um",
        ),
        _FROM_0,
    ),
}
_KNOWN = (*_NUMBERS, *_ALIASES, "voxel_um", "channel", "mosaic", "axes", "window")
_MICRO = str.maketrans("\u00b5\u03bc", "uu")
_SIMILARITY = 0.75  # least similarity of a misspelt name


@dataclass(frozen=True, eq=False, slots=True)
class StageRows:
    """One row a frame, as listed in the stage file.

    files: image names; page: index inside that image file, None where the table has no
    such column; source: the stage
    file, for messages.
    """

    files: tuple[str, ...]
    page: tuple[int | None, ...]
    position_um: Array
    angle_rad: Array
    exposure_s: Array
    source: str

    @classmethod
    def unknown(cls, names: tuple[str, ...]) -> "StageRows":
        """Rows for frames of which nothing but the name is known."""
        n = len(names)
        return cls(
            names,
            (None,) * n,
            np.full(n, np.nan),
            np.zeros((n, 2)),
            np.full(n, np.nan),
            "",
        )


def unit_um(unit: str) -> float:
    """Length of a unit in um, as tags of files name it; nan for what is no length.

    >>> unit_um("µm"), unit_um("inch"), unit_um("pixel")
    (1.0, 25400.0, nan)
    """
    plain = unit.strip().lower().replace("\\u00b5", "u").replace("\\u03bc", "u")
    return _TAGGED.get(plain.translate(_MICRO), math.nan)


def read_stage(folder: Path) -> StageRows | None:
    """The stage file of a capture folder; None where there is none.

    Columns: ``file``; ``page`` (from 0; without it a stack has a row for each page in
    turn); one of depth/z/position with unit, nm to m (``depth_um``, ``z_nm``,
    ``position_mm``); ``angle_deg``, ``angle_y_deg``; ``exposure_s`` (or ``_ms``,
    ``_us``). JSON: a list of such objects.

    Raises:
        CaptureError: an unknown column, one without its unit, two of depth or of one
            angle, no column ``file``, another separator than commas, more values than
            columns, a value that is no number, a page that is not whole; file and row
            are named. A table in another format (``stage.xlsx``).
    """
    path = naming.find_table(folder, "stage")
    return _parse_rows(_read_table(path), path) if path else None


def read_about(folder: Path) -> dict[str, Any]:
    """Entries of ``capture.toml`` or ``capture.json`` in a capture folder; empty where
    there is none.

    Raises:
        CaptureError: not TOML or JSON, a misspelt name, or an impossible number.
    """
    return _read_description(naming.find_table(folder, "capture"))


def read_sidecar(path: Path) -> dict[str, Any]:
    """Entries of the TOML or JSON file with the name of an image file; empty
    where there is none.

    Args:
        path: the image file.

    Raises:
        CaptureError: as :func:`read_about`.
    """
    paths = [path.with_suffix(suffix) for suffix in (".toml", ".json")]
    return _read_description(next((p for p in paths if p.is_file()), None))


def _read_description(path: Path | None) -> dict[str, Any]:
    """Checked entries of a TOML or JSON description in the standard units; empty
    without a file.
    """
    if path is None:
        return {}
    try:
        text = reading.read_text(path)
        description = (
            tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
        )
    except (
        ValueError,
        RecursionError,
    ) as error:  # of the format, of the text, or an integer of thousands of digits
        raise CaptureError(
            f"{path}: not valid {path.suffix[1:].upper()}: {error}"
        ) from None
    if not isinstance(description, dict):
        raise CaptureError(
            f"{path}: need entries by name (pixel_um, step_um, wavelength_um ...)"
        )
    for name, (entry, scale) in _ALIASES.items():
        if name in description and entry not in description:
            value = description.pop(name)
            description[entry] = (
                value * scale if isinstance(value, int | float) else value
            )
    if "voxel_um" in description:
        voxel = description.pop("voxel_um")
        if not isinstance(voxel, list) or len(voxel) != 3:
            raise CaptureError(f"{path}: voxel_um = {voxel!r}, need [z, y, x]")
        description = {"step_um": voxel[0], "pixel_um": voxel[2]} | description
    return _check_entries(description, path)


def _check_entries(description: dict[str, Any], path: Path) -> dict[str, Any]:
    """The entries, with ``bits`` as an integer.

    Misspelt names and impossible numbers are refused; unfamiliar names stay as notes.
    """
    for name, value in description.items():
        similar = difflib.get_close_matches(name, _KNOWN, n=1, cutoff=_SIMILARITY)
        if name not in _KNOWN and similar:
            raise CaptureError(
                f"{path}: unknown entry {name!r}; did you mean {similar[0]!r}?"
            )
        if name not in _NUMBERS:
            continue
        requirement, is_valid = _NUMBERS[name]
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (is_number and math.isfinite(value) and is_valid(value)):
            raise CaptureError(
                f"{path}: {name} = {value!r}, need a number {requirement}"
            )
    if "bits" in description:
        description["bits"] = int(description["bits"])
    return description


def _read_table(path: Path) -> list[dict[str, Any]]:
    """Records of a CSV table, or of a JSON list of objects, one a frame."""
    try:
        text = reading.read_text(path)
        if path.suffix.lower() != ".csv":
            table = json.loads(text)
        else:
            lines = text.splitlines(keepends=True)
            table = list(csv.DictReader(lines, skipinitialspace=True))
    except (csv.Error, ValueError, RecursionError) as error:
        raise CaptureError(
            f"{path}: not {path.suffix[1:].upper()} in UTF-8 or UTF-16 text: {error}"
        ) from None
    if not isinstance(table, list) or not all(isinstance(row, dict) for row in table):
        raise CaptureError(f"{path}: need a list of objects, one a frame")
    while table and not any(table[-1].values()):  # as spreadsheets leave below theirs
        table.pop()
    if not table:
        raise CaptureError(f"{path}: no rows; need one a frame")
    return table


def _parse_rows(table: list[dict[str, Any]], path: Path) -> StageRows:
    """Rows of a stage table in um, rad and s; refuses wrong or ambiguous columns.

    Args:
        table: one record a row, by column names.
        path: the stage file, for messages.
    """
    for mark in ";\t|":
        if mark in next(iter(table[0]), ""):
            raise CaptureError(
                f"{path}: columns parted by {mark!r}; save it with commas, and points "
                "in the numbers"
            )
    table = [_checked_row(entries, path, row) for row, entries in enumerate(table, 2)]
    columns: dict[str, str] = {}
    for key in table[0]:
        other = columns.setdefault(_COLUMNS[key][0], key)
        if other != key:
            raise CaptureError(
                f"{path}: columns {other} and {key} say the same; leave the one that "
                "holds"
            )

    def values_of(quantity: str, default: float) -> Array:
        """(n,) values of a quantity in um, rad or s."""
        if quantity not in columns:
            return np.full(len(table), default)
        key = columns[quantity]
        numbers = [
            _number(entries.get(key), key, f"{path}, row {row}: {key} is")
            for row, entries in enumerate(table, 2)
        ]
        return np.array(numbers) * _COLUMNS[key][1]

    return StageRows(
        tuple(str(entries["file"]) for entries in table),
        tuple(None if page < 0 else int(page) for page in values_of("page", -1.0)),
        values_of("position", np.nan),
        np.stack([values_of("angle", 0.0), values_of("angle along y", 0.0)], 1),
        values_of("exposure", np.nan),
        str(path),
    )


def _checked_row(entries: dict[str, Any], path: Path, row: int) -> dict[str, Any]:
    """A row with column names in small letters, without blanks, micro signs as u."""
    if None in entries:
        raise CaptureError(
            f"{path}, row {row}: more values than columns "
            f"({', '.join(map(str, list(entries)[:-1]))}); a comma inside "
            "a number? write it with a point (0.73)"
        )
    plain = {
        str(key).strip().lower().translate(_MICRO): value
        for key, value in entries.items()
    }
    if len(plain) < len(entries):
        raise CaptureError(
            f"{path}: columns {', '.join(entries)} are not all different; leave the "
            "ones that hold"
        )
    for key in plain:
        if key in _BARE:
            units = "s (or _ms, _us)" if key == "exposure" else "um (or _nm, _mm, _m)"
            raise CaptureError(
                f"{path}: column {key!r} without a unit; name it {key}_{units}"
            )
        if key == _PLANNED:
            raise CaptureError(
                f"{path}: {_PLANNED} is what a plan asks for, no time; write the "
                "exposure that each frame had as exposure_s (or _ms, _us)"
            )
        if key not in _COLUMNS:
            raise CaptureError(
                f"{path}, row {row}: unknown column "
                f"{key!r}{nearest_name_hint(str(key), _COLUMNS)}"
            )
    if not plain.get("file"):
        raise CaptureError(f"{path}, row {row}: no 'file'; name the image of every row")
    return plain


def _number(text: Any, key: str, where: str) -> float:
    """Finite number of a cell; pages are whole, exposures above 0."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        hint = " with a point, as 0.73" if "," in str(text) else ""
        raise CaptureError(f"{where} {text!r}, need a number{hint}") from None
    if not math.isfinite(value):
        raise CaptureError(f"{where} {value}, need a finite number")
    if key == "page" and (value != round(value) or value < 0):
        raise CaptureError(f"{where} {value:g}, need a whole number from 0 on")
    if key.startswith("exposure") and value <= 0:
        raise CaptureError(
            f"{where} {value:g}, need above 0; leave the column out if unknown"
        )
    return value


def unlisted_images_text(files: Sequence[Path], rows: StageRows) -> tuple[str, ...]:
    """What to say of images in the folder that the stage file does not name.

    Args:
        files: image files of the folder.
        rows: rows of the stage file.

    Raises:
        CaptureError: they are called as dark frames or flats, and would not be used.
    """
    named = {normalize_spelling(Path(name).name) for name in rows.files}
    unlisted = [
        path.name for path in files if normalize_spelling(path.name) not in named
    ]
    for name in unlisted:
        if kind := re.match(r"(dark|flat)s?(?![a-z])", name.lower()):
            raise CaptureError(
                f"{rows.source}: {name!r} is not named there and would not be used; "
                f"put all {kind[1]} frames into one "
                f"stack {kind[1]}.tif"
            )
    return (
        (
            f"{len(unlisted)} images that {rows.source} does not name left out: "
            f"{', '.join(unlisted[:5])}",
        )
        if unlisted
        else ()
    )


def unread_keys_text(about: dict[str, Any]) -> tuple[str, ...]:
    """What to say of entries of a capture's description that nothing reads.

    Args:
        about: entries of the capture's description.
    """
    unread = [reading.to_valid_utf8(name) for name in about if name not in _KNOWN]
    return (
        (
            "entries of the description that change nothing, kept as notes: "
            f"{', '.join(unread[:8])}",
        )
        if unread
        else ()
    )


def normalize_spelling(name: str) -> str:
    """A file name in one spelling: some systems write an umlaut as a letter and its
    dots.
    """
    return unicodedata.normalize("NFC", name)
