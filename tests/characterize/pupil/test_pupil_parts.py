"""Pieces of the pupil fit with known answers: stage zero, background tilt, start, and
what is known beforehand.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference.leastsquares import FitImages
from characterize.pupil import fit as pupilfit
from characterize.pupil.record import PupilModel, PupilSpec

RNG = np.random.default_rng(4)
SPEC = PupilSpec(
    0.3,
    0.5,
    0.4,
    window=16,
    phase_order=5,
    amplitude_order=2,
    drift_order=1,
    model_error=0.0,
)
Z = np.array([-8.0, -3.0, 1.0, 6.0])


def model(spec=SPEC, position=Z):
    return PupilModel(
        spec,
        position,
        phase_order=spec.phase_order,
        amplitude_order=spec.amplitude_order,
    )


def capture(peaks, stated):
    frames = np.full((len(peaks), 6, 7), 10.0)
    frames[:, 2, 3] += peaks
    return SimpleNamespace(frames=frames, position_um=np.asarray(stated, float))


def test_positions_are_about_the_centre_of_what_is_sharper_than_half():
    peaks = np.array([10.0, 60.0, 100.0, 70.0, 20.0])
    stated = np.array([3.0, 4.0, 6.0, 7.0, 9.0])
    zero = (10 * 4.0 + 50 * 6.0 + 20 * 7.0) / 80
    assert pupilfit._positions(capture(peaks, stated), SPEC) == pytest.approx(
        stated - zero
    )
    step = PupilSpec(0.3, 0.5, 0.4, step_um=-0.7)
    zero = -0.7 * (10 * 1 + 50 * 2 + 20 * 3) / 80
    assert pupilfit._positions(capture(peaks, stated), step) == pytest.approx(
        -0.7 * np.arange(5) - zero
    )


def test_tilt_of_the_background_is_read_from_the_rim():
    y, x = np.mgrid[-1:1:31j, -1:1:41j]
    frames = 50 + 3.0 * x - 1.7 * y + RNG.normal(0, 0.2, (9, 31, 41))
    frames[:, 13:18, 17:24] += 900.0  # the bead
    frames[:, 0, 5:9] += 400.0  # another at the rim
    frames[:, 30, 40] = np.nan
    assert (
        np.abs(pupilfit._plane(frames) - (3.0 * x - 1.7 * y)).max() < 0.05
    )  # 0.2 / 3 over 450 pixels, at corners


def test_offset_of_the_bead_from_the_middle():
    y, x = np.mgrid[:20, :24]
    for row, column, want in ((10 + 6, 12 - 4, (6, -4)), (10 + 1, 12 + 1, (0, 0))):
        light = 30 + 500 * np.exp(-((y - row) ** 2 + (x - column) ** 2) / 4.0)
        stack = np.tile(light, (3, 1, 1))
        seen = FitImages(
            stack, np.ones(stack.shape, bool), np.zeros(stack.shape, bool), stack, stack
        )
        assert tuple(pupilfit._offset(seen)) == want


def test_more_orders_begin_at_zero_and_the_rest_stays():
    small = PupilModel(SPEC, Z, phase_order=4, amplitude_order=0)
    large = model()
    value = RNG.normal(size=small.layout().size)
    grown = large.layout().split(pupilfit._grow(value, small, large))
    before = small.layout().split(value)
    assert grown[0][: len(before[0])] == pytest.approx(before[0])
    assert not grown[0][len(before[0]) :].any()
    assert not grown[1][len(before[1]) :].any()
    for one, other in zip(grown[2:], before[2:], strict=True):
        assert one == pytest.approx(other)


def test_what_is_known_of_a_pupil_beforehand():
    """3 rad for orders to 4, then falling with the cube; 0.5 / n; 10 pixels of drift;
    gains to 30 %;
    planes to a tenth of their step; the rest free."""
    pupil = model()
    layout = pupil.layout()
    start = RNG.normal(size=layout.size)
    prior = pupilfit._prior(pupil, start)
    phase, amplitude, dx, dy, dz, blur, gain, level = layout.split(prior.sigma)
    assert dz == pytest.approx(np.full(4, 0.1 * (Z[-1] - Z[0]) / 3))
    assert phase == pytest.approx(
        [3.0 * min(1.0, (4 / n) ** 3) for n, _ in pupil.phase_indices]
    )
    assert amplitude == pytest.approx([0.5 / n for n, _ in pupil.amplitude_indices])
    assert np.concatenate([dx, dy]) == pytest.approx(np.full(2 * layout.drift, 4.0))
    assert math.isinf(blur)
    assert gain == pytest.approx(np.full(4, 0.3))
    assert np.isinf(level).all()
    means, begun = layout.split(prior.mean), layout.split(start)
    assert not means[0].any()
    assert not means[1].any()
    assert not means[4].any()
    for part in (2, 3, 5, 6, 7):
        assert means[part] == pytest.approx(begun[part])
    low, high = layout.split(prior.low), layout.split(prior.high)
    assert (low[5], high[5]) == pytest.approx((0.02, 1.6))
    assert np.isinf(np.delete(prior.low, layout.size - 9)).all()


def test_a_start_takes_light_and_level_from_the_frames():
    stack = np.full((4, 16, 16), 12.0)
    stack[:, 5:9, 6:11] += np.array([40.0, 90.0, 70.0, 30.0])[:, None, None]
    seen = FitImages(
        stack, np.ones(stack.shape, bool), np.zeros(stack.shape, bool), stack, stack
    )
    pupil = model()
    phase, amplitude, dx, dy, dz, blur, gain, level = pupil.layout().split(
        pupilfit._start(pupil, seen, 0.8)
    )
    assert phase[pupil.phase_indices.index((4, 0))] == 0.8
    assert np.count_nonzero(phase) == 1
    assert not amplitude.any()
    assert blur == pytest.approx(0.2)
    assert gain == pytest.approx(np.full(4, math.log(90.0 * 20)))
    assert level == pytest.approx(np.full(4, 12.0))
    assert not np.concatenate([dx, dy, dz]).any()


@pytest.mark.parametrize(("chi2", "widened"), [(0.4, 1.0), (1.6, 1.6), (9.0, 9.0)])
def test_error_bars_grow_with_a_misfit_and_never_shrink(monkeypatch, chi2, widened):
    """sigma = sqrt of the covariance's diagonal times chi² where that is above 1."""
    pupil = model()
    n = pupil.layout().size
    mixed = RNG.normal(size=(n, n))
    covariance = mixed @ mixed.T
    stack = RNG.uniform(5, 9, (4, 16, 16))
    seen = FitImages(
        stack, np.ones(stack.shape, bool), np.zeros(stack.shape, bool), stack, stack
    )
    solution = SimpleNamespace(
        value=np.zeros(n), covariance=covariance, chi2_per_dof=chi2, image=stack + 1, residual_sigma=stack,
        converged=True, reason="",
    )  # fmt: skip
    for name, answer in (
        ("_complete", SPEC),
        ("to_electrons", SimpleNamespace(corrections=("dark",))),
        ("_positions", Z),
        ("_crop", (seen, 4.0, ["cut"])),
        ("_fit", (pupil, solution)),
        ("_cautions", ()),
    ):
        monkeypatch.setattr(pupilfit, name, lambda *_, answer=answer, **__: answer)
    found = pupilfit.fit_pupil(None, SPEC, judge=False, insist=True)
    assert found.sigma == pytest.approx(
        np.sqrt(np.diag(covariance) * widened), rel=1e-12
    )
    assert found.cautions[:2] == ("dark", "cut")
    assert found.held_out is None


@pytest.mark.parametrize(("high", "kept"), [(4.2, True), (4.8, False)])
def test_a_rim_pixel_beyond_three_robust_sigma_has_no_part_in_the_tilt(high, kept):
    """A chequer of ±1 about a plane: sigma is 1.4826, three of them 4.45."""
    y, x = np.mgrid[-1:1:21j, -1:1:27j]
    chequer = np.where(np.add.outer(np.arange(21), np.arange(27)) % 2, 1.0, -1.0)
    level = 40 + 2.3 * x - 1.1 * y + chequer
    spots = [
        (0, 20),
        (3, 26),
        (18, 25),
        (20, 22),
    ]  # all to one side, so that they would tilt it
    for row, column in spots:
        level[row, column] = 40 + 2.3 * x[row, column] - 1.1 * y[row, column] + high
    rim = (np.abs(x) > 0.8) | (np.abs(y) > 0.8)
    for row, column in spots:
        rim[row, column] &= kept
    design = np.stack([np.ones_like(x), x, y], -1)
    _, a, b = np.linalg.lstsq(design[rim], level[rim], rcond=None)[0]
    assert pupilfit._plane(np.tile(level, (3, 1, 1))) == pytest.approx(
        a * x + b * y, abs=1e-9
    )


def test_cells_on_the_rim_of_a_pupil_weigh_their_share_inside():
    """The vector of a ray has length 1, so that components carry the weight: against
    24² points a cell.
    """
    pupil = model()
    step = 2 * SPEC.sine / pupil.nodes
    part = ((np.arange(24) + 0.5) / 24 - 0.5) * step
    inside = (
        np.hypot(
            pupil.sx[:, None, None] + part, pupil.sy[:, None, None] + part[:, None]
        )
        < SPEC.sine
    )
    share = inside.mean((1, 2))
    weight = np.abs(pupil.components).reshape(-1, len(share))
    weight = np.sqrt((weight**2).sum(0))
    deep = share == 1
    weight = weight / np.median(
        weight[deep & (np.hypot(pupil.sx, pupil.sy) > 0.7 * SPEC.sine)]
    )
    rim = (share > 0) & (share < 1)
    assert (
        np.abs(weight - share)[rim].mean() < 0.05
    )  # slant of the rim; slow growth of obliquity to it
    assert weight[rim].sum() == pytest.approx(share[rim].sum(), rel=0.03)


@pytest.mark.parametrize("high", [0.4, 2.0, 600.0, -2.0])
def test_a_plane_without_noise_is_found_whatever_stands_on_it(high):
    """Three robust sigma of nothing leave only the plane itself: weak light is no part
    of it, nor is strong.
    """
    y, x = np.mgrid[-1:1:21j, -1:1:27j]
    plane = 5.3 * x - 7.1 * y
    level = 40 + plane
    for row, column in ((0, 20), (3, 26), (18, 25), (20, 22)):
        level[row, column] += high
    assert pupilfit._plane(np.tile(level, (3, 1, 1))) == pytest.approx(
        plane, abs=1e-7
    )  # 1e-9 a round


def frames_of(light, usable=None):
    usable = np.ones(light.shape, bool) if usable is None else usable
    return SimpleNamespace(
        electrons=light, usable=usable, saturated=np.zeros(light.shape, bool),
        variance_e2=np.full(light.shape, 4.0), scale=np.arange(light[0].size, dtype=float).reshape(light.shape[1:]),
    )  # fmt: skip


def bead_at(row, column):
    """5 x 5 pixels of 600, 750 and 900 in the middle."""
    y, x = np.mgrid[:30, :41]
    bead = 900.0 - 150 * np.maximum(np.abs(x - column), np.abs(y - row))
    return np.where(bead < 500, 0, bead)


@pytest.mark.parametrize(
    ("centre", "first"),
    [((14, 21), (6, 13)), ((4, 21), (0, 13)), ((14, 36), (6, 25)), ((26, 4), (14, 0))],
)
def test_the_window_lies_about_the_bead_and_moves_inwards_at_an_edge(centre, first):
    """16 pixels of 30 x 41 about the brightest place, or about the one that is stated."""
    light = 20.0 + np.array([0.3, 1.0, 0.7, 0.5])[:, None, None] * bead_at(*centre)
    found, background, notes = pupilfit._crop(frames_of(light), SPEC)
    part = (slice(None), slice(first[0], first[0] + 16), slice(first[1], first[1] + 16))
    assert found.electrons == pytest.approx(light[part])
    assert background == pytest.approx(
        20.0, abs=1e-9
    )  # the median is far from the bead
    assert any("near the edge" in words for words in notes) == (
        first != (centre[0] - 8, centre[1] - 8)
    )
    whole = np.broadcast_to(frames_of(light).scale, light.shape)
    assert np.array_equal(found.scale, whole[part])


@pytest.mark.parametrize(("tilt", "taken"), [(8.5, False), (9.5, True)])
def test_a_plane_is_taken_off_from_a_fiftieth_of_the_light_on(tilt, taken):
    """Over the window it changes by ``tilt`` along each axis, of a light of 900 above
    the middle of the frame.
    """
    y, x = np.mgrid[:30, :41]
    slope = tilt / 15 * ((x - 20) - (y - 15))
    light = np.tile(50.0 + slope + bead_at(15, 20), (4, 1, 1))
    found, background, notes = pupilfit._crop(frames_of(light), SPEC)
    part = (slice(7, 23), slice(12, 28))
    plane = np.ptp(slope[part])
    assert plane == pytest.approx(2 * tilt)
    level = 0.0 if not taken else tilt / 15 * ((x - 19.5) - (y - 14.5))[part]
    assert found.electrons[0] == pytest.approx((light[0][part] - level), abs=1e-9)
    assert any(f"plane of {plane:.3g} e" in words for words in notes) == taken
    assert background == pytest.approx(50.0 if taken else np.median(light), abs=1e-9)
