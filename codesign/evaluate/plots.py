"""Pictures of lenses side by side (Figs. 5 and 7 of the paper), and of runs in the
experiment (Figs. 10 and 11).
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from codesign.evaluate.gaze_experiment import AXIAL, LATERAL, RunResult
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
COLOURS = ("#e9812b", "#1f6feb", "#2a9d8f", "#6d597a")


def plot_axial_information(
    axial: Mapping[str, AxialInformation], setting: ResolvedSettings
) -> bytes:
    """PNG of I(z) over depth on axis, a panel for each binning.

    Args:
        axial: axial information by name of the lens.
        setting: how the lenses were measured.
    """
    depths = np.linspace(*setting.depths_mm, setting.count)
    count = len(setting.binnings)
    figure, panels = make_figure(1, count, size=(1.5 + 3.2 * count, 3.2), squeeze=False)
    for k, (panel, binning) in enumerate(zip(panels[0], setting.binnings, strict=True)):
        for name, info in axial.items():
            mean = float(info.information[0, k].mean())
            shown = info.information[0, k].clamp_min(max(1e-6 * mean, 1e-30)).numpy()
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
    """PNG of line spreads over depth (PSF on axis summed over y, in pixels), lenses
    down, binnings across.

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
    (low, high), half_um = setting.depths_mm, HALF * setting.window_um
    for row_number, (row, (name, info)) in enumerate(
        zip(panels, axial.items(), strict=True)
    ):
        for panel, binning in zip(row, setting.binnings, strict=True):
            pixel = setting.pixel_um * binning
            pixels = int(2 * half_um / pixel) // 2 * 2 + 1
            weights = pixel_weights(
                info.slices.shape[1], setting.sample_um, pitch_um=pixel, count=pixels
            )
            light = info.slices @ weights.to(info.slices).mT
            relative = (light / light.amax(1, keepdim=True).clamp_min(1e-30)).numpy()
            edge = pixels * pixel / 2
            panel.imshow(
                relative,
                extent=(-edge, edge, high, low),
                aspect="auto",
                vmin=0,
                interpolation="nearest",
            )
            panel.grid(False)
            panel.set_xlim(-half_um, half_um)
            if row_number == 0:
                panel.set_title(f"{binning} × {binning} of {setting.pixel_um:g} µm")
        row[0].set_ylabel(f"{name}\ndepth / mm", fontsize=8)
    for panel in panels[-1]:
        panel.set_xlabel("x / µm")
    return figure_png(figure)


def plot_scenes(energies: Mapping[str, SceneEnergy]) -> bytes:
    """PNG of the first scene through every lens: image, squared change with gaze,
    squared difference of gaze and slip.

    Args:
        energies: scene sensitivity by name of the lens.
    """
    titles = ("image", "(gaze − anchor)²", "(gaze − slip)²")
    figure, panels = make_figure(
        len(energies), 3, size=(8.4, 0.5 + 2.6 * len(energies)), squeeze=False
    )
    maxima = [
        float(
            torch.quantile(
                torch.stack(
                    [scene_energy.maps[k] for scene_energy in energies.values()]
                ),
                0.998,
            )
        )
        for k in range(3)
    ]
    for number, (row, (name, energy)) in enumerate(
        zip(panels, energies.items(), strict=True)
    ):
        for panel, picture, maximum, title in zip(
            row, energy.maps, maxima, titles, strict=True
        ):
            is_image = title == "image"
            panel.imshow(
                picture.numpy(),
                cmap="gray" if is_image else "magma",
                vmin=0,
                vmax=max(maximum, 1e-12),
            )
            panel.set(xticks=[], yticks=[])
            panel.grid(False)
            if number == 0:
                panel.set_title(title)
        row[0].set_ylabel(name, fontsize=8)
    return figure_png(figure)


def plot_ambiguity(result: RunResult) -> bytes:
    """Fig. 10: pupil centres of all stimuli under axial and lateral slippage, and their
    means with ranges.

    Args:
        result: of one run.
    """
    trial = result.trial
    percent = result.centre * 100
    figure, axes = make_figure(1, 3, size=(10.5, 3.2))
    for panel, kind, axis_index in ((axes[0], AXIAL, 2), (axes[1], LATERAL, 0)):
        chosen = trial.group(kind)
        dots = panel.scatter(
            *percent[chosen].T, c=trial.slip_mm[chosen, axis_index], s=2, cmap="viridis"
        )
        figure.colorbar(dots, ax=panel, label=f"d{'xyz'[axis_index]} / mm")
        panel.set(
            title=f"{kind} slippage",
            xlabel="pupil x / % of the frame",
            ylabel="pupil y / %",
        )
        panel.invert_yaxis()
    for state in np.unique(trial.state):
        of_state = trial.state == state
        mean = percent[of_state].mean(0)
        slip = trial.slip_mm[of_state][0]
        low, high = np.percentile(percent[of_state], [2.5, 97.5], axis=0)
        half_range = np.abs(np.stack([low - mean, high - mean]))
        axes[2].errorbar(
            *mean,
            xerr=half_range[:, :1],
            yerr=half_range[:, 1:],
            fmt="o",
            label=f"({slip[0]:g}, {slip[2]:g})",
        )
    axes[2].set(
        title="mean and 95 % range by (dx, dz)",
        xlabel="pupil x / %",
        ylabel="pupil y / %",
    )
    axes[2].invert_yaxis()
    axes[2].legend(fontsize=6)
    return figure_png(figure)


def plot_gaze_errors(results: Sequence[RunResult]) -> bytes:
    """Fig. 11: mean gaze error at every stimulus, as the size of its marker, under
    axial and lateral slippage.

    Args:
        results: one a run.
    """
    figure, axes = make_figure(1, 2, size=(10.5, 3.8))
    for panel, kind in zip(axes, (AXIAL, LATERAL), strict=True):
        for number, (result, colour) in enumerate(zip(results, COLOURS, strict=False)):
            trial = result.trial
            shift = (number - (len(results) - 1) / 2) * 1.1
            chosen = trial.group(kind) & np.isfinite(result.gaze_deg)
            for point in np.unique(trial.stimulus[chosen]):
                at_point = chosen & (trial.stimulus == point)
                x, y = trial.stimulus_deg[at_point][0]
                panel.scatter(
                    x + shift,
                    y,
                    s=24 * result.gaze_deg[at_point].mean() ** 2 + 2,
                    color=colour,
                    alpha=0.75,
                    lw=0,
                )
            panel.scatter(
                [], [], color=colour, label=f"{result.name}: {result.gaze(kind):.2f}°"
            )
        panel.set(
            title=f"{kind} slippage",
            xlabel="stimulus across / deg",
            ylabel="stimulus down / deg",
            aspect="equal",
        )
        panel.invert_yaxis()
        panel.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.18),
            ncols=len(results),
            fontsize=7,
        )
    return figure_png(figure)
