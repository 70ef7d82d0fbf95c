"""The table of the design guide: errors with 95 % intervals over seeds, ratios paired
by seed.
"""

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student
from torch import nn

from benchmarks import kept_lines
from benchmarks.design_guide import (
    BOUNDS,
    CHOICE,
    DESIGNERS,
    DESIGNS,
    DEVICE,
    FOCI,
    KNOBS,
    LADDER,
    LONG_READ,
    LOOKS,
    MANY,
    NETWORK_FRAMES,
    RESULT,
    STOPS,
    TRAINED,
    TRAINING,
    compared,
    done,
    long_read,
    plan,
    watched,
)
from benchmarks.design_guide_cells import FIELDS, cell_of
from benchmarks.design_guide_network import EACH, PEOPLE
from benchmarks.design_guide_words import FIELD, HEAD, LONG, NETWORK, RUNGS
from codesign.evaluate.reader import ReferenceReader
from codesign.network import blur
from metalens.ground import store

PAGE = Path(__file__).parents[1] / "docs" / "codesign" / "guide.md"
MEASURES = ("axial_mm", "lateral_mm", "window_mm", "trusted_mm")
NETWORKS = {
    "codesign_study_p18blur": "25 600 frames",
    "codesign_study_p18blurlong": "76 800 frames",
}


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean over seeds with its 95 % interval, nan with one seed."""

    mean: float
    low: float
    high: float
    seeds: int

    def __str__(self) -> str:
        if self.seeds < 2:
            return f"{self.mean:.2f} (one seed)"
        return f"{self.mean:.2f} [{self.low:.2f}, {self.high:.2f}]"


def interval(values: list[float]) -> Interval:
    """Student's interval of a mean: m ± t s / √n."""
    mean, count = float(np.mean(values)), len(values)
    if count < 2:
        return Interval(mean, math.nan, math.nan, count)
    half = float(
        student.ppf(0.975, count - 1) * np.std(values, ddof=1) / math.sqrt(count)
    )
    return Interval(mean, mean - half, mean + half, count)


def ratio(one: dict[int, float], other: dict[int, float]) -> Interval:
    """Geometric mean of the ratios of the seeds that both have, with Student's interval
    of their logarithm.

    Raises:
        ValueError: they share no seed.
    """
    both = sorted(set(one) & set(other))
    if not both:
        raise ValueError(f"no seed in common: {sorted(one)} and {sorted(other)}")
    logs = interval([math.log(one[s] / other[s]) for s in both])
    return Interval(
        math.exp(logs.mean), math.exp(logs.low), math.exp(logs.high), logs.seeds
    )


def by_cell(lines: dict[str, dict[str, Any]]) -> dict[str, dict[int, dict[str, Any]]]:
    """{cell: {seed: line}} without the runs that chose."""
    found: dict[str, dict[int, dict[str, Any]]] = defaultdict(dict)
    for name, line in lines.items():
        cell, _, seed = name.rpartition("/")
        if int(seed) != CHOICE:
            found[cell][int(seed)] = line
    return dict(found)


def measured(runs: dict[int, dict[str, Any]], name: str) -> dict[int, float]:
    """{seed: value} of one measure."""
    return {seed: float(line[name]) for seed, line in runs.items()}


def knob_rows(runs: dict[str, dict[int, dict[str, Any]]]) -> list[dict[str, Any]]:
    """A row a cell that changes one knob of the base, in the order of the plan; those
    without a run are left out.
    """
    names = [name for knob in KNOBS if (name := cell_of(knob).name) in runs]
    return [row_of(runs, name, "base") for name in names]


def row_of(
    runs: dict[str, dict[int, dict[str, Any]]], name: str, base: str
) -> dict[str, Any]:
    """Intervals of all measures of a cell, and its ratios to another."""
    row: dict[str, Any] = {
        "cell": name,
        "guess_mm": float(np.mean(list(measured(runs[name], "guess_mm").values()))),
    }
    for measure in MEASURES:
        mine = measured(runs[name], measure)
        row[measure] = interval(list(mine.values()))
        if name != base and base in runs and set(runs[name]) & set(runs[base]):
            row[f"{measure}_ratio"] = ratio(mine, measured(runs[base], measure))
    return row


def role_rows(
    runs: dict[str, dict[int, dict[str, Any]]], roles: dict[str, str]
) -> list[dict[str, Any]]:
    """A row a role that has runs; ratios to the best focus, of the trained lens to the
    best designer's too.
    """
    roles = {role: cell for role, cell in roles.items() if cell in runs}
    if "focus" not in roles:
        return []
    rows = [
        {"role": role} | row_of(runs, cell, roles["focus"])
        for role, cell in roles.items()
    ]
    if {"trained", "designer"} <= set(roles):
        mine, other = (
            measured(runs[roles[r]], "axial_mm") for r in ("trained", "designer")
        )
        rows[-1]["to_designer"] = ratio(mine, other)
    return rows


def device_rows(
    lines: dict[str, dict[str, Any]], devices: tuple[str, ...] = DEVICE
) -> dict[str, list[dict[str, Any]]]:
    """{field and light: rows of its roles}, of those that have runs."""
    runs = by_cell(lines)
    found = {device: role_rows(runs, compared(lines, device)) for device in devices}
    return {device: rows for device, rows in found.items() if rows}


def reference_macs(pixels: int) -> int:
    """Multiply-accumulates of the reference reader for a frame: its branch and the
    layers to the slippage.
    """
    layers = [
        part.weight.numel()
        for part in ReferenceReader().slip
        if isinstance(part, nn.Linear)
    ]
    return blur.macs(pixels) + sum(layers)


def network_rows() -> list[dict[str, Any]]:
    """What the elastic network reads at the base, of committed results: one PSF a
    depth, in place of the true image.
    """
    found = []
    for name, frames in NETWORKS.items():
        for row in json.loads((RESULT.parent / f"{name}.json").read_text("utf-8")):
            mean = interval(row["axial_by_seed_mm"])
            found.append({"reader": f"elastic network, {frames}", "lens": row["lens"], "mmacs": row["mmacs"],
                          "axial_mm": mean, "lateral_mm": row["lateral_mm"]})  # fmt: skip
    return found


def page(
    lines: dict[str, dict[str, Any]],
    bounds: dict[str, float] | None = None,
    designs: Sequence[dict[str, Any]] = (),
) -> str:
    """Markdown of all tables, and what of the plan was not measured; ``bounds`` by
    cell, ``designs`` as trained.
    """
    runs, devices = by_cell(lines), device_rows(lines)
    parts = [
        HEAD.format(frames=cell_of("base").frames),
        "",
        *knob_table(knob_rows(runs)),
    ]
    foci, designers = (
        ", ".join(dict.fromkeys(n.lstrip("abcdefghijklmnopqrstuvwxyz") for n in names))
        for names in (FOCI, DESIGNERS)
    )
    told = {
        "coarse": TRAINED,
        "turns": TRAINING.turns,
        "hold": TRAINING.hold,
        "foci": foci,
        "designers": designers,
    }
    told["stops"] = ", ".join(n.removeprefix("stop") for n in STOPS)
    told |= {
        "still": 100 * TRAINING.phase.start,
        "looks": " and ".join(f"{100 * share:g}" for share in LOOKS),
    }
    parts += [FIELD.format(oblique=reach("oblique"), ring=reach("ring"), **told)]
    for device, rows in devices.items():
        parts += device_table(device, rows, lines, bounds or {})
    parts += long_tables(lines, LONG_READ[0])
    parts += [
        RUNGS,
        *ladder_table(device_rows(lines, LADDER), bounds or {}),
        "",
        *(told_of(one) for one in designs),
    ]
    for device in LONG_READ[1:]:
        parts += long_tables(lines, device)
    parts += [
        *watched_table(role_rows(runs, watched(lines)), runs),
        "",
        *network_table(network_rows()),
        "",
    ]
    absent = missing(lines)
    if absent:
        cells = ", ".join(f"`{c}`" for c in absent)
        parts += [
            "## Planned and not measured",
            "",
            f"Cells without a run: {cells}.",
            "",
        ]
    return "\n".join(parts)


def long_tables(lines: dict[str, dict[str, Any]], device: str) -> list[str]:
    """The lenses of a device after more frames, where they were read."""
    long, of = role_rows(by_cell(lines), long_read(lines, device)), cell_of(device)
    told = {
        "field": of.field,
        "fwhm": of.fwhm,
        "many": _count(MANY),
        "frames": _count(cell_of("base").frames),
    }
    return [LONG.format(**told), *lens_table(long, {}), ""] if long else []


def reach(field: str) -> str:
    """Angles that a field spans along x."""
    place = FIELDS[field]
    ends = (
        math.tan(math.radians(place.angle_deg)) + s * place.width_um / 2 / 2000.0
        for s in (-1, 1)
    )
    low, high = (math.degrees(math.atan(e)) for e in ends)
    return f"±{high:.0f}°" if place.angle_deg == 0 else f"{low:.0f} to {high:.0f}°"


def knob_table(rows: list[dict[str, Any]]) -> list[str]:
    """A row a cell; the ratio of axial errors is to the base."""
    out = [
        "| cell | seeds | axial / mm | to the base | lateral / mm | windows / mm (guess) | trusted / mm |",
        "|---" * 7 + "|",
    ]
    for row in rows:
        told = f"{row['window_mm']} ({row['guess_mm']:.2f})"
        axial = f"{row['axial_mm'].seeds} | {row['axial_mm']} | {row.get('axial_mm_ratio', '1')}"
        out.append(
            f"| `{row['cell']}` | {axial} | {row['lateral_mm']} | {told} | {row['trusted_mm']} |"
        )
    return out


def device_table(
    device: str,
    rows: list[dict[str, Any]],
    lines: dict[str, dict[str, Any]],
    bounds: dict[str, float],
) -> list[str]:
    """A row a role, and the runs that chose below."""
    cell = cell_of(device)
    scan = {
        n: v
        for n, v in lines.items()
        if n.endswith(f"/{CHOICE}") and replace(cell_of(n[:-2]), lens="focus40") == cell
    }
    told = (
        f"`{cell_of(n[:-2]).lens}` {v['axial_mm']:.2f} ({v['window_mm']:.2f})"
        for n, v in scan.items()
    )
    chose = (
        "Axial error and that of the windows in the runs that chose, mm: "
        + ", ".join(told)
        + "."
    )
    return [
        f"### {cell.field}, {cell.fwhm:g} nm",
        "",
        *lens_table(rows, bounds),
        "",
        chose,
        "",
    ]


def lens_table(rows: list[dict[str, Any]], bounds: dict[str, float]) -> list[str]:
    """A row a lens, its errors also as a share of the best focus's."""
    out = ["| lens | seeds | axial / mm | to best focus | windows / mm | to best focus | trusted / mm | lateral / mm "
           "| bound / mm |", "|---" * 9 + "|"]  # fmt: skip
    for row in rows:
        ratios = [str(row.get(f"{m}_ratio", 1)) for m in ("axial_mm", "window_mm")]
        name = f"{row['role']}: `{cell_of(row['cell']).lens}`"
        both = f"{row['axial_mm']} | {ratios[0]} | {row['window_mm']} | {ratios[1]}"
        out.append(f"| {name} | {row['axial_mm'].seeds} | {both} | {row['trusted_mm']} | {row['lateral_mm']} | "
                   f"{_told(bounds.get(row['cell']))} |")  # fmt: skip
    for row in rows:
        if "to_designer" in row:
            out += [
                "",
                f"Trained to the best designer's lens, axial: {row['to_designer']}.",
            ]
    return out


def _count(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def _told(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def told_of(design: dict[str, Any]) -> str:
    """What a training did by the reader that chose among its lenses."""
    read = ", ".join(
        f"{error:.3f} mm after {turn} turns"
        for turn, error in design["axial_mm"].items()
    )
    end = f"kept after {design['turn']}, {design['apart_rad']:.2f} rad rms from the start" if design["turn"] else (
        "kept the start: its runs are those of that lens"
    )  # fmt: skip
    return f"Training of `{design['design']}`: axial {read}, on the frames that choose; {end}.\n"


def ladder_table(
    rungs: dict[str, list[dict[str, Any]]], bounds: dict[str, float]
) -> list[str]:
    """A row a rung: its lenses, and the trained one against the others."""
    head = ("field", "best focus", "designer", "best focus, axial / mm", "designer to it", "trained to it",
            "trained to designer", "windows, trained to focus", "trusted, likewise", "bound, likewise")  # fmt: skip
    out = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for device, rows in rungs.items():
        of = {row["role"]: row for row in rows}
        if not {"focus", "designer"} <= set(of):
            continue
        focus, designer, trained = of["focus"], of["designer"], of.get("trained", {})
        ends = (bounds.get(row.get("cell", "")) for row in (trained, focus))
        least = [end for end in ends if end is not None]
        told = [
            f"`{cell_of(device).field}`",
            *(f"`{cell_of(row['cell']).lens}`" for row in (focus, designer)),
        ]
        told += [focus["axial_mm"], designer["axial_mm_ratio"]]
        ratios = (
            "axial_mm_ratio",
            "to_designer",
            "window_mm_ratio",
            "trusted_mm_ratio",
        )
        told += [trained.get(name, "–") for name in ratios]
        told += [_told(least[0] / least[1] if len(least) == 2 else None)]
        out.append("| " + " | ".join(map(str, told)) + " |")
    return out


def watched_table(
    rows: list[dict[str, Any]], runs: dict[str, dict[int, dict[str, Any]]]
) -> list[str]:
    """The network's rows in the oblique field, gaze with its interval."""
    told = {"frames": _count(NETWORK_FRAMES), "people": PEOPLE, "each": EACH}
    out = [
        NETWORK.format(macs=reference_macs(cell_of("base").config.pixels) / 1e6, **told)
    ]
    head = ("lens", "MMACs", "seeds", "axial / mm", "to best focus", "windows / mm", "to best focus", "lateral / mm",
            "pupil IoU", "gaze / °", "to best focus")  # fmt: skip
    out += ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        mine, base = (measured(runs[r["cell"]], "gaze_deg") for r in (row, rows[0]))
        macs, iou = (
            np.mean(list(measured(runs[row["cell"]], n).values()))
            for n in ("mmacs", "iou")
        )
        parts = [
            f"{row['role']}: `{cell_of(row['cell']).lens}`",
            f"{macs:.2f}",
            row["axial_mm"].seeds,
        ]
        parts += [
            row["axial_mm"],
            row.get("axial_mm_ratio", 1),
            row["window_mm"],
            row.get("window_mm_ratio", 1),
        ]
        gaze = interval(list(mine.values())), 1 if row is rows[0] else ratio(mine, base)
        parts += [row["lateral_mm"], f"{iou:.2f}", *gaze]
        out.append("| " + " | ".join(map(str, parts)) + " |")
    for row in rows:
        if "to_designer" in row:
            out += [
                "",
                f"Trained to the best designer's lens, axial, by the network: {row['to_designer']}.",
            ]
    return out


def network_table(rows: list[dict[str, Any]]) -> list[str]:
    """The elastic network's rows."""
    out = ["The elastic network behind a lens that does not move, at 18 µm, on axis, one wavelength, one PSF a depth, "
           "on frames of equal pupil places (from the committed study; other frames than above, so no ratio):", "",
           "| reader | lens | MMACs | axial / mm | lateral / mm |", "|---" * 5 + "|"]  # fmt: skip
    return out + [
        f"| {r['reader']} | `{r['lens']}` | {r['mmacs']:.2f} | {r['axial_mm']} | {r['lateral_mm']:.2f} |"
        for r in rows
    ]


def missing(lines: dict[str, dict[str, Any]]) -> list[str]:
    """Cells of the plan that no run of a table is of."""
    have = {name.rpartition("/")[0] for name in lines}
    return list(
        dict.fromkeys(
            cell
            for name in plan(lines)
            if (cell := name.rpartition("/")[0]) not in have
        )
    )


def write(work: Path) -> None:
    """JSON and page of the lines there are."""
    lines = done(work)
    bounds = kept_lines(work / BOUNDS)
    kept = {
        "runs": list(lines.values()),
        "designs": kept_lines(work / DESIGNS),
        "bounds": bounds,
    }
    store.write_text(RESULT, json.dumps(kept, indent=1) + "\n")
    told = {line["cell"]: line["bound_mm"] for line in bounds}
    store.write_text(PAGE, page(lines, told, kept["designs"]))
