"""The table of :mod:`tests.metamorphic`: each public verb under each of its symmetries,
on cases that every run draws anew (``--draws SEED`` repeats them).
"""

import numpy as np
import pytest

from tests import metamorphic


def check(pairs):
    for one, other, bar in pairs:
        assert np.shape(one) == np.shape(other)
        assert np.max(np.abs(np.subtract(one, other, dtype=complex))) <= bar


@pytest.mark.parametrize("engine", metamorphic.ENGINES)
@pytest.mark.parametrize("symmetry", metamorphic.CELLS, ids=lambda one: one.__name__)
def test_a_unit_cell_keeps_its_symmetries(rng, engine, symmetry):
    check(symmetry(metamorphic.ENGINES[engine], rng))


@pytest.mark.parametrize("symmetry", metamorphic.LIGHT, ids=lambda one: one.__name__)
def test_light_and_lenses_keep_their_symmetries(rng, symmetry):
    check(symmetry(rng))


@pytest.mark.parametrize("symmetry", metamorphic.FILES, ids=lambda one: one.__name__)
def test_files_hold_what_was_written(rng, tmp_path, symmetry):
    check(symmetry(rng, tmp_path))
