"""The error of factors held at a window's middle: every pixel's own factors, by sums
over the nodes of the lens.
"""

from dataclasses import replace

import numpy as np
import pytest

from metalens.core import legendre
from metalens.propagate import PropagationCase, estimate
from metalens.propagate.estimate import ErrorSample

CASE = PropagationCase(
    (30, 41),
    0.37,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900, 1 / 2500),
    (14.0, -8.5),
    0.6,
    (3, 4),
)
CASES = [  # sixteen pixels: all are looked at
    replace(CASE, samples=samples, centre_um=centre)
    for samples, centre in (
        ((2, 3), (14.0, -8.5)),
        ((1, 4), (15.5, -8.1)),
        ((4, 1), (12.1, -7.7)),
        ((2, 1), (14.7, -9.9)),
    )
]
SIGNS = np.array([1.0, -1.0, 0.5])


def factors(case):
    """Three components of two maps, quadratic over the lens, that turn with where the
    window lies.
    """
    cx, cy = (c / 40 for c in case.centre_um)

    def on(e, x):
        y, x = e[:, None] / 6, x / 8
        one = [1 + cx * x - 0.3 * y**2, 0.4 * cy + 0.2 * x * y, 0.7 - cx * y]
        other = [0.3 * cx * x**2, 1 - cy * y, cx * cy + 0.5 * x]
        return SIGNS, np.array(
            [[a + 0 * x * y, b + 0 * x * y] for a, b in zip(one, other, strict=True)]
        )

    return on


def sample(case, orders, weight, seed, *, held=True):
    """Light of two maps on nodes of the lens; of one, a scalar, where no factors are
    held.
    """
    rng = np.random.default_rng(seed)
    shape = (2, *orders) if held else orders
    hy, hx = case.half_size_um
    places = (
        legendre.gauss_legendre_nodes(orders[0])[0] * hy,
        legendre.gauss_legendre_nodes(orders[1])[0] * hx,
    )
    pupils = factors(case)(*places) if held else None
    return ErrorSample(
        case,
        weight,
        rng.normal(size=shape) + 1j * rng.normal(size=shape),
        0.0,
        1,
        places,
        pupils,
    )


def by_sums(windows, seen, depths):
    """1.7 sqrt(Σ (δ/S - (I/S) Σδ/S)² / Σ (I/S)²), δ of each pixel from the light of a
    lens with its own factors.
    """
    changed = []
    for samples in windows:
        rows, columns = samples[0].case.samples
        part = np.zeros((len(depths), rows, columns))
        for row, column in np.ndindex(rows, columns):
            at = np.array([row]), np.array([column])
            for s in samples:
                x, y = s.case.centre_um
                place = (
                    x + (column - (columns - 1) / 2) * 0.6,
                    y + (row - (rows - 1) / 2) * 0.6,
                )
                own = held = 0.0
                for centre in (place, (x, y)):
                    signs, table = factors(replace(s.case, centre_um=centre))(
                        *s.nodes_um
                    )
                    if (
                        s.pupils is None
                    ):  # its one map is both maps of the factors' sum: factors of the first alone
                        table = table[:, :1]
                    alone = [
                        estimate._direct(
                            replace(s, moments=(f * s.moments).sum(0), pupils=None),
                            depths,
                            at,
                        )[0, :, 0]
                        for f in table
                    ]
                    power = sum(
                        sign * np.abs(u) ** 2
                        for sign, u in zip(signs, alone, strict=True)
                    )
                    own, held = (power, held) if centre == place else (own, power)
                if s.pupils is None:
                    held = np.abs(estimate._direct(s, depths, at)[0, :, 0]) ** 2
                part[:, row, column] += s.weight * (own - held)
        changed.append(part.reshape(len(depths), -1))
    light = np.concatenate([s[depths].reshape(len(depths), -1) for s in seen], 1)
    energy = light.sum(1, keepdims=True)
    share, delta = light / energy, np.concatenate(changed, 1) / energy
    return 1.7 * np.sqrt(
        ((delta - share * delta.sum(1, keepdims=True)) ** 2).sum() / (share**2).sum()
    )


@pytest.mark.parametrize("orders", [(5, 6), (14, 15)])
def test_every_pixel_is_seen_with_factors_of_its_own(orders):
    """Four windows of two wavelengths, of three depths the outer two; factors of degree
    2 are exact on twelve nodes.
    """
    windows = [
        [
            sample(case, orders, 0.7, 2 * n),
            sample(replace(case, wavelength_um=0.53), orders, 0.4, 2 * n + 1),
        ]
        for n, case in enumerate(CASES)
    ]
    rng = np.random.default_rng(5)
    seen = [rng.uniform(0.5, 2.0, (3, *case.samples)) for case in CASES]
    got = estimate.pupil_error(windows, seen, factors)
    assert got == pytest.approx(by_sums(windows, seen, np.array([0, 2])), rel=1e-8)


def one_map(case):
    """Factors of a scalar: those of the first map."""
    inner = factors(case)
    return lambda e, x: (SIGNS, inner(e, x)[1][:, :1])


def test_a_scalar_is_held_as_its_square_and_many_nodes_are_judged_at_one_depth(
    monkeypatch,
):
    one, other = (
        replace(CASE, samples=(2, 3)),
        replace(CASE, samples=(1, 2)),
    )  # eight pixels, all looked at
    alone = [
        [sample(one, (5, 6), 0.7, 6, held=False)],
        [sample(other, (4, 5), 0.7, 7, held=False)],
    ]
    rng = np.random.default_rng(7)
    seen = [rng.uniform(0.5, 2.0, (3, 2, 3)), rng.uniform(0.5, 2.0, (3, 1, 2))]
    for depths, work in (([0, 2], 30 * 8 * 8), ([0], 30 * 8 * 8 - 1)):
        monkeypatch.setattr(estimate, "WORK", work)
        got = estimate.pupil_error(alone, seen, one_map)
        assert got == pytest.approx(by_sums(alone, seen, np.array(depths)), rel=1e-8)


def test_of_few_pixels_half_of_the_plain_part_is_left(monkeypatch):
    """Light that changes as it lies is no error of a normalised one; its 8 or 16 points
    tell it only by chance.
    """
    wide = replace(CASE, samples=(9, 11))
    light = np.random.default_rng(8).uniform(0.5, 2.0, (3, 9, 11))
    windows = [[sample(wide, (5, 6), 1.0, 9)]]
    monkeypatch.setattr(
        estimate,
        "_changed",
        lambda s, given, at, pupils: 0.1 * light[at[0], int(at[1]), int(at[2])],
    )
    got = estimate.pupil_error(windows, [light], factors)
    share, energy, _, points, chance = estimate._looked_at(windows, [light], (16, 2))
    assert points.shape == (2, 16)
    plain = ((0.1 * np.take_along_axis(share, points, 1)) ** 2 / chance).mean(1).sum()
    assert got == pytest.approx(1.7 * np.sqrt(0.5 * plain / (share**2).sum()), rel=1e-9)
    assert energy == pytest.approx(light[[0, 2]].sum((1, 2)))


def test_factors_are_formed_on_twelve_nodes_where_the_lens_has_more():
    """Shares of a node are Lagrange's: places are given back, and a polynomial of
    degree 11 at each of them.
    """
    few = np.array([-3.0, 1.0, 2.5])
    for places in (few, np.full(20, 4.0)):
        nodes, shares = estimate._coarse(places)
        assert nodes is places
        assert np.array_equal(shares, np.eye(len(places)))
    places = np.linspace(-7.0, 31.0, 40)
    nodes, shares = estimate._coarse(places)
    assert nodes.shape == (12,)
    assert shares.shape == (12, 40)
    series = np.polynomial.Polynomial(
        np.random.default_rng(3).normal(size=12), domain=(-7, 31)
    )
    assert series(nodes) @ shares == pytest.approx(series(places), abs=1e-9)
