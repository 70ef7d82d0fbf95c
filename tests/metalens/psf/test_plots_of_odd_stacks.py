"""Pictures of stacks that are no squares, repeat a depth, or hold what is below 0 at
places.
"""

import dataclasses

import matplotlib.axes
import numpy as np
import pytest

from metalens.psf import plots, psf_stack

X, Y = (np.arange(n) - (n - 1) / 2 for n in (31, 24))
PHASE = (
    -2
    * np.pi
    / 0.85
    * (np.sqrt((0.4 * X) ** 2 + (0.4 * Y[:, None]) ** 2 + 900.0) - 30.0)
)


def stack(depths_um=(200.0, 400.0)):
    return psf_stack(
        PHASE,
        np.ones_like(PHASE),
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=30.0,
        depths_um=depths_um,
        window_um=(12.0, 5.0),
        samples=(24, 10),
        tolerance=1e-3,
    )


@pytest.fixture
def shown(monkeypatch):
    """(image, extent) of every picture that is drawn."""
    kept, draw = [], matplotlib.axes.Axes.imshow
    monkeypatch.setattr(
        matplotlib.axes.Axes,
        "imshow",
        lambda panel, image, **about: (
            kept.append((image, about["extent"])) or draw(panel, image, **about)
        ),
    )
    return kept


def test_the_montage_has_the_shape_of_the_window(shown):
    plots.plot_montage(stack())
    assert [image.shape for image, _ in shown] == [(10, 24), (10, 24)]
    assert shown[0][1] == pytest.approx((-6.0, 6.0, 2.5, -2.5))


def test_flux_below_0_is_drawn_as_none(shown):
    """Rays far off the axis may carry light back through the plane at places of no
    light.
    """
    made = stack()
    light = made.intensity.copy()
    light[0, 3, 7] = -1e-4 * light.max()
    plots.plot_montage(dataclasses.replace(made, intensity=light))
    assert shown[0][0][3, 7] == 0.0
    assert np.isfinite(shown[0][0]).all()


@pytest.mark.parametrize(
    ("depths_um", "told"),
    [
        ((200.0, 400.0), True),
        ((400.0, 200.0), True),
        ((200.0, 200.0, 400.0), False),
        ((200.0,), False),
    ],
)
def test_information_is_drawn_between_depths_that_differ(depths_um, told):
    assert ("information" in plots.psf_pictures(stack(depths_um))) == told
