"""Marks and labels in pieces of one dose: they cover the drawn figures exactly once."""

import numpy as np
import pytest

import layout
from layout.process.process import DieSettings, ExposureSettings, Process
from metalens.lens.record import DiameterMap


def twice_area(polygon):
    x, y = np.asarray(polygon, float).T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


@pytest.mark.parametrize("beta_um", [4.7, 33.0])
def test_pieces_cover_every_figure_exactly_once(beta_um):
    """Equal areas, and an intersection (KLayout) as large as either."""
    db = pytest.importorskip("klayout.db")
    process = Process(
        exposure=ExposureSettings(alpha_um=0.013, beta_um=beta_um, eta=0.7),
        die=DieSettings(margin_um=320, mark_um=37, label="A7"),
    )
    source = DiameterMap(np.full((9, 13), 0.17), 0.4)
    drawn = layout.plan(source, process)
    dosed = layout.correct(drawn, process.exposure)
    exposed = 0
    for before, after in zip(drawn.figures, dosed.figures, strict=True):
        if before.name not in ("MARKS", "VERNIERS", "LABEL"):
            continue
        exposed += 1
        one, many = (
            [polygon for shapes in figure.polygons.values() for polygon in shapes]
            for figure in (before, after)
        )
        assert len(many) > len(one)
        assert sum(map(twice_area, many)) == sum(map(twice_area, one))
        regions = []
        for polygons in (one, many):
            region = db.Region()
            for polygon in polygons:
                region.insert(db.Polygon([db.Point(*p) for p in polygon.tolist()]))
            regions.append(region)
        assert (regions[0] ^ regions[1]).is_empty()
    assert exposed == 3
