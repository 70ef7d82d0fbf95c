"""Pictures of a PSF stack: slice along depth, montage over depth and angle, MTF and
encircled energy, I(z).
"""

from typing import TYPE_CHECKING

import numpy as np

from metalens.core.arrays import Array
from metalens.core.report import figure_png, make_figure
from metalens.psf import metrics as psf_metrics
from metalens.psf.metrics import DiffractionLimit
from metalens.psf.record import PsfStack

if TYPE_CHECKING:
    from metalens.psf.z_scan import FocusScan


def psf_pictures(
    stack: PsfStack,
    *,
    limit: DiffractionLimit | None = None,
    scan: "FocusScan | None" = None,
) -> dict[str, bytes]:
    """{name: PNG}: ``montage`` and ``mtf``; ``xz`` of two depths or more; ``zscan`` of a
    scan.

    limit: of the aperture, for the ideal MTF and its cut-off.

    Args:
        stack: PSFs over angle, depth and wavelength.
    """
    plain = stack.numpy()
    pictures = {"montage": plot_montage(plain), "mtf": plot_mtf(plain, limit=limit)}
    if scan is not None:
        pictures["zscan"] = plot_focus_scan(scan)
    if len(plain.depths_um) > 1:
        pictures["xz"] = plot_slices(plain)
    return pictures


def _by_angle(stack: PsfStack) -> Array:
    """(angle, depth, y, x) whether or not the stack has an angle axis."""
    return np.asarray(stack.intensity).reshape(
        len(stack.angles_rad), *np.shape(stack.intensity)[-3:]
    )


def _angle_name(angle: Array) -> str:
    x, y = np.rad2deg(angle)
    return f"{x:.3g}°" if abs(y) < 1e-9 else f"({x:.3g}°, {y:.3g}°)"


def _picked(count: int, most: int) -> Array:
    """At most so many of count indices, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _depth_name(depth_um: float) -> str:
    return "∞" if np.isinf(depth_um) else f"{depth_um * 1e-3:.3g} mm"


def plot_slices(stack: PsfStack) -> bytes:
    """x against depth through the centre row, one panel an angle, brightest value of
    each depth at full scale.

    Args:
        stack: PSFs over angle, depth and wavelength.
    """
    light, depths = _by_angle(stack), stack.depths_um
    order = np.argsort(depths)
    figure, axes = make_figure(
        1, len(light), size=(2.2 + 2.6 * len(light), 3.4), squeeze=False, sharey=True
    )
    for panel, psf, angle in zip(axes[0], light, stack.angles_rad, strict=True):
        rows = psf[order, psf.shape[1] // 2]
        image = rows / rows.max(1, keepdims=True)
        panel.pcolormesh(
            stack.x_um,
            np.arange(len(depths)),
            image,
            shading="nearest",
            rasterized=True,
        )
        panel.set(title=_angle_name(angle), xlabel="x from the window's middle / µm")
        panel.grid(False)
    picks = _picked(len(depths), 6)
    axes[0, 0].set_yticks(picks, [_depth_name(depths[order][i]) for i in picks])
    axes[0, 0].set_ylabel("source depth")
    figure.suptitle("PSF along depth (each depth at its own full scale)", fontsize=10)
    return figure_png(figure)


def plot_montage(stack: PsfStack, *, most: int = 7) -> bytes:
    """PSFs over depth (across) and angle (down), square root of intensity, each at its
    own full scale.

    Args:
        stack: PSFs over angle, depth and wavelength. most: depths that are drawn.
    """
    light = _by_angle(stack)
    picks = _picked(len(stack.depths_um), most)
    size = (1.3 * len(picks) + 0.7, 1.35 * len(light) + 0.6)
    figure, axes = make_figure(len(light), len(picks), size=size, squeeze=False)
    across, down = (stack.step_um * n / 2 for n in light.shape[:-3:-1])
    for row, (psfs, angle) in enumerate(zip(light, stack.angles_rad, strict=True)):
        for column, i in enumerate(picks):
            panel = axes[row, column]
            shown = np.sqrt(
                np.maximum(psfs[i], 0)
            )  # the flux of steep rays is below 0 at places
            panel.imshow(shown, extent=(-across, across, down, -down), vmin=0)
            panel.set(xticks=[], yticks=[])
            panel.grid(False)
            if row == 0:
                panel.set_title(_depth_name(stack.depths_um[i]))
        axes[row, 0].set_ylabel(_angle_name(angle))
    figure.suptitle(
        f"√PSF over depth and field angle, {2 * across:.3g} x {2 * down:.3g} µm, +x right, +y down",
        fontsize=10,
    )
    return figure_png(figure)


def plot_mtf(stack: PsfStack, *, limit: DiffractionLimit | None = None) -> bytes:
    """MTF along x and y up to its cut-off (where samples show it), and encircled
    energy, of three depths at the first and last angle.

    Args:
        stack: PSFs over angle, depth and wavelength. limit: drawn beside them.
    """
    depths = np.unique([0, len(stack.depths_um) // 2, len(stack.depths_um) - 1])
    cut = 0.5 / stack.step_um
    if limit is not None:
        cut = min(cut, limit.cutoff_per_um)
    frequency = np.linspace(0, cut, 81)
    radius = np.linspace(0, stack.step_um * len(stack.x_um) / 2, 61)
    curves = psf_metrics.mtf(stack, frequencies_per_um=frequency)
    angles = sorted({0, len(stack.angles_rad) - 1})
    curves = curves.reshape(len(stack.angles_rad), -1, 2, len(frequency))
    light = _by_angle(stack)
    figure, axes = make_figure(1, 2, size=(9.5, 3.4))
    for style, angle in zip(("-", "--"), angles, strict=False):
        for colour, i in enumerate(depths):
            name = f"{_depth_name(stack.depths_um[i])}, {_angle_name(stack.angles_rad[angle])}"
            for curve, width in zip(curves[angle, i], (1.5, 0.6), strict=True):
                axes[0].plot(
                    frequency * 1e3, curve, style, color=f"C{colour}", lw=width
                )
            energy = _encircled(stack, light[angle, i], radius)
            axes[1].plot(radius, energy, style, color=f"C{colour}", label=name)
    if limit is not None:
        s = np.minimum(frequency / limit.cutoff_per_um, 1.0)
        ideal = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
        axes[0].plot(frequency * 1e3, ideal, ":", color="0.4")
    axes[0].set(
        title="MTF (thick along x, thin along y)",
        xlabel="cycles per mm",
        ylabel="modulation",
        ylim=(0, 1.02),
    )
    axes[1].set(
        title="encircled energy of the window's light",
        xlabel="radius / µm",
        ylabel="share",
        ylim=(0, 1.02),
    )
    axes[1].legend(fontsize=7)
    return figure_png(figure)


def _encircled(stack: PsfStack, light: Array, radius_um: Array) -> Array:
    """(radius,) share of (y, x) light within circles about its centroid."""
    x, y = stack.x_um, stack.y_um
    cx = light.sum(0) @ x / light.sum()
    cy = light.sum(1) @ y / light.sum()
    distance = np.hypot(x - cx, (y - cy)[:, None]).ravel()
    order = np.argsort(distance)
    shares = np.cumsum(light.ravel()[order])
    return np.asarray(np.interp(radius_um, distance[order], shares))


def plot_focus_scan(scan: "FocusScan") -> bytes:
    """Irradiance of a ``scan`` along x against the shift of the plane, peak and FWHM."""
    figure, axes = make_figure(1, 2, size=(9.5, 3.4))
    axes[0].pcolormesh(
        scan.shift_um,
        scan.x_um,
        np.sqrt(scan.slices.T),
        shading="nearest",
        rasterized=True,
    )
    axes[0].grid(False)
    axes[0].set(
        title="√irradiance along x behind the lens",
        xlabel="shift from the sensor / µm",
        ylabel="x / µm",
    )
    axes[1].plot(scan.shift_um, scan.peak / scan.peak.max(), label="peak irradiance")
    axes[1].plot(scan.shift_um, scan.fwhm_um / np.nanmax(scan.fwhm_um), label="FWHM")
    axes[1].set(
        xlabel="shift from the sensor / µm", ylabel="of the largest", ylim=(0, None)
    )
    axes[1].legend(fontsize=7)
    return figure_png(figure)
