"""Gain, noise floor, flat, masks and merged brackets in closed form: frames made of
levels and chequers, no chance.
"""

import math

import numpy as np
import pytest
from scipy import optimize

from characterize.captures import electrons as clean
from characterize.captures.capture import Capture
from metalens.ground.errors import CaptureError

NY, NX = 12, 14
CHEQUER = np.where(np.add.outer(np.arange(NY), np.arange(NX)) % 2, 1.0, -1.0)


def capture(frames, bits=12, **more):
    n = len(frames)
    unknown = np.full(n, np.nan)
    return Capture(
        frames,
        unknown,
        np.zeros((n, 2)),
        unknown,
        tuple(map(str, range(n))),
        bits,
        **more,
    )


def pair(level, swing):
    """Two frames whose difference is a chequer: the variance of one is 2 swing² n / (n
    - 1).
    """
    return [level - swing * CHEQUER, level + swing * CHEQUER]


def varies(swing):
    return 2 * swing**2 * NY * NX / (NY * NX - 1)


LEVELS, SWINGS, OFFSET = (
    np.array([310.0, 940.0, 2750.0]),
    np.array([3.8, 5.5, 9.4]),
    21.5,
)
MIXED = [
    pair(level, swing)[k]
    for k in (0, 1)
    for level, swing in zip(LEVELS, SWINGS, strict=True)
]  # pairs apart


@pytest.mark.parametrize(
    "swing", [1.7, 0.43]
)  # 0.37 counts² are noise that hides rounding
def test_gain_with_a_floor_from_the_dark_frames(swing):
    """1 / gain is the mean of (v - floor) / m, each with the weight m² over the square
    of its error √(2 / n) v.
    """
    found = clean.photon_transfer(np.stack(MIXED), np.stack(pair(OFFSET, swing)))
    mean, floor = LEVELS - OFFSET, varies(swing)
    slope = (varies(SWINGS) - floor) / mean
    fitted = floor + mean * (slope * mean).sum() / mean.sum()
    error = fitted * math.sqrt(2 / (NY * NX)) / mean  # of one slope
    inverse = np.average(slope, weights=error**-2)
    assert found.gain_e == pytest.approx(1 / inverse, rel=1e-12)
    assert found.gain_sigma_e == pytest.approx(
        (error**-2).sum() ** -0.5 / inverse**2, rel=1e-12
    )
    assert found.read_noise_e == pytest.approx(
        math.sqrt(floor - 1 / 12) / inverse, rel=1e-12
    )
    assert found.known


def test_dark_frames_half_way_between_two_counts_read_as_quiet_as_they_are():
    """Nearly half of them up: 0.25 counts² of 0.17 of noise, of which rounding hides
    nothing; taken for noise beside
    1/12 they would read as 0.35 and more. Pixels' levels scatter by the usual tenth;
    0.03 is what noise and scatter
    leave to one another."""
    rng = np.random.default_rng(17)
    level = OFFSET + 0.02 + 0.1 * rng.standard_normal((50, 60))
    dark = np.rint(level + 0.17 * rng.standard_normal((4, 50, 60)))
    assert dark.var() == pytest.approx(0.25, rel=0.02)
    found = clean.photon_transfer(np.stack(MIXED), dark)
    assert found.read_noise_e / found.gain_e == pytest.approx(0.17, abs=0.03)


def test_gain_and_floor_from_the_levels_alone():
    """The line through levels apart is scipy's, with its standard error."""
    found = clean.photon_transfer(np.stack(MIXED))
    variance = varies(SWINGS)
    error = LEVELS * variance.sum() / LEVELS.sum() * math.sqrt(2 / (NY * NX))
    best, covariance = optimize.curve_fit(
        lambda x, a, b: a * x + b,
        LEVELS,
        variance,
        sigma=error,
        absolute_sigma=True,
        p0=(0.1, 10.0),
    )
    assert found.gain_e == pytest.approx(1 / best[0], rel=1e-6)
    assert found.gain_sigma_e == pytest.approx(
        covariance[0, 0] ** 0.5 / best[0] ** 2, rel=1e-6
    )
    assert found.read_noise_e == pytest.approx(
        math.sqrt(best[1] - 1 / 12) / best[0], rel=1e-6
    )


def test_one_dark_frame_gives_the_offset_and_no_floor():
    one = clean.photon_transfer(np.stack(MIXED), np.full((1, NY, NX), OFFSET))
    none = clean.photon_transfer(np.stack(MIXED) - OFFSET)
    assert (one.gain_e, one.gain_sigma_e) == pytest.approx(
        (none.gain_e, none.gain_sigma_e), rel=1e-9
    )
    assert one.read_noise_e == pytest.approx(none.read_noise_e, rel=1e-9)
    assert none.read_noise_e > 1


@pytest.mark.parametrize(("swing", "reach"), [(0.21, 4.0), (5.0, 8 * 1.4826 * 5.0)])
def test_the_level_of_a_flat_leaves_out_what_lies_eight_sigma_away(swing, reach):
    """Of half a count at least; what is fixed in both frames has no part in the noise."""
    flat = np.stack(pair(100.0, swing))
    flat[:, 3, 4], flat[:, 5, 6] = 100 + 0.95 * reach, 100 + 1.1 * reach
    found = clean.photon_transfer(flat)
    mean = np.delete(flat.mean(0).ravel(), 5 * NX + 6).mean()
    steps = (flat[1] - flat[0]) / math.sqrt(2)
    assert found.gain_e == pytest.approx(mean / steps.var(ddof=1), rel=1e-12)


def test_a_single_flat_tells_no_gain():
    found = clean.clean(
        capture(np.full((1, NY, NX), 900), flat=np.full((1, NY, NX), 700))
    )
    assert (found.gain.gain_e, found.gain.known) == (1.0, False)


def test_a_floor_below_none_is_none():
    swings = np.array([4.1, 8.3, 13.9])  # the line through them meets 0 counts at -9
    flat = np.stack(
        [
            f
            for level, swing in zip(LEVELS, swings, strict=True)
            for f in pair(level, swing)
        ]
    )
    assert clean.photon_transfer(flat).read_noise_e == 0


@pytest.mark.parametrize(("second", "line"), [(790.0, True), (810.0, False)])
def test_levels_closer_than_a_fifth_do_not_tell_the_floor(second, line):
    """Of 1000 and 790 counts a line can be drawn; of 1000 and 810 the floor is none."""
    found = clean.photon_transfer(np.stack([*pair(1000.0, 9.0), *pair(second, 8.5)]))
    slope = (varies(9.0) - varies(8.5)) / (1000 - second)
    if line:
        assert found.gain_e == pytest.approx(1 / slope, rel=1e-9)
    else:
        assert found.read_noise_e == 0
        means = np.array([1000, second])
        ratios = np.array([varies(9.0), varies(8.5)]) / means
        assert found.gain_e == pytest.approx(
            1 / ratios.mean(), rel=1e-12
        )  # m / error is the same for both


def test_a_step_of_6_5_sigma_is_no_noise_and_one_of_5_5_is():
    """Of the dark's differences what lies beyond 6 robust sigma is a bad pixel: 1.4826
    x the median of all.
    """
    swing = 3.3
    dark = np.stack(pair(60.0, swing))
    sigma = 1.4826 * math.sqrt(2) * swing
    dark[1, 2, 3] = dark[0, 2, 3] + math.sqrt(2) * 5.5 * sigma
    dark[1, 7, 4] = dark[0, 7, 4] + math.sqrt(2) * 6.5 * sigma
    found = clean.clean(capture(np.full((1, NY, NX), 300), dark=dark, flat=None))
    steps = (dark[1] - dark[0]) / math.sqrt(2)
    steps = np.delete((steps - steps.mean()).ravel(), 7 * NX + 4)
    floor = (steps**2).mean() * NY * NX / (NY * NX - 1)
    assert found.gain.read_noise_e == pytest.approx(math.sqrt(floor), rel=1e-12)
    assert not found.gain.known
    assert found.gain.gain_e == 1
    assert found.gain.gain_sigma_e == math.inf


@pytest.mark.parametrize(
    ("about", "noise"),
    [({"gain_e": 3.7}, 2.0), ({"gain_e": 3.7, "read_noise_e": 5.3}, 5.3)],
)
@pytest.mark.parametrize("repeats", [0, 1, 3])
def test_the_floor_is_read_and_rounding_noise_and_that_of_the_mean_dark(
    about, noise, repeats
):
    rng = np.random.default_rng(2)
    dark = rng.integers(18, 25, (repeats, NY, NX)) if repeats else None
    frames = rng.integers(200, 290, (2, NY, NX))
    found = clean.clean(capture(frames, dark=dark, about=about))
    own = noise**2 + 3.7**2 / 12
    of_dark = own / repeats if repeats else 0.0
    assert found.variance_e2 == pytest.approx(
        np.full((2, NY, NX), own + of_dark), rel=1e-12
    )
    assert found.common_floor == pytest.approx(of_dark / (own + of_dark), rel=1e-12)
    assert found.common_light == 0
    level = dark.mean(0) if repeats else 0.0
    assert found.electrons == pytest.approx(3.7 * (frames - level), rel=1e-12)


def test_without_flats_and_with_one_dark_two_counts_of_noise_are_assumed():
    found = clean.clean(
        capture(np.full((1, NY, NX), 300), dark=np.full((1, NY, NX), 11))
    )
    assert found.gain.read_noise_e == 2
    assert found.variance_e2 == pytest.approx(
        2 * (4 + 1 / 12), rel=1e-12
    )  # the one dark is as noisy as the frame


def shaded(uneven, swing):
    """Two flats whose halves differ by 2 ``uneven`` of 2000 counts above a dark of 40."""
    light = (
        2000.0
        * np.where(np.arange(NX) < NX // 2, 1 - uneven, 1 + uneven)
        * np.ones((NY, 1))
    )
    return np.stack([light + 40 - swing * CHEQUER, light + 40 + swing * CHEQUER])


@pytest.mark.parametrize(("ratio", "divided"), [(1.3, True), (1.1, False)])
def test_a_flat_counts_where_it_is_rougher_than_its_noise(ratio, divided):
    """The mean of two has √(v / 2) of noise; the halves a robust sigma of 1.4826 x
    their distance from the median.
    """
    swing = 120.0
    noise = math.sqrt(varies(swing) / 2) / 2000
    uneven = ratio * noise / 1.4826
    about = {"gain_e": 3.7, "read_noise_e": 2.6}
    dark = np.full((2, NY, NX), 40)
    found = clean.clean(
        capture(
            np.full((1, NY, NX), 900),
            dark=dark,
            flat=shaded(uneven, swing),
            about=about,
        )
    )
    own = 1.5 * (2.6**2 + 3.7**2 / 12)
    flat = (
        np.where(np.arange(NX) < NX // 2, 1 - uneven, 1 + uneven)
        if divided
        else np.ones(NX)
    )
    assert found.common_light == pytest.approx(noise if divided else 0.0, rel=1e-12)
    assert found.electrons[0, 0] == pytest.approx(860 * 3.7 / flat, rel=1e-12)
    assert found.scale[0, 0] == pytest.approx(flat, rel=1e-12)
    assert found.variance_e2[0, 0] == pytest.approx(own / flat**2, rel=1e-12)


def test_a_flat_is_divided_by_between_0_3_and_3():
    flat = shaded(0.2, 1.0)  # two of either half change: the median stays between them
    wanted = {(1, 1): 0.27, (2, 5): 0.33, (3, 9): 2.9, (4, 12): 3.1}
    for place, share in wanted.items():
        flat[(slice(None), *place)] = 40 + share * 2000
    frames = np.full((1, NY, NX), 900)
    found = clean.clean(
        capture(frames, dark=np.full((1, NY, NX), 40), flat=flat, about={"gain_e": 1.0})
    )
    assert [float(found.scale[0, y, x]) for y, x in wanted] == pytest.approx(
        [1.0, 0.33, 2.9, 1.0], rel=1e-12
    )
    assert [bool(found.usable[0, y, x]) for y, x in wanted] == [
        False,
        True,
        True,
        False,
    ]


def level(highest, at_top, near, background=100):
    """A frame with ``at_top`` pixels at the highest count and ``near`` ones 1 % below
    it.
    """
    frame = np.full((1, 20, 20), background)
    frame[0, 0, :at_top] = highest
    frame[0, 1, :near] = round(0.985 * highest)
    return capture(frame)


@pytest.mark.parametrize(
    ("made", "clips"),
    [
        (level(3000, 4, 3), True),
        (level(3000, 4, 4), False),  # half of the near ones: light that comes to a top
        (level(3000, 3, 0), False),
        (level(117, 4, 0), True),
        (level(116, 4, 0), False),  # 16 counts above the rest: no well is so small
        (level(103, 20, 20), False),  # 5 % of all
        (level(103, 20, 0), False),
    ],
)
def test_a_plateau_of_four_pixels_more_than_half_of_those_near_it_is_a_full_well(
    made, clips
):
    assert clean.saturation_level(made) == (made.frames.max() if clips else 4095)


@pytest.mark.parametrize(
    ("count", "highest", "clips"), [(21, 103, True), (21, 102, False), (20, 103, False)]
)
def test_more_than_a_twentieth_of_all_pixels_at_one_count_is_a_full_well(
    count, highest, clips
):
    frame = np.full((1, 20, 20), 100)
    frame.ravel()[:count] = highest
    assert clean.saturation_level(capture(frame)) == (highest if clips else 4095)


def test_a_dark_pixel_is_hot_above_eight_sigma_of_half_a_count_at_least():
    dark = np.full((10, NY, NX), 30)
    dark[:, 2, 3] += 4  # 8 x 0.5 counts, no more
    dark[:, 5, 7] += 4
    dark[0, 5, 7] += 1
    dark[:, 6, 1] -= 5
    frames = np.full((1, NY, NX), 500)
    bad = clean.bad_pixels(capture(frames, dark=dark))
    assert sorted(map(tuple, np.argwhere(bad))) == [(5, 7), (6, 1)]
    rough = 30.0 + 2.0 * CHEQUER[None]  # sigma 1.4826 x 2, eight of them 23.7
    rough = np.repeat(rough, 2, 0)
    rough[:, 4, 4], rough[:, 8, 9] = 30 + 23.4, 30 - 24.1  # the median stays 30
    bad = clean.bad_pixels(capture(frames, dark=rough))
    assert sorted(map(tuple, np.argwhere(bad))) == [(8, 9)]


def test_a_pixel_that_never_changes_is_stuck_where_it_differs_from_its_neighbours():
    frames = 500 + 3 * np.arange(3)[:, None, None] * np.ones((1, NY, NX), int)
    for place, value in {
        (3, 4): 504,
        (6, 9): 505,
        (8, 2): 490,
    }.items():  # the others have a mean of 503
        frames[(slice(None), *place)] = value
    assert sorted(map(tuple, np.argwhere(clean.bad_pixels(capture(frames))))) == [
        (6, 9),
        (8, 2),
    ]
    assert not clean.bad_pixels(
        capture(frames[:2])
    ).any()  # two frames of a kind are no proof


@pytest.mark.parametrize("axis", [0, 1])
def test_a_dead_line_is_dead_along_itself_alone(axis):
    frames = np.full((2, NY, NX), 40)
    frames[1] += 7
    line = (slice(None), 4) if axis == 0 else (slice(None), slice(None), 4)
    frames[line] = 0
    want = np.zeros((NY, NX), bool)
    want[line[1:]] = True
    assert np.array_equal(clean.bad_pixels(capture(frames)), want)


def test_a_lonely_spike_stands_six_sigma_and_half_above_its_neighbours_in_most_frames():
    """Even light has a spread of 0.5 counts (the least): 3 counts and 1.5 x the
    brightest neighbour.
    """
    frames = np.full((10, NY, NX), 10)
    frames[:, 2, 2] = 16  # 1.6 x and 6 counts: a spike
    frames[:, 2, 8] = 15  # 1.5 x, no more
    frames[:9, 6, 3] = 16  # in nine of ten
    frames[:8, 6, 9] = 16  # in eight: no
    bad = clean.bad_pixels(
        capture(frames + 1e-3 * np.arange(10)[:, None, None])
    )  # nothing is constant
    assert sorted(map(tuple, np.argwhere(bad))) == [(2, 2), (6, 3)]
    slope = (
        100.0
        + 20 * np.arange(NX) * np.ones((3, NY, 1))
        + 1e-3 * np.arange(3)[:, None, None]
    )
    slope[:, 4, 5] += (
        150  # light that grows over the frame is no spread about the neighbours
    )
    assert sorted(map(tuple, np.argwhere(clean.bad_pixels(capture(slope))))) == [(4, 5)]
    faint = np.full((3, NY, NX), 4.0) + 1e-3 * np.arange(3)[:, None, None]
    faint[:, 3, 3], faint[:, 7, 7] = (
        faint[:, 0, 0] + 2.9,
        faint[:, 0, 0] + 3.1,
    )  # 6 x 0.5 counts
    assert sorted(map(tuple, np.argwhere(clean.bad_pixels(capture(faint))))) == [(7, 7)]
    assert not clean.bad_pixels(capture(faint[:2])).any()


def brackets():
    """Three exposures of four pixels: all open, the longest full, one masked, all full."""
    light = np.array(
        [
            [110.0, 330.0, 980.0],
            [300.0, 905.0, 2000.0],
            [77.0, 5.0, 720.0],
            [2000.0, 2000.0, 2000.0],
        ]
    ).T
    usable, saturated = np.ones((3, 4), bool), np.zeros((3, 4), bool)
    saturated[2, 1], usable[1, 2], saturated[:, 3] = True, False, True
    floor = np.array(
        [[3.0, 4.0, 5.0, 6.0], [7.0, 8.0, 9.0, 10.0], [2.0, 12.0, 13.0, 14.0]]
    )
    scale = np.array([[1.3, 0.7, 1.9, 0.9], [1.2, 0.8, 1.7, 1.1], [1.4, 0.6, 1.8, 1.5]])
    shape = (3, 1, 4)
    gain = clean.Gain(1.7, 0.02, 3.0)
    parts = [a.reshape(shape) for a in (light, usable, saturated, floor, scale)]
    return clean.Frames(*parts, gain, ("as made",), 0.3, 0.04)


def test_brackets_merge_by_inverse_variance_of_their_rates():
    """The rate from all that is open tells each bracket's noise; noise / time² is that
    of its rate.
    """
    made, exposure = brackets(), np.array([0.02, 0.06, 0.2])
    merged, first = clean.merge_brackets(made, exposure, np.array([5, 5, 5]))
    time = exposure / 0.2
    assert first.tolist() == [0]
    for pixel, open_ in enumerate(([0, 1, 2], [0, 1], [0, 2])):
        light, floor, scale = (
            getattr(made, n)[open_, 0, pixel]
            for n in ("electrons", "variance_e2", "scale")
        )
        rate = light.sum() / time[open_].sum()
        noise = (floor + rate * time[open_] / scale) / time[open_] ** 2
        weight = (1 / noise) / (1 / noise).sum()
        assert merged.electrons[0, 0, pixel] == pytest.approx(
            weight @ (light / time[open_]), rel=1e-12
        )
        assert merged.variance_e2[0, 0, pixel] == pytest.approx(
            weight**2 @ (floor / time[open_] ** 2), rel=1e-12
        )
        whole = merged.variance_e2[0, 0, pixel] + rate / merged.scale[0, 0, pixel]
        assert whole == pytest.approx(1 / (1 / noise).sum(), rel=1e-12)
    assert merged.electrons[0, 0, 3] == pytest.approx(
        2000 / 0.1, rel=1e-12
    )  # the shortest is the best lower bound
    assert merged.variance_e2[0, 0, 3] == pytest.approx(6 / 0.01, rel=1e-12)
    assert merged.saturated[0, 0].tolist() == [False, False, False, True]
    assert merged.usable.all()
    assert (merged.common_floor, merged.common_light, merged.gain) == (
        0.3,
        0.04,
        made.gain,
    )
    assert merged.corrections == (
        "as made",
        "3 exposures merged to 1 frames by inverse variance",
    )


def test_groups_keep_the_order_in_which_they_come():
    made = brackets()
    merged, first = clean.merge_brackets(
        made, np.array([0.02, 0.06, 0.2]), np.array([9, 4, 9])
    )
    assert first.tolist() == [0, 1]
    assert merged.electrons[1, 0, :2] == pytest.approx([330.0, 905.0], rel=1e-12)
    assert merged.variance_e2[1, 0, 0] == pytest.approx(7.0, rel=1e-12)
    assert merged.scale[1, 0, 0] == pytest.approx(1.2, rel=1e-12)
    alone, _ = clean.merge_brackets(made, np.array([0.02, 0.06, 0.2]), np.arange(3))
    assert alone.corrections == ("as made",)


def test_full_wells_are_seen_through_their_pixels_own_offsets():
    """Three wells that read 1080 counts above their dark level to half a count, where
    light scatters by 17.
    """
    counts = np.random.default_rng(8).uniform(0, 700, (4, NY, NX))
    gain = clean.Gain(3.7, 0.1, 3.1)
    counts[1, 3, 4:7] = 1080.3, 1079.9, 1080.6
    assert clean.full_well(counts, gain) == pytest.approx(1078.6)
    spread = counts.copy()
    spread[1, 3, 4:7] = 1080.3, 1062.0, 1049.6
    assert clean.full_well(spread, gain) == math.inf
    assert (
        clean.full_well(np.minimum(counts, 30.0), gain) == math.inf
    )  # dim: all light is as even as that


def test_a_full_well_is_masked_and_said():
    rng = np.random.default_rng(3)
    fixed = 97 + 2 * rng.standard_normal((NY, NX))
    light = rng.uniform(0, 500, (3, NY, NX))
    light[:, 4, 5:8] = 1080.0
    shots = capture(
        np.rint(light + fixed).astype(np.uint16), dark=np.rint(np.tile(fixed, (4, 1, 1))).astype(np.uint16),
        about={"gain_e": 3.7},
    )  # fmt: skip
    found = clean.clean(shots)
    assert found.saturated[:, 4, 5:8].all()
    assert found.saturated.sum() == 9
    assert any("saturated" in note for note in found.corrections)


def test_noise_of_frames_of_two_pixels_is_half_the_square_of_the_difference_of_their_steps():
    """Steps are 6 and -3 counts; their variance about 1.5 is 2 x 4.5² of one degree,
    halved for one frame.

    One pixel has no step but the common one: no noise, so no gain."""
    flat = np.array([[[500.0, 501.0]], [[506.0, 498.0]]])
    found = clean.photon_transfer(flat)
    assert found.gain_e == pytest.approx(
        (503 + 499.5) / 2 / (2 * 4.5**2 / 2), rel=1e-12
    )
    with pytest.raises(CaptureError, match="without noise or light"):
        clean.photon_transfer(flat[:, :, :1])


@pytest.mark.parametrize(
    ("step", "noisy"), [(-4.4, False), (-4.1, True), (4.4, False), (4.1, True)]
)
def test_a_step_of_dark_frames_of_few_bits_is_noise_up_to_six_halves_of_a_count(
    step, noisy
):
    """Frames that are alike have a robust sigma of 0, and half a count is taken: 3 =
    4.24 / √2, either way.
    """
    dark = np.full((2, NY, NX), 60.0)
    dark[1, 4, 5] += step
    found = clean.clean(capture(np.full((1, NY, NX), 300), dark=dark, flat=None))
    steps = np.zeros(NY * NX)
    steps[0] = step / math.sqrt(2)
    n = NY * NX
    steps -= steps.mean()
    floor = ((steps if noisy else steps[1:]) ** 2).mean() * n / (n - 1)
    assert found.gain.read_noise_e == pytest.approx(math.sqrt(floor), rel=1e-9)


def test_a_robust_sigma_is_about_the_median_and_knows_no_outliers():
    values = np.random.default_rng(2).normal(7.0, 2.3, 40_001)
    values[::50] = 900.0  # 2 % of them: 2.5 % wider
    assert clean._robust_sigma(values) == pytest.approx(
        2.3 * 1.0253, rel=0.02
    )  # its own scatter is 0.6 %
