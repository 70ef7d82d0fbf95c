"""What exploring adds to valleys: profiles stretched by the calibration's error, and a
second lens in words.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import explore, posterior
from characterize.inference.ends import Profile
from characterize.inference.walk import Walk

NAMES = ("bias_nm", "height_nm", "coma_x_rad", "index")


def test_a_profile_is_stretched_about_its_own_mode():
    """1.3 times as wide: the ends and the places of the curve, not how much it rises
    there.
    """
    one = Profile(
        1.1,
        9.7,
        np.array([0.4, 2.0, 5.0, 11.0]),
        np.array([7.0, 1.0, 2.0, 6.0]),
        parabolic=False,
    )
    wide = explore._widened(
        one, np.array([-50.0, 3.0, 8.0]), np.array([2.9, 1.3, 0.4]), 1
    )
    assert (wide.low, wide.high) == pytest.approx(
        (3 - 1.3 * 1.9, 3 + 1.3 * 6.7), rel=1e-12
    )
    assert wide.value == pytest.approx(
        np.array([3 - 1.3 * 2.6, 3 - 1.3, 3 + 1.3 * 2, 3 + 1.3 * 8]), rel=1e-12
    )
    assert wide.rise is one.rise
    assert not wide.parabolic


def test_a_second_lens_is_told_by_the_three_parameters_that_differ_most_in_sigma_and_ends_that_were_not_found():
    """Of steps -8, 3, -0.1 and 0.06 with errors 4, 0.5, 0.1 and 0.02: 2, 6, 1 and 3
    sigma.
    """
    best = SimpleNamespace(
        value=np.array([2.0, -7.0, 0.3, 0.02]),
        covariance=np.diag([4.0, 0.5, 0.1, 0.02]) ** 2,
        merit=812.0,
    )
    other = SimpleNamespace(
        value=best.value + np.array([-8.0, 3.0, -0.1, 0.06]), merit=814.5
    )
    found = SimpleNamespace(
        best=best, modes=(best, other), share=np.array([0.78, 0.22]), parabolic=np.array([True, False, True, True]),
        low=np.array([0.0, -9.25, 0.0, 0.0]), high=np.array([9.0, 1.5, 1.0, 1.0]),
        profiles={
            name: Profile(low, high, np.zeros(1), np.zeros(1), parabolic=False, found=found)
            for name, low, high, found in (
                ("bias_nm", 0.0, 9.0, (True, True)),
                ("height_nm", -9.25, 1.5, (False, True)),
                ("index", 0.0, 1.0, (True, False)),
            )
        },
    )  # fmt: skip
    low, high, bent, second = explore.words(SimpleNamespace(names=NAMES), found)
    assert (
        low
        == "the lower end of height_nm was not found: 95 % reach to -9.25 at least, perhaps beyond"
    )
    assert (
        high
        == "the upper end of index was not found: 95 % reach to 1 at least, perhaps beyond"
    )
    assert bent.startswith("height_nm is bent: 95 % within -9.25 to 1.5 about -7, ")
    assert second.startswith(
        "a second lens explains the frames nearly as well (misfit +2.5, probability 22%): "
    )
    assert (
        ": height_nm -4 for -7, index 0.08 for 0.02, bias_nm -6 for 2; frames" in second
    )


@pytest.mark.parametrize(
    ("gain", "followed", "left"),
    [(0.06, True, True), (0.04, True, False), (5.0, False, False)],
)
def test_a_better_lens_met_on_the_way_out_ends_the_search_of_ends(
    monkeypatch, gain, followed, left
):
    """By more than 0.05 of the misfit, and where it is to be followed; it is fitted to
    its end once.
    """
    refined = []

    class Found:
        def __init__(self, *given):
            self.rounds = 0

        def ends(self, wanted):
            return ["place", "another"]

        def beyond(self):
            self.rounds += 1
            return [(0, 1, None)] if self.rounds < 3 else []

        def profile(self, i):
            return f"profile {i}"

    def refine(task, place):
        refined.append(place)
        return SimpleNamespace(merit=812.0 - gain)

    monkeypatch.setattr(explore, "Search", Found)
    monkeypatch.setattr(explore, "refine", refine)
    task, mode = (
        SimpleNamespace(names=("bias_nm", "height_nm")),
        SimpleNamespace(merit=812.0),
    )
    profiles, other = explore._profiles(task, None, mode, {}, followed=followed)
    assert refined == (["place"] if followed else [])
    assert (other is not None) == left
    assert profiles == (
        {} if left else {"bias_nm": "profile 0", "height_nm": "profile 1"}
    )


REACH = 1.959964
BEST = np.array([1.0, -2.0, 0.5])
OWN = np.array([[0.49, 0.1, -0.2], [0.1, 1.44, 0.3], [-0.2, 0.3, 0.81]])
COMMON = np.array(
    [[0.2, -0.15, 0.05], [-0.15, 0.5, 0.1], [0.05, 0.1, 0.3]]
)  # of dark and flat
HELD = np.array(
    [[0.0, 0.0, 0.0], [0.0, 0.36, 0.12], [0.0, 0.12, 0.25]]
)  # of the others, along the walk


def lens(value, rise=0.0, spread=1.0, covariance=OWN):
    """(mode, valley) of a parabola."""
    mode = SimpleNamespace(
        value=np.asarray(value), merit=70.0 + rise, chi2_per_dof=spread
    )
    sigma = np.sqrt(np.diag(covariance))
    return mode, SimpleNamespace(
        sigma=sigma,
        covariance=covariance,
        least=70.0 + rise,
        calibration=lambda: COMMON,
    )


def walked(width=0.9):
    """Of the first parameter: a Gaussian about the best, the others along a line with
    one covariance.
    """
    x = width * np.linspace(-6, 6, 121)
    value = BEST + x[:, None] * np.array([1.0, 0.7, -1.1])
    return Walk(
        0,
        value,
        (x / width) ** 2,
        np.broadcast_to(HELD, (121, 3, 3)).copy(),
        shown=20.0,
    )


def about(low=-99.0, high=99.0):
    prior = SimpleNamespace(low=np.full(3, low), high=np.full(3, high))
    return SimpleNamespace(names=("bias_nm", "height_nm", "log_gain"), prior=prior)


def test_ends_of_what_has_no_profile_reach_as_far_as_the_walk():
    """Of the third: 1.96 times the root of 0.25 and (1.1 · 0.9)², where that is beyond
    its own; the others' profiles
    stay. What a walk shows to be farther than 1.18 of the parabola is none."""
    mode, valley = lens(BEST)
    profiles = {
        "bias_nm": Profile(-1.0, 2.9, np.zeros(1), np.zeros(1), parabolic=True),
        "height_nm": Profile(-6.0, 0.6, np.zeros(1), np.zeros(1), parabolic=True),
    }
    low, high, parabolic = explore._intervals(
        about(), [mode], [valley], profiles, {"bias_nm": walked()}
    )
    half = REACH * np.hypot(0.5, 1.1 * 0.9)
    assert half > REACH * 0.9
    assert low == pytest.approx([-1.0, -6.0, 0.5 - half], abs=0.01)  # places of 1201
    assert high == pytest.approx([2.9, 0.6, 0.5 + half], abs=0.01)
    ratios = 2.0 / (REACH * 0.7), 4.0 / (REACH * 1.2), half / (REACH * 0.9)
    assert (
        parabolic.tolist()
        == [ratio < 1.18 for ratio in ratios]
        == [False, False, False]
    )
    places = (
        ("bias_nm", 1.0, 1.15 * REACH * 0.7),
        ("height_nm", -2.0, 1.21 * REACH * 1.2),
    )
    narrow = {
        name: Profile(at - r, at + r, np.zeros(1), np.zeros(1), parabolic=True)
        for name, at, r in places
    }
    _, _, parabolic = explore._intervals(
        about(), [mode], [valley], narrow, {"bias_nm": walked(0.6)}
    )
    assert parabolic.tolist() == [True, False, True]
    lopsided = {
        "bias_nm": Profile(
            0.8, 1.0 + 1.21 * REACH * 0.7, np.zeros(1), np.zeros(1), parabolic=True
        )
    }
    assert not explore._intervals(
        about(), [mode], [valley], lopsided, {"bias_nm": walked(0.6)}
    )[2][0]
    # another lens that is 0.3 short of the level
    far = lens(BEST + 9, rise=REACH**2 - 0.3)
    high = explore._intervals(about(), [mode, far[0]], [valley, far[1]], {}, {})[1]
    assert high == pytest.approx(BEST + 9 + 0.3**0.5 * np.array([0.7, 1.2, 0.9]))
    # fewer degrees of misfit than of freedom widen nothing
    assert explore._intervals(about(), [lens(BEST, spread=0.3)[0]], [valley], {}, {})[
        1
    ] == pytest.approx(BEST + REACH * np.array([0.7, 1.2, 0.9]))


def test_draws_scatter_by_what_all_frames_have_in_common_and_their_sigma_is_that_of_the_intervals(
    monkeypatch,
):
    """Of draws that all lie at one place: dark's and flat's covariance. 24 000 of them:
    a hundredth of it.
    """
    monkeypatch.setattr(posterior, "DRAWS", 24_000)
    monkeypatch.setattr(posterior, "draws", lambda valleys: np.tile(BEST, (24_000, 1)))
    mode, valley = lens(BEST)
    bent = {"bias_nm": Profile(-1.0, 3.5, np.zeros(1), np.zeros(1), parabolic=False)}
    found = explore._joined(about(), [mode], [valley], bent, {})
    size = np.sqrt(np.diag(COMMON))
    assert np.abs((np.cov(found.draws.T) - COMMON) / np.outer(size, size)).max() < 0.03
    assert np.abs((found.draws.mean(0) - BEST) / size).max() < 0.03
    sigma = (found.high - found.low) / (2 * REACH)
    assert sigma[1] == pytest.approx(np.sqrt(1.44 + 0.5))
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(sigma)
    correlation = 0.8 * COMMON / np.outer(size, size) + 0.2 * OWN / np.outer(
        valley.sigma, valley.sigma
    )
    assert found.covariance / np.outer(sigma, sigma) == pytest.approx(
        correlation, abs=0.02
    )
    assert found.profiles["bias_nm"].low == found.low[0]
    cut = explore._joined(about(low=-1.8, high=1.1), [mode], [valley], bent, {})
    assert cut.draws == pytest.approx(np.clip(found.draws, -1.8, 1.1))
    assert (cut.low.min(), cut.high.max()) == (-1.8, 1.1)


@pytest.mark.parametrize(("share", "drawn"), [(0.995, False), (0.985, True)])
def test_draws_are_made_where_a_second_lens_has_a_hundredth(monkeypatch, share, drawn):
    monkeypatch.setattr(
        posterior, "draws", lambda valleys: np.tile(BEST, (posterior.DRAWS, 1))
    )
    monkeypatch.setattr(
        posterior, "shares", lambda valleys: np.array([share, 1 - share])
    )
    both = lens(BEST), lens(BEST + 9, rise=30.0)
    found = explore._joined(
        about(), [one[0] for one in both], [one[1] for one in both], {}, {}
    )
    assert len(found.draws) == (posterior.DRAWS if drawn else 0)
    assert found.parabolic.all()


def test_a_lens_beside_the_walk_is_drawn_by_the_mass_of_its_parabola(monkeypatch):
    """exp(-rise / 2) √(2π)³ √det of each over three parameters, those of the walk along
    it: 0.9 and the others'.
    """
    monkeypatch.setattr(posterior, "DRAWS", 30_000)
    asked = []

    def draws(valleys, count):
        asked.append((valleys, count))
        return np.full((count, 3), 50.0)

    monkeypatch.setattr(posterior, "draws", draws)
    on, beside = lens(BEST), lens(BEST + 8, rise=1.3, covariance=0.4 * OWN)
    made = explore._drawn([on[0], beside[0]], [on[1], beside[1]], [walked()], 1.0)
    mass = (
        0.9 * np.sqrt(np.linalg.det(HELD[1:, 1:])),
        np.exp(-1.3 / 2) * np.sqrt(np.linalg.det(0.4 * OWN)),
    )
    ((valleys, count),) = asked
    assert valleys == [beside[1]]
    assert count / 30_000 == pytest.approx(
        mass[1] / sum(mass), abs=0.012
    )  # four sigma; the walk ends at 20: 1e-5
    assert len(made) == 30_000
    assert (made[:, 0] == 50.0).sum() == count
    rest = made[made[:, 0] != 50.0]
    assert np.cov(rest.T)[0, 0] == pytest.approx(0.81, rel=0.05)
    halves = (made[:15_000, 0] == 50.0).sum(), (made[15_000:, 0] == 50.0).sum()
    assert halves[0] == pytest.approx(
        halves[1], rel=0.1
    )  # mixed, so that a part of them is as good


@pytest.mark.parametrize("far", [2000.0, -2000.0])
def test_masses_are_compared_where_none_is_a_number_of_its_own(monkeypatch, far):
    """e^2000 and e^-2000 are beyond double precision; e^-1 of them stays what it is."""
    monkeypatch.setattr(posterior, "DRAWS", 30_000)
    monkeypatch.setattr(Walk, "log_mass", lambda self: far)
    monkeypatch.setattr(explore, "_log_mass", lambda mode, valley, least: far - 1.0)
    monkeypatch.setattr(
        posterior, "draws", lambda valleys, count: np.full((count, 3), 50.0)
    )
    on, beside = lens(BEST), lens(BEST + 8)
    made = explore._drawn([on[0], beside[0]], [on[1], beside[1]], [walked()], 1.0)
    assert (made[:, 0] == 50.0).mean() == pytest.approx(1 / (1 + np.e), abs=0.012)
    monkeypatch.setattr(explore, "_log_mass", lambda mode, valley, least: far - 900.0)
    assert not (
        explore._drawn([on[0], beside[0]], [on[1], beside[1]], [walked()], 1.0)[:, 0]
        == 50.0
    ).any()


def test_the_profile_that_a_walk_is_has_points_from_end_to_end():
    made = explore._whole(
        walked(), lens(BEST)[0], np.array([-1.0, 9, 9]), np.array([3.0, 9, 9])
    )
    value, _ = walked().profile()
    assert (made.low, made.high, made.parabolic) == (-1.0, 3.0, False)
    assert len(made.value) == len(made.rise) == 61
    assert (made.value[0], made.value[-1]) == (value[0], value[-1])
    assert (np.diff(made.value) > 0).all()
    assert made.rise == pytest.approx(((made.value - 1.0) / 0.9) ** 2, abs=1e-3)


def test_a_parameter_whose_draws_all_agree_keeps_a_covariance():
    draws = np.random.default_rng(4).normal(size=(40, 3)) * [0.7, 0.0, 0.9]
    got = explore._covariance(draws, lens(BEST)[1], np.array([0.3, 0.5, 0.8]))
    own = (
        0.2
        * OWN[1]
        / (1.2 * np.array([0.7, 1.2, 0.9]))
        * 0.5
        * np.array([0.3, 0.5, 0.8])
    )
    assert got[1] == pytest.approx(own + np.array([0, 0.8 * 0.25, 0]))
    assert np.isfinite(got).all()


def test_less_misfit_than_noise_narrows_no_covariance():
    mode, valley = lens(BEST, spread=0.3)
    assert explore._joined(
        about(), [mode], [valley], {}, {}
    ).covariance == pytest.approx(OWN + COMMON)


def test_few_draws_share_their_correlation_with_the_parabola_s():
    """Term by term after Schäfer and Strimmer: what 30 draws scatter by chance over how
    far they are from the parabola,
    a fifth at the least, all of it where they are the parabola's."""
    rng = np.random.default_rng(6)
    parabola, sigma = (
        np.array([[4.0, 1.1, 0.2], [1.1, 0.9, -0.3], [0.2, -0.3, 2.5]]),
        np.array([2.2, 1.0, 1.7]),
    )
    valley = SimpleNamespace(covariance=parabola, sigma=np.sqrt(np.diag(parabola)))
    told = []
    for bend in (0.6, 40.0, 0.0):
        draws = rng.multivariate_normal(np.zeros(3), parabola, 30)
        draws[:, 2] += bend * draws[:, 0]
        r = np.corrcoef(draws.T)
        other = parabola / np.outer(valley.sigma, valley.sigma)
        chance = sum((1 - r[i, j] ** 2) ** 2 / 30 for i in range(3) for j in range(3))
        apart = sum((r[i, j] - other[i, j]) ** 2 for i in range(3) for j in range(3))
        told.append(min(max(chance / apart, 0.2), 1.0))
        want = ((1 - told[-1]) * r + told[-1] * other) * np.outer(sigma, sigma)
        assert explore._covariance(draws, valley, sigma) == pytest.approx(
            want, rel=1e-6
        )
    assert any(
        0.21 < share < 0.45 for share in told
    )  # none of these is at a limit where it is halved
