"""Where the stage stood: stage.csv or stage.json beside the frames, capture.toml with what else is known."""

import csv
import json
import math
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from metalens.errors import CaptureError, nearest
from metalens.store import Array

_LENGTHS = {"um": 1.0, "nm": 1e-3, "mm": 1e3}
_POSITIONS = {f"{name}_{unit}": scale for name in ("depth", "z", "position") for unit, scale in _LENGTHS.items()}
_ANGLES = {"angle_deg": math.pi / 180, "angle_rad": 1.0}
_COLUMNS = {"file", "page", "exposure_s", "angle_y_deg", "angle_y_rad"} | set(_POSITIONS) | set(_ANGLES)


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """One row a frame, as listed in the stage file.

    files: image names; page: index inside that image file; source: the stage file, for messages.
    """

    files: tuple[str, ...]
    page: tuple[int, ...]
    position_um: Array
    angle_rad: Array
    exposure_s: Array
    source: str

    @classmethod
    def unknown(cls, names: tuple[str, ...]) -> "Rows":
        """Rows for frames of which nothing but the name is known."""
        n = len(names)
        return cls(names, (0,) * n, np.full(n, np.nan), np.zeros((n, 2)), np.full(n, np.nan), "")


def read_stage(folder: Path) -> Rows | None:
    """The stage file of a capture folder; None where there is none.

    Columns: ``file``, ``page`` (default 0), one of depth/z/position with unit (``depth_um``, ``z_nm``,
    ``position_mm``), ``angle_deg``, ``angle_y_deg``, ``exposure_s``. JSON: a list of such objects.

    Raises:
        CaptureError: unknown column, no column ``file``, a value that is no number; file and row are named.
    """
    for path in (folder / "stage.csv", folder / "stage.json"):
        if path.is_file():
            table = _read_csv(path) if path.suffix == ".csv" else _read_json(path)
            return _rows(table, path)
    return None


def read_about(folder: Path) -> dict[str, Any]:
    """Entries of ``capture.toml`` in a capture folder; empty where there is none.

    Raises:
        CaptureError: not TOML, or a number that must be above 0 is not.
    """
    path = folder / "capture.toml"
    if not path.is_file():
        return {}
    try:
        about = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: not valid TOML: {error}") from None
    for name in ("pixel_um", "wavelength_um", "bits"):
        value = about.get(name, 1)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise CaptureError(f"{path}: {name} = {value!r}, need a number above 0")
    return about


def ome_positions(xml: str) -> Array:
    """Stage positions of the planes in OME-XML, um (PositionZ with its unit, default um)."""
    planes = re.findall(r'PositionZ="([^"]+)"(?:[^>]*PositionZUnit="([^"]+)")?', xml)
    return np.array([float(z) * _LENGTHS.get(unit.replace("µ", "u"), 1.0) for z, unit in planes])


def _read_csv(path: Path) -> list[dict[str, Any]]:
    with open(path, newline="", encoding="utf-8-sig") as file:
        return list(csv.DictReader(file, skipinitialspace=True))


def _read_json(path: Path) -> list[dict[str, Any]]:
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(table, list) or not all(isinstance(row, dict) for row in table):
        raise CaptureError(f"{path}: need a list of objects, one a frame")
    return table


def _rows(table: list[dict[str, Any]], path: Path) -> Rows:
    if not table:
        raise CaptureError(f"{path}: no rows; need one a frame")
    for row, entries in enumerate(table, 2):
        for key in entries:
            if key not in _COLUMNS:
                raise CaptureError(f"{path}, row {row}: unknown column {key!r}{nearest(str(key), _COLUMNS)}")
        if not entries.get("file"):
            raise CaptureError(f"{path}, row {row}: no 'file'; name the image of every row")
    head = table[0].keys()
    place = next((key for key in _POSITIONS if key in head), None)
    angle = [next((k for k in names if k in head), None) for names in (_ANGLES, ("angle_y_deg", "angle_y_rad"))]
    scales = [_ANGLES.get((key or "").replace("_y_", "_"), 1.0) for key in angle]
    columns = [_column(table, key, path) * s for key, s in zip(angle, scales, strict=True)]
    return Rows(
        files=tuple(str(entries["file"]) for entries in table),
        page=tuple(int(v) for v in _column(table, "page" if "page" in head else None, path)),
        position_um=_column(table, place, path, np.nan) * _POSITIONS.get(place or "", 1.0),
        angle_rad=np.stack(columns, 1),
        exposure_s=_column(table, "exposure_s" if "exposure_s" in head else None, path, np.nan),
        source=str(path),
    )


def _column(table: list[dict[str, Any]], key: str | None, path: Path, default: float = 0.0) -> Array:
    if key is None:
        return np.full(len(table), default)
    values = []
    for row, entries in enumerate(table, 2):
        try:
            value = float(entries[key])
        except (TypeError, ValueError, KeyError):
            raise CaptureError(f"{path}, row {row}: {key} is {entries.get(key)!r}, need a number") from None
        if not math.isfinite(value):
            raise CaptureError(f"{path}, row {row}: {key} is {value}, need a finite number")
        values.append(value)
    return np.array(values)
