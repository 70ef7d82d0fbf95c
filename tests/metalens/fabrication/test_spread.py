"""What a process leaves uncertain: amounts of its causes, lenses that are drawn with
them, entries that are stated.
"""

import math

import numpy as np
import pytest

from metalens.fabrication.spread import DRAWN, Draw, Spread, draws


def test_a_drawn_gradient_points_in_its_own_direction():
    """From edge to edge: half of it from the axis to the rim, cosine along x and sine
    along y.
    """
    made = Draw({"gradient_nm": 5.0, "bow_nm": -2.0, "height_nm": 6.0}, 0.7).state()
    assert made["bias_x_nm"] == pytest.approx(2.5 * math.cos(0.7))
    assert made["bias_y_nm"] == pytest.approx(2.5 * math.sin(0.7))
    assert (made["bias_r_nm"], made["height_nm"], made["bias_nm"]) == (-2.0, 6.0, 0.0)


def test_lenses_are_drawn_with_the_stated_sigma_and_in_all_directions():
    sigma = {
        "bias_nm": 4.0,
        "gradient_nm": 3.0,
        "bow_nm": 0.0,
        "height_nm": 7.0,
        "index": 0.013,
        "sidewall_deg": 0.4,
    }
    sides = {"width_nm", "length_nm", "turn_deg", "pedestal_nm", "cap_nm"}
    assert set(sigma) == set(DRAWN) - sides
    lenses = draws(Spread(**sigma), 4000, seed=3)
    for name, want in sigma.items():
        values = np.array([lens.amounts[name] for lens in lenses])
        assert values.std() == pytest.approx(want, rel=0.05)  # 1 / sqrt(8000) is 1.1 %
        assert abs(values.mean()) <= 4 * want / math.sqrt(4000)
    turns = np.array([lens.turn_rad for lens in lenses])
    assert np.histogram(turns, 8, (0, 2 * math.pi))[0] == pytest.approx(
        np.full(8, 500), abs=100
    )  # sigma 21
    assert Spread.only(bow_nm=1.5).values() == dict.fromkeys(DRAWN, 0.0) | {
        "bow_nm": 1.5
    }
    usual = Spread().values()
    assert usual == {
        "bias_nm": 4.0, "gradient_nm": 3.0, "bow_nm": 2.0, "height_nm": 7.0, "index": 0.02, "sidewall_deg": 0.5,
    } | dict.fromkeys(sides, 0.0)  # fmt: skip
    assert Spread(width_nm=2.0).stated == {
        n: v for n, v in usual.items() if n not in sides
    } | {"width_nm": 2.0}
    some = draws(Spread(length_nm=2.5), 4000, seed=5)
    assert np.std([lens.amounts["length_nm"] for lens in some]) == pytest.approx(
        2.5, rel=0.05
    )
    assert "width_nm" not in some[0].amounts


def test_what_every_process_has_is_stated_even_where_it_is_none():
    """And what no process has unless it says so only where it does."""
    usual = {name for name, row in DRAWN.items() if row.sigma}
    rare = sorted(DRAWN.keys() - usual)
    assert usual
    assert rare
    still = Spread(**dict.fromkeys(DRAWN, 0.0))
    assert still.stated == dict.fromkeys((n for n in DRAWN if n in usual), 0.0)
    assert Spread(
        **dict.fromkeys(DRAWN, 0.0) | {rare[0]: 3.7}
    ).stated.keys() == usual | {rare[0]}
