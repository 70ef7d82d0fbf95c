"""Films of air are no films, and a focus check passes up to a quarter of what it may
miss.
"""

import dataclasses

import numpy as np
import pytest

from metalens.cell import Film, Index
from metalens.design.focus_check import FocusCheck
from metalens.design.profiles import Focus
from metalens.lens import Layers


@pytest.mark.parametrize("source_um", [17e3, np.inf])
@pytest.mark.parametrize("tangent", [0.0, 0.21, -0.34])
def test_paths_through_films_of_air_are_paths_through_air(tangent, source_um):
    """Rays by Snell's law through a stack against distances in closed form, to either
    side of the axis.
    """
    random = np.random.default_rng(2)
    x, y = random.uniform(-400, 400, (2, 40))
    plain = Focus(0.85, 2100.0, source_um)
    filled = dataclasses.replace(
        plain,
        layers=Layers(
            front=(Film(Index(1.0), 310.0),), behind=(Film(Index(1.0), 770.0),)
        ),
    )
    assert not filled.layers.plain
    for one, other in zip(
        filled.paths_from(x, y, tangent), plain.paths_from(x, y, tangent), strict=True
    ):
        np.testing.assert_allclose(
            one, other, atol=2e-9
        )  # um: Newton's steps of the ray end at 1e-12 of 2 mm


@pytest.mark.parametrize(
    ("x_um", "y_um", "z_um", "strehl", "passed"),
    [
        (0.24, -0.24, -1.9, 0.81, True), (0.26, 0.0, 0.0, 0.95, False), (0.0, -0.26, 0.0, 0.95, False),
        (0.0, 0.0, 2.1, 0.95, False), (0.0, 0.0, -2.1, 0.95, False), (0.0, 0.0, 0.0, 0.79, False),
        (0.1, 0.1, float("nan"), 0.9, True),
    ],
)  # fmt: skip
def test_a_focus_passes_within_a_quarter_of_resolution_and_depth(
    x_um, y_um, z_um, strehl, passed
):
    found = FocusCheck(x_um, y_um, z_um, strehl, resolution_um=1.0, depth_um=8.0)
    assert found.passed is passed
    assert ("BUT DIM" in found.text) is (
        strehl < 0.8
    )  # the one that fails by its light alone
    assert ("NO FOCUS" in found.text) is (not passed and strehl >= 0.8)


def test_a_peak_at_the_end_of_the_search_is_told_to_lie_there_or_farther():
    """Half a depth of focus to either side is looked at."""
    about = {"strehl": 0.5, "resolution_um": 1.0, "depth_um": 90.0}
    assert (
        "+45.00 um or farther from the sensor plane"
        in FocusCheck(0.0, 0.0, 45.0, **about).text
    )
    assert "-45.00 um or farther" in FocusCheck(0.0, 0.0, -45.0, **about).text
    assert "+44.00 um from the sensor plane" in FocusCheck(0.0, 0.0, 44.0, **about).text
