"""Spreads over the pillars of a lens whose proxy is a straight line or a parabola:
every mean by hand.
"""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from layout.process.process import Process
from layout.study import pillars, tolerance, tolerant
from layout.study.sensitivity import Sensitivities
from metalens.cell.record import Cell
from metalens.lens.record import DiameterMap, Lens
from metalens.made import Draw
from metalens.pillars.proxy import Proxy

# phase and |T| over u = (2 D - 0.4) / 0.2 in [-1, 1]
PROXY = Proxy(
    np.array([[4.6, 4.2, 0.5]]),
    np.array([[0.83, 0.02, 0.05]]),
    (0.1, 0.3),
    (0.85, 0.85),
    0.0,
    0.0,
)
MAP = np.array([[0.0, 0.12, 0.2], [0.27, 0.12, 0.0], [0.2, 0.2, 0.29]])
LENS = Lens(DiameterMap(MAP, 0.4), Cell(0.4), PROXY, 0.85, 150.0, 1500.0, "map")


def at(diameter):
    """(phase, |T|, d ln t / dD per nm) by differences of the proxy."""
    phase, level = (f(diameter, 0.85) for f in (PROXY.phase_rad, PROXY.transmission))
    h = 1e-6
    up, down = (
        (PROXY.phase_rad(diameter + s, 0.85), PROXY.transmission(diameter + s, 0.85))
        for s in (h, -h)
    )
    rate = (np.log(up[1] / down[1]) + 1j * (up[0] - down[0])) / (2 * h) * 1e-3
    return phase, level, rate


def test_spread_phase_error_and_light_of_a_lens_are_means_over_its_pillars():
    present = MAP > 0
    phase, level, rate = at(MAP[present])
    wanted = np.zeros(MAP.shape)
    wanted[present] = phase + np.array([0.3, -0.1, 0.25, 0.05, -0.2, 0.4, 0.1])
    spread, error, light = tolerant._statistics(LENS, wanted, present)
    assert spread == pytest.approx(
        np.sqrt((abs(rate - rate.mean()) ** 2).mean()), rel=1e-5
    )
    turn = np.exp(1j * (phase - wanted[present]))
    assert error == pytest.approx(
        np.sqrt((np.angle(turn / turn.mean()) ** 2).mean()), rel=1e-9
    )
    assert light == pytest.approx(level.mean(), rel=1e-9)


def test_a_round_of_the_choice_never_raises_the_weighted_variance():
    """What it ends with is the best for its own common rate, and the variance is that
    of the weights.
    """
    rng = np.random.default_rng(3)
    stock = SimpleNamespace(
        rate=rng.normal(0.02, 0.01, 9) + 1j * rng.normal(0.05, 0.02, 9)
    )
    bins = tolerant._BINS
    weight = rng.integers(0, 40, bins)
    allowed = rng.uniform(size=(bins, 9)) > 0.4
    allowed[:, 4] = True
    variance, best = tolerant._settle(stock, weight, allowed, 0.05j)
    common = np.average(stock.rate[best], weights=weight)
    assert variance == pytest.approx(
        (abs(stock.rate[best] - common) ** 2 * weight).sum(), rel=1e-9
    )
    nearest = np.where(allowed, abs(stock.rate - common), np.inf).min(1)
    assert abs(stock.rate[best] - common)[weight > 0] == pytest.approx(
        nearest[weight > 0]
    )


@pytest.mark.parametrize("loss", [0.002, 0.006])
def test_the_choice_is_the_best_of_all_printable_ones_that_keep_phase_and_light(loss):
    """Every choice of 2 nm steps within 0.18 rad and ``loss`` of |T| for four
    diameters, tried one by one.
    """
    sizes = np.array([[0.12, 0.0, 0.201], [0.266, 0.12, 0.3], [0.201, 0.201, 0.12]])
    lens = dataclasses.replace(LENS, diameters=DiameterMap(sizes, 0.4))
    kinds, count = np.unique(sizes[sizes > 0], return_counts=True)
    printable = np.arange(100, 301, 2) * 1e-3
    (phase, level, rate), (wanted, light, _) = at(printable), at(kinds)
    away = abs(np.angle(np.exp(1j * (phase - wanted[:, None]))))
    assert (
        abs(away - 0.18) > 2 * np.pi / 2048
    ).all()  # phases are told apart by 3 mrad
    allowed = [
        np.flatnonzero((a <= 0.18) & (level >= t - loss))
        for a, t in zip(away, light, strict=True)
    ]
    tried = np.array(list(itertools.product(*allowed)))
    share = count / count.sum()
    spread = np.sqrt(
        (
            abs(rate[tried] - (rate[tried] * share).sum(1, keepdims=True)) ** 2 * share
        ).sum(1)
    )
    best = printable[tried[spread.argmin()]]
    assert len(tried) > 10
    made = tolerant.choose(lens, Process(), tolerance_rad=0.18, loss=loss)
    want = np.where(sizes > 0, best[np.searchsorted(kinds, sizes).clip(0, 3)], 0)
    assert made.lens.diameters.diameter_um == pytest.approx(want)
    assert made.after == pytest.approx(spread.min(), rel=1e-5)
    assert made.moved == pytest.approx((abs(best - kinds) > 1e-6) @ share)
    assert made.transmission_before == pytest.approx(light @ share, rel=1e-6)
    assert made.transmission == pytest.approx(
        level[tried[spread.argmin()]] @ share, rel=1e-6
    )


def test_a_bias_changes_phase_and_light_by_the_slopes_of_the_proxy():
    """rms of dφ about the mean and of d|T| over the pillars, for a bias of 2 nm that is
    the same everywhere.
    """
    diameter, count = np.array([0.12, 0.2, 0.27, 0.29]), np.array([2, 3, 1, 1])
    sens = Sensitivities(np.array([0.1, 0.2, 0.3]), np.zeros((3, 3), complex), 0.0)
    model = SimpleNamespace(
        pillars=pillars.OneSize(LENS.proxy, LENS.wavelength_um, sens, diameter),
        count=count,
    )
    phase, light = tolerance._pillar_change(model, Draw({"bias_nm": 2.0}).state())
    share = count / count.sum()
    before, after = (
        (PROXY.phase_rad(d, 0.85), PROXY.transmission(d, 0.85))
        for d in (diameter, diameter + 2e-3)
    )
    turn = after[0] - before[0]
    weight = share * after[1] / before[1]
    mean = np.angle((weight * np.exp(1j * turn)).sum())
    assert phase == pytest.approx(np.sqrt((share * (turn - mean) ** 2).sum()), rel=1e-6)
    assert light == pytest.approx(
        np.sqrt((share * (after[1] - before[1]) ** 2).sum()), rel=1e-6
    )


def test_entries_of_a_lens_are_its_diameters_and_their_counts():
    index, count, made = pillars.kinds(
        LENS, Sensitivities(np.array([0.1, 0.3]), np.zeros((3, 2)), 0.0)
    )
    diameter = made.diameter_um
    assert diameter == pytest.approx([0.12, 0.2, 0.27, 0.29], abs=2.6e-5)
    assert count.tolist() == [2, 3, 1, 1]
    assert np.where(index > 0, diameter[index - 1], 0) == pytest.approx(MAP, abs=2.6e-5)
