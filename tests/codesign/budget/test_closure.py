"""The budget of a trained reader closes: its links add up to what the virtual
experiment measures.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.adapt import train as retraining
from codesign.budget import links, quadrature_total
from codesign.budget.entry import MEASURED
from codesign.budget.prepared import BudgetInputs, prepare_device
from codesign.budget.reading import NetworkReading
from codesign.budget.task import TaskSetting
from codesign.evaluate import AXIAL, ExperimentConfig, run_experiment
from codesign.optics import OpticsNumerics, formed, image_difference
from metalens.core.errors import LensError
from tests.codesign import made_lens as m

FRAMES = ExperimentConfig(
    subjects=2,
    grid=(4, 3),
    share=0.3,
    axial_mm=(-2.5, 3.0),
    lateral_mm=(1.5,),
    hidden=0,
    people=9,
)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("closure") / "run"
    m.finished_run(
        folder, m.TINY.replace("batch = 8", "batch = 48")
    )  # a subject's frames are read at once
    return retraining.load_finished_run(folder)


@pytest.fixture(scope="module")
def before(source):
    """The run's own lens as a bench, read by its network."""
    setting = TaskSetting(scenes=1, pixels=8, margin=2, pitch_um=3.0)
    return prepare_device(
        m.small(),
        BudgetInputs(OpticsNumerics(2, 1, 1e-2, 1e-1), run=source, frames=FRAMES),
        setting,
    )


@pytest.fixture(scope="module")
def reading(before):
    return before.reading


def test_the_links_add_up_to_what_the_experiment_measures(source, before, reading):
    """A reader trained on one PSF before the whole field; the experiment is computed
    beside it, by its own loop.
    """
    rows = list(reading.path())
    names = [row.link for row in rows]
    assert names == [
        "subject and calibration", "fixation", "reader, pupil", "reader, slippage", "sensor noise", "field",
        "radiometry", "spectrum",
    ]  # fmt: skip
    *_, (_, (found,)) = run_experiment([source], FRAMES)
    assert reading.measured_deg[AXIAL] == pytest.approx(found.gaze(AXIAL), rel=1e-6)
    together = math.degrees(quadrature_total(rows).gaze_rad)
    assert 1 / 1.5 < together / found.gaze(AXIAL) < 1.5
    change = reading.changed("nothing", reading.true.whole, reading.true.whole, "")
    assert change.gaze_rad < 1e-7
    assert change.psf == 0
    (seen,) = links.measured_entry(before)
    assert (seen.link, seen.counted, seen.gaze_rad) == (
        MEASURED,
        False,
        pytest.approx(math.radians(found.gaze(AXIAL))),
    )
    assert f"{FRAMES.frames} frames" in seen.method
    rows = {row.link: row for row in links.pillar_device_entry(before)}
    smooth = before.device.image(wave=reading.true.wave, layers=reading.true.layers)
    assert rows["pillars on a lattice"].psf == pytest.approx(
        image_difference(before.device.whole, smooth), rel=1e-6
    )
    assert (
        rows["pillars on a lattice"].gaze_rad
        == reading.turned(before.device.whole, smooth)
        > 0
    )


def test_a_cause_that_the_reader_knows_is_shown_and_not_counted(source):
    optics = source.run.trainer.optics
    source.run.trainer.optics = replace(optics, image="true")
    try:
        rows = {
            row.link: row for row in NetworkReading(source, FRAMES, fwhm_nm=0.0).path()
        }
    finally:
        source.run.trainer.optics = optics
    assert not rows["field"].counted
    assert rows["field"].psf > 0.05
    assert rows["sensor noise"].counted


def test_the_reader_of_another_lens_is_refused(source):
    run = replace(
        source.run.settings,
        optics=replace(source.run.settings.optics, sensor_distance_mm=0.4),
    )
    kept, source.run.settings = source.run.settings, run
    try:
        with pytest.raises(LensError, match=r"0\.4 mm.*lens file"):
            prepare_device(m.small(), BudgetInputs(run=source, frames=FRAMES))
    finally:
        source.run.settings = kept


def test_pillars_image_as_their_smooth_phase_and_polarisation_is_small_at_a_small_aperture(
    source, before
):
    """NA 0.2: both polarisations change the flux by some 1e-4; the lattice adds the
    noise of its cells.
    """
    made, settings = before.device, source.run.settings.optics
    smooth = made.image(wave=formed.wave_of(settings, torch.zeros(0)))
    assert image_difference(made.whole, smooth) < 0.1
    assert 1e-7 < image_difference(made.both_polarisations(), made.whole) < 1e-3
    assert image_difference(made.image(shift_um=20.0), made.whole) > 0.02
    assert float(np.ptp(made.evenly_lit().energy.numpy())) == 0
