"""What is known of a mask without drawing one is what its maker's rules say."""

from layout.process.process import DesignRules
from metalens.fabrication import PrintedProcess, of_process


def test_pillars_of_no_stated_mask_come_in_the_steps_of_the_default_rules(tmp_path):
    """The one number that both hold: metalens does not load layout."""
    assert PrintedProcess().diameter_step_nm == DesignRules().diameter_step_nm
    (tmp_path / "p.toml").write_text("[rules]\nminimum_gap_nm = 61.0\n")
    assert of_process(tmp_path / "p.toml") == PrintedProcess()


def test_a_table_of_the_bias_lies_beside_the_file_that_names_it(tmp_path):
    """Wherever the command runs, and in its place."""
    (tmp_path / "fab").mkdir()
    (tmp_path / "fab" / "bias.csv").write_text("drawn,bias\n90.5,-8\n250,1.25\n")
    (tmp_path / "fab" / "p.toml").write_text(
        '[rules]\ndiameter_step_nm = 3\n[bias]\ncsv = "bias.csv"\n'
    )
    made = of_process(tmp_path / "fab" / "p.toml")
    assert made.bias.table_nm == ((90.5, -8.0), (250.0, 1.25))
    assert made.bias.csv is None
    assert made.diameter_step_nm == 3
