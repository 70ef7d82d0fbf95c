"""Write fields by hand: borders midway between sites, counts and cuts pillar by pillar,
unlike along x and y.
"""

import numpy as np
import pytest

from layout.mask import fields
from layout.process.process import DesignRules, Process, WriteField
from metalens.core.errors import ProcessError
from metalens.lens import DiameterMap

PLAN = fields.FieldPlan(
    np.array([-2, 5, 11]),
    np.array([1, 4, 9, 15]),
    (10, 13),
    0.4,
    "shift",
    np.array([[3, 0, 7], [0, 0, 5]]),
    4,
    0.03,
    0.3,
)


def process(size_um, mode="floating"):
    return Process(
        rules=DesignRules(diameter_step_nm=2.0), write_field=WriteField(size_um, mode)
    )


def test_borders_are_half_a_step_before_their_site_about_the_axis():
    """13 columns of 0.4 um: site 1 at -2 um, its border at -2.2; 10 rows of 0.3 um:
    site 5 at 0.15, its border at 0.
    """
    assert PLAN.x_um == pytest.approx([-2.2, -1.0, 1.0, 3.4], abs=1e-12)
    assert PLAN.y_um == pytest.approx([-2.1, 0.0, 1.8], abs=1e-12)
    assert PLAN.size_um == pytest.approx((2.4, 2.1), abs=1e-12)
    assert PLAN.used == 3
    square = fields.FieldPlan(
        PLAN.rows, PLAN.columns, (10, 13), 0.4, "shift", PLAN.pillars, 4, 0.03
    )
    assert square.y_um == pytest.approx([-2.8, 0.0, 2.4], abs=1e-12)


def test_fields_are_counted_along_x_first_and_end_with_the_lattice():
    row, column = np.array([0, 4, 5, 9, 4, 5]), np.array([1, 3, 4, 12, 9, 8])
    assert PLAN.of(row, column).tolist() == [0, 0, 4, 5, 2, 4]
    spans = [((a.start, a.stop), (b.start, b.stop)) for a, b in PLAN.blocks()]
    columns = (1, 4), (4, 9), (9, 13)
    assert spans == [((0, 5), c) for c in columns] + [((5, 10), c) for c in columns]


@pytest.mark.parametrize(
    ("mode", "sites", "want"),
    [
        ("floating", 3, [2, 4, 7, 10]),  # 8 lines from the third on in three fields
        ("floating", 8, [2, 10]),
        ("floating", 7, [2, 6, 10]),
        ("shift", 3, [2, 5, 8, 11]),  # 9 sites around 8: the odd one at the end
        ("shift", 5, [1, 6, 11]),
        ("shift", 11, [1, 12]),
        ("shift", 8, [2, 10]),
    ],
)
def test_borders_hold_the_occupied_lines_in_as_few_fields_as_can_be(mode, sites, want):
    held = np.zeros(14, bool)
    held[[2, 3, 5, 9]] = True
    assert fields._edges(WriteField(1.0, mode), held, sites).tolist() == want


def ragged(shape=(10, 13), seed=5):
    """Diameters of whole steps, a third of the sites empty; the first column and the
    last two rows are.
    """
    rng = np.random.default_rng(seed)
    sizes = np.where(rng.random(shape) < 0.67, rng.integers(60, 170, shape) * 2e-3, 0.0)
    sizes[:, 0], sizes[-2:], sizes[3, 5] = 0, 0, 0.342
    return sizes


def test_pillars_are_counted_field_by_field_and_borders_keep_their_distance():
    """Fields of 3 columns and 3 rows (1.2 um of 0.4 and 0.37): 1.2 / 0.4 is just below
    3 in floating point.
    """
    assert 1.2 / 0.4 < 3
    sizes = ragged()
    plan = fields.split_write_fields(DiameterMap(sizes, 0.4, row_um=0.37), process(1.2))
    assert (plan.columns.tolist(), plan.rows.tolist()) == (
        [1, 4, 7, 10, 13],
        [0, 2, 5, 8],
    )
    assert (plan.shape, plan.pitch_um, plan.row_um, plan.mode) == (
        (10, 13),
        0.4,
        0.37,
        "floating",
    )
    want = [
        [np.count_nonzero(sizes[a:b, c : c + 3]) for c in (1, 4, 7, 10)]
        for a, b in ((0, 2), (2, 5), (5, 8))
    ]
    assert plan.pillars.tolist() == want
    assert plan.clearance_um == pytest.approx((0.37 - 0.342) / 2, abs=1e-12)
    with pytest.raises(ProcessError, match="smaller than the pitch"):
        fields.split_write_fields(DiameterMap(sizes, 0.4, row_um=0.37), process(0.38))


@pytest.mark.parametrize("sites", [1 << 20, 26, 5])
@pytest.mark.parametrize("size_um", [1.42, 1.32, 0.97])
def test_a_raster_about_the_axis_cuts_pillars_that_lie_on_its_borders(
    monkeypatch, sites, size_um
):
    """A border at k sizes from the axis cuts a pillar whose middle is nearer than half
    its diameter; once, though two
    may."""
    monkeypatch.setattr(fields, "_BLOCK_SITES", sites)
    sizes, want = ragged(), 0
    for row, column in np.argwhere(sizes).tolist():
        x, y, half = (column - 6) * 0.4, (row - 4.5) * 0.37, sizes[row, column] / 2
        borders = size_um * np.arange(-5, 6)
        want += bool((abs(borders - x) < half).any() or (abs(borders - y) < half).any())
    plan = fields.split_write_fields(
        DiameterMap(sizes, 0.4, row_um=0.37), process(size_um)
    )
    assert plan.cut_before == want
    assert 5 < want < np.count_nonzero(sizes)
    assert plan.pillars.sum() == np.count_nonzero(sizes)


def test_a_single_column_of_pillars_lies_on_the_border_at_the_axis():
    plan = fields.split_write_fields(
        DiameterMap(np.array([[0.1], [0.0], [0.2]]), 0.4), process(1.2)
    )
    assert (plan.cut_before, plan.pillars.tolist()) == (2, [[2]])
    row = fields.split_write_fields(
        DiameterMap(np.array([[0.1, 0.3]]), 0.4), process(1.2)
    )
    assert (row.cut_before, row.pillars.tolist(), row.columns.tolist()) == (
        2,
        [[2]],
        [0, 2],
    )
