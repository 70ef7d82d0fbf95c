"""Classes of two lattices and three pieces of marks: every number by plain sums over
pillars, pieces and nodes.
"""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from layout.dose.assign import Fields, Ladder, assign, classes, ladder
from layout.dose.bodies import NONE, Body, Ranges, Rects, Table
from layout.dose.exposure import CLEARS, PointExposure
from layout.dose.nodes import Grid, convolution
from layout.process.process import Exposure

OWN = np.array([0.0, 0.31, 0.44, 0.37, 0.29])
AREA = np.array([0.0, 0.021, 0.034, 0.017, 0.0])
GOAL = np.array([1.0, 1.0, 0.93, 1.04, 0.2])
SLOPE = np.array([0.0, 46.0, 62.0, 34.0, 0.0])
COUNT = np.array([0, 1, 1, 1, 0])  # entry 4 does not occur
FAR, BESIDE = (
    PointExposure(np.array([2.4]), np.array([0.09])),
    PointExposure(np.array([0.35]), np.array([0.004])),
)
PLANES = {"far": (0.11, 0.006, -0.009), "alone": (0.2, -0.008, 0.011)}
FACTORS = 0.83 * 1.11 ** np.arange(5)
RECTS = Rects(
    np.array([[-2.0, -3.0, -1.4, -2.1], [3.0, -3.2, 4.1, -2.9], [0.2, 2.9, 0.7, 3.6]]),
    np.arange(3), np.array([1.0, 0.95, 1.07]),
)  # fmt: skip
OWN_RECTS = np.array([0.41, 0.33, 0.38])
POINTS = np.array([[-1.4, -2.5], [-2.0, -2.6], [3.5, -3.2], [0.7, 3.1]])
PIECE = np.array([0, 0, 1, 2])
SPOTS = (
    np.array([[-1.7, -2.5], [3.3, -3.0], [3.8, -3.1], [0.45, 3.25]]),
    np.array([0.54, 0.17, 0.16, 0.35]),
)
SPOT_OF = np.array([0, 1, 1, 2])


def plane(name, x, y):
    a, b, c = PLANES[name]
    return a + b * x + c * y


def lattices():
    draw = np.random.default_rng(5)
    found = []
    for shape, more in (((4, 6), {"pitch_um": 0.37, "x_um": -0.9, "y_um": 1.1}),
                        ((3, 5), {"pitch_um": 0.53, "row_um": 0.41, "x_um": 1.8, "y_um": -0.6})):  # fmt: skip
        index = draw.integers(0, 4, shape)
        index[0, :4] = 0, 1, 2, 3
        found.append(
            (
                index,
                Body(
                    *shape,
                    source=lambda first, end, index=index: index[first:end],
                    **more,
                ),
            )
        )
    return found


def made(**changes):
    """Backgrounds are planes, which interpolation on nodes keeps; at the far nodes,
    which nothing reaches, far from
    what the doses give."""
    both, draw = lattices(), np.random.default_rng(8)
    grid = Grid.over((-2.0, -3.2, 4.1, 3.6), 2.4)
    x, y = (a.origin_um + a.spacing_um * np.arange(a.count) for a in (grid.x, grid.y))
    far, alone = (plane(name, x, y[:, None]) for name in ("far", "alone"))
    far[-1], alone[-1] = (
        7.0,
        1e-4,
    )  # light is dark there: whatever it is, no edge sees it
    fields = {
        "bodies": [body for _, body in both],
        "table": Table(SimpleNamespace(), AREA, GOAL, OWN, SLOPE, COUNT),
        "ranges": Ranges(
            FAR, BESIDE, PointExposure(np.array([0.03, 0.1]), np.array([0.7, 0.2]))
        ),
        "grid": grid,
        "reach": convolution(
            grid.shape, (grid.y.spacing_um, grid.x.spacing_um), point=FAR, hollow=False
        ),
        "middles": [
            convolution(i.shape, (b.down_um, b.pitch_um), point=BESIDE, hollow=True)
            for i, b in both
        ],
        "far": far,
        "alone": alone,
        "near": [draw.uniform(0.0, 0.02, i.shape).astype(np.float32) for i, _ in both],
        "near_alone": [
            draw.uniform(0.0, 0.03, i.shape).astype(np.float32) for i, _ in both
        ],
        "rects": RECTS,
        "own": OWN_RECTS,
        "points": POINTS,
        "piece": PIECE,
        "spots": (*SPOTS, SPOT_OF),
    } | changes
    return Fields(**fields)


def pillars(fields):
    """(body, row, column, entry, x, y) of each."""
    for number, (index, body) in enumerate(lattices()):
        for row, column in zip(*np.nonzero(index), strict=True):
            x, y = body.x_um + column * body.pitch_um, body.y_um - row * body.down_um
            yield number, row, column, index[row, column], x, y


def backgrounds(fields):
    """Of each pillar with the doses and with dose 1, and (pieces,) the mean over their
    edges.
    """
    lit = [(plane("far", x, y) + fields.near[n][r, c], plane("alone", x, y) + fields.near_alone[n][r, c])
           for n, r, c, _, x, y in pillars(fields)]  # fmt: skip
    pads = [
        np.mean(
            [plane("far", *p) for p, of in zip(POINTS, PIECE, strict=True) if of == n]
        )
        for n in range(3)
    ]
    return np.array(lit), np.array(pads)


def nearest(dose):
    return [int(np.argmin(np.abs(np.log(FACTORS / d)))) for d in dose]


def given(fields):
    """What each pillar and piece gets: (class of pillars, class of pieces)."""
    lit, pads = backgrounds(fields)
    wanted = [
        (CLEARS * GOAL[k] - b) / OWN[k]
        for (_, _, _, k, _, _), b in zip(pillars(fields), lit[:, 0], strict=True)
    ]
    return nearest(wanted), nearest((CLEARS * RECTS.goal - pads) / fields.own)


def gaussian(r2, point):
    (width,), (weight,) = point.widths_um, point.weights
    return weight / (math.pi * width**2) * np.exp(-r2 / width**2)


def moved(fields):
    """By how much backgrounds change with the classes, at most: over nodes that see
    light, plus over pillars.
    """
    chosen, pads = given(fields)
    every = [
        (x, y, FACTORS[c] * AREA[k])
        for (_, _, _, k, x, y), c in zip(pillars(fields), chosen, strict=True)
    ]
    every += [
        (*at, FACTORS[pads[of]] * a) for at, a, of in zip(*SPOTS, SPOT_OF, strict=True)
    ]
    x, y = (
        a.origin_um + a.spacing_um * np.arange(a.count)
        for a in (fields.grid.x, fields.grid.y)
    )
    after = sum(
        m * gaussian((x - u) ** 2 + (y[:, None] - v) ** 2, FAR) for u, v, m in every
    )
    far = float(np.abs(after - fields.far)[:-1].max())
    here, apart = list(zip(pillars(fields), chosen, strict=True)), []
    for (n, r, c, _, x, y), _ in here:
        others = [
            (u, v, FACTORS[o] * AREA[k])
            for (m, i, j, k, u, v), o in here
            if m == n and (i, j) != (r, c)
        ]
        own = sum(
            mass * gaussian((x - u) ** 2 + (y - v) ** 2, BESIDE)
            for u, v, mass in others
        )
        apart.append(abs(own - fields.near[n][r, c]))
    return after, (far + max(apart)) / (CLEARS * 0.93)


def test_pillars_have_the_class_of_the_nearest_ratio_and_empty_sites_none():
    fields = made()
    chosen = iter(given(fields)[0])
    for number, (index, _) in enumerate(lattices()):
        want = np.full(index.shape, NONE)
        for at in zip(*np.nonzero(index), strict=True):
            want[at] = next(chosen)
        found = [
            classes(fields, number, first, index[first : first + 2], Ladder(FACTORS))
            for first in (0, 2)
        ]
        assert np.concatenate(found).tolist() == want.tolist()


@pytest.mark.parametrize("worst", [0, 1, 2], ids=["lens", "others", "pieces"])
def test_counts_errors_and_backgrounds_are_those_of_plain_sums(worst):
    """Backgrounds of some hundredths are interpolated on nodes to 1e-4 of themselves.
    The worst of all lies where so
    much light is that the least dose is too much: at a pillar of either lattice, or at
    pieces."""
    fields = made(own=OWN_RECTS * (1.4 if worst == 2 else 1.0))
    if worst < 2:
        fields.near[worst][0, 2] += 0.2
    pairs, own_class, found = assign(fields, Ladder(FACTORS))
    chosen, pads = given(fields)
    want = np.zeros((5, 5), int)
    for (_, _, _, k, _, _), c in zip(pillars(fields), chosen, strict=True):
        want[k, c] += 1
    assert pairs.tolist() == want.tolist()
    assert own_class.tolist() == pads

    after, shift = moved(fields)
    assert found.far == pytest.approx(after, abs=1e-5)
    lit, _ = backgrounds(fields)
    here = list(pillars(fields))
    errors = [(FACTORS[c] * OWN[k] + b) / (CLEARS * GOAL[k]) - 1
              for (_, _, _, k, _, _), c, b in zip(here, chosen, lit[:, 0], strict=True)]  # fmt: skip
    lens, rest = (
        [e for (n, *_), e in zip(here, errors, strict=True) if (n > 0) is other]
        for other in (False, True)
    )
    edge = [abs((FACTORS[pads[of]] * fields.own[of] + plane("far", *p)) / (CLEARS * RECTS.goal[of]) - 1)
            for p, of in zip(POINTS, PIECE, strict=True)]  # fmt: skip
    largest = [max(map(abs, lens)), max(map(abs, rest)), max(edge)]
    assert found.after.worst == pytest.approx(largest[0] + shift, abs=3e-5)
    assert found.after.rms == pytest.approx(
        math.sqrt(np.mean(np.square(lens))) + shift, abs=3e-5
    )
    # 34 per um the gentlest slope, at the least dose, of what clears; either edge moves
    assert found.after.diameter_nm == pytest.approx(
        2e3 * found.after.worst / (34.0 * FACTORS[0] / CLEARS), rel=1e-9
    )
    assert found.worst == pytest.approx(max(largest) + shift, abs=3e-5)
    assert np.argmax(largest) == worst

    single = [
        (AREA[k], OWN[k] + b)
        for (n, _, _, k, _, _), b in zip(here, lit[:, 1], strict=True)
        if n == 0
    ]
    mean = sum(a * e for a, e in single) / sum(a for a, _ in single)
    off_one = [e / mean - 1 for _, e in single]
    assert found.before.worst == pytest.approx(max(map(abs, off_one)), rel=1e-6)
    assert found.before.rms == pytest.approx(
        math.sqrt(np.mean(np.square(off_one))), rel=1e-6
    )
    assert found.before.diameter_nm == pytest.approx(
        2e3 * found.before.worst / (34.0 / mean), rel=1e-6
    )


@pytest.mark.parametrize(("tolerance", "softest"), [(0.004, 46.0), (0.05, 9.0)])
def test_as_many_doses_as_three_quarters_of_the_tolerance_need(tolerance, softest):
    """The step is halved until a dose in the middle between two is off by three
    quarters of what its own edge allows;
    0.7 nm of width is the least that is asked for."""
    slope = np.array([0.0, softest, 62.0, 34.0, 0.0])
    fields = made(table=Table(SimpleNamespace(), AREA, GOAL, OWN, slope, COUNT))
    lit, pads = backgrounds(fields)
    doses, shares = [], []
    for (_, _, _, k, _, _), b in zip(pillars(fields), lit[:, 0], strict=True):
        doses.append((CLEARS * GOAL[k] - b) / OWN[k])
        allowed = min(tolerance, 0.35e-3 * slope[k] * doses[-1] / (CLEARS * GOAL[k]))
        shares.append(doses[-1] * OWN[k] / (CLEARS * GOAL[k]) / allowed)
    steep = (0.7 / 0.03 + 0.2 / 0.1) / math.sqrt(
        math.pi
    )  # of the edge of a half plane, per um
    for b, own, goal in zip(pads, OWN_RECTS, RECTS.goal, strict=True):
        doses.append((CLEARS * goal - b) / own)
        allowed = min(tolerance, 0.35e-3 * steep * doses[-1] / (CLEARS * goal))
        shares.append(doses[-1] * own / (CLEARS * goal) / allowed)
    enough = next(n for n in itertools.count(1)
                  if (math.exp(math.log(max(doses) / min(doses)) / (2 * n)) - 1) * max(shares) <= 0.75)  # fmt: skip
    steps, needed = ladder(
        fields,
        Exposure(alpha_um=0.03, beta_um=2.4, tolerance=tolerance, maximum_classes=200),
    )
    assert needed == enough
    place = np.log(steps.factors / min(doses)) / math.log(max(doses) / min(doses))
    assert place == pytest.approx((np.arange(needed) + 0.5) / needed, abs=1e-6)
    few, still = ladder(
        fields,
        Exposure(alpha_um=0.03, beta_um=2.4, tolerance=tolerance, maximum_classes=3),
    )
    assert (len(few.factors), still) == (3, needed)
