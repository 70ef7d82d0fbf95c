"""Functions of every pillar times its phasor, against complex numbers as numpy multiplies them."""

import numpy as np
import pytest

from characterize.model.gather import lit


@pytest.mark.parametrize(("kind", "close"), [(np.complex64, 3e-7), (np.complex128, 1e-15)])
def test_a_pillar_s_functions_are_looked_up_and_turned(kind, close):
    """By columns and rows, real parts first: products of numbers below 4 to a few roundings. Views are read as they
    lie."""
    rng = np.random.default_rng(3)
    table = (rng.normal(size=(5, 3)) + 1j * rng.normal(size=(5, 3))).astype(kind)
    place = rng.integers(0, 5, (4, 6))
    turns = np.exp(2j * np.pi * rng.random((6, 4))).astype(kind).T
    got = lit(table, place, turns)
    want = (table[place] * turns[..., None]).transpose(1, 0, 2)
    assert got.shape == (6, 4, 6)
    assert got.dtype == table.real.dtype
    assert np.abs(got[..., :3] - want.real).max() < 4 * close
    assert np.abs(got[..., 3:] - want.imag).max() < 4 * close
