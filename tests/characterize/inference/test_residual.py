"""The phase that physics leaves over: its modes, and that it is kept where it is true
and only there.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

import characterize
from characterize.bench import bench
from characterize.inference import asbuilt
from characterize.inference.estimate import FitOptions
from characterize.model import made, thinplate
from characterize.model.forward import ForwardModel, FrameSetting
from characterize.model.parameters import parameter_vector
from metalens.core.errors import FitError
from metalens.lens.record import DiameterMap

T = np.linspace(-1, 1, 81)
U, V = np.meshgrid(T, T)
INSIDE = np.hypot(U, V) <= 1
SETTING = FrameSetting(np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16)
USUAL = FitOptions(scan_um=60.0)


def test_modes_have_unit_rms_and_hold_nothing_that_parameters_do():
    modes = thinplate.thin_plate_basis(U, V)[:, INSIDE]
    gram = modes @ modes.T / INSIDE.sum()
    assert (
        np.abs(gram - np.eye(len(gram))).max() < 0.02
    )  # another grid than the one they were made on: its rim
    for shape in (
        np.ones_like(U),
        U,
        V,
        U**2 + V**2,
        U**2 - V**2,
        (3 * (U**2 + V**2) - 2) * U,
    ):
        assert np.abs(modes @ shape[INSIDE] / INSIDE.sum()).max() < 0.02
    expected = thinplate.prior_rad()
    assert (
        np.diff(expected) <= 0
    ).all()  # the more a mode bends, the less of it is expected


def test_phase_on_a_grid_is_the_sum_of_its_modes():
    modes = np.random.default_rng(0).normal(0, 0.1, thinplate.MODES)
    want = np.tensordot(modes, thinplate.thin_plate_basis(U, V), 1)
    assert np.abs(thinplate.phase_rad(modes, T, T) - want).max() < 1e-4


def test_the_reduced_model_and_every_pillar_agree_on_it():
    """Pixel by pixel: pillars and windows 1e-3 of the peak, as without the phase;
    derivatives by differences.
    """
    modes = np.random.default_rng(1).normal(0, 0.08, thinplate.MODES)
    x = parameter_vector(b.VALUES | {"background_e": 0.0, "background_x_e": 0.0})
    whole = ForwardModel(b.lens(), SETTING, b.RESPONSE)
    before = whole.groups
    model = whole.with_residual(modes, thinplate.thin_plate_basis)
    assert whole.groups is before  # a lens with a phase is another lens
    assert not any(len(group.residual) for group in before)
    found, slope = model.images(x, ["residual_3"])
    plain = made.as_built_transmission(b.lens(), b.RESPONSE, x)
    turned = made.as_built_transmission(b.lens(), b.RESPONSE, x, modes=modes)
    old = made.as_built_transmission
    made.as_built_transmission = lambda lens, response, values, **more: old(
        lens, response, values, modes=modes, **more
    )
    try:
        want = bench.bench_irradiance(
            b.lens(), b.truth(background_e=0.0, background_x_e=0.0), b.RESPONSE
        )
    finally:
        made.as_built_transmission = old
    assert np.abs(turned - plain).max() > 0.3
    found = found * (found * want).sum() / (found**2).sum()
    assert np.abs(found - want).max() < 1e-3 * want.max()
    step = np.eye(thinplate.MODES)[3] * 1e-3
    up, down = (
        model.with_residual(modes + s, thinplate.thin_plate_basis).images(x)[0]
        for s in (step, -step)
    )
    difference = (up - down) / 2e-3
    assert np.abs(slope[0] - difference).max() < 2e-2 * np.abs(difference).max()


def bumped(height_nm):
    """The design with a ring of wider and a patch of thinner pillars, which no
    parameter describes.
    """
    d = b.lens().diameters
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    bump = np.exp(-((u - 0.45) ** 2 + (v + 0.3) ** 2) / 0.04) - np.exp(
        -((u + 0.4) ** 2 + (v - 0.5) ** 2) / 0.05
    )
    grown = np.where(d.diameter_um > 0, d.diameter_um + 1e-3 * height_nm * bump, 0.0)
    return dataclasses.replace(b.lens(), diameters=DiameterMap(grown, d.pitch_um))


def shots_of(lens, peak_e=8000.0):
    light = bench.bench_irradiance(lens, b.truth(), b.RESPONSE)
    return b.capture(light * (peak_e / light.max()) + bench.background_plane(b.truth()))


def test_a_patch_of_wrong_pillars_is_kept_as_a_phase_that_unseen_frames_confirm(
    tmp_path,
):
    found = characterize.fit(
        shots_of(bumped(12.0)),
        b.lens(),
        dataclasses.replace(USUAL, insist=True),
        response=b.RESPONSE,
    )
    assert len(found.residual_modes) == thinplate.MODES
    assert any("beyond the parameters is kept" in words for words in found.cautions)
    phase = np.tensordot(found.residual_modes, thinplate.thin_plate_basis(U, V), 1)
    true = np.exp(-((U - 0.45) ** 2 + (V + 0.3) ** 2) / 0.04) - np.exp(
        -((U + 0.4) ** 2 + (V - 0.5) ** 2) / 0.05
    )
    assert np.corrcoef(phase[INSIDE], true[INSIDE])[0, 1] > 0.5
    found.save(tmp_path / "a.h5")
    again = asbuilt.load(tmp_path / "a.h5")
    assert np.array_equal(again.residual_modes, found.residual_modes)
    assert np.array_equal(again.pillars(), found.pillars())


@pytest.mark.slow
def test_without_such_a_phase_none_is_kept():
    found = characterize.fit(
        b.capture(b.electrons(8000.0)), b.lens(), USUAL, response=b.RESPONSE
    )
    assert not len(found.residual_modes)


@pytest.mark.slow
def test_a_moved_frame_is_not_explained_by_a_phase():
    """Frames left out do not improve: the fit is refused as without the phase."""
    with pytest.raises(FitError, match="shifted or repeated frame"):
        characterize.fit(
            b.with_a_moved_frame(b.capture(b.electrons())),
            b.lens(),
            USUAL,
            response=b.RESPONSE,
        )
