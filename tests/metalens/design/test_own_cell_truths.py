"""What a lens's own pillars leave out, from rows and tilted answers that are typed in:
every term by hand.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.design import own_cell
from metalens.lens import Layers

LENS = SimpleNamespace(
    wavelength_um=0.85,
    sensor_distance_um=210.0,
    source_distance_um=900.0,
    layers=Layers(),
    pairs=None,
    neighbours=None,
    cell=SimpleNamespace(pitch_um=0.37, cover="air"),
)


class Rows:
    """Solved rows whose share of the focus is typed in, whatever the lens."""

    def __init__(self, whole, coarse=None, without=()):
        self.whole, self.coarse, self.less = whole, coarse, without
        self.sine, self.diagonal = (
            0.85 / 0.37 / np.array([3.0, 5.0, 4.4]),
            np.array([False, False, True]),
        )
        self.asked = []

    def share(self, sine, weight):
        self.asked.append((sine, weight))
        return self.whole

    @property
    def coarser(self):
        return Rows(self.coarse)

    @property
    def others(self):
        return [Rows(less) for less in self.less]


def test_rings_of_a_lens_are_equal_areas_that_bend_source_light_to_the_sensor():
    sine, weight = own_cell._rings(LENS, 80.0)
    assert weight.sum() == pytest.approx(1.0, rel=1e-12)

    def bend(r):
        return r / math.hypot(r, 210.0) + r / math.hypot(r, 900.0)

    r = 80.0 * np.sqrt((np.arange(20000) + 0.5) / 20000)
    for power in (1, 2):  # moments over the aperture
        want = np.mean([bend(v) ** power for v in r[10::20]])
        assert weight @ sine**power == pytest.approx(want, rel=1e-4)


def test_the_error_of_unlike_neighbours_adds_truncation_rows_and_a_fifth_of_the_loss(
    monkeypatch,
):
    """0.83 of the focus; 0.80 at the coarser truncation, 0.85, 0.78, 0.84 without a
    row: 0.03 + 0.05 + 0.2 * 0.17.
    """
    made = Rows(0.83, 0.80, (0.85, 0.78, 0.84))
    counts = []
    monkeypatch.setattr(
        own_cell,
        "neighbours",
        lambda lens, *, counts, told=counts: told.append(counts) or made,
    )
    found = own_cell.unlike(LENS, radius_um=80.0)
    assert found.share == 0.83
    assert found.error == pytest.approx(0.03 + 0.05 + 0.2 * 0.17, rel=1e-12)
    assert found.pillars == (3, 5)
    rim = round(0.85 / (0.37 * max(made.asked[0][0])))
    assert counts == [(rim, math.ceil(1.5 * rim), 2 * rim)]
    held = SimpleNamespace(
        **vars(LENS) | {"neighbours": Rows(0.7, 0.7)}
    )  # those of the lens are not solved again
    assert own_cell.unlike(held, radius_um=80.0).error == pytest.approx(
        0.2 * 0.3, rel=1e-12
    )
    assert len(counts) == 1


def test_neighbours_that_gain_in_the_rough_cell_are_no_loss_below_nothing():
    """At NA 0.1 the rough factor is above 1: the error was negative, and `-0.5%` the
    most that they may cost.
    """
    flat = SimpleNamespace(
        **vars(LENS) | {"sensor_distance_um": 1600.0, "source_distance_um": math.inf}
    )
    sine, weight = own_cell._rings(flat, 80.0)
    share = (
        abs(
            (weight * (1 + (0.057 - 0.289j) * sine + (-0.523 + 0.054j) * sine**2)).sum()
        )
        ** 2
    )
    assert share > 1.0005
    found = own_cell.rough_unlike(flat, radius_um=80.0)
    assert found.share == pytest.approx(share, rel=1e-12)
    assert found.error == pytest.approx(share - 1, rel=1e-9)


@pytest.mark.parametrize(
    ("aperture", "counts"),
    [
        (0.93, (2, 3, 4)),
        (0.74, (3, 5, 6)),
        (0.45, (5, 8, 10)),
        (0.2, (6, 9, 12)),
        (3.0, (2, 3, 4)),
    ],
)
def test_three_rows_are_asked_for_from_the_zone_of_the_rim_to_half_its_slope(
    aperture, counts
):
    """Three fix a and b of 1 + a s + b s² with one to spare, whose absence is the
    error. Zones of the rim: 0.85 / 0.37
    pitches over the sine; a row has two pillars or more, to tell both sides apart, and
    twelve at most."""
    assert own_cell._counts(LENS, aperture) == counts


def test_rough_neighbours_err_by_all_that_they_take():
    sine, weight = own_cell._rings(LENS, 80.0)
    factor = 1 + (0.057 - 0.289j) * sine + (-0.523 + 0.054j) * sine**2
    share = abs((weight * factor).sum()) ** 2
    found = own_cell.rough_unlike(LENS, radius_um=80.0)
    assert found.share == pytest.approx(share, rel=1e-12)
    assert found.error == pytest.approx(1 - share, rel=1e-12)
    assert found.pillars == ()


@pytest.mark.parametrize(
    ("aperture", "counts"),
    [(0.31, (6, 9, 12)), (0.5, (5, 8, 10)), (0.9, (3, 5, 6)), (2.0, (2, 3, 4))],
)
def test_terms_of_the_budget_come_from_a_zone_of_the_rim_and_longer_ones(
    monkeypatch, aperture, counts
):
    asked = []
    monkeypatch.setattr(
        own_cell, "neighbours", lambda lens, *, counts: asked.append(counts) or "rows"
    )
    monkeypatch.setattr(own_cell, "angle_change", lambda lens, angle: 0.07 * angle)
    found = own_cell.left_out(LENS, aperture=aperture, incidence_rad=0.4)
    assert asked == [counts]
    assert found.neighbours == "rows"
    assert found.angle == pytest.approx(0.07 * 0.4 / math.sin(0.4) ** 2, rel=1e-12)
    assert own_cell.left_out(LENS, aperture=aperture, incidence_rad=0.0).angle == 0


def test_the_change_by_an_angle_is_what_no_common_factor_makes_up_for(monkeypatch):
    """Two of five pillars at an angle answer as a multiple of themselves with a part at
    right angles; s and p apart.
    """
    rng = np.random.default_rng(2)
    flat = rng.normal(size=5) + 1j * rng.normal(size=5)
    away = rng.normal(size=5) + 1j * rng.normal(size=5)
    away -= flat * (np.vdot(flat, away) / np.vdot(flat, flat))
    parts = {"s": 0.3, "p": 0.11}

    def solve_many(cell, diameters, wavelength, *, angle_rad, polarization, tolerance):
        assert len(diameters) == 5
        assert (diameters[0], diameters[-1]) == (0.12, 0.29)
        t = flat if angle_rad == 0 else (0.8 - 0.5j) * flat + parts[polarization] * away
        return [SimpleNamespace(t=v) for v in t]

    monkeypatch.setattr(own_cell.rcwa, "solve_many", solve_many)
    monkeypatch.setattr(own_cell, "printed", lambda lens: (0.12, 0.29))
    ratio = (np.abs(away) ** 2).sum() / (np.abs(flat) ** 2).sum()
    squares = [q**2 * ratio / (0.89 + q**2 * ratio) for q in parts.values()]
    assert own_cell.angle_change(LENS, 0.3) == pytest.approx(
        math.sqrt(np.mean(squares)), rel=1e-9
    )
