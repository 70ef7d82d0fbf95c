"""A picture of a lens: phase across the aperture, and a corner of it down to single
pillars.
"""

from typing import Any

import numpy as np

from metalens.cell.shapes import rotate_corners
from metalens.core import report
from metalens.core.arrays import Array
from metalens.lens.record import Lens
from metalens.library.axes import cell_of_sizes


def lens_picture(lens: Lens) -> bytes:
    """PNG: wrapped phase at the design wavelength, and single pillars halfway to the rim.

    A pixel has the phase of the mean of exp(iφ) over its sites and fades where the
    phase turns within it, so that no lenses appear that are none.

    Args:
        lens: the lens.
    """
    figure, (left, right) = report.make_figure(1, 2, size=(9.6, 4.4))
    _phase(figure, left, lens)
    _pillars(figure, right, lens)
    return report.figure_png(figure)


def _phase(figure: Any, axes: Any, lens: Lens) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Circle

    d = lens.diameters
    least = (
        2 if d.lattice.centred else 1
    )  # every other site of the map is none of the lattice
    field = mean_field(lens, max(least, -(-max(d.diameter_um.shape) // 420)))
    colour = colormaps["twilight"](np.mod(np.angle(field), 2 * np.pi) / (2 * np.pi))
    colour[..., 3] = np.minimum(1, np.abs(field))
    edge = d.x_um[0], d.x_um[-1], d.y_um[-1], d.y_um[0]
    axes.imshow(colour, extent=edge, interpolation="nearest")
    if stop := lens.layers.stop:
        hole = Circle(
            stop.centre_um, stop.radius_um, fill=False, color="k", linestyle="--"
        )
        axes.add_patch(hole)
        axes.legend(
            [hole],
            [f"aperture stop, {stop.distance_um:g} µm before"],
            loc="upper right",
        )
    scale = ScalarMappable(Normalize(0, 2 * np.pi), "twilight")
    figure.colorbar(
        scale,
        ax=axes,
        label="phase / rad, faded where it turns in a pixel",
        shrink=0.85,
    )
    axes.set(
        title=f"{lens.profile} lens, {lens.wavelength_um * 1e3:.0f} nm",
        xlabel="x / µm",
        ylabel="y / µm",
    )
    axes.grid(visible=False)


def mean_field(lens: Lens, sites: int) -> Array:
    """Mean of exp(iφ) over blocks of ``sites`` by ``sites``, 0 where there is no
    pillar; complex (y, x), blocks whole.

    Read in bands of rows: a large lens stays in its file.
    """
    d = lens.diameters.diameter_um
    centred = lens.diameters.lattice.centred
    height, width = (-(-n // sites) for n in d.shape)
    mean = np.empty((height, width), complex)
    for i in range(height):
        at = slice(i * sites, min((i + 1) * sites, d.shape[0]))
        rows = np.asarray(d[at])
        field = np.zeros((sites, width * sites), complex)
        there = np.where(rows > 0, np.exp(1j * lens.rows_phase_rad(at)), 0)
        field[: len(rows), : rows.shape[1]] = there * (2 if centred else 1)
        mean[i] = field.reshape(sites, width, sites).mean(axis=(0, 2))
    return mean


def _pillars(figure: Any, axes: Any, lens: Lens) -> None:
    from matplotlib.collections import PolyCollection

    d = lens.diameters
    ny, nx = d.diameter_um.shape
    side = 28  # pillars along the side of the picture
    row = ny // 2 - side // 2
    column = min(nx * 3 // 4, max(nx - side, 0))
    rows = slice(max(row, 0), row + side)
    columns = slice(column, column + side)
    part = d.diameter_um[rows, columns]
    x, y = np.meshgrid(d.x_um[columns], d.y_um[rows])
    there = part > 0
    size = part[there]
    turn = (
        np.zeros(len(size))
        if d.angle_rad is None
        else d.angle_rad[rows, columns][there]
    )
    length = (
        np.zeros(len(size))
        if d.length_um is None
        else d.length_um[rows, columns][there]
    )
    drawn = [
        _outline(lens, *one)
        for one in zip(size, length, turn, x[there], y[there], strict=True)
    ]
    shown = PolyCollection(drawn, cmap="viridis")
    shown.set_array(size * 1e3 if d.angle_rad is None else np.degrees(turn))
    axes.add_collection(shown)
    half = d.pitch_um / 2
    axes.set(
        xlim=(x.min() - half, x.max() + half),
        ylim=(y.max() + half, y.min() - half),
        aspect="equal",
    )
    axes.set(title="single pillars", xlabel="x / µm", ylabel="y / µm")
    size_name = "size / nm" if d.length_um is None else "size along x / nm"
    figure.colorbar(
        shown,
        ax=axes,
        label=size_name if d.angle_rad is None else "turn / deg",
        shrink=0.85,
    )
    axes.grid(visible=False)


def _outline(
    lens: Lens,
    size_um: float,
    length_um: float,
    turn_rad: float,
    x_um: float,
    y_um: float,
) -> Array:
    """(n, 2) corners of one pillar where it stands."""
    cell = (
        cell_of_sizes(lens.cell, float(size_um), float(length_um))
        if length_um
        else lens.cell
    )
    corners = cell.outline(float(size_um)).line(32)
    placed: Array = rotate_corners(corners, float(turn_rad)) + np.array([x_um, y_um])
    return placed
