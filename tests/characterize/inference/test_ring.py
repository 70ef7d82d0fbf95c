"""A posterior that closes to a ring: bias and its gradient seen through their product
and the difference of squares.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b
from pictured import Pictured

from characterize.inference import explore, leastsquares, search
from characterize.inference.leastsquares import GaussianPrior
from characterize.model import PLACE

NAMED = ("bias_nm", "bias_y_nm", "background_e")
RNG = np.random.default_rng(8)
BRIGHT = RNG.uniform(3, 9, (5, 4, 3))
PICTURES = np.linalg.qr(RNG.standard_normal((60, 3)))[0].T.reshape(
    3, 5, 4, 3
)  # of unit length, at right angles
PRODUCT, SQUARES, NOISE = 0.043, 0.013, 0.4
PRIOR = GaussianPrior(
    np.array([1.7, 0.0, 0.0]),
    np.array([15.0, np.inf, np.inf]),
    np.full(3, -40.0),
    np.full(3, 40.0),
)


class Ring(Pictured):
    """(b + ig)², its parts on two pictures: two lenses alike, (b, g) and (-b, -g), with
    a ring between them.
    """

    def images(self, x, names=None):
        bias, g, level = (x[PLACE[name]] for name in NAMED)
        one, two, three = PICTURES[:, self.index]
        image = (
            BRIGHT[self.index]
            + PRODUCT * bias * g * one
            + SQUARES * (bias**2 - g**2) * two
            + level * three
        )
        slopes = (
            PRODUCT * g * one + 2 * SQUARES * bias * two,
            PRODUCT * bias * one - 2 * SQUARES * g * two,
            three,
        )
        return self.seen * image, None if names is None else self.seen * np.stack(
            slopes
        )


def rise(b, g, seen):
    """-2 ln posterior less the background's part, which is fitted whatever the others
    are.
    """
    parts = (PRODUCT * b * g - seen[0]) ** 2 + (
        SQUARES * (b * b - g * g) - seen[1]
    ) ** 2
    return parts / NOISE**2 + ((b - PRIOR.mean[0]) / PRIOR.sigma[0]) ** 2


def fitted(seen, begin):
    """The task of frames that show ``seen`` on the first two pictures, and a fit from
    one side of the ring.
    """
    frames = BRIGHT + seen[0] * PICTURES[0] + seen[1] * PICTURES[1] + 1.3 * PICTURES[2]
    about = b.given(Ring(), frames, NOISE, NAMED, PRIOR)
    return about, leastsquares.fit_levenberg_marquardt(
        about.problem(), about.data, np.array(begin), prior=PRIOR
    )


@pytest.mark.parametrize("seen", [(0.55, 0.2), (0.62, -0.2)])
def test_ends_on_a_ring_are_those_of_the_least_over_a_grid(seen):
    """The gradient's ends lie far from where any walk of the bias stops; the least over
    a fine grid is the profile.

    A search ends within a quarter of a sigma and goes on by its slopes; the noise is
    held, and alike.
    """
    about, mode = fitted(seen, (4.0, 5.0, 0.0))
    found = explore.explore_posterior(about, [mode])

    fine = np.linspace(-25, 25, 2501)
    whole = rise(*np.meshgrid(fine, fine, indexing="ij"), seen)
    for name, low, high, axis in zip(
        NAMED, found.low, found.high, (1, 0), strict=False
    ):
        curve = whole.min(axis) - whole.min()
        ends = fine[curve < 3.8415][[0, -1]]
        room = 0.02 * np.ptp(ends)
        assert low < ends[0] + room, name
        assert high > ends[1] - room, name
    followed = found.profiles["bias_y_nm"]
    assert (followed.low, followed.high) == pytest.approx(tuple(ends), abs=room)
    assert not followed.parabolic


@pytest.mark.parametrize("begin", [(4.0, 5.0, 0.0), (-2.0, 6.5, 0.0)])
@pytest.mark.parametrize(
    "seen",
    [(0.05, 0.02), (0.55, 0.2), (0.3, -0.7), (-0.9, 0.4), (-0.2, 1.1), (0.1, -1.3)],
)
def test_intervals_on_a_ring_are_those_of_the_grid_wherever_the_fit_began(seen, begin):
    """Neither end reaches farther nor less far, whether valleys are one ring, a bent
    one or two: 5 % of the width, of
    which steps between points of the grid are 0.2 %."""
    about, mode = fitted(seen, begin)
    found = explore.explore_posterior(about, search.add_mirrored_starts(about, [mode]))
    fine = np.linspace(-30, 30, 3001)
    whole = rise(*np.meshgrid(fine, fine, indexing="ij"), seen)
    for name, low, high, axis in zip(
        NAMED, found.low, found.high, (1, 0), strict=False
    ):
        ends = fine[whole.min(axis) - whole.min() < 3.8415][[0, -1]]
        assert (low, high) == pytest.approx(tuple(ends), abs=0.05 * np.ptp(ends)), name
