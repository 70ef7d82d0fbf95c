"""Both polarisations put onto nodes of the lens against every pillar's own E and H,
each summed apart.
"""

import math

import numpy as np
import pytest
import torch

from metalens import propagate, psf
from metalens.cell import Film, Index
from metalens.lens import Layers
from metalens.psf import among
from metalens.psf.vector import PolarizationMixing

PITCH, WAVE, DISTANCE, COUNT = 0.41, 0.83, 60.0, 110
ANGLE, SEEN = (
    (0.22, -0.13),
    dict(depths_um=[900.0, 2500.0], window_um=14.0, samples=20, offset_um=(1.3, -2.1)),
)


def lens(distance=DISTANCE):
    """Phase of a focus with coma, uneven transmission, an aperture off the middle; NA
    0.35.
    """
    y, x = (np.indices((COUNT, COUNT)) - (COUNT - 1) / 2) * PITCH
    r2 = x**2 + y**2
    path = r2 / (np.sqrt(r2 + distance**2) + distance) - 0.4 * x * r2 / 20**3
    return -2 * np.pi / WAVE * path, (np.hypot(x - 1.0, y + 2.0) < 20.0) * (
        0.8 + 0.01 * x
    )


def turn(a, b):
    """(3, 3, y, x) rotation that takes the direction a to b the short way (Rodrigues)."""
    axis = np.cross(a, b, axisb=0, axisc=0)
    cosine = np.einsum("i,iyx->yx", a, b)
    k = np.array(
        [
            [0 * axis[0], -axis[2], axis[1]],
            [axis[2], 0 * axis[0], -axis[0]],
            [-axis[1], axis[0], 0 * axis[0]],
        ]
    )
    return (
        np.eye(3)[..., None, None]
        + k
        + np.einsum("ijyx,jkyx->ikyx", k, k) / (1 + cosine)
    )


def plain(maps, jones, *, kind, index=1.0, layers=None):
    """(depth, y, x) mean over light along x and y of E x H* along z, or of |E|²: six
    exact sums of every pillar's.

    Rays to the window's middle, turned in the air behind the pillars; index is that
    before the sensor, where they bend.
    """
    about = dict(
        pitch_um=PITCH,
        wavelength_um=WAVE,
        sensor_distance_um=DISTANCE,
        angle_rad=ANGLE,
        **SEEN,
        layers=layers,
    )
    case = propagate.make_case((COUNT, COUNT), **about)
    y, x = case.pillars_um
    dx, dy = case.centre_um[0] - x[None, :], case.centre_um[1] - y[:, None]
    p, q = (
        propagate.ray_cosines(case, along, across)
        for along, across in ((dx, dy), (dy, dx))
    )
    b = np.stack([p, q, np.sqrt(1 - p * p - q * q)])
    bent = np.stack([p / index, q / index, np.sqrt(1 - (p * p + q * q) / index**2)])
    a = np.array([*np.tan(ANGLE), 1.0]) / math.sqrt(1 + (np.tan(ANGLE) ** 2).sum())
    to_a = turn(np.array([0, 0, 1.0]), a[:, None, None])[..., 0, 0]
    total = 0
    for given in (0, 1):
        e = np.einsum(
            "ijyx,jk,kyx->iyx", turn(a, b), to_a[:, :2], jones[:, given]
        ) / np.sqrt(b[2])
        e = face(e, b, bent, index)
        h = np.cross(bent, e, axis=0)
        wave = [
            np.array([summed(maps, part, about) for part in field]) for field in (e, h)
        ]
        if kind == "flux":
            total = (
                total
                + (wave[0][0] * wave[1][1].conj() - wave[0][1] * wave[1][0].conj()).real
                / 2
            )
        else:
            total = total + (np.abs(wave[0]) ** 2).sum(0) / 2
    return total


def face(e, b, bent, index):
    """Field behind a face of air and glass over the root mean square of s and p power:
    Fresnel's amplitudes.
    """
    unit = np.stack([b[0], b[1], 0 * b[0]]) / np.hypot(b[0], b[1])
    s = np.stack([-unit[1], unit[0], 0 * b[0]])
    level = []
    for both in (b[2] + index * bent[2], index * b[2] + bent[2]):
        level.append(
            2 * b[2] / both * np.sqrt(index * bent[2] / b[2])
        )  # amplitude whose square is power
    mean = np.sqrt((level[0] ** 2 + level[1] ** 2) / 2)
    along_s, along_p = (e * s).sum(0), (e * np.cross(s, b, axis=0)).sum(0)
    out = along_s * level[0] * s + along_p * level[1] * np.cross(s, bent, axis=0)
    return out / mean * np.sqrt(b[2] / bent[2])


def summed(maps, factor, about):
    light = maps[1] * np.exp(1j * maps[0]) * factor
    return propagate.exact(np.angle(light), np.abs(light), **about)


def uneven():
    """(2, 2, y, x) complex Jones matrices of pillars, unlike over the lens."""
    y, x = (np.indices((COUNT, COUNT)) / COUNT - 0.5) * 2
    off = 0.1 * x * y + 0.05j * y
    return np.array([[0.9 - 0.2j * x**2, off], [off, 0.8 + 0.15j * y + 0.05 * x]])


@pytest.mark.parametrize("kind", ["flux", "vector"])
@pytest.mark.parametrize("films", [False, True])
@pytest.mark.parametrize("answer", ["alike", "apart"])
def test_factors_on_nodes_are_those_of_every_pillar(kind, films, answer):
    """To the estimate, light from the side, through glass, and where pillars answer x
    and y apart; at 1e-6.
    """
    layers = Layers(behind=(Film(Index(1.52), 20.0),)) if films else None
    maps = lens()
    jones = (
        np.eye(2)[..., None, None] + np.zeros((2, 2, COUNT, COUNT))
        if answer == "alike"
        else uneven()
    )
    tensors = [
        torch.tensor(one, dtype=torch.complex128)[None]
        for one in (jones[0, 0], jones[1, 1], jones[0, 1])
    ]
    fields = None if answer == "alike" else among.NeighbourJonesFactors(*tensors)
    about = dict(
        pitch_um=PITCH,
        wavelength_um=WAVE,
        sensor_distance_um=DISTANCE,
        angle_rad=ANGLE,
        layers=layers,
        **SEEN,
    )
    phase = torch.tensor(
        maps[0], requires_grad=True
    )  # not by the exact sum, which has no derivatives
    got = psf.psf_stack(
        phase,
        torch.tensor(maps[1]),
        **about,
        tolerance=1e-6,
        integrate=False,
        polarisation=kind,
        neighbours=fields,
    )
    assert got.reason.startswith("windowed")
    want = plain(maps, jones, kind=kind, index=1.52 if films else 1.0, layers=layers)
    light = want / want.sum((1, 2), keepdims=True)
    error = np.linalg.norm(got.numpy().intensity - light) / np.linalg.norm(light)
    assert error <= got.error <= 1e-6
    assert got.numpy().energy_um2 == pytest.approx(want.sum((1, 2)) * 0.7**2, rel=1e-6)
    exact = psf.psf_stack(
        *maps,
        **about | dict(window_um=0.7, samples=1),
        polarisation=kind,
        neighbours=fields,
        integrate=False,
    )
    assert exact.reason.startswith("exact")


def test_what_pillars_let_through_is_their_power_and_over_the_cosine_of_rays():
    """By every pillar: t² of the flux, t² / cos θ of |E|²; of pillars apart half of |J|². Blocks of two: 1e-4."""
    maps, jones = lens(), uneven()
    case = propagate.make_case((COUNT, COUNT), pitch_um=PITCH, wavelength_um=WAVE, sensor_distance_um=DISTANCE,
                          angle_rad=ANGLE, **SEEN)  # fmt: skip
    y, x = case.pillars_um
    dx, dy = case.centre_um[0] - x, (case.centre_um[1] - y)[:, None]
    steep = np.sqrt(dx**2 + dy**2 + DISTANCE**2) / DISTANCE
    level = torch.tensor(maps[1])
    power = float((level**2).sum())
    assert PolarizationMixing(True).power(case, [power], level[None]) == pytest.approx(
        power, rel=1e-12
    )
    want = float((maps[1] ** 2 * steep).sum())
    assert PolarizationMixing(False).power(case, [power], level[None]) == pytest.approx(
        want, rel=1e-4
    )
    three = [
        np.abs(jones[i, j]) ** 2 * maps[1] ** 2 for i, j in ((0, 0), (1, 1), (0, 1))
    ]
    levels = torch.tensor(np.sqrt(np.array(three)))
    both = (np.abs(jones) ** 2).sum((0, 1)) * maps[1] ** 2 / 2
    powers = [float(one.sum()) for one in three]
    assert PolarizationMixing(True, apart=True).power(
        case, powers, levels
    ) == pytest.approx(both.sum(), rel=1e-12)
    assert PolarizationMixing(False, apart=True).power(
        case, powers, levels
    ) == pytest.approx((both * steep).sum(), rel=1e-4)


def test_a_wide_window_of_both_polarisations_is_the_sum_of_pillars():
    """By Fourier transforms; the factors at every pillar, exact sums at the brightest
    points and some by chance.
    """
    count = 320
    y, x = (np.indices((count, count)) - (count - 1) / 2) * PITCH
    phase = -2 * np.pi / WAVE * np.sqrt(x**2 + y**2 + 230.0**2)
    phase = np.angle(
        np.exp(1j * phase + 0.5j * np.random.default_rng(3).normal(size=phase.shape))
    )
    level = (np.hypot(x, y) < 65.0) * 1.0
    about = dict(
        pitch_um=PITCH,
        wavelength_um=WAVE,
        sensor_distance_um=230.0,
        angle_rad=(0.1, -0.05),
    )
    about |= dict(depths_um=[5e3], window_um=190.0, samples=230)
    stack = psf.psf_stack(
        phase, level, **about, tolerance=1e-4, integrate=False, polarisation="flux"
    )
    assert stack.reason.startswith("wide")
    case = propagate.make_case(phase.shape, **about)
    signs, factors = PolarizationMixing(True).pupils(case)(*case.pillars_um)
    rng, light = np.random.default_rng(5), stack.intensity[0].ravel()
    at = np.concatenate([np.argsort(light)[-40:], rng.integers(0, light.size, 20)])
    j, i = np.divmod(at, 230)
    where = np.stack(
        [
            stack.centres_um[0, 0] + stack.x_um[i],
            stack.centres_um[0, 1] + stack.y_um[j],
        ],
        -1,
    )
    fields = [
        propagate.field_at(phase, level * one[0], case, where)[0] for one in factors
    ]
    want = sum(
        sign * np.abs(field) ** 2 for sign, field in zip(signs, fields, strict=True)
    )
    got = light[at] * float(stack.energy_um2[0]) / stack.step_um**2
    assert np.linalg.norm(got - want) < 1e-4 * np.linalg.norm(want)
    assert stack.converged
