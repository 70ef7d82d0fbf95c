"""A search for diameters on a rational function that is known: it ends where the fit
tells it, and the bars hold.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from metalens.pillars import curve


def known(diameter_um):
    """t and r with one pole pair 12 nm off the axis near 0.213 um."""
    place = 1 / (diameter_um - (0.213 + 0.012j))
    t, r = 0.3 + 0.4j + 0.004 * place, 0.2 - 0.1j - 0.002j * place
    return SimpleNamespace(t=t, r=r, t_error=0.0, energy=1.0)


@pytest.mark.parametrize("cheaper", [None, np.array([0.05, 0.1371, 0.2222, 0.41])])
def test_a_search_ends_where_two_new_nodes_are_told_by_the_fit(cheaper):
    nodes = curve.explore(known, 0.1, 0.4, tolerance=1e-6, cheaper_um=cheaper)
    assert nodes.converged
    assert (
        nodes.reason
        == f"the last 2 of {len(nodes.diameter_um)} solves were predicted within 1e-06"
    )
    assert nodes.diameter_um[:13] == pytest.approx(
        0.25 - 0.15 * np.cos(np.pi * np.arange(13) / 12)
    )
    assert nodes.response[:, 0] == pytest.approx(
        [known(d).t for d in nodes.diameter_um]
    )
    assert (
        len(nodes.diameter_um) == 15
    )  # a function of one pole is told by the first thirteen
    first = np.sort(nodes.diameter_um[:13])
    gap = first[np.argmax(np.diff(first))], np.diff(first).max()
    assert abs(nodes.diameter_um[13] - gap[0] - gap[1] / 2) <= gap[1] / 4
    at = np.random.default_rng(1).uniform(0.1, 0.4, 60)
    value, error = curve.curve(nodes, tolerance=1e-6)(at)
    missed = np.abs(value[:, 0] - [known(d).t for d in at])
    assert (missed <= error).all()
    assert missed.max() < 1e-9


def test_a_search_that_may_not_go_on_says_so():
    nodes = curve.explore(known, 0.1, 0.4, tolerance=1e-6, most=14)
    assert not nodes.converged
    assert nodes.reason == "14 solves do not meet 1e-06"
