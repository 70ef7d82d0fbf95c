"""Subjects are drawn from the population that is documented: mean and deviation of
every trait, cut at its limits.
"""

import numpy as np
import pytest

from codesign.eye import population
from codesign.eye.population import POPULATION


def test_traits_of_many_subjects_have_the_documented_mean_and_deviation():
    """4000 draws: means to 1.6 % of a deviation, deviations to 1.1 %, three times that;
    what limits of two deviations
    and more cut off takes a tenth of them at most."""
    drawn = population.draw_states(4000, 3).traits.numpy()
    assert drawn.shape == (4000, len(POPULATION))
    for column, (name, trait) in zip(drawn.T, POPULATION.items(), strict=True):
        assert trait.low <= column.min() <= trait.mean <= column.max() <= trait.high, (
            name
        )
        if trait.sd:
            assert abs(column.mean() - trait.mean) < 0.1 * trait.sd, name
            assert column.std() == pytest.approx(trait.sd, rel=0.13), name
    together = np.corrcoef(drawn[:, drawn.std(0) > 0].T)
    assert (
        np.abs(together - np.eye(len(together))).max() < 0.08
    )  # each for itself: 5 of 0.016
