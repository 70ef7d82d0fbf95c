"""Line images and transfer functions: against squared plane-wave fields, the sum over
pillars, and a closed form.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.aberrations.waves import _directions, line_mtf, plane_waves_of_source
from metalens.cell import Lattice
from metalens.lens import DiameterMap
from metalens.psf import View, from_lens, passed_um2
from tests.metalens.aberrations.hyperbolic import CASES, PITCH, WAVE, made

PER_UM = np.array([0.031, 0.077, 0.19, 0.33])
K = 2 * math.pi / WAVE


def _squared(case, angle, sensor_um, frequencies):
    """Own plane waves on a lattice three times as wide, squared in space: (2,
    frequencies) MTF of all light; in air, without a stop.
    """
    rays, depth = CASES[case]
    lens = made(case)
    phase = lens.phase_rad()
    level = (lens.diameters.diameter_um > 0).astype(float)
    place, n = lens.diameters.x_um, 3 * len(lens.diameters.x_um)
    x, y = np.meshgrid(place, place)
    if math.isinf(depth):
        come = x * math.sin(math.radians(angle))
    else:
        sx, sy = rays.source(angle, depth)
        come = np.sqrt((x - sx) ** 2 + (y - sy) ** 2 + depth**2)
    f = np.fft.fftfreq(n, PITCH)
    along = WAVE**-2 - f**2 - f[:, None] ** 2
    goes = np.exp(2j * np.pi * sensor_um * np.sqrt(np.maximum(along, 0.0))) * (
        along > 0
    )
    light = (
        np.abs(
            np.fft.ifft2(
                np.fft.fft2(level * np.exp(1j * (phase + K * come)), (n, n)) * goes
            )
        )
        ** 2
    )
    lines = light.sum(0), light.sum(1)
    at = np.arange(n) * PITCH
    mtf = [
        [abs(line @ np.exp(-2j * np.pi * v * at)) / level.sum() for v in frequencies]
        for line in lines
    ]
    return np.array(mtf)


@pytest.mark.parametrize(
    ("case", "angle"), [("plain", 0.0), ("plain", 14.0), ("off-centre", -9.0)]
)
@pytest.mark.parametrize("sensor_um", [310.0, 287.0])
def test_transfer_is_that_of_the_squared_field(case, angle, sensor_um):
    """Frequencies off the lattice of either; what is left is light that zone borders
    scatter: beyond the rays it is no
    detail here, and comes back over the lattice's ends there."""
    light = plane_waves_of_source(
        made(case), (math.radians(angle), 0.0), CASES[case][1]
    )
    here = light.at(sensor_um)
    want = _squared(case, angle, sensor_um, PER_UM)
    for axis in (0, 1):
        assert line_mtf(light, here, axis, PER_UM) == pytest.approx(
            want[axis], abs=3e-3
        )
    assert 0.97 < light.held < 1.0


@pytest.mark.parametrize(("case", "angle"), [("stop", -13.0), ("all", 11.0)])
def test_transfer_is_that_of_the_sum_over_pillars(case, angle):
    """PSFs in a window of 150 um, by rays from each pillar through the films; what lies
    outside is said by energies.
    """
    rays, depth = CASES[case]
    lens, angles = made(case), (math.radians(angle), 0.0)
    sensor = {"stop": 310.0, "all": 395.0}[
        case
    ]  # near the focus: what lies outside the window is little
    lens = type(lens)(
        lens.diameters,
        lens.cell,
        lens.proxy,
        WAVE,
        sensor,
        rays.depth_um,
        "map",
        layers=lens.layers,
    )
    light = plane_waves_of_source(lens, angles, depth)
    here = light.at(sensor)
    stack = from_lens(lens, View((depth,), (angles,), 150.0, 225), tolerance=1e-4)
    held = float(stack.energy_um2[0, 0] / passed_um2(lens, angles, (depth,))[0])
    for axis, line in enumerate(
        (stack.intensity[0, 0].sum(0), stack.intensity[0, 0].sum(1))
    ):
        place = (np.arange(225) - 112) * 150.0 / 225
        want = [held * abs(line @ np.exp(-2j * np.pi * v * place)) for v in PER_UM]
        assert line_mtf(light, here, axis, PER_UM) == pytest.approx(want, abs=1e-3)


def test_an_even_round_pupil_has_the_transfer_function_of_the_books():
    """(2/π)(arccos s - s √(1 - s²)), s = ν λ / 2 NA, of all the light that is not
    scattered by zone borders (0.8 %);
    rays of this lens are even over directions to NA²/2 = 0.02 at the rim, most of which
    the edge of s² has."""
    light = plane_waves_of_source(made("plain"), (0.0, 0.0), math.inf)
    share = np.array([0.07, 0.21, 0.4, 0.66, 0.9])
    sine = 62.0 / math.hypot(62.0, 310.0)
    want = 2 / math.pi * (np.arccos(share) - share * np.sqrt(1 - share**2))
    found = line_mtf(light, light.at(310.0), 0, share * 2 * sine / WAVE)
    assert found == pytest.approx(want, abs=0.015)
    assert (
        float(
            line_mtf(light, light.at(310.0), 1, np.array([1.04 * 2 * sine / WAVE]))[0]
        )
        < 0.01
    )


@pytest.mark.parametrize(
    ("lattice", "rows", "hop", "first"),
    [
        (Lattice(), 5, 1, [0, 1, 2, 3]),
        (Lattice("hexagonal"), 5, 2, [0, 1, 2]),
        (Lattice(), 1, 1, [0]),
        (Lattice(), 191, 1, None),
    ],
)
def test_directions_of_light_are_slopes_between_rows_and_pillars_that_are_there(
    lattice, rows, hop, first
):
    """A plane wave: one direction along each axis; 48 rows from the first to the last
    that has one beyond it.
    """
    asked, slopes = [], (0.21, -0.34)
    odd = (
        np.arange(rows)[:, None] + np.arange(70)
    ) % 2  # where a centred lattice has no site
    d = DiameterMap(np.where(odd & lattice.centred, 0.0, 0.2), 0.4, lattice)
    dx, dy = d.steps_um

    def lit(some):
        asked.append(some.tolist())
        return np.exp(
            2j
            * np.pi
            / WAVE
            * (slopes[0] * dx * np.arange(70) + slopes[1] * dy * some[:, None])
        )

    low, high = _directions(SimpleNamespace(diameters=d, wavelength_um=WAVE), lit)
    want = slopes if rows > 1 else (slopes[0], 0.0)  # one row has none beside it
    assert low == pytest.approx(want, abs=1e-9)
    assert high == pytest.approx(want, abs=1e-9)
    near, far = asked
    assert far == [min(row + hop, rows - 1) for row in near]
    assert (
        near == first if first else (len(near), near[0], near[-1]) == (48, 0, rows - 2)
    )
