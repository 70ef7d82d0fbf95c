"""A valley that only the walk finds may have a mirror image: both are in the intervals."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

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
