"""Panels of a co-design run: how it trained, what its networks read and cost, and the lens it ended with."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from metalens.ground import report
from metalens.ground.errors import StoreError
from metalens.view import Curves, Numbers, Panel, lens_panels

LOG, RESULT, LENS = "log.jsonl", "result.json", "lens.h5"


def panels(path: Path) -> list[Panel]:
    """A run's folder, finished or not.

    Raises:
        StoreError: a log or a result that is no JSON.
    """
    shown = _training(_lines(path / LOG))
    if (path / RESULT).is_file():
        shown += _networks(_json((path / RESULT).read_text(encoding="utf-8"), path / RESULT))
    if (path / LENS).is_file():
        shown += lens_panels(path / LENS)
    return shown


def _lines(path: Path) -> list[dict[str, Any]]:
    """Entries of the log; a last line that is still being written is left out."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    whole = [line for line in lines if line.endswith("}")]
    return [_json(line, path) for line in whole]


def _json(text: str, path: Path) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise StoreError(f"{path}: not JSON ({error})") from None
    if not isinstance(found, dict):
        raise StoreError(f"{path}: need a table of names and values, found {type(found).__name__}")
    return found


def _training(entries: list[dict[str, Any]]) -> list[Panel]:
    steps = [entry for entry in entries if entry.get("kind") == "step"]
    if len(steps) < 2:
        return []
    x = np.array([entry["step"] for entry in steps], float)
    names = [k for k, v in steps[0].items() if k not in ("kind", "step") and isinstance(v, (int, float))]
    lines = {name: np.array([entry.get(name, np.nan) for entry in steps], float) for name in names}
    said = {name: report.in_words(name) for name in names}
    moving = [name for name in names if np.ptp(lines[name]) > 0]
    return [Curves(f"Training: {said[name]}", x, "step", {said[name]: lines[name]}, "") for name in moving]


def _networks(result: dict[str, Any]) -> list[Panel]:
    rows = [row for row in result.get("rows", []) if isinstance(row, dict)]
    names = sorted({name for row in rows for name, value in row.items() if isinstance(value, (int, float, str))})
    table = [[row.get(name, "") for name in names] for row in rows]
    return [Numbers("Networks of the run", [report.in_words(name) for name in names], table)]
