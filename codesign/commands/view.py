"""Panels of a co-design run (training, searches, networks, answers, bound, lens), of
rendered eyes, of a budget.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from codesign.commands import budget as budgets
from codesign.network import Architecture
from codesign.train import EvaluatedCandidate, pareto_front
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
    """A run's folder, finished or not.

    Args:
        path: of the file.

    Raises:
        StoreError: a log or a result that is no JSON.
    """
    entries = _lines(path / LOG)
    result = (
        _json((path / RESULT).read_text(encoding="utf-8"), path / RESULT)
        if (path / RESULT).is_file()
        else {}
    )
    shown = [*_training(entries), *_searched(entries), *_networks(result)]
    if (path / ANSWERS).is_file():
        shown += prediction_panels(path / ANSWERS)
    shown += _bound(result)
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
        raise StoreError(
            f"{path}: need a table of names and values, found {type(found).__name__}"
        )
    return found


def _training(entries: list[dict[str, Any]]) -> list[Panel]:
    steps = [entry for entry in entries if entry.get("kind") == "step"]
    if len(steps) < 2:
        return []
    x = np.array([entry["step"] for entry in steps], float)
    names = [
        k
        for k, v in steps[0].items()
        if k not in ("kind", "step") and isinstance(v, (int, float))
    ]
    lines = {
        name: np.array([entry.get(name, np.nan) for entry in steps], float)
        for name in names
    }
    said = {name: report.in_words(name) for name in names}
    moving = [name for name in names if np.ptp(lines[name]) > 0]
    budgets = list(
        dict.fromkeys(
            entry["budget_mmacs"] for entry in entries if "budget_mmacs" in entry
        )
    )
    shown = {name: {said[name]: lines[name]} for name in moving}
    if "mmacs" in shown and len(budgets) > 1:
        shown["mmacs"] = _in_turn(x, lines["mmacs"], budgets)
    return [
        CurvePanel(f"Training: {said[name]}", x, "step", curves, "")
        for name, curves in shown.items()
    ]


def _in_turn(step: Array, values: Array, budgets: list[float]) -> dict[str, Array]:
    """A curve for each budget, of what is of a step for each in turn; between its steps
    the last value stands.
    """
    curves = {}
    for i, budget in enumerate(budgets):
        last = np.maximum.accumulate(
            np.where((step - 1) % len(budgets) == i, np.arange(len(step)), -1)
        )
        curves[f"budget {budget:g}"] = np.where(last >= 0, values[last], np.nan)
    return curves


def _searched(entries: list[dict[str, Any]]) -> list[Panel]:
    """Every network that the searches tried, and those that no other beats in both
    error and cost.
    """
    births = [
        e
        for e in entries
        if e.get("kind") == "birth" and {"error", "mmacs", "budget_mmacs"} <= set(e)
    ]
    births = [e for e in births if math.isfinite(e["error"])]
    if not births:
        return []
    tried = [
        EvaluatedCandidate(
            _architecture(e.get("architecture", {})), e["error"], e["mmacs"]
        )
        for e in births
    ]
    front = [
        next(i for i, one in enumerate(tried) if one is best)
        for best in pareto_front(tried)
    ]
    notes = [
        dict(_layers(e["architecture"])) if e.get("architecture") else {}
        for e in births
    ]
    return [
        PointPanel(
            "Networks of the searches",
            [e["mmacs"] for e in births],
            [e["error"] for e in births],
            "million MACs",
            "gaze error / deg",
            [f"budget {e['budget_mmacs']:g} million MACs" for e in births],
            front,
            notes=notes,
            caption="Errors are of the validation frames. Pick a network to read its layers.",
        )
    ]


def _architecture(held: dict[str, Any]) -> Architecture:
    sizes = {
        name: tuple(held.get(name, ())) for name in ("depths", "kernels", "expansions")
    }
    return Architecture(
        **sizes, width=held.get("width", 1.0), resolution=held.get("resolution", 1.0)
    )


def _layers(held: dict[str, Any]) -> list[tuple[str, str]]:
    """(what, how many) of a network: its input, its channels, and the blocks of each
    stage.
    """
    depths = held["depths"]
    slots = len(held["kernels"]) // len(depths)
    rows = [
        ("input scale", f"{held['resolution']:.3g}"),
        ("channels, of the full ones", f"{held['width']:.3g}"),
    ]
    for stage, depth in enumerate(depths):
        used = range(stage * slots, stage * slots + depth)
        blocks = ", ".join(
            f"{held['kernels'][i]}×{held['kernels'][i]} × {held['expansions'][i]:g}"
            for i in used
        )
        rows.append((f"stage {stage + 1}", blocks))
    return rows


def _bound(result: dict[str, Any]) -> list[Panel]:
    held = result.get("bound")
    if not held:
        return []
    x = np.array(held["depth_mm"])
    least = np.array(held["window_depth_mm"])
    words = (
        "Least standard deviation of any reader of the blur of one window, on axis: 1/f texture as wide as the PSFs, "
        "noise a thousandth of its power. Readers of real frames collect less."
    )
    return [
        CurvePanel(
            "Bound on the depth of a window",
            x,
            "depth / mm",
            {"bound": least},
            "mm",
            caption=words,
            scale="log",
        )
    ]


def prediction_panels(path: Path) -> list[Panel]:
    """Test frames and what the networks said of them, beside the truth.

    Args:
        path: of the file.
    """
    stored = store.load(path, "answers")
    held, count = stored.arrays, len(stored.arrays["frames"])
    names = [
        str(stored.attributes[f"network_{i}"]) for i in range(len(held["told_slip_um"]))
    ]
    axes = [
        SliderAxis("network", names),
        SliderAxis("frame", list(range(count))),
        SliderAxis("shown", ["truth", "answer"], blink=True),
    ]
    shown: list[Panel] = [
        ImagePanel(
            "Frames of the test",
            held["frames"],
            axes[1:2],
            1.0,
            "of its spread",
            across="pixels",
            from_least=True,
        )
    ]
    for title, true, told, unit in _PAIRS:
        if told in held:
            both = np.stack(
                [np.broadcast_to(held[true], held[told].shape), held[told]], axis=2
            )
            scaled = both * (1e-3 if unit == "mm" else 1.0)
            shown.append(
                ImagePanel(
                    title,
                    scaled,
                    axes,
                    1.0,
                    unit,
                    across="cells",
                    from_least=unit == "mm",
                )
            )
    rows = []
    for i, name in enumerate(names):
        slips = np.stack([held["slip_um"], held["told_slip_um"][i]], axis=2).reshape(
            count, 6
        )
        wide = [1e-3 * v if v == v else "–" for v in held["interval_um"][i].tolist()]
        rows += [(name, k, *(1e-3 * slips[k]).tolist(), wide[k]) for k in range(count)]
    head = [f"{word} {axis} / mm" for axis in "xyz" for word in ("true", "read")]
    words = "Slippage of the eye; z is along the axis of the camera."
    return [
        *shown,
        TablePanel(
            "Answers",
            ("network", "frame", *head, "90 % interval of z / mm"),
            rows,
            words,
        ),
    ]


def _networks(result: dict[str, Any]) -> list[Panel]:
    if not result:
        return []
    rows = [row for row in result.get("rows", []) if isinstance(row, dict)]
    names = sorted(
        {
            name
            for row in rows
            for name, value in row.items()
            if isinstance(value, (int, float, str))
        }
    )
    table = [[row.get(name, "") for name in names] for row in rows]
    shown: list[Panel] = [
        TablePanel(
            "Networks of the run", [report.in_words(name) for name in names], table
        )
    ]
    drawn = [
        (f"budget {row['budget_mmacs']:g}", _layers(held))
        for row in rows
        if (held := row.get("architecture"))
    ]
    if drawn:
        head = ["", *(name for name, _ in drawn)]
        lines = [
            [what, *(layers[i][1] for _, layers in drawn)]
            for i, (what, _) in enumerate(drawn[0][1])
        ]
        words = "Blocks of each stage: side of the kernel × expansion of the channels."
        shown.append(TablePanel("Layers of the networks", head, lines, words))
    return shown


def scene_panels(path: Path) -> list[Panel]:
    """Rendered eyes: what the camera would see, depth, pupil mask, and the labels of
    every frame.

    Args:
        path: of the file.
    """
    held = store.load(path, "scene").arrays
    count = len(held["radiance"])
    frames = [SliderAxis("frame", list(range(count)))]
    full = float(np.iinfo(held["radiance"].dtype).max)
    far = (
        held["coverage"] > full / 2
    )  # the far sheet shows where it covers most of the pixel
    depth_mm = 1e-3 * np.where(far, held["depth_um"][:, 1], held["depth_um"][:, 0])
    labels = {
        k.removeprefix("labels/"): v for k, v in held.items() if k.startswith("labels/")
    }
    told = {
        name: value
        for name in ("slip_um", "pupil_um", "visible")
        if (value := labels.get(name)) is not None
    }
    head = [
        f"{report.in_words(name)}{axis}"
        for name, v in told.items()
        for axis in ([""] if v.ndim == 1 else _XYZ)
    ]
    rows = [
        [i, *np.concatenate([np.atleast_1d(v[i]) for v in told.values()]).tolist()]
        for i in range(count)
    ]
    return [
        ImagePanel(
            "Rendered eyes",
            held["radiance"].sum(1, dtype=float) / full,
            frames,
            1.0,
            "of full light",
            across="pixels",
        ),
        ImagePanel(
            "Depth",
            depth_mm,
            frames,
            1.0,
            "mm from the lens",
            across="pixels",
            from_least=True,
        ),
        ImagePanel(
            "Pupil",
            held["pupil"] / full,
            frames,
            1.0,
            "share of the pixel",
            across="pixels",
        ),
        TablePanel(
            "Labels",
            ("frame", *head),
            rows,
            "Positions in the camera's axes; labels.csv holds all of them.",
        ),
    ]


def layer_panels(path: Path) -> list[Panel]:
    """The layers of one frame, as images are formed of them.

    Args:
        path: of the file.
    """
    held = store.load(path, "layers").arrays
    axis = [SliderAxis("layer at", (1e-3 * held["depth_um"]).tolist(), "mm")]
    return [
        ImagePanel(
            "Light of a layer",
            held["radiance"],
            axis,
            1.0,
            "of full light",
            across="pixels",
        ),
        ImagePanel(
            "What a layer covers",
            held["coverage"],
            axis,
            1.0,
            "share of the pixel",
            across="pixels",
        ),
    ]


def image_panels(path: Path) -> list[Panel]:
    """Scenes and what a lens makes of them, and the PSFs over field and depth that did
    it.

    Args:
        path: of the file.
    """
    stored = store.load(path, "image")
    held, about = stored.arrays, stored.attributes
    frames = SliderAxis("frame", list(range(len(held["scene"]))))
    both = np.stack([held["scene"], held["image"]], axis=1)
    shown = SliderAxis("shown", ["scene", "image"], blink=True)
    names = [SliderAxis("depth", (1e-3 * held["depth_um"]).tolist(), "mm")]
    names += [
        SliderAxis("field, down", held["y_deg"].tolist(), "deg"),
        SliderAxis("field, across", held["x_deg"].tolist(), "deg"),
    ]
    psf = held["psf"] / held["psf"].max()
    step = float(about["pitch_um"])
    parts = [
        (report.in_words(k.removeprefix("error_")), v)
        for k, v in sorted(about.items())
        if k.startswith("error_")
    ]
    words = f"Relative L2 error of a texture, {float(about['error']):.2g} together; outside: light beyond the windows."
    unit = "light, as of the scene"
    return [
        ImagePanel("Scene and image", both, [frames, shown], step, unit),
        ImagePanel(
            "Image less scene",
            held["image"] - held["scene"],
            [frames],
            step,
            unit,
            signed=True,
        ),
        ImagePanel(
            "Points of the field",
            psf,
            at_brightest(names, psf),
            step,
            "of the highest peak",
            optics=True,
        ),
        TablePanel("Error of the image", ("cause", "error"), parts, words),
    ]


def budget_panels(path: Path) -> list[Panel]:
    """Every link from pillar to answer with its error.

    Args:
        path: of the file.
    """
    rows = [
        (
            row.link,
            row.phase_rad,
            row.psf,
            math.degrees(row.gaze_rad),
            "yes" if row.counted else "no",
            row.method,
        )
        for row in budgets.load_budget(path)
    ]
    shown = [
        tuple("–" if isinstance(v, float) and math.isnan(v) else v for v in row)
        for row in rows
    ]
    head = (
        "link",
        "phase / rad",
        "PSF, relative L2",
        "gaze / deg",
        "in the sum",
        "how",
    )
    words = (
        "The last row is the root of the sum of squares of those that are in the sum."
    )
    return [TablePanel("Error of every link", head, shown, words)]


_PAIRS = (
    ("Pupil", "pupil", "told_pupil", "share of the pixel"),
    ("Depth of the windows", "window_um", "told_window_um", "mm"),
)
_XYZ = (", x", ", y", ", z")
