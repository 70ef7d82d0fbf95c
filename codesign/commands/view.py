"""Panels of a co-design run (training, searches, networks, predictions, lens), of rendered
eyes, of a budget.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from codesign.commands import budget as budgets
from metalens.core import report, store
from metalens.core.arrays import Array
from metalens.core.errors import StoreError
from metalens.view import (
    CurvePanel,
    ImagePanel,
    Panel,
    PointPanel,
    SliderAxis,
    TablePanel,
    at_brightest,
    lens_panels,
)

LOG = "log.jsonl"
RESULT = "result.json"
LENS = "lens.h5"
ANSWERS = "answers.h5"


def run_panels(path: Path) -> list[Panel]:
    """Panels of a run's folder, finished or not.

    Training curves, searched networks, results, test frames with predictions and lens,
    as far as their files exist.

    Args:
        path: of the folder.

    Raises:
        StoreError: a log or a result that is no JSON.
    """
    log, result = path / LOG, path / RESULT
    lines = log.read_text("utf-8").splitlines() if log.is_file() else []
    # a last line that is still being written is left out
    entries = [_parse_table(line, log) for line in lines if line.endswith("}")]
    panels = [*_training_panels(entries), *_search_panels(entries)]
    if result.is_file():
        panels += _network_panels(_parse_table(result.read_text("utf-8"), result))
    if (path / ANSWERS).is_file():
        panels += prediction_panels(path / ANSWERS)
    if (path / LENS).is_file():
        panels += lens_panels(path / LENS)
    return panels


def _parse_table(text: str, path: Path) -> dict[str, Any]:
    """JSON object from text.

    Raises:
        StoreError: not JSON, or not an object; ``path`` is named.
    """
    try:
        content = json.loads(text)
    except ValueError as error:
        raise StoreError(f"{path}: not JSON ({error})") from None
    if not isinstance(content, dict):
        raise StoreError(
            f"{path}: need a table of names and values, found {type(content).__name__}"
        )
    return content


def _training_panels(entries: list[dict[str, Any]]) -> list[Panel]:
    """A curve over the step for every logged number that varies; [] of less than two
    steps.
    """
    steps = [entry for entry in entries if entry.get("kind") == "step"]
    if len(steps) < 2:
        return []
    x = np.array([entry["step"] for entry in steps], float)
    curves = {
        report.in_words(name): np.array([e.get(name, np.nan) for e in steps], float)
        for name in steps[0]
        if name not in ("kind", "step")
    }
    return [
        CurvePanel(f"Training: {title}", x, "step", {title: curve}, "")
        for title, curve in curves.items()
        if np.ptp(curve) > 0
    ]


def _search_panels(entries: list[dict[str, Any]]) -> list[Panel]:
    """Error over cost of every network that the searches evaluated, Pareto set marked.

    The Pareto set: no other network is better in both.
    """
    births = [
        e
        for e in entries
        if e.get("kind") == "birth" and np.isfinite(e.get("error", math.nan))
    ]
    if not births:
        return []
    costs, errors = ([e[name] for e in births] for name in ("mmacs", "error"))
    pairs = list(zip(costs, errors, strict=True))
    front = [
        number
        for number, (cost, error) in enumerate(pairs)
        if not any(c <= cost and e <= error for c, e in set(pairs) - {(cost, error)})
    ]
    return [
        PointPanel(
            "Networks of the searches",
            costs,
            errors,
            "million MACs",
            "gaze error / deg",
            [f"budget {e['budget_mmacs']:g} million MACs" for e in births],
            front,
            caption="Errors are of the validation frames; log.jsonl holds the layers.",
        )
    ]


def prediction_panels(path: Path) -> list[Panel]:
    """Test frames, and predictions of the networks next to the truth.

    Pupil masks as images that alternate; a table of slippages in mm.

    Args:
        path: of the file.
    """
    stored = store.load(path, "answers")
    arrays = stored.arrays
    count = len(arrays["frames"])
    names = [
        str(stored.attributes[f"network_{i}"])
        for i in range(len(arrays["predicted_slip_um"]))
    ]
    frames = SliderAxis("frame", list(range(count)))
    panels: list[Panel] = [
        _pixels(
            "Frames of the test",
            arrays["frames"],
            [frames],
            "of its spread",
            from_least=True,
        )
    ]
    predicted = arrays["predicted_pupil"]
    truth = np.broadcast_to(arrays["pupil"], predicted.shape)
    choice = SliderAxis("shown", ["truth", "answer"], blink=True)
    axes = [SliderAxis("network", names), frames, choice]
    pair = np.stack([truth, predicted], axis=2)
    panels.append(_pixels("Pupil", pair, axes, "share of the pixel"))
    rows = []
    for i, name in enumerate(names):
        pairs = np.stack([arrays["slip_um"], arrays["predicted_slip_um"][i]], axis=2)
        values = np.c_[pairs.reshape(count, 6), arrays["interval_um"][i]] * 1e-3
        rows += [(name, k, *row) for k, row in enumerate(values.tolist())]
    columns = [f"{word} {axis} / mm" for axis in "xyz" for word in ("true", "read")]
    caption = "Slippage of the eye; z is along the axis of the camera."
    return [
        *panels,
        TablePanel(
            "Answers",
            ("network", "frame", *columns, "90 % interval of z / mm"),
            rows,
            caption,
        ),
    ]


def _network_panels(result: dict[str, Any]) -> list[Panel]:
    """Table of the results; [] without any."""
    rows = result.get("rows", [])
    names = sorted(
        {n for row in rows for n, v in row.items() if isinstance(v, (int, float, str))}
    )
    head = [report.in_words(name) for name in names]
    table = [[row.get(name, "") for name in names] for row in rows]
    return [TablePanel("Networks of the run", head, table)] if rows else []


def _pixels(
    title: str, values: Array, axes: list[SliderAxis], unit: str, **more: Any
) -> ImagePanel:
    """Pictures on the pixels of a frame."""
    return ImagePanel(title, values, axes, 1.0, unit, across="pixels", **more)


def scene_panels(path: Path) -> list[Panel]:
    """Rendered eyes, depth in mm and pupil mask of every frame; labels.csv holds labels.

    The depth of a pixel is that of the sheet that covers most of it.

    Args:
        path: of the file.
    """
    arrays = store.load(path, "scene").arrays
    frames = [SliderAxis("frame", list(range(len(arrays["radiance"]))))]
    full = float(np.iinfo(arrays["radiance"].dtype).max)
    # the far sheet's depth counts where it covers most of the pixel
    is_far = arrays["coverage"] > full / 2
    depth_mm = 1e-3 * np.where(
        is_far, arrays["depth_um"][:, 1], arrays["depth_um"][:, 0]
    )
    radiance = arrays["radiance"].sum(1, dtype=float) / full
    pupil = arrays["pupil"] / full
    return [
        _pixels("Rendered eyes", radiance, frames, "of full light"),
        _pixels("Depth", depth_mm, frames, "mm from the lens", from_least=True),
        _pixels("Pupil", pupil, frames, "share of the pixel"),
    ]


def image_panels(path: Path) -> list[Panel]:
    """Scene and image with its error, their difference, PSFs over field and depth.

    Args:
        path: of the file.
    """
    stored = store.load(path, "image")
    arrays = stored.arrays
    attributes = stored.attributes
    frames = SliderAxis("frame", list(range(len(arrays["scene"]))))
    pairs = np.stack([arrays["scene"], arrays["image"]], axis=1)
    choice = SliderAxis("shown", ["scene", "image"], blink=True)
    axes = [SliderAxis("depth", (1e-3 * arrays["depth_um"]).tolist(), "mm")]
    axes += [
        SliderAxis("field, down", arrays["y_deg"].tolist(), "deg"),
        SliderAxis("field, across", arrays["x_deg"].tolist(), "deg"),
    ]
    psf = arrays["psf"] / arrays["psf"].max()
    pitch_um = float(attributes["pitch_um"])
    difference = arrays["image"] - arrays["scene"]
    note = f"Relative L2 error of a texture: {float(attributes['error']):.2g}."
    unit = "light, as of the scene"
    return [
        ImagePanel(
            "Scene and image", pairs, [frames, choice], pitch_um, unit, caption=note
        ),
        ImagePanel(
            "Image less scene", difference, [frames], pitch_um, unit, signed=True
        ),
        ImagePanel(
            "Points of the field",
            psf,
            at_brightest(axes, psf),
            pitch_um,
            "of the highest peak",
            optics=True,
        ),
    ]


def budget_panels(path: Path) -> list[Panel]:
    """Table of the error of every link from pillar to gaze: phase, PSF and gaze.

    Args:
        path: of the file.
    """
    table = budgets.budget_table(budgets.load_budget(path))
    return [TablePanel("Error of every link", table.head, table.rows, table.caption)]
