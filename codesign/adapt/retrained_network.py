"""Finished retrainings: their network with the fabricated lens."""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

from characterize.bench import HiddenLens
from characterize.inference import AsBuilt
from codesign.adapt import train as retraining
from codesign.adapt.source import (
    FinishedRun,
    fabricated_lens,
    is_retraining,
    load_finished_run,
)
from codesign.settings import RetrainConfig
from codesign.train import RunConfig, checkpoint
from metalens.core import config, store, transaction
from metalens.core.errors import TrainingError

RECIPE, RESULT = "retrain.toml", "result.json"


@dataclass(frozen=True, slots=True)
class RetrainingRecipe:
    """Inputs of a retraining, which must be unchanged for a resume.

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
    """Paths of a retraining's run, fit and truth relative to its folder, for its
    result.

    Args:
        folder: of the retraining. run: folder of its run. built: asbuilt.h5.
        truth: of the virtual bench, or None.
    """
    paths = {"run": run, "asbuilt": built, "truth": truth}
    return {
        name: os.path.relpath(path.resolve(), folder.resolve()) if path else None
        for name, path in paths.items()
    }


def load_retrained(path: Path) -> FinishedRun:
    """A finished run, or a retraining as one: its network with the PSFs of the made
    lens.

    The lens is the true one where the bench was virtual, else that of the fitted
    values.

    Args:
        path: of a run, of a retraining, or a checkpoint in that:
            ``nominal.safetensors`` is the network trained on the designed lens,
            ``known.safetensors`` that trained on the true lens.

    Raises:
        TrainingError: no finished run or retraining, or one whose run, fit or truth has
            changed.
    """
    folder = path.parent if path.suffix == ".safetensors" else path
    if not is_retraining(folder):
        return load_finished_run(path)
    job = "retrained" if path == folder else path.stem
    transaction.check_manifest(folder)
    recipe = config.load(folder / RECIPE, RetrainingRecipe)
    run_dir = _unchanged(folder, "run", recipe.weights)
    built = AsBuilt.load(_unchanged(folder, "asbuilt", recipe.asbuilt))
    source = load_finished_run(run_dir, budget_mmacs=recipe.settings.budget_mmacs)
    lens = fabricated_lens(source, built, insist=True)
    made = fitted = lens.stack(built.parameters())
    which_lens = "as fitted"
    stacks = {"nominal": lens.stack(), "retrained": fitted}
    if recipe.truth:
        truth = config.load(_unchanged(folder, "truth", recipe.truth), HiddenLens)
        made = stacks["known"] = lens.stack(truth.vector())
        which_lens = "as made"
    if job not in stacks or not (folder / f"{job}.safetensors").is_file():
        available = ", ".join(f"{name}.safetensors" for name in stacks)
        raise TrainingError(
            f"{path}: no network of this retraining; it holds {available}"
        )
    # batch statistics are those behind the lens that the network was trained on for
    trainer = retraining.make_trainer(source, recipe.settings, (stacks[job],))
    state = checkpoint.load_checkpoint(folder / f"{job}.safetensors", settings=recipe)
    trainer.model.restore(state["trainer"])
    run = replace(source.run, trainer=trainer)
    return replace(source, run=run, made=made, lens=which_lens)


def _input_paths(folder: Path) -> dict[str, Path | None]:
    """Run, fit and truth of a retraining.

    Raises:
        TrainingError: it is not finished, or of a version that did not note them.
    """
    try:
        inputs = json.loads((folder / RESULT).read_text("utf-8"))["given"]
        names = ("run", "asbuilt", "truth")
        return {name: folder / inputs[name] if inputs[name] else None for name in names}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        raise TrainingError(
            f"{folder} holds a retraining that is not finished, or of a version that did not note its run and fit: go "
            f"on with `metalens retrain RUN_DIR --asbuilt FILE -o {folder} --resume`"
        ) from None


def _unchanged(folder: Path, name: str, sha: str) -> Path:
    """Path of an input of a retraining, whose SHA-256 is the one that it noted.

    Raises:
        TrainingError: the input is missing or another, with its name and path.
    """
    path = _input_paths(folder)[name] or folder
    file = path / "checkpoint.safetensors" if name == "run" else path
    if not file.is_file():
        raise TrainingError(
            f"{folder}: its {name} is no longer at {path}; put it back, or retrain from where it is"
        )
    if store.sha256(file) != sha:
        raise TrainingError(
            f"{folder}: {file} is not what it was retrained from; give it back, or retrain"
        )
    return path
