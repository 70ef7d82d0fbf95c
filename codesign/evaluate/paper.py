"""Claims of the paper and what was measured here, with the conditions of both."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from metalens.core import config
from metalens.core.errors import StoreError

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
        """Ours over the paper's; nan where it was not measured."""
        return self.ours.value / self.claim.value if self.ours else math.nan

    def words(self) -> tuple[str, str, str, str, str, str]:
        """Cells of a table: place, what, paper, ours, ratio, conditions."""
        claim, ours, ratio, conditions = self.claim, self.picture, "", self.claim.note
        if not self.picture and self.ours is None:
            ours, conditions = "not measured", f"measure with: {claim.how}"
        elif self.ours is not None:
            low, high = self.ours.low, self.ours.high
            span = "" if math.isnan(low) else f" [{low:.3g}, {high:.3g}]"
            ours, ratio = f"{self.ours.value:.3g}{span}", f"{self.ratio:.2f}"
            conditions = self.ours.conditions
            if claim.note:
                conditions += f"; paper: {claim.note}"
        value = f"{claim.value:g} {claim.unit}".removesuffix(" ratio").strip()
        paper = "picture" if claim.picture else value
        return claim.place, claim.what, paper, ours, ratio, conditions


def load_claims() -> tuple[PaperClaim, ...]:
    """Every claim, in the order of the paper."""
    text = (resources.files("codesign") / "data" / "claims.toml").read_text("utf-8")
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
    numbers = {}
    for run in content["runs"]:
        conditions = f"{settings['subjects']} synthetic subjects, {run['mmacs']:.1f} MMACs, seed {settings['seed']}"
        for name, key in QUANTITIES.items():
            low, high = run.get(f"{name}_interval", (math.nan, math.nan))
            numbers[f"{key}/{run['name']}"] = MeasuredNumber(
                run[name], low, high, conditions
            )
    conditions = "mid-range hyperbolic, paired subjects"
    for entry in content["ratios"]:
        low, high = entry["interval"]
        if entry["against"] == "hyperbolic" and entry["quantity"] in QUANTITIES:
            numbers[f"{QUANTITIES[entry['quantity']]}/ratio"] = MeasuredNumber(
                entry["ratio"], low, high, conditions
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
    if "proposed" not in dim_deg:
        return {}
    conditions = "gaze under axial slip, networks trained in good light"
    return {
        f"dim/{name}": MeasuredNumber(
            error / (bright_deg if name == "proposed" else dim_deg)["proposed"],
            conditions=conditions,
        )
        for name, error in dim_deg.items()
    }


def of_optics(path: Path) -> dict[str, MeasuredNumber]:
    """Measurements in an optics.json whose lenses are named by :data:`ROLES`: scene
    ratios, and axial information over that of the hyperbolic lens.

    Args:
        path: path of the file.

    Raises:
        StoreError: no such file, or of another version.
    """
    content = _load_json(path, "lenses", "angles_deg", "normalisation")
    lenses = content["lenses"]
    numbers = {
        f"scenes/{kind}/{name}": MeasuredNumber(
            ratio, low, high, "same states, images of equal light"
        )
        for name, values in lenses.items()
        for kind, (ratio, low, high) in values["scene_ratios"].items()
    }
    if "hyperbolic" not in lenses:
        return numbers
    conditions = (
        f"honest I(z), {content['normalisation']} normalisation, pixels not binned"
    )
    for i, angle in enumerate(content["angles_deg"]):
        information = {
            name: sum(values["information_per_mm2"][i][0])
            for name, values in lenses.items()
        }
        for name, value in information.items():
            numbers[f"information/{angle:g}/{name}"] = MeasuredNumber(
                value / information["hyperbolic"], conditions=conditions
            )
    return numbers


def of_runs(rows: Mapping[str, list[dict[str, Any]]]) -> dict[str, MeasuredNumber]:
    """Fig. 8 a: proposed over hyperbolic run, as error at the least common budget and
    as compute for the best slippage of the hyperbolic run.

    Args:
        rows: rows of result.json by role of the run.
    """
    ours, reference = (
        [row for row in rows.get(role, []) if "axial_slip_mm" in row]
        for role in ROLES[:2]
    )
    pairs = [
        (row, other)
        for row in ours
        for other in reference
        if row["budget_mmacs"] == other["budget_mmacs"]
    ]
    if not pairs:
        return {}
    row, other = min(pairs, key=lambda pair: float(pair[0]["budget_mmacs"]))
    numbers = {
        "fig8a/error": MeasuredNumber(
            row["axial_slip_mm"] / other["axial_slip_mm"],
            conditions=f"axial slippage at {row['mmacs']:.1f} MMACs",
        )
    }
    best = min(reference, key=lambda r: (r["axial_slip_mm"], r["mmacs"]))
    goal = best["axial_slip_mm"]
    sufficient = [r["mmacs"] for r in ours if r["axial_slip_mm"] <= goal]
    if sufficient:
        numbers["fig8a/compute"] = MeasuredNumber(
            min(sufficient) / best["mmacs"],
            conditions=f"axial slippage of {goal:.2f} mm or less",
        )
    return numbers


def _load_json(path: Path, *needed: str) -> dict[str, Any]:
    """Content of a JSON file; refuses one that lacks a ``needed`` key."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    missing = [name for name in needed if name not in content]
    if missing:
        raise StoreError(
            f"{path}: {', '.join(missing)} missing: made by another version; measure it again"
        )
    return content


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
