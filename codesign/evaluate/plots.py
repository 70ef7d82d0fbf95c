"""Pictures of lenses side by side: I(z) per binning, slices along depth (Fig. 7), and
what scenes show (Fig. 5).
"""

from collections.abc import Mapping

import numpy as np
import torch

from codesign.evaluate.optics import AxialInformation, ResolvedSettings, SceneEnergy
from metalens.core.report import figure_png, make_figure
from metalens.psf import pixel_weights

CAPTIONS = {
    "axial": "Axial information on axis (Eq. 11) over depth for each binning, averaged over sub-pixel positions.",
    "slices": "Light across the PSF (summed along y) over depth, lens by lens (down) and binning by binning (across), "
    "each depth at its own full scale.",
    "scenes": "First scene: the sensor image, its squared change with gaze, and the squared difference between gaze "
    "and slip, on one scale for all lenses.",
}
HALF = 0.1875  # half width of the slices that is shown, of the window


def plot_axial_information(
    axial: Mapping[str, AxialInformation], setting: ResolvedSettings
) -> bytes:
    """I(z) over depth on axis, a panel for each binning.

    Args:
        axial: axial information by name of the lens.
        setting: how the lenses were measured.
    """
    depths = np.linspace(*setting.depths_mm, setting.count)
    count = len(setting.binnings)
    figure, panels = make_figure(1, count, size=(1.5 + 3.2 * count, 3.2), squeeze=False)
    for k, (panel, binning) in enumerate(zip(panels[0], setting.binnings, strict=True)):
        for name, found in axial.items():
            mean = float(found.information[0, k].mean())
            shown = found.information[0, k].clamp_min(max(1e-6 * mean, 1e-30)).numpy()
            panel.semilogy(depths, shown, ".-", label=f"{name}: {mean:.3g}")
        panel.set(
            title=f"{binning} × {binning} of {setting.pixel_um:g} µm",
            xlabel="source depth / mm",
        )
        panel.legend(fontsize=7, title="mean", title_fontsize=7)
    panels[0, 0].set_ylabel(f"I(z) / mm⁻² ({setting.normalisation})")
    return figure_png(figure)


def plot_depth_slices(
    axial: Mapping[str, AxialInformation], setting: ResolvedSettings
) -> bytes:
    """Light along x over depth, lenses down, binnings across.

    Args:
        axial: axial information by name of the lens.
        setting: how the lenses were measured.
    """
    shape = (len(axial), len(setting.binnings))
    figure, panels = make_figure(
        *shape,
        size=(1 + 2.6 * shape[1], 0.6 + 2.0 * shape[0]),
        squeeze=False,
        sharex=True,
    )
    (low, high), half = setting.depths_mm, HALF * setting.window_um
    for place, (row, (name, found)) in enumerate(
        zip(panels, axial.items(), strict=True)
    ):
        for panel, binning in zip(row, setting.binnings, strict=True):
            pixel = setting.pixel_um * binning
            pixels = int(2 * half / pixel) // 2 * 2 + 1
            weights = pixel_weights(
                found.slices.shape[1], setting.sample_um, pitch_um=pixel, count=pixels
            )
            light = found.slices @ weights.to(found.slices).mT
            shown = (light / light.amax(1, keepdim=True).clamp_min(1e-30)).numpy()
            edge = pixels * pixel / 2
            panel.imshow(
                shown,
                extent=(-edge, edge, high, low),
                aspect="auto",
                vmin=0,
                interpolation="nearest",
            )
            panel.grid(False)
            panel.set_xlim(-half, half)
            if place == 0:
                panel.set_title(f"{binning} × {binning} of {setting.pixel_um:g} µm")
        row[0].set_ylabel(f"{name}\ndepth / mm", fontsize=8)
    for panel in panels[-1]:
        panel.set_xlabel("x / µm")
    return figure_png(figure)


def plot_scenes(energies: Mapping[str, SceneEnergy]) -> bytes:
    """The first scene through every lens: image, change with gaze, difference of gaze
    and slip.

    Args:
        energies: scene sensitivity by name of the lens.
    """
    titles = ("image", "(gaze − anchor)²", "(gaze − slip)²")
    figure, panels = make_figure(
        len(energies), 3, size=(8.4, 0.5 + 2.6 * len(energies)), squeeze=False
    )
    tops = [
        float(
            torch.quantile(torch.stack([e.maps[k] for e in energies.values()]), 0.998)
        )
        for k in range(3)
    ]
    for place, (row, (name, energy)) in enumerate(
        zip(panels, energies.items(), strict=True)
    ):
        for panel, picture, top, title in zip(
            row, energy.maps, tops, titles, strict=True
        ):
            grey = title == "image"
            panel.imshow(
                picture.numpy(),
                cmap="gray" if grey else "magma",
                vmin=0,
                vmax=max(top, 1e-12),
            )
            panel.set(xticks=[], yticks=[])
            panel.grid(False)
            if place == 0:
                panel.set_title(title)
        row[0].set_ylabel(name, fontsize=8)
    return figure_png(figure)
