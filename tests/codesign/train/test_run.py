"""A whole run at the smallest size: presets, stop and resume bit for bit, search within
budgets, refusals by name.
"""

import gc
import math
from dataclasses import replace

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from codesign.batches import FramePool
from codesign.network import windows
from codesign.network.architecture import smallest_architecture
from codesign.train import run, search
from codesign.train.results import finished_budgets
from metalens.core.errors import ConfigError, TrainingError

TINY = """
preset = "smoke"
checkpoint_every = 1
validation_batches = 1
test_batches = 1
[scenes]
pixels = 48
pool = 6
[inner]
steps = 2
batch = 2
[inner.optics]
rate = 0.02
start = 0.0
end = 0.9
[search]
population = 2
tournament = 1
rounds = 3
[run]
budgets_mmacs = [2.0]
[optics]
image = "uniform"
aperture_mm = 0.3
sensor_distance_mm = 1.0
depth_count = 4
window_samples = 9
"""


@pytest.fixture
def settings(tmp_path):
    (tmp_path / "run.toml").write_text(TINY)
    return run.load_run_settings(tmp_path / "run.toml")


def test_runs_of_several_seeds_hold_one_pool_of_frames_between_them(settings):
    """Nine runs of an experiment held nine pools of a gigabyte; a pool that went is
    rendered again, the same.
    """
    going = [
        run.start_run(replace(settings, inner=replace(settings.inner, seed=seed)))
        for seed in (31, 32)
    ]
    first, other, again = (going[i].trainer.scenes.batch(1, 2) for i in (0, 1, 0))
    gc.collect()
    assert sum(isinstance(held, FramePool) for held in gc.get_objects()) <= 1
    assert torch.equal(first.slip_mm, again.slip_mm)
    assert torch.equal(first.mask, again.mask)
    assert not torch.equal(first.slip_mm, other.slip_mm)


def _end(going, path):
    list(run.train_run(going, path))
    list(search.search_architectures(going, path))
    return [end.row for end in finished_budgets(going)]


def test_frames_are_those_of_the_run_s_own_camera(settings):
    """1.0 mm in the file are 1000 um to the scenes, of training and of any other
    stream.
    """
    going = run.start_run(replace(settings, scenes=replace(settings.scenes, pool=0)))
    for scenes in (going.trainer.scenes, going.scenes(5)):
        assert scenes.sensor_distance_um == pytest.approx(1000.0)
        assert scenes.sample_um == settings.optics.sample_um
        assert scenes.seed == settings.inner.seed
    assert going.scenes(5).stream == 5


@pytest.mark.parametrize("name", ["smoke", "laptop", "paper"])
def test_every_preset_is_a_valid_run_whose_psfs_fit_its_margin(tmp_path, name):
    (tmp_path / "run.toml").write_text(f'preset = "{name}"')
    found = run.load_run_settings(tmp_path / "run.toml")
    assert found.preset == name
    assert found.scenes.margin >= found.optics.window_samples // 2
    side = found.scenes.pixels + 2 * found.scenes.margin
    assert found.scenes.pool * side**2 * 3 < 4e9  # bytes of the pool


def test_a_run_stopped_in_training_and_in_search_ends_bit_for_bit_the_same_within_budget(
    settings, tmp_path
):
    whole = run.start_run(settings)
    rows = _end(whole, tmp_path / "whole")

    first = run.start_run(settings)
    steps = run.train_run(first, tmp_path / "part")
    next(steps), next(steps)
    second = run.resume_run(tmp_path / "part", settings)
    # the checkpoint of the second step is written after the record is taken
    assert second.trainer.step == 1
    list(run.train_run(second, tmp_path / "part"))
    births = search.search_architectures(second, tmp_path / "part")
    next(births), next(births)
    third = run.resume_run(tmp_path / "part", settings)
    assert _end(third, tmp_path / "part") == rows
    for a, b in zip(
        whole.trainer.model.net.state_dict().values(),
        third.trainer.model.net.state_dict().values(),
        strict=True,
    ):
        assert torch.equal(a, b)
    assert torch.equal(
        whole.trainer.model.coefficients_rad, third.trainer.model.coefficients_rad
    )
    assert float(whole.trainer.model.coefficients_rad.abs().max()) > 0
    assert all(c.macs <= 2e6 for s in whole.searches for c in s.history)


def test_changed_settings_and_unfinished_runs_are_refused(settings, tmp_path):
    going = run.start_run(settings)
    run.save_run(tmp_path / "c", going)
    (tmp_path / "other.toml").write_text(TINY.replace("steps = 2", "steps = 4"))
    with pytest.raises(TrainingError, match=r"inner\.steps: 2 -> 4"):
        run.resume_run(tmp_path / "c", run.load_run_settings(tmp_path / "other.toml"))
    with pytest.raises(TrainingError, match="0 of 1 searches"):
        finished_budgets(going)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('preset = "laptp"', r"preset is 'laptp'; did you mean 'laptop'\?"),
        ("[run]\npitch_um = 500.0", "pixels of a"),
        (
            "[optics]\ndepths_mm = [17.9, 50.0]",
            r"optics.depths_mm = \(17.9, 50.0\) does not hold the eyes, 17.5 to 24.5",
        ),
        (
            "[optics]\ndepths_mm = [12.0, 24.4]",
            "does not hold the eyes, 17.5 to 24.5 mm",
        ),
        ("[scenes]\ndepth_sd_mm = 3.0", "does not hold the eyes, 11.5 to 30.5 mm"),
        (
            "[scenes]\nslip_mm = [2.0, 1.5, 9.5]",
            "does not hold the eyes, 11.5 to 30.5 mm",
        ),
        ("[inner]\nstps = 3", "unknown key 'inner.stps'; did you mean 'steps'"),
        ("[run]\nbudgets_mmacs = []", "budgets_mmacs"),
        ("[run]\nbudgets_mmacs = [4.0, 2.0, 4]", "two are alike"),
        ("[scenes]\npool = 3", "need a pool of a batch or more"),
        ("[run]\nfrozen = ['lens']", "frozen"),
        (
            "[optics]\nwavelength_nm = 0.94",
            r"need 5e8 or less; check the units in .*wavelength_nm=0.94,",
        ),
        (
            "[optics]\nsensor_distance_mm = 2000.0",
            r"need 5e8 or less; check the units in .*sensor_distance_mm=2000.0,",
        ),
        (
            "[optics]\ndepth_count = 1000000",
            r"need 5e8 or less; check the units in .*depth_count=1000000,",
        ),
        ("[optics.spread]\nfocus_um = -1.0", "standard deviations of 0 or more"),
    ],
)
def test_bad_configs_are_refused_by_name(tmp_path, change, message):
    (tmp_path / "run.toml").write_text(change + "\n")
    with pytest.raises(ConfigError, match=message):
        run.load_run_settings(tmp_path / "run.toml")


def test_what_runs_for_a_frame_is_counted_in_whole_pixels(settings):
    """A pitch that does not divide the image and a resolution that does not divide the
    pixels, by torch's counter.
    """
    pitch = 1.07 * settings.run.pitch_um
    going = run.start_run(replace(settings, run=replace(settings.run, pitch_um=pitch)))
    net = going.trainer.model.net.eval()
    chosen = replace(smallest_architecture(settings.space), resolution=0.87)
    pixels = math.ceil(settings.scenes.pixels * settings.optics.sample_um / pitch)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        net(torch.zeros(1, 1, pixels, pixels), chosen)
    # taken by slices: not counted
    assert going.macs(chosen) == counter.get_total_flops() // 2 + windows.STEP_MACS


@pytest.mark.slow
@pytest.mark.parametrize("pitch_um", [18.3, 21.1])
def test_no_network_that_is_found_takes_more_than_its_budget(
    settings, tmp_path, pitch_um
):
    """Pixels that do not divide the image: 47.2 and 40.9 of them; a budget that
    whole resolution is beyond.
    """
    budgets = replace(settings.run, budgets_mmacs=(1.8, 2.3), pitch_um=pitch_um)
    still = replace(
        settings.inner, pitch=replace(settings.inner.pitch, rate=0.0), steps=1
    )
    rows = _end(
        run.start_run(replace(settings, run=budgets, inner=still)), tmp_path / "run"
    )
    for row in rows:
        assert 0 < row["mmacs"] <= row["budget_mmacs"]


def test_frozen_parts_stay_and_a_frozen_architecture_is_uniform(settings, tmp_path):
    going = run.start_run(
        replace(settings, run=replace(settings.run, frozen=("optics", "architecture")))
    )
    rows = _end(going, tmp_path / "c")
    assert not going.trainer.model.coefficients_rad.any()
    assert [len(s.history) for s in going.searches] == [1]
    assert len(set(rows[0]["architecture"]["kernels"])) == 1
    assert rows[0]["mmacs"] <= 2.0


def test_fine_tuning_moves_weights_alone_and_repeats_after_a_resume(settings, tmp_path):
    tuned = replace(settings, run=replace(settings.run, finetune_steps=2))
    going = run.start_run(tuned)
    rows = _end(going, tmp_path / "c")
    plain = [end.row for end in finished_budgets(run.resume_run(tmp_path / "c", tuned))]
    assert plain == rows
    assert "depth_response_mm_per_mm" in rows[0]
    before = {k: v.clone() for k, v in going.trainer.model.net.state_dict().items()}
    end = finished_budgets(going)[0]
    row, made = end.row, end.trainer.model
    assert row == rows[0]
    assert torch.equal(made.coefficients_rad, going.trainer.model.coefficients_rad)
    assert not torch.equal(made.net.stem.weight, before["stem.weight"])
