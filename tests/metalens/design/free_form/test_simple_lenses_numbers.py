"""Baselines by what they are told to be worth: which foci and zones are tried, which is
taken, their names.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.design.free_form import simple_lenses as baselines
from metalens.design.free_form.settings import Fisher
from metalens.design.profiles import Focus
from metalens.image.pupil import Pupil
from metalens.image.pupil import coordinates as nodes_um

PUPIL = Pupil(210.0, 1700.0, 0.81, 64)


def worth(monkeypatch, best_per_m, tops=None):
    """Every lens tried, by zones and 1 / focus; best at ``best_per_m``, with ``tops``
    by zones.
    """
    tried = []

    def judged(pupil, settings, *, zones, focus_um):
        assert (pupil, settings) == (PUPIL, "asked")
        tried.append((zones, 1e6 / focus_um))
        value = (tops or {}).get(zones, 1.0) - (1e6 / focus_um - best_per_m) ** 2 * 1e-4
        return baselines.Baseline(zones, focus_um, value, 0.5)

    monkeypatch.setattr(baselines, "judged", judged)
    return tried


def test_a_scan_is_even_in_inverse_depth_and_halves_its_step_twice_about_the_best(
    monkeypatch,
):
    """10 to 25 mm: 100 to 40 per m in four steps of 15. About 70 at 7.5, then about
    77.5 at 3.75.
    """
    tried = worth(monkeypatch, 76.5)
    found = baselines.tuned(PUPIL, "asked", foci_mm=(10.0, 25.0), count=5)
    want = [100, 85, 70, 55, 40, 62.5, 77.5, 73.75, 81.25]
    assert sorted(u for _, u in tried) == pytest.approx(sorted(want), rel=1e-12)
    assert {zones for zones, _ in tried} == {0}
    assert found.focus_um == pytest.approx(1e6 / 77.5, rel=1e-12)


def test_twelve_foci_are_tried_where_no_number_is_given(monkeypatch):
    tried = worth(monkeypatch, 71.0)
    baselines.tuned(PUPIL, "asked", foci_mm=(10.0, 25.0))
    assert len(tried) == 12 + 4
    assert tried[0][1] == pytest.approx(100.0, rel=1e-12)
    assert tried[1][1] == pytest.approx(100.0 - 60 / 11, rel=1e-12)
    assert tried[11][1] == pytest.approx(40.0, rel=1e-12)


@pytest.mark.parametrize(
    ("best", "ends"), [(107.0, (10.0, 100.0)), (33.0, (25.0, 40.0))]
)
def test_nothing_is_tried_beyond_the_ends(monkeypatch, best, ends):
    """About an end the finer steps go inwards alone; the end itself may be tried."""
    tried = worth(monkeypatch, best)
    found = baselines.tuned(PUPIL, "asked", foci_mm=(10.0, 25.0), count=3)
    inner = 1 if ends[1] == 40.0 else -1
    want = [100, 70, 40, ends[1] + inner * 15, ends[1] + inner * 7.5]
    assert sorted(u for _, u in tried) == pytest.approx(sorted(want), rel=1e-12)
    assert found.focus_um == pytest.approx(1e3 * ends[0], rel=1e-12)


def test_the_best_of_all_zones_is_taken(monkeypatch):
    tried = worth(monkeypatch, 73.0, {1: 0.7, 3: 1.9, 4: 1.2})
    found = baselines.tuned(
        PUPIL, "asked", zones=(1, 3, 4), foci_mm=(10.0, 25.0), count=3
    )
    assert found.zones == 3
    assert [zones for zones, _ in tried] == [1] * 7 + [3] * 7 + [4] * 7


def test_a_pair_is_searched_over_foci_from_before_the_depths_to_behind_them(
    monkeypatch,
):
    """Of 20 to 40 mm, 50 and 25 per m: 50 + 0.87 * 25 and 50 - 1.77 * 25 for the
    hyperbolic lens, of 12 foci; helices
    of one zone to six, of 6 foci, from 50 + 0.37 * 25 to 50 - 1.21 * 25."""
    asked = []

    def tuned(pupil, settings, *, foci_mm, zones=(0,), count=12):
        asked.append((zones, count, foci_mm))
        return len(asked)

    monkeypatch.setattr(baselines, "tuned", tuned)
    plain, helix = baselines.tuned_pair(PUPIL, SimpleNamespace(depths_mm=(20.0, 40.0)))
    by_zones = {zones: (count, foci) for zones, count, foci in asked}
    assert by_zones[0,] == (
        12,
        (14.0, 170.0),
    )  # 1e3 / 71.75 = 13.94, 1e3 / 5.75 = 173.9
    assert by_zones[1, 2, 3, 4, 5, 6] == (
        6,
        (17.0, 51.0),
    )  # 1e3 / 59.25 = 16.88, 1e3 / 19.75 = 50.6
    assert [asked[plain - 1][0], asked[helix - 1][0]] == [(0,), (1, 2, 3, 4, 5, 6)]


def test_a_lens_is_worth_its_mean_information_and_its_least_energy(monkeypatch):
    told = SimpleNamespace(
        information=torch.tensor([0.3, 1.1, 0.7, 2.3]),
        encircled=torch.tensor([0.9, 0.4, 0.6]),
    )
    seen = []

    def score(phase, pupil, *, focus_um, settings):
        seen.append((phase, pupil, focus_um, settings))
        return told

    monkeypatch.setattr(baselines, "score", score)
    found = baselines.judged(PUPIL, "asked", zones=3, focus_um=17300.0)
    assert (found.zones, found.focus_um) == (3, 17300.0)
    assert (found.information, found.encircled) == pytest.approx(
        (1.1, 0.4), rel=1e-6
    )  # float32
    phase, *rest = seen[0]
    assert rest == [PUPIL, 17300.0, "asked"]
    x, y = (a.numpy() for a in nodes_um(PUPIL))
    turn, share = np.arctan2(y, x), (x**2 + y**2) / 210.0**2
    for ring, inside in (
        (1, share < 1 / 3),
        (3, (share > 1 / 3) & (share < 2 / 3)),
        (5, share > 2 / 3),
    ):
        assert np.abs(phase.numpy()[inside] - ring * turn[inside]).max() < 1e-12
    assert not baselines.baseline_phase(PUPIL, 0).any()


def test_names_tell_zones_and_millimetres():
    told = [baselines.Baseline(zones, 17340.0, 0.3, 0.5).name for zones in (0, 1, 2, 6)]
    assert told == [
        "hyperbolic, 17.3 mm", "helix of 1 zone, 17.3 mm", "helix of 2 zones, 17.3 mm", "helix of 6 zones, 17.3 mm",
    ]  # fmt: skip


@pytest.mark.parametrize("zones", [0, 2])
def test_the_phase_of_a_baseline_is_its_focus_and_its_turns(zones):
    """-k (√(r² + d²) - d + √(r² + z²) - z), and one turn about the axis per turn
    inside, three outside.
    """
    mine, focus = baselines.Baseline(zones, 9e3, 0.3, 0.5), Focus(0.81, 1700.0, 30e3)
    phase, own = mine.phase(focus, radius_um=210.0)
    assert own == Focus(0.81, 1700.0, 9e3)
    x, y = np.array([-40.0, 61.0, 170.0]), np.array([25.0, -90.0])
    r2 = x**2 + y[:, None] ** 2
    path = sum(np.sqrt(r2 + z**2) - z for z in (1700.0, 9e3))
    want = -2 * math.pi / 0.81 * path
    if zones:
        want = want + np.where(r2 < 210.0**2 / 2, 1, 3) * np.arctan2(y[:, None], x)
    got = np.asarray(phase(x, y))
    assert (
        np.abs(np.angle(np.exp(1j * (got - got[0, 0] - want + want[0, 0])))).max()
        < 1e-8
    )


def test_real_lenses_are_scanned_with_the_settings_of_a_design():
    """A range whose ends are one lens each, of 64 nodes: its worth is that of the lens
    alone.
    """
    asked = Fisher(encircled=0.0).about(Focus(0.81, 1700.0, 20e3), 210.0)
    found = baselines.tuned(PUPIL, asked, foci_mm=(14.0, 30.0), count=3)
    again = baselines.judged(PUPIL, asked, zones=0, focus_um=found.focus_um)
    assert (found.information, found.encircled) == (again.information, again.encircled)
