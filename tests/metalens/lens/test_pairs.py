"""A table of pillars of two sizes: each entry at its sizes, wavelength and
polarisation, and nothing between.
"""

import numpy as np
import pytest

from metalens.core import store
from metalens.core.errors import DomainError, LensError
from metalens.lens.record import TwoSizeTable

DRAW = np.random.default_rng(19)
WAVES = np.array([0.78, 0.85])
X = 0.1 + 0.02 * np.arange(5)
Y = 0.15 + 0.05 * np.arange(3)
T = DRAW.normal(size=(2, 5, 3, 2)) + 1j * DRAW.normal(size=(2, 5, 3, 2))


def pairs():
    return TwoSizeTable(WAVES, X, Y, T, (210.0, 900.0))


@pytest.mark.parametrize("light", ["x", "y"])
def test_every_pillar_has_its_entry_and_no_pillar_has_none(light):
    row = DRAW.integers(0, 5, (4, 6))
    column = DRAW.integers(0, 3, (4, 6))
    # a twentieth of a step is rounding
    x, y = (X[row] + 0.04 * 0.02, Y[column] - 0.04 * 0.05)
    x[1, 2] = y[1, 2] = 0.0
    for w, wave in enumerate(WAVES):
        found = pairs().amplitude(x, y, wave + 5e-10, light)
        want = T[w, row, column, "xy".index(light)]
        want[1, 2] = 0
        assert np.array_equal(found, want)


@pytest.mark.parametrize(
    ("x", "y", "wave", "word"),
    [
        (0.1212, 0.2, 0.85, "0.1212 um"),  # a twentieth of a step and more
        (0.12, 0.204, 0.85, "0.204 um"),
        (0.08, 0.2, 0.85, "0.08 um"),  # one step before the first
        (0.2, 0.2, 0.85, "0.2 um"),
        (0.12, 0.3, 0.85, "0.3 um"),
        (0.12, 0.2, 0.8500001, "holds 0.78, 0.85 um"),
    ],
)
def test_what_the_table_does_not_hold_is_refused_by_name(x, y, wave, word):
    with pytest.raises(DomainError, match=word):
        pairs().amplitude(np.array([0.12, x]), np.array([0.2, y]), wave, "x")


def test_one_size_is_an_axis_too():
    one = TwoSizeTable(WAVES, X[:1], Y, T[:, :1], (210.0, 900.0))
    assert one.amplitude(np.array([0.1]), Y[2:], 0.78, "y").tolist() == [T[0, 0, 2, 1]]
    with pytest.raises(DomainError, match=r"0\.18 um"):
        one.amplitude(np.array([0.18]), Y[2:], 0.78, "y")


def test_a_table_of_another_shape_or_not_finite_is_refused():
    for wrong in (T[:1], T[..., :1], np.where(T[0, 0, 0, 0] == T, np.nan, T)):
        with pytest.raises(LensError, match="need finite values"):
            TwoSizeTable(WAVES, X, Y, wrong, (210.0, 900.0))


def test_it_comes_back_from_arrays_and_stands_where_a_proxy_does():
    back = store.build_record(
        TwoSizeTable, *store.flatten_record(pairs()), where="a file"
    )
    assert back.focus_y_um == (210.0, 900.0)
    for name in ("wavelength_um", "x_um", "y_um", "t"):
        assert np.array_equal(getattr(back, name), getattr(pairs(), name))
    proxy = pairs().proxy
    low, high = proxy.domain_um
    assert low == X[0]
    assert X[-1] < high < X[-1] + 1e-6
    with pytest.raises(DomainError, match="no proxy of one diameter"):
        proxy.transmission(0.1, 0.85)
