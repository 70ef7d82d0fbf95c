"""The error estimate of a mesh as its parts say, for discs of every width, at a cutoff
and after other meshes.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from metalens import modal
from metalens.cell import Cell, Incidence, Index
from metalens.modal import case_of, ladder, solve_on_mesh
from metalens.modal.ladder import DampedEstimate, ErrorFactors, MeshChoice, MeshLevel

THIN_PLAN, WIDE_PLAN = object(), object()
THIN = ErrorFactors(0.3, 1.4, flat=2e-4, steep=7e-4, oblique=3e-4)
WIDE = ErrorFactors(0.7, 0.9, flat=1e-4, at_cutoff=3.1, grazing=0.15)
ALONE, AFTER = ErrorFactors(2.2, 5.1, flat=6e-4), ErrorFactors(0.4, 0.6, moved=0.8)
RUNG = MeshLevel(
    "typed",
    (MeshChoice(THIN_PLAN, 0.6, THIN, AFTER), MeshChoice(WIDE_PLAN, 1.0, WIDE, THIN)),
    1e-2,
    alone=ALONE,
)
UNSEEN = 0.02 * 1e-2


def whole(first):
    """Of a cell of lenses: with the orders beyond the first."""
    return ladder.second_order_bound(first)


def found(t=0.6 + 0.1j, **other):
    usual = {
        "rim": 0.02,
        "waves": 0.05,
        "drift": 1.7,
        "grazing": 0.0,
        "bloch": 0.0,
        "size": 1.3,
        "strange": 0.0,
    }
    usual["beside"] = 0.0
    all_ = {"matrix": np.array([[0.1, t], [t, 0.2j]]), "damping": 1.0} | usual | other
    return SimpleNamespace(**all_, spread=all_["rim"] + all_["waves"])


@pytest.mark.parametrize(
    ("rho", "bloch", "size", "want"),
    [
        (0.2, 0.0, 1.3, 0.3 * 0.02 + 1.4 * 0.05 + (2e-4 + 7e-4 * 0.65**6) * 1.7),
        (0.5, 0.3, 1.3, 0.3 * 0.02 + 1.4 * 0.05 + (5e-4 + 7e-4 * 0.65**6) * 1.7),
        (0.5, 0.0, 2.5, 0.3 * 0.02 + 1.4 * 0.05 + (2e-4 + 7e-4 * 1.25**6) * 1.7),
        (0.8, 0.3, 1.3, 0.7 * 0.02 + 0.9 * 0.05 + 1e-4 * 1.7),
    ],
)
def test_the_estimate_adds_rim_waves_and_drift_by_the_width_of_the_disc_and_the_waves_in_a_pitch(
    rho, bloch, size, want
):
    """What elements of degree three get wrong of a wave rises as the sixth power of its
    number.
    """
    assert RUNG.choice(rho).plan is (THIN_PLAN if rho <= 0.6 else WIDE_PLAN)
    unseen = (
        UNSEEN if bloch else 0.0
    )  # at normal incidence a plane wave is uniform, which elements follow
    assert RUNG.error(found(bloch=bloch, size=size), rho) == pytest.approx(
        whole(want) + unseen, rel=1e-9
    )


def test_near_a_cutoff_the_difference_counts_more_and_so_do_exact_cutoffs():
    """Each mesh has a least factor there, which fades with the distance; a change by
    exact cutoffs counts in part.
    """
    at = found(grazing=0.04, beside=1.0)
    assert RUNG.error(at, 0.8) == pytest.approx(
        whole(3.1 * 0.07 + 1e-4 * 1.7 + 0.15 * 0.04), rel=1e-9
    )
    thin = 2.6 * 0.07 + (2e-4 + 7e-4 * 0.65**6) * 1.7 + 0.15 * 0.04
    assert RUNG.error(at, 0.5) == pytest.approx(whole(thin), rel=1e-9)
    half = max(0.7, 3.1 / 2) * 0.02 + max(0.9, 3.1 / 2) * 0.05 + 1e-4 * 1.7
    assert RUNG.error(found(beside=0.5), 0.8) == pytest.approx(whole(half), rel=1e-9)
    assert RUNG.error(found(beside=0.1), 0.8) == RUNG.error(found(), 0.8)
    assert (
        RUNG.error(found(grazing=0.04, strange=1.0), 0.5)
        > RUNG.error(found(strange=1.0), 0.5) + 0.005
    )


def test_a_mesh_meant_for_wider_discs_is_judged_as_the_own_and_the_wider_one():
    """The larger of both: neither was chosen on thin discs on the mesh of wide ones."""
    wide, thin = RUNG.choices[1], RUNG.error(found(), 0.5)
    of_wide = 0.7 * 0.02 + 0.9 * 0.05 + 1e-4 * 1.7
    assert RUNG.error(found(), 0.5, mesh=wide) == pytest.approx(
        max(thin, whole(of_wide)), rel=1e-9
    )
    much_rim = found(rim=1.1)
    assert RUNG.error(much_rim, 0.5, mesh=wide) == pytest.approx(
        whole(0.7 * 1.1 + 0.9 * 0.05 + 1.7e-4), rel=1e-9
    )


def test_factors_of_wider_discs_do_not_count_where_the_mesh_is_the_own():
    """The same matrices: the estimate is that of a solve of this disc alone."""
    wider = MeshChoice(THIN_PLAN, 0.9, ErrorFactors(5.0, 5.0, flat=1e-2), AFTER)
    assert RUNG.error(found(), 0.5, mesh=wider) == RUNG.error(found(), 0.5)


@pytest.mark.parametrize("strange", [1.0, 3.0])
def test_cells_unlike_those_of_lenses_are_judged_by_one_mesh_more_widely(strange):
    want = strange * (2.2 * 0.02 + 5.1 * 0.05 + 6e-4 * 1.7)
    assert RUNG.error(found(strange=strange), 0.5) == pytest.approx(want, rel=1e-9)


def test_after_other_meshes_the_farthest_change_counts_as_far_as_the_forms_have_drawn_together():
    """Changes of 0.5 and 0.3; the forms are at a quarter of what they were on the first
    mesh, further apart than on
    the second: 0.5 / 2 and 0.3. The last two meshes count."""
    now = found(strange=1.0)
    first, second = (
        found(rim=0.08, waves=0.2, t=0.1 + 0.1j),
        found(rim=0.001, waves=0.02, t=0.6 + 0.4j),
    )
    assert ladder.damped_change(now, first) == pytest.approx(
        0.5 * math.sqrt(0.07 / 0.28), rel=1e-9
    )
    assert ladder.damped_change(now, second) == pytest.approx(0.3, rel=1e-9)
    both = RUNG.error(now, 0.5, (first, second))
    assert both == pytest.approx(0.4 * 0.02 + 0.6 * 0.05 + 0.8 * 0.3, rel=1e-9)
    assert RUNG.error(now, 0.5, (first, first)) == pytest.approx(
        both - 0.8 * 0.05, rel=1e-9
    )
    assert RUNG.error(now, 0.5, (second, first, first)) == RUNG.error(
        now, 0.5, (first, first)
    )
    assert ladder.damped_change(
        now, found(rim=0.0, waves=0.0, t=0.1 + 0.1j)
    ) == pytest.approx(0.5, rel=1e-9)
    assert RUNG.error(found(), 0.5, (first,)) == RUNG.error(
        found(), 0.5
    )  # cells of lenses need none


def test_near_a_resonance_a_change_counts_by_as_much_as_waves_in_the_layer_go_undamped():
    """The answer moves as one over what a round trip loses, up to six times as far;
    losing all is no less than 1.
    """
    before = found(t=0.6 + 0.4j)
    for damping, factor in ((0.25, 4.0), (1.0, 1.0), (1.3, 1.0), (0.01, 6.0)):
        now = found(strange=1.0, damping=damping)
        assert ladder.damped_change(now, before) == pytest.approx(
            0.3 * factor, rel=1e-9
        )


def test_at_a_cutoff_the_last_change_of_a_disc_of_the_rarer_medium_counts_in_full_and_half_as_much_again():
    """0.3 since the last mesh, 0.5 since the one before; forms at a hundredth of what
    they were, and a lens's disc.
    """
    first, last = (
        found(rim=2.0, waves=5.0, t=0.1 + 0.1j),
        found(rim=2.0, waves=5.0, t=0.6 + 0.4j),
    )
    parts = 0.4 * 0.02 + 0.6 * 0.05
    for beside, counts in ((1.0, 0.45), (0.5, 0.225), (0.0, 0.8 * 0.05)):
        now = found(strange=3.0, beside=beside)
        near = beside * AFTER.at_cutoff
        whole_ = max(0.4, near) * 0.02 + max(0.6, near) * 0.05 + counts
        assert AFTER.bound(now, (first, last)) == pytest.approx(whole_, rel=1e-9)
    other = AFTER.bound(found(strange=1.0, beside=1.0), (first, last))
    assert other == pytest.approx(2.6 * 0.07 + 0.8 * 0.05, rel=1e-9)
    assert AFTER.bound(found(strange=3.0), (first, last)) == pytest.approx(
        parts + 0.8 * 0.05, rel=1e-9
    )


@pytest.mark.parametrize(
    ("now", "before", "applies"),
    [
        ({}, {}, True),
        ({"damping": 0.1}, {"damping": 0.1}, True),
        ({"damping": 0.09}, {}, False),
        ({}, {"damping": 0.09}, False),
        ({"bloch": 0.2}, {}, False),
        ({"strange": 3.0}, {}, False),
        ({"size": 2.6}, {}, False),
        ({"beside": 0.5}, {"beside": 0.6}, True),
        ({"beside": 0.51}, {}, False),
    ],
    ids=[
        "damped",
        "just damped",
        "not on this mesh",
        "not before",
        "oblique",
        "rarer",
        "waves",
        "not at",
        "at a cutoff",
    ],
)
def test_damped_cells_at_normal_incidence_are_judged_by_how_they_settle_where_that_is_less(
    now, before, applies
):
    """0.2 of the farther change (0.5, of forms drawn together to a quarter), 0.3 of
    half the difference, 1e-3 drift.
    """
    found_ = found(**{"strange": 1.0} | now)
    meshes = (
        found(rim=0.08, waves=0.2, t=0.1 + 0.1j),
        found(rim=0.08, waves=0.2, t=0.6 + 0.3j, **before),
    )
    settling = DampedEstimate(moved=0.2, forms=0.3, shared=1e-3)
    want = 0.2 * 0.25 + 0.3 * 0.07 + 1e-3 * 1.7
    assert settling.bound(found_, meshes) == pytest.approx(
        want if applies else math.inf, rel=1e-9
    )
    assert (
        settling.bound(found_, meshes[1:]) == math.inf
    )  # one mesh before tells nothing of how an answer settles
    rung, wide = (
        replace(RUNG, settling=settling),
        replace(RUNG, settling=DampedEstimate(9.0, 9.0, 9.0)),
    )
    usual = RUNG.error(found_, 0.5, meshes)
    assert want < usual == wide.error(found_, 0.5, meshes)
    assert rung.error(found_, 0.5, meshes) == pytest.approx(
        want if applies else usual, rel=1e-9
    )


def test_modes_far_below_the_error_are_left_out():
    assert RUNG.weak == pytest.approx(1e-3 * 1e-2**1.1, rel=1e-9)


def test_the_first_mesh_is_the_coarsest_that_usually_meets_the_tolerance():
    usual = [rung.usual for rung in ladder.RUNGS]
    assert usual == sorted(usual, reverse=True)
    assert ladder.first_rung(1.0) == 0
    for i, value in enumerate(usual):
        assert ladder.first_rung(value) == i
        assert ladder.first_rung(0.999 * value) == min(i + 1, len(usual) - 1)


def test_a_mesh_may_usually_meet_less_for_some_discs(monkeypatch):
    quick = MeshLevel(
        "quick",
        (MeshChoice(THIN_PLAN, 0.3, THIN, AFTER, usual=3e-3), *RUNG.choices),
        2e-2,
        alone=ALONE,
    )
    monkeypatch.setattr(ladder, "RUNGS", (quick, RUNG))
    assert [ladder.first_rung(5e-3, rho) for rho in (0.25, 0.35)] == [0, 1]
    assert ladder.first_rung(5e-3) == 1
    assert [ladder.first_rung(2e-2, rho) for rho in (0.25, 0.35)] == [0, 0]


def test_cells_of_few_waves_in_a_pitch_begin_on_coarser_meshes():
    """Usual estimates are those of 1.4 waves in a pitch and more; below they fall as
    the third power.
    """
    usual = [rung.usual for rung in ladder.RUNGS]
    for size, share in ((0.7, 0.125), (1.3, (13 / 14) ** 3), (1.4, 1.0), (1.9, 1.0)):
        for i, value in enumerate(usual[:-1]):
            assert ladder.first_rung(1.001 * share * value, 0.5, size) == i
            assert ladder.first_rung(0.999 * share * value, 0.5, size) == i + 1


def test_a_cell_of_a_lens_meets_its_tolerance_on_the_mesh_that_its_waves_ask_for():
    """0.92 waves in a pitch: 2.5e-4, what is usual for many on the mesh "even", led to
    "good".
    """
    titania = Cell(0.25, 0.6, Index(2.4), Index(1.46))
    found = modal.solve(titania, 0.13, 0.65, tolerance=1e-4)
    fine = modal.solve(titania, 0.13, 0.65, tolerance=3e-6)
    assert found.reason.startswith("the even mesh")
    assert abs(found.t - fine.t) < found.t_error < 1e-4


SLIM = Cell(0.4, 1.1, Index(3.3), Index(1.47), Index(1.06), Index(1.13))


@pytest.mark.parametrize("place", range(4))
def test_bars_of_slim_discs_hold_and_are_not_too_wide(place):
    """0.145 pitches: both forms err by what is singular at the rim, the mean by a half
    of half their difference. The
    bars were 19, 13, 8 and 7 errors; the mesh "finer" knows the answer to 1e-6."""
    rung, case = ladder.RUNGS[place], case_of(SLIM, 0.058, Incidence(0.87))
    made = solve_on_mesh(case, rung.choice(case.rho).plan, weak=rung.weak)
    error = np.abs(made.matrix - solve_on_mesh(case, ladder.FINER).matrix)[:, 0].max()
    assert 1.3 * error < rung.error(made, case.rho) < 6 * error


def test_off_normal_incidence_waves_may_count_more():
    slanted = MeshLevel(
        "slanted",
        (MeshChoice(THIN_PLAN, 1.0, ErrorFactors(0.3, 1.4, slanted=2.1), AFTER),),
        1e-9,
        alone=ALONE,
    )
    for bloch, factor in ((0.0, 1.4), (0.2, 2.1)):
        assert slanted.error(found(bloch=bloch), 0.5) == pytest.approx(
            whole(0.3 * 0.02 + factor * 0.05), rel=1e-8
        )


@pytest.mark.parametrize(
    ("share", "want"),
    [
        (0.001, 1e-4 / 0.999),
        (0.3, 0.03 / 0.7),
        (0.5, 0.1),
        (0.8, 0.16),
        (1.7, 0.2),
        (4.0, 0.4),
    ],
)
def test_an_estimate_reckons_with_a_resonance_that_it_moves_towards(share, want):
    """0.1 d / (d - shift) at the distance d from a pole: first order 0.1 share; twice
    that at most, and 0.2.
    """
    assert whole(0.1 * share) == pytest.approx(want, rel=1e-9)
    strange = found(strange=2.0, rim=1e-3, waves=0.0, drift=0.0)
    assert RUNG.error(strange, 0.5) == pytest.approx(
        2.0 * 2.2e-3, rel=1e-9
    )  # of such cells the factors hold it
