"""Bias by its polynomial and table, ends of both, isolation, inverse and the slope that
is refused.
"""

from pathlib import Path

import numpy as np
import pytest

from metalens.ground.errors import ProcessError
from metalens.made.bias import STEEPEST, Bias, read_csv

TABLE = ((80.0, -6.0), (120.0, -3.5), (180.0, -1.0))


def test_a_curve_is_constant_beyond_ten_nanometres_and_two_micrometres():
    bias = Bias(curve_nm=(-8.0, 3.0, -0.03))
    assert bias.at(250.0) == pytest.approx(-8 + 7.5 - 0.1875)
    assert bias.at(np.array([3.0, 10.0])) == pytest.approx(
        np.array([-7.7003] * 2)
    )  # at 0.1 of 100 nm
    assert bias.at(np.array([2000.0, 2600.0])) == pytest.approx(
        np.array([40.0] * 2)
    )  # -8 + 60 - 12 at 20
    assert Bias().at(np.array([[7.0, 9.0, 11.0]])).tolist() == [[0.0, 0.0, 0.0]]


def test_what_is_made_adds_the_bias_and_the_share_of_isolation():
    """At 100 nm, half way between the knots: -4.75; 0.25 of 2.2 for a pillar of some
    neighbours.
    """
    bias = Bias(table_nm=TABLE, isolated_nm=2.2)
    assert bias.made_nm(100.0) == pytest.approx(95.25)
    assert bias.made_nm(
        np.array([100.0, 300.0]), np.array([0.25, 1.0])
    ) == pytest.approx(np.array([95.8, 301.2]))
    assert bias.drawn_nm(
        np.array([95.8, 301.2]), np.array([0.25, 1.0])
    ) == pytest.approx(np.array([100.0, 300.0]), abs=1e-9)
    assert bias.drawn_nm(np.zeros(0)).shape == (0,)


def test_the_steepest_curve_that_is_taken_is_inverted_to_its_digits():
    """Nearly half a nanometre a nanometre: each round leaves half of the last one's
    error, 60 of them 1e-16 nm.
    """
    assert STEEPEST == 0.5
    assert Bias(curve_nm=(0.0, 49.9)).drawn_nm(299.8) == pytest.approx(200.0, abs=1e-9)
    assert Bias(curve_nm=(0.0, -49.9)).drawn_nm(150.3) == pytest.approx(300.0, abs=1e-9)
    for slope, told in ((51.0, "by 0.51 nm per nm"), (-51.0, "by -0.51 nm per nm")):
        with pytest.raises(ProcessError, match=told):
            Bias(curve_nm=(0.0, slope))


def test_the_steepest_piece_of_a_table_is_told_by_its_diameter():
    with pytest.raises(ProcessError, match=r"changes by -0.60 nm per nm at 120 nm"):
        Bias(table_nm=((80.0, 4.0), (120.0, -4.0), (130.0, -10.0)))
    assert Bias(table_nm=((80.0, 4.0), (120.0, -16.0))).at(100.0) == -6  # -0.5 is taken


@pytest.mark.parametrize(
    ("told", "about"),
    [
        ("more than once", {"table_nm": TABLE, "curve_nm": (1.0,)}),
        ("more than once", {"table_nm": TABLE, "csv": Path("b.csv")}),
        ("not finite", {"table_nm": ((80.0, np.nan), (90.0, 1.0))}),
        ("not finite", {"isolated_nm": np.inf}),
        ("above 0", {"range_um": 0.0}),
        ("must rise", {"table_nm": ((80.0, 1.0), (80.0, 1.0))}),
        ("must rise", {"table_nm": ((0.0, 1.0), (80.0, 1.0))}),
    ],
)
def test_what_cannot_be_a_bias_is_refused(told, about):
    with pytest.raises(ProcessError, match=told):
        Bias(**about)


def test_ranges_and_the_pillar_alone_are_as_promised():
    assert (Bias().isolated_nm, Bias().range_um) == (0.0, 1.0)
    assert Bias(csv=Path("b.csv")).at(100.0) == 0  # until its file is read


def test_a_file_with_and_without_a_head_and_a_line_that_is_no_pair(tmp_path):
    file = tmp_path / "b.csv"
    file.write_text("# a note\ndrawn nm, bias nm\n90, -8.5\n\n250, 1.25\n")
    assert read_csv(file) == ((90.0, -8.5), (250.0, 1.25))
    file.write_text("9, -8.5\n250, 1.25\n")
    assert read_csv(file) == ((9.0, -8.5), (250.0, 1.25))
    file.write_text("90;-8,5\n250;1,25\n")
    assert read_csv(file) == ((90.0, -8.5), (250.0, 1.25))
    file.write_text("drawn, bias\n90, -8.5\nwide, 3\n")
    with pytest.raises(ProcessError, match="line 3: 'wide, 3'"):
        read_csv(file)
    for nothing in ("", "drawn, bias\n"):
        file.write_text(nothing)
        with pytest.raises(ProcessError, match="no numbers"):
            read_csv(file)
