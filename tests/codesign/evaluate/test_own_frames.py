"""Frames of the simulator as images and a table: the predictions of the path in memory,
and errors against the targets of the table.
"""

import csv
import json
import runpy
from pathlib import Path

import cv2
import numpy as np
import pytest

from codesign.adapt import source as finished
from codesign.batches import EXPERIMENT, as_batch
from codesign.evaluate import gaze_experiment as experiment
from codesign.settings import ExperimentConfig
from codesign.train import assess
from metalens.cli import main
from tests.codesign import made_lens as m
from tests.command_line import call

CONFIG = ExperimentConfig(
    subjects=1, grid=(3, 2), share=0.5, people=2, axial_mm=(1.5,), lateral_mm=()
)
WORDS = ["--grid", "3", "2", "--share", "0.5", "--people", "2", "--axial-mm", "1.5"]


@pytest.fixture(scope="module")
def device(tmp_path_factory):
    """(folder of a run and its frames, predictions in memory, rows of the table)."""
    folder = tmp_path_factory.mktemp("own")
    m.finished_run(folder / "run")
    source = finished.load_finished_run(folder / "run")
    scenes, trainer = source.run.scenes(EXPERIMENT), source.run.trainer
    states, trial = experiment.draw_trials(CONFIG, 3, scenes)
    rendered = experiment.render_subject(states, CONFIG, 3, scenes)
    imager = experiment.prepare_run(source)
    batch = as_batch(rendered, source.settings.scenes.margin)
    frames = assess.read_batch(trainer, batch, imager, seed=8)
    predicted = experiment.predict_with_run(source, frames)
    (folder / "frames").mkdir()
    rows = []
    for k, frame in enumerate(frames.frames[:, 0].double().numpy()):
        step = np.diff(np.unique(frame)).min()  # one count of the sensor
        counts = np.rint((frame - frame.min()) / step).astype(np.uint16)
        mask = (255 * (frames.mask[k] > 0.5).numpy()).astype(np.uint8)
        for name, image in (("f", counts), ("m", mask)):
            cv2.imwrite(str(folder / "frames" / f"{name}{k}.png"), image)
        # 48 pixels of one sample; 3 and 4 pixels beside what is predicted
        x, y = 48 * predicted.centre[k].double().numpy() + 23.5 + [3, -4]
        gaze, slip = trial.stimulus_deg[k], batch.slip_mm[k].tolist()
        rows.append([f"f{k}.png", f"m{k}.png", x, y, *slip, *gaze])
    return folder, predicted, rows


HEAD = "file,mask,pupil_x_px,pupil_y_px,slip_x_mm,slip_y_mm,slip_z_mm,gaze_x_deg,gaze_y_deg"


def _write(folder, rows, head=HEAD):
    lines = [head, *(",".join(map(str, row)) for row in rows)]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")


def _unit(x_deg, y_deg):
    x, y = np.radians([x_deg, y_deg]).astype(float)
    return np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)])


def test_images_and_a_table_give_the_predictions_of_the_path_in_memory(device, capsys):
    folder, predicted, rows = device
    _write(folder / "frames", rows)
    words = ["evaluate", "experiment", str(folder / "run"), "--json", *WORDS]
    words += ["--frames", str(folder / "frames"), "-o", str(folder / "out")]
    assert main(words) == 0
    (told,) = json.loads(capsys.readouterr().out)["runs"]
    with (folder / "out" / "run.csv").open() as file:
        table = list(csv.DictReader(file))
    got = {k: np.array([float(r[k]) for r in table]) for k in table[0] if k != "file"}
    slip = predicted.slip_mm.double().numpy()
    truth = np.array([row[4:7] for row in rows])
    # frames in float32, standardised in another order
    for axis, name in enumerate("xyz"):
        assert np.allclose(got[f"slip_{name}_mm"], slip[:, axis], atol=1e-4)
    assert np.allclose(got["pupil_error_px"], 5.0, atol=1e-3)
    assert np.allclose(got["iou"], predicted.iou.numpy(), atol=1e-3)
    assert told["slip_error_mm"] == pytest.approx(abs(slip - truth).mean(), abs=1e-4)
    target = _unit(*np.array([row[7:] for row in rows]).T)
    cosine = (_unit(got["gaze_x_deg"], got["gaze_y_deg"]) * target).sum(0)
    judged = np.isfinite(got["gaze_error_deg"])
    assert judged.sum() == len(rows) // 2
    angle = np.degrees(np.arccos(cosine))[judged]
    assert np.allclose(got["gaze_error_deg"][judged], angle, atol=1e-4)
    assert "Own frames" in (folder / "out" / "report.html").read_text()


def test_the_example_reads_frames_without_a_gaze(device, capsys):
    folder, _, rows = device
    _write(folder / "frames", [[row[0], *row[4:7]] for row in rows[:3]],
           "file,slip_x_mm,slip_y_mm,slip_z_mm")  # fmt: skip
    path = Path(__file__).parents[3] / "examples" / "own_frames.py"
    errors = runpy.run_path(str(path))["mean_errors"](folder / "run", folder / "frames")
    assert set(errors) == {"slip_error_mm", "axial_slip_error_mm"}
    assert "f2.png: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("head", "row", "words"),
    [(None, (), "frames.csv: no such file; write a row for each image"),
     ("file,gaze_x_deg", ("f0.png", 3), "column gaze_y_deg missing"),
     ("name", ("f0.png",), "it takes a row an image, the columns file"),
     ("file,slip_x_mm,slip_y_mm,slip_z_mm", ("f0.png", 1, 2, "far"), "every row needs its targets"),
     ("file", ("small.png",), "31 x 48 pixels, the run's sensor has 48 x 48: crop or bin"),
     ("file", ("gone.png",), "gone.png")],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_with_the_cure(
    device, tmp_path, capsys, head, row, words
):
    folder, _, _ = device
    (tmp_path / "f0.png").write_bytes((folder / "frames" / "f0.png").read_bytes())
    cv2.imwrite(str(tmp_path / "small.png"), np.full((48, 31), 9, np.uint8))
    if head:
        _write(tmp_path, [row], head)
    command = f"evaluate experiment {folder}/run -o {tmp_path}/o"
    assert call(f"{command} --frames {tmp_path}") == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
