"""Claims of the paper beside what was measured here, with the conditions of both."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from codesign.adapt import source as finished
from codesign.train import run as runs
from metalens.core import config
from metalens.core.errors import StoreError, TrainingError

# roles of the runs, in the order of the command line
ROLES = ("proposed", "hyperbolic", "best_focus", "double_helix")
# of experiment.json, and their names in the keys of claims
QUANTITIES = {
    "slip_mm": "slip",
    "gaze_axial_deg": "gaze_axial",
    "gaze_lateral_deg": "gaze_lateral",
    "iou": "iou",
}

WORDS = (
    "visual axis of synthetic people under slippage, after a personal calibration of sphere and regressor on a fifth "
    "of the frames"
)


@dataclass(frozen=True, slots=True)
class PaperClaim:
    """A number or picture of the paper.

    place: table, figure or section. what: quantity in words.
    key: key of our measurement. how: the command that measures it.
    value, unit: of the paper; inf where it prints a picture only.
    note: conditions of the paper.
    """

    place: str
    what: str
    key: str
    how: str
    value: float = math.inf
    unit: str = ""
    note: str = ""

    @property
    def picture(self) -> bool:
        """Whether the paper shows it and prints no number."""
        return math.isinf(self.value)


@dataclass(frozen=True, slots=True)
class PaperClaims:
    """The content of claims.toml."""

    claim: tuple[PaperClaim, ...]


@dataclass(frozen=True, slots=True)
class MeasuredNumber:
    """A measured number with its 95 % interval (nan without one) and its conditions."""

    value: float
    low: float = math.nan
    high: float = math.nan
    conditions: str = ""


@dataclass(frozen=True, slots=True)
class ClaimLine:
    """A claim of the paper and our measurement of it.

    ours: None where it was not measured. picture: name of our file, '' without one.
    """

    claim: PaperClaim
    ours: MeasuredNumber | None
    picture: str = ""

    @property
    def ratio(self) -> float:
        """Ours over the paper's; nan without either."""
        return (
            self.ours.value / self.claim.value
            if self.ours and not self.claim.picture
            else math.nan
        )

    def words(self) -> tuple[str, str, str, str, str, str]:
        """Cells of a table: place, what, paper, ours, ratio, conditions."""
        c = self.claim
        paper = (
            "picture"
            if c.picture
            else f"{c.value:g} {c.unit if c.unit != 'ratio' else ''}".strip()
        )
        if self.picture:
            return c.place, c.what, paper, self.picture, "", c.note
        if self.ours is None:
            return c.place, c.what, paper, "not measured", "", f"measure with: {c.how}"
        span = (
            f" [{self.ours.low:.3g}, {self.ours.high:.3g}]"
            if not math.isnan(self.ours.low)
            else ""
        )
        ratio = "" if c.picture else f"{self.ratio:.2f}"
        conditions = "; ".join(
            w for w in (self.ours.conditions, f"paper: {c.note}" if c.note else "") if w
        )
        return c.place, c.what, paper, f"{self.ours.value:.3g}{span}", ratio, conditions


def load_claims() -> tuple[PaperClaim, ...]:
    """Every claim, in the order of the paper."""
    text = (
        resources.files("codesign")
        .joinpath("data", "claims.toml")
        .read_text(encoding="utf-8")
    )
    return config.loads(text, PaperClaims, where="claims.toml").claim


def claim_lines(
    measured: Mapping[str, MeasuredNumber], folder: Path | None = None
) -> list[ClaimLine]:
    """Every claim of the paper with our measurement of it.

    Args:
        measured: measurements by the claims' keys.
        folder: folder of our pictures; None for none.
    """
    lines = []
    for claim in load_claims():
        name = claim.key.removeprefix("picture/")
        has_picture = claim.picture and folder is not None and (folder / name).is_file()
        lines.append(
            ClaimLine(claim, measured.get(claim.key), name if has_picture else "")
        )
    return lines


def of_experiment(path: Path) -> dict[str, MeasuredNumber]:
    """Measurements in an experiment.json whose runs are named by :data:`ROLES`: error
    of every run, and ratios to the hyperbolic one.

    Args:
        path: path of the file.

    Raises:
        StoreError: no such file, or of another version.
    """
    content = _load_json(path, "runs", "ratios", "settings")
    settings = content["settings"]
    numbers: dict[str, MeasuredNumber] = {}
    for run in content["runs"]:
        conditions = f"{settings['subjects']} synthetic subjects, {run['mmacs']:.1f} MMACs, seed {settings['seed']}"
        for name, key in QUANTITIES.items():
            low, high = run.get(f"{name}_interval", (math.nan, math.nan))
            numbers[f"{key}/{run['name']}"] = MeasuredNumber(
                run[name], low, high, conditions
            )
    for entry in content["ratios"]:
        if entry["against"] == "hyperbolic" and entry["quantity"] in QUANTITIES:
            low, high = entry["interval"]
            numbers[f"{QUANTITIES[entry['quantity']]}/ratio"] = MeasuredNumber(
                entry["ratio"], low, high, "mid-range hyperbolic, paired subjects"
            )
    return numbers


def of_dim(bright: Path, dim: Path) -> dict[str, MeasuredNumber]:
    """Loss by dim light (the 15 dB test): gaze error of the proposed run in dim over
    good light, and of other runs over the proposed one in dim light.

    Args:
        bright: experiment.json in good light.
        dim: experiment.json in dim light.

    Raises:
        StoreError: no such file, or of another version.
    """
    bright_deg, dim_deg = (
        {run["name"]: run["gaze_axial_deg"] for run in _load_json(path, "runs")["runs"]}
        for path in (bright, dim)
    )
    conditions = "gaze under axial slip, networks trained in good light"
    numbers = {}
    if "proposed" in dim_deg:
        numbers["dim/proposed"] = MeasuredNumber(
            dim_deg["proposed"] / bright_deg["proposed"], conditions=conditions
        )
        for name in ("hyperbolic", "double_helix"):
            if name in dim_deg:
                numbers[f"dim/{name}"] = MeasuredNumber(
                    dim_deg[name] / dim_deg["proposed"], conditions=conditions
                )
    return numbers


def of_optics(path: Path) -> dict[str, MeasuredNumber]:
    """Measurements in an optics.json whose lenses are named by :data:`ROLES`: scene
    ratios, and axial information over that of the hyperbolic lens.

    Args:
        path: path of the file.

    Raises:
        StoreError: no such file, or of another version.
    """
    content = _load_json(path, "lenses", "angles_deg", "normalisation")
    numbers: dict[str, MeasuredNumber] = {}
    reference = content["lenses"].get("hyperbolic")
    for name, values in content["lenses"].items():
        for kind, (value, low, high) in values["scene_ratios"].items():
            numbers[f"scenes/{kind}/{name}"] = MeasuredNumber(
                value, low, high, "same states, images of equal light"
            )
        if reference is None:
            continue
        for i, angle in enumerate(content["angles_deg"]):
            information, reference_information = (
                sum(lens_values["information_per_mm2"][i][0])
                for lens_values in (values, reference)
            )
            conditions = f"honest I(z), {content['normalisation']} normalisation, pixels not binned"
            numbers[f"information/{angle:g}/{name}"] = MeasuredNumber(
                information / reference_information, conditions=conditions
            )
    return numbers


def of_runs(rows: Mapping[str, list[dict[str, Any]]]) -> dict[str, MeasuredNumber]:
    """Fig. 8 a: proposed over hyperbolic run, as error at the least common budget and
    as compute for the best slippage of the hyperbolic run.

    Args:
        rows: rows of result.json by role of the run.
    """
    if not {"proposed", "hyperbolic"} <= rows.keys():
        return {}
    ours, reference = (
        {row["budget_mmacs"]: row for row in rows[name] if "axial_slip_mm" in row}
        for name in ("proposed", "hyperbolic")
    )
    shared = sorted(ours.keys() & reference.keys())
    if not shared:
        return {}
    budget = shared[0]
    error = ours[budget]["axial_slip_mm"] / reference[budget]["axial_slip_mm"]
    numbers = {
        "fig8a/error": MeasuredNumber(
            error, conditions=f"axial slippage at {ours[budget]['mmacs']:.1f} MMACs"
        )
    }
    goal = min(row["axial_slip_mm"] for row in reference.values())
    reference_mmacs = min(
        row["mmacs"] for row in reference.values() if row["axial_slip_mm"] == goal
    )
    sufficient = [row["mmacs"] for row in ours.values() if row["axial_slip_mm"] <= goal]
    if sufficient:
        numbers["fig8a/compute"] = MeasuredNumber(
            min(sufficient) / reference_mmacs,
            conditions=f"axial slippage of {goal:.2f} mm or less",
        )
    return numbers


def _load_json(path: Path, *needed: str) -> dict[str, Any]:
    """Content of a JSON file; refuses one that lacks a ``needed`` key."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise StoreError(f"{path}: no such file; measure it first") from None
    except json.JSONDecodeError as error:
        raise StoreError(
            f"{path}: not a JSON file ({error}); measure it again"
        ) from None
    missing = [name for name in needed if name not in content]
    if missing:
        raise StoreError(
            f"{path}: {', '.join(missing)} missing: made by another version; measure it again"
        )
    return content


def frozen_parts(folder: Path) -> tuple[str, ...]:
    """Parts of a finished run that were frozen in training, from its result.json.

    Args:
        folder: folder of the run.

    Raises:
        TrainingError: no finished run, or of another version.
    """
    finished.rows_of(folder)  # refuses what is missing, cut short or empty
    return tuple(_load_json(folder / "result.json").get("frozen", ()))


def image_tolerance(folders: Sequence[Path]) -> float:
    """Image tolerance to compare the lenses of runs at: the largest of theirs.

    Args:
        folders: folders of finished runs.
    """
    return max(
        runs.load_run_settings(folder / "run.toml").optics.image_tolerance
        for folder in folders
    )


def of_gaze(rows: Sequence[Mapping[str, Any]]) -> dict[str, MeasuredNumber]:
    """Table 2: gaze errors of the fastest and of the most accurate network of the
    proposed run, on people whom training never used.

    Args:
        rows: rows of its result.json.
    """
    known = [row for row in rows if "gaze_deg" in row]
    if not known:
        return {}
    chosen = {
        "efficient": min(known, key=lambda row: float(row["mmacs"])),
        "accurate": min(known, key=lambda row: float(row["gaze_deg"])),
    }
    return {
        f"table2/proposed_{name}": MeasuredNumber(
            float(row["gaze_deg"]), conditions=f"{row['mmacs']:.1f} MMACs, {WORDS}"
        )
        for name, row in chosen.items()
    }


def of_ablations(
    ours: Sequence[Mapping[str, Any]], others: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, MeasuredNumber]:
    """Fig. 8b: compute of a run with one part frozen over that of the joint run, at the
    best axial slippage of the frozen run.

    A part whose best error the joint run does not reach is left out.

    Args:
        ours: rows of the joint run.
        others: rows by frozen part.
    """
    numbers = {}
    for part, rows in others.items():
        best = min(rows, key=lambda row: float(row["axial_slip_mm"]))
        sufficient = [
            float(row["mmacs"])
            for row in ours
            if row["axial_slip_mm"] <= best["axial_slip_mm"]
        ]
        if sufficient:
            conditions = f"axial slippage of {best['axial_slip_mm']:.2f} mm or less, at {min(sufficient):.1f} MMACs"
            numbers[f"fig8b/{part}"] = MeasuredNumber(
                float(best["mmacs"]) / min(sufficient), conditions=conditions
            )
    return numbers


def frozen_rows(folders: Sequence[Path]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """(part, rows) of every run in which exactly one part was frozen.

    Args:
        folders: of finished runs.

    Raises:
        TrainingError: two runs with the same part frozen.
    """
    owner: dict[str, Path] = {}
    for folder in folders:
        parts = frozen_parts(folder)
        if len(parts) != 1:
            continue
        (part,) = parts
        if part in owner:
            raise TrainingError(
                f"{owner[part]} and {folder} both have {part} frozen; give one of them"
            )
        owner[part] = folder
        yield part, finished.rows_of(folder)
