"""Fields of a handful of rays, turned by rotation matrices, and their power by
Poynting's vector at one point.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from metalens.lens import Media
from metalens.propagate import PropagationCase
from metalens.psf import vector
from metalens.psf.among import NeighbourJonesFactors
from tests.metalens.psf.test_fields_beyond_faces import fresnel, ray

Z = np.array([0.0, 0.0, 1.0])
TANGENTS = (0.21, -0.13)
PLAIN = PropagationCase(
    (5, 6), 2.9, 0.85, 31.0, TANGENTS, (1 / 400,), (4.0, -7.5), 0.6, (9, 11), row_um=3.7
)
ORDER = (1.52, 1.0, 1.33)
COVERED = PropagationCase((5, 6), 2.9, 0.85, 31.0, TANGENTS, (1 / 400,), (4.0, -7.5), 0.6, (9, 11),
               behind=Media(ORDER, (9.0, 15.0, 7.0)), row_um=3.7)  # fmt: skip
AT = np.array([-5.1, 2.3, 6.8]), np.array([-4.4, 3.7])  # rows and columns of the lens
RNG = np.random.default_rng(11)
LIGHT = RNG.normal(size=(3, 3, 2)) + 1j * RNG.normal(
    size=(3, 3, 2)
)  # of three maps at one point of the window


def across(start, end):
    """The rotation that takes one unit vector to another the short way."""
    normal = np.cross(start, end)
    size = np.linalg.norm(normal)
    return (
        Rotation.from_rotvec(normal / size * math.atan2(size, start @ end))
        if size
        else Rotation.identity()
    )


COMES = np.array([*TANGENTS, 1.0]) / np.linalg.norm([*TANGENTS, 1.0])
COMING = [across(Z, COMES).apply(axis) for axis in np.eye(3)[:2]]


def towards(case):
    """(y, x) rays from AT to the window's middle: directions, from the pillars and at
    the sensor.
    """
    found = np.empty((3, 2, 2, 3))
    for i, y in enumerate(AT[0]):
        for j, x in enumerate(AT[1]):
            aside = np.array([case.centre_um[0] - x, case.centre_um[1] - y])
            far = np.linalg.norm(aside)
            angles = angles_of(case, far)
            for end, angle in enumerate((angles[0], angles[-1])):
                found[i, j, end] = [*(math.sin(angle) * aside / far), math.cos(angle)]
    return found


def angles_of(case, far):
    """Angles to the axis in every medium of a ray that goes so far aside, by bisection
    of Snell's sine.
    """
    if case.behind is None:
        return [math.atan2(far, case.sensor_distance_um)]
    low, high = 0.0, 1.0  # the air between bends no ray of a larger sine
    for _ in range(60):
        sine = (low + high) / 2
        gone = sum(
            t * sine / math.sqrt(n * n - sine * sine)
            for n, t in zip(ORDER, (9.0, 15.0, 7.0), strict=True)
        )
        low, high = (sine, high) if gone < far else (low, sine)
    return [math.asin(low / n) for n in ORDER]


def fields(case):
    """(polarisation, y, x, 3) of light along x and y as it comes, at the sensor."""
    out = np.empty((2, 3, 2, 3))
    for i, j in np.ndindex(3, 2):
        first, last = towards(case)[i, j]
        for k, e in enumerate(COMING):
            field = across(COMES, first).apply(e) / math.sqrt(first[2])
            if case.behind is not None:
                turn = math.atan2(first[1], first[0])
                angles = angles_of(
                    case,
                    np.linalg.norm(
                        [case.centre_um[0] - AT[1][j], case.centre_um[1] - AT[0][i]]
                    ),
                )
                s_power, p_power = fresnel(angles)
                _, s, p = ray(turn, angles[0])
                _, s_last, p_last = ray(turn, angles[-1])
                level = np.sqrt(
                    2
                    * np.array([s_power, p_power])
                    / (s_power + p_power)
                    * first[2]
                    / last[2]
                )
                field = (
                    level[0] * (field @ s) * s_last + level[1] * (field @ p) * p_last
                )
            out[k, i, j] = field
    return out


def seen(case, light, *, flux):
    """(2,) power of each polarisation at a point; light: (2, 2, y, x) from what comes
    in to what leaves.
    """
    e = fields(case)
    b = towards(case)[:, :, 1]
    found = []
    for k in (0, 1):
        whole = (
            sum(light[k, out][..., None] * e[out] for out in (0, 1))
            .reshape(-1, 3)
            .sum(0)
        )
        magnetic = (
            sum(light[k, out][..., None] * np.cross(b, e[out]) for out in (0, 1))
            .reshape(-1, 3)
            .sum(0)
        )
        poynting = np.cross(whole, magnetic.conj())[2].real
        found.append(poynting if flux else float((np.abs(whole) ** 2).sum()))
    return np.array(found)


@pytest.mark.parametrize("case", [PLAIN, COVERED], ids=["one medium", "films"])
@pytest.mark.parametrize("flux", [True, False])
@pytest.mark.parametrize("apart", [True, False])
def test_components_add_up_to_the_power_of_both_polarisations(case, flux, apart):
    """Of maps from x to x, y to y and between; of one map alone the flux of light along
    x stands for both.
    """
    signs, factors = vector.PolarizationMixing(flux, apart=apart).pupils(case)(*AT)
    light = np.zeros((2, 2, 3, 2), complex)
    light[0, 0], light[1, 1] = LIGHT[0], LIGHT[1] if apart else LIGHT[0]
    if apart:
        light[0, 1] = light[1, 0] = LIGHT[2]
    power = seen(case, light, flux=flux)
    want = power[0] if flux and not apart and case is PLAIN else power.mean()
    maps = LIGHT if apart else LIGHT[:1]
    got = float(signs @ (np.abs((factors * maps).sum((1, 2, 3))) ** 2))
    assert got == pytest.approx(want, rel=1e-9)
    assert (
        factors.shape[1]
        == vector.PolarizationMixing(flux, apart=apart).maps
        == (3 if apart else 1)
    )
    assert len(signs) == (
        4 if flux and not apart and case is PLAIN else 8 if flux else 6
    )


def test_components_that_are_nothing_are_left_out():
    """Of straight light above the middle of the window no ray leaves the plane of x =
    0: light along x has Ex alone.
    """
    case = PropagationCase(
        (5, 6), 2.9, 0.85, 31.0, (0.0, 0.0), (0.0,), (0.0, -7.5), 0.6, (9, 11)
    )
    signs, factors = vector.PolarizationMixing(False).pupils(case)(AT[0], np.zeros(1))
    assert (
        len(signs) == len(factors) == 3
    )  # Ex of light along x, Ey and Ez of light along y
    assert signs.tolist() == [1.0, 1.0, 1.0]
    signs, factors = vector.PolarizationMixing(True).pupils(case)(AT[0], np.zeros(1))
    assert signs.tolist() == [1.0, -1.0]
    cosine = 31.0 / np.hypot(31.0, AT[0] + 7.5)
    for got, want in zip(
        factors[:, 0, :, 0], ((1 + cosine) / 2, (1 - cosine) / 2), strict=True
    ):
        assert np.abs(got) == pytest.approx(want / np.sqrt(cosine), rel=1e-12)


def test_rays_run_to_the_middle_of_the_window_in_the_last_medium_or_one_that_is_asked_for():
    for case in (PLAIN, COVERED):
        want = towards(case)
        assert vector.rays_to(case, AT).numpy() == pytest.approx(
            np.moveaxis(want[:, :, 1], -1, 0), rel=1e-9
        )
        inner = vector.rays_to(case, AT, vector.order_behind(case)[0]).numpy()
        assert inner == pytest.approx(np.moveaxis(want[:, :, 0], -1, 0), rel=1e-9)
    assert (vector.order_behind(PLAIN), vector.order_behind(COVERED)) == ((1.0,), ORDER)
    assert (vector.has_faces(PLAIN), vector.has_faces(COVERED)) == (False, True)


def test_squares_of_a_turned_field_add_up_to_twice_one_over_the_cosine():
    a, b = (
        torch.from_numpy(COMES),
        torch.from_numpy(np.moveaxis(towards(PLAIN)[:, :, 0], -1, 0).copy()),
    )
    got = vector.transmitted_polarization(a, b)
    assert (got**2).sum(0).numpy() == pytest.approx((2 / b[2]).numpy(), rel=1e-12)
    want = np.moveaxis(fields(PLAIN), -1, 1).reshape(6, 3, 2)
    assert got.numpy() == pytest.approx(want, rel=1e-12, abs=1e-13)
    still = vector.transmitted_polarization(
        torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([0.0, 0.0, 1.0]).double()
    )
    assert still.tolist() == [1, 0, 0, 0, 1, 0]


def test_power_of_maps_apart_counts_what_goes_between_polarisations_for_both():
    levels = torch.from_numpy(RNG.uniform(0.2, 1, (3, 5, 6)))
    assert vector.PolarizationMixing(True, apart=True).power(
        PLAIN, (3.0, 5.0, 11.0), levels
    ) == pytest.approx(1.5 + 2.5 + 11.0)
    assert vector.PolarizationMixing(True).power(
        PLAIN, (3.0,), levels[:1]
    ) == pytest.approx(3.0)
    steep = []
    for level in levels.numpy():
        y, x = (np.arange(5) - 2) * 3.7, (np.arange(6) - 2.5) * 2.9
        cosine = 31.0 / np.sqrt(31.0**2 + (x - 4.0) ** 2 + (y[:, None] + 7.5) ** 2)
        steep.append(float((level**2 / cosine).sum() / (level**2).sum()))
    want = 1.5 * steep[0] + 2.5 * steep[1] + 11 * steep[2]
    assert vector.PolarizationMixing(False, apart=True).power(
        PLAIN, (3.0, 5.0, 11.0), levels
    ) == pytest.approx(want, rel=1e-12)
    dark = vector.PolarizationMixing(False, apart=True).power(
        PLAIN, (3.0, 0.0, 11.0), levels
    )
    assert dark == pytest.approx(want - 2.5 * steep[1], rel=1e-12)


def test_s_and_p_alone_pass_with_half_the_light_each_where_nothing_parts_them():
    signs, factors = vector.s_and_p(PLAIN)(*AT)
    assert signs.tolist() == [1.0, 1.0]
    assert factors == pytest.approx(np.full((2, 1, 3, 2), math.sqrt(0.5)), rel=1e-12)
    case = dataclasses.replace(COVERED, centre_um=(24.0, -19.0))
    signs, factors = vector.s_and_p(case)(*AT)
    assert signs.tolist() == [1.0, 1.0]
    shares = np.array(
        [
            [fresnel(angles_of(case, math.hypot(24.0 - x, -19.0 - y))) for x in AT[1]]
            for y in AT[0]
        ]
    )
    want = np.moveaxis(shares / shares.sum(-1, keepdims=True), -1, 0)
    assert (want[1] - want[0]).max() > 0.05
    # their saddles differ from the mean's by a wavelength over the path: 0.85 / 2 pi /
    # 50
    assert np.abs(factors[:, 0]) ** 2 == pytest.approx(want, rel=0.01)


def test_maps_apart_are_the_map_times_each_factor_wavelength_by_wavelength():
    phase, level = RNG.uniform(-1, 1, (2, 3, 4)), RNG.uniform(0.2, 1, (2, 3, 4))
    factors = [
        RNG.normal(size=(2, 3, 4)) + 1j * RNG.normal(size=(2, 3, 4)) for _ in range(3)
    ]
    jones = NeighbourJonesFactors(*map(torch.from_numpy, factors))
    got = vector.apart_maps((torch.from_numpy(phase), torch.from_numpy(level)), jones)
    made = torch.polar(got[1], got[0]).numpy()
    want = [
        level[w] * np.exp(1j * phase[w]) * factors[k][w]
        for w in (0, 1)
        for k in (0, 1, 2)
    ]
    assert made == pytest.approx(np.array(want), rel=1e-12)
    assert (got[1] >= 0).all()


@pytest.mark.parametrize("count", [1, 2, 9])
def test_mixtures_keep_the_light_of_the_nodes_and_all_of_them_every_power(count):
    """Four components of three independent ones at seven nodes: three are left. Sums
    over any light are as before, up
    to the one level that makes the light of the nodes that of their weights."""
    pupils = RNG.normal(size=(4, 7))
    pupils[3] = 2 * pupils[0] - pupils[1]
    signs, weight = np.array([1.0, 1.0, 1.0, -1.0]), RNG.uniform(0.5, 2, 7)
    pupils[3] *= 0.1
    found = vector.dominant_components(
        vector.VectorPupil(torch.from_numpy(pupils), tuple(signs)),
        torch.from_numpy(weight),
        count,
    )
    made, sign = found.pupils.numpy(), np.array(found.signs)
    assert len(sign) == min(count, 3)
    assert sign @ ((made * weight) ** 2).sum(1) == pytest.approx(
        (weight**2).sum(), rel=1e-9
    )
    if count > 2:
        whole = signs @ ((pupils * weight) ** 2).sum(1)
        for light in RNG.normal(size=(3, 7)):
            want = signs @ (pupils @ light) ** 2 * (weight**2).sum() / whole
            assert sign @ (made @ light) ** 2 == pytest.approx(want, rel=1e-9)
    powers = sign * ((made * weight) ** 2).sum(1)
    assert (np.diff(np.abs(powers)) <= 0).all()
