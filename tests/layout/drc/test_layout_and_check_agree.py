"""One judgement of widths: of a plan, and of the files written from it."""

import numpy as np
import pytest

import layout
from layout.process.process import DesignRules, Process
from metalens.lens import DiameterMap

db = pytest.importorskip("klayout.db")


@pytest.mark.parametrize("suffix", ["gds", "oas"])
@pytest.mark.parametrize(("drawn_nm", "limit_nm"), [(80, 80), (82, 80), (96, 95)])
def test_a_round_pillar_at_its_limit_is_judged_alike_everywhere(
    tmp_path, suffix, drawn_nm, limit_nm
):
    """Widths are those of the drawn polygon, between its flats; KLayout measures the
    same edges of the file in projection.
    """
    size = np.full((5, 7), drawn_nm * 1e-3)
    size[1, 2] = 0
    rules = DesignRules(minimum_feature_nm=limit_nm)
    plan = layout.plan(DiameterMap(size, 0.39), Process(rules=rules), furnished=False)
    path = tmp_path / f"m.{suffix}"
    (layout.write_gdsii if suffix == "gds" else layout.write_oasis)(plan, path)
    reports = [layout.check(mask, rules) for mask in (plan, path)]
    there = db.Layout()
    there.read(str(path))
    shapes = db.Region(there.top_cell().begin_shapes_rec(there.layer(1, 0)))
    thin = shapes.width_check(limit_nm, False, db.Region.Projection).count() > 0
    for report in reports:
        assert report.counts["width"] == (34 if thin else 0)
    assert reports[0].minimum_width_nm == reports[1].minimum_width_nm
