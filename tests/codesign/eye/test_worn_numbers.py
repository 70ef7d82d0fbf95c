"""Every number of what frames wear, pixel by pixel: loops over float64 from the words
of the docstrings.
"""

import math

import numpy as np
import pytest
import torch

from codesign.eye import worn as wear
from codesign.eye.population import draw
from codesign.eye.renderer import Labels, Rendered
from metalens.image import Frames

N, FRAME = 40, 1  # pixels; the second of two frames wears, the first must stay as it is
PLACE = (23.5, 17.5)  # x, y of the pupil, not in the middle
ROUND = 2e-6  # float32 of amounts below 2, some ten operations
RNG = np.random.default_rng(11)
OPENING = np.clip(RNG.uniform(-0.4, 1.4, (N, N)), 0, 1).astype(
    np.float32
)  # share of the eye in each pixel
LIGHT = RNG.uniform(0.2, 0.8, (2, N, N)).astype(np.float32)
DRAWS = np.array(
    [0.68, 0.83, 0.27, 0.41, 0.58, 0.76, 0.36, 0.19, 0.68, 0.47, 0.23, 0.77]
)
LINE = (np.arange(N) + 0.5) / N - 0.5
X, Y = LINE[None, :], LINE[:, None]


def scene():
    """Two frames of random light; skin at 15 mm, the eye at 21 to 25 mm."""
    cover = torch.from_numpy(np.stack([1 - OPENING, OPENING]))[None].repeat(2, 1, 1, 1)
    light = torch.from_numpy(LIGHT)[None].repeat(2, 1, 1, 1)
    depth = torch.full((2, 2, N, N), 15e3)
    depth[:, 1] = torch.linspace(21e3, 25e3, N)
    pupil = torch.from_numpy(OPENING.copy())[None].repeat(2, 1, 1)
    two = torch.zeros(2, dtype=torch.float64)
    three, place = (
        torch.zeros(2, 3, dtype=torch.float64),
        torch.tensor([PLACE] * 2, dtype=torch.float64),
    )
    labels = Labels(
        three,
        three,
        three,
        three,
        three,
        three,
        place,
        place,
        two + 0.8,
        torch.zeros(2, 9, 2),
    )
    return Rendered(Frames(light, cover, depth), pupil, labels)


def put_on(draws=DRAWS, **size):
    """(light, coverage, depth, pupil) of the frame that wears, float64; the other frame
    is as it was.
    """
    made = scene()
    sizes = {name: np.zeros(2) for name in wear.CAUSES}
    for name, value in size.items():
        sizes[name][FRAME] = value
    out = wear.dressed(made, wear.Worn(sizes, np.stack([np.zeros(12), draws])))
    for name in Frames.__slots__:
        assert torch.equal(getattr(out.frames, name)[0], getattr(made.frames, name)[0])
    sheets = (
        getattr(out.frames, name)[FRAME].double().numpy() for name in Frames.__slots__
    )
    return *sheets, out.pupil[FRAME].double().numpy()


def test_amounts_of_what_may_be_worn():
    """Shares at variety 2 and ranges: what presets and docs were measured with."""
    table = {name: (c.share, c.low, c.high) for name, c in wear.CAUSES.items()}
    assert table == {
        "tilt": (0.7, -30.0, 50.0),
        "liner": (0.25, 0.3, 0.9),
        "lid_shadow": (0.25, 0.15, 0.6),
        "rim": (0.2, 0.03, 0.10),
        "reflection": (0.25, 0.15, 0.8),
        "glints": (0.4, 0.4, 1.2),
        "gradient": (0.6, 0.1, 0.7),
        "shade": (0.25, 0.2, 0.7),
        "movement": (0.3, 0.008, 0.04),
        "vignette": (0.4, 0.1, 0.8),
        "saturation": (0.25, 0.01, 0.15),
        "tone": (0.5, -0.6, 0.6),
        "side": (0.6, -40.0, 40.0),
        "roll": (0.5, -25.0, 25.0),
        "wide": (0.7, 1.1, 2.2),
        "iris": (0.35, 0.08, 0.5),
        "overhang": (0.5, 0.5, 1.0),
        "socket": (0.3, 0.2, 0.75),
        "patch": (0.4, 0.4, 0.95),
        "retina": (0.2, 0.02, 0.25),
        "veil": (0.4, 0.02, 0.2),
    }


def test_sizes_are_even_over_their_range_and_twice_the_variety_is_twice_the_share():
    count = 4000
    for variety, times in ((1.5, 0.5), (2.0, 1.0), (9.0, 8.0)):
        got = wear.drawn(count, variety, np.random.default_rng(3))
        assert got.draws.shape == (count, 12)
        for name, cause in wear.CAUSES.items():
            size = got.size[name][got.size[name] != 0]
            share = min(times * cause.share, 1.0)
            assert len(size) / count == pytest.approx(
                share, abs=4 * math.sqrt(share * (1 - share) / count) + 1e-9
            )
            middle, sigma = (
                (cause.low + cause.high) / 2,
                (cause.high - cause.low) / math.sqrt(12),
            )
            assert size.mean() == pytest.approx(
                middle, abs=4.5 * sigma / math.sqrt(len(size))
            )


def largest(cover, row, up, down):
    """(x,) largest coverage of the rows from ``down`` above to ``up`` below a row."""
    return cover[max(row - down, 0) : row + up + 1].max(0)


@pytest.mark.parametrize(("side", "below"), [(0.49, 2), (0.51, 1)])
def test_a_liner_takes_its_opacity_of_the_skin_within_its_width(side, below):
    draws = DRAWS.copy()
    draws[0], draws[1] = 0.98, side  # 0.015 + 0.025 x 0.98 of 40 pixels: 1.58, two rows
    light = put_on(draws, liner=0.7)[0]
    for row in range(N):
        want = LIGHT[0, row] * (1 - 0.7 * largest(OPENING, row, 2, below))
        assert light[0, row] == pytest.approx(want, abs=ROUND)
    assert np.array_equal(light[1], LIGHT[1].astype(float))


def test_a_darkened_lid_is_a_mean_over_a_square_of_half_its_height():
    draws = DRAWS.copy()
    draws[2] = (
        # 0.06 + 0.06 x 0.66 of 40 pixels: 3.98, four rows; the mean over 2 reach + 1 =
        # 3 pixels
        0.66
    )
    light = put_on(draws, lid_shadow=0.55)[0]
    near = np.stack([largest(OPENING, row, 4, 0) for row in range(N)])
    wide = np.pad(near, 1, mode="edge")
    soft = sum(wide[i : i + N, j : j + N] for i in range(3) for j in range(3)) / 9
    assert light[0] == pytest.approx(LIGHT[0] * (1 - 0.55 * soft), abs=ROUND)


def test_glints_are_lorentzian_spots_about_the_pupil():
    light = put_on(glints=0.9)[0]
    px, py = (PLACE[0] + 0.5) / N - 0.5, (PLACE[1] + 0.5) / N - 0.5
    added = np.zeros((N, N))
    for k in range(4):  # 1 + int(4 x 0.76)
        turn = 6.283 * 0.41 + 1.7 * k
        apart, size = 0.02 + 0.07 * 0.58, 0.005 + 0.035 * ((0.36 + 0.37 * k) % 1) ** 2
        away = (X - px - apart * math.cos(turn)) ** 2 + (
            Y - py - apart * math.sin(turn)
        ) ** 2
        added += 0.9 * OPENING / (1 + (away / size**2) ** 2)
    assert light[1] == pytest.approx(
        LIGHT[1] + added, abs=5 * ROUND
    )  # (away / size²)² amplifies float32 near a spot
    assert np.array_equal(light[0], LIGHT[0].astype(float))


def test_a_gradient_is_a_plane_and_stays_above_a_tenth():
    turn = 6.283 * 0.19
    plane = 1 + 2 * 1.3 * (X * math.cos(turn) + Y * math.sin(turn))
    assert plane.min() < 0
    assert put_on(gradient=1.3)[0] == pytest.approx(
        LIGHT * np.maximum(plane, 0.1), abs=ROUND
    )


def test_a_shade_is_a_soft_edge():
    turn, edge, middle = 6.283 * 0.68, 0.02 + 0.1 * 0.47, (0.23 - 0.5) * 0.6
    away = X * math.cos(turn) + Y * math.sin(turn) - middle
    want = LIGHT * (1 - 0.6 / (1 + np.exp(-away / edge)))
    assert put_on(shade=0.6)[0] == pytest.approx(want, abs=2 * ROUND)


def test_mirrored_windows_are_rounded_boxes_that_lean():
    """Their number, places and halves from the draws; both sheets have them as far as
    they are seen.
    """
    light, cover, depth, _ = put_on(reflection=0.45)
    added = np.zeros((N, N))
    lean = 0.6 * (0.76 - 0.5)
    for k in range(3):  # 1 + int(3 x 0.68)
        at_x, at_y = (0.83 + 0.61 * k) % 1 - 0.5, (0.27 + 0.43 * k) % 1 - 0.5
        half_x, half_y = (
            0.02 + 0.1 * ((0.41 + 0.29 * k) % 1),
            0.02 + 0.08 * ((0.58 + 0.53 * k) % 1),
        )
        u, v = (X - at_x) + lean * (Y - at_y), (Y - at_y) - lean * (X - at_x)
        added += 0.45 / (1 + (u / half_x) ** 6 + (v / half_y) ** 6)
    was = scene().frames
    want = LIGHT + added * was.coverage[FRAME].double().numpy()
    assert light == pytest.approx(want, abs=2e-5)  # sixth powers of float32 places
    assert np.array_equal(cover, was.coverage[FRAME].double().numpy())
    assert np.array_equal(depth, was.depth_um[FRAME].double().numpy())


def test_a_rim_is_an_arc_that_hides_and_shines():
    width = 0.09
    light, cover, depth, pupil = put_on(rim=width)
    radius, turn, gap = 0.45 + 0.5 * 0.36, 6.283 * 0.19, 0.30 + 0.17 * 0.68
    squeeze = 0.8 + 0.4 * 0.47
    x, y = X + (radius - gap) * math.cos(turn), Y + (radius - gap) * math.sin(turn)
    away = np.hypot(x, squeeze * y) - radius
    band = 1 / (1 + np.exp(-(width / 2 - np.abs(away - width / 2)) * N * 2))
    shine = 0.02 + 0.5 * 0.23**2 * (1 + 0.6 * np.cos(away / width * 6.0))
    was = scene()
    open_ = was.frames.coverage[FRAME].double().numpy()
    near = 2e-5  # slopes of the band: 2 N = 80 a frame width, times float32 places
    assert light[0] == pytest.approx(LIGHT[0] * (1 - band) + band * shine, abs=near)
    assert light[1] == pytest.approx(LIGHT[1] * (1 - band), abs=near)
    assert cover[0] == pytest.approx(open_[0] * (1 - band) + band, abs=near)
    assert cover[1] == pytest.approx(open_[1] * (1 - band), abs=near)
    assert pupil == pytest.approx(
        was.pupil[FRAME].double().numpy() * (1 - band), abs=near
    )
    middle = float(
        np.sort(was.frames.depth_um[FRAME, 1].numpy().ravel())[N * N // 2 - 1]
    )  # torch: the lower of two
    assert depth[0][np.abs(band - 0.5) > near] == pytest.approx(
        np.where(band > 0.5, 0.7 * middle, 15e3)[np.abs(band - 0.5) > near], rel=1e-6
    )
    assert np.array_equal(depth[1], was.frames.depth_um[FRAME, 1].double().numpy())


def test_a_movement_averages_along_its_line_and_depths_by_what_is_covered():
    """Correlation with the kernel of the line: 0.0775 of 40 pixels at 3.1416 x 0.77
    rad.
    """
    kernel = wear.line_kernel(0.0775 * N, 3.1416 * 0.77).double().numpy()
    assert kernel.shape == (5, 5)
    light, cover, depth, pupil = put_on(movement=0.0775)
    was = scene()

    def moved(picture):
        wide = np.pad(picture, 2, mode="edge")
        return sum(
            kernel[i, j] * wide[i : i + N, j : j + N]
            for i in range(5)
            for j in range(5)
        )

    before = was.frames.coverage[FRAME].double().numpy()
    for sheet in (0, 1):
        kept = np.maximum(before[sheet], 1e-6)
        assert light[sheet] == pytest.approx(
            moved(LIGHT[sheet].astype(float)), abs=ROUND
        )
        assert cover[sheet] == pytest.approx(moved(before[sheet]), abs=ROUND)
        far = was.frames.depth_um[FRAME, sheet].double().numpy()
        assert depth[sheet] == pytest.approx(moved(kept * far) / moved(kept), rel=2e-6)
    assert pupil == pytest.approx(moved(was.pupil[FRAME].double().numpy()), abs=ROUND)


def test_a_line_of_five_pixels_weighs_its_pixels_by_what_of_it_lies_in_each():
    """Taps of a straight horizontal line of 3 pixels: triangles of half a pixel about
    each end, whole between.

    A point at u gives 1 - |u - k| to the pixels k beside it; over [-1.5, 1.5] that is 1
    / 3 each to -1, 0 and 1 less
    1 / 8 / 3 at both ends, which the outermost pixels take.
    """
    row = wear.line_kernel(3.0, 0.0).double().numpy()
    assert row.shape == (5, 5)
    assert row[2] == pytest.approx(
        np.array([1 / 8, 7 / 8, 1, 7 / 8, 1 / 8]) / 3, abs=2e-3
    )  # 32 places: 1 / 32² of it
    assert np.abs(np.delete(row, 2, 0)).max() == 0
    column = wear.line_kernel(3.0, math.pi / 2).double().numpy()
    assert column == pytest.approx(row.T, abs=1e-6)
    assert wear.line_kernel(99.0, 0.3).shape == (15, 15)  # TAPS at most


def test_labels_follow_the_mask():
    was, after = torch.zeros(2, 5, 5), torch.zeros(2, 5, 5)
    was[0, 1:4, 1:4], after[0, 1, 2], after[0, 3, 3] = (
        0.1,
        0.3,
        0.15,
    )  # less than a pixel in all
    was[1, 2, 2] = 1.0
    place = torch.tensor([[9.0, 8.0], [7.0, 6.0]], dtype=torch.float64)
    two, three = (
        torch.tensor([0.8, 0.6], dtype=torch.float64),
        torch.zeros(2, 3, dtype=torch.float64),
    )
    labels = Labels(
        three,
        three,
        three,
        three,
        three,
        three,
        place,
        place,
        two,
        torch.zeros(2, 9, 2),
    )
    got = wear._labels(labels, was, after)
    assert got.visible.tolist() == pytest.approx([0.8 * 0.45 / 0.9, 0.0])
    assert got.centroid_px[0].tolist() == pytest.approx([3.5 / 1.5, 2.5 / 1.5])
    assert got.centroid_px[1].tolist() == [
        7.0,
        6.0,
    ]  # nothing is left: where the pupil is
    grown = wear._labels(labels, after, was)
    assert grown.visible.tolist() == [
        1.0,
        0.6,
    ]  # not above 1; of nothing before, as it was


def test_corners_of_another_camera_are_darker_by_the_square_of_their_distance():
    """Corners lose the whole share but for half a pixel, the middle nothing."""
    light, cover, depth, pupil = put_on(vignette=0.6)
    plain, *rest = put_on()
    line = (np.arange(plain.shape[-1]) + 0.5) / plain.shape[-1] - 0.5
    assert light == pytest.approx(
        plain * (1 - 0.6 * 2 * (line[None] ** 2 + line[:, None] ** 2)),
        rel=1e-5,
        abs=1e-7,
    )
    for now, was in zip((cover, depth, pupil), rest, strict=True):
        assert np.array_equal(now, was)


def test_the_brightest_pixels_are_at_one_white():
    plain, seen = put_on()[0], put_on(saturation=0.15)[0]
    level = plain.sum(0)
    white = np.quantile(level, 0.85)
    assert seen.sum(0) == pytest.approx(np.minimum(level, white), rel=1e-4)
    bright = level > white
    assert bright.any()
    assert seen[:, bright] / seen.sum(0)[bright] == pytest.approx(
        plain[:, bright] / level[bright], rel=1e-4
    )


@pytest.mark.parametrize("log_gamma", [-0.5, 0.4])
def test_a_tone_curve_is_a_power_between_black_and_white(log_gamma):
    plain, seen = put_on()[0], put_on(tone=log_gamma)[0]
    level = plain.sum(0)
    white, gamma = np.quantile(level, 0.99), math.exp(log_gamma)
    inside = level > 1e-3 * white
    assert inside.any()
    assert seen.sum(0)[inside] == pytest.approx(
        white * (level[inside] / white) ** gamma, rel=1e-4
    )


def test_light_of_the_retina_fills_the_pupil_and_stray_light_everything():
    before, was = put_on(), scene().frames
    lit, seen = put_on(retina=0.21), put_on(veil=0.13)
    assert lit[0][1] == pytest.approx(
        LIGHT[1] + 0.21 * OPENING, abs=ROUND
    )  # the scene's pupil is its opening
    assert seen[0] == pytest.approx(
        LIGHT + 0.13 * was.coverage[FRAME].double().numpy(), abs=ROUND
    )
    assert np.array_equal(lit[0][0], LIGHT[0].astype(float))
    for now in (lit, seen):
        assert all(np.array_equal(now[k], before[k]) for k in (1, 2, 3))


def test_dark_places_of_the_skin_are_ellipses_of_which_every_other_is_striped():
    light, *rest = put_on(patch=0.8)
    dark = np.zeros((N, N))
    for k in range(3):  # 1 + int(3 x 0.76)
        at_x, at_y = (
            1.1 * ((0.36 + 0.38 * k) % 1 - 0.5),
            1.1 * ((0.19 + 0.71 * k) % 1 - 0.5),
        )
        half_x, half_y = (
            0.05 + 0.2 * ((0.68 + 0.57 * k) % 1),
            0.05 + 0.2 * ((0.47 + 0.23 * k) % 1),
        )
        turn = 3.1416 * ((0.23 + 0.47 * k) % 1)
        u = (X - at_x) * math.cos(turn) + (Y - at_y) * math.sin(turn)
        v = (Y - at_y) * math.cos(turn) - (X - at_x) * math.sin(turn)
        hair = 0.75 + 0.25 * np.sin(80 * v + 12 * u) if k != 1 else 1.0
        dark = np.maximum(
            dark, hair / (1 + ((u / half_x) ** 2 + (v / half_y) ** 2) ** 2)
        )
    assert light[0] == pytest.approx(
        LIGHT[0] * (1 - 0.8 * dark), abs=1e-5
    )  # 80 v of float32 places: 80 x 6e-8
    assert np.array_equal(light[1], LIGHT[1].astype(float))
    assert all(
        np.array_equal(now, was) for now, was in zip(rest, put_on()[1:], strict=True)
    )


def test_lashes_darken_both_sheets_by_one_factor_and_leave_the_outline():
    light, *rest = put_on(overhang=0.7)
    factor = light / LIGHT
    assert factor[0] == pytest.approx(factor[1], rel=1e-5)
    assert factor.min() == pytest.approx(
        0.3, abs=0.03
    )  # where lashes of full darkness (110 to 255 of 255) lie
    assert factor.max() == 1.0
    assert all(
        np.array_equal(now, was) for now, was in zip(rest, put_on()[1:], strict=True)
    )


def test_a_deep_socket_darkens_the_eye_and_a_dark_iris_is_a_share_of_its_albedo():
    light, *rest = put_on(socket=0.35)
    assert light == pytest.approx(
        LIGHT * np.array([1.0, 0.65])[:, None, None], abs=ROUND
    )
    assert all(
        np.array_equal(now, was) for now, was in zip(rest, put_on()[1:], strict=True)
    )
    states = draw(3, 4)
    sizes = {name: np.zeros(3) for name in wear.CAUSES} | {
        "iris": np.array([0.0, 0.23, 0.41])
    }
    found = wear.pigmented(states, wear.Worn(sizes, np.zeros((3, 12))))
    want = states.trait("iris") * torch.tensor([1.0, 0.23, 0.41], dtype=torch.float64)
    assert torch.equal(found.trait("iris"), want)
    assert torch.equal(found.trait("pupil"), states.trait("pupil"))


@pytest.mark.parametrize(("length", "angle"), [(4.6, 0.37), (3.3, 2.2), (0.7, -0.9)])
def test_a_slanted_line_gives_each_pixel_the_tent_about_it(length, angle):
    """1 - |u| along x times the same along y, of 32 places along the line through the
    middle.
    """
    kernel = wear.line_kernel(length, angle).double().numpy()
    reach = math.ceil(length / 2)
    assert kernel.shape == (2 * reach + 1, 2 * reach + 1)
    pixel = np.arange(-reach, reach + 1)
    along = ((np.arange(32) + 0.5) / 32 - 0.5) * length
    x, y = (
        np.maximum(1 - np.abs(along[:, None] * f(angle) - pixel), 0)
        for f in (math.cos, math.sin)
    )
    assert kernel == pytest.approx(np.einsum("kj,ki->ij", x, y) / 32, abs=1e-7)


def test_a_line_without_length_is_one_pixel():
    assert wear.line_kernel(0.0, 1.0).tolist() == [[1.0]]


def test_two_windows_are_mirrored_where_a_draw_says_two():
    """What three windows have more than two is the third."""
    draws = DRAWS.copy()
    draws[0] = 0.5  # 1 + int(3 x 0.5)
    three, two = put_on(reflection=0.45)[0], put_on(draws, reflection=0.45)[0]
    k = 2
    at_x, at_y = (0.83 + 0.61 * k) % 1 - 0.5, (0.27 + 0.43 * k) % 1 - 0.5
    half_x, half_y = (
        0.02 + 0.1 * ((0.41 + 0.29 * k) % 1),
        0.02 + 0.08 * ((0.58 + 0.53 * k) % 1),
    )
    lean = 0.6 * (0.76 - 0.5)
    u, v = (X - at_x) + lean * (Y - at_y), (Y - at_y) - lean * (X - at_x)
    third = 0.45 / (1 + (u / half_x) ** 6 + (v / half_y) ** 6)
    assert three - two == pytest.approx(
        third * scene().frames.coverage[FRAME].double().numpy(), abs=2e-5
    )


def test_a_soft_picture_is_the_mean_over_a_square_of_its_width():
    picture = torch.from_numpy(RNG.uniform(0, 1, (9, 12)))
    got = wear._soft(picture, 6.0).numpy()  # three to each side
    wide = np.pad(picture.numpy(), 3, mode="edge")
    assert got == pytest.approx(
        sum(wide[i : i + 9, j : j + 12] for i in range(7) for j in range(7)) / 49,
        rel=1e-9,
    )


def test_a_rim_before_closed_lids_lies_before_the_skin():
    """No depth of an eye: 0.7 of that of the skin, 15 mm."""
    made = scene()
    made.frames.depth_um[:, 1] = 0.0
    sizes = {name: np.zeros(2) for name in wear.CAUSES} | {"rim": np.array([0.0, 0.09])}
    depth = wear.dressed(
        made, wear.Worn(sizes, np.stack([np.zeros(12), DRAWS]))
    ).frames.depth_um[FRAME, 0]
    assert sorted(set(depth.flatten().tolist())) == pytest.approx([0.7 * 15e3, 15e3])
