"""Running extremes of exposure errors: the worst lies on either side, and the diameter
follows from the slope.
"""

import numpy as np
import pytest

from layout.pec.uniformity import ErrorTally


def test_the_worst_error_may_lie_below():
    tally = ErrorTally()
    tally.merge(np.array([-0.03, 0.01, 0.0011, 3.0]))
    tally.merge(np.array([-0.02, 0.004, 0.0005, 2.0]))
    assert tally.worst == 0.03
    found = tally.result(slope=4.0, shift=0.002)
    assert found.worst == pytest.approx(0.032)
    assert found.rms == pytest.approx((0.0016 / 5) ** 0.5 + 0.002)
    # an edge moves by error / slope, both edges of a diameter do: 2 x 0.032 / 4 um
    assert found.diameter_nm == pytest.approx(16.0)


def test_or_above():
    tally = ErrorTally()
    tally.merge(np.array([-0.01, 0.07, 0.0049, 1.0]))
    assert tally.worst == 0.07
    assert tally.result(slope=2.0, shift=0.001).rms == pytest.approx(
        0.071
    )  # of one pillar its own error


def test_nothing_taken_in_is_no_error():
    assert ErrorTally().worst == 0.0
    assert ErrorTally().result(2.0, 0.0).rms == 0.0
