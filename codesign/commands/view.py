"""Panels of a co-design run (how it trained, what its networks read, its lens), of rendered eyes, and of a budget."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from codesign.commands import budget as budgets
from metalens.ground import report, store
from metalens.ground.errors import StoreError
from metalens.view import Axis, Curves, Images, Numbers, Panel, lens_panels

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


def scene(path: Path) -> list[Panel]:
    """Rendered eyes: what the camera would see, depth, pupil mask, and the labels of every frame."""
    held = store.load(path, "scene").arrays
    count = len(held["radiance"])
    frames, full = [Axis("frame", list(range(count)))], float(np.iinfo(held["radiance"].dtype).max)
    far = held["coverage"] > full / 2  # the far sheet shows where it covers most of the pixel
    depth_mm = 1e-3 * np.where(far, held["depth_um"][:, 1], held["depth_um"][:, 0])
    labels = {k.removeprefix("labels/"): v for k, v in held.items() if k.startswith("labels/")}
    told = {name: value for name in ("slip_um", "pupil_um", "visible") if (value := labels.get(name)) is not None}
    head = [f"{report.in_words(name)}{axis}" for name, v in told.items() for axis in ([""] if v.ndim == 1 else _XYZ)]
    rows = [[i, *np.concatenate([np.atleast_1d(v[i]) for v in told.values()]).tolist()] for i in range(count)]
    return [
        Images(
            "Rendered eyes", held["radiance"].sum(1, dtype=float) / full, frames, 1.0, "of full light", across="pixels"
        ),
        Images("Depth", depth_mm, frames, 1.0, "mm from the lens", across="pixels", from_least=True),
        Images("Pupil", held["pupil"] / full, frames, 1.0, "share of the pixel", across="pixels"),
        Numbers("Labels", ("frame", *head), rows, "Positions in the camera's axes; labels.csv holds all of them."),
    ]


def layers(path: Path) -> list[Panel]:
    """The layers of one frame, as images are formed of them."""
    held = store.load(path, "layers").arrays
    axis = [Axis("layer at", (1e-3 * held["depth_um"]).tolist(), "mm")]
    return [
        Images("Light of a layer", held["radiance"], axis, 1.0, "of full light", across="pixels"),
        Images("What a layer covers", held["coverage"], axis, 1.0, "share of the pixel", across="pixels"),
    ]


def budget(path: Path) -> list[Panel]:
    """Every link from pillar to answer with its error."""
    rows = [
        (row.link, row.phase_rad, row.psf, math.degrees(row.gaze_rad), "yes" if row.counted else "no", row.method)
        for row in budgets.load(path)
    ]
    shown = [tuple("–" if isinstance(v, float) and math.isnan(v) else v for v in row) for row in rows]
    head = ("link", "phase / rad", "PSF, relative L2", "gaze / deg", "in the sum", "how")
    words = "The last row is the root of the sum of squares of those that are in the sum."
    return [Numbers("Error of every link", head, shown, words)]


_XYZ = (", x", ", y", ", z")
