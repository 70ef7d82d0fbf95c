"""Windows that are not cut about the chief ray of their field angle: refused by name,
and no lens is bent for them.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.inference import estimate
from characterize.inference.estimate import FitOptions
from metalens.core.errors import FitRefused

DEGREES, DEPTHS = (0.0, 6.0), (420.0, 600.0, 900.0)


def captured(aside_um):
    """Frames of the hidden lens at both angles, those of the second with windows (x, y)
    off its chief ray.
    """
    moved = dict(zip(("decentre_x_um", "decentre_y_um"), aside_um, strict=True))
    light = []
    for angle, off in zip(
        DEGREES,
        ({}, {name: b.VALUES[name] + um for name, um in moved.items()}),
        strict=True,
    ):
        hidden = dataclasses.replace(
            b.truth(**off), depths_um=DEPTHS, angles_deg=(angle,)
        )
        light.append(bench.bench_irradiance(b.lens(8.0), hidden, b.RESPONSE))
    bright = [
        one * (6000.0 / np.max(light)) + bench.background_plane(b.truth())
        for one in light
    ]
    shots = b.capture(b.electrons(strength_rad=8.0))
    n = len(DEPTHS)
    return dataclasses.replace(
        shots,
        frames=np.concatenate(
            [b.counts(one, seed=seed) for seed, one in enumerate(bright, 11)]
        ),
        position_um=np.tile(DEPTHS, 2),
        angle_rad=np.radians(np.column_stack([np.repeat(DEGREES, n), np.zeros(2 * n)])),
        exposure_s=np.full(2 * n, np.nan),
        names=tuple(f"frame {i}" for i in range(2 * n)),
    )


@pytest.mark.slow
def test_a_window_half_a_pixel_off_at_one_angle_is_refused_by_name():
    """0.8 um along x and 0.5 um against y, of pixels of 1.5 um; 6000 electrons tell
    0.02 um.
    """
    with pytest.raises(
        FitRefused,
        match="a window off the chief ray at a field angle explains what is left",
    ):
        estimate.fit(
            captured((0.8, -0.5)),
            b.lens(8.0),
            FitOptions(scan_um=60.0),
            response=b.RESPONSE,
        )


@pytest.mark.slow
def test_windows_about_their_chief_rays_are_fitted():
    found = estimate.fit(
        captured((0.0, 0.0)), b.lens(8.0), FitOptions(scan_um=60.0), response=b.RESPONSE
    )
    assert found.trusted
    assert any(
        "window off" in cause for cause in found.causes
    )  # of 0.3 px, where nobody states it
    for name in ("decentre_x_um", "distance_um", "coma_x_rad"):
        low, high = found.interval(name)
        assert low < b.VALUES[name] < high, name
