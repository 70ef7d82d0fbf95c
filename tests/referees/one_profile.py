"""The profile of one parameter about one valley, both sides followed by themselves."""

import math

from characterize.inference.ends import find_limit, join_limits
from characterize.inference.posterior import REACH


def profile(valley, i, *, level=REACH**2):
    """Out to a rise of ``level``; second: a place below the mode, if one was met."""
    goal = math.sqrt(level)
    sides = [find_limit(valley, i, sign, goal) for sign in (-1, 1)]
    better = next((one.lower for one in sides if one.lower is not None), None)
    return join_limits(
        sides, float(valley.mode[i]), float(valley.sigma[i]), goal
    ), better
