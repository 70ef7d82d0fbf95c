"""Bars of what a network reads, and what is asked for where a table is too open: closed
forms, unlike numbers.
"""

import statistics
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.model import PLACE
from codesign.adapt import reading, sure


def test_the_interval_of_a_mean_is_its_95_percent():
    """A mean of 700 skewed values: 1.96 of its standard error to either side; 4000
    draws leave 2 % of it, skewness
    of Γ(2.3), 1.32, moves both ends by 1.32 / (6 √700) (1.96² - 1) = 2.4 % of one."""
    values = np.random.default_rng(3).gamma(2.3, 0.41, 700)
    low, high = reading.bootstrap_interval(values, draws=4000, seed=8)
    error = values.std() / np.sqrt(700)
    assert (low, high) == pytest.approx(
        (values.mean() - 1.96 * error, values.mean() + 1.96 * error), abs=0.1 * error
    )


def test_intervals_hold_the_mean_in_95_of_100_sets():
    """400 sets of 60 values; a bootstrap of so few is short by 1 / 120 of its width:
    94.5 %, scatter 1.1 %.
    """
    draw, held = np.random.default_rng(21), 0
    for k in range(400):
        low, high = reading.bootstrap_interval(
            draw.normal(3.7, 1.3, 60), draws=400, seed=k
        )
        held += low < 3.7 < high
    assert 0.915 < held / 400 < 0.975


@pytest.mark.parametrize(
    ("ends", "usable"),
    [((0.1, 1.98), True), ((0.1, 2.02), False), ((2.02, 0.1), False)],
)
def test_a_table_is_used_where_its_widest_entry_is_known_to_two_nanometres(
    monkeypatch, ends, usable
):
    """Standard deviations of 24 draws by hand, about their own mean."""
    drawn = np.random.default_rng(4).gamma(1.7, 2.0, 24)
    drawn = (drawn - drawn.mean()) / statistics.stdev(drawn)
    monkeypatch.setattr(sure, "_settled", lambda *_: "care")
    result = SimpleNamespace(
        samples=lambda n, seed: drawn[:n], parameters=lambda row: row, names=()
    )
    found = sure.judge_correction(result, lambda x: 7.0 + x * np.array(ends))
    assert found.sigma_nm == pytest.approx(np.array(ends), rel=1e-9)
    assert found.usable == usable
    assert found.table_nm.shape == (24, 2)


@pytest.mark.parametrize(("own", "asked"), [(1.3, False), (1.4, True)])
@pytest.mark.parametrize("along", [1.7, -1.7])
def test_frames_are_asked_for_where_the_model_alone_leaves_seven_tenths_of_what_is_allowed(
    own, asked, along
):
    """1.7 nm a nm, of 1.3 or 1.4 nm: 2.21 and 2.38, on either side of 0.7 x 3.3 = 2.31;
    a cause of 1 nm is named.
    """
    result = SimpleNamespace(
        names=("bias_nm",), value=np.array([2.0]), sigma=np.array([0.3]), causes=("a side wall",),
        by_cause=np.array([[1.0]]), within_covariance=np.array([[own**2]]),
        parameters=lambda values=(2.0,): np.array(values),
    )  # fmt: skip
    words = sure._settled(
        result,
        lambda x: np.array([0.4, along]) * x[0],
        np.array([0.9, 3.9]),
        (sure.TABLE, 3.3),
    )
    assert words.startswith("the side wall by a cross-section")
    assert ("both sides of focus" in words) == asked
    assert ("the diameters themselves" in words) != asked


@pytest.mark.parametrize(("second", "named"), [(0.5, False), (0.9, True)])
def test_causes_of_less_than_a_fifth_of_what_is_allowed_are_not_asked_for(
    second, named
):
    """Of 3.3 nm allowed, a fifth is 0.66: the table follows the bias by 1.7 nm a nm,
    which two causes move.
    """

    def table(x):
        return np.array([0.4, 1.7]) * x[PLACE["bias_nm"]]

    parameters = np.zeros(len(PLACE))
    result = SimpleNamespace(
        names=("bias_nm",), value=np.array([2.0]), sigma=np.array([0.3]),
        causes=("a side wall", "another refractive index"),
        by_cause=np.array([[1.1 / 1.7], [second / 1.7]]), within_covariance=np.array([[0.01]]),
    )  # fmt: skip

    def whole(values=result.value):
        out = parameters.copy()
        out[PLACE["bias_nm"]] = values[0]
        return out

    result.parameters = whole
    words = sure._settled(result, table, np.array([0.9, 3.9]), (sure.TABLE, 3.3))
    assert words.startswith("the side wall by a cross-section")
    assert ("ellipsometry" in words) == named
    assert "micrographs" in words
