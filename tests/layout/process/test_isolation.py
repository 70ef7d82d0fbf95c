"""How alone a pillar stands, by the plain sum over its neighbours."""

import math

import numpy as np
import pytest

from layout.process.isolation import isolation_map


def test_isolation_on_a_hexagonal_lattice_is_the_share_of_its_own_neighbours():
    """Weights by plain distances from site to site: no rows and columns, half the
    places hold none.
    """
    pitch, row, reach = 0.43, 0.37, 0.52
    rng = np.random.default_rng(11)
    rows, columns = 41, 117  # wider than one tile of 96
    site = (np.arange(rows)[:, None] + np.arange(columns)) % 2 == 0
    present = site & (rng.uniform(size=site.shape) > 0.3)
    present[20, 56] = present[40, 116] = True
    y, x = np.nonzero(np.ones_like(present))
    got = isolation_map(present, (pitch / 2, row), reach, centred=True)
    full = [
        (i * pitch / 2, j * row)
        for i in range(-40, 41)
        for j in range(-40, 41)
        if (i + j) % 2 == 0 and (i or j)
    ]
    whole = sum(math.exp(-(a * a + b * b) / reach**2) for a, b in full)
    for j, i in ((20, 56), (40, 116), (3, 5), (17, 97)):
        weight = np.exp(-(((x - i) * pitch / 2) ** 2 + ((y - j) * row) ** 2) / reach**2)
        stood = weight[present[y, x] & ((x != i) | (y != j))].sum()
        # float32; 3 ranges along each axis leave erfc(3) = 2e-5 of a Gaussian's weight
        # out, about twice that of a plane
        assert got[j, i] == pytest.approx(1 - stood / whole, abs=1e-4)
    assert (
        isolation_map(site, (pitch / 2, row), reach, centred=True)[10:-10, 10:-10][
            site[10:-10, 10:-10]
        ].max()
        < 1e-5
    )


def test_rows_of_a_rectangular_lattice_count_by_their_own_distance():
    present = np.zeros((21, 21), bool)
    present[10, 10] = present[11, 10] = True  # one neighbour, 0.7 um along y
    far = [(0.3 * i, 0.7 * j) for i in range(-9, 10) for j in range(-4, 5) if i or j]
    weights = [np.exp(-(x * x + y * y) / 0.9**2) for x, y in far]
    want = 1 - np.exp(-((0.7 / 0.9) ** 2)) / sum(weights)
    assert isolation_map(present, (0.3, 0.7), 0.9)[10, 10] == pytest.approx(
        want, abs=1e-5
    )
