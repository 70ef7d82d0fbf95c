"""Limits of a design by hand: the first and the last drawn step that keep the rules,
and what rounds to them.
"""

import numpy as np
import pytest

from layout.process import limits
from layout.shapes import polygon
from metalens.core.errors import ProcessError

RULES = "[rules]\nminimum_feature_nm = {feature}\nminimum_gap_nm = {gap}\nminimum_foot_gap_nm = {foot}\ngrid_nm = {grid}\n"
RULES += 'diameter_step_nm = {step}\nvertices = 32\nshape = "round"\n[etch]\ncorner_radius_nm = 0\nsidewall_deg = {wall}\n'
PLAIN = {"feature": 103.0, "gap": 87.0, "foot": 10.0, "grid": 1, "step": 4, "wall": 0.0}


def printable(tmp_path, *, pitch_um=0.405, height_um=0.7, more="", **about):
    path = tmp_path / "p.toml"
    path.write_text(RULES.format(**PLAIN | about) + more)
    return limits.printable_limits(path, pitch_um=pitch_um, height_um=height_um)


def across(diameter, grid=1):
    """Width along x of the polygon of a pillar."""
    return (
        int(np.ptp(polygon.pillar_polygon(diameter / grid, vertices=32).points[:, 0]))
        * grid
    )


def test_the_thinnest_is_the_first_step_that_is_wide_enough_less_what_rounds_to_it(
    tmp_path,
):
    """Of steps of 4 nm 104 is the first above 103, and flats of 104 lie 104 apart or a
    little less: it or the next. A
    pillar within 0.45 steps of a drawn one is drawn so."""
    low, gap = printable(tmp_path)
    least = next(d for d in range(4, 405, 4) if polygon_width(d) >= 103)
    assert low == pytest.approx(least - 1.8, abs=1e-9)
    most = max(d for d in range(4, 405, 4) if 405 - across(d) >= 87)
    assert gap == pytest.approx(405 - most - 1.8, abs=1e-9)


def polygon_width(diameter):
    """Least distance of parallel lines with all corners between them, along the normal
    of each edge.
    """
    points = polygon.pillar_polygon(diameter, vertices=32).points
    edge = np.roll(points, -1, axis=0) - points
    normal = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.hypot(*edge.T)[:, None]
    return float(np.ptp(points @ normal.T, axis=0).min())


def test_a_feature_or_gap_exactly_at_its_limit_is_kept(tmp_path):
    width, wide = polygon_width(160), across(200)
    low, gap = printable(tmp_path, feature=repr(width), gap=float(405 - wide))
    assert low == pytest.approx(160 - 1.8, abs=1e-9)
    assert gap == pytest.approx(405 - 200 - 1.8, abs=1e-9)
    low, gap = printable(tmp_path, feature=repr(width + 1e-6), gap=405 - wide + 0.01)
    assert low == pytest.approx(164 - 1.8, abs=1e-9)
    assert gap == pytest.approx(405 - 196 - 1.8, abs=1e-9)


def test_tilted_walls_keep_the_gap_at_the_foot(tmp_path):
    """atan(0.1) over 700 nm makes the foot 70 nm wider: 405 - 70 - 45 leaves 290, and
    288 is the last step.
    """
    wall = np.degrees(np.arctan(0.1))
    _, gap = printable(tmp_path, wall=repr(float(wall)), foot=45.0, gap=20.0)
    assert gap == pytest.approx(405 - 288 - 1.8, abs=1e-9)
    _, gap = printable(tmp_path, wall=repr(float(wall)), foot=46.999, gap=20.0)
    assert gap == pytest.approx(405 - 288 - 1.8, abs=1e-9)
    _, gap = printable(tmp_path, wall=repr(float(wall)), foot=47.001, gap=20.0)
    assert gap == pytest.approx(405 - 284 - 1.8, abs=1e-9)


@pytest.mark.parametrize(
    ("alone", "thin", "wide", "foot"), [(7.5, 7.5, 0.0, 7.5), (-7.5, 0.0, -7.5, 0.0)]
)
def test_what_pillars_gain_alone_is_given_away_at_both_ends(
    tmp_path, alone, thin, wide, foot
):
    """One that comes out wider alone is designed wider, and its foot is; one that comes
    out thinner cannot be alone.
    """
    low, gap = printable(tmp_path)
    other_low, other_gap = printable(tmp_path, more=f"[bias]\nisolated_nm = {alone}\n")
    assert other_low - low == pytest.approx(thin, abs=1e-9)
    assert other_gap - gap == pytest.approx(-wide, abs=1e-9)
    most = max(d for d in range(4, 405, 4) if 405 - d - foot >= 101.0)
    _, gap = printable(
        tmp_path, gap=20.0, foot=101.0, more=f"[bias]\nisolated_nm = {alone}\n"
    )
    assert gap == pytest.approx(405 - most - 1.8 - wide, abs=1e-9)


def test_a_bias_moves_both_limits_by_what_pillars_there_come_out_wider(tmp_path):
    low, gap = printable(tmp_path)
    other_low, other_gap = printable(
        tmp_path, more="[bias]\ntable_nm = [[50, -6.0], [400, -6.0]]\n"
    )
    assert (other_low - low, other_gap - gap) == (
        pytest.approx(-6, abs=1e-9),
        pytest.approx(6, abs=1e-9),
    )


def test_nothing_below_four_steps_of_the_grid_is_drawn(tmp_path):
    low, _ = printable(tmp_path, feature=3.0, grid=6, step=6)
    assert low == pytest.approx(24 - 0.45 * 6, abs=1e-9)
    with pytest.raises(ProcessError, match="widen the pitch"):
        printable(tmp_path, pitch_um=0.15)
