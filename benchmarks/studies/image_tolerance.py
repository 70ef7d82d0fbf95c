"""Axial slippage error of finished runs on images formed at other tolerances.

``python -m benchmarks.studies.image_tolerance RUN [RUN ...]`` reads the networks of
each run on the same test frames, through the same lens, imaged at each of
``TOLERANCES``. Where a result depends on the tolerance, the network has learned the
image model and not the lens.
"""

import dataclasses
import sys
from pathlib import Path

from codesign.adapt.source import load_finished_run
from codesign.batches import TEST
from codesign.network import recalibrate_batch_norm
from codesign.train import assess

TOLERANCES = (0.1, 0.03, 0.012, 0.003)


def axial_errors_mm(folder: Path, budget_mmacs: float) -> list[float]:
    """Mean absolute axial slippage error in mm of one network at each tolerance."""
    source = load_finished_run(folder, budget_mmacs=budget_mmacs)
    trainer, settings = source.run.trainer, source.settings
    net, architecture = trainer.model.net, source.architecture
    recalibrate_batch_norm(net, architecture, assess.training_frames(trainer))
    errors = []
    for tolerance in TOLERANCES:
        optics = dataclasses.replace(trainer.optics, image_tolerance=tolerance)
        frames = assess.sensor_frames(
            trainer, source.run.scenes(TEST), settings.test_batches, optics=optics
        )
        read = assess.predict_frames(net, architecture, frames, settings.inner)
        errors.append(float((read.slip_mm - frames.slip_mm).abs().mean(0)[2]))
    return errors


def main() -> None:
    """Print a Markdown table: a row for each network, a column for each tolerance."""
    judged = " | ".join(f"judged at {t:g}" for t in TOLERANCES)
    print(f"| run | trained at | MMACs | {judged} |")
    print("|---" * (3 + len(TOLERANCES)) + "|")
    for folder in map(Path, sys.argv[1:]):
        settings = load_finished_run(folder).settings
        for budget in settings.run.budgets_mmacs:
            errors = " | ".join(f"{e:.3f}" for e in axial_errors_mm(folder, budget))
            print(
                f"| {folder.name} | {settings.optics.image_tolerance:g} "
                f"| {budget:g} | {errors} |"
            )


if __name__ == "__main__":
    main()
