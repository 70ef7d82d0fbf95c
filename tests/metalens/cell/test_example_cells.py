"""The example cells: they read, propagate no order, fit their lattice, and do what their heads say."""

import math
from pathlib import Path

import numpy as np
import pytest

from metalens import library, rcwa
from metalens.cell.orders import check_subwavelength
from metalens.commands.library import CellFile
from metalens.design import Limits, printable
from metalens.ground import config
from metalens.ground.errors import LensError
from metalens.pillars import Proxy

FOLDER = Path(__file__).parents[3] / "examples" / "cells"
FILES = sorted(FOLDER.glob("*.toml"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_example_cells_read_and_are_subwavelength(path):
    wanted = config.load(path, CellFile)
    library.check(wanted.cell, wanted.sweep)
    low, high = wanted.sweep.span_um(wanted.cell)
    assert wanted.cell.gap_um(high) > 0.04
    got = rcwa.jones(wanted.cell, (low + high) / 2, wanted.sweep.wavelengths_um[0], harmonics=5)
    assert np.abs(got.energy - 1).max() < 1e-2  # power; the TiO2 film absorbs little


def test_the_titania_pitch_keeps_the_aperture_it_promises():
    cell = config.load(FOLDER / "tio2_532.toml", CellFile).cell
    check_subwavelength(cell, 0.532)
    assert cell.pitch_um < 0.532 / (2 * 0.8)


def test_a_lens_on_another_lattice_is_refused():
    cell = config.load(FOLDER / "hexagonal_850.toml", CellFile).cell
    proxy = Proxy(np.array([[0.5, 7.5]]), np.array([[0.9, 0.05]]), (0.08, 0.28), (0.85, 0.85), 0.0, 0.0)
    with pytest.raises(LensError, match="square lattice"):
        printable(proxy, cell, Limits(), 0.85)


def test_widest_pillar_leaves_the_gap():
    wanted = config.load(FOLDER / "a_si_rectangle_940.toml", CellFile)
    size = wanted.cell.widest_um(0.06)
    assert size == pytest.approx(0.42 - 0.06, abs=0.004)  # rows of rectangles along x are the nearest
    assert math.isclose(config.load(FOLDER / "tio2_532.toml", CellFile).cell.widest_um(0.05), 0.27)
