"""Pictures of lenses side by side (Figs. 5 and 7 of the paper), and of runs in the
experiment (Figs. 10 and 11).
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from codesign.evaluate.gaze_experiment import AXIAL, LATERAL, RunResult
from codesign.evaluate.optics import AxialInformation, ResolvedSettings, SceneEnergy
from metalens.core.report import figure_png, make_figure

CAPTIONS = {
    "axial": "Axial information on axis (Eq. 11) over depth for each binning, averaged over sub-pixel positions.",
    "scenes": "First scene: the sensor image, its squared change with gaze, and the squared difference between gaze "
    "and slip, on one scale for all lenses.",
}


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
    maps = torch.stack([energy.maps for energy in energies.values()])
    full = torch.quantile(maps.transpose(0, 1).flatten(1), 0.998, dim=1).clamp_min(
        1e-12
    )
    for row, name, pictures in zip(panels, energies, maps, strict=True):
        row[0].set_ylabel(name, fontsize=8)
        for k, panel in enumerate(row):
            colours = "magma" if k else "gray"
            panel.imshow(pictures[k].numpy(), cmap=colours, vmin=0, vmax=float(full[k]))
            panel.set(xticks=[], yticks=[])
            panel.grid(False)
    for panel, title in zip(panels[0], titles, strict=True):
        panel.set_title(title)
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
    for panel, kind, axis in ((axes[0], AXIAL, 2), (axes[1], LATERAL, 0)):
        chosen = trial.group(kind)
        dots = panel.scatter(
            *percent[chosen].T, c=trial.slip_mm[chosen, axis], s=2, cmap="viridis"
        )
        figure.colorbar(dots, ax=panel, label=f"d{'xyz'[axis]} / mm")
        panel.set_title(f"{kind} slippage")
    for state in np.unique(trial.state):
        places = percent[trial.state == state]
        x, _, z = trial.slip_mm[trial.state == state][0]
        middle = places.mean(0)
        span = np.abs(np.percentile(places, [2.5, 97.5], axis=0) - middle)
        axes[2].errorbar(
            *middle,
            xerr=span[:, :1],
            yerr=span[:, 1:],
            fmt="o",
            label=f"({x:g}, {z:g})",
        )
    axes[2].set_title("mean and 95 % range by (dx, dz)")
    axes[2].legend(fontsize=6)
    for panel in axes:
        panel.set(xlabel="pupil x / % of the frame", ylabel="pupil y / %")
        panel.invert_yaxis()
    return figure_png(figure)


def plot_gaze_errors(results: Sequence[RunResult]) -> bytes:
    """Fig. 11: mean gaze error at every stimulus, as the size of its marker, under
    axial and lateral slippage.

    Args:
        results: one a run.
    """
    figure, axes = make_figure(1, 2, size=(10.5, 3.8))
    for panel, kind in zip(axes, (AXIAL, LATERAL), strict=True):
        for number, result in enumerate(results):
            trial, colour = result.trial, f"C{number}"
            shift = (number - (len(results) - 1) / 2) * 1.1
            chosen = trial.group(kind) & np.isfinite(result.gaze_deg)
            for point in np.unique(trial.stimulus[chosen]):
                at_point = chosen & (trial.stimulus == point)
                x, y = trial.stimulus_deg[at_point][0]
                area = 24 * result.gaze_deg[at_point].mean() ** 2 + 2
                panel.scatter(x + shift, y, s=area, color=colour, alpha=0.75, lw=0)
            label = f"{result.name}: {result.gaze(kind):.2f}°"
            panel.scatter([], [], color=colour, label=label)
        panel.set(
            title=f"{kind} slippage",
            xlabel="stimulus across / deg",
            ylabel="stimulus down / deg",
            aspect="equal",
        )
        panel.invert_yaxis()
        panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), fontsize=7)
    return figure_png(figure)
