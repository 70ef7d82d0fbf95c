"""SemMicrograph on design: the scatter at every shift by plain least squares, the standard
error of each knot.
"""

import numpy as np
import pytest

from characterize.measure import overlay

RNG = np.random.default_rng(5)


def test_knots_of_a_bias_table_carry_mean_and_standard_error():
    designed = np.repeat([110.0, 170.0, 260.0], [7, 7, 6])
    error = RNG.normal(0, 3.0, 20) + designed * 0.02
    outlier = np.zeros(20, bool)
    outlier[3] = True
    laid = overlay.MaskOverlay(
        designed, error, 0, 0, site=np.zeros((0, 2)), clearly=True, outlier=outlier
    )
    table = overlay.bias_table(laid, knots=3)
    kept_drawn, kept_error = designed[~outlier], error[~outlier]
    for (drawn, made, sigma, count), part in zip(
        table, np.array_split(np.arange(19), 3), strict=True
    ):
        assert count == len(part)
        assert drawn == pytest.approx(kept_drawn[part].mean())
        assert made == pytest.approx(kept_error[part].mean())
        assert sigma == pytest.approx(
            np.std(kept_error[part], ddof=1) / np.sqrt(len(part)), rel=1e-12
        )
    covered = 0
    for _ in range(
        300
    ):  # each of the three within 2.2 of its sigma: 5 or 6 degrees of freedom, 93 %
        drawn = RNG.normal(0, 3.0, 20)
        rows = overlay.bias_table(
            overlay.MaskOverlay(
                designed,
                drawn,
                0,
                0,
                site=np.zeros((0, 2)),
                clearly=True,
                outlier=outlier,
            ),
            knots=3,
        )
        covered += sum(abs(row[1]) < 2.2 * row[2] for row in rows)
    assert 0.88 < covered / 900 < 0.97
