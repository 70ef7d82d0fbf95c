"""The error of a fast sum at one pillar at a time: in the middle of a lens, at its
sides and in its corners.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.dose import sampled
from layout.dose.assign import Ladder
from layout.dose.bodies import NONE, Body
from layout.dose.drawn import Discs
from layout.dose.exposure import CLEARS, PointExposure, disc, rim_of_own_disc

PITCH, SHAPE = 0.37, (17, 21)
DIAMETER, GOAL, OWN = (
    np.array([0.0, 0.19, 0.27]),
    np.array([1.0, 0.93, 1.12]),
    np.array([0.0, 0.33, 0.41]),
)
POINT = PointExposure(np.array([0.05, 1.9]), np.array([0.7, 0.3]))
DOSES = np.array([0.9, 1.3])
RNG = np.random.default_rng(4)
SITES = RNG.integers(0, 3, SHAPE).astype(np.uint8)
CLASS = np.where(SITES > 0, RNG.integers(0, 2, SHAPE), NONE).astype(np.uint8)


@pytest.mark.parametrize(
    "site", [(8, 10), (1, 12), (15, 9), (7, 2), (9, 19), (0, 0), (16, 20)]
)
def test_discs_within_five_sites_to_either_side_are_exact(monkeypatch, site):
    """The wide Gaussian reaches them all: by loops over rows and columns from 5 before
    to 5 behind.
    """
    row, column = site
    sites, chosen = SITES.copy(), CLASS.copy()
    sites[site], chosen[site] = 2, 1
    for step in range(1, 7):  # nothing is empty along the four ways out
        for i, j in (
            (row + step, column),
            (row - step, column),
            (row, column + step),
            (row, column - step),
        ):
            if 0 <= i < SHAPE[0] and 0 <= j < SHAPE[1]:
                sites[i, j], chosen[i, j] = 1, 0
    lens = Body(*SHAPE, PITCH, 2.0, 5.0, lambda first, end: sites[first:end])
    monkeypatch.setattr(
        sampled,
        "classes",
        lambda fields, number, first, block, steps: chosen[first : first + len(block)],
    )
    monkeypatch.setattr(
        sampled, "_some", lambda body, samples: (np.array([row]), np.array([column]))
    )
    monkeypatch.setattr(sampled, "_distant", lambda *_: np.array([0.013]))
    fields = SimpleNamespace(
        bodies=[lens], table=SimpleNamespace(drawn=Discs(DIAMETER), goal=GOAL, own=OWN),
        at=lambda *asked: {("far", 0, row, 1, "near"): np.full((1, SHAPE[1]), 0.071)}[asked],
    )  # fmt: skip
    found = SimpleNamespace(far="far", near="near")
    got = sampled.sampled_error(fields, Ladder(DOSES), found, point=POINT, samples=1)
    turn, exact = 2 * np.pi * (np.arange(24) + 0.5) / 24, 0.013
    for width, weight in zip(POINT.widths_um, POINT.weights, strict=True):
        exact += weight * DOSES[1] * rim_of_own_disc(DIAMETER[2], width)
        for i in range(max(row - 5, 0), min(row + 6, SHAPE[0])):
            for j in range(max(column - 5, 0), min(column + 6, SHAPE[1])):
                if sites[i, j] and (i, j) != site:
                    y, x = (i - row) * PITCH, (j - column) * PITCH
                    away = np.hypot(
                        x - DIAMETER[2] / 2 * np.cos(turn),
                        y - DIAMETER[2] / 2 * np.sin(turn),
                    )
                    exact += (
                        weight
                        * DOSES[chosen[i, j]]
                        * disc(away, DIAMETER[sites[i, j]], width).mean()
                    )
    assert got == pytest.approx(
        abs(DOSES[1] * OWN[2] + 0.071 - exact) / (CLEARS * GOAL[2]), rel=1e-9
    )


def test_a_shape_by_itself_is_exposed_once_however_many_of_its_pillars_are_looked_at(
    monkeypatch,
):
    asked = []

    class Counted(Discs):
        def edges(self, used, point):
            asked.append(used)
            return super().edges(used, point)

    lens = Body(*SHAPE, PITCH, 2.0, 5.0, lambda first, end: SITES[first:end])
    rows, columns = (v[:40] for v in np.nonzero(SITES))
    monkeypatch.setattr(
        sampled,
        "classes",
        lambda fields, number, first, block, steps: CLASS[first:][: len(block)],
    )
    monkeypatch.setattr(sampled, "_some", lambda body, samples: (rows, columns))
    monkeypatch.setattr(sampled, "_distant", lambda *_: np.zeros(40))
    fields = SimpleNamespace(
        bodies=[lens], table=SimpleNamespace(drawn=Counted(DIAMETER), goal=GOAL, own=OWN),
        at=lambda *_: np.zeros((1, SHAPE[1])),
    )  # fmt: skip
    sampled.sampled_error(
        fields, Ladder(DOSES), SimpleNamespace(far=0, near=0), point=POINT, samples=40
    )
    assert np.sum(asked, axis=0).tolist() == [0, 1, 1]
