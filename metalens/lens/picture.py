"""A picture of a lens: the phase across its aperture."""

from typing import Any

import numpy as np

from metalens.core import report
from metalens.core.arrays import Array


def lens_picture(lens: Any) -> bytes:
    """PNG of :func:`draw_phase`.

    Args:
        lens: the lens.
    """
    figure, axes = report.make_figure(1, 1, size=(5.2, 4.4))
    draw_phase(lens, axes)
    return report.figure_png(figure)


def draw_phase(lens: Any, axes: Any) -> None:
    """Draw the wrapped phase at the design wavelength, and the aperture stop.

    A pixel has the phase of the mean of exp(iφ) over its sites and fades where the
    phase turns within it, so that undersampling draws no false zones.

    Args:
        lens: the lens.
        axes: matplotlib axes.
    """
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
    axes.figure.colorbar(
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


def mean_field(lens: Any, sites: int) -> Array:
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
