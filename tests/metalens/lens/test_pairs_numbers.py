"""A table of pillars of two sizes, number by number: entries, ends, focus of the other
light, error of its entries.
"""

import math

import numpy as np
import pytest

from metalens.ground.errors import DomainError, LensError
from metalens.lens.pairs import Pairs

WAVES, X, Y = (
    np.array([0.63, 0.71, 0.94]),
    np.array([0.11, 0.14, 0.17]),
    np.array([0.2, 0.25, 0.3, 0.35]),
)
T = (np.arange(72.0).reshape(3, 3, 4, 2) + 1) * (0.01 - 0.002j)


def made(**other):
    return Pairs(WAVES, X, Y, T, (210.0, 900.0), **other)


def test_an_entry_is_its_place_in_the_table():
    """Place 1 + ((w 3 + x) 4 + y) 2 + light of the table counts up from 1."""
    x, y = np.array([[0.14, 0.11, 0.0]]), np.array([[0.25, 0.35, 0.0]])
    for light, places in (("x", [35, 31, 0]), ("y", [36, 32, 0])):
        assert made().amplitude(x, y, 0.71, light) == pytest.approx(
            np.array([places]) * (0.01 - 0.002j), rel=1e-15
        )
    assert made().amplitude(x, y, 0.94, "y")[0, 1] == pytest.approx(
        56 * (0.01 - 0.002j), rel=1e-15
    )


def test_a_wavelength_is_held_to_a_billionth_and_a_size_to_a_twentieth_of_its_step():
    one, other = np.array([0.14]), np.array([0.3])
    assert made().amplitude(one, other, 0.71 + 0.9e-9, "x") == made().amplitude(
        one, other, 0.71, "x"
    )
    for off in (1.2e-9, -1.2e-9):
        with pytest.raises(DomainError, match=r"0\.63, 0\.71, 0\.94"):
            made().amplitude(one, other, 0.71 + off, "x")
    assert (
        made().amplitude(one - 0.049 * 0.03, other + 0.049 * 0.05, 0.71, "x").size == 1
    )
    for x, y, told in (
        (0.14 + 0.052 * 0.03, 0.3, "0.14156"),
        (0.14, 0.3 - 0.052 * 0.05, "0.2974"),
    ):
        with pytest.raises(DomainError, match=f"{told} um"):
            made().amplitude(np.array([0.17, x]), np.array([0.35, y]), 0.71, "x")
    for x, y, told in (
        (0.2, 0.3, "0.2"),
        (0.23, 0.3, "0.23"),
        (0.14, 0.4, "0.4"),
        (0.14, 0.45, "0.45"),
        (0.14, 0, "0"),
    ):
        with pytest.raises(
            DomainError, match=f"of {told} um"
        ):  # beyond the last, and a pillar of no length
            made().amplitude(np.array([x]), np.array([y]), 0.71, "x")


def test_a_single_size_counts_in_steps_of_a_micrometre():
    """Any step would do for its own place; beside it a twentieth of a micrometre is the
    limit.
    """
    one = Pairs(WAVES, X[:1], Y, T[:, :1], (210.0, 900.0))
    assert one.amplitude(np.array([0.15]), np.array([0.25]), 0.63, "x") == T[0, 0, 1, 0]
    with pytest.raises(DomainError, match=r"0\.17 um"):
        one.amplitude(np.array([0.17]), np.array([0.25]), 0.63, "x")


def test_two_sizes_have_their_own_step():
    two = Pairs(WAVES, X[:2], Y, T[:, :2], (210.0, 900.0))
    assert two.amplitude(np.array([0.14]), np.array([0.25]), 0.63, "y") == T[0, 1, 1, 1]


def test_what_stands_for_a_proxy_knows_its_ends_and_the_error_of_the_entries():
    stands = made(entry_error=0.013).proxy
    assert stands.domain_um == (0.11, pytest.approx(0.17 + 1e-9, abs=1e-12))
    assert stands.domain_um[1] > 0.17
    assert stands.wavelengths_um == (0.63, 0.94)
    assert stands.entry_error == 0.013
    assert (
        stands.phase_coefficients.tolist()
        == stands.transmission_coefficients.tolist()
        == [[0.0]]
    )
    assert (stands.max_phase_error_rad, stands.max_transmission_error) == (0.0, 0.0)
    assert math.isnan(made().entry_error)
    assert made().proxy.entry_error == 0
    with pytest.raises(LensError, match="no proxy of one diameter"):
        stands.phase_rad(np.array([0.12]), 0.71)


def test_arrays_bring_everything_back_and_older_ones_have_no_error():
    arrays = made(entry_error=0.013).to_arrays()
    back = Pairs.from_arrays(arrays)
    assert (back.focus_y_um, back.entry_error) == ((210.0, 900.0), 0.013)
    assert all(
        np.array_equal(getattr(back, name), want)
        for name, want in zip(arrays, (WAVES, X, Y, T), strict=False)
    )
    del arrays["entry_error"]
    assert math.isnan(Pairs.from_arrays(arrays).entry_error)


def test_a_table_of_another_shape_is_refused():
    for t in (T[:, :, :3], T[:, :2], T.transpose(0, 2, 1, 3), T[..., :1]):
        with pytest.raises(LensError, match="need finite values of"):
            Pairs(WAVES, X, Y, t, (210.0, 900.0))
    with pytest.raises(LensError, match="need finite values of"):
        Pairs(WAVES, X[:0], Y, T[:, :0], (210.0, 900.0))
