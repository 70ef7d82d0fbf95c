"""Markers of violations lie where the violation is, in micrometres, whatever the unit
of the mask.
"""

from types import SimpleNamespace

import pytest

from layout.rules import markers
from layout.rules.report import Violation


@pytest.mark.parametrize("unit_nm", [1.0, 0.25])
def test_a_marker_s_box_is_the_violation_s_in_micrometres(unit_nm):
    violation = Violation("gap", (-41_000, 7_300, -40_200, 9_900), 57.31, 80.0, "lens")
    box, text = markers._values(SimpleNamespace(unit_nm=unit_nm), violation)
    numbers = [
        float(n)
        for n in box.removeprefix("box: (")
        .removesuffix(")")
        .replace(";", ",")
        .split(",")
    ]
    assert numbers == pytest.approx(
        [unit_nm * n for n in (-41.0, 7.3, -40.2, 9.9)], rel=1e-6
    )
    assert text == "text: 'lens: 57.31, need 80'"
