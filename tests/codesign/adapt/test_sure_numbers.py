"""What leaves a correction open, by a table that is a straight line of typed-in slopes:
thresholds at their edges.
"""

import statistics
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.adapt import sure
from metalens.core.errors import ConfigError

NAMES = ("bias_nm", "focus_um", "height_nm")  # the second is none that a table follows
SLOPES = {
    "bias_nm": (0.4, 1.7, -0.9),
    "focus_um": (50.0, 50.0, 50.0),
    "height_nm": (-0.2, -0.6, 0.3),
}


def table(x):
    """(3 knots,) of the parameters by name, straight."""
    return sum(x[k] * np.array(SLOPES[name]) for k, name in enumerate(NAMES))


def fit(by_cause=((0.0, 0.0, 0.0),), causes=("a side wall",), within=None):
    value = np.array([2.0, 7.0, -3.0])
    return SimpleNamespace(
        names=NAMES, value=value, sigma=np.array([0.3, 0.9, 1.9]), causes=causes, by_cause=np.array(by_cause),
        within_covariance=np.diag([0.01, 4.0, 0.01]) if within is None else np.array(within),
        parameters=lambda values=value: np.array(values),
        interval=lambda name: (1.25, 2.75) if name == "bias_nm" else (-9.0, 4.5),
    )  # fmt: skip


def words(found, wide_nm, part=sure.TABLE):
    """Of the second knot, the widest: slopes 1.7 along the bias and -0.6 along the
    height.
    """
    return sure._settled(found, table, np.array([0.9, 3.9, 2.0]), (part, wide_nm))


@pytest.mark.parametrize(("covariance", "own"), [
    ([[0.5, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 1.3]], (1.7**2 * 0.5 + 0.6**2 * 1.3) ** 0.5),
    ([[0.5, 0.0, 0.3], [0.0, 9.0, 0.0], [0.3, 0.0, 1.3]], (1.445 - 2 * 1.02 * 0.3 + 0.468) ** 0.5),
])  # fmt: skip
def test_what_frames_leave_is_by_the_slopes_at_the_widest_knot_and_their_covariance(
    covariance, own
):
    """Frames are asked for where that is above seven tenths of what is allowed,
    whatever the focus does.
    """
    found = fit([[1.0, 0.0, 0.0]], within=covariance)
    assert "both sides of focus" in words(found, own / 0.7 * 0.999)
    told = words(found, own / 0.7 * 1.001)
    assert "both sides of focus" not in told
    assert told.endswith("the diameters themselves by micrographs (metalens measure)")


def test_a_cause_moves_all_that_it_moves_together_at_most_by_the_sum():
    """1.7 x 0.8 + 0.6 x 0.5 = 1.66 nm: a fifth of 8.3. A cause is named above that and
    a quarter of the worst.
    """
    one = fit([[0.8, 99.0, 0.5]])
    assert words(one, 8.29).startswith("the side wall by a cross-section")
    assert "side wall" not in words(one, 8.31)
    assert words(one, 8.31).startswith(
        "frames at source depths on both sides of focus"
    )  # nothing else to ask for
    for share, named in ((0.249, False), (0.251, True)):
        two = fit(
            [[0.8, 0.0, 0.5], [0.0, 0.0, share * 1.66 / 0.6]],
            ("a side wall", "another refractive index"),
        )
        assert ("ellipsometry" in words(two, 0.01)) == named
    both = fit(
        [[0.3, 0.0, 0.1], [0.8, 0.0, 0.5]], ("a side wall", "another refractive index")
    )
    told = words(both, 0.4)
    assert told.index("ellipsometry") < told.index(
        "cross-section"
    )  # 1.66 and 0.57 nm, of at least 0.415


def test_causes_that_go_by_one_way_are_told_once_and_no_cause_asks_for_frames():
    twice = fit(
        [[0.8, 0.0, 0.5], [0.7, 0.0, 0.5]], ("glass in the beam", "a tilt of the glass")
    )
    assert words(twice, 0.4).count("the glass in the beam") == 1
    none = fit(np.zeros((0, 3)), ())
    assert words(none, 4.0).startswith("frames at source depths")


def test_of_the_map_only_its_own_names_count():
    """A table's slopes are none of the map's: nothing is left that its own frames could
    settle.
    """
    found = fit([[0.8, 0.0, 0.5]])
    assert words(found, 4.0, sure.MAP).startswith("frames at source depths")


def drawn(wide):
    """24 draws whose standard deviation is exactly ``wide``."""
    rows = np.random.default_rng(2).gamma(1.3, 2.0, sure.DRAWS)
    return 5.0 + wide * (rows - rows.mean()) / statistics.stdev(rows)


@pytest.mark.parametrize(
    ("about", "limit", "seed"), [({}, 2.0, 5), ({"wide_nm": 0.7, "seed": 9}, 0.7, 9)]
)
def test_a_spread_up_to_what_is_allowed_is_a_table(about, limit, seed):
    for share, usable in ((0.999, True), (1.001, False)):
        asked = []
        found = fit([[0.8, 0.0, 0.5]])
        rows = drawn(limit * share / 1.7)
        found.samples = lambda count, seed, rows=rows, asked=asked: (
            asked.append((count, seed)) or [(row, 0.0, 0.0) for row in rows]
        )
        told = sure.judge_correction(found, table, **about)
        assert asked == [(24, seed)]
        assert told.usable is usable
        assert told.sigma_nm == pytest.approx(
            limit * share * np.array([0.4, 1.7, 0.9]) / 1.7, rel=1e-9
        )
        assert told.table_nm[:, 2] == pytest.approx(-0.9 * rows, rel=1e-12)
        if not usable:
            wide = f"{limit:.1f} nm (1 sigma, at most {limit:g} allowed; bias_nm 1.25 to 2.75, height_nm -9 to 4.5)"
            assert (
                f"the posterior leaves the bias table open by {wide}. Settle it by "
                in told.words
            )


def test_a_spread_of_just_what_is_allowed_is_a_table():
    found, rows = fit(), drawn(0.3)
    found.samples = lambda count, seed: [(row, 0.0, 0.0) for row in rows]
    widest = float(sure.judge_correction(found, table).sigma_nm.max())
    assert sure.judge_correction(found, table, wide_nm=widest).usable
    assert not sure.judge_correction(found, table, wide_nm=widest * (1 - 1e-12)).usable


def test_a_draw_that_no_table_can_hold_leaves_no_numbers():
    found = fit()
    found.samples = lambda count, seed: [found.value]

    def impossible(x):
        raise ConfigError("3 nm per nm")

    told = sure.judge_correction(found, impossible)
    assert (told.table_nm.shape, told.sigma_nm.shape) == ((0, 0), (0,))
    assert told.words == "no correction: for lenses of the posterior 3 nm per nm"
