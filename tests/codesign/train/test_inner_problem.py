"""Eq. 10: every candidate has optics, pitch and weights of its own, within its budget."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.adapt import source as finished
from codesign.gaze import bench
from codesign.gaze.readings import NetworkReadings
from codesign.network.architecture import smallest_architecture
from codesign.train import run as runs
from codesign.train import search
from metalens import lens
from tests.codesign import made_lens as m
from tests.command_line import call

MOVING = (
    m.TINY.replace("polynomials = 0", "polynomials = 4")
    .replace("[inner.optics]\nrate = 0.0", "[inner.optics]\nrate = 0.08")
    .replace("[search]", "[inner.pitch]\nrate = 0.02\n[search]\ninner_steps = 3")
)


def _settings(tmp_path):
    (tmp_path / "run.toml").write_text(MOVING)
    return runs.load_run_settings(tmp_path / "run.toml")


def test_the_inner_problem_moves_lens_pitch_and_weights_and_leaves_the_supernet(
    tmp_path,
):
    going = runs.start_run(_settings(tmp_path))
    net = {k: v.clone() for k, v in going.trainer.model.net.state_dict().items()}
    only = smallest_architecture(going.settings.space)
    one, again = (search.specialise_candidate(going, only, 2.0) for _ in range(2))
    assert float(one.model.coefficients_rad.detach().norm()) > 1e-3
    assert float(one.model.pitch_um.detach()) != pytest.approx(3.0, abs=1e-6)
    assert torch.equal(one.model.coefficients_rad, again.model.coefficients_rad)
    assert torch.equal(one.model.log_pitch, again.model.log_pitch)
    assert not going.trainer.model.coefficients_rad.any()
    for name, value in going.trainer.model.net.state_dict().items():
        assert torch.equal(value, net[name]), name
    other = search.specialise_candidate(going, only, 1.9)
    assert not torch.equal(one.model.coefficients_rad, other.model.coefficients_rad)


def test_own_pitch_keeps_the_budget(tmp_path):
    """A pitch that would go finer ends where the candidate's count meets the budget."""
    settings = _settings(tmp_path)
    going = runs.start_run(
        replace(settings, search=replace(settings.search, inner_steps=8))
    )
    only = smallest_architecture(settings.space)
    budget = 1.02 * going.macs(only) / 1e6
    made = search.specialise_candidate(going, only, budget)
    pitch = float(made.model.pitch_um.detach())
    assert going.counted(only, pitch) <= budget * 1e6


def test_a_run_keeps_a_lens_for_every_budget_and_reads_it_back(tmp_path):
    (tmp_path / "run.toml").write_text(MOVING)
    out = tmp_path / "out"
    assert call(f"codesign {tmp_path}/run.toml -o {out}") == 0
    source = finished.load_finished_run(out)
    model = source.run.trainer.model
    assert source.row["pitch_um"] == pytest.approx(float(model.pitch_um.detach()))
    assert 0 < source.row["gaze_deg"] < 90
    shared, own = (lens.load(out / f"{name}.h5") for name in ("lens", "lens_2"))
    assert not np.array_equal(shared.diameters.diameter_um, own.diameters.diameter_um)
    raw = runs.resume_run(out / "checkpoint.safetensors", source.settings)
    assert not torch.equal(model.coefficients_rad, raw.trainer.model.coefficients_rad)


def test_true_pupil_and_slippage_leave_little_gaze_error_and_slippage_unseen_much(
    tmp_path,
):
    """Solver and regressor on what is true: anatomy and fixation beyond four frames of
    calibration leave some degrees; slippage that is not read adds far more.
    """
    settings = _settings(tmp_path)
    people = bench.simulate_people(runs.start_run(settings).scenes(1), 6, 20, seed=3)
    camera = people.scenes.camera.pitch_um * people.scenes.camera.pixels / 32
    pupil = ((people.labels.pupil_px - 15.5) * camera * 1e-3).numpy()
    slip = (people.labels.slip_um * 1e-3).numpy()
    true = bench.calibrated_error_deg(people, NetworkReadings(pupil, slip))
    blind = bench.calibrated_error_deg(people, NetworkReadings(pupil, 0 * slip))
    assert true < 0.6 * blind
    assert math.isfinite(blind)
