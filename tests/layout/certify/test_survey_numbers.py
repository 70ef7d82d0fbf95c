"""Sums over pillars and the verdict on them, typed in; weights of Gaussians."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import special

from layout.certify import certificate
from layout.certify.verdict import Edges, Survey, Tally
from layout.dose import assign
from layout.process.process import Exposure

BOX = (-20.0, -30.0, 60.0, 50.0)  # 80 um wide: half a micrometre a point of the map
NONE = np.array([])


def survey(tally, *, exposure=NONE, shift=NONE, lean=0.0, undosed=()):
    edges = Edges(0 * exposure, 0 * exposure, exposure, shift, 0 * exposure)
    return Survey(9, tally, BOX, edges, lean, undosed)


def taken(off_nm, exposure=1.0, judged=True, place=(0.0, 0.0), made=150.0):
    """A tally of pillars 148 nm wide, ``off_nm`` wider in the resist, at x, y."""
    off = np.atleast_1d(np.asarray(off_nm, float))
    full = [
        np.broadcast_to(np.asarray(v, float), off.shape).copy()
        for v in (place[0], place[1], exposure, made)
    ]
    drawn = np.full(off.shape, 148.0)
    made_of = np.broadcast_to(np.asarray(judged), off.shape).copy()
    tally = Tally.empty()
    tally.take((full[0], full[1]), made_of, (full[2], drawn, drawn + off, full[3]), BOX)
    return tally


def test_sums_hold_the_worst_of_judged_pillars_alone():
    tally = taken(
        [0.4, -0.7, 5.0],
        exposure=[1.004, 0.991, 1.5],
        judged=[True, True, False],
        made=[141.0, 163.5, 900.0],
    )
    assert tally.ends == pytest.approx([0.009, 0.7, 141.0, 163.5])
    found = survey(tally, lean=3.5)
    assert (found.worst_exposure, found.worst_nm) == pytest.approx((0.009, 0.7))
    assert (found.thinnest_top_nm, found.widest_foot_nm) == pytest.approx(
        (137.5, 167.0)
    )
    assert found.ok


def test_the_map_is_the_mean_in_half_a_micrometre():
    x, y = (
        [0.1, 0.4, 0.6, 59.9, 75.0],
        [-29.6, -29.9, -29.9, 49.8, 90.0],
    )  # the last one lies outside: it counts at the rim
    found = survey(taken([0.2, 0.6, -0.3, 0.5, 0.1], place=(x, y))).map_nm
    assert found.shape == (160, 160)
    assert found[0, 40] == pytest.approx(0.4)  # (0.1 + 20) / 0.5
    assert found[0, 41] == pytest.approx(-0.3)
    assert found[159, 159] == pytest.approx(0.3)
    assert np.isfinite(found).sum() == 3


def test_the_histogram_counts_in_sixteenths_of_a_nanometre():
    """From the first used bin to the last; what lies beyond 8 nm counts in the
    outermost.
    """
    edges, counts = survey(taken([-0.01, 0.01, 0.06, 0.0626, -0.07])).histogram
    assert edges == pytest.approx([-0.125, -0.0625, 0, 0.0625, 0.125])
    assert counts.tolist() == [1, 1, 2, 1]
    edges, counts = survey(taken([-40.0, 7.99, 40.0])).histogram
    assert (edges[0], edges[-1]) == (-8, 8)
    assert (counts[0], counts[-1], counts.sum()) == (1, 2, 3)
    edges, counts = survey(Tally.empty()).histogram
    assert len(edges) == 2
    assert counts.tolist() == [0]


@pytest.mark.parametrize(
    ("more", "ok"),
    [
        ({"exposure": 1.0099}, True),
        ({"exposure": 1.0101}, False),
        ({"exposure": 0.9899}, False),
        ({"off": 0.99}, True),
        ({"off": -1.01}, False),
        ({"edges": [1.0] * 99 + [1.019]}, True),
        (
            {"edges": [1.0] * 99 + [0.979]},
            False,
        ),  # one point of a hundred, but beyond 2 %
        (
            {"edges": [1.0] * 98 + [1.011, 1.012]},
            False,
        ),  # two points of a hundred beyond 1 %
        ({"edges": [1.0] * 198 + [1.011, 1.012]}, True),
        ({"shift": 0.49}, True),
        ({"shift": -0.51}, False),  # both edges of a line
        ({"undosed": ((7, 0),)}, False),
    ],
)
def test_what_a_sound_exposure_keeps(more, ok):
    """Pillars 1 % of dose-to-size, everything 1 nm of width, marks 1 % at 99 of 100
    points and 2 % at all.
    """
    edges = np.array(more.get("edges", [1.0, 1.0]))
    shift = np.full(len(edges), more.get("shift", 0.0))
    tally = taken(more.get("off", 0.0), exposure=more.get("exposure", 1.0))
    assert (
        survey(tally, exposure=edges, shift=shift, undosed=more.get("undosed", ())).ok
        is ok
    )


def test_gaussians_weigh_as_their_energies_with_sum_1():
    exposure = Exposure(alpha_um=0.04, beta_um=11.0, eta=0.7, gamma_um=2.5, nu=0.3)
    terms = certificate._terms(SimpleNamespace(exposure=exposure))
    assert terms == [
        (0.04, pytest.approx(1 / 2)),
        (11.0, pytest.approx(0.35)),
        (2.5, pytest.approx(0.15)),
    ]
    terms = certificate._terms(
        SimpleNamespace(exposure=Exposure(alpha_um=0.04, beta_um=11.0, eta=0.6))
    )
    assert terms == [(0.04, pytest.approx(1 / 1.6)), (11.0, pytest.approx(0.6 / 1.6))]


def test_an_edge_error_moves_both_edges_of_a_line():
    """Exposure across an edge is sum w (1 + erf(x / a)) / 2: what it changes over half
    of what a width may.
    """
    widths, weights = np.array([0.05, 3.0, 9.0]), np.array([0.5, 0.3, 0.2])
    point = SimpleNamespace(widths_um=widths, weights=weights)
    half = assign._SOFTEST_UM / 2
    rise = (weights * special.erf(half / widths)).sum() / 2
    assert assign.straight_edge_error(point) == pytest.approx(
        rise / assign.CLEARS, rel=1e-3
    )  # straight: (half / a)² / 3
