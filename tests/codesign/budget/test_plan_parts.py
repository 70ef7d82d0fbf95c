"""What the pilot makes of every knob, on a chain of stand-ins: who is misread for whom, seconds, and what is kept."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.budget import plan, task
from codesign.budget.entry import Entry

SCENES, STACKS, FRAMES = 3, 7, 110
DIAMETERS = np.linspace(0.1, 0.21, 111)


class Aperture:
    """Pillars of 0.12 to 0.16 um; thinner and thicker ones are in the table and not on the lens."""

    diameter_um = DIAMETERS
    share = np.where((DIAMETERS > 0.1195) & (DIAMETERS < 0.1605), 0.4, 0.0)

    @staticmethod
    def rounded(table, step_um):
        return ("rounded", table, round(step_um, 9))


def chain_of(levels, **more):
    """Optics are (table, numerics) themselves, a table of a tolerance is its name."""
    config = SimpleNamespace(task=SimpleNamespace(scenes=SCENES), stacks=STACKS, frames=FRAMES)
    made = SimpleNamespace(levels=levels, config=config, aperture=Aperture, around="around", said=[], eyes="eyes")
    made.optics = lambda table, numerics: (table, numerics)
    made.table = lambda tolerance: f"table {tolerance}"
    made.library = lambda tolerance: (
        SimpleNamespace(solves=round(1.2 / tolerance)),
        {0.03: 2.5, 0.02: 1.5, 0.01: 4.5}[tolerance],
    )
    made.electrons = lambda optics: ("image of", optics)
    made.say = made.said.append
    vars(made).update(more)
    return made


@pytest.fixture
def misread(monkeypatch):
    """Pairs (truth, believed) as they are asked for; the k-th errs by k + 1 times a row of its own for every scene."""
    asked = []

    def stand_in(chain, truth, believed):
        asked.append((truth, believed))
        return len(asked) * np.array([[0.3, -0.1], [0.7, 0.2], [-0.4, 0.9]])

    monkeypatch.setattr(plan, "_misread", stand_in)
    return asked


def test_libraries_are_misread_for_the_finest_and_never_cost_less_than_coarser_ones(misread):
    errors, seconds = plan._library_knob(chain_of({"library_tolerance": (0.03, 0.02, 0.01)}), "finest", 9.5)
    assert misread == [("finest", ("table 0.03", "around")), ("finest", ("table 0.02", "around"))]
    assert errors[:, 1, 0].tolist() == pytest.approx([0.7, 1.4, 0])
    assert seconds.tolist() == [2.5, 2.5, 9.5]


def test_rounded_masks_are_taken_for_the_drawn_one_and_cost_their_classes(misread):
    """Pillars of 0.12 to 0.16 um in steps of 20 and 8 nm are 3 and 6 classes, each of 3 ms."""
    errors, seconds = plan._mask_knob(chain_of({"diameter_step_nm": (20, 8)}), "drawn", "exact")
    assert misread == [((("rounded", "exact", step), "around"), "drawn") for step in (0.02, 0.008)]
    assert errors[:, 2, 1].tolist() == pytest.approx([0.9, 1.8])
    assert seconds.tolist() == pytest.approx([9e-3, 18e-3])


def scripted(monkeypatch, *seconds):
    """The faster of two calls, as told; what is timed is run once."""
    told = iter(seconds)
    ran = []
    monkeypatch.setattr(plan, "_fastest", lambda work: ran.append(work()) or next(told))
    return ran


def test_settings_of_the_optics_are_believed_against_their_finest(misread, monkeypatch):
    ran = scripted(monkeypatch, 0.5, 0.4, 2.0)
    errors, seconds = plan._optics_knob(chain_of({"depth_count": (4.0, 6.0, 12.0)}), "table", "depth_count")
    assert [optics[1].depth_count for optics in ran] == [4, 6, 12]
    assert [optics[1].psf_tolerance for optics in ran] == [plan.PILOT.psf_tolerance] * 3
    assert [(truth[1].depth_count, believed[1].depth_count) for truth, believed in misread] == [(12, 4), (12, 6)]
    assert errors[:, 0, 0].tolist() == pytest.approx([0.3, 0.6, 0])
    assert errors.shape == (3, SCENES, 2)
    assert seconds.tolist() == [0.5, 0.5, 2.0]


def test_kernels_are_timed_by_the_image_of_a_scene_at_many_depths(misread, monkeypatch):
    ran = scripted(monkeypatch, 0.6, 2.4)
    chain = chain_of({"kernel_tolerance": (0.1, 0.004)})
    _, seconds = plan._optics_knob(chain, "table", "kernel_tolerance")
    assert [optics[1].basis_tolerance for _, optics in ran] == [0.1, 0.004]
    assert {optics[1].depth_count for _, optics in ran} == {48}
    assert seconds.tolist() == pytest.approx([0.2, 0.8])
    assert len(misread) == 1


def test_a_true_image_costs_its_stacks_and_its_frames(misread, monkeypatch):
    scripted(monkeypatch, 0.5, 0.9, 0.25, 0.6, 4.0, 1.2)
    monkeypatch.setattr(
        plan, "nodes_of", lambda optics: {0.3: (3, 5, 7, 2), 0.2: (9, 11, 13, 4)}.get(optics[1], (8,) * 4)
    )
    errors, seconds, nodes = plan._image_knob(chain_of({"image_tolerance": (0.3, 0.2, 0.1)}), "table")
    assert misread == [(("table", 0.1), ("table", 0.3)), (("table", 0.1), ("table", 0.2))]
    assert errors[:, 1, 1].tolist() == pytest.approx([0.2, 0.4, 0])
    # the second took less than the first: noise of the clock
    assert seconds.tolist() == pytest.approx([7 * 0.5 + 110 * 0.3] * 2 + [7 * 4.0 + 110 * 0.4])
    assert nodes.tolist() == [[3, 5, 7, 2], [9, 11, 13, 4], [8, 8, 8, 8]]


def test_the_finest_library_is_the_coarse_one_put_right_by_twelve_solves(monkeypatch):
    """The solver says 0.9 exp(i (0.2 + 30 D)) times the coarse table: log and phase of the ratio are straight lines.
    Twelve solves in 6 s are 0.5 s each, 40 of them and half as many that check."""
    coarse = (0.8 + DIAMETERS) * np.exp(1j * np.sin(20 * DIAMETERS))
    factor = 0.9 * np.exp(1j * (0.2 + 30 * DIAMETERS))
    solved = []

    def smooth(cell, light, span, *, tolerance, engine):
        assert (light.wavelength_um, span, tolerance, engine) == (0.85, (0.1, 0.21), 0.01, "engine of cell")

        def solve(diameter):
            solved.append(diameter)
            return SimpleNamespace(t=(coarse * factor)[abs(DIAMETERS - diameter).argmin()])

        return solve

    monkeypatch.setattr(plan, "engines", SimpleNamespace(smooth=smooth, choose=lambda cell: f"engine of {cell}"))
    monkeypatch.setattr(plan, "time", SimpleNamespace(perf_counter=itertools.count(3.0, 6.0).__next__))
    lens = SimpleNamespace(proxy=SimpleNamespace(domain_um=(0.1, 0.21)), wavelength_um=0.85, cell="cell")
    tables = {0.03: coarse}
    chain = chain_of({"library_tolerance": (0.03, 0.02, 0.01)}, lens=lens, table=tables.__getitem__)
    table, seconds = plan._exact(chain)
    assert len(solved) == 12
    assert table == pytest.approx(coarse * factor, rel=1e-9)
    assert seconds == pytest.approx(1.5 * 0.5 * 40)
    listed = plan._listed(chain)
    assert np.array(listed[0]) + 1j * np.array(listed[1]) == pytest.approx(table, rel=1e-15)


def test_a_pilot_keeps_what_each_knob_gave_and_one_frame_s_noise(monkeypatch):
    """Of a Gaussian in the plane with rms 5e-3 the mean is that of Rayleigh: the integral of r over its density."""
    levels = {"library_tolerance": (0.03,), "diameter_step_nm": (20,), "image_tolerance": (0.3, 0.2)}
    chain = chain_of(levels)
    monkeypatch.setattr(plan, "_listed", lambda chain: [[0.5, 0.6], [-0.2, 0.1], 8.0])
    exact = [0.5 - 0.2j, 0.6 + 0.1j]
    gave = {name: (np.full((2, 3, 2), k + 1.5), np.array([k + 0.25, 2.0])) for k, name in enumerate(levels)}

    def library(chain, truth, seconds):
        assert (list(truth[0]), truth[1], seconds) == (exact, "around", 8.0)
        return gave["library_tolerance"]

    monkeypatch.setattr(plan, "_library_knob", library)
    monkeypatch.setattr(plan, "_mask_knob", lambda chain, base, table: gave["diameter_step_nm"])
    image = (*gave["image_tolerance"], np.array([[3, 5, 7, 2], [9, 11, 13, 4]]))
    monkeypatch.setattr(plan, "_image_knob", lambda chain, table: image)
    monkeypatch.setattr(task, "linear", lambda eyes, base, setting: SimpleNamespace(noise_rad=5e-3))
    monkeypatch.setattr(plan, "time", SimpleNamespace(perf_counter=itertools.count(3.0, 4.0).__next__))
    person = Entry("person", plan.NONE, plan.NONE, 2e-3, "told")
    found = plan.pilot(chain, floor=(person,))
    for name, (errors, seconds) in gave.items():
        assert np.array_equal(found.errors[name], errors)
        assert np.array_equal(found.seconds[name], seconds)
    assert found.nodes == ((3, 5, 7, 2), (9, 11, 13, 4))
    assert (found.noise_rad, found.spent_seconds, len(chain.said)) == (5e-3, 4.0, 3)
    r = np.linspace(0, 0.06, 20_001)
    s = 5e-3 / math.sqrt(2)
    mean = np.trapezoid(r * r / s**2 * np.exp(-(r**2) / (2 * s**2)), r)
    assert found.floor[0] is person
    assert [entry.gaze_rad for entry in found.floor[1:]] == [pytest.approx(mean, rel=1e-6)]
    assert plan.pilot(chain).floor == ()
    known = (person, Entry("sensor noise", plan.NONE, plan.NONE, 3e-3, "told"))
    assert plan.pilot(chain, floor=known).floor == known
