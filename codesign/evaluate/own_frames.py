"""Eye frames of a user's own device, read by a run's network and compared with the
targets that are given.
"""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from characterize.captures import capture
from codesign.adapt import FinishedRun
from codesign.evaluate import gaze_experiment as experiment
from codesign.gaze import angle_deg
from codesign.settings import ExperimentConfig
from codesign.train import SensorFrames, frame_wide
from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.psf import pixel_count

# columns of a target, which are given together
TARGETS = {
    "pupil": ("pupil_x_px", "pupil_y_px"),
    "slip": ("slip_x_mm", "slip_y_mm", "slip_z_mm"),
    "gaze": ("gaze_x_deg", "gaze_y_deg"),
}


def read_frames_table(path: Path) -> tuple[list[dict[str, str]], dict[str, Array]]:
    """Rows of a table of frames, and the targets that it gives, (n, 2 or 3) by name of
    :data:`TARGETS`.

    Its columns: ``file``; as far as they are known ``subject``, ``mask`` (an image, 0
    outside the pupil), and all columns of a target.

    Args:
        path: of the table.

    Raises:
        ConfigError: no table, a missing or unknown column, or no number.
    """
    if not path.is_file():
        raise ConfigError(
            f"{path}: no such file; write a row for each image with the column file, and the targets that you know"
        )
    rows = list(csv.DictReader(reading.read_text(path).splitlines()))
    columns = set(rows[0] if rows else ())
    given = {name: group for name, group in TARGETS.items() if columns & {*group}}
    needed = {"file"}.union(*given.values())
    if wrong := (needed - columns) | (columns - needed - {"subject", "mask"}):
        known = ", ".join(["file", "subject", "mask", *sum(TARGETS.values(), ())])
        raise ConfigError(
            f"{path}: column {', '.join(map(str, wrong))} missing or not known; it takes a row an image, the columns "
            f"{known}, and all columns of a target or none"
        )
    try:
        return rows, {
            name: np.array([[float(row[c]) for c in group] for row in rows])
            for name, group in given.items()
        }
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: {error}; every row needs its targets") from None


def read_frames(folder: Path, names: list[str], size: int) -> Tensor:
    """(n, y, x) counts of images of one size.

    Args:
        folder: of the files. names: of the files.
        size: pixels of the run's sensor along a side.

    Raises:
        ConfigError: an image of another size. CaptureError: one that is missing or
            cannot be read.
    """
    images = [capture.read_images(folder / name)[0] for name in names]
    for name, image in zip(names, images, strict=True):
        if image.shape != (size, size):
            raise ConfigError(
                f"{folder / name}: {image.shape[1]} x {image.shape[0]} pixels, the run's sensor has {size} x {size}: "
                "crop or bin the frames to it"
            )
    return torch.from_numpy(np.stack(images).astype(float))


@torch.no_grad()
def predict_own_frames(
    source: FinishedRun, folder: Path, config: ExperimentConfig
) -> dict[str, Any]:
    """Columns of predictions for the frames of ``frames.csv``, and of their absolute
    errors where targets are given.

    Gaze needs targets: ``config.share`` of every subject's stimuli calibrates, as in
    the virtual experiment. Its error is nan in those frames.

    Args:
        source: finished run: its network, lens and sensor.
        folder: of ``frames.csv`` and its images.
        config: calibration, light and image of the simulated people of the prior.

    Raises:
        ConfigError, CaptureError: see :func:`read_frames_table`, :func:`read_frames`.
        TrainingError: fewer than three frames of a subject to calibrate on.
    """
    trainer, settings = source.run.trainer, source.settings
    sample_um, samples = settings.optics.sample_um, settings.scenes.pixels
    pitch_um = float(trainer.model.pitch_um.detach())
    size = pixel_count(samples, sample_um, pitch_um)
    rows, targets = read_frames_table(folder / "frames.csv")
    counts = read_frames(folder, [row["file"] for row in rows], size)
    mask = blank = torch.zeros_like(counts)
    if "mask" in rows[0]:
        mask = (read_frames(folder, [row["mask"] for row in rows], size) > 0).double()
    imager = experiment.prepare_run(source, image=config.image)
    deviation, mean = torch.std_mean(counts, (1, 2), keepdim=True)
    frames = ((counts - mean) / deviation.clamp_min(1e-6))[:, None].float()
    wide = frame_wide(samples, sample_um, pitch_um)
    predicted = experiment.predict_with_run(
        source, SensorFrames(frames, mask, blank, settings.inner.batch, blank, wide)
    )
    read = experiment.collect_readings([predicted], source)
    pupil_px = read.pupil_mm * 1e3 / pitch_um + (size - 1) / 2
    values = {"pupil": pupil_px, "slip": read.slip_mm}
    table: dict[str, Any] = {"file": [row["file"] for row in rows]}
    if "pupil" in targets:
        table["pupil_error_px"] = np.hypot(*(pupil_px - targets["pupil"]).T)
    if "slip" in targets:
        error_mm = np.abs(read.slip_mm - targets["slip"])
        table["slip_error_mm"] = error_mm.mean(1)
        table["axial_slip_error_mm"] = error_mm[:, 2]
    if "gaze" in targets:
        gaze_deg = targets["gaze"]
        people = [row.get("subject", "") for row in rows]
        subject, stimulus = (
            np.unique(keys, axis=0, return_inverse=True)[1].ravel()
            for keys in (people, gaze_deg)
        )
        trial = experiment.ExperimentTrials(
            subject, stimulus, 0 * subject, gaze_deg, read.slip_mm
        )
        (sensor,) = experiment.experiment_sensors([source], config)
        calibrator = experiment.run_calibrator(source, imager, config, sensor)
        values["gaze"], judged = experiment.calibrated_gaze(
            read, trial, config, calibrator
        )
        error_deg = angle_deg(values["gaze"], gaze_deg)
        table["gaze_error_deg"] = np.where(judged, error_deg, np.nan)
    if mask is not blank:
        table["iou"] = predicted.iou.numpy()
    for name, predictions in values.items():
        table |= dict(zip(TARGETS[name], predictions.T, strict=True))
    return table
