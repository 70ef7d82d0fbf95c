"""The check against closed forms, brute force and KLayout, on patches with seeded
violations.
"""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from layout.drc.lattice import check_plan
from layout.drc.report import DrcReport
from layout.mask.plan import MaskPlan, PillarArray, PillarClass, pillar_classes
from layout.process.process import DesignRules
from tests.referees.convex import convex_gap

LOOSE = DesignRules(minimum_feature_nm=1, minimum_gap_nm=1, maximum_density=1)


def plan_of(diameters, classes, *, pitch=400, vertices=16):
    made = pillar_classes(
        np.array(diameters), layer=(1, 0), grid=1, unit_nm=1.0, vertices=vertices
    )
    lattice = PillarArray.of(
        "LENS", np.asarray(classes, np.uint8), pitch=pitch, x0=-3000, y0=2000
    )
    return MaskPlan("TOP", made, (lattice,))


def sites(plan):
    """(x, y, class) of every pillar."""
    lattice = plan.lattices[0]
    for row, column in np.argwhere(lattice.whole() > 0).tolist():
        yield (
            lattice.x0 + column * lattice.pitch,
            lattice.y0 - row * lattice.pitch,
            int(lattice.whole()[row, column]),
        )


def seeded(size, seeds, seed=0):
    """A patch of well separated pillars with some that are too wide or too thin."""
    rng = np.random.default_rng(seed)
    classes = rng.integers(1, 16, (size, size))
    rows, columns = rng.integers(0, size, (2, seeds))
    classes[rows, columns] = rng.integers(16, 21, seeds)
    classes[rng.integers(0, size, seeds // 4), rng.integers(0, size, seeds // 4)] = 21
    return plan_of([*range(100, 295, 13), 330, 350, 370, 390, 395, 60], classes)


def klayout_findings(plan, rules):
    """(boxes of pairs that are too close, sites that are too thin) by KLayout."""
    db = pytest.importorskip("klayout.db")
    region, boxes = db.Region(), {}
    for x, y, k in sites(plan):
        shape = db.Polygon(
            [db.Point(x + int(a), y + int(b)) for a, b in plan.classes[k - 1].outline]
        )
        region.insert(shape)
        boxes[x, y] = shape.bbox()
    region.merged_semantics = False
    pitch = plan.lattices[0].pitch

    def site(edge):
        middle = ((edge.p1.x + edge.p2.x) / 2, (edge.p1.y + edge.p2.y) / 2)
        return round((middle[0] + 3000) / pitch) * pitch - 3000, round(
            (middle[1] - 2000) / pitch
        ) * pitch + 2000

    close = set()
    for pair in region.space_check(
        int(rules.minimum_gap_nm), False, db.Region.Euclidian
    ).each():
        both = boxes[site(pair.first)] + boxes[site(pair.second)]
        close.add((both.left, both.bottom, both.right, both.top))
    # opposite edges only: edges at an angle measure chords of the round pillar, not its
    # width
    check = region.width_check(
        int(rules.minimum_feature_nm), False, db.Region.Euclidian, 10
    )
    thin = {site(p.first) for p in check.each()}
    return close, thin


def agree(size, seeds, seed):
    plan = seeded(size, seeds, seed)
    rules = DesignRules(minimum_gap_nm=70, minimum_feature_nm=80, maximum_density=1)
    found = check_plan(plan, rules)
    close, thin = klayout_findings(plan, rules)
    assert {v.box for v in found.violations if v.rule == "space"} == close
    assert {v.centre for v in found.violations if v.rule == "width"} == thin
    assert (found.counts["space"], found.counts["width"]) == (len(close), len(thin))
    assert close
    assert thin
    assert not found.ok


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_disagreement_with_klayout_on_a_patch_with_seeded_violations(seed):
    agree(60, 40, seed)


@pytest.mark.slow
def test_no_disagreement_with_klayout_on_240000_pillars():
    agree(490, 110, 7)


@given(
    st.lists(
        st.lists(st.integers(0, 6), min_size=5, max_size=5), min_size=2, max_size=6
    )
)
def test_gap_is_the_least_of_all_pairs_by_brute_force(rows):
    plan = plan_of([100, 180, 240, 300, 350, 390], rows)
    found = check_plan(plan, LOOSE)
    gaps = [
        convex_gap(
            plan.classes[k - 1].outline, plan.classes[m - 1].outline, u - x, v - y
        )
        for (x, y, k), (u, v, m) in itertools.combinations(sites(plan), 2)
        if abs(u - x) <= 400 and abs(v - y) <= 400
    ]
    assert found.shapes == np.count_nonzero(rows)
    if gaps:
        assert found.minimum_space_nm == pytest.approx(min(gaps), abs=1e-9)
    else:
        assert math.isinf(found.minimum_space_nm)


def test_overlap_and_touch_are_found_with_their_place():
    found = check_plan(plan_of([420], [[1, 1, 0, 1]]), LOOSE)
    assert found.counts["overlap"] == 1
    (violation,) = found.violations
    assert violation.centre == (-2800, 2000)
    square = np.array([[-200, -200], [200, -200], [200, 200], [-200, 200]])
    touching = MaskPlan(
        "T",
        (PillarClass("A", 450.0, 450, (1, 0), square),),
        (PillarArray.of("L", np.ones((1, 2), np.uint8), pitch=400, x0=0, y0=0),),
    )
    assert check_plan(touching, LOOSE).minimum_space_nm == 0
    assert not check_plan(touching, LOOSE).ok


def test_a_rule_as_wide_as_two_pitches_looks_at_second_neighbours():
    plan = plan_of([100], [[1, 0, 1]], pitch=200)
    assert (
        check_plan(
            plan,
            DesignRules(minimum_gap_nm=310, minimum_feature_nm=1, maximum_density=1),
        ).counts["space"]
        == 1
    )
    assert check_plan(
        plan, DesignRules(minimum_gap_nm=290, minimum_feature_nm=1, maximum_density=1)
    ).ok


def test_structures_that_meet_are_found(make_plan):
    plan = make_plan()
    again = plan.lattices[0]
    other = PillarArray.of(
        "OTHER", np.ones((2, 2), np.uint8), pitch=400, x0=again.x0 + 300, y0=again.y0
    )
    found = check_plan(plan.replace(lattices=(again, other)), LOOSE)
    assert found.counts["clearance"] == 1


def test_summary_says_what_was_found():
    report = check_plan(
        plan_of([200, 380], [[1, 2, 2]]), DesignRules(minimum_gap_nm=70)
    )
    assert isinstance(report, DrcReport)
    assert "space" in report.summary
    assert "3 shapes" in report.summary
    assert (
        "2,500 shapes"
        in check_plan(
            plan_of([200], np.full((50, 50), 1)), DesignRules(minimum_gap_nm=70)
        ).summary
    )
