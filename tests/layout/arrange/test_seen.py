"""The die as a coarse microscope sees it: areas are kept, wherever and however parts stand."""

import numpy as np
import pytest

from layout.arrange import At, joined, parts, seen
from layout.files import CellContent, Placed, Sites
from layout.mask import Lattice
from layout.process.process import Process

AREA = 90.0 * 80 / 2


def lens(block):
    """A lattice of triangles of 90 by 80 nm that is never all in memory, placed by the part's own cell."""
    cells = {"TRI": CellContent("TRI", {(1, 0): [np.array([[0, 0], [90, 0], [0, 80]])]}), "LENS": CellContent("LENS")}
    cells["TOP"] = CellContent("TOP", placed=PLACED)
    sites = Sites(Lattice.of("OWN", block, pitch=400, x0=-2000, y0=3000), ("TRI",))
    return parts.Part(
        "A", "TOP", cells, {(1, 0): 1.0}, {}, {}, np.array([-2000, -9000, 6000, 3000]), sites={"LENS": sites}
    )


PLACED = Placed(("LENS",), *(np.array([v], np.int32) for v in (0, 700, -300)), np.zeros(1, np.uint8))


def pads():
    shape = np.array([[0, 0], [50_000, 0], [50_000, 20_000], [0, 20_000]])
    return parts.Part("P", "PAD", {"PAD": CellContent("PAD", {(2, 0): [shape]})}, {(2, 0): 1.0}, {}, {}, np.zeros(4))


def test_every_area_is_seen_once_and_where_it_stands():
    block = np.zeros((31, 21), np.uint8)
    block[4:, 3:] = np.random.default_rng(2).integers(0, 2, (27, 18))
    at = (At(x_um=20.0, y_um=-15.0, turn_deg=90.0), At(x_um=-40.0, y_um=12.0, columns=2, step_um=(15.0, 3.0)))
    placed = [joined.Placing(lens(block), at), joined.Placing(pads(), (At(x_um=-10.0, y_um=20.0),))]
    view = seen.View.over(np.array([-70_000, -60_000, 80_000, 60_000]), 75)
    found = seen.covered(placed, Process(), view)
    assert set(found) == {parts.PILLARS, parts.APERTURE}
    assert found[parts.PILLARS].sum() * view.side**2 == pytest.approx(3 * block.sum() * AREA, rel=1e-9)
    pad = found[parts.APERTURE]
    assert pad.sum() * view.side**2 == pytest.approx(50e6 * 20, rel=1e-9)
    row, column = int((30_000 + 60_000) / view.side), int((10_000 + 70_000) / view.side)
    assert pad[row, column] == pytest.approx(1, abs=0.02)  # in the middle of the pad
    rows, columns = np.nonzero(found[parts.PILLARS])
    share = found[parts.PILLARS][rows, columns]
    x, y = ((k + 0.5) * view.side + low for k, low in ((columns, view.left), (rows, view.bottom)))
    r, c = np.nonzero(block)
    u, v = -2000 + 400 * c + 700 + 40, 3000 - 400 * r - 300 + 40  # box middles; their shares weigh alike
    want_x = np.mean([20_000 - v.mean(), -40_000 + u.mean(), -25_000 + u.mean()])
    want_y = np.mean([-15_000 + u.mean(), 12_000 + v.mean(), 12_000 + v.mean()])
    assert np.average(x, weights=share) == pytest.approx(want_x, abs=60)  # the triangle's own middle
    assert np.average(y, weights=share) == pytest.approx(want_y, abs=60)
