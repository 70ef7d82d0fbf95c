"""DXF of a window in micrometres, read by ezdxf: layers with names, numbers and
colours, corners at their places.
"""

import dataclasses

import numpy as np
import pytest

from layout.files import dxf
from layout.mask import Figure, Lattice, MaskPlan, PillarClass
from metalens.ground.errors import ProcessError

ezdxf = pytest.importorskip("ezdxf")
WEDGE = np.array([[-60, -40], [70, -50], [10, 90]])
BAR = np.array([[0, 0], [900, 0], [900, 50], [0, 50]])
SITES = np.array([[1, 0, 2], [2, 1, 0]], np.uint8)
WHOLE = dxf.Window(0.0, 0.0, 50.0)


def plan(**more):
    """Units of 2 nm; rows 300 apart, columns 410; two layers of one name."""
    classes = (
        PillarClass("A", 240.0, 120, (1, 0), WEDGE),
        PillarClass("B", 240.0, 120, (1, 3), WEDGE[::-1] * 2),
    )
    lattice = Lattice(
        "LENS", 2, 3, 410, -7, 1009, lambda a, b: SITES[a:b], SITES, row_pitch=300
    )
    figures = (Figure("MARKS", {(3, 0): (BAR,), (14, 5): (BAR + 500,)}),)
    names = {(1, 0): "pillar", (1, 3): "pillar", (3, 0): "marks 1.5"}
    return MaskPlan(
        "TOP", classes, (lattice,), figures, unit_nm=2.0, layer_names=names, **more
    )


def test_layers_have_names_of_their_own_and_colours_by_turns(tmp_path):
    assert dxf.write(plan(), tmp_path / "m.dxf", window=WHOLE) == 4
    drawing = ezdxf.readfile(tmp_path / "m.dxf")
    assert drawing.units == 13  # micrometres
    told = {name: (drawing.layers.get(name).description, drawing.layers.get(name).color) for name in (
        "PILLAR", "PILLAR_L1D3", "MARKS 1_5", "L14D5"
    )}  # fmt: skip
    assert told == {
        "PILLAR": ("1/0", 1),
        "PILLAR_L1D3": ("1/3", 2),
        "MARKS 1_5": ("3/0", 3),
        "L14D5": ("14/5", 4),
    }
    many = dataclasses.replace(
        plan(), figures=(Figure("M", {(20 + k, 0): (BAR,) for k in range(7)}),)
    )
    dxf.write(many, tmp_path / "n.dxf", window=WHOLE)
    drawing = ezdxf.readfile(tmp_path / "n.dxf")
    assert [drawing.layers.get(f"L{20 + k}D0").color for k in range(7)] == [
        3,
        4,
        5,
        6,
        7,
        1,
        2,
    ]


def test_corners_are_in_micrometres_at_their_sites(tmp_path):
    dxf.write(plan(), tmp_path / "m.dxf", window=WHOLE)
    found = {}
    for line in ezdxf.readfile(tmp_path / "m.dxf").modelspace().query("LWPOLYLINE"):
        assert line.closed
        found.setdefault(line.dxf.layer, []).append(np.array(line.get_points("xy")))
    assert {name: len(lines) for name, lines in found.items()} == {
        "PILLAR": 2,
        "PILLAR_L1D3": 2,
        "MARKS 1_5": 1,
        "L14D5": 1,
    }
    # class 1 at the first site (-7, 1009) and at column 1 of the second row (403, 709),
    # in units of 2 nm
    want = [2e-3 * (WEDGE + at) for at in ([-7, 1009], [403, 709])]
    assert np.array(found["PILLAR"]) == pytest.approx(np.array(want), abs=1e-9)
    assert found["L14D5"][0] == pytest.approx(2e-3 * (BAR + 500), abs=1e-9)


def test_a_window_holds_its_pillars_and_all_figures(tmp_path):
    """From 0 to 1.8 um: the sites at (1.626, 2.018) and (0.806, 1.418) um, the upper
    window the first.
    """
    narrow = dxf.Window(0.9, 2.1, 1.8)
    assert dxf.write(plan(), tmp_path / "m.dxf", window=narrow) == 2
    upper = dxf.Window(0.9, 2.6, 1.8)
    assert dxf.write(plan(), tmp_path / "m.dxf", window=upper) == 1
    assert len(ezdxf.readfile(tmp_path / "m.dxf").modelspace()) == 3
    assert dxf.differences(plan(), tmp_path / "m.dxf", window=upper) == ()
    assert dxf.differences(plan(), tmp_path / "m.dxf", window=narrow) == (
        "layer PILLAR: 1 polygons missing",
    )


def test_what_differs_is_counted_by_layer(tmp_path):
    dxf.write(plan(), tmp_path / "m.dxf", window=WHOLE)
    assert dxf.differences(plan(), tmp_path / "m.dxf", window=WHOLE) == ()
    moved = dataclasses.replace(
        plan(),
        figures=(Figure("MARKS", {(3, 0): (BAR + 1, BAR), (14, 5): (BAR + 500,)}),),
    )
    assert dxf.differences(moved, tmp_path / "m.dxf", window=WHOLE) == (
        "layer MARKS 1_5: 1 polygons missing",
    )
    other = dataclasses.replace(
        plan(), figures=(Figure("MARKS", {(3, 0): (), (14, 5): (BAR + 499,)}),)
    )
    assert dxf.differences(other, tmp_path / "m.dxf", window=WHOLE) == (
        "layer L14D5: 1 polygons missing",
        "layer L14D5: 1 polygons not planned",
        "layer MARKS 1_5: 1 polygons not planned",
    )
    clockwise = {(3, 0): (np.roll(BAR, 2, axis=0)[::-1],), (14, 5): (BAR + 500,)}
    turned = dataclasses.replace(plan(), figures=(Figure("MARKS", clockwise),))
    assert dxf.differences(turned, tmp_path / "m.dxf", window=WHOLE) == ()
    drawing = ezdxf.readfile(tmp_path / "m.dxf")
    drawing.units = 4
    drawing.saveas(tmp_path / "m.dxf")
    assert dxf.differences(plan(), tmp_path / "m.dxf", window=WHOLE) == (
        "unit 4, planned 13 (um)",
    )


def test_two_hundred_thousand_pillars_are_the_most(monkeypatch, tmp_path):
    assert dxf.MOST_PILLARS == 200_000
    monkeypatch.setattr(dxf, "MOST_PILLARS", 4)
    assert dxf.write(plan(), tmp_path / "m.dxf", window=WHOLE) == 4
    monkeypatch.setattr(dxf, "MOST_PILLARS", 3)
    with pytest.raises(
        ProcessError, match=r"4 pillars in a window of 50\.0 um: .* at most 3"
    ):
        dxf.write(plan(), tmp_path / "m.dxf", window=WHOLE)


def test_a_window_is_20_um_about_the_axis_and_no_less_than_nothing():
    assert dataclasses.astuple(dxf.Window()) == (0.0, 0.0, 20.0)
    for size in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ProcessError, match="size above 0"):
            dxf.Window(0.0, 0.0, size)
