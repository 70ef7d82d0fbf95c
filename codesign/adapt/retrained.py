"""A retraining taken up again: its network, with the lens it was trained on for, as
experiments show them.
"""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from characterize.bench import HiddenLens
from characterize.inference import asbuilt
from codesign.adapt import train as retraining
from codesign.adapt.source import (
    FinishedRun,
    is_retraining,
    lens_file,
    load_finished_run,
)
from codesign.optics import MadeLens
from codesign.settings import RetrainConfig
from codesign.train import RunConfig, checkpoint
from metalens import lens as lenses
from metalens.core import config, store, transaction
from metalens.core.errors import TrainingError

RECIPE, RESULT = "retrain.toml", "result.json"


@dataclass(frozen=True, slots=True)
class RetrainingRecipe:
    """What a retraining was made of, and a resume must find unchanged.

    asbuilt, weights, truth: SHA-256 of the files; '' without one.
    """

    settings: RetrainConfig
    asbuilt: str
    weights: str
    run: RunConfig
    truth: str = ""


def relative_inputs(
    folder: Path, run: Path, built: Path, truth: Path | None
) -> dict[str, str | None]:
    """Where a retraining's run, fit and truth lie, as seen from its folder, for its
    result.

    Args:
        built: asbuilt.h5.
    """
    paths = {"run": run, "asbuilt": built, "truth": truth}
    return {
        name: None if path is None else _from(folder, path)
        for name, path in paths.items()
    }


def run_of(path: Path) -> Path:
    """The folder of the run: of a retraining the one that it went on from, else the
    path itself.
    """
    return (
        _places(_folder(path))["run"] or path if is_retraining(_folder(path)) else path
    )


def lens_of(path: Path) -> str:
    """Which lens forms the images: "as designed", or of a retraining "as fitted", or
    "as made" where that is known.

    Args:
        path: of the file.
    """
    folder = _folder(path)
    if not is_retraining(folder):
        return "as designed"
    return "as made" if _places(folder)["truth"] else "as fitted"


def load_retrained(path: Path) -> FinishedRun:
    """A finished run as :func:`codesign.adapt.source.load_finished_run` has it; of a
    retraining its
    network and the made lens.

    Args:
        path: of a run, of a retraining, or a checkpoint in that:
            ``nominal.safetensors`` is the network that nobody
            warned of the made lens, ``known.safetensors`` the one that was trained with
            the truth known.

    The lens is the true one where the bench was virtual, else the one of the fitted
    values.

    Raises:
        TrainingError: no finished run or retraining, or one whose run, fit or truth is
            no longer what it was.
    """
    folder = _folder(path)
    if not is_retraining(folder):
        return load_finished_run(path)
    job = "retrained" if path == folder else path.stem
    transaction.check_manifest(folder)
    recipe = config.load(folder / RECIPE, RetrainingRecipe)
    places = _places(folder)
    for name, sha in (
        ("run", recipe.weights),
        ("asbuilt", recipe.asbuilt),
        ("truth", recipe.truth),
    ):
        _unchanged(folder, name, places[name], sha)
    source = load_finished_run(
        _known(places["run"]), budget_mmacs=recipe.settings.budget_mmacs
    )
    built = asbuilt.load(_known(places["asbuilt"]))
    truth = (
        None if places["truth"] is None else config.load(places["truth"], HiddenLens)
    )
    run_dir, budget = _known(places["run"]), source.row["budget_mmacs"]
    design = lenses.load_plain(lens_file(run_dir, source.settings, budget))
    made = MadeLens(design, source.settings.optics, response=built.response)
    found = retraining.lens_psfs(made, built, recipe.settings, truth)
    if (
        job not in retraining.available_jobs(found)
        or not (folder / f"{job}.safetensors").is_file()
    ):
        have = ", ".join(
            f"{name}.safetensors" for name in retraining.available_jobs(found)
        )
        raise TrainingError(f"{path}: no network of this retraining; it holds {have}")
    going = retraining.make_job(source, recipe.settings, found, job)
    going.restore(
        checkpoint.load(folder / f"{job}.safetensors", settings=recipe)["trainer"]
    )
    shown = found.judges[0] if found.known else found.best
    return replace(source, run=replace(source.run, trainer=going), made=shown)


def _folder(path: Path) -> Path:
    return path.parent if path.suffix == ".safetensors" else path


def _known(path: Path | None) -> Path:
    if path is None:
        raise TrainingError(
            "a retraining without a run or a fit: made by another version; retrain again"
        )
    return path


def _from(folder: Path, path: Path) -> str:
    try:
        return os.path.relpath(path.resolve(), folder.resolve())
    except ValueError:  # on another drive
        return str(path.resolve())


def _places(folder: Path) -> dict[str, Path | None]:
    """Run, fit and truth of a retraining.

    Raises:
        TrainingError: it is not finished, or of a version that did not note them.
    """
    try:
        inputs: dict[str, Any] = json.loads((folder / RESULT).read_text("utf-8"))[
            "given"
        ]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise TrainingError(
            f"{folder} holds a retraining that is not finished, or of a version that did not note its run and fit: go "
            f"on with `metalens retrain RUN_DIR --asbuilt FILE -o {folder} --resume`"
        ) from None
    return {
        name: folder / inputs[name] if inputs.get(name) else None
        for name in ("run", "asbuilt", "truth")
    }


def _unchanged(folder: Path, name: str, path: Path | None, sha: str) -> None:
    """Refuse what has moved away or become another."""
    file = (
        path / "checkpoint.safetensors" if path is not None and name == "run" else path
    )
    if file is None and not sha:
        return
    if file is None or not file.is_file():
        raise TrainingError(
            f"{folder}: its {name} is no longer at {path}; put it back, or retrain from where it is"
        )
    if store.sha256(file) != sha:
        raise TrainingError(
            f"{folder}: {file} is not what it was retrained from; give it back, or retrain"
        )
