"""The basis of a spread is the smallest that keeps what it says, found anew from the eigenvalues of all overlaps."""

import numpy as np
import pytest

from layout.study import focus
from layout.study.spread_model import reduce
from metalens.made import Spread, draws, transmission
from tests.layout.study.test_tolerance import PROXY, SENS, hyperbolic

KEPT = 3e-4  # of the variation of t, in amplitude: lenses drawn anew then miss 2e-3 of theirs
DRAWN = 160


def overlaps(lens, spread, seed):
    """(draws, draws) sums over the pillars of one curve t(D) times another, each at a place of its own in the lens."""
    every = lens.diameters.diameter_um
    size, count = np.unique(np.rint(every[every > 0] / 5e-5), return_counts=True)
    rng, curves = np.random.default_rng(seed), []
    far, angle = np.sqrt(rng.uniform(0, 1, DRAWN)), 2 * np.pi * rng.uniform(0, 1, DRAWN)
    for draw, r, phi in zip(draws(spread, DRAWN, seed=seed), far, angle, strict=True):
        a = draw.amounts
        bias_nm = a["bias_nm"] + a["gradient_nm"] / 2 * r * np.cos(phi - draw.turn_rad) + a["bow_nm"] * (r**2 - 0.5)
        d = size * 5e-5 + bias_nm * 1e-3
        height, index, wall = SENS.at(d)
        change = height * a["height_nm"] * 1e-3 + index * a["index"] + wall * np.deg2rad(a["sidewall_deg"])
        curves.append(transmission(PROXY, SENS, d, 0.85, np.zeros(3)) * np.exp(change))
    return (np.array(curves) * count) @ np.conj(curves).T


@pytest.mark.parametrize("scale", [0.2, 0.5, 1.0, 1.7])
def test_no_fewer_functions_would_keep_the_variation_and_no_more_are_taken(scale):
    lens, seed = hyperbolic(), 5
    spread = Spread(**{name: scale * value for name, value in Spread().values().items()})
    where = focus.Window(np.linspace(-2, 3, 3), np.linspace(-1, 4, 3), 150.0, 0.85, np.array([1500.0]))
    rank = len(reduce(lens, SENS, focus.prepare(lens, where), spread, seed=seed).basis)
    power = np.linalg.eigvalsh(overlaps(lens, spread, seed))[::-1]
    left = np.sqrt(np.maximum(np.r_[power.sum(), power.sum() - np.cumsum(power)], 0) / power.sum())
    assert left[rank] <= KEPT < left[rank - 1]
