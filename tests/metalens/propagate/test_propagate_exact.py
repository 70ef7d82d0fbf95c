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
    assert (
        np.abs(field - want).max() < 1e-13 * np.abs(want).max()
    )  # source phase is 0 at the lens centre


def test_sum_agrees_with_a_plain_loop_off_axis():
    random = np.random.default_rng(1)
    phase, level = random.uniform(-9, 9, (4, 7)), random.uniform(0, 1, (4, 7))
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
            s, r = np.linalg.norm(pillar - source), np.linalg.norm(X - pillar)
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
    assert (
        np.abs(got[0] - want).max() < 1e-12 * np.abs(want).max()
    )  # rounding of paths of 1e4 rad: 1e-12


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
    assert (
        abs(got - want) < 1e-2
    )  # the staircase rim: its mean radius is off by a few nm, k·R/s·3 nm = 7e-3


def test_angular_spectrum_nears_the_sum_as_padding_grows():
    random = np.random.default_rng(2)
    x = (np.arange(64) - 31.5) * PITCH
    r2 = x**2 + x[:, None] ** 2
    phase = -K * (np.sqrt(r2 + D**2) - D) + 0.2 * random.normal(size=r2.shape)
    level = np.exp(-r2 / 60)
    geometry = GEOMETRY | dict(depths_um=np.inf, window_um=8 * PITCH, samples=8)
    want = np.abs(propagate.exact(phase, level, **geometry)) ** 2
    errors = []
    for pad in (2, 4, 8):
        got = np.abs(propagate.angular_spectrum(phase, level, pad=pad, **geometry)) ** 2
        errors.append(np.linalg.norm(got - want) / np.linalg.norm(want))
    assert errors[0] > errors[2]
    assert (
        errors[2] < 3e-3
    )  # left: light of the noise beyond the lattice's own frequencies
    limited = (
        np.abs(propagate.angular_spectrum(phase, level, band_limited=True, **geometry))
        ** 2
    )
    assert np.linalg.norm(limited - want) < 2e-2 * np.linalg.norm(want)


@pytest.mark.parametrize("limited", [False, True])
def test_angular_spectrum_is_the_sum_over_the_frequencies_of_the_padded_grid(limited):
    """U(X, Y) = Σ_j Σ_f t_j exp(2πi f (X - x_j) + i k_z d) / N, summed as it stands: no
    transform, no indices.

    9 rows of 0.3 um and 6 columns of 0.45 um, thrice as many with the padding;
    frequencies beyond 1 / wavelength
    decay, and with a limit those go that turn by more than half a turn from one
    frequency to the next. The window lies
    off the middle, 4 steps of 0.9 um by 3, of two columns and of three rows; the chief
    ray meets the sensor 3 columns
    to the right and 2 rows up.
    """
    random = np.random.default_rng(3)
    phase, level = random.uniform(-9, 9, (9, 6)), random.uniform(0, 1, (9, 6))
    step, d, depths, pad = (0.3, 0.45), 2.6, [21.0, 900.0], 3
    tangents = 3 * step[1] / d, -2 * step[0] / d
    got = propagate.angular_spectrum(
        phase, level, pad=pad, band_limited=limited, wavelength_um=WAVELENGTH, sensor_distance_um=d, pitch_um=step[1],
        row_um=step[0], depths_um=depths, angle_rad=tuple(np.arctan(tangents)), window_um=(3.6, 2.7),
        samples=(4, 3), offset_um=(-1.5 * step[1], 1.0 * step[0]),
    )  # fmt: skip
    y, x = ((np.arange(n) - (n - 1) / 2) * s for n, s in zip((9, 6), step, strict=True))
    X, Y = (
        (1.5 + 2 * (np.arange(4) - 1.5)) * step[1],
        (-1 + 3 * (np.arange(3) - 1)) * step[0],
    )
    fy, fx = (
        np.arange(-(n * pad // 2), (n * pad + 1) // 2) / (n * pad * s)
        for n, s in zip((9, 6), step, strict=True)
    )
    assert (len(fy), len(fx)) == (27, 18)
    kz = 2 * np.pi * np.emath.sqrt(WAVELENGTH**-2 - fx**2 - fy[:, None] ** 2)
    h = np.exp(1j * kz * d)
    # the slope of k_z d, 2 pi d f / sqrt(1 / wavelength² - f²), below half the padded
    # width
    if limited:
        kept = [
            d * np.abs(f) / np.sqrt(np.maximum(WAVELENGTH**-2 - f**2, 1e-9))
            <= n * pad * s / 2
            for f, n, s in zip((fy, fx), (9, 6), step, strict=True)
        ]
        h = h * kept[0][:, None] * kept[1]
        assert 0 < kept[0].sum() < 27
        assert 0 < kept[1].sum() < 18
    for light, z in zip(got, depths, strict=True):
        source = np.array([-z * tangents[0], -z * tangents[1], -z])
        r = np.sqrt((x - source[0]) ** 2 + (y[:, None] - source[1]) ** 2 + z**2)
        leaving = level * np.exp(1j * (phase + K * (r - np.linalg.norm(source))))
        ahead = [
            np.exp(2j * np.pi * np.outer(f, at))
            for f, at in ((fy, y), (fx, x), (fy, Y), (fx, X))
        ]
        want = (
            ahead[2].T
            @ (h * (ahead[0].conj() @ leaving @ ahead[1].conj().T))
            @ ahead[3]
            / (27 * 18)
        )
        assert np.abs(light - want).max() < 1e-11 * np.abs(want).max()  # rounding


def test_evanescent_cut_off_exactly_hit_gives_finite_light():
    geometry = GEOMETRY | dict(
        pitch_um=0.425, window_um=4 * 0.425, samples=4
    )  # 1/(2p) is 1/λ: cut-off on the grid
    field = propagate.angular_spectrum(
        np.zeros((8, 8)), np.ones((8, 8)), depths_um=np.inf, **geometry
    )
    assert np.isfinite(field).all()
    assert np.abs(field).min() > 0


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
