"""The asphere of the virtual experiment: its objective over the field, and how it gets
into a run.
"""

import json

import pytest
import torch

from benchmarks import experiment, experiment_asphere
from benchmarks.design_guide import optics_of
from benchmarks.design_guide_bound import centres_um
from benchmarks.loop_runs import _begun
from codesign.train import run as runs


def test_one_eighth_of_the_windows_stands_for_all():
    """7 x 7 windows, 3 rings about the middle: 10 kinds, of 1, 4 or 8 windows each."""
    cell = experiment_asphere.cell_for("focus33")
    at = centres_um(optics_of(cell), cell.config, (1.0, 1.0))
    places, share = experiment_asphere.distinct(at)
    assert sorted((share * 49).round().int().tolist()) == [1, 4, 4, 4, 4, 4, 4, 8, 8, 8]
    mean = (
        at.pow(2).sum(1).mean()
    )  # of a function of the distance alone, over all and over the kinds
    assert float(share @ places.pow(2).sum(1)) == pytest.approx(float(mean), rel=1e-9)


def test_a_least_bound_is_found_along_its_gradient():
    """A bowl of unlike axes, whose middle is known."""
    middle, wide = (
        torch.tensor([0.7, -1.9, 0.3]).double(),
        torch.tensor([1.0, 3.0, 0.2]).double(),
    )
    found = experiment_asphere.optimised(
        lambda x: (wide * (x - middle) ** 2).sum(), torch.zeros(3).double()
    )
    assert found.numpy() == pytest.approx(middle.numpy(), abs=1e-4)


def test_the_asphere_is_the_kept_line_of_least_error_and_the_run_begins_behind_it(
    tmp_path,
):
    kept = experiment_asphere.kept()
    lines = [
        line
        for line in json.loads(experiment_asphere.RESULT.read_text("utf-8"))
        if "asphere" in line["lens"]
    ]
    assert kept["axial_mm"] == min(line["axial_mm"] for line in lines)
    recipe = experiment.LENSES["asphere"]
    (tmp_path / "run.toml").write_text(recipe.toml.replace("pool = 12288", "pool = 8"))
    settings = runs.load(tmp_path / "run.toml")
    cell = experiment_asphere.cell_for("focus1000")
    seen = optics_of(cell)
    assert (
        (settings.optics.family, settings.optics.polynomials)
        == ("radial", 6)
        == (seen.family, seen.polynomials)
    )
    assert settings.optics.focus_mm == kept["focus_mm"]
    same = (
        settings.optics.sample_um,
        settings.optics.window_samples,
        settings.optics.fwhm_nm,
    )
    assert same == (seen.sample_um, seen.window_samples, seen.fwhm_nm)
    assert (
        settings.scenes.pixels * settings.optics.sample_um
        == cell.config.pixels * cell.config.pitch_um
    )
    assert (
        settings.sensor.exposure_e / settings.sensor.base_pitch_um**2
        == cell.config.sensor.exposure_e / 81
    )
    assert settings.inner.optics.rate == 0
    run = _begun(settings, recipe)
    assert runs.coefficients(run).tolist() == kept["coefficients_rad"]
