"""Micrographs on the mask, edges on a shade, spots above their rim and the sharpest
depth, each by hand.
"""

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import special

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures.capture import Capture
from characterize.measure import frames, metrics, overlay, sem
from characterize.measure.lattice import ImageLattice
from metalens.core.errors import CaptureError
from metalens.lens.record import DiameterMap

RNG = np.random.default_rng(8)


def found(diameter, site):
    zero, no = np.zeros(len(site)), np.zeros(len(site), bool)
    lattice = ImageLattice(np.zeros(2), np.r_[0, 9.0], np.r_[9.0, 0])
    return sem.MeasuredDiameters(zero, zero, diameter, zero, no, no, site, lattice, no)


def test_a_micrograph_lies_where_its_pillars_follow_the_design():
    """5 x 7 sites counted from (-1, 4) lie on the mask from (6, 2): site (0, 0) of the
    picture is (7, -2) there.
    """
    drawn = RNG.uniform(0.1, 0.3, (15, 13))
    drawn[8, 5] = 0.0  # where the picture shows one all the same
    site = np.stack(
        np.meshgrid(np.arange(-1, 4), np.arange(4, 11), indexing="ij"), -1
    ).reshape(-1, 2)
    there = drawn[site[:, 0] + 7, site[:, 1] - 2] * 1e3
    made = there * 1.04 - 9.0 + RNG.normal(0, 1.3, len(site))
    made[9], made[20], made[17] = (
        np.nan,
        made[20] + 60.0,
        190.0,
    )  # unmeasured, fallen, without a design
    assert there[17] == 0
    site, made, there = (np.delete(a, 17, 0) for a in (site, made, there))
    laid = overlay.overlay_design(found(made, site), DiameterMap(drawn, 0.4))
    assert (laid.row, laid.column, laid.clearly) == (7, -2, True)
    assert laid.designed_nm == pytest.approx(there)
    assert laid.error_nm == pytest.approx(made - there, nan_ok=True)
    assert np.flatnonzero(laid.outlier).tolist() == [19]
    assert np.array_equal(
        overlay.register_to_mask(found(made, site), laid).site, site + np.array([7, -2])
    )


@pytest.mark.parametrize(("off", "outlying"), [(3.9, False), (4.1, True)])
@pytest.mark.parametrize("size", [0.02, 3.0])
def test_an_outlier_is_four_robust_sigma_from_the_median_error(off, outlying, size):
    """Errors of 20 -+ size: 1.4826 size of sigma, half a nanometre at least."""
    drawn = RNG.uniform(0.1, 0.3, (6, 7))
    site = np.stack(np.meshgrid(np.arange(6), np.arange(7), indexing="ij"), -1).reshape(
        -1, 2
    )
    sign = np.where(RNG.permutation(42) % 2, 1, -1)
    error = 20 + size * sign
    error[11] = 20 + sign[11] * off * max(
        1.4826 * size, 0.5
    )  # on its own side: the median stays 20
    laid = overlay.overlay_design(
        found(drawn.ravel() * 1e3 + error, site), DiameterMap(drawn, 0.4)
    )
    assert np.flatnonzero(laid.outlier).tolist() == ([11] if outlying else [])


@pytest.mark.parametrize("height", [3, 80, 83])
def test_a_scale_bar_is_the_longest_run_in_the_lowest_quarter(height):
    quarter = max(height // 4, 1)
    picture = np.full((height, 90), 70, np.uint8)
    picture[: height - quarter, 5:85] = 255  # bright, and no bar
    picture[-1, 3:20], picture[-1, 30:55], picture[-1, 60:82] = 255, 255, 255
    if quarter > 1:
        picture[-quarter, 40:66] = 255
    assert sem.scale_from_bar(picture, 520.0) == pytest.approx(
        520 / (26 if quarter > 1 else 25)
    )
    picture[-1], picture[-quarter] = 70, 70
    picture[-1, 70:] = 255  # 20 pixels up to the border
    assert sem.scale_from_bar(picture, 520.0) == pytest.approx(26.0)
    picture[-1, 70] = 70
    with pytest.raises(CaptureError, match="19 pixels"):
        sem.scale_from_bar(picture, 520.0)


@pytest.mark.parametrize("ramp", [0.0, 3.0])
def test_the_line_of_an_edge_does_not_follow_a_shade(ramp):
    """An edge of 30 counts, 10 a pixel at its steepest, off the middle of a frame that
    brightens by 3 a pixel.
    """
    rows, x = np.arange(40), np.arange(60)
    line = 0.11 * rows + 17.3
    pixels = 30 * special.ndtr((x - line[:, None]) / 1.2) + ramp * x
    slope, offset = metrics._edge_line(pixels, rows)
    assert slope == pytest.approx(0.11, abs=2e-3)
    assert offset == pytest.approx(17.3, abs=0.05)


def test_an_edge_is_read_through_a_hann_window_about_its_steepest_place():
    """A blur of 3 pixels on 12 to both sides: the window takes its part, as an
    integral.
    """
    sigma, lean, reach = 3.0, math.radians(6.0), 12
    y, x = np.mgrid[:16, : 2 * reach + 3] - np.array([7.5, reach + 1.0])[:, None, None]
    edge = special.ndtr((x + y * math.tan(lean)) * math.cos(lean) / sigma)
    made = metrics.mtf_of_edge(edge, pixel_um=1.0)
    fine = np.linspace(-reach, reach, 4001)
    seen = (
        np.exp(-0.5 * (fine / sigma) ** 2) * np.cos(math.pi * fine / (2 * reach)) ** 2
    )
    for f in (0.03, 0.06, 0.09):
        want = (seen * np.cos(2 * math.pi * f * fine)).sum() / seen.sum()
        got = np.interp(f, made.frequency_per_um, made.modulation)
        assert got == pytest.approx(
            want, abs=0.02
        )  # reach is a whole number of pixels; bins
        assert (
            abs(got - math.exp(-2 * (math.pi * f * sigma) ** 2)) > 0.02
        )  # and not that of the blur alone


def capture(n=1, **more):
    unknown = np.full(n, np.nan)
    return Capture(
        np.zeros((n, 5, 6)), unknown, np.zeros((n, 2)), unknown, ("a",) * n, 8, **more
    )


def test_angles_of_one_place_of_the_source_are_alike_to_a_millionth_of_a_degree():
    at = SimpleNamespace(angle_deg=3.1234564, angle_y_deg=-0.2000006)
    assert frames.FrameMetrics.field.fget(at) == (3.123456, -0.200001)


def test_light_is_counted_above_the_median_of_the_rim():
    frame = np.full((6, 8), 50.0)
    frame[0, ::2] = frame[-1, 1::2] = 46.0  # 8 of 24 rim pixels lower
    frame[1:-1, 0] = 54.0
    frame[2, 3], frame[3, 4] = 90.0, 80.0
    usable = np.ones(frame.shape, bool)
    usable[2, 3] = False
    light = frames._above(frame, usable, "x.tif")
    assert light[3, 4] == 30
    assert light[0, 0] == -4


def test_masked_pixels_are_filled_from_those_around_them():
    """Exact for cubics along rows or columns; where a second neighbour is masked too,
    by those that touch.
    """
    y, x = np.mgrid[:9, :11] - 4.0
    light = 70 + 3 * x**3 - 2 * y**3 + x * y + 5 * x
    usable = np.ones(light.shape, bool)
    usable[4, 6] = usable[0, 3] = False
    broken = np.where(usable, light, 4000.0)
    assert frames._filled(broken, usable) == pytest.approx(light, abs=1e-9)
    usable[2, 6] = usable[4, 7] = (
        False  # neither the column nor the row of (4, 6) is whole
    )
    ring = [light[i, j] for i in (3, 4, 5) for j in (5, 6, 7) if usable[i, j]]
    assert len(ring) == 7
    assert frames._filled(np.where(usable, light, 4000.0), usable)[
        4, 6
    ] == pytest.approx(np.mean(ring))


@pytest.mark.parametrize("beside", [0, 1])
def test_a_hot_pixel_in_its_core_leaves_a_spot_its_width(beside):
    """A Gaussian of 1.6 x 1.9 pixels; the cubic misses 6 % of a pixel at its top, which
    holds 5 % of the light.
    """
    y, x = np.mgrid[:41, :47] - np.array([20.2, 23.4])[:, None, None]
    spot = 30000 * np.exp(-(x**2) / (2 * 1.6**2) - y**2 / (2 * 1.9**2))
    counts = np.rint(np.stack([0.7 * spot, spot, 0.4 * spot]) + 300)
    dark = np.full((3, 41, 47), 300.0)
    plain, broken = (
        frames.measure_frames(
            Capture(
                counts + hot, np.array([1.0, 2.0, 3.0]), np.zeros((3, 2)), np.full(3, np.nan), ("a", "b", "c"), 16,
                pixel_um=1.3, dark=dark + hot, about={"gain_e": 1.4},
            )
        )
        for hot in (0.0, np.where((np.arange(41)[:, None] == 20) & (np.arange(47) == 23 + beside), 9000.0, 0.0))
    )  # fmt: skip
    for before, after in zip(plain.frames, broken.frames, strict=True):
        assert after.spot.fwhm_um == pytest.approx(before.spot.fwhm_um, rel=0.05)
        assert after.spot.ee80_um == pytest.approx(before.spot.ee80_um, rel=0.01)
        assert after.spot.d4sigma_um == pytest.approx(before.spot.d4sigma_um, rel=0.01)
        assert after.mtf50_x_per_um == pytest.approx(before.mtf50_x_per_um, rel=0.02)
    assert any("within 3 spots (1 at most)" in note for note in broken.notes)
    assert not any("spots" in note for note in plain.notes)


@pytest.mark.parametrize(("top", "seen"), [(5.2, True), (4.8, False)])
def test_a_spot_stands_five_robust_sigma_above_the_rim(top, seen):
    frame = np.where(
        np.add.outer(np.arange(6), np.arange(8)) % 2, 53.0, 47.0
    )  # sigma 1.4826 x 3 about 50
    frame[1:-1, 1:-1] = 40.0
    frame[2, 5] = 50 + top * 1.4826 * 3
    if seen:
        assert frames._above(
            frame, np.ones(frame.shape, bool), "x.tif"
        ).max() == pytest.approx(top * 1.4826 * 3)
    else:
        with pytest.raises(CaptureError, match="five times"):
            frames._above(frame, np.ones(frame.shape, bool), "x.tif")


def row(depth, angle, ee80, x=0.0, *, angle_y=0.0, y=0.3):
    spot = metrics.SpotMetrics(1.0, ee80, (1.0, 1.0), (x, y))
    return frames.FrameMetrics(
        "f", depth, angle, angle_y, spot, 1.0, 1.0, 1.0, 3.0, 1.0, 9.0
    )


def test_the_sharpest_depth_is_the_top_of_a_parabola_in_its_inverse():
    best, curve = 1 / 23e3, 4e9
    depths = (18e3, 21e3, 24e3, 31e3)
    sharp = [2.5 - curve * (1 / z - best) ** 2 for z in depths]
    rows = [row(z, 0.0, s**-0.5) for z, s in zip(depths, sharp, strict=True)]
    rows += [
        row(z, 5.0, s) for z, s in ((18e3, 2.0), (21e3, 3.0), (24e3, 5.0))
    ]  # sharpest at the near end
    rows += [row(z, 9.0, 1.0) for z in (18e3, 21e3)]  # too few
    rows += [
        row(z, 0.0, s, angle_y=-7.0) for z, s in ((18e3, 5.0), (21e3, 3.0), (24e3, 2.0))
    ]  # another field
    made = frames._best(rows[::-1])
    assert set(made) == {(0.0, 0.0), (5.0, 0.0), (0.0, -7.0)}
    assert made[0.0, 0.0] == pytest.approx(23e3, rel=1e-6)
    assert made[5.0, 0.0] == pytest.approx(18e3)
    assert made[0.0, -7.0] == pytest.approx(24e3)


@pytest.mark.parametrize("best", [19e3, 23.5e3, 29e3])
def test_the_parabola_goes_through_the_sharpest_three_of_many(best):
    """Sharpness falls as a parabola near its top and no further: only neighbours of the
    top tell it.
    """
    depths = np.array([17e3, 18.5e3, 20e3, 22e3, 24.5e3, 27e3, 31e3])
    sharp = 3 - 4e9 * (1 / depths - 1 / best) ** 2
    near = np.argsort(np.abs(1 / depths - 1 / depths[sharp.argmax()]))[:1][0]
    for i in range(7):
        if abs(i - np.clip(near, 1, 5)) > 1:
            sharp[i] = 0.7 + 0.01 * i
    rows = [row(z, 2.0, s**-0.5) for z, s in zip(depths, sharp, strict=True)]
    assert frames._best(rows)[2.0, 0.0] == pytest.approx(best, rel=1e-6)
    unknown = [*rows[:-1], row(math.nan, 2.0, 1.0)]
    assert frames._best(unknown) == {}


def test_two_places_that_fit_alike_are_not_clear():
    """The mask repeats itself after five rows but for a little; once it repeats less,
    the place is clear.
    """
    site = np.stack(np.meshgrid(np.arange(4), np.arange(6), indexing="ij"), -1).reshape(
        -1, 2
    )
    block = RNG.uniform(0.1, 0.3, (5, 6))
    for change, clear in ((0.0012, False), (0.03, True)):
        drawn = np.concatenate([block, block + change * RNG.normal(size=block.shape)])
        made = drawn[site[:, 0], site[:, 1]] * 1e3 + RNG.normal(0, 4.0, len(site))
        laid = overlay.overlay_design(found(made, site), DiameterMap(drawn, 0.4))
        assert laid.clearly == clear
        assert laid.column == 0
        assert not clear or laid.row == 0


def test_knots_hold_six_pillars_at_least():
    drawn, none = RNG.uniform(100, 300, 17), np.zeros(17, bool)
    table = overlay.bias_table(
        overlay.MaskOverlay(
            drawn, drawn * 0.01, 0, 0, site=np.zeros((0, 2)), clearly=True, outlier=none
        )
    )
    assert [row[3] for row in table] == [
        9,
        8,
    ]  # 17 // 6 = 2, though seven are asked for
    many = np.sort(RNG.uniform(100, 300, 84))
    table = overlay.bias_table(
        overlay.MaskOverlay(
            many,
            many,
            0,
            0,
            site=np.zeros((0, 2)),
            clearly=True,
            outlier=np.zeros(84, bool),
        )
    )
    assert [row[3] for row in table] == [12] * 7


def test_distortion_is_the_place_over_that_of_a_straight_ray_relative_to_the_smallest_angle():
    design = b.row(sensor_distance_um=1970.0, layers=b.GLASS)
    place = {
        a: 1900 * math.tan(math.radians(a)) * (0.98 + 1e-3 * a**2)
        for a in (-7.0, 4.0, 11.0)
    }
    rows = [row(20e3, 0.0, 1.0, 3.1 - 0.4), row(30e3, 0.0, 1.0, 3.1 + 0.4)]
    rows += [row(20e3, a, 1.0, x + 3.1) for a, x in place.items()]
    found = frames._distortion(rows, capture(about={"window": "fixed"}), design)
    want = {
        (a, 0.0): (0.98 + 1e-3 * a**2) / (0.98 + 1e-3 * 16) - 1 for a in sorted(place)
    }
    assert list(found) == sorted(want)
    assert found == pytest.approx(want, rel=1e-9)
    assert frames._distortion(rows, capture(), design) == {}
    assert (
        frames._distortion(rows[:2], capture(about={"window": "fixed"}), design) == {}
    )


def test_distortion_is_measured_along_the_field_whichever_way_it_lies():
    """Spots of oblique fields at (0.97 + k |angle|) of the straight ray's place from
    that of the axis, (1.7, -2.9).
    """
    design = b.row(sensor_distance_um=1970.0, layers=b.GLASS)
    share = {(0.0, -5.0): 0.97, (6.0, 8.0): 0.99, (0.0, 11.0): 1.01}
    rows = [row(20e3, 0.0, 1.0, 1.7, y=-2.9)]
    for (ax, ay), k in share.items():
        x, y = (1900 * k * math.tan(math.radians(a)) for a in (ax, ay))
        rows.append(row(20e3, ax, 1.0, x + 1.7, angle_y=ay, y=y - 2.9))
    found = frames._distortion(rows, capture(about={"window": "fixed"}), design)
    assert found == pytest.approx(
        {field: k / 0.97 - 1 for field, k in share.items()}, abs=1e-9
    )


def test_the_airy_pattern_falls_to_nothing_at_its_first_ring():
    """0.61 λ / sin of the rim, on pixels so small that they do not blur; wide pixels
    take its mean.
    """
    design = b.row(400.0, wavelength_um=0.9, sensor_distance_um=1570.0, layers=b.GLASS)
    sine = 400 / math.hypot(400, 1500)
    ring = 3.8317059702 / (2 * math.pi * sine / 0.9)
    pattern = frames.airy_pattern(design, capture(pixel_um=ring / 20), (41, 61))
    assert pattern[20, 30] == pytest.approx(1, abs=2e-3)
    assert pattern[20, 50] < 2e-3
    assert pattern[40, 30] < 2e-3
    u = 3.8317059702 / 2
    assert pattern[30, 30] == pytest.approx((2 * special.j1(u) / u) ** 2, abs=2e-3)
    other = frames.airy_pattern(
        design, capture(pixel_um=ring / 20, wavelength_um=0.45), (41, 61)
    )
    assert other[30, 30] < 2e-3  # half the wavelength, half the ring
    wide = frames.airy_pattern(design, capture(pixel_um=ring / 4), (7, 9))
    assert wide[3, 4] == pytest.approx(pattern[18:23, 28:33].mean(), abs=2e-3)


def test_frames_are_measured_along_their_own_axes():
    """Gaussians of 2.1 and 3.4 pixels along x and y on a background, at two depths and
    angles; a reference beam.
    """
    pixel, (sx, sy) = 1.9, (2.1, 3.4)
    y, x = np.mgrid[:61, :67] - np.array([28.0, 35.0])[:, None, None]
    spot = np.exp(-(x**2) / (2 * sx**2) - y**2 / (2 * sy**2))
    peaks = (30000.0, 12000.0)
    shots = Capture(
        np.array([500 + 0.5 * p * spot for p in peaks]), np.array([18e3, 25e3]), np.array([[0.0, 0.0], [0.1, 0.3]]),
        np.full(2, np.nan), ("near", "far"), 16, pixel_um=pixel, about={"gain_e": 2.0},
    )  # fmt: skip
    total = [2 * math.pi * sx * sy * p for p in peaks]
    made = frames.measure_frames(shots, reference_e=1.6 * total[0])
    assert made.step_um == pixel
    for row, name, depth, angle, peak, light in zip(
        made.frames,
        ("near", "far"),
        (18e3, 25e3),
        (0.0, math.degrees(0.1)),
        peaks,
        total,
        strict=True,
    ):
        assert (row.name, row.depth_um) == (name, depth)
        assert row.angle_deg == pytest.approx(angle)
        assert row.angle_y_deg == pytest.approx(3 * angle)
        assert row.peak_e == pytest.approx(peak, rel=1e-6)
        assert row.spot.centroid_um == pytest.approx((2 * pixel, -2 * pixel), abs=0.02)
        assert row.spot.d4sigma_um == pytest.approx(
            (4 * sy * pixel, 4 * sx * pixel), rel=0.02
        )
        for got, sigma in (
            (row.mtf50_x_per_um, sx),
            (row.mtf50_y_per_um, sy),
        ):  # exp(-2 π² f² s²) = 1/2
            assert got == pytest.approx(
                math.sqrt(math.log(2) / 2) / (math.pi * sigma * pixel), rel=0.01
            )
        assert row.circle_um == pytest.approx(3 * row.spot.fwhm_um)
        radius = row.circle_um / 2 / pixel
        inside = spot[np.hypot(x, y) <= radius].sum() / spot.sum()
        assert row.efficiency == pytest.approx(
            inside * light / (1.6 * total[0]), rel=0.03
        )  # pixels cut by the circle
        assert math.isnan(row.strehl)
    assert made.best_depth_um == {}
    assert made.light[1].max() == pytest.approx(peaks[1], rel=1e-6)
    with pytest.raises(CaptureError, match="pixel_um"):
        frames.measure_frames(capture())


def test_pixels_per_side_of_the_rim_take_part_alike():
    """Every border counts once: levels 10, 20, 30, 40 along top, bottom, left, right of
    5 x 7 pixels.
    """
    frame = np.full((5, 7), 999.0)
    frame[0], frame[-1], frame[1:-1, 0], frame[1:-1, -1] = 10, 20, 30, 40
    light = frames._above(frame, np.ones(frame.shape, bool), "x.tif")
    assert light[0, 0] == 10 - np.median([10] * 7 + [20] * 7 + [30] * 3 + [40] * 3)
