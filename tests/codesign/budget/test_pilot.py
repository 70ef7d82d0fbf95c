"""The planner's pilot on small real runs: whom an estimator misreads at every setting,
and what the settings cost.

The clock is typed in; everything that it times is run.
"""

import copy
import itertools
import math
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.budget import chain as chains
from codesign.budget import plan, task
from codesign.budget.entry import NONE, Entry
from codesign.budget.plan import PILOT, Chain, Choice, PlanConfig, TrueChoice
from codesign.optics import device, gathered, image_difference, kernels, psf_difference
from metalens.cell import Index
from metalens.design import Focus
from metalens.image import Grid
from metalens.psf import Source
from tests.codesign.budget import small_bench as small

STACKS, FRAMES = 7, 110
SAID: list[str] = []
CONFIG = PlanConfig(
    aperture_mm=0.048, wavelength_nm=845.0, sensor_distance_mm=0.3, source_distance_mm=3.1, led_fwhm_nm=24.0,
    image="uniform", stacks=STACKS, frames=FRAMES, cell=replace(small.CELL, pillar=Index(3.6), height_um=0.7),
    task=replace(small.SETTING, pixels=8, margin=2),
)  # fmt: skip
COARSE, FINE = 3e-2, 1e-2
PILLARS = {"library_tolerance": (COARSE, FINE), "diameter_step_nm": (20, 8)}


def ticking(monkeypatch, times):
    """A clock that says these times, one after the other."""
    clock = SimpleNamespace(perf_counter=iter(times).__next__)
    monkeypatch.setattr(plan, "time", clock)
    monkeypatch.setattr(chains, "time", clock)


@pytest.fixture(scope="module")
def uniform():
    """One PSF a depth, in few pixels; its library took 2.5 s of a clock."""
    made = Chain(CONFIG, SAID.append)
    with pytest.MonkeyPatch.context() as patch:
        ticking(patch, [3.0, 5.5])
        made.library(FINE)
    made.window = replace(made.window, width_um=41.0)
    made.levels = PILLARS | {"depth_count": (2, 4), "kernel_tolerance": (0.4, 1e-5)}
    return made


@pytest.fixture(scope="module")
def true():
    """Over field, depth and the line of a diode."""
    made = Chain(replace(CONFIG, image="true"))
    made.levels = PILLARS | {"image_tolerance": (0.5, 0.06)}
    return made


@pytest.fixture(scope="module")
def exact(uniform):
    return plan.exact_table(uniform)[0]


def misread(chain, truth, believed):
    """(scenes, 2) gaze that the estimator of ``believed`` reads off images through
    ``truth``, started at the truth.
    """
    images = task.electrons(chain.eyes.anchor, truth, chain.config.task)
    found = task.settle(
        images, believed, chain.states, chain.config.task, seen=chain.eyes, steps=2
    )
    return found[:, :2].numpy()


def test_the_run_is_that_of_its_file():
    assert CONFIG.focus == Focus(0.845, 300.0, 3100.0)
    assert chains.levels_of(CONFIG) == plan.LEVELS
    one = chains.levels_of(replace(CONFIG, led_fwhm_nm=0.0))
    assert one.pop("wavelength_count") == (1.0,)
    assert one.items() <= plan.LEVELS.items()
    assert chains.levels_of(replace(CONFIG, image="true")) == plan.TRUE_LEVELS


def test_a_chain_holds_its_lens_its_eyes_and_its_finest_choice(uniform, true):
    lens = uniform.lens
    assert (lens.wavelength_um, lens.sensor_distance_um, lens.source_distance_um) == (
        0.845,
        300.0,
        3100.0,
    )
    assert lens.diameters.radius_um == pytest.approx(24.0, abs=lens.diameters.pitch_um)
    assert uniform.config.task.sensor_distance_um == 300.0
    assert (uniform.window.near_um, uniform.window.far_um) == uniform.eyes.depths_um
    assert (uniform.around, true.around) == (PILOT, 0.1)
    assert true.finest == TrueChoice(FINE, 0.06, 8)
    names = [
        "library_tolerance",
        "depth_count",
        "wavelength_count",
        "psf_tolerance",
        "kernel_tolerance",
    ]
    assert chains.choice_of(
        [*names, "diameter_step_nm"], [0.1, 6.0, 2.0, 0.02, 0.03, 5]
    ) == Choice(0.1, 6, 2, 0.02, 0.03, 5)


def test_libraries_are_computed_once_at_the_seconds_they_took(uniform):
    made = uniform
    library, seconds = made.library(FINE)
    assert seconds == 2.5
    assert made.library(FINE)[0] is library
    assert library.sweep.tolerance == FINE
    assert library.wavelength_um.tolist() == [0.845]
    assert SAID[-1] == f"library at 0.01: {library.solves} solves"
    d, t = library.diameter_um, library.t[:, 0, 0].mean(0)
    near = np.abs(made.aperture.diameter_um[:, None] - d).argmin(
        0
    )  # a place of the table beside each diameter
    inside = (d > made.aperture.diameter_um[0]) & (d < made.aperture.diameter_um[-1])
    got = made.table(FINE)[near]
    assert (
        np.abs(got - t)[inside].max() < 0.01
    )  # within 1e-5 um of it, at some 100 rad a um beside a resonance


def test_optics_are_of_these_pillars_at_this_setting(uniform, true, exact):
    """Kernels over the diode's line; a true image on its grid of eyes, the same plan
    for all pillars.
    """
    numerics = replace(PILOT, depth_count=3, wavelength_count=3)
    maps = uniform.aperture.maps(exact)
    got = uniform.optics(exact, numerics)
    want = kernels(uniform.lens, maps, numerics, uniform.window, fwhm_nm=24.0)
    assert psf_difference(got, want, uniform.window) == 0
    assert (
        psf_difference(
            got, kernels(uniform.lens, maps, numerics, uniform.window), uniform.window
        )
        > 1e-5
    )
    lens, grid = true.lens, Grid((8, 8), 4.1, true.eyes.depths_um, 2, 5)
    waves = [
        gathered(lens, *true.aperture.maps(table), window_um=5 * 4.1)
        for table in (true.aperture.designed(), exact)
    ]
    plain = device(
        waves[0], grid, layers=lens.layers, distance_um=300.0, tolerance=0.5, spectrum=Source(845.0, 24.0)
    )  # fmt: skip
    assert image_difference(true.optics(exact, 0.5), plain.image(wave=waves[1])) < 1e-6
    assert image_difference(true.device(0.5).whole, plain.whole) < 1e-6
    assert true.device(0.5) is true.device(0.5)


def test_the_finest_library_is_the_coarse_one_put_right_by_twelve_solves(
    uniform, exact, monkeypatch
):
    """A coarse library that is wrong by 0.9 exp(i (0.2 + 9 D)) is put right as the true
    one is. A clock that goes on
    by 6 s at every look has twelve solves in 6 s, half a second each, and half as many
    again that check."""
    coarse, seconds = uniform.library(COARSE)
    wrong = copy.copy(uniform)
    factor = 0.9 * np.exp(1j * (0.2 + 9 * coarse.diameter_um))
    wrong._libraries = {COARSE: (replace(coarse, t=coarse.t * factor), seconds)}
    ticking(monkeypatch, itertools.count(3.0, 6.0))
    table, seconds = plan.exact_table(wrong)
    assert seconds == pytest.approx(1.5 * 0.5 * coarse.solves)
    share = uniform.aperture.share
    off = [
        np.sqrt((np.abs(t - exact) ** 2 * share).sum())
        for t in (table, uniform.table(FINE), wrong.table(COARSE))
    ]
    assert off[0] < 1e-3  # the coarse table is looked up within 1e-5 um
    assert off[1] < FINE
    assert off[2] > 0.5


def test_libraries_are_misread_for_the_finest_and_never_cost_less_than_coarser_ones(
    uniform, exact
):
    base = uniform.optics(exact, uniform.around)
    errors, seconds = plan.library_knob(uniform, base, 1e-9)
    coarse = uniform.optics(uniform.table(COARSE), uniform.around)
    assert errors[0] == pytest.approx(
        misread(uniform, base, coarse), rel=1e-6, abs=1e-12
    )
    assert np.abs(errors[0]).max() > 0
    assert not errors[1].any()
    assert seconds.tolist() == [uniform.library(COARSE)[1]] * 2


def test_rounded_masks_are_taken_for_the_drawn_one_and_cost_their_classes(
    uniform, exact
):
    """3 ms for every step between the thinnest pillar that stands and the widest, and
    one.
    """
    base = uniform.optics(exact, uniform.around)
    errors, seconds = plan.mask_knob(uniform, base, exact)
    for found, step in zip(errors, (20e-3, 8e-3), strict=True):
        drawn = uniform.optics(uniform.aperture.rounded(exact, step), uniform.around)
        assert found == pytest.approx(
            misread(uniform, drawn, base), rel=1e-6, abs=1e-12
        )
    d = uniform.lens.diameters.diameter_um
    span_nm = 1e3 * np.ptp(d[d > 0])
    assert seconds == pytest.approx(
        3e-3 * (span_nm / np.array([20.0, 8.0]) + 1), rel=1e-3
    )


@pytest.mark.parametrize(
    ("knob", "field"),
    [("depth_count", "depth_count"), ("kernel_tolerance", "basis_tolerance")],
)
def test_settings_of_the_optics_are_believed_against_their_finest(
    uniform, exact, monkeypatch, knob, field
):
    """The faster of two calls, which takes 0.5 s and then 0.4 s: a finer setting is not
    taken as cheaper. Kernels are
    timed by an image of two scenes, at 48 depths."""
    ticking(monkeypatch, [0, 9.0, 10, 10.5, 20, 20.4, 30, 31.7])
    errors, seconds = plan.optics_knob(uniform, exact, knob)
    kernel = knob == "kernel_tolerance"
    assert seconds == pytest.approx([0.5 / (1 + kernel)] * 2)
    around = replace(PILOT, depth_count=48) if kernel else PILOT
    coarse, fine = (
        uniform.optics(exact, replace(around, **{field: v}))
        for v in uniform.levels[knob]
    )
    assert errors[0] == pytest.approx(
        misread(uniform, fine, coarse), rel=1e-6, abs=1e-12
    )
    assert np.abs(errors[0]).max() > 1e-7
    assert not errors[1].any()


def test_a_true_image_costs_its_stacks_and_its_frames(true, exact, monkeypatch):
    """PSFs in 0.5 s and an image of two scenes in 0.9 s at best, then in 4.0 and 1.2;
    then in less, which is noise.

    So small a field has the same few nodes at every tolerance; the coarser ones fold
    light from beyond their windows
    back, which is all that is misread.
    """
    one = copy.copy(true)
    one.levels = {"image_tolerance": (0.5, 0.2, 0.06)}
    clock = [
        0,
        0.5,
        1,
        7,
        10,
        13,
        20,
        20.9,
        30,
        34,
        40,
        45,
        50,
        53,
        60,
        61.2,
        70,
        71,
        72,
        73,
        80,
        80.1,
        81,
        81.1,
    ]
    ticking(monkeypatch, clock)
    errors, seconds, nodes = plan.image_knob(one, exact)
    finest = 7 * 4.0 + 110 * 0.6
    assert seconds == pytest.approx([7 * 0.5 + 110 * 0.45, finest, finest])
    coarse, middle, fine = (
        true.optics(exact, tolerance) for tolerance in (0.5, 0.2, 0.06)
    )
    assert coarse.plan.window.period < fine.plan.window.period
    for found, optics in zip(errors[:2], (coarse, middle), strict=True):
        assert found == pytest.approx(misread(true, fine, optics), rel=1e-6, abs=1e-9)
    assert errors[2] == pytest.approx(np.zeros((2, 2)), abs=1e-9)
    for found, optics in zip(nodes[[0, 2]].tolist(), (coarse, fine), strict=True):
        assert found[:3] == [*optics.stack.shape[:2], len(optics.plan.depths_um)]
        assert found[3] == len(optics.plan.waves.weights)
    with pytest.raises(TypeError, match="true image"):
        plan.nodes_of(kernels(true.lens, true.aperture.maps(exact), PILOT, true.window))


def test_a_pilot_keeps_what_each_knob_gave_and_one_frame_s_noise(true, exact):
    """Of a Gaussian in the plane of the estimator's rms the mean is that of Rayleigh:
    the integral of r over its
    density."""
    person = Entry("person", NONE, NONE, 2e-3, "told")
    one = copy.copy(true)
    one.levels = {
        "library_tolerance": (COARSE, FINE),
        "diameter_step_nm": (20,),
        "image_tolerance": (0.5,),
    }
    begun = time.perf_counter()
    found = plan.pilot(one, floor=(person,))
    most = time.perf_counter() - begun
    base = true.optics(exact, true.around)
    reader = task.linear(true.eyes, base, true.config.task)
    assert found.noise_rad == pytest.approx(reader.noise_rad, rel=1e-6)
    r = np.linspace(0, 12 * reader.noise_rad, 20_001)
    s = reader.noise_rad / math.sqrt(2)
    mean = np.trapezoid(r * r / s**2 * np.exp(-(r**2) / (2 * s**2)), r)
    assert found.floor[0] is person
    assert [entry.gaze_rad for entry in found.floor[1:]] == [
        pytest.approx(mean, rel=1e-6)
    ]
    drawn, _ = plan.mask_knob(one, base, exact)
    assert found.errors["diameter_step_nm"] == pytest.approx(drawn, rel=1e-5, abs=1e-12)
    coarse = true.optics(true.table(COARSE), true.around)
    assert found.errors["library_tolerance"][0] == pytest.approx(
        misread(true, base, coarse), rel=1e-5, abs=1e-12
    )
    assert found.nodes == (plan.nodes_of(true.optics(exact, 0.5)),)
    assert 0 < found.spent_seconds <= most  # a part of what went by around it
    floor = math.hypot(2e-3, mean)
    best = plan.choose(found, 2 * floor, one.config)
    assert best.met
    assert best.choice.image_tolerance == 0.5
    assert floor <= best.predicted_rad < 2 * floor
