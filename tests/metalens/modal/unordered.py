"""Eigenvalues in no order: conjugates share their real part, and rounding decides which
of them comes first.
"""

import numpy as np
from scipy import optimize


def apart(found, want):
    """(n,) distance of every wanted value from the found one that is its own, in parts
    of 1 + its size.
    """
    distance = np.abs(np.subtract.outer(found, want)) / (1 + np.abs(want))
    mine, theirs = optimize.linear_sum_assignment(distance)
    assert len(mine) == len(found) == len(want)
    return distance[mine, theirs]
