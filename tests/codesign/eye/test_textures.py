"""Textures as random fields whose spectrum falls by the power that was asked for."""

import numpy as np
import pytest

from codesign.eye import textures


@pytest.mark.parametrize(("power", "stretch"), [(1.4, 1.0), (0.8, 3.0)])
def test_spectrum_of_a_field_falls_by_its_power_and_is_stretched_along_y(
    power, stretch
):
    """Mean power of 60 fields of unit variance at places of the spectrum: ratios of
    frequency^-2p, each to 13 %.
    """
    rng = np.random.default_rng(1)
    shape = (48, 64)
    fields = [
        textures.periodic_noise(rng, power=power, stretch=stretch, shape=shape)
        for _ in range(240)
    ]
    assert all(
        abs(field.std() - 1) < 1e-12 and abs(field.mean()) < 1e-12 for field in fields
    )
    seen = np.mean([np.abs(np.fft.rfft2(field)) ** 2 for field in fields], axis=0)
    first = seen[0, 4]
    for row, column in ((0, 8), (4, 0), (8, 3), (-6, 5)):
        frequency = np.hypot(row * stretch, column)
        assert seen[row, column] / first == pytest.approx(
            (frequency / 4) ** (-2 * power), rel=0.35
        )  # 4 of sqrt(2 / 240)
