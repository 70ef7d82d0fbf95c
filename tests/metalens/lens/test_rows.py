"""Diameters that stay in the file give the same rows, ends and lens as those in memory."""

import h5py
import numpy as np
import pytest

from metalens import lens as lenses
from metalens.cell import Cell
from metalens.core.errors import LensError, MetalensError
from metalens.lens import Layers, Stop, record
from metalens.lens.record import DiameterMap, Lens
from metalens.lens.rows import RowsOnDisk
from metalens.pillars import Proxy


@pytest.fixture(params=[None, (7, 5)])
def stored(request, tmp_path):
    values = np.random.default_rng(1).uniform(0.1, 0.3, (53, 17)).astype(np.float32)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("d", data=values, chunks=request.param)
    return RowsOnDisk(tmp_path / "a.h5", "d"), values


@pytest.mark.parametrize(
    "key",
    [
        slice(3, 41),
        slice(50, 90),
        slice(9, 9),
        slice(None),
        52,
        (slice(6, 30), slice(2, 11)),
        (13, 4),
        slice(5, 40, 3),
    ],
)
def test_any_rows_are_those_of_the_array(stored, key):
    rows, values = stored
    assert np.array_equal(rows[key], values[key])
    assert np.array_equal(rows[key], values[key])  # from the band that is kept
    assert np.array_equal(rows[2:9], values[2:9])


def test_ends_and_all_of_it(stored):
    rows, values = stored
    assert (rows.max(), rows.min(initial=0)) == (float(values.max()), 0.0)
    assert rows.min(initial=9.0) == float(values.min())
    assert rows.count == values.size
    assert np.array_equal(np.asarray(rows), values)
    assert (len(rows), rows.shape, rows.dtype) == (53, values.shape, values.dtype)


IRIS = Layers(stop=Stop(7.5, 13.0, (0.7, -1.1)))  # and no film


def write(path, d):
    proxy = Proxy(
        np.array([[3.0, 3.0]]),
        np.array([[0.95]]),
        (0.08, 0.32),
        (0.85, 0.85),
        0.01,
        0.01,
    )
    about = (0.85, 500.0, float("inf"), "hyperbolic")
    lenses.save(path, Lens(DiameterMap(d, 0.4), Cell(0.4), proxy, *about, layers=IRIS))


def test_a_large_lens_stays_in_its_file(tmp_path, monkeypatch):
    d = np.random.default_rng(2).uniform(0.1, 0.3, (61, 43))
    write(tmp_path / "lens.h5", d)
    assert isinstance(
        lenses.load_out_of_core(tmp_path / "lens.h5").diameters.diameter_um, np.ndarray
    )
    monkeypatch.setattr(record, "MOST_HELD_BYTES", 100)
    large, small = (
        lenses.load_out_of_core(tmp_path / "lens.h5"),
        lenses.load(tmp_path / "lens.h5"),
    )
    assert isinstance(large.diameters.diameter_um, RowsOnDisk)
    assert large.diameters.radius_um == small.diameters.radius_um
    assert (large.profile, large.wavelength_um) == (small.profile, small.wavelength_um)
    assert large.layers.stop == small.layers.stop == IRIS.stop


def test_a_bad_diameter_and_a_damaged_file_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "MOST_HELD_BYTES", 100)
    d = np.random.default_rng(2).uniform(0.1, 0.3, (61, 43))
    write(tmp_path / "lens.h5", d)
    with h5py.File(tmp_path / "lens.h5", "r+") as file:
        file["diameter_um"][5, 7] = 0.45
    with pytest.raises(LensError, match="row 5, column 7"):
        lenses.load_out_of_core(tmp_path / "lens.h5")
    (tmp_path / "lens.h5").write_bytes(b"no lens")
    with pytest.raises(MetalensError, match=r"lens\.h5"):
        lenses.load_out_of_core(tmp_path / "lens.h5")
    with pytest.raises(MetalensError, match="no such file"):
        lenses.load_out_of_core(tmp_path / "none.h5")
