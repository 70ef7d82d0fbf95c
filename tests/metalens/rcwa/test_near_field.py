"""Fields in and around a cell: sums of a slab in closed form, Maxwell's equations,
power, and the modal engine.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens import modal, rcwa
from metalens.cell import Cell, Film, Incidence, Index, Lattice
from metalens.cell.shapes import Ring
from metalens.core.errors import CellError
from metalens.rcwa import FieldGrid, near_field, near_fields

WAVELENGTH = 0.81
K0 = 2 * math.pi / WAVELENGTH
ROUND = Cell(0.36, 0.45, Index(2.3), Index(1.46), Index(1.1), Index(1.05))
SIZE = 0.21


def _middles(count, edge):
    return (np.arange(count) + 0.5) / count * edge - edge / 2


def _airy(indices, heights, light, z):
    """(3, nz) E and H at x = y = 0 of plane waves up and down in every medium; light
    from the first one.

    Four unknowns an interface: tangential E and H are continuous. H = k x E with
    lengths over k0.
    """
    sine = math.sin(light.angle_rad)
    c = math.cos(light.azimuth_rad)
    s = math.sin(light.azimuth_rad)
    kz = [np.sqrt(n * n - sine**2 + 0j) for n in indices]

    def wave(n, q):
        k = np.array([sine * c, sine * s, q])
        e = (
            np.array([-s, c, 0.0])
            if light.polarization == "s"
            else np.array([q * c, q * s, -sine]) / n
        )
        return e, np.cross(k, e)

    pairs = [(wave(n, q), wave(n, -q)) for n, q in zip(indices, kz, strict=True)]
    # every wave has its phase 0 at the lower end of its medium,
    feet = np.concatenate([[0.0], np.cumsum(heights)])
    # that of the substrate at the top of it; unknowns: down in 0, both, ..., up in last
    count = 2 * (len(indices) - 1)
    system = np.zeros((2 * count, count), complex)
    right = np.zeros(2 * count, complex)
    for i in range(len(indices) - 1):
        rows = slice(4 * i, 4 * i + 4)
        for medium, sign in ((i, 1), (i + 1, -1)):
            at = np.exp(1j * K0 * kz[medium] * (feet[i] - feet[max(medium - 1, 0)]))
            for (e, h), factor, column in (
                (pairs[medium][0], at, 2 * medium - 1),
                (pairs[medium][1], 1 / at, 2 * medium),
            ):
                values = sign * factor * np.concatenate([e[:2], h[:2]])
                if column < 0:
                    right[rows] -= values
                elif column < count:
                    system[rows, column] = values
    found = np.concatenate(
        [[1.0], np.linalg.lstsq(system, right, rcond=None)[0], [0.0]]
    ).reshape(-1, 2)
    place = np.searchsorted(feet, z, side="right")
    out = np.zeros((2, 3, len(z)), complex)
    for i, medium in enumerate(place):
        at = np.exp(1j * K0 * kz[medium] * (z[i] - feet[max(medium - 1, 0)]))
        for (e, h), factor, a in zip(
            pairs[medium], (at, 1 / at), found[medium], strict=True
        ):
            out[:, :, i] += a * factor * np.stack([e, h])
    return out


@pytest.mark.parametrize("polarization", ["s", "p"])
@pytest.mark.parametrize("slab", [2.3, 1.9 + 0.3j])
def test_fields_in_a_stack_of_films_are_those_of_plane_waves_up_and_down(
    polarization, slab
):
    """A pillar of the medium around it is a film; one film under it, an absorbing one
    over it. Rounding is left.
    """
    medium = Index(slab.real, slab.imag)
    films = {"under": (Film(Index(1.9), 0.07),), "over": (Film(Index(1.3, 0.2), 0.11),)}
    cell = Cell(0.37, 0.47, medium, Index(1.46), Index(1.1), medium, **films)
    light = Incidence(WAVELENGTH, 0.5, polarization, 0.6)
    z = np.linspace(-0.43, 0.91, 24)
    got = near_field(
        cell, 0.2, light, x_um=[0.03, 0.11], y_um=[-0.07], z_um=z, harmonics=2
    )
    want = _airy(
        [1.46, 1.9, slab, 1.3 + 0.2j, 1.1], [0.07, 0.47, 0.11], light, z + 0.07
    )
    k = K0 * math.sin(0.5) * np.array([math.cos(0.6), math.sin(0.6)])
    for i, x in enumerate((0.03, 0.11)):
        turn = np.exp(1j * (k[0] * x - k[1] * 0.07))
        assert abs(got.e[:, :, 0, i] - turn * want[0]).max() < 1e-12
        assert abs(got.h[:, :, 0, i] - turn * want[1]).max() < 1e-12
    assert got.converged
    assert got.index[:, 0, 0] == pytest.approx(np.array([1.46, 1.9, slab, 1.3 + 0.2j, 1.1])[np.searchsorted(
        [-0.07, 0, 0.47, 0.58], z)])  # fmt: skip


def test_power_through_every_plane_of_a_lossless_cell_is_that_which_leaves():
    """Products on a grid finer than the orders; what (2) adds near the wall has no mean
    but for truncation (3e-4).
    """
    x, z = _middles(40, 0.36), [-0.3, -0.01, 0.1, 0.27, 0.44, 0.46, 0.9]
    got = near_field(
        ROUND,
        SIZE,
        Incidence(WAVELENGTH, 0.3, "p"),
        x_um=x,
        y_um=x,
        z_um=z,
        harmonics=7,
    )
    flux = (got.e[0] * got.h[1].conj() - got.e[1] * got.h[0].conj()).real.mean(
        axis=(1, 2)
    )
    flux /= math.sqrt(1.46**2 - math.sin(0.3) ** 2)  # of the light that comes
    t = rcwa.jones(ROUND, SIZE, WAVELENGTH, angle_rad=0.3, harmonics=7).t
    assert flux[[0, 1, -2, -1]] == pytest.approx(
        np.full(4, abs(t[1, 1]) ** 2), rel=1e-10
    )
    assert flux[2:-2] == pytest.approx(np.full(3, abs(t[1, 1]) ** 2), abs=3e-3)


def test_what_the_field_heats_is_what_the_modal_engine_misses():
    """Absorbed share: k0 eps'' ∫ |E|² over the pillar and the flux that comes; pixels
    of the rim leave 0.5 %.
    """
    cell = dataclasses.replace(ROUND, pillar=Index(3.1, 0.25))
    points, weights = np.polynomial.legendre.leggauss(12)
    x, z = _middles(48, 0.36), (points + 1) / 2 * 0.45
    got = near_field(
        cell, SIZE, Incidence(WAVELENGTH), x_um=x, y_um=x, z_um=z, harmonics=8
    )
    inside = got.index[0].imag > 0
    mean = (np.abs(got.e) ** 2).sum(axis=0)[:, inside].mean(axis=1) @ weights / 2 * 0.45
    share = K0 * (2 * 3.1 * 0.25) * mean * (math.pi / 4 * SIZE**2 / 0.36**2) / 1.46
    exact = modal.solve(cell, SIZE, WAVELENGTH, tolerance=1e-3)
    assert share == pytest.approx(1 - exact.energy, rel=0.02)


def test_fields_of_both_sides_give_the_derivative_of_t_that_the_modal_engine_has():
    """dt/dn = i k0 n / (A sqrt(n_s n_c)) ∫ E1 . E2 over the pillar, E2 from the cover
    (reciprocity): phases too.
    """
    points, weights = np.polynomial.legendre.leggauss(12)
    x, z = _middles(48, 0.36), (points + 1) / 2 * 0.45
    back = dataclasses.replace(ROUND, substrate=ROUND.cover, cover=ROUND.substrate)
    grid = {"x_um": x, "y_um": x, "z_um": z, "harmonics": 8}
    one, other = (
        near_field(cell, SIZE, Incidence(WAVELENGTH), **grid) for cell in (ROUND, back)
    )
    # z -> height - z
    mirrored = other.e[:, ::-1] * np.array([1, 1, -1])[:, None, None, None]
    inside = one.index[0].real > 2
    mean = (one.e * mirrored).sum(axis=0)[:, inside].mean(axis=1) @ weights / 2 * 0.45
    share = math.pi / 4 * SIZE**2 / 0.36**2
    got = 1j * K0 * 2.3 * share * mean / math.sqrt(1.46 * 1.1)
    ends = [
        modal.solve(
            dataclasses.replace(ROUND, pillar=Index(2.3 + side * 0.01)),
            SIZE,
            WAVELENGTH,
            tolerance=1e-5,
        ).t
        for side in (1, -1)
    ]
    want = (ends[0] - ends[1]) / 0.02
    assert abs(got - want) < 0.02 * abs(want)


def test_fields_keep_maxwells_equations_away_from_the_wall():
    """Central differences over 4 nm, inside and outside; derivatives of ten orders are
    seven per cent off.
    """
    step = 2e-3
    middles = ((0.01, 0.02, 0.2), (-0.12, 0.13, 0.1), (0.16, 0.02, 0.3))
    grids = [
        FieldGrid(*(c + step * np.arange(-1, 2) for c in middle)) for middle in middles
    ]
    for got in near_fields(
        ROUND, SIZE, Incidence(WAVELENGTH, 0.3, "p"), grids, harmonics=10
    ):
        eps = got.index[1, 1, 1] ** 2
        for field, want in ((got.e, 1j * K0 * got.h), (got.h, -1j * K0 * eps * got.e)):
            dz, dy, dx = (
                (field.take(2, a) - field.take(0, a)).take(1, 1).take(1, 1) / (2 * step)
                for a in (1, 2, 3)
            )
            curl = np.array([dy[2] - dz[1], dz[0] - dx[2], dx[1] - dy[0]])
            assert (
                abs(curl - want[:, 1, 1, 1]).max()
                < 0.1 * np.abs(want[:, 1, 1, 1]).max()
            )


def test_tangential_fields_are_continuous_and_normal_ones_jump_as_eps_does():
    """Across the wall at 40 degrees, 0.5 nm to both sides; across foot and top H, which
    (2) leaves as it is.
    """
    a = math.radians(40)
    n = np.array([math.cos(a), math.sin(a)])
    light = Incidence(WAVELENGTH, 0.0, "x")
    inner, outer = (
        near_field(
            ROUND,
            SIZE,
            light,
            x_um=[r * n[0]],
            y_um=[r * n[1]],
            z_um=[0.31],
            harmonics=9,
        ).e[:, 0, 0, 0]
        for r in (SIZE / 2 - 5e-4, SIZE / 2 + 5e-4)
    )
    along = np.array([-n[1], n[0]])
    assert outer[:2] @ n * 1.05**2 == pytest.approx(inner[:2] @ n * 2.3**2, rel=0.03)
    assert abs(inner[:2] @ along - outer[:2] @ along) < 0.03 * np.linalg.norm(outer)
    assert abs(inner[2] - outer[2]) < 0.03 * np.linalg.norm(outer)
    around = near_field(
        ROUND,
        SIZE,
        light,
        x_um=[0.05],
        y_um=[0.09],
        z_um=[-1e-9, 0, 0.45 - 1e-9, 0.45],
        harmonics=5,
    )
    assert around.h[:, 0] == pytest.approx(around.h[:, 1], abs=1e-6)
    assert around.h[:, 2] == pytest.approx(around.h[:, 3], abs=1e-6)


@pytest.mark.parametrize("lattice", [Lattice("hexagonal"), Lattice("rectangular", 1.2)])
def test_fields_repeat_from_site_to_site_with_the_phase_of_the_light(lattice):
    cell = dataclasses.replace(ROUND, lattice=lattice, shape=Ring(0.4))
    light = Incidence(WAVELENGTH, 0.4, "s", 0.3)
    step = np.array((0.18, 0.18 * math.sqrt(3)) if lattice.centred else (0.36, 0.432))
    x = np.array([0.02, 0.11])
    y = np.array([-0.08, 0.05])
    z = [-0.1, 0.2, 0.6]
    here = FieldGrid(x, y, z)
    there = FieldGrid(x + step[0], y + step[1], z)
    one, other = near_fields(cell, SIZE, light, [here, there], harmonics=4)
    turn = np.exp(
        1j * K0 * math.sin(0.4) * (math.cos(0.3) * step[0] + math.sin(0.3) * step[1])
    )
    assert abs(other.e - turn * one.e).max() < 1e-9
    assert abs(other.h - turn * one.h).max() < 1e-9
    assert np.array_equal(one.index, other.index)


@pytest.mark.parametrize("tilt", [0.12, -0.08])
def test_a_leaning_wall_is_wide_at_its_foot_in_twelve_steps(tilt):
    """Width at half height, less twice the height above it times the tangent: each step
    that of its middle.
    """
    cell = dataclasses.replace(ROUND, sidewall_rad=tilt)
    x = np.linspace(-0.17, 0.17, 341)
    z = (np.arange(12) + 0.3) / 12 * 0.45
    got = near_field(
        cell, SIZE, Incidence(WAVELENGTH), x_um=x, y_um=[0.0], z_um=z, harmonics=1
    )
    wide = (got.index[:, 0].real > 1.7).sum(1) * 0.001
    want = SIZE - 2 * ((np.arange(12) + 0.5) / 12 * 0.45 - 0.225) * math.tan(tilt)
    assert wide == pytest.approx(want, abs=0.0021)


def test_the_error_bar_holds_against_more_orders():
    grid = {
        "x_um": _middles(9, 0.36),
        "y_um": [0.02],
        "z_um": np.linspace(-0.1, 0.6, 15),
    }
    few, many = (
        near_field(ROUND, SIZE, Incidence(WAVELENGTH), **grid, harmonics=n)
        for n in (7, 14)
    )
    error = np.linalg.norm(few.e - many.e) / np.linalg.norm(many.e)
    assert 0.01 < error < few.error < 0.25


def test_what_cannot_be_computed_is_refused():
    light = Incidence(WAVELENGTH)
    for axis in ([], [math.nan], [[0.0]]):
        with pytest.raises(CellError, match="y_um has shape"):
            FieldGrid([0.0], axis, [0.0])
    with pytest.raises(CellError, match="9000000 points"):
        near_field(
            ROUND, SIZE, light, x_um=np.zeros(3000), y_um=np.zeros(3000), z_um=[0.0]
        )
    with pytest.raises(CellError, match="0 points"):
        near_fields(ROUND, SIZE, light, [])
    with pytest.raises(CellError, match="touches its neighbour"):
        near_field(ROUND, 0.37, light, x_um=[0], y_um=[0], z_um=[0])
