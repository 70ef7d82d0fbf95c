"""The true image while a lens trains: formed anew in time, resumed bit for bit, refused
where it cannot be.
"""

from dataclasses import replace

import pytest
import torch

from codesign.optics import stack
from codesign.optics.stack import OpticsConfig
from codesign.train import run
from codesign.train.imaging import StepImaging
from metalens.core.errors import TrainingError

FRAMES = """
[scenes]
pixels = 32
margin = 5
pool = 6
[inner]
steps = 4
batch = 2
"""
TRUE = f"""
preset = "smoke"
checkpoint_every = 1
validation_batches = 1
test_batches = 1
{FRAMES}
refresh = 2
draws = 3
optics_weight = 0.0
[inner.optics]
rate = 0.05
start = 0.0
end = 0.7
[space]
resolution = [0.9, 1.0]
[search]
population = 1
tournament = 1
rounds = 1
[run]
budgets_mmacs = [2.0]
pitch_um = 12.0
[optics]
image = "true"
image_tolerance = 0.4
aperture_mm = 0.3
focus_mm = 30.0
depths_mm = [16.0, 30.0]
sample_um = 12.0
polynomials = 5
depth_count = 4
window_samples = 11
"""


def _never(step):
    return None


def test_a_run_through_the_true_image_moves_its_lens_and_resumes_bit_for_bit(tmp_path):
    (tmp_path / "run.toml").write_text(TRUE)
    settings = run.load_run_settings(tmp_path / "run.toml")
    whole = run.start_run(settings)
    records = list(run.train_run(whole, tmp_path / "whole"))
    assert all(r.skipped == 0 for r in records)
    part = run.start_run(settings)
    steps = run.train_run(part, tmp_path / "part")
    next(steps), next(steps)  # imaged at step 0, moved since
    going = run.resume_run(tmp_path / "part", settings)
    list(run.train_run(going, tmp_path / "part"))
    assert torch.equal(
        whole.trainer.model.coefficients_rad, going.trainer.model.coefficients_rad
    )
    assert float(whole.trainer.model.coefficients_rad.abs().max()) > 1e-3
    with pytest.raises(TrainingError, match=r'optics\.image: "true" -> "uniform"'):
        run.resume_run(
            tmp_path / "part",
            replace(settings, optics=replace(settings.optics, image="uniform")),
        )
    one = replace(settings, optics=replace(settings.optics, image="uniform"))
    run.save_run(tmp_path / "one", run.start_run(one))
    with pytest.raises(TrainingError, match=r'optics\.image: "uniform" -> "true"'):
        run.resume_run(tmp_path / "one", settings)
    with pytest.raises(TrainingError, match=r"optics\.fwhm_nm: 0\.0 -> 30\.0"):
        run.resume_run(
            tmp_path / "part",
            replace(settings, optics=replace(settings.optics, fwhm_nm=30.0)),
        )
    pixel = replace(settings.run, pitch_um=settings.run.pitch_um * 1.5)
    with pytest.raises(TrainingError, match=r"run\.pitch_um: "):
        run.resume_run(tmp_path / "part", replace(settings, run=pixel))


def test_a_made_lens_known_on_axis_alone_is_no_true_image():
    settings = OpticsConfig(polynomials=0)
    assert settings.image == "true"  # what training sees where nothing is said
    made = stack.lens_psf_stack(replace(settings, image="uniform"), torch.zeros(0))
    light = StepImaging(settings, (made,), refresh=2, draws=2, seed=0, draw=_never)
    with pytest.raises(TrainingError, match="cannot stand for the field"):
        light.at(0, torch.zeros(0), 160, 16, live=False)


STILL = f"""
preset = "smoke"
{FRAMES}
[inner.optics]
rate = 0.0
[inner.pitch]
rate = 0.0
[space]
resolution = [0.9, 1.0]
[run]
budgets_mmacs = [4.0]
pitch_um = 12.0
[optics]
image = "uniform"
aperture_mm = 0.3
focus_mm = 30.0
depths_mm = [16.0, 30.0]
sample_um = 12.0
depth_count = 4
window_samples = 11
"""


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_a_still_lens_trains_to_the_same_bits_on_two_threads_after_a_stop(
    tmp_path, threads
):
    path = tmp_path / "r.toml"
    path.write_text(STILL, "utf-8")
    settings, found = run.load_run_settings(path), []
    threads(2)
    for stop in (4, 1):
        trainer = run.start_run(settings).trainer
        lines = list(trainer.run(until=stop))
        if stop < 4:
            again = run.start_run(settings).trainer
            again.restore(trainer.state())
            lines, trainer = lines + list(again.run()), again
        found.append((lines, trainer.model.net.state_dict()))
    (lines, state), other = found
    assert lines == other[0]
    assert all(torch.equal(state[name], value) for name, value in other[1].items())
