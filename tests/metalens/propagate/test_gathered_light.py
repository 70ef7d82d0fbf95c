"""Light gathered at the nodes of blocks, and gradients given back to the pillars: the
sums as they are defined.
"""

import numpy as np
import pytest

from metalens.propagate import compiled, pillars

ROWS, COLUMNS, NODES, LENGTH, CHUNK = 13, 11, 7, 5, 4
BASES = (
    np.array([0, 5, 8]),
    np.array([0, 5, 6]),
)  # the last blocks begin earlier, so that they end within the lens
FIRST = 1  # of the block rows that are taken
SITES = [(i, j) for i in range(FIRST * LENGTH, ROWS) for j in range(COLUMNS)]
ORDERS = {np.float32: 5, np.float64: 9}
CLOSE = {np.float32: 2e-5, np.float64: 1e-12}  # of sums of 88 numbers below 3


class Case:
    """Phases of many turns, a carrier that is a polynomial along the rows of a block;
    one tile is dark, and the levels
    of another add up to 0."""

    def __init__(self, kind):
        rng = np.random.default_rng(31)
        self.phase = rng.uniform(-40, 40, (ROWS, COLUMNS)).astype(kind)
        self.level = rng.uniform(0.2, 1.0, (ROWS, COLUMNS)).astype(kind)
        self.level[2 * LENGTH :, :CHUNK] = 0
        self.level[LENGTH : 2 * LENGTH, CHUNK : 2 * CHUNK] = (-1.0) ** np.arange(
            CHUNK
        ) / 2  # of sum 0, and not dark
        self.table = (rng.uniform(-1, 1, (2, 3, ORDERS[kind], CHUNK)) / 2).astype(kind)
        self.u = np.linspace(-0.9, 0.8, LENGTH).astype(kind)
        self.shares = rng.normal(size=(2, NODES, LENGTH)).astype(kind)
        self.grad = rng.normal(size=(2 * NODES, 2, 3 * NODES)).astype(kind)
        self.given = (
            self.phase,
            self.level,
            self.table,
            self.u,
            tuple(self.shares),
            BASES,
            FIRST,
        )

    def phasor(self, i, j):
        block, chunk = i // LENGTH, j // CHUNK
        u = float(self.u[i - BASES[0][block]])
        series = self.table[block - FIRST, chunk, :, j % CHUNK].astype(float)
        turns = float(self.phase[i, j]) / (2 * np.pi) + sum(
            c * u**n for n, c in enumerate(series)
        )
        return np.exp(2j * np.pi * turns)

    def weights(self, i, j):
        """(2 nodes, 3 nodes) shares of a pillar in all nodes."""
        down, across = np.zeros(2 * NODES), np.zeros(3 * NODES)
        a, b = i // LENGTH, j // LENGTH
        down[(a - FIRST) * NODES : (a - FIRST + 1) * NODES] = self.shares[0][
            :, i - BASES[0][a]
        ]
        across[b * NODES : (b + 1) * NODES] = self.shares[1][:, j - BASES[1][b]]
        return np.outer(down, across)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_light_is_gathered_by_the_shares_of_every_node(kind):
    case, out = (
        Case(kind),
        np.full((2 * NODES, 2, 3 * NODES), 0.25, kind),
    )  # what is there is added to
    power = compiled.grid_pillars(*case.given, out)
    want = sum(
        case.weights(i, j) * float(case.level[i, j]) * case.phasor(i, j)
        for i, j in SITES
    )
    assert out[:, 0] - 0.25 == pytest.approx(want.real, abs=CLOSE[kind])
    assert out[:, 1] - 0.25 == pytest.approx(want.imag, abs=CLOSE[kind])
    assert power == pytest.approx(
        (case.level[FIRST * LENGTH :].astype(float) ** 2).sum(), rel=1e-6
    )


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("asked", ["phase", "level", "both"])
def test_gradients_are_the_adjoint_of_gathering(kind, asked):
    """d/dphase and d/dlevel of Σ grad · light; of a dark tile a phase tells nothing."""
    case, nothing = Case(kind), np.empty((0, 0), kind)
    phase, level = (
        np.full((ROWS, COLUMNS), 7.0, kind) if asked in (one, "both") else nothing
        for one in ("phase", "level")
    )
    compiled.interpolate_to_pillars(*case.given, case.grad, phase, level)
    for one in (phase, level):
        assert (one[: FIRST * LENGTH] == 7).all()
    for i, j in SITES:
        re, im = ((case.weights(i, j) * case.grad[:, k]).sum() for k in range(2))
        c, s = case.phasor(i, j).real, case.phasor(i, j).imag
        if phase.size:
            assert phase[i, j] == pytest.approx(
                float(case.level[i, j]) * (im * c - re * s), abs=CLOSE[kind]
            )
        if level.size:
            assert level[i, j] == pytest.approx(re * c + im * s, abs=CLOSE[kind])


def test_a_phase_that_is_no_number_is_told_where_nothing_is_lit():
    case = Case(np.float64)
    case.phase[11, CHUNK - 1] = np.nan
    assert np.isnan(
        compiled.grid_pillars(*case.given, np.zeros((2 * NODES, 2, 3 * NODES)))
    )


def _grid_shares():
    """(300 nodes, 90) shares of an even grid: seven neighbours of each node, 0
    elsewhere.
    """
    place, grid = np.linspace(4.0, 85.0, 300)[:, None], np.arange(90)
    return np.where(np.abs(place - grid) < 3.5, np.cos(0.4 * (place - grid)), 0.0)


def test_bands_hold_every_share_and_leave_zeros_out():
    """All but zeros of an even grid; one band where shares are dense. A band one moment
    short on either side would
    lose some."""
    weights = _grid_shares()
    bands, held = pillars._bands(weights), np.zeros_like(weights)
    for at, to in bands:
        held[at, to] = weights[at, to]
    np.testing.assert_array_equal(held, weights)
    assert [at.stop - at.start for at, _ in bands] == [128, 128, 44]
    assert (
        sum((at.stop - at.start) * (to.stop - to.start) for at, to in bands)
        < 0.5 * weights.size
    )
    assert pillars._bands(weights + 1) == [(slice(0, 300), slice(0, 90))]


def test_bands_of_a_panel_are_cut_to_its_nodes():
    bands = [
        (slice(0, 128), slice(0, 40)),
        (slice(128, 256), slice(30, 80)),
        (slice(256, 300), slice(70, 90)),
    ]
    assert pillars._in(bands, 100, 256) == [
        (slice(100, 128), slice(0, 40)),
        (slice(128, 256), slice(30, 80)),
    ]
