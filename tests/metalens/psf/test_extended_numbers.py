"""Sources of finite size: transforms by quadrature, images by rays, and the error of
one PSF for a whole source.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from metalens.propagate import PropagationCase
from metalens.psf import extended
from metalens.psf.extended import Extent

CASE = PropagationCase(
    (44, 58),
    0.37,
    0.85,
    95.0,
    (0.21, -0.13),
    (1 / 900, 1 / 2100),
    (20.4, -12.9),
    0.5,
    (17, 26),
)


def density(shape, x, y):
    """Radiance of a source of size 1 at a place, of any scale."""
    if shape == "square":
        return ((np.abs(x) < 0.5) & (np.abs(y) < 0.5)) * 1.0
    r2 = x**2 + y**2
    return (r2 < 0.25) * 1.0 if shape == "disc" else np.exp(-4 * math.log(2) * r2)


def moment(shape, u, v, count=1200):
    """(ŵ, [∂ŵ/∂u, ∂ŵ/∂v]) by the midpoint rule."""
    reach = 3.0 if shape == "gaussian" else 0.5
    line = ((np.arange(count) + 0.5) / count * 2 - 1) * reach
    x, y = np.meshgrid(line, line)
    w = density(shape, x, y)
    wave = w / w.sum() * np.exp(-2j * np.pi * (u * x + v * y))
    return wave.sum(), np.array(
        [(-2j * np.pi * x * wave).sum(), (-2j * np.pi * y * wave).sum()]
    )


@pytest.mark.parametrize("shape", ["disc", "square", "gaussian"])
@pytest.mark.parametrize(
    ("u", "v"), [(0.3, 0.55), (1.4, -0.2), (-0.7, 0.9), (2e-5, -0.6)]
)
def test_transforms_and_their_slopes_are_the_integrals(shape, u, v):
    level, slope = Extent(shape, size_um=1.0).transform(u, v)
    want, rise = moment(shape, u, v)
    near = (
        2e-4 if shape == "disc" else 2e-6
    )  # of 1200 x 1200 midpoints: the disc's edge is a staircase
    assert level == pytest.approx(want.real, abs=near)
    assert slope == pytest.approx(np.linalg.norm(rise) / (2 * np.pi), abs=near)


@pytest.mark.parametrize("shape", ["disc", "square", "gaussian"])
def test_sigmas_are_those_of_the_radiance_along_an_axis(shape):
    """ŵ falls as 1 - (2πσu)² / 2 along x and y, and |∇ŵ|/(2π) rises as 2πσ² u."""
    sigma, u = extended.SIGMA[shape], 0.004
    for pair in ((u, 0.0), (0.0, u)):
        level, slope = Extent(shape, size_um=1.0).transform(*pair)
        assert 1 - level == pytest.approx(
            (2 * np.pi * sigma * u) ** 2 / 2, rel=1e-3
        )  # next: (2πσu)² / 12 of it
        assert slope == pytest.approx(2 * np.pi * sigma**2 * u, rel=1e-3)


def test_half_of_a_source_that_counts():
    assert extended.REACH["disc"] == extended.REACH["square"] == 0.5
    assert extended.REACH["gaussian"] == pytest.approx(
        4 / 2.354820045, rel=1e-9
    )  # four sigma of a width at half


def test_images_in_air_are_the_source_times_distance_over_depth():
    """-d / z for um, whatever the angle; -d for the tangent of a size in rad."""
    got = extended.source_to_image_matrices(CASE, Extent("square", size_um=70.0))
    assert got[0] == pytest.approx(-95 / 900 * 70 * np.eye(2), abs=1e-7)
    assert got[1] == pytest.approx(-95 / 2100 * 70 * np.eye(2), abs=1e-7)
    wide = extended.source_to_image_matrices(CASE, Extent("square", size_rad=0.06))
    assert wide == pytest.approx(np.stack([-95 * 0.06 * np.eye(2)] * 2), abs=1e-7)


def test_images_through_a_window_of_glass_turn_with_the_angle():
    """A plate of 200 um, n 1.6: the source of tangents τ lies at -((z - t) + t cosθ /
    √(n² - sin²θ)) τ.
    """
    case = replace(CASE, front=((1.6, 200.0),), inverse_depths_per_um=(1 / 900,))

    def place(tx, ty):
        sine2 = 1 - 1 / (1 + tx**2 + ty**2)
        away = 700 + 200 * math.sqrt((1 - sine2) / (1.6**2 - sine2))
        return np.array([-away * tx, -away * ty])

    h, (tx, ty) = 1e-5, case.tangents
    slopes = np.stack(
        [
            (place(tx + h, ty) - place(tx - h, ty)) / (2 * h),
            (place(tx, ty + h) - place(tx, ty - h)) / (2 * h),
        ],
        axis=1,
    )
    assert abs(slopes[0, 1]) > 0.1  # x and y are coupled off axis
    want = (
        95 * 70 * np.linalg.inv(slopes)
    )  # tangents by the source, um on the sensor by tangents
    assert extended.source_to_image_matrices(case, Extent("disc", size_um=70.0))[
        0
    ] == pytest.approx(want, rel=1e-6)


def test_a_window_is_widened_by_the_image_and_twelve_steps_of_nyquist():
    """Its image reaches 95 / 900 x 70 / 2 = 3.694 um, 8 samples of 0.5 um; Gaussian: 4
    x 0.42466 x 7.389 = 12.55.
    """
    limit = extended.nyquist_um(CASE)
    guard = 12 * math.ceil(limit / 0.5)
    for shape, samples in (("disc", 8), ("square", 8), ("gaussian", 26)):
        wide, more = extended.widen_case(CASE, Extent(shape, size_um=70.0))
        assert more == (samples + guard, samples + guard)
        assert wide.samples == (17 + 2 * more[0], 26 + 2 * more[1])
        assert replace(wide, samples=CASE.samples) == CASE
    assert limit > 0.5


def test_blurred_light_is_the_convolution_and_what_was_cut_is_the_edge():
    """A spot beside the middle, at the nearer depth the wider; Gaussians add their
    variances.
    """
    case = replace(CASE, samples=(61, 81))
    y, x = ((np.arange(n) - (n - 1) / 2) * 0.5 for n in (61, 81))
    sigma, at = 1.9, (2.3, -1.6)
    spot = np.exp(-((x - at[0]) ** 2 + (y[:, None] - at[1]) ** 2) / (2 * sigma**2))
    light = torch.from_numpy(np.stack([spot, spot]))
    extent = Extent("gaussian", size_um=20.0)
    more = (14, 16)
    got, edge = extended.blur_by_source(light, case, extent, more)
    for plane, depth in zip(got.numpy(), (900, 2100), strict=True):
        added = 95 / depth * 20 * extended.SIGMA["gaussian"]
        wide2 = sigma**2 + added**2
        want = (
            sigma**2
            / wide2
            * np.exp(-((x - at[0]) ** 2 + (y[:, None] - at[1]) ** 2) / (2 * wide2))
        )
        assert plane == pytest.approx(
            want[14:-14, 16:-16], abs=2e-6
        )  # light beyond the window: exp(-25)
    assert 0 < edge < 1e-3
    flat = torch.ones(2, 61, 81, dtype=torch.float64)
    bright, edge = extended.blur_by_source(flat, case, extent, more)
    reach = math.ceil(95 / 900 * 20 * 4 * extended.SIGMA["gaussian"] / 0.5)
    down, across = (14 - reach) // 2, (16 - reach) // 2
    cut = flat.clone()
    cut[:, :down], cut[:, -down:], cut[..., :across], cut[..., -across:] = 0, 0, 0, 0
    whole, inner = (
        extended._filtered(v, case, extent, 0)[:, 14:-14, 16:-16] for v in (flat, cut)
    )
    assert (down, across) == (3, 4)
    assert edge == pytest.approx(float((whole - inner).norm() / whole.norm()), rel=1e-9)
    assert bright.numpy() == pytest.approx(whole.numpy())


def test_unlike_is_what_a_blur_leaves_of_a_change_along_the_source():
    """PSFs that tilt by their tangents: P_s = P (1 + a δx + b δy), seen through √(ŵ² +
    |∇ŵ|²/(2πσ)²).
    """
    case = replace(CASE, samples=(48, 64))
    rng = np.random.default_rng(4)
    light = torch.from_numpy(rng.uniform(0.2, 1.0, (2, 48, 64)))
    extent, slopes = Extent("disc", size_um=50.0), (3.0, -8.0)
    asked = []

    def probe(other):
        depth = case.inverse_depths_per_um.index(other.inverse_depths_per_um[0])
        change = np.subtract(other.tangents, case.tangents)
        asked.append((depth, change, np.subtract(other.centre_um, case.centre_um)))
        return light[depth : depth + 1] * (1 + float(change @ slopes))

    got = extended.shift_invariance_error(light, case, extent, probe)
    found = []
    for depth, z in enumerate((900, 2100)):
        one = replace(case, inverse_depths_per_um=(1 / z,))
        seen = [
            float(extended._filtered(light[depth : depth + 1], one, extent, k).norm())
            for k in (0, 1)
        ]
        found.append(
            50 / z / 4 * np.hypot(*slopes) * seen[1] / seen[0]
        )  # a quarter of the size: sigma of a disc
    assert got == pytest.approx(max(found), rel=1e-6)
    for depth, change, moved in asked:
        assert moved == pytest.approx(
            95 * change, rel=1e-9
        )  # the window follows the chief ray
        assert np.abs(change).max() == pytest.approx(
            50 / (900, 2100)[depth] / 4, rel=1e-6
        )
    assert {depth for depth, *_ in asked} == {0, 1}


def test_a_source_seen_through_glass_is_drawn_along_its_slanted_image():
    """A Gaussian of covariance M Mᵀ times its variance, M with both axes coupled; the
    frequencies go with Mᵀ.
    """
    case = replace(
        CASE, samples=(81, 97), front=((1.6, 600.0),), inverse_depths_per_um=(1 / 900,)
    )
    extent = Extent("gaussian", size_um=25.0)
    turn = (
        extended.source_to_image_matrices(case, extent)[0] * extended.SIGMA["gaussian"]
    )
    y, x = ((np.arange(n) - (n - 1) / 2) * 0.5 for n in (81, 97))
    covariance = 1.6**2 * np.eye(2) + turn @ turn.T
    assert abs(covariance[0, 1]) > 0.002
    place = np.stack(np.meshgrid(x, y), -1)
    spot = np.exp(-(place**2).sum(-1) / (2 * 1.6**2))
    got = extended._filtered(torch.from_numpy(spot)[None], case, extent, 0)[0].numpy()
    inverse = np.linalg.inv(covariance)
    want = (
        np.exp(-np.einsum("yxi,ij,yxj->yx", place, inverse, place) / 2)
        * 1.6**2
        / math.sqrt(np.linalg.det(covariance))
    )
    flipped = np.exp(
        -np.einsum("yxi,ij,yxj->yx", place * [1, -1], inverse, place * [1, -1]) / 2
    )
    assert np.abs(got - want).max() < 1e-6
    assert np.abs(flipped * want.max() - want).max() > 1e-5
