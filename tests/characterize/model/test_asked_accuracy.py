"""Accuracy that is asked for: more digits where the tolerance is tighter; slopes of a
lens of one diameter.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from characterize.model import kernel
from metalens.core.errors import FitError


@pytest.mark.parametrize(
    ("tolerance", "more"), [(5e-4 / math.e**2, 2.0), (5e-7, math.log(1e3)), (5e-3, 0.0)]
)
def test_digits_are_counted_from_five_ten_thousandths_of_the_field(tolerance, more):
    assert kernel.extra_digits(tolerance) == pytest.approx(more, abs=1e-12)


def test_tables_hold_five_times_the_rounding_of_their_columns():
    """Of 300 rows in single precision 6e-8 x 2 x sqrt(300) of the norm is rounding; a
    fifth of a tolerance may be left.
    Just above that, what is found of a table of rank 7 is its range and no noise."""
    rng = np.random.default_rng(3)
    columns, rows = (rng.standard_normal((2, *shape)) for shape in ((300, 7), (7, 200)))
    table = ((columns[0] + 1j * columns[1]) @ (rows[0] + 1j * rows[1])).astype(
        np.complex64
    )
    least = 2.0**-23 * math.sqrt(300) * 5
    assert kernel.least_tolerance(table) == pytest.approx(least, rel=1e-9)
    left, right, _ = kernel.low_rank_factors(table, 1.02 * least)
    assert left.shape[1] == 7
    assert np.linalg.norm(left @ right - table) < least * np.linalg.norm(table)
    with pytest.raises(FitError, match="of their norm"):
        kernel.low_rank_factors(table, 0.98 * least)
