"""Single links of the error budget with everything but their own arithmetic typed in."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.budget import floor, links, person, reading
from codesign.budget.entry import NONE, Entry
from codesign.evaluate import AXIAL, ExperimentConfig
from metalens.ground.errors import CellError

RNG = np.random.default_rng(12)


def test_a_library_between_its_diameters_is_straight_in_level_and_in_unwound_phase():
    """Both polarisations averaged at the wavelength that is nearest; the phase passes half a turn."""
    d = np.array([0.10, 0.14, 0.20])
    level, phase = np.array([0.9, 0.7, 0.8]), np.array([2.0, 3.6, 5.9])
    mean = level * np.exp(1j * phase)
    off = 0.05 * np.exp(1j * np.array([0.3, -1.0, 2.0]))
    t = np.zeros((2, 1, 3, 3), complex)
    t[:, 0, 1] = mean + off, mean - off
    t[:, 0, (0, 2)] = 1j
    library = SimpleNamespace(t=t, wavelength_um=np.array([0.8, 0.84, 0.9]), diameter_um=d)
    got = links._stored(library, np.array([0.11, 0.18]), 0.861)
    want = [0.85 * np.exp(2.4j), (0.7 + 0.1 * 2 / 3) * np.exp(1j * (3.6 + 2.3 * 2 / 3))]
    assert got == pytest.approx(np.array(want), rel=1e-12)


def test_a_ratio_is_carried_to_other_diameters_by_its_logarithm():
    at = np.array([0.1, 0.2])
    ratio = np.array([1.1 * np.exp(3.0j), 0.8 * np.exp(3.4j)])  # passes half a turn in between
    aperture = SimpleNamespace(diameter_um=np.array([0.1, 0.13, 0.2]), designed=lambda: np.array([0.9j, 0.5, -0.7]))
    got = links._carried(SimpleNamespace(aperture=aperture), at, ratio)
    between = math.exp(0.7 * math.log(1.1) + 0.3 * math.log(0.8)) * np.exp(1j * 3.12)
    assert got == pytest.approx(np.array([0.9j, 0.5, -0.7]) * np.array([ratio[0], between, ratio[1]]), rel=1e-12)


def test_noise_of_both_angles_is_told_as_a_mean_angle(monkeypatch):
    """Of a Gaussian of sigma in each angle the rms is sigma sqrt(2), the mean sigma sqrt(pi / 2)."""
    sigma = 2.3e-3
    monkeypatch.setattr(links, "person", lambda frames, rig: iter(()))
    about = SimpleNamespace(
        given=SimpleNamespace(frames=None, fwhm_nm=0.0),
        setting=SimpleNamespace(rig=None),
        reader=SimpleNamespace(noise_rad=sigma * math.sqrt(2)),
        device=SimpleNamespace(one_psf=lambda: 1, evenly_lit=lambda: 2),
        entry=lambda link, optics, method: Entry(link, NONE, 0.1, 0.2, method),
    )
    found = {entry.link: entry for entry in links._answer(about)}
    drawn = np.hypot(*(sigma * RNG.standard_normal((2, 10**6)))).mean()
    assert found["sensor noise"].gaze_rad == pytest.approx(drawn, rel=3e-3)
    assert not found["field"].counted
    assert found["sensor noise"].counted


def test_made_lenses_count_by_their_root_mean_square(monkeypatch):
    rows = iter([(0.1, 0.3, 0.02), (0.5, 0.4, 0.06), (0.7, 1.2, 0.09)])
    state = SimpleNamespace(answers=lambda: {}, bias_um=lambda u, v: 0.0, bends=lambda: False)
    shape = (4, 5)
    flat = torch.zeros(shape)
    aperture = SimpleNamespace(
        place=np.zeros(shape, int),
        designed=lambda: None,
        diameter_um=None,
        maps=lambda table, bias_um=0.0: (flat, flat),
    )
    d = SimpleNamespace(x_um=np.arange(5.0), y_um=np.arange(4.0), radius_um=5.0)
    monkeypatch.setattr(links, "sensitivity", lambda lens: None)
    monkeypatch.setattr(links, "transmission", lambda *_: None)
    monkeypatch.setattr(links, "gathered", lambda *_: None)
    about = SimpleNamespace(
        lens=SimpleNamespace(diameters=d, proxy=None, wavelength_um=0.85),
        aperture=aperture,
        device=SimpleNamespace(image=lambda **_: None),
        entry=lambda link, optics, method, phase_rad: Entry(link, *next(rows), method),
    )
    got = links._drawn(about, "process spread", [links.Made(state)] * 3, "drawn")
    want = [math.sqrt(np.mean(np.square(v))) for v in ((0.1, 0.5, 0.7), (0.3, 0.4, 1.2), (0.02, 0.06, 0.09))]
    assert (got.phase_rad, got.psf, got.gaze_rad) == pytest.approx(want)


def made_reading(monkeypatch, judged, axial):
    """A reading whose answers are off by what is asked, in degrees."""
    monkeypatch.setattr(reading, "angle_deg", lambda one, other: np.asarray(one, float))
    self = reading.Reading.__new__(reading.Reading)
    self.trial = SimpleNamespace(stimulus_deg=None, group=lambda kind: axial if kind == AXIAL else ~axial)
    self._error_rad = 0.0
    monkeypatch.setattr(self, "_judged", lambda: judged)
    monkeypatch.setattr(self, "_taught", lambda read, how: how)
    monkeypatch.setattr(reading.gaze_experiment, "answered", lambda people, read, trial: read)
    return self


def test_one_more_cause_adds_what_the_error_has_more_in_quadrature(monkeypatch):
    """Mean errors of 3, then 5, then 4.6 degrees of the judged frames that slip along the axis: 3, 4 and nothing."""
    judged, axial = np.array([True, True, True, False]), np.array([True, True, False, True])
    self = made_reading(monkeypatch, judged, axial)
    errors = [self._error(np.array([low, high, 80.0, 70.0]), None) for low, high in ((2, 4), (3, 7), (4.6, 4.6))]
    found = [self._grown("link", error, "") for error in errors]
    assert [math.degrees(entry.gaze_rad) for entry in found] == pytest.approx([3, 4, 0])
    again = self._grown(
        "link", self._error(np.array([5.8, 5.8, 0.0, 0.0]), None), ""
    )  # over the state before, not over the largest
    assert math.degrees(again.gaze_rad) == pytest.approx(math.sqrt(5.8**2 - 4.6**2))


@pytest.mark.parametrize(("alone", "shares"), [(20.0, (12.0, 0.0)), (4.0, (math.sqrt(7.0), math.sqrt(137.0)))])
def test_a_pupil_alone_costs_at_most_what_all_that_is_read_does(monkeypatch, alone, shares):
    """3 degrees before, sqrt(153) by all that is read: a pupil that leads beyond by the sphere costs 12, not more."""
    self = made_reading(monkeypatch, np.array([True]), np.array([True]))
    self.source = SimpleNamespace(row={"mmacs": 2.0})
    self.believed, self._error_rad = "optics", math.radians(3.0)
    monkeypatch.setattr(self, "_read", lambda optics, quiet: (SimpleNamespace(pupil_mm="pupil"), "people"))
    by = {"people": math.radians(math.sqrt(153.0)), "sphere": math.radians(alone)}
    monkeypatch.setattr(self, "_error", lambda read, how: by[how])
    found = list(self._reader(SimpleNamespace(slip_mm="slip"), "sphere"))
    assert [entry.link for entry in found] == ["reader, pupil", "reader, slippage"]
    assert [math.degrees(entry.gaze_rad) for entry in found] == pytest.approx(shares, abs=1e-6)


def test_fixation_is_what_is_left_of_the_whole_error(monkeypatch):
    """Subject and calibration 0.5 degrees, with fixation 1.3: 1.2; only frames judged under axial slippage count."""
    config = ExperimentConfig(subjects=2, fixation_deg=0.9, hidden=7, seed=3)
    axial = np.array([True, True, False])
    trial = SimpleNamespace(group=lambda kind: axial, stimulus_deg=None)
    monkeypatch.setattr(person.gaze_experiment, "states_of", lambda *_: (None, None))
    monkeypatch.setattr(person.gaze_experiment, "joined", lambda _: trial)
    monkeypatch.setattr(person, "told", lambda one, scenes: one.fixation_deg)
    monkeypatch.setattr(person, "angle_deg", lambda one, other: one)

    def calibrated(fixation, trial, one, how):
        assert (fixation, how.hidden, how.seed) == (one.fixation_deg, 7, 3)
        return np.array([1.3 if fixation else 0.5, 40.0, 50.0])[:, None], np.array([True, False, True])

    monkeypatch.setattr(person.gaze_experiment, "calibrated", calibrated)
    rig = SimpleNamespace(sensor_distance_um=2000.0)
    people, fixation = person.person(config, rig)
    assert math.degrees(people.gaze_rad) == pytest.approx(0.5)
    assert math.degrees(fixation.gaze_rad) == pytest.approx(1.2)


def test_what_is_left_of_a_goal_above_its_floor_is_the_rest_of_the_squares():
    parts = (Entry("a", NONE, NONE, 0.03, ""), Entry("b", NONE, NONE, 0.04, ""), Entry("c", NONE, NONE, 9.0, "", False))
    assert floor.allowance_rad(0.13, parts) == pytest.approx(0.12)


def test_the_virtual_experiment_is_told_in_radians_and_outside_the_sum():
    about = SimpleNamespace(reading=None, given=SimpleNamespace(frames=SimpleNamespace(frames=7)))
    assert not list(links._measured(about))
    about.reading = SimpleNamespace(measured_deg={AXIAL: 1.3, "lateral": 2.9})
    (found,) = links._measured(about)
    assert found.gaze_rad == pytest.approx(1.3 * math.pi / 180, rel=1e-12)
    assert (found.link, found.counted) == (links.MEASURED, False)
    assert "7 frames" in found.method
    assert math.isnan(found.psf)


@dataclass(frozen=True)
class Layers:
    front: tuple[str, ...]
    behind: tuple[str, ...]

    @property
    def films(self) -> tuple[str, ...]:
        return self.front + self.behind


def optics_links(layers, reading):
    about = SimpleNamespace(
        lens=SimpleNamespace(layers=layers),
        reading=reading,
        device=SimpleNamespace(image=lambda **given: given, whole="whole", both_polarisations=lambda: "both"),
        entry=lambda link, optics, method: Entry(link, NONE, 0.1, 0.2, repr(optics)),
    )
    return {one.link: one for one in links._optics(about)}


def test_films_are_taken_away_on_both_faces_and_a_lens_without_them_errs_by_none():
    found = optics_links(Layers(("silica",), ("nitride", "silica")), None)
    assert found["glass"].method == "{'layers': Layers(front=(), behind=())}"
    assert found["polarisation"].method == "'both'"
    assert "pillars on a lattice" not in found  # no run: nothing smooth to compare with
    bare = optics_links(Layers((), ()), None)["glass"]
    assert (bare.psf, bare.gaze_rad) == (0.0, 0.0)


def test_pillars_stand_in_place_of_the_smooth_phase_of_the_run():
    """Its wave and its layers, both of the run's own device."""
    true = SimpleNamespace(wave="smooth wave", layers="no films")

    def changed(link, one, other, said):
        return Entry(link, NONE, 0.3, 0.4, f"{one} against {other}")

    found = optics_links(Layers((), ()), SimpleNamespace(true=true, changed=changed))
    said = "whole against {'wave': 'smooth wave', 'layers': 'no films'}"
    assert found["pillars on a lattice"].method == said


def test_rows_of_neighbours_are_told_by_their_length_in_pillars(monkeypatch):
    """Rows of 20 and 10 pillars of 0.42 um turn light of 0.85 um by 1 / 20 and 1 / 10 of a wave a pillar."""
    rows = SimpleNamespace(sine=0.85 / 0.42 / np.array([20.0, 10.0, 14.2]), diagonal=np.array([False, False, True]))
    monkeypatch.setattr(links, "_among", lambda about, rows, said: Entry("neighbours", 0.1, 0.2, 0.3, said))
    monkeypatch.setattr(links.supercell, "neighbours", lambda lens: rows)
    cell = SimpleNamespace(pitch_um=0.42)
    about = SimpleNamespace(lens=SimpleNamespace(neighbours=None, wavelength_um=0.85, cell=cell))
    (found,) = links._neighbours(about)
    assert found.method.startswith("rows of 20, 10 unlike pillars")

    def refused(lens):
        raise CellError("tilted walls")

    monkeypatch.setattr(links.supercell, "neighbours", refused)
    assert not list(links._neighbours(about))


def test_what_is_open_of_neighbours_that_the_lens_holds_adds_in_quadrature(monkeypatch):
    doubts = iter([Entry("neighbours", 0.3, 0.5, 0.02, ""), Entry("neighbours", 0.4, 1.2, 0.015, "")])
    monkeypatch.setattr(links, "_among", lambda about, rows, said: next(doubts))
    held = SimpleNamespace(doubted=lambda sine: (sine, sine))
    about = SimpleNamespace(lens=SimpleNamespace(neighbours=held), aperture=SimpleNamespace(turn_sine=lambda: 0.1))
    (found,) = links._neighbours(about)
    assert (found.phase_rad, found.psf, found.gaze_rad) == pytest.approx((0.5, 1.3, 0.025), rel=1e-12)
