"""Bias: forward and inverse agree, a table is its own knots, isolation has its two
limits.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from layout.process.isolation import isolation_map
from metalens.core.errors import ProcessError
from metalens.fabrication.bias import Bias, read_csv

DESIGN = np.linspace(60, 360, 301)
TABLE = ((80.0, -6.0), (120.0, -3.5), (180.0, -1.0), (340.0, 1.0))


def test_table_is_exact_at_its_knots_linear_between_and_constant_beyond():
    bias = Bias(table_nm=TABLE)
    assert bias.at(np.array([80, 120, 100, 20, 500])) == pytest.approx(
        [-6, -3.5, -4.75, -6, 1]
    )


@given(
    slopes=st.lists(st.floats(-0.49, 0.49), min_size=1, max_size=6),
    start=st.floats(-20, 20),
    isolated=st.floats(-10, 10),
    alone=st.floats(0, 1),
)
def test_what_is_drawn_gives_what_was_designed(slopes, start, isolated, alone):
    knots = 80 + 40.0 * np.arange(len(slopes) + 1)
    values = start + np.r_[0, np.cumsum(40 * np.array(slopes))]
    bias = Bias(
        table_nm=tuple(zip(knots.tolist(), values.tolist(), strict=True)),
        isolated_nm=isolated,
    )
    made = bias.fabricated_nm(bias.drawn_nm(DESIGN, alone), alone)
    assert abs(made - DESIGN).max() < 1e-9  # contraction by 0.49 a round, 60 rounds


def test_isolation_matches_the_direct_sum_on_a_ragged_patch():
    rng = np.random.default_rng(3)
    present = rng.random((150, 170)) < 0.97
    present[:, 100:] = True
    present[40:, :60] = False
    got = isolation_map(present, (0.4, 0.4), 0.9)
    reach = 7  # ceil(3 range / pitch)
    steps = np.exp(-((np.arange(-reach, reach + 1) * 0.4 / 0.9) ** 2))
    weights = np.outer(steps, steps)
    weights[reach, reach] = 0
    padded = np.pad(present, reach).astype(float)
    for row, column in [
        (0, 0),
        (39, 30),
        (64, 64),
        (63, 128),
        (149, 169),
        (100, 61),
        (128, 127),
    ]:
        patch = padded[row : row + 2 * reach + 1, column : column + 2 * reach + 1]
        assert got[row, column] == pytest.approx(
            1 - (weights * patch).sum() / weights.sum(), abs=2e-6
        )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"table_nm": ((100.0, 0.0), (90.0, 1.0))}, "must rise"),
        ({"table_nm": ((100.0, 0.0), (110.0, 8.0))}, "nm per nm"),
        ({"table_nm": TABLE, "csv": Path("b.csv")}, "more than once"),
        ({"table_nm": ((100.0, float("inf")),)}, "not finite"),
        ({"range_um": 0.0}, "above 0"),
    ],
)
def test_an_impossible_bias_is_refused(options, words):
    with pytest.raises(ProcessError, match=words):
        Bias(**options)


@pytest.mark.parametrize(
    "text",
    [
        # a spreadsheet's byte-order mark is no reason to take numbers for a head
        "\ufeff90.5,-8\n250,1.25\n",
        "\ufeffmade of D 90;at 50 kV\n90,5;-8,0\n250;1,25\n",
        "90,5\t-8\r\n250\t1,25\r\n",
        '"drawn","bias"\n"90.5","-8"\n"250","1.25"\n',
        "90.5 -8\n250 1.25\n",
    ],
)
def test_a_table_of_a_spreadsheet_keeps_every_row(tmp_path, text):
    path = tmp_path / "bias.csv"
    path.write_text(text, encoding="utf-8", newline="")
    assert read_csv(path) == ((90.5, -8.0), (250.0, 1.25))


@pytest.mark.parametrize("text", ["9O,-8\n250,1\n", "90,-8,0\n250,1,0\n", "90;-8;5\n"])
def test_a_first_row_of_broken_numbers_is_no_head(tmp_path, text):
    path = tmp_path / "bias.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ProcessError, match=r"line 1: .*need two numbers"):
        read_csv(path)


def test_csv_with_head_comments_and_a_bad_line(tmp_path):
    good = tmp_path / "bias.csv"
    good.write_text(
        "# from micrographs\ndiameter_nm,bias_nm\n100,-3\n200,0.5\n\n", encoding="utf-8"
    )
    assert read_csv(good) == ((100.0, -3.0), (200.0, 0.5))
    bad = tmp_path / "bad.csv"
    bad.write_text("100,-3\n200,abc\n", encoding="utf-8")
    with pytest.raises(ProcessError, match="line 2"):
        read_csv(bad)
    empty = tmp_path / "empty.csv"
    empty.write_text("a,b\n", encoding="utf-8")
    with pytest.raises(ProcessError, match="no numbers"):
        read_csv(empty)
    with pytest.raises(ProcessError, match="cannot be read"):
        read_csv(tmp_path / "absent.csv")
