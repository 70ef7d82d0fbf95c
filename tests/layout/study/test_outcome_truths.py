"""What studies say of draws: from the light of the model by plain loops, and from sums
over pillars one by one.
"""

import math

import numpy as np
import pytest

from layout.mask import fields
from layout.process.process import Process, WriteField
from layout.study import focus, stitching, tolerance
from layout.study.focus import FocusWindow, interpolated_peak
from layout.study.spread_model import reduce_spread
from layout.study.tolerance import ToleranceOutcome
from metalens.fabrication import Draw, ResponseError, Spread, draws, named, transmission
from tests.layout.study.test_tolerance import PROXY, SENS, hyperbolic
from tests.referees import plain_sum

DEPTHS_UM = np.array(
    [500.0, 620.0, 760.0, 1100.0, 1240.0]
)  # of the design, and two pairs


@pytest.fixture(scope="module")
def model():
    lens = hyperbolic(61, 60.0, 500.0)
    where = FocusWindow(
        np.arange(-2, 3) * 0.6, np.arange(-1, 3) * 0.9, 60.0, 0.85, DEPTHS_UM
    )
    return reduce_spread(lens, SENS, focus.prepare_focus(lens, where), Spread(), seed=3)


def test_numbers_of_draws_are_of_their_own_light_against_that_of_the_nominal_lens(
    model,
):
    """27 lenses, more than are worked on at once; a design depth and two pairs of
    depths 140 um apart: float32.
    """
    states = [draw.state() for draw in (Draw({}), *draws(Spread(), 26, seed=8))]
    light = model.focus.light(model.drawn(states))
    every = hyperbolic(61, 60.0, 500.0).diameters.diameter_um
    found = tolerance._outcome(model, states, 140.0)
    incident, nominal = (every > 0).sum() * 0.4**2, np.abs(light[0, 0]) ** 2
    assert np.ptp(found.strehl) > 0.01
    for n in (0, 1, 24, 25, 26):
        psf = np.abs(light[n]) ** 2
        assert found.strehl[n] == pytest.approx(
            interpolated_peak(psf[0]) / interpolated_peak(nominal), rel=1e-5
        )
        assert found.efficiency[n] == pytest.approx(
            psf[0].sum() * 0.6 * 0.9 / incident, rel=1e-5
        )
        change = math.sqrt(((psf[0] - nominal) ** 2).sum() / (nominal**2).sum())
        assert found.psf_change[n] == pytest.approx(change, abs=1e-5)
        assert found.psf[n] == pytest.approx(psf[0][2] / nominal.max(), rel=1e-5)
        for k, (near, far) in enumerate(((1, 2), (3, 4))):
            slope = (psf[far] / psf[far].sum() - psf[near] / psf[near].sum()) / 140.0
            assert found.information[n, k] == pytest.approx((slope**2).sum(), rel=1e-4)


def test_an_effect_is_the_worse_of_both_signs_against_the_nominal_lens(model):
    """Information is summed over the depths first; of the pillars phase and level each
    have their own worst sign.
    """
    alone = ToleranceOutcome(
        np.array([0.97, 0.91]), np.array([0.66, 0.63]), np.array([0.08, 0.05]),
        np.array([[2.0, 7.0], [4.0, 9.0]]), np.zeros((2, 3)),
    )  # fmt: skip
    nominal = ToleranceOutcome(
        np.array([1.0]),
        np.array([0.6]),
        np.array([0.0]),
        np.array([[4.0, 6.0]]),
        np.zeros((1, 3)),
    )
    found = tolerance._effect(
        model, (Draw({"bias_nm": -31.0}), Draw({"bias_nm": 31.0})), alone, nominal
    )
    assert (found.cause, found.deviation) == ("bias_nm", 31.0)
    every = hyperbolic(61, 60.0, 500.0).diameters.diameter_um
    before, *after = (
        transmission(
            PROXY, SENS, every[every > 0] + b, 0.85, np.zeros(len(named(ResponseError)))
        )
        for b in (0, -0.031, 0.031)
    )
    turned = [
        np.angle(t / before * np.exp(-1j * np.angle((t / before).sum()))) for t in after
    ]
    phases = [float(np.sqrt((turn**2).mean())) for turn in turned]
    levels = [float(np.sqrt(((np.abs(t) - np.abs(before)) ** 2).mean())) for t in after]
    assert min(np.ptp(phases) / max(phases), np.ptp(levels) / max(levels)) > 0.01
    assert found.phase_rad == pytest.approx(
        max(phases), rel=1e-3
    )  # diameters to 0.05 nm
    assert found.transmission == pytest.approx(max(levels), rel=1e-3)
    assert found.strehl == pytest.approx(0.09)
    assert found.efficiency == pytest.approx(0.1)
    assert found.psf == 0.08
    assert found.information == pytest.approx(0.3)  # 13 of 10; 9 is off by less


def test_fields_that_stand_off_are_the_sum_over_pillars_that_do():
    """Four draws of offsets within 17 nm less their mean, pillar by pillar: third order
    (k NA 17 nm)³, 1e-4, and the
    parabola of the peak."""
    lens, process = (
        hyperbolic(61, 60.0, 500.0),
        Process(write_field=WriteField(9.0, "floating", 17.0)),
    )
    plan = fields.split_write_fields(lens.diameters, process)
    found = stitching.simulate_stitching(lens, plan, process, draws=4, seed=6)
    held = [block for block in plan.blocks() if lens.diameters.diameter_um[block].any()]
    assert (found.fields, found.stitching_nm) == (len(held), 17.0)
    offsets = np.random.default_rng(6).uniform(-0.017, 0.017, (4, len(held), 2))
    offsets -= offsets.mean(1, keepdims=True)
    number = np.zeros(lens.diameters.diameter_um.shape, int)
    for k, block in enumerate(held):
        number[block] = k
    t = lens.transmission() * np.exp(1j * lens.phase_rad())
    perfect, *moved = (
        np.abs(plain_sum.field(lens, t, found.window, shift_um=shift)[0]) ** 2
        for shift in (None, *(np.moveaxis(each[number], -1, 0) for each in offsets))
    )
    y, x = np.meshgrid(found.window.y_um, found.window.x_um, indexing="ij")

    def middle(psf):
        return np.array([(psf * x).sum(), (psf * y).sum()]) / psf.sum()

    assert found.psf == pytest.approx(perfect, abs=1e-4 * perfect.max())
    change = [
        math.sqrt(((psf - perfect) ** 2).sum() / (perfect**2).sum()) for psf in moved
    ]
    assert found.change == pytest.approx(change, rel=0.01)
    assert found.strehl == pytest.approx(
        [interpolated_peak(psf) / interpolated_peak(perfect) for psf in moved], abs=1e-5
    )
    away = [1e3 * np.linalg.norm(middle(psf) - middle(perfect)) for psf in moved]
    assert found.moved_nm == pytest.approx(away, rel=0.01)
    worst = moved[int(np.argmax(change))]
    assert found.worst_psf == pytest.approx(worst, abs=1e-4 * worst.max())
