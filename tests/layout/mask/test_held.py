"""A lens that stays in its file, and classes in a scratch file, give the very mask of
one in memory.
"""

import dataclasses

import numpy as np
import pytest

import layout
from layout.mask import build, fields, held
from layout.process.process import ExposureSettings, Process, WriteField
from metalens import lens as lenses
from metalens.cell import Cell
from metalens.fabrication import Bias
from metalens.lens import record
from metalens.lens.record import DiameterMap, Lens
from metalens.lens.rows import RowsOnDisk
from metalens.pillars import Proxy

BEAM = ExposureSettings(alpha_um=0.01, beta_um=8.0, eta=0.7)


def test_blocks_come_back_from_memory_and_from_the_scratch_file(monkeypatch):
    sites = np.random.default_rng(0).integers(0, 900, (37, 11)).astype(np.uint16)
    blocks = [(first, sites[first : first + 9]) for first in range(0, 37, 9)]
    small = held.hold_on_disk(sites.shape, sites.dtype, blocks)
    monkeypatch.setattr(held, "MOST_BYTES", 10)
    large = held.hold_on_disk(sites.shape, sites.dtype, blocks)
    assert small.array is not None
    assert large.array is None
    for one in (small, large):
        assert np.array_equal(one.whole(), sites)
        assert np.array_equal(one.source(5, 31), sites[5:31])
        plain, turned = (
            one.lattice("A", pitch=4, x0=0, y0=0, upside_down=u) for u in (False, True)
        )
        assert np.array_equal(plain.source(3, 8), sites[3:8])
        assert np.array_equal(turned.source(3, 20), sites[::-1][3:20])


@pytest.mark.parametrize(
    "process",
    [
        Process(),
        Process(tone="negative"),
        Process(exposure=BEAM),
        Process(bias=Bias(isolated_nm=-9.0), write_field=WriteField(7.1)),
    ],
)
def test_the_mask_is_the_same_from_the_file_and_from_memory(
    process, tmp_path, monkeypatch
):
    axis = np.arange(53) - 26
    d = np.random.default_rng(1).uniform(0.1, 0.3, (53, 53))
    d[axis**2 + (axis[:, None] - 3) ** 2 > 500] = 0
    proxy = Proxy(
        np.array([[3.0, 3.0]]),
        np.array([[0.95]]),
        (0.08, 0.32),
        (0.85, 0.85),
        0.01,
        0.01,
    )
    lens = Lens(
        DiameterMap(d, 0.4), Cell(0.4), proxy, 0.85, 500.0, float("inf"), "hyperbolic"
    )
    lenses.save(tmp_path / "lens.h5", lens)
    small = build.prepare_mask(lens, process)
    few = fields.split_write_fields(lens.diameters, process)
    monkeypatch.setattr(record, "MOST_HELD_BYTES", 100)
    monkeypatch.setattr(held, "MOST_BYTES", 100)
    monkeypatch.setattr("layout.mask.cells._BLOCK_SITES", 700)
    source = lenses.load_out_of_core(tmp_path / "lens.h5")
    assert isinstance(source.diameters.diameter_um, RowsOnDisk)
    large = build.prepare_mask(source, process)
    assert large.plan.lattices[0].array is None
    for name, made in (("a.gds", small), ("b.gds", large)):
        layout.write_gdsii(made.plan, tmp_path / name)
    assert (tmp_path / "a.gds").read_bytes() == (tmp_path / "b.gds").read_bytes()
    assert layout.compare(large.plan, layout.read_gdsii(tmp_path / "b.gds")).ok
    again = fields.split_write_fields(source.diameters, process)
    for one in dataclasses.fields(few):
        assert np.array_equal(getattr(few, one.name), getattr(again, one.name)), (
            one.name
        )
