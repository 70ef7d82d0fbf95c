"""The referee against closed forms and against a plain double loop; the angular
spectrum against the referee.
"""

import numpy as np
import pytest

from metalens import propagate
from metalens.core.errors import PropagationError

PITCH, WAVELENGTH, D = 0.4, 0.85, 60.0
K = 2 * np.pi / WAVELENGTH
GEOMETRY = dict(
    pitch_um=PITCH,
    wavelength_um=WAVELENGTH,
    sensor_distance_um=D,
    window_um=12.0,
    samples=5,
)


def test_one_pillar_is_a_spherical_wavelet():
    level = np.zeros((3, 3))
    level[1, 1] = 0.7
    field = propagate.exact(
        np.full((3, 3), 0.3), level, depths_um=[500.0, np.inf], **GEOMETRY
    )
    x = (np.arange(5) - 2) * 2.4
    r = np.sqrt(x**2 + x[:, None] ** 2 + D**2)
    want = (
        PITCH**2
        * 0.7
        * np.exp(0.3j)
        * D
        / (2 * np.pi * r**2)
        * (1 / r - 1j * K)
        * np.exp(1j * K * r)
    )
    # source phase is 0 at the lens centre
    assert abs(field - want).max() < 1e-13 * np.abs(want).max()


def test_sum_agrees_with_a_plain_loop_off_axis():
    random = np.random.default_rng(1)
    phase = random.uniform(-9, 9, (4, 7))
    level = random.uniform(0, 1, (4, 7))
    ax, ay, z = 0.3, -0.2, 900.0
    got = propagate.exact(phase, level, depths_um=z, angle_rad=(ax, ay), **GEOMETRY)
    source = np.array([-z * np.tan(ax), -z * np.tan(ay), -z])
    want = np.zeros((5, 5), complex)
    for b, a in np.ndindex(5, 5):
        X = np.array(
            [D * np.tan(ax) + (a - 2) * 2.4, D * np.tan(ay) + (b - 2) * 2.4, D]
        )
        for j, i in np.ndindex(4, 7):
            pillar = np.array([(i - 3) * PITCH, (j - 1.5) * PITCH, 0])
            s = np.linalg.norm(pillar - source)
            r = np.linalg.norm(X - pillar)
            light = level[j, i] * np.exp(
                1j * (phase[j, i] + K * (s - np.linalg.norm(source)))
            )
            want[b, a] += (
                PITCH**2
                * light
                * D
                / (2 * np.pi * r**2)
                * (1 / r - 1j * K)
                * np.exp(1j * K * r)
            )
    # rounding of paths of 1e4 rad: 1e-12
    assert abs(got[0] - want).max() < 1e-12 * np.abs(want).max()


def test_circular_aperture_has_the_closed_form_on_its_axis():
    """Plane wave, disc of radius R: U(0) = e^{ikd} - (d/s) e^{iks}, s = √(d² + R²)."""
    n, radius = 501, 20.0
    x = (np.arange(n) - 250) * 0.08
    level = (x**2 + x[:, None] ** 2 < radius**2).astype(float)
    geometry = GEOMETRY | dict(pitch_um=0.08, samples=1)
    got = propagate.exact(np.zeros((n, n)), level, depths_um=np.inf, **geometry)[
        0, 0, 0
    ]
    s = np.hypot(D, radius)
    want = np.exp(1j * K * D) - D / s * np.exp(1j * K * s)
    # the staircase rim: its mean radius is off by a few nm, k·R/s·3 nm = 7e-3
    assert abs(got - want) < 1e-2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(transmission=np.zeros((4, 4))), "empty aperture"),
        (dict(phase=np.full((4, 4), np.nan)), "row 0, column 0"),
        (dict(transmission=np.ones((4, 5))), "shape"),
        (dict(depths_um=-3.0), "depth"),
        (dict(depths_um=[]), "depth"),
        (dict(angle_rad=2.0), "angle_rad"),
        (dict(pitch_um=0.0), "pitch_um"),
        (dict(samples=0), "samples"),
        (dict(window_um=np.inf), "step_um"),
    ],
)
def test_bad_input_is_refused_with_its_place(change, words):
    maps = dict(phase=np.zeros((4, 4)), transmission=np.ones((4, 4)))
    arguments = (
        GEOMETRY
        | dict(depths_um=100.0)
        | {k: v for k, v in change.items() if k not in maps}
    )
    maps |= {k: v for k, v in change.items() if k in maps}
    with pytest.raises(PropagationError, match=words):
        propagate.exact(maps["phase"], maps["transmission"], **arguments)
