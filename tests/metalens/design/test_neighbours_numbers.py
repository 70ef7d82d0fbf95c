"""Rows of pillars by their parts: discs and normals integrated, waves by k x E, slabs
by Airy, rows told by hand.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell.record import Cell, Index
from metalens.design import neighbours as rows
from metalens.pillars.proxy import Proxy

WAVE, PITCH = 0.83, 0.37


def orders(m, n):
    """All orders -m..m along the row and -n..n across it, across the quicker one."""
    return tuple(
        a.ravel()
        for a in np.meshgrid(np.arange(-m, m + 1), np.arange(-n, n + 1), indexing="ij")
    )


@pytest.mark.parametrize("diagonal", [False, True])
def test_pillars_stand_a_block_apart_about_the_middle_of_their_row(diagonal):
    """Along the diagonal every other one half a square aside, squares √2 pitches wide."""
    block = rows.block_of(PITCH, diagonal)
    x, y = block.places_um(4)
    if diagonal:
        assert block.width_um == pytest.approx(math.sqrt(2) * PITCH, rel=1e-15)
        assert (block.pillars, block.spacing_um) == (
            2,
            pytest.approx(PITCH / math.sqrt(2), rel=1e-12),
        )
        assert y == pytest.approx(
            [0, PITCH / math.sqrt(2), 0, PITCH / math.sqrt(2)], rel=1e-12
        )
        assert x == pytest.approx(
            np.array([-1.5, -0.5, 0.5, 1.5]) * PITCH / math.sqrt(2), rel=1e-12
        )
    else:
        assert (block.width_um, block.pillars, block.spacing_um) == (PITCH, 1, PITCH)
        assert y.tolist() == [0] * 4
        assert x == pytest.approx(np.array([-1.5, -0.5, 0.5, 1.5]) * PITCH, rel=1e-12)


@pytest.mark.parametrize("diagonal", [False, True])
def test_coefficients_of_discs_are_their_integrals_over_the_row(diagonal):
    """Sums over a raster of 4e-3 of a pillar: its rims are cut at random, 1e-3 of the
    area.
    """
    block, sizes = rows.block_of(PITCH, diagonal), np.array([0.11, 0.29, 0.2, 0.16])
    blocks = 4 // block.pillars
    dm, dn = np.array([0, 1, -3, 2, 0, 5]), np.array([0, 0, 1, -2, 3, 1])
    got = rows._discs(dm, dn, sizes, block)
    period = blocks * block.width_um
    x, y = ((np.arange(count) + 0.5) / count - 0.5 for count in (1600, 500))
    x, y = np.meshgrid(x * period, y * block.width_um, indexing="ij")
    inside = np.zeros(x.shape, bool)
    for at_x, at_y, d in zip(*block.places_um(4), sizes, strict=True):
        away_x = (x - at_x + period / 2) % period - period / 2
        away_y = (y - at_y + block.width_um / 2) % block.width_um - block.width_um / 2
        inside |= away_x**2 + away_y**2 <= d**2 / 4
    for k in range(6):
        wave = np.exp(-2j * np.pi * (dm[k] * x / period + dn[k] * y / block.width_um))
        assert got[k] == pytest.approx((inside * wave).mean(), abs=5e-4)
    area = math.pi / 4 * (sizes**2).sum() / (period * block.width_um)
    assert got[0] == pytest.approx(area, rel=1e-12)


@pytest.mark.parametrize("diagonal", [False, True])
def test_normals_point_from_the_nearest_pillar_and_their_tables_are_sums_over_the_row(
    diagonal,
):
    """48 points across a square; nx² + ny² = 1, on a border between pillars the mean of
    both.
    """
    block = rows.block_of(PITCH, diagonal)
    xx, yy, xy = block.normals()
    assert xx.shape == (48, 48)
    assert xx + yy == pytest.approx(np.ones((48, 48)), rel=1e-12)
    places = [(-0.25, 0.0), (0.25, 0.5)] if diagonal else [(0.0, 0.0)]
    copies = [(a + i, b + j) for a, b in places for i in (-1, 0, 1) for j in (-1, 0, 1)]
    for i, k in ((3, 5), (40, 11), (17, 30), (22, 46)):
        u, v = (i + 0.5) / 48 - 0.5, (k + 0.5) / 48 - 0.5
        away = np.array([(u - a, v - b) for a, b in copies])
        near = away[np.hypot(*away.T) <= np.hypot(*away.T).min() + 1e-9]
        unit = near / np.hypot(*near.T)[:, None]
        want = (
            (unit[:, 0] ** 2).mean(),
            (unit[:, 1] ** 2).mean(),
            (unit[:, 0] * unit[:, 1]).mean(),
        )
        assert (xx[i, k], yy[i, k], xy[i, k]) == pytest.approx(
            want, abs=1e-7
        )  # ties to 1e-9 of squares
    count = 3 * block.pillars
    m, n = orders(2, 1)
    tables = rows._normal_fields(count, m, n, block)
    whole = [np.tile(field, (3, 1)) for field in (xx, yy, xy)]
    x = ((np.arange(144) + 0.5) / 144 - 0.5) * 3
    y = (np.arange(48) + 0.5) / 48 - 0.5
    for dm, dn in ((0, 0), (1, 0), (3, 1), (-4, 2), (-3, -2), (4, -1)):
        wave = np.exp(-2j * np.pi * (dm * x[:, None] / 3 + dn * y))
        for table, field in zip(tables, whole, strict=True):
            assert table[dm, dn] == pytest.approx((field * wave).mean(), abs=1e-12)


@pytest.mark.parametrize("sign", [1, -1])
def test_even_and_odd_combinations_are_orthonormal_mirrors(sign):
    m, n = orders(2, 3)
    made = rows._parity(n, sign)
    assert made.shape == (35, 5 * (4 if sign > 0 else 3))
    assert made.T @ made == pytest.approx(np.eye(made.shape[1]), abs=1e-12)
    mirrored = np.zeros((35, 35))
    for k in range(35):
        mirrored[k, np.flatnonzero((m == m[k]) & (n == -n[k]))[0]] = 1
    assert mirrored @ made == pytest.approx(sign * made, abs=1e-12)


def test_waves_go_or_decay_upwards():
    given = np.array([1.2, -1.2, 0.7j, -0.7j, 1 + 0.1j, -1 - 0.1j, 0.3 - 0.2j])
    assert rows._forward(given) == pytest.approx(
        np.array([1.2, 1.2, 0.7j, 0.7j, 1 + 0.1j, 1 + 0.1j, 0.3 - 0.2j])
    )


@pytest.mark.parametrize("index", [1.45, 2.1 + 0.05j])
def test_the_magnetic_field_of_a_wave_is_k_cross_e(index):
    """Times i, as the layer counts it; E transverse to k in a medium, decaying orders
    too.
    """
    m, n = orders(3, 2)
    kx, ky = m * 0.83 / 1.1 + 0.0, n * 0.83 / 0.7
    one = np.eye(2 * len(m))
    made = rows._homogeneous(index, (m, n, kx, ky), one, one)
    draw = np.random.default_rng(1)
    ex, ey = draw.normal(size=(2, len(m))) + 1j * draw.normal(size=(2, len(m)))
    kz = np.sqrt(index**2 - kx**2 - ky**2 + 0j)
    kz = np.where(kz.imag < -1e-12, -kz, kz)
    e = np.stack([ex, ey, -(kx * ex + ky * ey) / kz])
    h = np.cross(np.stack([kx + 0j, ky + 0j, kz]), e, axis=0)
    assert made @ np.concatenate([ex, ey]) == pytest.approx(
        1j * np.concatenate([h[0], h[1]]), rel=1e-10, abs=1e-10
    )


def slab(n1, n, n2, height):
    """(t, energy) of a film between two media at normal incidence (Airy), t of power:
    √(n2 / n1) of the field's.
    """
    beta = 2 * math.pi / WAVE * n * height
    r1, r2 = (n1 - n) / (n1 + n), (n - n2) / (n + n2)
    t1, t2 = 2 * n1 / (n1 + n), 2 * n / (n + n2)
    below = 1 + r1 * r2 * np.exp(2j * beta)
    t = t1 * t2 * np.exp(1j * beta) / below
    r = (r1 + r2 * np.exp(2j * beta)) / below
    return t * math.sqrt(n2 / n1), abs(t) ** 2 * n2 / n1 + abs(r) ** 2


@pytest.mark.parametrize("index", [1.9, 1.9 + 0.04j])
@pytest.mark.parametrize("polarization", ["x", "y"])
@pytest.mark.parametrize(("count", "diagonal"), [(1, False), (3, False), (2, True)])
def test_pillars_of_what_lies_between_them_are_a_film(
    index, polarization, count, diagonal
):
    film = Index(index.real, complex(index).imag)
    cell = Cell(
        PITCH, 0.41, pillar=film, between=film, substrate=Index(1.46), cover=Index(1.2)
    )
    got = rows.solve_row(
        cell,
        np.linspace(0.1, 0.2, count),
        WAVE,
        polarization=polarization,
        harmonics=1,
        diagonal=diagonal,
    )
    t, energy = slab(1.46, index, 1.2, 0.41)
    assert got.order(0) == pytest.approx(t, rel=1e-9)
    assert got.energy == pytest.approx(energy, rel=1e-9)
    assert np.abs(got.t[got.orders != 0]).max() < 1e-12
    reach = count if not diagonal else 2
    assert got.orders.tolist() == list(range(-reach, reach + 1))


def test_orders_to_each_side_are_so_many_a_pillar_and_across_the_row():
    """Along the diagonal √2 times as many of a square: 3 √2 = 4.2 makes 5, of two
    squares 10.
    """
    cell = Cell(PITCH, 0.3, pillar=Index(1.6), substrate=Index(1.46))
    seen = []
    kept = rows._layer

    def layer(cell, diameters, wavelength, block, grid):
        seen.append(grid)
        return kept(cell, diameters, wavelength, block, grid)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "_layer", layer)
        rows.solve_row(cell, [0.1, 0.2], WAVE, polarization="x", harmonics=2)
        rows.solve_row(
            cell, [0.1, 0.2], WAVE, polarization="x", harmonics=2, diagonal=True
        )
    (m, n, kx, ky), (dm, dn, dx, dy) = seen
    assert (m.min(), m.max(), n.min(), n.max()) == (-4, 4, -2, 2)
    assert kx == pytest.approx(m * WAVE / (2 * PITCH), rel=1e-12)
    assert ky == pytest.approx(n * WAVE / PITCH, rel=1e-12)
    assert (dm.max(), dn.max()) == (3, 3)  # 2 √2 = 2.8
    assert dx == pytest.approx(dm * WAVE / (math.sqrt(2) * PITCH), rel=1e-12)
    assert dy == pytest.approx(dn * WAVE / (math.sqrt(2) * PITCH), rel=1e-12)


def lens(cover=1.0, sizes=((0.1, 0.14), (0.0, 0.21)), domain=(0.08, 0.2)):
    """What rows ask of a lens: 40 rad per um of diameter."""
    mid, half = sum(domain) / 2, (domain[1] - domain[0]) / 2
    proxy = Proxy(
        np.array([[40 * mid - 3.2, 40 * half]]),
        np.array([[0.9]]),
        domain,
        (WAVE, WAVE),
        0.0,
        0.0,
    )
    cell = Cell(PITCH, pillar=Index(3.4), substrate=Index(1.46), cover=Index(cover))
    return SimpleNamespace(
        cell=cell,
        wavelength_um=WAVE,
        proxy=proxy,
        diameters=SimpleNamespace(diameter_um=np.array(sizes)),
    )


def test_sizes_of_rows_are_those_of_the_lens_within_its_proxy():
    assert rows.printed(lens()) == (0.1, 0.2)
    assert rows.printed(lens(domain=(0.11, 0.3))) == (0.11, 0.21)


def told(monkeypatch, whole, alone):
    """Rows and single pillars as given, by what is asked."""
    asked = []

    def solve_row(cell, diameters, wavelength, *, polarization, harmonics, diagonal):
        asked.append((tuple(diameters), polarization, harmonics, diagonal, wavelength))
        if len(set(diameters)) == 1:
            return rows.Row(
                np.array([-1, 0, 1]),
                np.array([9.0, alone[polarization][diameters[0]], 7.0]),
                1.0,
            )
        t = np.array(whole[polarization])
        return rows.Row(np.arange(len(t)) - len(t) // 2, t, 1.0)

    monkeypatch.setattr(rows, "solve_row", solve_row)
    return asked


@pytest.mark.parametrize("diagonal", [False, True])
def test_a_blazed_row_is_compared_with_its_pillars_one_by_one(monkeypatch, diagonal):
    """Order 1 over Σ t exp(-2πi place / N) / N, places about the middle; lost is what
    the row has less of its light in
    that order than its pillars have. Three pillars of 0.37 um reach to order 1.3, 0.92
    along the diagonal of four."""
    sizes = (0.1, 0.13, 0.17, 0.2) if diagonal else (0.1, 0.13, 0.17)
    alone = {p: dict(zip(sizes, v, strict=False)) for p, v in {
        "x": (0.9, 0.7 * np.exp(2.1j), 0.8 * np.exp(4.0j), 0.75 * np.exp(5.2j)),
        "y": (0.6, 0.9 * np.exp(1.7j), 0.5 * np.exp(4.4j), 0.95 * np.exp(5.0j))}.items()}  # fmt: skip
    whole = {
        "x": (5.0, 0.1, 0.3j, 0.6 - 0.2j, 4.0),
        "y": (5.0, 0.2j, 0.1, 0.7 + 0.1j, 4.0),
    }
    asked = told(monkeypatch, whole, alone)
    ratios, lost = rows._blazed(lens(), np.array(sizes), 2, diagonal)
    count = len(sizes)
    spacing = PITCH / math.sqrt(2) if diagonal else PITCH
    reach = math.ceil(count * spacing / WAVE) - 1
    assert reach == 1
    parts = []
    for k, p in enumerate(("x", "y")):
        each = np.array([alone[p][d] for d in sizes])
        want = (
            sum(
                t * np.exp(-2j * np.pi * (i - (count - 1) / 2) / count)
                for i, t in enumerate(each)
            )
            / count
        )
        assert ratios[k] == pytest.approx(whole[p][3] / want, rel=1e-12)
        total = sum(abs(t) ** 2 for t in whole[p][1:4])
        parts.append(
            abs(want) ** 2 / np.mean(np.abs(each) ** 2) - abs(whole[p][3]) ** 2 / total
        )
    assert lost == pytest.approx(np.mean(parts), rel=1e-12)
    pillars = 2 if diagonal else 1
    singles = [one for one in asked if len(set(one[0])) == 1]
    assert {len(one[0]) for one in singles} == {pillars}
    assert {one[2:] for one in asked} == {(2, diagonal, WAVE)}
    assert len(asked) == 2 * (1 + count)


@pytest.mark.parametrize(("count", "begins"), [(2, 3), (3, 2), (4, 2), (5, 1), (8, 1)])
def test_short_rows_are_solved_with_phases_that_begin_elsewhere(
    monkeypatch, count, begins
):
    """As many as make six pillars; phases a quarter of a step on, then a share of a
    step on again.
    """
    seen = []

    def blazed(lens, diameters, harmonics, diagonal):
        seen.append((np.asarray(diameters), harmonics, diagonal))
        k = len(seen)
        return np.array([1.0 * k, 2.0j * k]), 0.1 * k**2

    monkeypatch.setattr(rows, "_blazed", blazed)
    given = lens(sizes=((0.08, 0.2), (0.0, 0.13)), domain=(0.08, 0.24))
    ratio, lost = rows._mean(given, count, True, 4)
    assert len(seen) == begins
    assert {one[1:] for one in seen} == {(4, True)}
    numbers = np.arange(1, begins + 1)
    assert ratio == pytest.approx(
        np.array([numbers.mean(), 2j * numbers.mean()]), rel=1e-12
    )
    assert lost == pytest.approx(0.1 * (numbers**2).mean(), rel=1e-12)
    for begin, (diameters, *_) in enumerate(seen):
        assert diameters.min() >= 0.08 - 1e-12
        assert diameters.max() <= 0.2 + 1e-12
        wanted = 2 * math.pi * (np.arange(count) + 0.25 + begin / begins) / count
        made = 40 * diameters - 3.2
        inside = (diameters > 0.0801) & (
            diameters < 0.1999
        )  # 4.8 rad are there, else the nearer end
        assert (
            np.abs(np.angle(np.exp(1j * (made - wanted))))[inside].max(initial=0) < 1e-6
        )
        assert inside.any()


def test_rows_of_a_lens_are_those_whose_light_goes_on_in_its_cover(monkeypatch):
    """Sines 0.83 / (N 0.37) of 2, 3 and 6 pillars, and along the diagonal of the even
    numbers next to 2.8, 4.2 and
    8.5: 2, 4 and 8; below 0.95 of the index of the cover, which two pillars (1.12 and
    1.59) are not."""
    seen = []

    def mean(lens, count, diagonal, harmonics):
        seen.append((count, diagonal, harmonics))
        return np.array(
            [count + harmonics / 10, 1j * count]
        ), 0.01 * count + 0.1 * harmonics

    monkeypatch.setattr(rows, "_mean", mean)
    found = rows.neighbours(lens(), counts=(6, 2, 3))
    step = 0.83 / 0.37
    assert found.sine == pytest.approx(
        [step / 6, step / 3, step / 2**1.5, step / 2**2.5], rel=1e-12
    )
    assert found.diagonal.tolist() == [False, False, True, True]
    assert found.factor == pytest.approx(
        np.array([[6.3, 3.3, 4.3, 8.3], [6j, 3j, 4j, 8j]]), rel=1e-12
    )
    assert found.coarse == pytest.approx(
        np.array([[6.2, 3.2, 4.2, 8.2], [6j, 3j, 4j, 8j]]), rel=1e-12
    )
    values = [getattr(found, one.name) for one in dataclasses.fields(found)]
    lost = [
        v
        for v in values
        if isinstance(v, np.ndarray) and v.shape == (4,) and v.dtype == float
    ]
    assert any(
        v == pytest.approx([0.36, 0.33, 0.34, 0.38], rel=1e-12) for v in lost
    )  # of the finer ones
    assert WAVE in [v for v in values if isinstance(v, float)]
    dense = rows.neighbours(lens(cover=1.3), counts=(6, 2, 3), diagonal=False)
    assert dense.sine == pytest.approx(
        [step / 6, step / 2, step / 3], rel=1e-12
    )  # 1.1216 of 1.235
    assert 1.3 in [
        getattr(dense, one.name)
        for one in dataclasses.fields(dense)
        if one.type in ("float", float)
    ]
    seen.clear()
    rows.neighbours(lens(), diagonal=True)
    assert {one[:2] for one in seen} == {(6, False), (5, False), (8, True)}
    assert {one[2] for one in seen} == {3, 2}
