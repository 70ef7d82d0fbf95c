"""How frames lie and are left out, by stand-ins whose answer is known: reversed stacks,
words, halves, far pixels.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from characterize.captures import SensorNoise
from characterize.inference import arrange, leastsquares, residual, verdict
from characterize.inference.arrange import FrameArrangement, _Frames
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.model import parameter_vector

RNG = np.random.default_rng(34)
DEPTH = np.array([31e3, 22e3, 27e3, 24e3, 29e3, 35e3, 20e3])


@pytest.mark.parametrize(
    ("orientation", "words", "mirrored", "quarters"),
    [
        (0, "as they are", False, 0),
        (3, "turned by 270°", False, 3),
        (4, "mirrored", True, 0),
        (6, "mirrored and turned by 180°", True, 2),
    ],
)
def test_an_orientation_is_named_as_it_is_done(orientation, words, mirrored, quarters):
    """Left and right first, then quarter turns."""
    found = FrameArrangement(
        0, 0, (0, 0), 1, np.arange(3), False, True, orientation, True, ()
    )
    assert found.words == words
    frame = np.arange(6.0).reshape(2, 3)
    made = np.rot90(frame[:, ::-1] if mirrored else frame, quarters)
    assert np.array_equal(arrange.orient_frames(frame, orientation), made)


def spot(width):
    y, x = np.mgrid[:21, :23] - np.array([10.0, 11.0])[:, None, None]
    return np.exp(-(y**2 + 1.7 * x**2) / (2 * width**2))


@pytest.mark.parametrize(("turned", "want"), [(False, 1.0), (True, 0.95)])
def test_a_stack_end_to_end_is_worth_a_twentieth_less_than_one_as_stated(
    monkeypatch, turned, want
):
    """Both are wholly alike; what is stated is right unless the other is clearly
    better.
    """
    stack = np.array([spot(w) for w in (1.2, 1.9, 2.7, 3.6)])
    aside = np.swapaxes(np.roll(stack, 1, 0), 1, 2)  # of another lens
    monkeypatch.setattr(arrange, "_expected", lambda model, x, clipped: (stack, aside))
    seen = 5.3 * (stack[::-1] if turned else stack)
    frames = _Frames(None, None, seen, np.zeros(4), np.zeros(4), np.arange(4)[::-1])
    assert frames.scanned(parameter_vector(), np.zeros(1))[1] == pytest.approx(
        want, abs=1e-6
    )


def test_every_second_depth_is_left_out_and_then_the_others(monkeypatch):
    """What each of four fits saw, by the depth of its frames; the last with all of them
    does not come about.
    """
    n, seen = len(DEPTH), []
    everywhere = np.ones((n, 3, 4), bool)
    data = FitImages(
        DEPTH[:, None, None] * everywhere,
        everywhere,
        ~everywhere,
        1.0 * everywhere,
        1.0 * everywhere,
    )
    model = SimpleNamespace(setting=SimpleNamespace(depth_um=DEPTH))
    model.only = lambda index: SimpleNamespace(
        setting=SimpleNamespace(depth_um=DEPTH[index])
    )

    def fit(images, part, begin, *, prior, settings):
        seen.append((part.electrons[:, 0, 0], images, len(begin)))
        return SimpleNamespace(value=begin)

    hidden = []
    monkeypatch.setattr(
        residual,
        "residual_phase_problem",
        lambda here, names, base: here.setting.depth_um,
    )
    monkeypatch.setattr(leastsquares, "fit_levenberg_marquardt", fit)
    monkeypatch.setattr(
        residual,
        "_misfit",
        lambda images, rest, x: hidden.append((rest.electrons[:, 0, 0], images)) or 9.0,
    )
    known = GaussianPrior.none(np.zeros(2))
    assert (
        residual.fit_residual_phase(
            model,
            data,
            ("bias_nm", "height_nm"),
            np.zeros(2),
            base=np.zeros(2),
            prior=known,
        )
        is None
    )
    rising = np.sort(DEPTH)
    assert [sorted(own) for own, _, _ in seen] == [rising[::2].tolist()] * 2 + [
        rising[1::2].tolist()
    ] * 2
    assert [sorted(own) for own, _ in hidden] == [rising[1::2].tolist()] * 2 + [
        rising[::2].tolist()
    ] * 2
    for own, images, *_ in (*seen, *hidden):
        assert np.array_equal(
            own, images
        )  # the model of the same frames, in the same order
    assert [count for *_, count in seen] == [2, 2 + residual.MODES] * 2


@pytest.mark.parametrize(
    ("away", "share", "said"),
    [(6.4, 0.03, True), (5.6, 0.03, False), (6.4, 0.012, False)],
)
def test_pixels_beyond_six_sigma_are_told_where_there_are_more_than_one_in_fifty(
    away, share, said
):
    rest = np.full((2, 20, 25), 0.3)
    rest.ravel()[: round(1000 * share)] = -away
    one = SimpleNamespace(converged=True, image=900 * np.eye(9)[None], residual_sigma=rest, chi2_per_dof=1.0,
                          value=np.zeros(2))  # fmt: skip
    found = verdict.fit_problems(
        ("bias_nm", "coma_x_rad"), one, SensorNoise(1.3, 0.01, 2.0)
    )
    assert [
        f"{share:.1%} of the pixels" in words for words in found if "sigma" in words
    ] == [True] * said
