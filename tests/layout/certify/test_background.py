"""Exposure from afar on pixels, against the direct sum over all shapes."""

import numpy as np
import pytest

from layout.certify import background
from layout.certify.background import Raster
from layout.certify.places import OnLattices, strip_of
from layout.mask import Lattice
from tests.referees.listed_certificate import Listed


def disc_of_pillars(pitch=0.41, n=90):
    """Places that are no grid of pixels, of masses that are not alike."""
    axis = (np.arange(n) - n / 2.3) * pitch
    x, y = (v.ravel() for v in np.meshgrid(axis + 3.1, axis - 1.7))
    held = (x - 3.1) ** 2 + (y + 1.7) ** 2 < (0.45 * n * pitch) ** 2
    return x[held], y[held], np.random.default_rng(3).uniform(0.5, 1.5, held.sum())


def direct(x, y, mass, at, range_um):
    away = (x - at[0][:, None]) ** 2 + (y - at[1][:, None]) ** 2
    return (mass * np.exp(-away / range_um**2)).sum(1) / (np.pi * range_um**2)


@pytest.mark.parametrize("range_um", [1.0, 2.0, 7.3])
def test_pixels_give_the_sum_over_all_masses(range_um):
    x, y, mass = disc_of_pillars()
    raster = Raster.over((x.min(), y.min(), x.max(), y.max()), range_um)
    image = np.zeros((raster.rows, raster.columns), np.float32)
    raster.put(x, y, mass, image)
    found = raster.take(x[::37], y[::37], raster.blurred(image))
    # splines of four pixels a range: 3e-4, and 1e-3 where the range is hardly wider
    # than the pitch
    error = 1.2e-3 if range_um < 3 * 0.41 else 4e-4
    assert found == pytest.approx(
        direct(x, y, mass, (x[::37], y[::37]), range_um), rel=error
    )


def test_a_band_of_pixels_is_the_same_as_all_of_them():
    x, y, mass = disc_of_pillars()
    whole = Raster.over((x.min(), y.min(), x.max(), y.max()), 1.3)
    images = []
    low, high = -4.2, -0.9
    here = (y > low) & (y < high)
    for raster in (whole, whole.between(low, high)):
        image = np.zeros((raster.rows, raster.columns), np.float32)
        near = (y > low - raster.halo_um) & (y < high + raster.halo_um)
        raster.put(
            *(v[near] if raster is not whole else v for v in (x, y, mass)), image
        )
        images.append(raster.take(x[here], y[here], raster.blurred(image)))
    assert whole.between(low, high).rows < whole.rows
    assert images[1] == pytest.approx(
        images[0], rel=2e-6
    )  # float32, and what lies 4.5 ranges away


def test_lattices_and_lists_hold_the_same_pillars_each_in_one_strip():
    rng = np.random.default_rng(1)
    parts = [
        Lattice.of(
            "A",
            rng.integers(0, 4, (300, 500)).astype(np.uint8),
            pitch=410,
            x0=-90_003,
            y0=61_007,
        ),
        Lattice.of(
            "B",
            rng.integers(0, 4, (40, 30)).astype(np.uint8),
            pitch=650,
            x0=150_001,
            y0=90_000,
        ),
    ]
    kinds = np.array([-1, 2, -1, 0], np.int32)
    centre = np.array([[0.001, 0.002], [0.0, 0.0], [-0.003, 0.0]])
    lattices = OnLattices.of(parts, kinds, centre, unit_nm=1.0, count=0)
    x, y, kind = lattices.part(0, lattices.strips)
    assert len(x) == sum(np.isin(l.array, [1, 3]).sum() for l in parts)
    listed = Listed(x, y, kind)
    for places in (lattices, listed):
        strips = [places.part(k, k + 1) for k in range(places.strips)]
        assert sum(len(p[0]) for p in strips) == len(x)
        assert {tuple(row) for p in strips for row in np.column_stack(p)} == set(
            map(tuple, np.column_stack([x, y, kind]))
        )
    middle = lattices.part(1, 2)
    assert (strip_of(lattices, middle[1] - centre[middle[2], 1] + 1e-7) == 1).all()


def test_at_the_rim_of_an_image_its_last_nine_pixels_go_on():
    """Quadratic splines hold any plane, in the middle of pixels, on the rim and half a
    pixel beyond it.
    """
    y, x = np.mgrid[:7, :9]
    image = 2.0 + 0.3 * x - 0.7 * y
    u, v = (
        a.ravel()
        for a in np.meshgrid(
            [-0.5, 0.0, 0.4, 3.2, 7.6, 8.0, 8.5], [-0.5, 0.1, 2.7, 5.5, 6.0, 6.5]
        )
    )
    found = np.empty(len(u))
    background._take(1.7 + 0.25 * u, -3.1 + 0.25 * v, 1.7, -3.1, 0.25, image, found)
    assert found == pytest.approx(2.0 + 0.3 * u - 0.7 * v, abs=1e-12)
