"""What a PROCESS.toml says of bias, spread and step, as numbers."""

import pytest

from metalens.ground.errors import ConfigError
from metalens.made.bias import Bias
from metalens.made.printed import DIAMETER_STEP_NM, Printed, of_process, with_table
from metalens.made.spread import Spread


def test_each_entry_is_taken_and_the_rest_is_as_ever(tmp_path):
    file = tmp_path / "p.toml"
    file.write_text(
        "[bias]\ncurve_nm = [-4.5, 1.5]\n[rules]\ndiameter_step_nm = 5.0\nminimum_gap_nm = 61.0\n"
    )
    assert of_process(file) == Printed(Bias(curve_nm=(-4.5, 1.5)), Spread(), 5.0)
    file.write_text("[bias]\nisolated_nm = 3.5\n")
    assert of_process(file) == Printed(Bias(isolated_nm=3.5), Spread(), 2)
    assert DIAMETER_STEP_NM == 2  # nm of diameter from class to class
    file.write_text("rules = 3\n")  # of no table the step is not asked
    assert of_process(file) == Printed()
    file.write_text("[bias]\nisolated = 3.5\n")
    with pytest.raises(ConfigError, match="isolated"):
        of_process(file)


def test_a_bias_without_a_file_stays_and_one_with_a_file_becomes_its_table(tmp_path):
    plain = Bias(curve_nm=(1.25,))
    assert with_table(plain, tmp_path) is plain
    (tmp_path / "b.csv").write_text("100, -3\n150, -1.5\n")
    assert with_table(Bias(csv="b.csv", isolated_nm=2.5), tmp_path) == Bias(
        table_nm=((100.0, -3.0), (150.0, -1.5)), isolated_nm=2.5
    )
