"""Limits that a process puts on a design: what they let through, the mask draws within
the rules.
"""

import numpy as np
import pytest

import layout
from layout.process import process
from layout.process.limits import printable_limits
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap

COARSE = "[rules]\nminimum_feature_nm = 100\nminimum_gap_nm = 90\ngrid_nm = 5\ndiameter_step_nm = 5\n"
ALONE = COARSE + "[bias]\nisolated_nm = {}\nrange_um = 0.9\n"
BIASED = (
    COARSE
    + "[bias]\ntable_nm = [[80, -6.0], [200, 3.0], [340, 1.0]]\n[etch]\nsidewall_deg = 0.8\n"
)


@pytest.mark.parametrize("text", [COARSE, BIASED])
def test_designs_at_the_limits_are_drawn_within_the_rules(tmp_path, text):
    path = tmp_path / "process.toml"
    path.write_text(text)
    least, gap = printable_limits(path, pitch_um=0.4, height_um=0.7)
    rules = process.load_process(path)
    sizes = np.random.default_rng(1).uniform(least, 400 - gap, (30, 30)) * 1e-3
    sizes[0, :3] = np.array([least, 400 - gap, 400 - gap]) * 1e-3
    found = layout.check_plan(
        layout.plan(DiameterMap(sizes, 0.4), rules, furnished=False), rules.rules
    )
    assert found.ok, found.summary
    # and they give away no more than a step or two
    assert found.minimum_space_nm < 90 + 10
    assert found.minimum_width_nm < 100 + 10


def drawn_well(diameter_nm, rules, *, alone):
    """Whether the mask of a field of one diameter, or of one pillar alone, keeps the
    rules.
    """
    sizes = np.zeros((11, 11))
    sizes[5, 5] = diameter_nm * 1e-3
    planned = layout.plan(
        DiameterMap(sizes if alone else sizes.max() + 0 * sizes, 0.4),
        rules,
        furnished=False,
    )
    return layout.check_plan(planned, rules.rules).ok


@pytest.mark.parametrize(
    ("text", "alone"),
    [
        (COARSE, False),
        (BIASED, False),
        (ALONE.format(7.3), True),
        (ALONE.format(-7.3), False),
    ],
    ids=["plain", "biased", "wider alone", "thinner alone"],
)
def test_a_tenth_of_a_step_beyond_the_limits_the_mask_breaks_a_rule(
    tmp_path, text, alone
):
    """A pillar rounds to the step within half of one: a twentieth is given away. The
    thinnest is asked of pillars that
    come out the widest, whose drawn ones are the thinnest; pairs that come out thinner
    are never alone, so that there
    the widest loses what isolation takes."""
    path = tmp_path / "process.toml"
    path.write_text(text)
    rules = process.load_process(path)
    least, gap = printable_limits(path, pitch_um=0.4, height_um=0.7)
    for one in (False, True):
        assert drawn_well(least + 0.05, rules, alone=one)
        assert drawn_well(400 - gap - 0.05, rules, alone=one)
    assert not drawn_well(least - 0.5, rules, alone=alone)
    assert not drawn_well(
        400 - gap + 0.5 - min(0.0, rules.bias.isolated_nm), rules, alone=False
    )


def test_a_process_that_prints_nothing_on_this_pitch_is_refused(tmp_path):
    path = tmp_path / "process.toml"
    path.write_text(COARSE)
    with pytest.raises(ProcessError, match="widen the pitch"):
        printable_limits(path, pitch_um=0.18, height_um=0.7)
