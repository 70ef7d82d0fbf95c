"""The estimate of a stack is within the tolerance that was asked, or the stack says
what keeps it above.
"""

import numpy as np

from metalens import psf

ABOVE = "above the tolerance"


def drawn(rng):
    """(maps, arguments) of a small lens of any aperture: windows from the side, coarse,
    of sources of finite size.
    """
    count = int(rng.integers(60, 140))
    pitch = rng.uniform(0.25, 0.5)
    wave = rng.uniform(0.5, 1.1)
    half = count * pitch / 2
    distance = half * rng.uniform(1.5, 8)
    depths = half * 10 ** rng.uniform(1, 2, 2)
    y, x = (np.indices((count, count)) - (count - 1) / 2) * pitch
    path = np.sqrt(x**2 + y**2 + distance**2) + rng.normal(0, 0.05 * wave, x.shape)
    phase = np.remainder(-2 * np.pi / wave * path, 2 * np.pi)
    about = dict(
        pitch_um=pitch,
        wavelength_um=wave,
        sensor_distance_um=distance,
        depths_um=depths,
    )
    about |= dict(
        angle_rad=tuple(rng.uniform(-0.4, 0.4, 2)),
        window_um=half * rng.uniform(0.2, 1.0),
        samples=40,
    )
    about |= dict(
        offset_um=tuple(rng.uniform(-0.2, 0.2, 2) * half),
        polarisation=str(rng.choice(KINDS)),
    )
    if rng.random() < 0.1:
        about |= dict(
            source=psf.SourceExtent("disc", size_rad=rng.uniform(0.001, 0.02))
        )
    maps = (
        phase.astype("f4"),
        ((np.hypot(x, y) < half) * rng.uniform(0.5, 1, x.shape)).astype("f4"),
    )
    return maps, about | dict(tolerance=float(10 ** rng.uniform(-6.3, -2)))


KINDS = ("scalar", "flux", "vector")


def test_random_stacks_in_single_precision_keep_the_tolerance_or_say_why_not():
    rng, said = np.random.default_rng(31), 0
    for _ in range(24):
        maps, about = drawn(rng)
        made = psf.psf_stack(*maps, **about)
        assert made.converged != (ABOVE in made.reason), (made.error, about)
        said += ABOVE in made.reason
        if "source" not in about:
            assert made.converged
    assert 0 < said < 8  # sources of finite size: their own points are unlike


def test_single_precision_says_what_it_cannot_hold():
    maps, about = drawn(np.random.default_rng(8))
    about = {k: v for k, v in about.items() if k != "source"} | dict(
        polarisation="scalar", tolerance=1e-8
    )
    made = psf.psf_stack(*maps, **about)
    assert "float32 holds 1.2e-07, give float64 maps" in made.reason
    assert made.error < 3e-7
    double = psf.psf_stack(*(m.astype(float) for m in maps), **about)
    assert double.converged
    assert ABOVE not in double.reason
