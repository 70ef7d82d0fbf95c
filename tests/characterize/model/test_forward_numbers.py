"""Numbers of the forward model that have a formula: the lines of a spectrum, the true
place of a source.
"""

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference.leastsquares import FitImages
from characterize.inference.prepare import quick_enough
from characterize.model import ForwardModel, FrameSetting, made, thinplate
from characterize.model.glass import extra_path
from characterize.model.moments import WHOLE
from characterize.model.parameters import PLACE, parameter_vector
from characterize.model.setting import SpectralLine, true_depth
from metalens import design, profiles
from metalens.cell.record import Cell
from metalens.core.errors import FitError


@pytest.mark.parametrize("path_um", [1.0, 13.7, 69.0, 310.0])
@pytest.mark.parametrize("tolerance", [5e-4, 1e-5])
def test_colours_stand_for_a_gaussian_line_to_every_path_of_the_lens(
    path_um, tolerance
):
    """Mean of exp(i s) over a line of 4.25 nm, for phases s of paths up to the longest:
    exp(-s²/2).
    """
    line = SpectralLine(path_um, 0.85, tolerance)
    offset, weight = np.array(line.colours(4.25)).T
    assert weight.sum() == pytest.approx(1, rel=1e-12)
    assert (weight * offset).sum() == pytest.approx(0, abs=1e-9)
    for share in (0.17, 0.61, 1.0):
        turn_a_nm = 2 * math.pi * share * path_um / 0.85**2 * 1e-3
        mean = (weight * np.exp(1j * turn_a_nm * offset)).sum()
        assert abs(mean - math.exp(-((turn_a_nm * 4.25) ** 2) / 2)) <= 1.05 * tolerance
    assert line.colours(0.0) == [(0.0, 1.0)]
    assert np.array(line.colours(4.5, 4.25)) == pytest.approx(
        np.stack([offset * 4.5 / 4.25, weight], 1)
    )


def test_narrow_light_on_a_small_lens_is_two_colours_and_wide_light_on_a_large_one_is_refused():
    assert len(SpectralLine(5.0, 0.85, 5e-4).colours(1.0)) == 2
    assert len(SpectralLine(69.0, 0.85, 5e-4).colours(4.25)) == 9
    with pytest.raises(FitError, match="narrower filter"):
        SpectralLine(900.0, 0.85, 5e-4).colours(8.0)


def test_the_longest_path_of_a_lens_is_from_its_axis_to_its_rim():
    """On the axis r² / 2 (1/z + 1/d) to first order, most for the nearest source; a
    wavelength more for the pillars.
    """
    lens, radius = b.lens(), b.lens().diameters.radius_um
    exact = math.hypot(radius, 380) - 380 + math.hypot(radius, 110) - 110
    line = SpectralLine.of(
        lens, np.array([600.0, 380.0]), np.zeros((2, 2)), tolerance=1e-3
    )
    assert line.path_um == pytest.approx(exact + 0.85, rel=1e-9)
    aside = SpectralLine.of(
        lens,
        np.array([380.0, 600.0]),
        np.array([[0.2, -0.1], [0.2, -0.1]]),
        tolerance=1e-3,
    )
    slope = np.tan(np.array([0.2, -0.1]))
    turn = np.linspace(0, 2 * np.pi, 2000)
    places = [np.zeros(2), *(radius * np.stack([np.cos(turn), np.sin(turn)], -1))]
    found = [
        math.hypot(*(place + 380 * slope), 380)
        + math.hypot(*(place - 110 * slope), 110)
        for place in places
    ]
    assert aside.path_um - 0.85 == pytest.approx(
        max(found) - min(found), rel=3e-3
    )  # 48 places of the rim


def test_frames_of_a_wide_spectrum_are_those_of_its_colours():
    """A lens of NA 0.55 under 8 nm: light at its rim turns by 2.4 rad a standard
    deviation against that of its axis, of
    which five lines missed 1 % of the peak.

    Judge: 25 even colours over +-4 sigma, each a frame of one wavelength. Twice the
    tolerance, since differences of
    many paths add.
    """
    focus = profiles.Focus(0.85, 150.0, 900.0)
    lens = design.make(
        design.phase_of(None, focus, radius_um=100.0),
        focus,
        aperture_um=200.0,
        cell=Cell(pitch_um=0.4),
        proxy=b.proxy(),
    )[0]
    setting = FrameSetting(np.array([640.0]), np.zeros((1, 2)), np.ones(1), 1.5, 16, 16)
    model, x = (
        ForwardModel(lens, setting, b.RESPONSE),
        parameter_vector({"bandwidth_nm": 8.0}),
    )
    place = np.linspace(-4, 4, 25)
    weight = np.exp(-(place**2) / 2)
    want = 0.0
    for offset, share in zip(8.0 * place, weight / weight.sum(), strict=True):
        want = (
            want
            + share
            * model.images(parameter_vector({"wavelength_nm": float(offset)}))[0]
        )
    assert np.abs(model.images(x)[0] - want).max() < 2 * setting.tolerance * want.max()


def test_a_stage_is_off_by_its_zero_and_by_its_scale_about_its_middle():
    setting = SimpleNamespace(depth_um=np.array([21e3, 26e3, 34e3]))
    x = parameter_vector({"stage_zero_um": 310.0, "stage_scale": 0.013})
    assert true_depth(x, setting, 27e3) == pytest.approx(
        [21e3 + 310 - 78, 26e3 + 310 - 13, 34e3 + 310 + 91]
    )
    behind = true_depth(parameter_vector({"stage_zero_um": -20e3}), setting, 27e3)
    assert behind == pytest.approx(
        [4.2e3, 6e3, 14e3]
    )  # never nearer than a fifth of what was stated


def test_fewer_terms_change_no_derivative():
    """By distance and wavelength too, which are differences of fields: of all terms,
    else what is left out is in them.

    A twentieth of the largest change; 1 % of the fields is left out.
    """
    setting = FrameSetting(
        np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16
    )
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    x = parameter_vector(b.VALUES | {"background_e": 0.0})
    names = ["distance_um", "wavelength_nm", "stage_zero_um", "bias_nm", "coma_x_rad"]
    full, some = (each.images(x, names)[1] for each in (model, model.rough(1e-2)))
    for one, other in zip(full, some, strict=True):
        assert np.abs(one - other).max() < 0.05 * np.abs(one).max()


def test_the_fewest_terms_that_count_depend_on_the_light():
    """Of frames of few electrons more may be left out; chi-square rises by no more than
    0.02 against all terms.
    """
    setting = FrameSetting(
        np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16
    )
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    light = model.images(parameter_vector(b.VALUES | {"background_e": 0.0}))[0]
    cuts = []
    for peak in (50.0, 5e5, 5e7):
        x = parameter_vector(b.VALUES | {"log_gain": math.log(peak / light.max())})
        exact = model.images(x)[0]
        ones = np.ones_like(exact)
        data = FitImages(exact, ones > 0, ones < 0, 4 * ones, ones)
        quick = quick_enough(model, data, x)
        rise = float(((quick.images(x)[0] - exact) ** 2 / data.variance(exact)).sum())
        assert rise < 0.02
        cuts.append(quick.cut)
    assert cuts[0] > cuts[1] >= cuts[2]


def test_of_some_nodes_phase_and_its_slopes_are_those_of_all():
    """Also through glass, with modes beyond the parameters and uneven light; to
    rounding.
    """
    setting = FrameSetting(
        np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16
    )
    model = ForwardModel(b.lens(), setting, b.RESPONSE).with_residual(
        np.array([0.07, -0.11]), thinplate.thin_plate_basis
    )
    x = parameter_vector(
        b.VALUES
        | {
            "glass_um": 170.0,
            "glass_tilt_x_deg": 3.1,
            "light_y": 0.13,
            "tilt_y_deg": 0.4,
        }
    )
    group = model.groups[0]
    cut = np.ix_([0, 3, 17], [2, 5, 9, 11])
    assert model._phase(x, group, cut) == pytest.approx(
        model._phase(x, group)[:, *cut], rel=1e-12
    )
    names = [
        "bias_r_nm",
        "height_nm",
        "coma_y_rad",
        "residual_1",
        "light_y",
        "distance_um",
        "stage_zero_um",
    ]
    for name, factor in model._factors(x, group, names):
        assert factor.values(cut) == pytest.approx(
            factor.values(WHOLE)[:, *cut], rel=1e-6
        ), name


@pytest.mark.parametrize("pixels", [(3, -2), (-5, 4)])
def test_a_window_off_the_chief_ray_sees_the_same_light_shifted_by_whole_pixels(pixels):
    """By 4.5 and 3 um from directions that are there, by 7.5 and 6 um from more of
    them: fields to 5e-4, twice. Held at
    the chief ray, the phase of a decentre turns each place as the middle: k 4.5 um 10
    um 1.5 sin² / d missed."""
    setting = FrameSetting(
        np.array([480.0, 800.0]), np.zeros((2, 2)), np.ones(2), 1.5, 16, 18
    )
    model, names = (
        ForwardModel(b.lens(8.0), setting, b.RESPONSE),
        ("coma_y_rad", "distance_um", "decentre_x_um"),
    )
    values = b.VALUES | {
        "decentre_x_um": 0.0,
        "decentre_y_um": 0.0,
        "background_x_e": 0.0,
        "log_gain": 10.0,
    }
    here, slopes = model.images(parameter_vector(values), names)
    x, y = (1.5 * n for n in pixels)
    moved = parameter_vector(values | {"decentre_x_um": x, "decentre_y_um": y})
    there, shifted = model.about((x, y)).images(moved, names)
    rows, columns = (
        slice(max(n, 0), size + min(n, 0))
        for n, size in zip(pixels[::-1], (16, 18), strict=True)
    )
    back = [
        slice(max(-n, 0), size + min(-n, 0))
        for n, size in zip(pixels[::-1], (16, 18), strict=True)
    ]
    kept = there[:, back[0], back[1]]
    assert np.abs(kept - here[:, rows, columns]).max() < 2e-3 * here.max()
    for one, other in zip(slopes, shifted, strict=True):
        assert (
            np.abs(other[:, back[0], back[1]] - one[:, rows, columns]).max()
            < 2e-2 * np.abs(one).max()
        )
    plain = model.images(moved)[0][:, back[0], back[1]]
    assert np.abs(plain - here[:, rows, columns]).max() > 8e-3 * here.max()


SMALL = FrameSetting(
    np.array([480.0, 800.0]), np.zeros((2, 2)), np.array([1.0, 1.7]), 1.5, 12, 16
)


@pytest.fixture(scope="module")
def small():
    return ForwardModel(b.lens(), SMALL, b.RESPONSE)


def test_frames_hold_the_light_of_the_lens(small):
    """e^1.3 electrons for what falls on the pillars at the mean depth, by its square
    and the exposure; of that the
    pillars pass three quarters and the window, of three Airy radii to each side, nine
    tenths."""
    light = small.images(parameter_vector({"log_gain": 1.3}))[0].sum((1, 2))
    mean = 2 / (1 / 480.0 + 1 / 800.0)
    want = math.exp(1.3) * np.array(
        [1.0 * (mean / 480.0) ** 2, 1.7 * (mean / 800.0) ** 2]
    )
    t = made.as_built_transmission(b.lens(), b.RESPONSE, parameter_vector({}))
    passed = (np.abs(t) ** 2).sum() / (t != 0).sum()
    assert passed == pytest.approx(0.75, abs=0.03)
    assert light / want / passed == pytest.approx([0.92, 0.92], abs=0.06)


def test_some_frames_of_several_angles_are_those_of_all():
    """Angles take turns, so that neither the frames nor their groups stand in order."""
    angles = np.array([[0.05, -0.02], [0.0, 0.03]])[[0, 1, 0, 1, 0]]
    model = ForwardModel(
        b.lens(),
        FrameSetting(np.array(b.DEPTHS), angles, np.linspace(1, 2, 5), 1.5, 10, 10),
        b.RESPONSE,
    )
    x = parameter_vector(b.VALUES)
    every = model.images(x)[0]
    for some in ([1, 2, 4], [3], [0, 4]):
        assert model.only(np.array(some)).images(x)[0] == pytest.approx(
            every[some], rel=1e-6
        )


def test_windows_far_off_along_one_axis_alone_have_directions_of_their_own(small):
    """As far as 5 um, those of the middle serve."""
    assert small.about((4.0, -4.9)).groups[0].reduced is small.groups[0].reduced
    for middle in ((9.0, 0.0), (0.0, -9.0)):
        assert small.about(middle).groups[0].reduced is not small.groups[0].reduced


def test_a_background_rises_from_minus_one_to_one_across_the_frame(small):
    """In electrons of exposure 1, 1.7 times as many in the second frame: its level, and
    its slopes along x and y by
    (column - 7.5) / 8 and (row - 5.5) / 6."""
    dark = b.VALUES | {"background_e": 0.0, "background_x_e": 0.0}
    light = small.images(parameter_vector(dark))[0]
    seen = small.images(
        parameter_vector(
            dark | {"background_e": 7.0, "background_x_e": 3.0, "background_y_e": -5.0}
        )
    )[0]
    y, x = (np.arange(12)[:, None] - 5.5) / 6, (np.arange(16) - 7.5) / 8
    grown = np.array([1.0, 1.7])[:, None, None]
    assert seen - light == pytest.approx(grown * (7 + 3 * x - 5 * y), abs=1e-9)


def test_a_source_of_some_width_is_the_sum_of_its_points(small):
    """Of 61 points on a disc, whose places and weights are exact to the third degree;
    its width there times d / z.
    """
    values = b.VALUES | {"background_e": 0.0, "background_x_e": 0.0, "log_gain": 10.0}
    wide = small.images(parameter_vector(values | {"pinhole_um": 14.0}))[0]
    point = small.images(parameter_vector(values))[0]
    radius = 7.0 * np.sqrt((np.arange(5) + 0.5) / 5)  # rings of one area
    want = np.mean([
        small.images(parameter_vector(values | {"source_x_um": r * math.cos(a), "source_y_um": r * math.sin(a)}))[0]
        for i, r in enumerate(radius)
        for a in 2 * np.pi * (np.arange(7) + i / 3) / 7
    ], axis=0)  # fmt: skip
    off = np.abs(wide - want).max((1, 2)) / want.max((1, 2))
    told = np.abs(point - want).max((1, 2)) / want.max((1, 2))
    assert (off < 0.05 * told).all()
    assert told[0] > 2 * told[1] > 0  # nearer: its image is larger


def test_derivatives_by_the_bench_are_differences_with_a_wide_source(small):
    """Central ones; the source's image grows with distance and depth. Slopes of fields
    are of fewer terms, which leaves
    0.8 % of that by the wavelength."""
    x = parameter_vector(b.VALUES | {"pinhole_um": 14.0, "log_gain": 10.0})
    steps = {
        "distance_um": 0.03,
        "stage_zero_um": 0.3,
        "stage_scale": 1e-3,
        "pinhole_um": 0.05,
        "log_gain": 1e-4,
    }
    steps |= {
        "background_e": 1.0,
        "background_x_e": 1.0,
        "background_y_e": 1.0,
        "wavelength_nm": 0.3,
    }
    steps |= {"bias_nm": 0.5, "bias_y_nm": 0.5, "height_nm": 2.0, "crosstalk_px": 0.01}
    slopes = small.images(x, list(steps))[1]
    for one, (name, step) in zip(slopes, steps.items(), strict=True):
        way = step * (np.arange(len(x)) == PLACE[name])
        want = (small.images(x + way)[0] - small.images(x - way)[0]) / (2 * step)
        assert np.abs(one - want).max() < 1e-2 * np.abs(want).max(), name
    alone = small.images(x, ["stage_scale"])[1]
    assert alone[0] == pytest.approx(
        slopes[2], rel=1e-9, abs=1e-9 * np.abs(slopes[2]).max()
    )


def test_smooth_phases_are_those_of_the_paths_from_a_point_of_the_bench_to_a_window():
    """Straight lines through the place of a node, at the wavelength that it is, but for
    a phase of all the lens.
    """
    setting = FrameSetting(
        np.array([480.0, 800.0]),
        np.tile([0.06, -0.04], (2, 1)),
        np.ones(2),
        1.5,
        12,
        16,
    )
    (group,) = (model := ForwardModel(b.lens(), setting, b.RESPONSE)).groups
    bench = {
        "wavelength_nm": 1.3,
        "distance_um": 2.0,
        "decentre_x_um": 0.8,
        "decentre_y_um": -0.4,
    }
    x = parameter_vector(
        bench
        | {
            "tilt_x_deg": 0.3,
            "tilt_y_deg": -0.2,
            "stage_zero_um": 9.0,
            "source_x_um": 3.0,
        }
    )
    tx, ty = (
        math.tan(0.06) + math.tan(math.radians(0.3)),
        math.tan(-0.04) + math.tan(math.radians(-0.2)),
    )
    near_x, near_y, d = group.reduced.x_um, group.reduced.y_um, 112.0
    for got, z in zip(
        model._phase(x, group) + group.reduced.known, (489.0, 809.0), strict=True
    ):
        enter = np.sqrt((near_x + z * tx - 3.0) ** 2 + (near_y + z * ty) ** 2 + z**2)
        leave = np.sqrt(
            (near_x - d * tx - 0.8) ** 2 + (near_y - d * ty + 0.4) ** 2 + d**2
        )
        off = got - 2 * math.pi / 0.8513 * (enter + leave)
        assert np.ptp(off) < 1e-9 * np.abs(got).max()
    plate = (
        x
        + parameter_vector({"glass_um": 70.0, "glass_tilt_x_deg": 1.1})
        - parameter_vector({})
    )
    for got, z in zip(
        model._phase(plate, group) - model._phase(x, group), (489.0, 809.0), strict=True
    ):
        tangents = tx - 3.0 / z, ty
        added = extra_path(near_x, near_y, tangents=tangents, depth_um=z, values=plate)
        assert got == pytest.approx(2 * math.pi / 0.8513 * added, abs=1e-6)
        assert np.ptp(got) > 0.5
