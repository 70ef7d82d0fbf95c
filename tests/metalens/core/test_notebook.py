"""What records show in a notebook: a line, a table, axes, an xarray data set."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from characterize.captures import Capture
from metalens import psf
from metalens.cell import Cell, Index
from metalens.lens import DiameterMap, Lens
from metalens.library import PillarLibrary, Sweep
from tests.proxies import proxy_of

CELL = Cell(0.4, pillar=Index(3.2))
SIZES = np.array([0.11, 0.14, 0.2])


def stack():
    x_um = (np.arange(60) - 29.5) * 0.5
    phase = -2 * np.pi / 0.85 * np.hypot(np.hypot(x_um, x_um[:, None]), 90.0)
    return psf.psf_stack(
        phase, np.ones_like(phase), pitch_um=0.5, wavelength_um=0.85,
        sensor_distance_um=90.0, depths_um=[4e3, np.inf], angle_rad=[[0.02, -0.01]],
        window_um=12.0, samples=32,
    )  # fmt: skip


def pillar_library():
    t = 0.9 * np.exp(1j * np.array([0.3, 2.9, 6.0])).reshape(1, 1, 1, 3)
    rest = np.full(t.shape, 1e-3)
    return PillarLibrary(
        CELL, Sweep(), ("x",), np.zeros(1), np.array([0.85]), SIZES, t, 0.1 * t, rest,
        rest, np.empty((0, 5)), "modal", 3,
    )  # fmt: skip


def lens():
    proxy = proxy_of([0.0, 6.5], [0.9], (0.1, 0.3), 0.85)
    sizes = DiameterMap(np.full((7, 9), 0.2), 0.4)
    return Lens(sizes, CELL, proxy, 0.85, 150.0, 1500.0, "map")


def capture():
    frames = np.arange(4 * 5 * 6).reshape(4, 5, 6) % 17
    places = np.array([12e3, 15e3, 18e3, 21e3])
    return Capture(
        frames, places, np.zeros((4, 2)), np.full(4, 0.01), tuple("abcd"), 12,
        pixel_um=3.45,
    )  # fmt: skip


@pytest.mark.parametrize("make", [stack, pillar_library, lens, capture])
def test_a_record_is_a_line_a_table_and_axes(make):
    record = make()
    line = repr(record)
    assert line.startswith(f"{type(record).__name__}(")
    assert "\n" not in line
    assert len(line) < 1500  # no array is written out
    table = record._repr_html_()
    assert table.count("<tr>") > 5
    axes = Figure().subplots()
    assert record.plot(axes) is axes
    assert axes.images or axes.lines
    assert "µm" in axes.get_xlabel() or "pixel" in axes.get_xlabel()


def test_data_sets_hold_the_values_at_their_coordinates():
    pytest.importorskip("xarray")
    made = stack()
    data = made.to_xarray()
    far = data.intensity.sel(depth_um=np.inf).isel(angle=0)
    assert float(far.sum()) == pytest.approx(1, abs=1e-5)
    # a plane wave at +x, -y has its image at the chief ray, the window's middle
    peak = far.argmax(dim=("y_um", "x_um"))
    assert abs(float(far.x_um[peak["x_um"]])) < 1.0
    assert data.angle_y_rad.values == pytest.approx([-0.01])
    table = pillar_library().to_xarray()
    assert complex(table.t.sel(diameter_um=0.14).squeeze()) == pytest.approx(
        0.9 * np.exp(2.9j)
    )
    shots = capture().to_xarray()
    frame = shots.frames[shots.position_um == 15e3][0]
    assert int(frame[2, 3]) == (30 + 2 * 6 + 3) % 17
