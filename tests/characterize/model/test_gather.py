"""Functions of every pillar times its phasor, against complex numbers as numpy
multiplies them.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from characterize.model.gather import fold_weights, gather_light, is_mirror_symmetric
from characterize.model.glass import BenchGeometry
from characterize.model.pillars import PillarResponse
from characterize.model.reduced import CompressedLens
from metalens import design
from metalens.cell import Cell
from metalens.design import profiles
from metalens.lens import Stop

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b


@pytest.mark.parametrize(
    ("kind", "close"), [(np.complex64, 3e-7), (np.complex128, 1e-15)]
)
def test_a_pillar_s_functions_are_looked_up_and_turned(kind, close):
    """By columns and rows, real parts first: products of numbers below 4 to a few
    roundings. Views are read as they
    lie."""
    rng = np.random.default_rng(3)
    table = (rng.normal(size=(5, 3)) + 1j * rng.normal(size=(5, 3))).astype(kind)
    place = rng.integers(0, 5, (4, 6))
    turns = np.exp(2j * np.pi * rng.random((6, 4))).astype(kind).T
    got = gather_light(table, place, turns)
    want = (table[place] * turns[..., None]).transpose(1, 0, 2)
    assert got.shape == (6, 4, 6)
    assert got.dtype == table.real.dtype
    assert np.abs(got[..., :3] - want.real).max() < 4 * close
    assert np.abs(got[..., 3:] - want.imag).max() < 4 * close


@pytest.mark.parametrize("count", [1, 6, 7])
def test_half_of_what_is_alike_to_both_sides_sums_to_all_of_it(count):
    """Weights of no symmetry, of small whole numbers: the sums are exact."""
    rng = np.random.default_rng(5)
    weights, half = (
        rng.integers(-9, 9, (count, 4)).astype(float),
        rng.integers(-9, 9, count - count // 2).astype(float),
    )
    values = np.concatenate([half[::-1], half[count % 2 :]])
    first = count // 2
    assert (
        fold_weights(weights, first)[first:].T @ values[first:] == weights.T @ values
    ).all()
    assert fold_weights(weights, 0) is weights


@pytest.fixture(scope="module", params=[9.2, 9.6])
def lens(request):
    """Of an odd and of an even number of pillars across."""
    focus = profiles.Focus(0.85, 9.2, 138.0)
    phase = design.phase_of(None, focus, radius_um=request.param / 2)
    return design.make(
        phase,
        focus,
        aperture_um=request.param,
        cell=Cell(pitch_um=0.4),
        proxy=b.proxy(),
    )[0]


def gathered(lens, tangents=(0.0, 0.0)):
    bench, depths = (
        BenchGeometry(lens.sensor_distance_um, 0.85, 138.0, tangents),
        np.array([100.0, 170.0]),
    )
    return CompressedLens(
        lens,
        PillarResponse(lens, b.RESPONSE),
        bench,
        window_um=24.0,
        depths_um=depths,
        tolerance=1e-7,
    ).gathered


def with_one_wider(lens, more_um):
    """One pillar away from both axes."""
    d = lens.diameters.diameter_um.astype(float)
    d[5, 9] += more_um
    return dataclasses.replace(
        lens, diameters=dataclasses.replace(lens.diameters, diameter_um=d)
    )


def test_a_quarter_of_the_pillars_gathers_what_all_do(lens):
    """One pillar wider by less than its table knows, so that all are summed: the same
    to rounding, of 1e-16 each. One
    that is wider by 20 nm shows."""
    plain, all_of_them = gathered(lens), gathered(with_one_wider(lens, 1e-12))
    size = np.abs(plain).max()
    assert plain.dtype == np.complex128
    assert (
        np.abs(plain - all_of_them).max() < 1e-12 * size
    )  # 400 pillars, interpolated thrice
    assert np.abs(plain - gathered(with_one_wider(lens, 0.02))).max() > 1e-5 * size


def test_pillars_are_alike_to_both_sides_only_where_all_of_them_and_the_light_are(lens):
    d = lens.diameters
    assert is_mirror_symmetric(d, (0.0, 0.0))
    assert not is_mirror_symmetric(d, (0.0, 0.01))
    assert not is_mirror_symmetric(with_one_wider(lens, 1e-12).diameters, (0.0, 0.0))
    one_way = d.diameter_um * (1 + 1e-3 * np.linspace(-1, 1, len(d.diameter_um)))
    assert not is_mirror_symmetric(
        dataclasses.replace(d, diameter_um=one_way), (0.0, 0.0)
    )
    assert not is_mirror_symmetric(
        dataclasses.replace(d, diameter_um=one_way.T), (0.0, 0.0)
    )
    assert not is_mirror_symmetric(
        dataclasses.replace(d, length_um=d.diameter_um), (0.0, 0.0)
    )
    assert not is_mirror_symmetric(
        dataclasses.replace(d, angle_rad=np.zeros_like(d.diameter_um)), (0.0, 0.0)
    )
    assert is_mirror_symmetric(d, (0.0, 0.0), Stop(7.0, 30.0))
    assert not is_mirror_symmetric(d, (0.0, 0.0), Stop(7.0, 30.0, (0.0, 0.3)))
