"""A valley that only the walk finds may have a mirror image: both are in the intervals."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import explore, leastsquares
from characterize.inference.leastsquares import GaussianPrior
from characterize.model import PLACE
from characterize.model.setting import FrameSetting

NAMED = ("bias_nm", "bias_x_nm", "background_e")
RNG = np.random.default_rng(7)
BRIGHT, PICTURES = RNG.uniform(3, 9, (5, 6, 5)), RNG.standard_normal((3, 5, 6, 5))
LOW, HIGH, PER_NM, LEAN, NOISE = -7.0, 11.0, 0.013, 3.0, 0.05


class Forked:
    """q = (b - LOW)(b - HIGH) on one picture, x² + LEAN x - 25 (HIGH - b) / (HIGH -
    LOW) on another.

    At b = HIGH the gradient x is 0 or -LEAN; at b = LOW it is either root of x² + LEAN
    x = 25. A tenth of q more on the
    second picture of HIGH makes LOW the better.
    """

    def __init__(self, index=None):
        self.index = index = np.arange(5) if index is None else index
        self.setting = FrameSetting(
            np.linspace(21e3, 29e3, 5)[index],
            np.zeros((len(index), 2)),
            np.ones(len(index)),
            1.7,
            6,
            5,
        )
        self.groups = [SimpleNamespace(index=np.arange(len(index)))]

    def only(self, index):
        return Forked(self.index[index])

    def rough(self, tolerance):
        return self

    def quick(self, *_part):
        return self

    def images(self, x, names=None):
        bias, lean, level = (x[PLACE[name]] for name in NAMED)
        one, two, three = PICTURES[:, self.index]
        q, fork = (
            PER_NM * (bias - LOW) * (bias - HIGH),
            lean**2 + LEAN * lean - 25 * (HIGH - bias) / (HIGH - LOW),
        )
        worse = 0.012 * (bias - LOW) / (HIGH - LOW)
        image = (
            BRIGHT[self.index] + q * one + 0.05 * fork * two + (level + worse) * three
        )
        if names is None:
            return image, None
        by_bias = (
            PER_NM * (2 * bias - LOW - HIGH) * one
            + 0.05 * 25 / (HIGH - LOW) * two
            + 0.012 / (HIGH - LOW) * three
        )
        return image, np.stack([by_bias, 0.05 * (2 * lean + LEAN) * two, three])


def test_both_signs_of_a_gradient_that_the_walk_met_lie_in_its_interval():
    model, wide = Forked(), np.array([30.0, 40.0, 9.0])
    known = GaussianPrior(np.zeros(3), np.array([15.0, 20.0, 0.02]), -wide, wide)
    task = b.given(model, BRIGHT.copy(), NOISE, NAMED, known)
    end = leastsquares.fit_levenberg_marquardt(
        task.problem(), task.data, np.array([HIGH, 0.0, 0.0]), prior=known
    )
    assert end.value[0] == pytest.approx(HIGH, abs=1.0)
    found = explore.explore_posterior(task, [end])
    roots = np.roots([1, LEAN, -25])
    assert found.best.value[0] == pytest.approx(LOW, abs=0.5)
    # both roots, with what the prior pulls them by (25 / 20² of -2 ln L, against a
    # noise that knows them to 0.03)
    assert found.low[1] < roots.min() + 0.1
    assert found.high[1] > roots.max() - 0.1
