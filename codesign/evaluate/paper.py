"""The paper's tables and figures as claims, and what was measured here beside each:
paper, ours, ratio, conditions.

What was not measured says so, with the command that would measure it: no number is
filled in.
"""

import functools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from codesign.adapt import source as finished
from codesign.batches import CALIBRATION, TEST
from codesign.gaze import NetworkReadings, bench
from codesign.network import Architecture, recalibrate_batch_norm
from codesign.train import SensorFrames, assess
from codesign.train import run as runs
from metalens.core import config
from metalens.core.errors import StoreError, TrainingError

Shown = tuple[bench.PeopleFrames, SensorFrames]

ROLES = (
    "proposed",
    "hyperbolic",
    "best_focus",
    "double_helix",
)  # of the runs, in the order they are given

PEOPLE, EACH = 16, 40  # frames of a person; a fifth of them calibrates
# other people of as many frames, whose gaze tells what an axis that is read means
BEFORE = 32
WORDS = "visual axis after a personal calibration on a fifth of the frames"


@dataclass(frozen=True, slots=True)
class PaperClaim:
    """A number or picture of the paper.

    place: table, figure or section. value: nan where the paper prints a picture only.
    key: of our measurement.
    how: the command that measures it. note: conditions of the paper.
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
    """A number of ours with its 95 % interval (nan: none) and the conditions that it
    holds for.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    conditions: str = ""


@dataclass(frozen=True, slots=True)
class ClaimLine:
    """A claim and what stands beside it.

    ours: None where it was not measured. picture: file of ours, '' for none.
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
    """Every claim beside what was measured; pictures are looked for in ``folder``."""
    out = []
    for claim in load_claims():
        name = claim.key.removeprefix("picture/")
        there = claim.picture and folder is not None and (folder / name).is_file()
        out.append(ClaimLine(claim, measured.get(claim.key), name if there else ""))
    return out


def of_experiment(path: Path) -> dict[str, MeasuredNumber]:
    """Measurements in an experiment.json whose runs are named by :data:`ROLES`.

    Args:
        path: of the file.

    Raises:
        StoreError: no such file, or of another version.
    """
    content = _json(path, "runs", "ratios", "settings")
    about = content["settings"]
    found: dict[str, MeasuredNumber] = {}
    for run in content["runs"]:
        words = f"{about['subjects']} synthetic subjects, {run['mmacs']:.1f} MMACs, seed {about['seed']}"
        for key, name in (
            ("slip", "slip_mm"),
            ("gaze_axial", "gaze_axial_deg"),
            ("gaze_lateral", "gaze_lateral_deg"),
            ("iou", "iou"),
        ):
            low, high = run.get(f"{name}_interval", (math.nan, math.nan))
            if run[name] is not None:  # a network without a mask has no overlap
                found[f"{key}/{run['name']}"] = MeasuredNumber(
                    run[name], low, high, words
                )
    for entry in content["ratios"]:
        if entry["against"] != "hyperbolic":
            continue
        for key, name in (
            ("slip", "slip_mm"),
            ("gaze_axial", "gaze_axial_deg"),
            ("gaze_lateral", "gaze_lateral_deg"),
        ):
            if entry["quantity"] == name:
                low, high = entry["interval"]
                found[f"{key}/ratio"] = MeasuredNumber(
                    entry["ratio"], low, high, "mid-range hyperbolic, paired subjects"
                )
    return found


def of_dim(bright: Path, dim: Path) -> dict[str, MeasuredNumber]:
    """The 15 dB test from an experiment in good light and one in dim light.

    Args:
        bright: experiment.json in good light.

    Raises:
        StoreError: no such file, or of another version.
    """
    good, poor = (
        {r["name"]: r["gaze_axial_deg"] for r in _json(p, "runs")["runs"]}
        for p in (bright, dim)
    )
    words = "gaze under axial slip, networks trained in good light"
    found = {}
    if "proposed" in poor:
        found["dim/proposed"] = MeasuredNumber(
            poor["proposed"] / good["proposed"], conditions=words
        )
        for name in ("hyperbolic", "double_helix"):
            if name in poor:
                found[f"dim/{name}"] = MeasuredNumber(
                    poor[name] / poor["proposed"], conditions=words
                )
    return found


def of_optics(path: Path) -> dict[str, MeasuredNumber]:
    """Measurements in an optics.json whose lenses are named by :data:`ROLES`,
    hyperbolic first.

    Args:
        path: of the file.

    Raises:
        StoreError: no such file, or of another version.
    """
    content = _json(path, "lenses", "angles_deg", "normalisation")
    found: dict[str, MeasuredNumber] = {}
    base = content["lenses"].get("hyperbolic")
    for name, values in content["lenses"].items():
        for kind, (value, low, high) in values["scene_ratios"].items():
            found[f"scenes/{kind}/{name}"] = MeasuredNumber(
                value, low, high, "same states, images of equal light"
            )
        if base is None:
            continue
        for i, angle in enumerate(content["angles_deg"]):
            one, other = (sum(v["information_per_mm2"][i][0]) for v in (values, base))
            words = f"honest I(z), {content['normalisation']} normalisation, pixels not binned"
            found[f"information/{angle:g}/{name}"] = MeasuredNumber(
                one / other, conditions=words
            )
    return found


def of_runs(rows: Mapping[str, list[dict[str, Any]]]) -> dict[str, MeasuredNumber]:
    """Fig. 8 a from the rows of result.json of the proposed and the hyperbolic run:
    errors at equal budgets.
    """
    if not {"proposed", "hyperbolic"} <= rows.keys():
        return {}
    ours, theirs = (
        {r["budget_mmacs"]: r for r in rows[name] if "axial_slip_mm" in r}
        for name in ("proposed", "hyperbolic")
    )
    shared = sorted(ours.keys() & theirs.keys())
    if not shared:
        return {}
    least = shared[0]
    error = ours[least]["axial_slip_mm"] / theirs[least]["axial_slip_mm"]
    found = {
        "fig8a/error": MeasuredNumber(
            error, conditions=f"axial slippage at {ours[least]['mmacs']:.1f} MMACs"
        )
    }
    goal = min(r["axial_slip_mm"] for r in theirs.values())
    best = min(r["mmacs"] for r in theirs.values() if r["axial_slip_mm"] == goal)
    enough = [r["mmacs"] for r in ours.values() if r["axial_slip_mm"] <= goal]
    if enough:
        found["fig8a/compute"] = MeasuredNumber(
            min(enough) / best, conditions=f"axial slippage of {goal:.2f} mm or less"
        )
    return found


def _json(path: Path, *needed: str) -> dict[str, Any]:
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
    """Parts of a finished run that did not move, from its result.json.

    Args:
        folder: of the files.

    Raises:
        TrainingError: no finished run, or of another version.
    """
    finished.rows_of(folder)  # refuses what is missing, cut short or empty
    return tuple(_json(folder / "result.json").get("frozen", ()))


def image_tolerance(folders: Sequence[Path]) -> float:
    """Of the true image that lenses of these runs are compared by: the largest that one
    of them is imaged at.

    Args:
        folders: of finished runs.
    """
    return max(
        runs.load_run_settings(folder / "run.toml").optics.image_tolerance
        for folder in folders
    )


@torch.no_grad()
def gaze_rows(
    folder: Path, *, people: int = PEOPLE, seed: int = 5
) -> list[dict[str, Any]]:
    """Gaze errors of every network of a finished run on people whom training never saw,
    after a calibration on a fifth of their frames; least compute first.

    Args:
        folder: of the files. people: how many. seed: of the random generator.

    Raises:
        TrainingError: no finished run, half written, or of another version.
    """
    settings = runs.load_run_settings(folder / "run.toml")
    going = runs.resume_run(folder / "checkpoint.safetensors", settings)
    trainer, net = going.trainer, going.trainer.model.net

    def simulate(stream: int, count: int, seed: int) -> Shown:
        found = bench.simulate_people(going.scenes(stream), count, EACH, seed=seed)
        return found, assess.frames_of(trainer, found)

    def read(architecture: Architecture, shown: Shown) -> NetworkReadings:
        one = assess.predict_frames(net, architecture, shown[1], settings.inner)
        return bench.read_of(shown[0], one.centre, one.slip_mm, one.axis)

    test = simulate(TEST, people, seed)
    before = functools.cache(lambda: simulate(CALIBRATION, BEFORE, seed + 1))
    known = assess.training_frames(trainer)
    out = []
    for row in sorted(finished.rows_of(folder), key=lambda r: float(r["mmacs"])):
        architecture = finished.architecture_of(row["architecture"], going, folder)
        finished.restore_network(going, row, folder)
        recalibrate_batch_norm(net, architecture, known)
        found, how = read(architecture, test), None
        if found.axis_deg is not None:
            others = before()
            how = bench.learn_from_people(others[0], read(architecture, others))
        error = bench.calibrated_error_deg(test[0], found, how=how)
        about = {"people": people, "frames_each": EACH, "seed": seed}
        out.append({"mmacs": row["mmacs"], **about, "personal_deg": error})
    return out


def of_gaze(content: Mapping[str, Mapping[str, Any]]) -> dict[str, MeasuredNumber]:
    """Table 2 from gaze.json, {folder: {rows of :func:`gaze_rows`}}: the first run is
    the proposed one. Networks of others are not rebuilt here.

    Args:
        content: of gaze.json.
    """
    for entry in content.values():
        rows = entry["rows"]
        accurate = min(rows, key=lambda r: float(r["personal_deg"]))
        return {
            "table2/proposed_efficient": _measured(rows[0]),
            "table2/proposed_accurate": _measured(accurate),
        }
    return {}


def _measured(row: Mapping[str, Any]) -> MeasuredNumber:
    words = f"{row['mmacs']:.1f} MMACs, {row['people']} synthetic people, seed {row['seed']}, {WORDS}"
    return MeasuredNumber(float(row["personal_deg"]), conditions=words)


def of_ablations(
    ours: Sequence[Mapping[str, Any]], others: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, MeasuredNumber]:
    """Fig. 8b: compute of a run with one part frozen over ours, at the best axial
    slippage that the frozen one reaches.

    ours: rows of the joint run. others: {frozen part: rows}. A part whose best error
    ours never reaches is left out.
    """
    found = {}
    for part, rows in others.items():
        best = min(rows, key=lambda r: float(r["axial_slip_mm"]))
        enough = [
            float(r["mmacs"])
            for r in ours
            if r["axial_slip_mm"] <= best["axial_slip_mm"]
        ]
        if enough:
            words = f"axial slippage of {best['axial_slip_mm']:.2f} mm or less, at {min(enough):.1f} MMACs"
            found[f"fig8b/{part}"] = MeasuredNumber(
                float(best["mmacs"]) / min(enough), conditions=words
            )
    return found


def frozen_rows(folders: Sequence[Path]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """(part, rows) of every run in which exactly one part was frozen.

    Args:
        folders: of finished runs.

    Raises:
        TrainingError: two runs with the same part frozen.
    """
    seen: dict[str, Path] = {}
    for folder in folders:
        parts = frozen_parts(folder)
        if len(parts) != 1:
            continue
        (part,) = parts
        if part in seen:
            raise TrainingError(
                f"{seen[part]} and {folder} both have {part} frozen; give one of them"
            )
        seen[part] = folder
        yield part, finished.rows_of(folder)
