"""The error estimate of a mesh as its parts say, for discs of every width and at a cutoff."""

from types import SimpleNamespace

import pytest

from metalens.modal import ladder
from metalens.modal.ladder import Choice, Rung

NARROW_PLAN, WIDE_PLAN = object(), object()
RUNG = Rung(
    "typed",
    (
        Choice(NARROW_PLAN, 0.6, 2e-4, 7e-3, oblique=3e-4, middle=5e-4),
        Choice(WIDE_PLAN, 1.0, 1e-4, 4e-3),
    ),
    safety=1.4, usual=1e-2, at_cutoff=3.1, thin=0.45,
)  # fmt: skip


def found(spread=0.02, drift=1.7, grazing=0.0, bloch=0.0, size=1.3, strange=0.0):
    return SimpleNamespace(spread=spread, drift=drift, grazing=grazing, bloch=bloch, size=size, strange=strange)


@pytest.mark.parametrize(
    ("rho", "bloch", "want"),
    [
        (0.2, 0.0, 0.45 * 0.02 + 0.2 * (2e-4 + 7e-3 * 0.2**4) * 1.7),  # thin: the forms err apart
        (0.28, 0.3, 1.4 * 0.02 + (2e-4 + 7e-3 * 0.28**4 + 3e-4) * 1.7),
        (0.5, 0.0, 1.4 * 0.02 + (2e-4 + 7e-3 * 0.5**4 + 5e-4) * 1.7),
        (0.8, 0.3, 1.4 * 0.02 + (1e-4 + 4e-3 * 0.8**4) * 1.7),
        (0.95, 0.0, 3 * 1.4 * 0.02 + 1.5 * (1e-4 + 4e-3 * 0.95**4) * 1.7),  # a narrow gap
    ],
)
def test_the_estimate_adds_half_difference_and_drift_by_the_width_of_the_disc(rho, bloch, want):
    assert RUNG.choice(rho).plan is (NARROW_PLAN if rho <= 0.6 else WIDE_PLAN)
    assert RUNG.error(found(bloch=bloch), rho) == pytest.approx(want + 0.02 * 1e-2, rel=1e-9)


def test_near_a_cutoff_the_difference_counts_more_and_exact_cutoffs_in_part():
    shared = 2e-4 + 7e-3 * 0.5**4 + 5e-4
    want = 3.1 * 0.02 + shared * 1.7 + 0.15 * 0.04 + 2e-4
    assert RUNG.error(found(grazing=0.04), 0.5) == pytest.approx(want, rel=1e-9)
    thin = 3.1 * 0.02 + (2e-4 + 7e-3 * 0.2**4) * 1.7 + 0.15 * 0.04 + 2e-4  # no longer as of thin discs
    assert RUNG.error(found(grazing=0.04), 0.2) == pytest.approx(thin, rel=1e-9)
    gap = 4.2 * 0.02 + 1.5 * (1e-4 + 4e-3 * 0.95**4) * 1.7 + 0.15 * 0.04 + 2e-4  # 3 x 1.4 is above 3.1
    assert RUNG.error(found(grazing=0.04), 0.95) == pytest.approx(gap, rel=1e-9)


def test_in_a_pitch_of_many_waves_the_shared_error_rises_as_their_sixth_power():
    shared = 2e-4 + 7e-3 * 0.5**4 + 5e-4
    for size, more in ((2.0, 1.0), (2.5, 1.25**6)):
        want = 1.4 * 0.02 + more * shared * 1.7 + 2e-4
        assert RUNG.error(found(size=size), 0.5) == pytest.approx(want, rel=1e-9)


def test_discs_too_thin_to_be_told_are_given_the_whole_difference():
    for rho, safety, share in ((0.031, 0.45, 0.2), (0.029, 1.4, 1.0)):
        want = safety * 0.02 + share * (2e-4 + 7e-3 * rho**4) * 1.7 + 2e-4
        assert RUNG.error(found(), rho) == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize(("strange", "safety"), [(0.5, 1.4), (1.0, 2.5), (2.5, 6.25)])
def test_cells_unlike_those_of_lenses_have_wider_bars_and_no_discount_for_thin_discs(strange, safety):
    """Never less than the rung's own factor; the shared error five times."""
    for rho in (0.2, 0.28):
        shared = 2e-4 + 7e-3 * rho**4
        want = safety * 0.02 + 5 * shared * 1.7 + 2e-4
        assert RUNG.error(found(strange=strange), rho) == pytest.approx(want, rel=1e-9)


def test_a_mesh_may_have_factors_of_its_own_in_place_of_those_of_the_rung():
    own = Rung("own", (Choice(NARROW_PLAN, 0.6, 2e-4, safety=0.7, at_cutoff=1.1), *RUNG.choices[1:]), 1.4, 1e-2, 3.1)
    assert own.error(found(), 0.5) == pytest.approx(0.7 * 0.02 + 2e-4 * 1.7 + 2e-4, rel=1e-9)
    assert own.error(found(grazing=0.04), 0.5) == pytest.approx(1.1 * 0.02 + 2e-4 * 1.7 + 0.15 * 0.04 + 2e-4, rel=1e-9)
    assert own.error(found(grazing=0.04), 0.8) == RUNG.error(found(grazing=0.04), 0.8)


def test_modes_far_below_the_error_are_left_out():
    assert RUNG.weak == pytest.approx(1e-3 * 1e-2**1.1, rel=1e-9)


def test_the_first_mesh_is_the_coarsest_that_usually_meets_the_tolerance():
    usual = [rung.usual for rung in ladder.RUNGS]
    assert usual == sorted(usual, reverse=True)
    assert ladder.first_rung(1.0) == 0
    for i, value in enumerate(usual):
        assert ladder.first_rung(value) == i
        assert ladder.first_rung(0.999 * value) == min(i + 1, len(usual) - 1)
