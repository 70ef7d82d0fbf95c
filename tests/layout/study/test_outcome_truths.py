"""What a tolerance study says of draws, from light and curves that are typed in, by plain loops."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from layout.study import spread_model, stitching, tolerance
from layout.study.focus import Window
from layout.study.tolerance import Outcome
from metalens.made import Draw

RNG = np.random.default_rng(23)
WINDOW = Window(np.arange(5) * 0.7, np.arange(4) * 0.9, 500.0, 0.85, np.ones(5))


def test_numbers_of_draws_are_of_their_own_light_against_that_of_the_nominal_lens(monkeypatch):
    """27 lenses, more than are worked on at once; a design depth and two pairs of depths 140 um apart."""
    light = RNG.normal(size=(27, 5, 4, 5)) + 1j * RNG.normal(size=(27, 5, 4, 5))
    monkeypatch.setattr(tolerance, "peak", lambda psf: np.asarray(psf).max((-2, -1)))
    model = SimpleNamespace(
        count=np.array([30.0, 17.0]),
        focus=SimpleNamespace(window=WINDOW, case=SimpleNamespace(area_um2=0.16), light=lambda drawn: light[drawn]),
        drawn=lambda states: np.array(states),
    )
    found = tolerance._outcome(model, list(range(27)), 140.0)
    incident, nominal = 47 * 0.16, np.abs(light[0, 0]) ** 2
    for n in (0, 1, 24, 25, 26):
        psf = np.abs(light[n]) ** 2
        assert found.strehl[n] == pytest.approx(psf[0].max() / nominal.max())
        assert found.efficiency[n] == pytest.approx(psf[0].sum() * 0.63 / incident)
        change = math.sqrt(((psf[0] - nominal) ** 2).sum() / (nominal**2).sum())
        assert found.psf_change[n] == pytest.approx(change, abs=1e-12)
        assert found.psf[n] == pytest.approx(psf[0][2] / nominal.max())
        for k, (near, far) in enumerate(((1, 2), (3, 4))):
            slope = (psf[far] / psf[far].sum() - psf[near] / psf[near].sum()) / 140.0
            assert found.information[n, k] == pytest.approx((slope**2).sum())


def test_an_effect_is_the_worse_of_both_signs_against_the_nominal_lens(monkeypatch):
    """Information is summed over the depths first; of the pillars each number has its own worst sign."""
    alone = Outcome(
        np.array([0.97, 0.91]), np.array([0.66, 0.63]), np.array([0.08, 0.05]),
        np.array([[2.0, 7.0], [4.0, 9.0]]), np.zeros((2, 3)),
    )  # fmt: skip
    nominal = Outcome(np.array([1.0]), np.array([0.6]), np.array([0.0]), np.array([[4.0, 6.0]]), np.zeros((1, 3)))
    changes = iter([(0.11, 0.002), (0.07, 0.009)])
    monkeypatch.setattr(tolerance, "_pillar_change", lambda model, state: next(changes))
    found = tolerance._effect(None, (Draw({"bias_nm": -3.1}), Draw({"bias_nm": 3.1})), alone, nominal)
    assert (found.cause, found.deviation) == ("bias_nm", 3.1)
    assert (found.phase_rad, found.transmission) == (0.11, 0.009)
    assert found.strehl == pytest.approx(0.09)
    assert found.efficiency == pytest.approx(0.1)
    assert found.psf == 0.08
    assert found.information == pytest.approx(0.3)  # 13 of 10; 9 is off by less


def test_what_the_basis_misses_is_the_worst_rms_of_any_draw_at_the_centre_and_both_edges():
    """Over pillars of unlike count, relative to their own t: at right angles to a basis that is orthonormal so."""
    count = np.array([3.0, 1.0, 5.0, 2.0])
    first = np.array([0.4, 0.9, -0.2, 0.5])
    first = first / math.sqrt((first**2 * count).sum())
    curves = {k: RNG.normal(size=(3, 4)) + 1j * RNG.normal(size=(3, 4)) for k in (0, 1)}
    asked = []

    def curve(diameter, bias, state):
        asked.append(bias)
        return curves[len(asked) - 1]

    model = SimpleNamespace(pillars=SimpleNamespace(curve=curve), diameter_um=None, count=count, basis=first[None])
    draws = [Draw({"bias_x_nm": 2.0}, 0.7), Draw({"bias_nm": 1.5}, 0.0)]
    found = spread_model.missed(model, draws)
    worst = 0.0
    for some in curves.values():
        for t in some:
            rest = t - (t * count * first).sum() * first
            worst = max(worst, math.sqrt((np.abs(rest) ** 2 * count).sum() / (np.abs(t) ** 2 * count).sum()))
    assert found == pytest.approx(worst, rel=1e-9)
    assert asked[1] == pytest.approx([1.5e-3] * 3)
    state = draws[0].state()
    places = [(0.0, 0.0), (math.cos(0.7), math.sin(0.7)), (-math.cos(0.7), -math.sin(0.7))]
    assert asked[0] == pytest.approx([float(state.bias_um(np.array([u]), np.array([v]))[0]) for u, v in places])


def test_fields_that_stand_off_change_the_light_by_their_series_and_move_its_middle(monkeypatch):
    """Three fields, offsets uniform within 17 nm less their mean, terms of the series by hand for every draw."""
    monkeypatch.setattr(stitching, "prepare", lambda lens, window: SimpleNamespace(window=WINDOW))
    monkeypatch.setattr(stitching, "window", lambda lens: WINDOW)
    monkeypatch.setattr(stitching, "peak", lambda psf: np.asarray(psf).max((-2, -1)))
    monkeypatch.setattr(stitching, "field_moments", lambda lens, plan, focus: (3, None))
    still = 2 + RNG.normal(size=(4, 5)) + 1j * RNG.normal(size=(4, 5))
    terms = 0.1 * (RNG.normal(size=(5, 3, 4, 5)) + 1j * RNG.normal(size=(5, 3, 4, 5)))
    steps = []
    monkeypatch.setattr(stitching, "_expansion", lambda focus, moments, step: steps.append(step) or (still, terms))
    process = SimpleNamespace(write_field=SimpleNamespace(stitching_nm=17.0))
    found = stitching.stitching(None, None, process, draws=4, seed=6)
    assert steps == [pytest.approx(17e-3)]
    offsets = np.random.default_rng(6).uniform(-1, 1, (4, 3, 2))
    perfect = np.abs(still) ** 2

    def middle(psf):
        y, x = np.meshgrid(WINDOW.y_um, WINDOW.x_um, indexing="ij")
        return np.array([(psf * x).sum(), (psf * y).sum()]) / psf.sum()

    for n in range(4):
        light = still.copy()
        for f in range(3):
            x, y = offsets[n, f] - offsets[n].mean(0)
            light = light + sum(c * terms[k, f] for k, c in enumerate((x, y, x * x / 2, y * y / 2, x * y)))
        psf = np.abs(light) ** 2
        assert found.change[n] == pytest.approx(math.sqrt(((psf - perfect) ** 2).sum() / (perfect**2).sum()))
        assert found.strehl[n] == pytest.approx(psf.max() / perfect.max())
        assert found.moved_nm[n] == pytest.approx(1e3 * np.linalg.norm(middle(psf) - middle(perfect)))
        if n == found.change.argmax():
            assert found.worst_psf == pytest.approx(psf)
    assert found.psf == pytest.approx(perfect)
    assert (found.fields, found.stitching_nm) == (3, 17.0)


def test_sites_send_the_light_of_their_own_pillars_and_none_where_none_stands(monkeypatch):
    monkeypatch.setattr(stitching, "designed", lambda proxy, d, wave: (0.4 + d) * np.exp(1j * d / wave))
    size = np.array([[0.12, 0.0, 0.21], [0.0, 0.18, 0.3]], np.float32)
    lens = SimpleNamespace(
        diameters=SimpleNamespace(diameter_um=size), proxy=SimpleNamespace(domain_um=(0.1, 0.3)), wavelength_um=0.85
    )
    got = stitching._amplitude(lens, slice(0, 2), slice(1, 3))
    want = [
        [0.0, (0.4 + 0.21) * np.exp(0.21j / 0.85)],
        [(0.4 + 0.18) * np.exp(0.18j / 0.85), 0.7 * np.exp(0.3j / 0.85)],
    ]
    assert got == pytest.approx(np.array(want), rel=1e-6)
