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
    """PNG of the wrapped phase at the design wavelength, and of single pillars halfway
    to the rim.

    A pixel has the phase of the mean of exp(iφ) over its sites and fades where the
    phase turns within it, so that undersampling draws no false zones.

    Args:
        lens: the lens.
    """
    figure, (left, right) = report.make_figure(1, 2, size=(9.6, 4.4))
    _phase(figure, left, lens)
    _pillars(figure, right, lens)
    return report.figure_png(figure)


def _phase(figure: Any, axes: Any, lens: Lens) -> None:
    """Draw the wrapped phase, and the aperture stop where there is one."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Circle

    d = lens.diameters
    # a hexagonal lattice leaves every other site of the map empty
    least = 2 if d.lattice.centred else 1
    field = mean_field(lens, max(least, -(-max(d.diameter_um.shape) // 420)))
    colour = colormaps["twilight"](np.mod(np.angle(field), 2 * np.pi) / (2 * np.pi))
    colour[..., 3] = np.minimum(1, np.abs(field))
    extent_um = d.x_um[0], d.x_um[-1], d.y_um[-1], d.y_um[0]
    axes.imshow(colour, extent=extent_um, interpolation="nearest")
    if stop := lens.layers.stop:
        stop_circle = Circle(
            stop.centre_um, stop.radius_um, fill=False, color="k", linestyle="--"
        )
        axes.add_patch(stop_circle)
        axes.legend(
            [stop_circle],
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
    """(y, x) complex mean of exp(iφ) over blocks of ``sites`` by ``sites``; sites
    without a pillar count as 0.

    Incomplete blocks at the end are filled with 0. Rows are read in bands: a large lens
    stays in its file.

    Args:
        lens: the lens.
        sites: side of a block.
    """
    d = lens.diameters.diameter_um
    centred = lens.diameters.lattice.centred
    height, width = (-(-n // sites) for n in d.shape)
    mean = np.empty((height, width), complex)
    for i in range(height):
        band = slice(i * sites, min((i + 1) * sites, d.shape[0]))
        rows = np.asarray(d[band])
        field = np.zeros((sites, width * sites), complex)
        phasor = np.where(rows > 0, np.exp(1j * lens.phase_rad(rows=band)), 0)
        field[: len(rows), : rows.shape[1]] = phasor * (2 if centred else 1)
        mean[i] = field.reshape(sites, width, sites).mean(axis=(0, 2))
    return mean


def _pillars(figure: Any, axes: Any, lens: Lens) -> None:
    """Draw 28 by 28 pillars halfway to the rim, coloured by size or turn."""
    from matplotlib.collections import PolyCollection

    d = lens.diameters
    ny, nx = d.diameter_um.shape
    side = 28  # pillars along the side of the picture
    row = ny // 2 - side // 2
    column = min(nx * 3 // 4, max(nx - side, 0))
    rows = slice(max(row, 0), row + side)
    columns = slice(column, column + side)
    x, y = np.meshgrid(d.x_um[columns], d.y_um[rows])
    has_pillar = d.diameter_um[rows, columns] > 0
    size, length, turn = (
        np.zeros(np.count_nonzero(has_pillar))
        if values is None
        else values[rows, columns][has_pillar]
        for values in (d.diameter_um, d.length_um, d.angle_rad)
    )
    outlines = []
    pillars = np.column_stack([size, length, turn, x[has_pillar], y[has_pillar]])
    for along_x, along_y, turn_rad, *place_um in pillars.tolist():
        cell = cell_of_sizes(lens.cell, along_x, along_y) if along_y else lens.cell
        corners = rotate_corners(cell.outline(along_x).line(32), turn_rad)
        outlines.append(corners + place_um)
    collection = PolyCollection(outlines, cmap="viridis")
    collection.set_array(size * 1e3 if d.angle_rad is None else np.degrees(turn))
    axes.add_collection(collection)
    half = d.pitch_um / 2
    axes.set(
        xlim=(x.min() - half, x.max() + half),
        ylim=(y.max() + half, y.min() - half),
        aspect="equal",
    )
    axes.set(title="single pillars", xlabel="x / µm", ylabel="y / µm")
    label = "size along x / nm" if d.angle_rad is None else "turn / deg"
    figure.colorbar(collection, ax=axes, label=label, shrink=0.85)
    axes.grid(visible=False)
