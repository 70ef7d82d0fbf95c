"""A bias and its gradients seen through their products alone: for every lens another,
with all of them reversed.
"""

import sys
from pathlib import Path

import numpy as np
from scipy import optimize

sys.path.insert(0, str(Path(__file__).parents[1]))
from pictured import Pictured

from characterize.inference.leastsquares import GaussianPrior
from characterize.model import PLACE

NAMED = ("bias_nm", "bias_x_nm", "bias_y_nm", "bias_r_nm", "background_e")
RNG = np.random.default_rng(8)
BRIGHT = RNG.uniform(3, 9, (5, 4, 3))
PICTURES = np.linalg.qr(RNG.standard_normal((60, 8)))[0].T.reshape(
    8, 5, 4, 3
)  # of unit length, at right angles
PAIRS = (
    (0, 1, 0.030),
    (0, 2, 0.022),
    (0, 3, 0.050),
    (1, 3, 0.035),
    (2, 3, 0.020),
    (1, 2, 0.016),
)
SQUARES, NOISE = 0.028, 0.4
SIGMA, WIDE = (
    np.array([15.0, 6.0, 6.0, 6.0, np.inf]),
    np.array([26.0, 20.0, 20.0, 20.0, 99.0]),
)
PRIOR = GaussianPrior(np.zeros(5), SIGMA, -WIDE, WIDE)


def products(field):
    """(7,) what the pictures show of (4,) bias and gradients, and (4, 7) slopes."""
    value, slopes = np.zeros(7), np.zeros((4, 7))
    for k, (i, j, size) in enumerate(PAIRS):
        value[k], slopes[i, k], slopes[j, k] = (
            size * field[i] * field[j],
            size * field[j],
            size * field[i],
        )
    value[6] = SQUARES * (field[0] ** 2 / 4 - field[3] ** 2)
    slopes[0, 6], slopes[3, 6] = SQUARES * field[0] / 2, -2 * SQUARES * field[3]
    return value, slopes


class Field(Pictured):
    """Seven pictures of the products, and a background."""

    def images(self, x, names=None):
        *field, level = (x[PLACE[name]] for name in NAMED)
        value, slopes = products(np.array(field))
        shown = PICTURES[:, self.index]
        image = BRIGHT[self.index] + np.tensordot(np.append(value, level), shown, 1)
        if names is None:
            return self.seen * image, None
        return self.seen * image, self.seen * np.concatenate(
            [np.tensordot(slopes, shown[:7], 1), shown[7:]]
        )


def least(seen, begin):
    """Of -2 ln posterior without the background's part, from one begin: (rise, field)."""

    def root(field):
        return np.concatenate([(products(field)[0] - seen) / NOISE, field / SIGMA[:4]])

    found = optimize.least_squares(root, begin, bounds=(-WIDE[:4], WIDE[:4]))
    return 2 * found.cost, found.x
