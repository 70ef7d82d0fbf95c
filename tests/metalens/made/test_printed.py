"""What is known of a mask without drawing one is what its maker's rules say."""

from layout.process import Rules
from metalens.made import Printed, of_process


def test_pillars_of_no_stated_mask_come_in_the_steps_of_the_default_rules(tmp_path):
    """The one number that both hold: metalens does not load layout."""
    assert Printed().diameter_step_nm == Rules().diameter_step_nm
    (tmp_path / "p.toml").write_text("[rules]\nminimum_gap_nm = 61.0\n")
    assert of_process(tmp_path / "p.toml") == Printed()
