"""A picture of a lens: phase across the aperture, and a corner of it down to single pillars."""

from typing import Any

import numpy as np

from metalens.ground import report
from metalens.ground.arrays import Array
from metalens.lens.record import Lens

_PIXELS = 420  # along the longer side of the phase picture
_ZOOM = 28  # pillars along the side of the zoom


def picture(lens: Lens) -> bytes:
    """PNG: wrapped phase at the design wavelength (every n-th pillar), and single pillars halfway to the rim."""
    figure, (left, right) = report.canvas(1, 2, size=(9.6, 4.4))
    _phase(figure, left, lens)
    _pillars(figure, right, lens)
    return report.png(figure)


def _phase(figure: Any, axes: Any, lens: Lens) -> None:
    d = lens.diameters
    stride = max(1, -(-max(d.diameter_um.shape) // _PIXELS))
    part = d.diameter_um[::stride, ::stride]
    phase = np.where(part > 0, np.mod(_phase_of(lens, part), 2 * np.pi), np.nan)
    edge = d.x_um[0], d.x_um[-1], d.y_um[-1], d.y_um[0]
    shown = axes.imshow(phase, extent=edge, cmap="twilight", vmin=0, vmax=2 * np.pi, interpolation="nearest")
    figure.colorbar(shown, ax=axes, label="phase / rad", shrink=0.85)
    axes.set(title=f"{lens.profile} lens, {lens.wavelength_um * 1e3:.0f} nm", xlabel="x / µm", ylabel="y / µm")
    axes.grid(visible=False)


def _pillars(figure: Any, axes: Any, lens: Lens) -> None:
    from matplotlib.collections import EllipseCollection

    d = lens.diameters
    ny, nx = d.diameter_um.shape
    row, column = ny // 2 - _ZOOM // 2, min(nx * 3 // 4, max(nx - _ZOOM, 0))
    rows, columns = slice(max(row, 0), row + _ZOOM), slice(column, column + _ZOOM)
    part = d.diameter_um[rows, columns]
    x, y = np.meshgrid(d.x_um[columns], d.y_um[rows])
    there = part > 0
    size = part[there]
    sites = np.stack([x[there], y[there]], 1)
    shown = EllipseCollection(
        size, size, np.zeros(len(size)), offsets=sites, units="xy", transOffset=axes.transData, cmap="viridis"
    )
    shown.set_array(size * 1e3)
    axes.add_collection(shown)
    half = d.pitch_um / 2
    axes.set(xlim=(x.min() - half, x.max() + half), ylim=(y.max() + half, y.min() - half), aspect="equal")
    axes.set(title="single pillars", xlabel="x / µm", ylabel="y / µm")
    figure.colorbar(shown, ax=axes, label="diameter / nm", shrink=0.85)
    axes.grid(visible=False)


def _phase_of(lens: Lens, diameter_um: Array) -> Array:
    inside = np.where(diameter_um > 0, diameter_um, lens.proxy.domain_um[0])
    return np.asarray(lens.proxy.phase_rad(inside, lens.wavelength_um))
