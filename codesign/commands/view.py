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
    """Panels of a run's folder, finished or not.

    Training curves, searched networks, results, test frames with predictions, bound and
    lens, as far as their files exist.

    Args:
        path: of the folder.

    Raises:
        StoreError: a log or a result that is no JSON.
    """
    entries = _log_entries(path / LOG)
    result: dict[str, Any] = {}
    if (path / RESULT).is_file():
        text = (path / RESULT).read_text(encoding="utf-8")
        result = _parse_table(text, path / RESULT)
    panels = [
        *_training_panels(entries),
        *_search_panels(entries),
        *_network_panels(result),
    ]
    if (path / ANSWERS).is_file():
        panels += prediction_panels(path / ANSWERS)
    panels += _bound_panels(result)
    if (path / LENS).is_file():
        panels += lens_panels(path / LENS)
    return panels


def _log_entries(path: Path) -> list[dict[str, Any]]:
    """Entries of the log; a last line that is still being written is left out."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [_parse_table(line, path) for line in lines if line.endswith("}")]


def _parse_table(text: str, path: Path) -> dict[str, Any]:
    """JSON object from text.

    Raises:
        StoreError: not JSON, or not an object; ``path`` is named.
    """
    try:
        found = json.loads(text)
    except ValueError as error:
        raise StoreError(f"{path}: not JSON ({error})") from None
    if not isinstance(found, dict):
        raise StoreError(
            f"{path}: need a table of names and values, found {type(found).__name__}"
        )
    return found


def _training_panels(entries: list[dict[str, Any]]) -> list[Panel]:
    """A curve over the step for every logged number that varies; [] of less than two
    steps.
    """
    steps = [entry for entry in entries if entry.get("kind") == "step"]
    if len(steps) < 2:
        return []
    x = np.array([entry["step"] for entry in steps], float)
    names = [
        k
        for k, v in steps[0].items()
        if k not in ("kind", "step") and isinstance(v, (int, float))
    ]
    values = {
        name: np.array([entry.get(name, np.nan) for entry in steps], float)
        for name in names
    }
    titles = {name: report.in_words(name) for name in names}
    varying = [name for name in names if np.ptp(values[name]) > 0]
    budgets = list(
        dict.fromkeys(
            entry["budget_mmacs"] for entry in entries if "budget_mmacs" in entry
        )
    )
    curves_by_name = {name: {titles[name]: values[name]} for name in varying}
    if "mmacs" in curves_by_name and len(budgets) > 1:
        curves_by_name["mmacs"] = _curves_by_budget(x, values["mmacs"], budgets)
    return [
        CurvePanel(f"Training: {titles[name]}", x, "step", curves, "")
        for name, curves in curves_by_name.items()
    ]


def _curves_by_budget(
    step: Array, values: Array, budgets: list[float]
) -> dict[str, Array]:
    """(steps,) curve of each budget, of a value that belongs to one budget in turn.

    Step s belongs to budget (s - 1) mod len(budgets). Between its steps the last value
    is repeated; before the first it is nan.
    """
    curves = {}
    for i, budget in enumerate(budgets):
        last = np.maximum.accumulate(
            np.where((step - 1) % len(budgets) == i, np.arange(len(step)), -1)
        )
        curves[f"budget {budget:g}"] = np.where(last >= 0, values[last], np.nan)
    return curves


def _search_panels(entries: list[dict[str, Any]]) -> list[Panel]:
    """Error over cost of every network that the searches evaluated, Pareto set marked.

    The Pareto set: no other network is better in both.
    """
    births = [
        e
        for e in entries
        if e.get("kind") == "birth"
        and {"error", "mmacs", "budget_mmacs"} <= set(e)
        and math.isfinite(e["error"])
    ]
    if not births:
        return []
    candidates = [
        EvaluatedCandidate(
            _architecture(e.get("architecture", {})), e["error"], e["mmacs"]
        )
        for e in births
    ]
    front = [
        next(i for i, candidate in enumerate(candidates) if candidate is best)
        for best in pareto_front(candidates)
    ]
    notes = [
        dict(_layer_rows(e["architecture"])) if e.get("architecture") else {}
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


def _architecture(values: dict[str, Any]) -> Architecture:
    """Architecture from its entry in a log; empty sizes where the entry lacks them."""
    sizes = {
        name: tuple(values.get(name, ()))
        for name in ("depths", "kernels", "expansions")
    }
    return Architecture(
        **sizes,
        width=values.get("width", 1.0),
        resolution=values.get("resolution", 1.0),
    )


def _layer_rows(architecture: dict[str, Any]) -> list[tuple[str, str]]:
    """(property, value) rows of a network: input scale, channels, blocks of each stage.

    A block is written kernel × kernel × expansion.
    """
    depths = architecture["depths"]
    slots = len(architecture["kernels"]) // len(depths)
    rows = [
        ("input scale", f"{architecture['resolution']:.3g}"),
        ("channels, of the full ones", f"{architecture['width']:.3g}"),
    ]
    for stage, depth in enumerate(depths):
        used = range(stage * slots, stage * slots + depth)
        blocks = ", ".join(
            f"{architecture['kernels'][i]}×{architecture['kernels'][i]} × {architecture['expansions'][i]:g}"
            for i in used
        )
        rows.append((f"stage {stage + 1}", blocks))
    return rows


def _bound_panels(result: dict[str, Any]) -> list[Panel]:
    """Cramér-Rao bound on the depth of a window over the depth; [] where the run has
    none.
    """
    bound = result.get("bound")
    if not bound:
        return []
    depth_mm = np.array(bound["depth_mm"])
    sigma_mm = np.array(bound["window_depth_mm"])
    caption = (
        "Least standard deviation of any reader of the blur of one window, on axis: 1/f texture as wide as the PSFs, "
        "noise a thousandth of its power. Readers of real frames collect less."
    )
    return [
        CurvePanel(
            "Bound on the depth of a window",
            depth_mm,
            "depth / mm",
            {"bound": sigma_mm},
            "mm",
            caption=caption,
            scale="log",
        )
    ]


def prediction_panels(path: Path) -> list[Panel]:
    """Test frames, and predictions of the networks next to the truth.

    Pupil mask and window depths as images that alternate; a table of slippages in mm.

    Args:
        path: of the file.
    """
    stored = store.load(path, "answers")
    arrays = stored.arrays
    count = len(arrays["frames"])
    names = [
        str(stored.attributes[f"network_{i}"])
        for i in range(len(arrays["told_slip_um"]))
    ]
    axes = [
        SliderAxis("network", names),
        SliderAxis("frame", list(range(count))),
        SliderAxis("shown", ["truth", "answer"], blink=True),
    ]
    panels: list[Panel] = [
        ImagePanel(
            "Frames of the test",
            arrays["frames"],
            axes[1:2],
            1.0,
            "of its spread",
            across="pixels",
            from_least=True,
        )
    ]
    for title, truth, predicted, unit in _PAIRS:
        if predicted in arrays:
            repeated = np.broadcast_to(arrays[truth], arrays[predicted].shape)
            pair = np.stack([repeated, arrays[predicted]], axis=2)
            scaled = pair * (1e-3 if unit == "mm" else 1.0)
            panels.append(
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
        slips = np.stack(
            [arrays["slip_um"], arrays["told_slip_um"][i]], axis=2
        ).reshape(count, 6)
        half_widths = [
            1e-3 * v if v == v else "–" for v in arrays["interval_um"][i].tolist()
        ]
        rows += [
            (name, k, *(1e-3 * slips[k]).tolist(), half_widths[k]) for k in range(count)
        ]
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
    """Tables of the results and of the layers of every network; [] without a result."""
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
    panels: list[Panel] = [
        TablePanel(
            "Networks of the run", [report.in_words(name) for name in names], table
        )
    ]
    layers_of_budgets = [
        (f"budget {row['budget_mmacs']:g}", _layer_rows(architecture))
        for row in rows
        if (architecture := row.get("architecture"))
    ]
    if layers_of_budgets:
        columns = ["", *(name for name, _ in layers_of_budgets)]
        lines = [
            [what, *(layers[i][1] for _, layers in layers_of_budgets)]
            for i, (what, _) in enumerate(layers_of_budgets[0][1])
        ]
        caption = (
            "Blocks of each stage: side of the kernel × expansion of the channels."
        )
        panels.append(TablePanel("Layers of the networks", columns, lines, caption))
    return panels


def scene_panels(path: Path) -> list[Panel]:
    """Rendered eyes, depth in mm, pupil mask, and a table of the labels of every frame.

    The depth of a pixel is that of the sheet that covers most of it.

    Args:
        path: of the file.
    """
    arrays = store.load(path, "scene").arrays
    count = len(arrays["radiance"])
    frames = [SliderAxis("frame", list(range(count)))]
    full = float(np.iinfo(arrays["radiance"].dtype).max)
    # the far sheet's depth counts where it covers most of the pixel
    is_far = arrays["coverage"] > full / 2
    depth_mm = 1e-3 * np.where(
        is_far, arrays["depth_um"][:, 1], arrays["depth_um"][:, 0]
    )
    labels = {
        k.removeprefix("labels/"): v
        for k, v in arrays.items()
        if k.startswith("labels/")
    }
    shown_labels = {
        name: value
        for name in ("slip_um", "pupil_um", "visible")
        if (value := labels.get(name)) is not None
    }
    columns = [
        f"{report.in_words(name)}{axis}"
        for name, v in shown_labels.items()
        for axis in ([""] if v.ndim == 1 else _XYZ)
    ]
    rows = [
        [
            i,
            *np.concatenate(
                [np.atleast_1d(v[i]) for v in shown_labels.values()]
            ).tolist(),
        ]
        for i in range(count)
    ]
    return [
        ImagePanel(
            "Rendered eyes",
            arrays["radiance"].sum(1, dtype=float) / full,
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
            arrays["pupil"] / full,
            frames,
            1.0,
            "share of the pixel",
            across="pixels",
        ),
        TablePanel(
            "Labels",
            ("frame", *columns),
            rows,
            "Positions in the camera's axes; labels.csv holds all of them.",
        ),
    ]


def layer_panels(path: Path) -> list[Panel]:
    """Light and coverage of the depth layers of one frame, as images are formed of
    them.

    Args:
        path: of the file.
    """
    arrays = store.load(path, "layers").arrays
    axis = [SliderAxis("layer at", (1e-3 * arrays["depth_um"]).tolist(), "mm")]
    return [
        ImagePanel(
            "Light of a layer",
            arrays["radiance"],
            axis,
            1.0,
            "of full light",
            across="pixels",
        ),
        ImagePanel(
            "What a layer covers",
            arrays["coverage"],
            axis,
            1.0,
            "share of the pixel",
            across="pixels",
        ),
    ]


def image_panels(path: Path) -> list[Panel]:
    """Scene, image and their difference, PSFs over field and depth, and the error by
    cause.

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
    errors = [
        (report.in_words(k.removeprefix("error_")), v)
        for k, v in sorted(attributes.items())
        if k.startswith("error_")
    ]
    note = f"Relative L2 error of a texture, {float(attributes['error']):.2g} together; outside: light beyond the windows."
    unit = "light, as of the scene"
    return [
        ImagePanel("Scene and image", pairs, [frames, choice], pitch_um, unit),
        ImagePanel(
            "Image less scene",
            arrays["image"] - arrays["scene"],
            [frames],
            pitch_um,
            unit,
            signed=True,
        ),
        ImagePanel(
            "Points of the field",
            psf,
            at_brightest(axes, psf),
            pitch_um,
            "of the highest peak",
            optics=True,
        ),
        TablePanel("Error of the image", ("cause", "error"), errors, note),
    ]


def budget_panels(path: Path) -> list[Panel]:
    """Table of the error of every link from pillar to gaze: phase, PSF and gaze.

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
    cells = [
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
    caption = (
        "The last row is the root of the sum of squares of those that are in the sum."
    )
    return [TablePanel("Error of every link", head, cells, caption)]


_PAIRS = (
    ("Pupil", "pupil", "told_pupil", "share of the pixel"),
    ("Depth of the windows", "window_um", "told_window_um", "mm"),
)
_XYZ = (", x", ", y", ", z")
