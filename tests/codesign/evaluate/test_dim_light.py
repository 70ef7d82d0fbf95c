"""One exposure and one background for every lens: what a lens loses costs it signal."""

import math
from dataclasses import replace

import pytest

from codesign.adapt import source as finished
from codesign.evaluate import gaze_experiment as experiment
from codesign.settings import ExperimentConfig
from tests.codesign import made_lens as m

CONFIG = ExperimentConfig(subjects=1, people=2, grid=(4, 3), share=0.3, snr_db=15.0)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dim") / "run"
    m.finished_run(folder)
    return finished.load_finished_run(folder)


def test_dim_light_is_that_of_a_perfect_lens_and_the_same_for_all(source):
    """15 dB in the mean pixel of the pinhole image by hand: signal over the square root
    of signal, background and read noise.
    """
    narrow = replace(source.settings.optics, aperture_mm=0.06)
    other = replace(
        source,
        run=replace(source.run, settings=replace(source.settings, optics=narrow)),
    )
    here, there, half = experiment.experiment_sensors([source, source, other], CONFIG)
    assert here == there
    scenes = source.run.scenes(experiment.EXPERIMENT)
    states, _ = experiment.draw_trials(CONFIG, 0, scenes)
    made = experiment.render_subject(states[slice(12)], CONFIG, 0, scenes)
    level = float(made.pinhole().mean())
    share = (source.settings.run.pitch_um / here.base_pitch_um) ** 2
    signal, background = (share * e for e in (here.exposure_e * level, here.ambient_e))
    noise = math.sqrt(signal + background + here.read_noise_e**2)
    assert 20 * math.log10(signal / noise) == pytest.approx(15.0, abs=1e-3)
    assert half.exposure_e == pytest.approx(here.exposure_e / 4)  # half the diameter
    assert half.ambient_e == pytest.approx(here.ambient_e / 4)
