"""A finished run as retraining and the experiments take it up, and what is refused:
half runs, other lenses.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from characterize.inference import AsBuilt
from codesign.network import Architecture
from codesign.optics import MadeLens, PixelPsfStack
from codesign.train import CodesignRun, RunConfig, checkpoint, evolution
from codesign.train import run as runs
from metalens.core import transaction
from metalens.core.errors import FitError, TrainingError
from metalens.lens import Lens, load_plain


@dataclass(frozen=True, eq=False, slots=True)
class FinishedRun:
    """A finished run that is trained on: its network, the architecture that was chosen,
    its row of result.json.

    folder: of the run. made: of a retraining, the fabricated lens; None where images
    are those of the run's own lens. lens: which of them forms the images, in words.
    """

    folder: Path
    run: CodesignRun
    architecture: Architecture
    row: dict[str, Any]
    made: PixelPsfStack | None = None
    lens: str = "as designed"

    @property
    def settings(self) -> RunConfig:
        """The run's settings."""
        return self.run.settings


def load_finished_run(folder: Path, *, budget_mmacs: float = 0.0) -> FinishedRun:
    """A finished run with the network of one budget, as it was evaluated in
    result.json.

    Where the run fine-tuned it or its optics, weights, lens and pitch are those of the
    network's own file.

    Args:
        folder: of the run.
        budget_mmacs: compute budget, million multiply-accumulates a frame; 0 for the
            largest.

    Raises:
        TrainingError: no run folder, half written, unfinished, of another version, or
            without such a budget.
    """
    _no_retraining(folder)
    names = ("run.toml", "checkpoint.safetensors", "lens.h5", "result.json")
    missing = [name for name in names if not (folder / name).is_file()]
    if len(missing) == len(names):
        raise TrainingError(
            f"{folder} is no run folder: {', '.join(missing)} missing; give the folder that "
            "`metalens codesign RUN.toml -o FOLDER` wrote"
        )
    if missing:
        raise TrainingError(
            f"{folder} is a half-written run: {', '.join(missing)} missing; finish it with "
            f"`metalens codesign RUN.toml -o {folder} --resume`"
        )
    rows = rows_of(folder)
    settings = runs.load_run_settings(folder / "run.toml")
    run = runs.resume_run(folder / "checkpoint.safetensors", settings)
    selected = (
        [r for r in rows if r["budget_mmacs"] == budget_mmacs]
        if budget_mmacs
        else rows[-1:]
    )
    if not selected:
        budgets = ", ".join(f"{r['budget_mmacs']:g}" for r in rows)
        raise TrainingError(
            f"{folder} holds no network of {budget_mmacs:g} MMACs; its budgets are {budgets}"
        )
    entry: dict[str, Any] = selected[0].get("architecture") or {}
    try:
        best = evolution.candidate_from_json(entry)
    except (KeyError, TypeError) as error:
        raise TrainingError(
            f"{folder}/result.json: its network is of another version ({error})"
        ) from None
    if settings.run.finetune_steps or settings.search.inner_steps:
        file = weights_file(folder, selected[0]["budget_mmacs"])
        run.trainer.model.restore(checkpoint.load_checkpoint(file, settings=settings))
    return FinishedRun(folder, run, best.architecture, selected[0])


def weights_file(folder: Path, budget_mmacs: float) -> Path:
    """Path of the weights of one network of a run.

    Args:
        folder: of the files.
        budget_mmacs: compute budget, million multiply-accumulates a frame.
    """
    return folder / f"subnet_{budget_mmacs:g}.safetensors"


def lens_file(folder: Path, settings: RunConfig, budget_mmacs: float) -> Path:
    """The lens of one network of a run: the run's, or its own.

    Args:
        folder: of the files. settings: of the run.
        budget_mmacs: compute budget, million multiply-accumulates a frame.
    """
    name = f"lens_{budget_mmacs:g}" if settings.search.inner_steps else "lens"
    return folder / f"{name}.h5"


def is_retraining(folder: Path) -> bool:
    """Whether a folder is one of `metalens retrain`."""
    return (folder / "retrain.toml").is_file()


def _no_retraining(folder: Path) -> None:
    """Refuse a folder of `metalens retrain`, which holds a network and not the run that
    it belongs to.
    """
    if is_retraining(folder):
        raise TrainingError(
            f"{folder} holds a retraining, no run: its network was trained on for one made lens; give the folder that "
            "`metalens codesign RUN.toml -o FOLDER` wrote"
        )


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Rows of result.json, least budget first.

    Args:
        folder: of the files.

    Raises:
        TrainingError: the file is missing, cut short or of another version.
    """
    _no_retraining(folder)
    transaction.check_manifest(folder)
    path = folder / "result.json"
    if not path.is_file():
        raise TrainingError(f"{path} is missing: no finished run; resume the run")
    try:
        rows: list[dict[str, Any]] = sorted(
            json.loads(path.read_text("utf-8"))["rows"], key=lambda r: r["budget_mmacs"]
        )
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise TrainingError(
            f"{path}: cut short or of another version ({error!r}); resume the run"
        ) from None
    return rows


def fabricated_lens(
    source: FinishedRun, result: AsBuilt, *, insist: bool = False
) -> MadeLens:
    """The designed lens of a run, ready to be perturbed as a fit found it.

    Args:
        source: finished run. result: of the fit to captures of its lens.
        insist: accept a fit that failed its own checks.

    Raises:
        FitError: see :func:`check_lens`.
    """
    budget_mmacs = source.row["budget_mmacs"]
    design = load_plain(lens_file(source.folder, source.settings, budget_mmacs))
    check_lens(design, result, insist=insist)
    return MadeLens(design, source.settings.optics, response=result.response)


def check_lens(design: Lens, result: AsBuilt, *, insist: bool = False) -> None:
    """Refuse an as-built record of another lens, or of a fit that failed its own
    checks.

    Args:
        design: as designed. result: of the fit.
        insist: accept a fit that failed its own checks.

    Raises:
        FitError: either of the two, with what to do.
    """
    own, other = design.diameters, result.design.diameters
    if (
        own.diameter_um.shape != other.diameter_um.shape
        or own.pitch_um != other.pitch_um
    ):
        raise FitError(
            f"the as-built record is of another lens: {other.diameter_um.shape} pillars of pitch {other.pitch_um} um, "
            f"the run's lens has {own.diameter_um.shape} of {own.pitch_um} um; fit captures of the run's own lens.h5"
        )
    gap_um = float(np.abs(own.diameter_um - other.diameter_um).max())
    if gap_um > 1e-6 or design.sensor_distance_um != result.design.sensor_distance_um:
        raise FitError(
            f"the as-built record is of another lens: designed diameters differ by up to {gap_um * 1e3:.1f} nm, sensor "
            f"distances are {design.sensor_distance_um} and {result.design.sensor_distance_um} um; "
            "fit captures of the run's own lens.h5"
        )
    if not result.trusted and not insist:
        raise FitError(
            "the fit was refused by its own checks: "
            + "; ".join(result.problems)
            + ". Mend the captures and fit "
            "again; --insist trains on it in spite of that"
        )
