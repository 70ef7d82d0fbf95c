"""Which pairs of sizes are printed, which are nearest, how much they cover, and their
bars: small stocks by hand.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Rectangle
from metalens.design import Focus, Limits, paired
from metalens.design.sites import sites
from metalens.ground.errors import LensError

rng = np.random.default_rng(12)


def stock(t, error=None, leaked=None, sizes=None):
    """Pairs of these (n, 2) amplitudes, by the constructor of the module."""
    t = np.asarray(t, complex)
    n = len(t)
    jones = np.zeros((1, n, 1, 2, 2), complex)
    jones[0, :, 0, 0, 0], jones[0, :, 0, 1, 1] = t.T
    jones[0, :, 0, 1, 0], jones[0, :, 0, 0, 1] = np.asarray(
        leaked if leaked is not None else np.zeros((n, 2))
    ).T
    library = SimpleNamespace(
        usable=np.ones((1, n, 1), bool), x_um=np.linspace(0.1, 0.2, n) if sizes is None else sizes,
        y_um=np.array([0.15]), t=jones, cell=Cell(0.4, pillar=Index(3.6), shape=Rectangle()),
        t_error=np.asarray(error if error is not None else np.zeros(n), float).reshape(1, n, 1),
    )  # fmt: skip
    return paired._stock(library, 0, Limits(60, 60))


def phasors(degrees, levels=(1.0, 1.0)):
    return np.exp(1j * np.radians(degrees)) * levels


def test_a_stock_holds_what_is_printed_and_within_its_bar_with_what_leaks():
    """Of light along x what leaves along y; squares of amplitudes."""
    made = stock(
        phasors([(10, 50), (20, 60)]),
        error=[0.01, 0.02],
        leaked=[(0.3, 0.1), (0.2j, 0.4)],
    )
    assert made.sizes.tolist() == [[0.1, 0.15], [0.2, 0.15]]
    assert np.degrees(np.angle(made.t)) == pytest.approx(np.array([[10, 50], [20, 60]]))
    assert made.error.tolist() == [0.01, 0.02]
    assert made.leaked == pytest.approx(np.array([[0.09, 0.01], [0.04, 0.16]]))


def test_the_nearest_pair_is_that_of_the_least_sum_of_squares():
    """(1) over all pairs, of amplitudes from 0.3 to 1: dim pillars lie near to no
    phase.
    """
    made = stock(phasors(rng.uniform(0, 360, (40, 2)), rng.uniform(0.3, 1, (40, 2))))
    x, y = rng.uniform(-9, 9, (2, 25))
    away = (
        abs(made.t[:, 0] - np.exp(1j * x[:, None])) ** 2
        + abs(made.t[:, 1] - np.exp(1j * y[:, None])) ** 2
    )
    assert made.nearest(x, y).tolist() == away.argmin(1).tolist()
    tried = np.linspace(0, 2 * math.pi, 24, endpoint=False)

    def peak(a, b):
        t = made.t[made.nearest(x + a, y + b)]
        return (
            abs((t[:, 0] * np.exp(-1j * x)).mean()) ** 2
            + abs((t[:, 1] * np.exp(-1j * y)).mean()) ** 2
        )

    alike = max(((a, a) for a in tried), key=lambda pair: peak(*pair))
    apart = max(((a, b) for a in tried for b in tried), key=lambda pair: peak(*pair))
    assert made.pistons((x, y), alike=True) == pytest.approx(alike, abs=1e-12)
    assert made.pistons((x, y), alike=False) == pytest.approx(apart, abs=1e-12)
    assert peak(*apart) > peak(*alike)


def test_the_bar_of_a_pillar_counts_by_the_light_that_has_less_of_it():
    """√ of the mean over the pillars of (bar / least |t|)²: (3 · (0.02/0.5)² + 5 ·
    (0.03/0.6)²) / 8.
    """
    made = stock(
        phasors([(10, 50), (20, 60), (0, 0)], [(0.5, 0.9), (0.8, 0.6), (1, 1)]),
        error=[0.02, 0.03, 0.5],
    )
    want = math.sqrt((3 * 0.04**2 + 5 * 0.05**2) / 8)
    assert made.entry_error(np.array([3, 5, 0])) == pytest.approx(want, rel=1e-12)


@pytest.mark.parametrize("level", [0.699, 0.701])
@pytest.mark.parametrize(
    ("off", "single", "pair"), [(0, 5, 9), (8.0, 4, 6), (-11.0, 5, 9)]
)
def test_phases_within_a_fifth_of_a_radian_of_a_bright_pillar_are_covered(
    level, off, single, pair
):
    """0.2 rad are 11.46°: of 72 phases every 5°, five about 0 and 355..365 + 8 hold 0,
    5, 10, 15; of pairs of 36 every
    10°, three by three, or two (0 and 10 about 8) by three. Nothing below a level of
    0.7."""
    made = stock(phasors([(off, off)], [(1.0, level)]))
    kept = level > 0.7
    count = sum(abs((k * 5 - off + 180) % 360 - 180) <= 11.459 for k in range(72))
    assert paired._covered(made, True) == pytest.approx(kept * count / 72, abs=1e-12)
    mixed = stock(phasors([(off, 0.0)], [(level, 1.0)]))
    ten = sum(abs((k * 10 - off + 180) % 360 - 180) <= 11.459 for k in range(36))
    assert paired._covered(mixed, False) == pytest.approx(
        kept * ten * 3 / 36**2, abs=1e-12
    )
    assert count in (single, 4, 5)
    assert ten * 3 in (pair, 6, 9)


def library(cell, x, y):
    return SimpleNamespace(cell=cell, x_um=np.asarray(x), y_um=np.asarray(y))


@pytest.mark.parametrize(
    ("turn", "swapped"), [(0.0, False), (math.pi / 2, True), (math.pi, False)]
)
def test_pillars_are_printed_where_their_gaps_and_sizes_are(turn, swapped):
    """A lattice of 0.4 by 0.5 um, gaps of 90 nm and 110 nm of a pillar at least: 0.11
    to 0.31 along x and 0.41 along y,
    of a pillar turned by a quarter the other way round; exactly at either end it is
    printed."""
    lattice = Lattice("rectangular", 1.25)
    cell = Cell(
        0.4, pillar=Index(3.6), lattice=lattice, shape=Rectangle(angle_rad=turn)
    )
    sizes = [0.1099, 0.11, 0.2, 0.31, 0.3101, 0.41, 0.4101]
    found = paired._printable(library(cell, sizes, sizes), Limits(110, 90))
    wide, tall = (0.41, 0.31) if swapped else (0.31, 0.41)
    want = [
        [min(a, b) >= 0.11 and a <= wide and b <= tall for b in sizes] for a in sizes
    ]
    assert found.tolist() == want


def test_of_turned_pillars_the_gap_is_that_of_the_next_larger_pair_of_a_table():
    """Rectangles turned by 30 degrees on a square of 0.45 um: those that are printed
    have the gap themselves, and none
    with a gap larger by what a step of the table changes is left out."""
    cell = Cell(0.45, pillar=Index(3.6), shape=Rectangle(angle_rad=math.pi / 6))
    x, y = np.linspace(0.1, 0.32, 23), np.linspace(0.12, 0.29, 18)
    found = paired._printable(library(cell, x, y), Limits(110, 90))

    def gap(a, b):
        """Least distance of a rectangle to its copies: of corners to sides, both ways
        round.
        """
        c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
        corners = np.array([(a, b), (-a, b), (-a, -b), (a, -b)]) / 2
        least = math.inf
        for i in range(-1, 2):
            for j in range(-1, 2):
                if (i, j) != (0, 0):
                    step = (
                        np.array([c * i + s * j, c * j - s * i]) * 0.45
                    )  # in the axes of the rectangle
                    away = np.maximum(np.abs(corners + step) - (a / 2, b / 2), 0)
                    least = min(least, np.hypot(*away.T).min())
        return least

    gaps = np.array([[gap(a, b) for b in y] for a in x])
    wide = np.minimum(x[:, None], y) >= 0.11 - 1e-9
    assert not (found & (gaps < 0.09 - 1e-6)).any()
    assert found.any()
    assert not found.all()
    step = (
        0.22 / 11 + 0.17 / 11
    )  # what both grow by in a step: no more of the gap than that
    assert (found | (gaps < 0.09 + step) | ~wide).all()
    assert not (found & ~wide).any()
    rows = np.ceil((x - 0.1) / 0.02 - 1e-9) * 0.02 + 0.1
    columns = np.ceil((y - 0.12) / (0.17 / 11) - 1e-9) * (0.17 / 11) + 0.12
    table = np.array([[gap(a, b) for b in columns] for a in rows])
    clear = np.abs(table - 0.09) > 1e-6
    assert (found == (wide & (table >= 0.09)))[clear].all()


def test_of_hexagons_the_table_is_asked_as_well():
    cell = Cell(0.4, pillar=Index(3.6), lattice=Lattice("hexagonal"), shape=Rectangle())
    x = np.array([0.15, 0.2, 0.25])
    found = paired._printable(library(cell, x, x), Limits(100, 140))
    assert found[0, 0]
    assert found[1, 0]  # 0.4 - 0.2 along x, rows 0.346 apart less 0.15
    assert not found[2, 2]


def test_nothing_to_choose_from_is_refused_with_what_there_was():
    with pytest.raises(
        LensError,
        match=r"holds 0\.04-0\.05 um by 0\.15-0\.15 um, the process prints 60 nm and gaps of 60",
    ):
        stock(phasors([(0, 0), (0, 0)]), sizes=np.array([0.04, 0.05]))


def test_sites_that_choose_pistons_are_picked_evenly_from_both_maps(monkeypatch):
    """Of 21 sites of a round aperture every fifth, both ends among them."""
    monkeypatch.setattr(paired, "_SAMPLE", 5)
    place = sites(Cell(1.0, pillar=Index(3.6)), 5.9, grid_nm=1.0)
    first, second = (
        lambda x, y, k=k: k * np.arange(x.size * y.size).reshape(y.size, x.size)
        for k in (1.0, -2.0)
    )
    x, y = paired._sampled(place, (first, second))
    every = np.concatenate([phase for *_, phase in place.blocks(first)])
    assert len(every) == 21
    assert x.tolist() == every[[0, 5, 10, 15, 20]].tolist()
    assert y.tolist() == (-2 * every[[0, 5, 10, 15, 20]]).tolist()
    assert paired._sampled(place, (first, second))[0].shape == (5,)


def test_the_table_that_goes_with_a_lens_has_both_answers_and_the_focus_of_y():
    t = rng.normal(size=(1, 3, 4, 2, 2)) + 1j * rng.normal(size=(1, 3, 4, 2, 2))
    given = SimpleNamespace(
        t=t,
        wavelength_um=np.array([0.94]),
        x_um=np.linspace(0.1, 0.3, 3),
        y_um=np.linspace(0.12, 0.27, 4),
    )
    made = paired._table(given, Focus(0.94, 52.0, 700.0), 0.017)
    assert np.array_equal(made.t[..., 0], t[..., 0, 0])
    assert np.array_equal(made.t[..., 1], t[..., 1, 1])
    assert made.entry_error == 0.017
    assert made.focus_y_um == (52.0, 700.0)


def test_the_peak_of_a_choice_is_the_sum_of_both_squares():
    made = stock(phasors([(10, 50), (200, 110)], [(0.8, 0.5), (0.9, 0.7)]))
    x, y = np.radians([30.0, 180.0]), np.radians([20.0, 100.0])
    assert made.nearest(x, y).tolist() == [0, 1]
    first = (
        abs(0.8 * np.exp(1j * np.radians(-20)) + 0.9 * np.exp(1j * np.radians(20))) ** 2
        / 4
    )
    second = (
        abs(0.5 * np.exp(1j * np.radians(30)) + 0.7 * np.exp(1j * np.radians(10))) ** 2
        / 4
    )
    assert made._peak(x, y) == pytest.approx(first + second, rel=1e-9)


def test_what_a_lens_makes_of_either_light_is_of_its_own_focus():
    """Apertures of a radius of 21 um at 37 and at 52 um; whole turns; each light's own
    pillars.
    """
    made, sums = (
        stock(phasors([(10, 50), (20, 60)]), error=[0.01, 0.02]),
        (paired.Sums(), paired.Sums()),
    )
    sums[0].add(np.zeros(4), np.zeros(4), np.full(4, 0.9))
    sums[1].add(np.zeros(4), np.full(4, 0.3), np.full(4, 0.8))
    focuses = Focus(0.94, 37.0), Focus(0.94, 52.0)
    given = SimpleNamespace(cell=Cell(0.4, pillar=Index(3.6)))
    found = paired._split(
        made, sums, np.array([3, 1]), focuses, 42.0, given, alike=True
    )
    for one, distance, level in ((found.x, 37.0, 0.9), (found.y, 52.0, 0.8)):
        assert one.numerical_aperture == pytest.approx(
            21 / math.hypot(21, distance), rel=1e-12
        )
        assert one.wavefront_efficiency == pytest.approx(level**2, rel=1e-12)
        assert one.turns == 1.0
        assert one.sampled_aperture == pytest.approx(0.94 / 0.8, rel=1e-12)
    assert found.wavefront_efficiency_error == pytest.approx(
        (1.8 * 0.0125 + 0.0125**2, 1.6 * 0.0125 + 0.0125**2), rel=1e-12
    )
    assert (found.multiplexed, found.pairs) == (False, 2)
