"""Widths told, causes scored, terms dropped and noise added up, on models made by hand."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from characterize.inference import (
    arrange,
    causes,
    estimate,
    missing,
    prepare,
    residual,
    verdict,
)
from characterize.inference.leastsquares import Data
from characterize.inference.missing import Lean

RNG, KNOWN = np.random.default_rng(31), SimpleNamespace(known=True)


def test_an_interval_is_told_as_a_share_of_its_prior():
    """± 1.96 sigma is the whole interval: 0.6 and 0.05 wide of 3.92 sigma where 2 and
    0.25 was the prior's.
    """
    found = SimpleNamespace(
        low=np.array([-1.0, 3.0]),
        high=np.array([-1.0 + 3.919928 * 0.6, 3.0 + 3.919928 * 0.05]),
    )
    task = SimpleNamespace(prior=SimpleNamespace(sigma=np.array([2.0, 0.25])))
    assert estimate._told(task, found) == pytest.approx([0.3, 0.2], rel=1e-6)


def test_the_error_of_the_gain_goes_where_electrons_are_counted():
    """Of 3.1 +- 0.4 electrons a count: 0.4 / 3.1 of the background, as much of log
    gain, together; never above 1.
    """
    names = ("bias_nm", "background_e", "log_gain")
    covariance = np.diag([0.3, 0.7, 0.002])
    found = SimpleNamespace(
        best=SimpleNamespace(value=np.array([5.0, 23.0, 1.9])), covariance=covariance
    )
    share = 0.4 / 3.1
    by = np.array([0.0, 23.0 * share, share])
    got = estimate._with_gain(
        names, found, SimpleNamespace(gain_e=3.1, gain_sigma_e=0.4)
    )
    assert got == pytest.approx(covariance + np.outer(by, by), rel=1e-12)
    by = np.array([0.0, 23.0, 1.0])
    got = estimate._with_gain(
        names, found, SimpleNamespace(gain_e=3.1, gain_sigma_e=9.4)
    )
    assert got == pytest.approx(covariance + np.outer(by, by), rel=1e-12)


@pytest.mark.parametrize(
    ("clipped", "told", "want"), [(3, [], 0), (3, ["bad"], 2), (2, ["bad"], 1)]
)
def test_saturation_is_blamed_for_what_is_wrong_and_for_nothing_else(
    monkeypatch, clipped, told, want
):
    """3 of 20 pixels are more than a tenth, 2 of 20 are not; without a problem there is
    nothing to blame.
    """
    monkeypatch.setattr(verdict, "problems", lambda *_: list(told))
    saturated = np.zeros((1, 4, 5), bool)
    saturated[0, 0, :clipped] = True
    task = SimpleNamespace(
        names=(),
        data=SimpleNamespace(saturated=saturated),
        model=SimpleNamespace(modes=np.zeros(3)),
    )
    found = estimate._problems(task, None, KNOWN, [])
    assert len(found) == want
    assert ("15% of the pixels are saturated" in "".join(found)) is (want == 2)
    task.model.modes = np.array([0.8, 0.0, 0.6]) * residual.MOST_RAD
    assert len(estimate._problems(task, None, KNOWN, [])) == want
    task.model.modes = task.model.modes * 1.01
    assert (
        f"a phase of {1.01 * residual.MOST_RAD:.2f} rad rms is left"
        in estimate._problems(task, None, KNOWN, [])[-1]
    )


@pytest.mark.parametrize(("left_rad", "refused"), [(0.5, False), (0.75, True)])
def test_a_phase_that_nobody_explains_may_cost_a_third_of_the_peak_and_no_more(
    monkeypatch, left_rad, refused
):
    """Maréchal: a phase of w rad rms leaves exp(-w²) of the peak, 78 % of it at 0.5 rad
    and 57 % at 0.75.
    """
    monkeypatch.setattr(verdict, "problems", lambda *_: [])
    model = SimpleNamespace(modes=left_rad * np.array([0.28, -0.96]))
    task = SimpleNamespace(
        names=(), data=SimpleNamespace(saturated=np.zeros((1, 4, 5), bool)), model=model
    )
    assert [
        "no parameter explains" in words
        for words in estimate._problems(task, None, KNOWN, [])
    ] == [True] * refused
    assert (math.exp(-(left_rad**2)) < 2 / 3) == refused


@pytest.mark.parametrize(("chi2", "spread"), [(4.0, 4.0), (0.6, 1.0), (1.7, 1.7)])
def test_causes_are_scored_over_the_scatter_that_is_there(monkeypatch, chi2, spread):
    """(c r)² / (c c) / chi-square a pixel, never scored up; far residuals count as 6,
    dark pixels not at all.
    """
    shape = (2, 3, 4)
    image, sigma = np.full(shape, 30.0), RNG.uniform(0.5, 1.5, shape)
    data = Data(
        image,
        np.ones(shape, bool),
        np.zeros(shape, bool),
        sigma**2,
        np.full(shape, 1e15),
    )
    data.usable[0, 0, 0], data.saturated[1, 2, 3] = False, True
    slope, change = RNG.normal(size=shape), RNG.normal(size=shape)
    off = RNG.uniform(-2, 2, shape)
    off[1, 0, 2] = 9.0
    counted = (data.usable & ~data.saturated).ravel()
    root = (1 / sigma).ravel()[counted]
    fitted, other = slope.ravel()[counted] * root, change.ravel()[counted] * root
    rest = np.clip(off, -6, 6).ravel()[counted]
    prior = 0.4
    model = SimpleNamespace(images=lambda x, names: (image, slope[None]))
    task = SimpleNamespace(
        model=model, all_of=lambda x: x, data=data, names=("bias_nm",),
        prior=SimpleNamespace(sigma=np.array([prior]), mean=np.array([0.7])),
    )  # fmt: skip
    mode = SimpleNamespace(
        value=np.array([0.3]),
        residual_sigma=off,
        chi2_per_dof=chi2,
        image=image,
        slopes=slope[None],
    )
    monkeypatch.setattr(
        causes, "changes", lambda *_: [causes.Change("made", change[None])]
    )
    for name in ("_ghost", "_patch"):
        monkeypatch.setattr(missing, name, lambda *_: Lean("none", 0.0, 0, 1.0))
    (lean,) = missing.look(task, mode).leans
    own = other - fitted * (fitted @ other) / (fitted @ fitted + prior**-2)
    moved = fitted @ other / (fitted @ fitted + prior**-2)
    want = (own @ rest + moved * (0.3 - 0.7) / prior**2) ** 2 / spread / (own @ other)
    assert lean.chi2 == pytest.approx(want, rel=1e-9)
    assert lean.chance == pytest.approx(stats.chi2.sf(want, 1), rel=1e-9)


@pytest.mark.parametrize(
    ("scale", "kept"), [(1.0, 2e-2), (2.0, 8e-3), (6.0, 3e-3), (40.0, None)]
)
def test_terms_are_dropped_while_chi_square_rises_by_less_than_a_fiftieth(scale, kept):
    """Images off by the cut times a picture: chi-square is its square over the noise;
    unusable pixels do not count.
    """
    shape = (2, 3, 5)
    exact, picture = RNG.uniform(20, 60, shape), RNG.normal(size=shape)
    data = Data(
        exact,
        np.ones(shape, bool),
        np.zeros(shape, bool),
        RNG.uniform(1, 3, shape),
        np.full(shape, 2.7),
    )
    data.usable[1, 1, 1] = False
    picture[1, 1, 1] = 1e6
    variance = data.variance_e2 + exact / 2.7
    power = float((picture**2 / variance)[data.usable].sum())
    unit = math.sqrt(0.02 / power) / 2.1e-2  # at a cut of 2e-2 chi-square is 0.0181

    def made(cut):
        return SimpleNamespace(
            cut=cut,
            images=lambda x: (exact + (cut or 0.0) * scale * unit * picture, None),
            rough=made,
        )

    assert prepare.quick_enough(made(None), data, np.zeros(2)).cut == kept


def test_the_noise_of_a_frame_is_that_of_its_usable_pixels():
    """Floor and shot noise summed over the pixels that count, each frame by itself."""
    shape = (2, 6, 7)
    light = RNG.uniform(10, 90, shape)
    data = Data(
        light,
        np.ones(shape, bool),
        np.zeros(shape, bool),
        RNG.uniform(2, 5, shape),
        np.full(shape, 1.6),
    )
    data.usable[0, 2:4, 1:3] = False
    data.saturated[1, 0, :3] = True
    groups = [SimpleNamespace(index=np.array([0, 1]))]
    model = SimpleNamespace(
        quick=lambda: None,
        groups=groups,
        setting=SimpleNamespace(depth_um=np.array([1.0, 2.0])),
    )
    found = arrange._Frames.of(model, data)
    variance = (data.variance_e2 + light / 1.6) * data.usable
    assert found.noise == pytest.approx(
        [math.sqrt(v.sum()) for v in variance], rel=1e-12
    )
    assert found.clipped == pytest.approx([0, 3 / 42])


def test_windows_off_are_a_problem_where_the_gain_says_what_is_noise(monkeypatch):
    task = SimpleNamespace(
        names=(),
        data=SimpleNamespace(saturated=np.zeros(3)),
        model=SimpleNamespace(modes=[0.0]),
    )
    monkeypatch.setattr(verdict, "problems", lambda *_: [])
    aside = Lean(causes.WINDOWS, 70.0, 2, 1e-9)
    (said,) = estimate._problems(task, None, KNOWN, [aside])
    assert said.startswith(
        "a window off the chief ray at a field angle explains what is left (chi-square 70 with 2 "
    )
    assert not estimate._problems(task, None, SimpleNamespace(known=False), [aside])


SHOWN = [
    (1e-6, 0, 12.5, "shows"),
    (1e-3, 9, 20.0, ""),
    (1e-3, 16, 20.0, "is likely there (16 to 1)"),
]


@pytest.mark.parametrize(
    ("chance", "odds", "gained", "freed"),
    [*SHOWN, (1e-6, 0, 11.5, ""), (1e-3, 16, 11.5, "")],
)
def test_what_shows_in_the_residuals_is_fitted_where_that_explains_it(
    monkeypatch, chance, odds, gained, freed
):
    """A lean of chi-square 24 beyond chance or likely; kept where the misfit falls by
    half of that or more.
    """

    @dataclasses.dataclass(frozen=True)
    class Asked:
        free: tuple = ()
        all_of = staticmethod(lambda value: value)

    lean = Lean(
        "uneven illumination", 24.0, 3, chance, frees=("light_x", "light_y"), odds=odds
    )
    looks = iter([missing.Looked([lean], None, {}), missing.Looked([], None, {})])
    monkeypatch.setattr(missing, "look", lambda *_: next(looks))
    before = SimpleNamespace(merit=1000.0, value=np.zeros(2), converged=True)
    after = SimpleNamespace(merit=1000.0 - gained, value=np.zeros(4), converged=True)
    monkeypatch.setattr(estimate.search, "wider", lambda task, _: (task, [after]))
    cautions = []
    known = SimpleNamespace(known=True)
    task, ends, looked = estimate._with_what_is_there(
        Asked(), [before], known, cautions
    )
    assert task.free == (("light_x", "light_y") if freed else ())
    assert ends[0] is looked[0] is (after if freed else before)
    assert [words.startswith(f"uneven illumination {freed}") for words in cautions] == [
        True
    ] * bool(freed)


def test_every_plane_of_the_data_is_turned_with_the_frames():
    """Electrons, masks, variance and scale keep their places; what is common to all
    frames has none.
    """
    planes = [RNG.uniform(1, 9, (3, 4, 4)) for _ in range(3)]
    masks = [RNG.random((3, 4, 4)) < share for share in (0.8, 0.3)]
    data = Data(
        planes[0],
        masks[0],
        masks[1],
        planes[1],
        planes[2],
        common_floor=0.3,
        common_light=0.02,
    )
    order = np.array([2, 0, 1])
    mirrored = arrange.Arrangement(
        0.0, 700.0, (0.0, 0.0), 0.9, order, True, True, 2, True, ()
    )
    found = data.arranged(lambda part: arrange.rearranged(part, mirrored))
    for made, given in (
        (found.electrons, planes[0]),
        (found.usable, masks[0]),
        (found.saturated, masks[1]),
        (found.variance_e2, planes[1]),
        (found.scale, planes[2]),
    ):
        assert np.array_equal(made, given[order][:, ::-1, ::-1])  # half a turn
    assert (found.common_floor, found.common_light) == (0.3, 0.02)


@pytest.mark.parametrize(
    ("unseen", "told"), [(0.99, False), (1.01, True), (float("nan"), False)]
)
def test_structure_is_sought_in_residuals_of_one_sigma_and_in_what_frames_share_over_it(
    monkeypatch, unseen, told
):
    """Shares of 3 and 8 e of pixels whose sigma is the root of 4 and 25 e²; the light
    is that of the fit.
    """
    asked = []
    monkeypatch.setattr(
        estimate.verdict,
        "structure",
        lambda left, shared: asked.append((left, shared)) or ["structure"],
    )
    monkeypatch.setattr(estimate.missing, "words", lambda leans: [f"causes of {leans}"])
    data = SimpleNamespace(
        variance=lambda light: 2.0 * light, shared=lambda light: light * [1.5, 0.64]
    )
    solution = SimpleNamespace(image=np.array([2.0, 12.5]), residual_sigma="left")
    unseen *= estimate._LEFT_OUT
    got = estimate._seen(
        SimpleNamespace(data=data), solution, SimpleNamespace(leans="leans"), unseen
    )
    ((left, shared),) = asked
    assert left == "left"
    assert shared == pytest.approx([3.0 / 2.0, 8.0 / 5.0])
    assert got[:2] == ["structure", "causes of leans"]
    assert [f"chi-square {unseen:.2f} a pixel" in words for words in got[2:]] == [
        True
    ] * told


def test_what_stays_open_is_what_is_bent_what_goes_together_and_causes_that_nobody_fitted(
    monkeypatch,
):
    monkeypatch.setattr(estimate.explore, "words", lambda task, found: ["bent"])
    monkeypatch.setattr(
        estimate.knowable,
        "degeneracies",
        lambda names, covariance, sigma: [(names, covariance, sigma)],
    )
    monkeypatch.setattr(estimate.missing, "untold", lambda leans: [f"untold {leans}"])
    task = SimpleNamespace(names="names", prior=SimpleNamespace(sigma="sigma"))
    pairs = ("names", "covariance", "sigma")
    assert estimate._open(task, None, "covariance", SimpleNamespace(leans=3)) == (
        "bent",
        pairs,
        "untold 3",
    )
    assert estimate._open(task, None, "covariance", None) == ("bent", pairs)
