"""Pictures of lenses side by side (Figs. 5 and 7 of the paper), and of runs in the
experiment (Figs. 9 to 11).
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from codesign.adapt import FinishedRun
from codesign.batches import EXPERIMENT
from codesign.evaluate.gaze_experiment import (
    AXIAL,
    LATERAL,
    RunResult,
    experiment_sensors,
    image_frames,
    prepare_run,
    render_subject,
    states_of,
)
from codesign.evaluate.optics import AxialInformation, ResolvedSettings, SceneEnergy
from codesign.settings import ExperimentConfig
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


@torch.no_grad()
def plot_samples(
    source: FinishedRun, config: ExperimentConfig, *, subjects: int = 4
) -> bytes:
    """Fig. 9 b: eyes of a few subjects in every slippage state; the pupil as it is
    (green) and as it is read (red).

    Args:
        source: finished run: its network, lens and sensor.
        config: subjects, stimuli, slippage and calibration.
    """
    scenes = source.run.scenes(EXPERIMENT)
    net = source.run.trainer.model.net
    prepared = prepare_run(source, image=config.image)
    slips = config.slips_mm
    sensor = experiment_sensors([source], config)[0]
    points = len(config.stimuli_deg)
    count = min(subjects, config.subjects)
    figure, axes = make_figure(
        count, len(slips), size=(1.25 * len(slips), 1.3 * count), squeeze=False
    )
    net.eval()
    for subject in range(count):
        rows = torch.arange(len(slips)) * points + (points // 2 + 5 * subject) % points
        states, _ = states_of(config, subject, scenes)
        made = render_subject(states[rows], config, subject, scenes)
        seen = image_frames(source, made, prepared, seed=subject, sensor=sensor)
        logits = net(seen.frames, source.architecture).mask_logits
        for column, slip in enumerate(slips):
            ax = axes[subject, column]
            ax.imshow(seen.frames[column, 0].numpy(), cmap="gray", extent=(0, 1, 1, 0))
            for mask, level, colour in (
                (seen.mask[column], 0.5, "#39d353"),
                (logits[column], 0.0, "#ff4d4d"),
            ):
                if mask.numel() and float(mask.min()) < level < float(
                    mask.max()
                ):  # some networks give no mask
                    n = mask.shape[-1]
                    place = (np.arange(n) + 0.5) / n
                    ax.contour(
                        place, place, mask.numpy(), [level], colors=colour, linewidths=1
                    )
            ax.set(xticks=[], yticks=[])
            ax.grid(visible=False)
            if subject == 0:
                ax.set_title(f"dx {slip[0]:g}, dz {slip[2]:g}", fontsize=7)
    return figure_png(figure)


def plot_ambiguity(result: RunResult) -> bytes:
    """Fig. 10: pupil centres of all stimuli under axial and lateral slippage, and their
    means with ranges.

    Args:
        result: of one run.
    """
    trial, percent = result.trial, result.centre * 100
    figure, axes = make_figure(1, 3, size=(10.5, 3.2))
    for ax, kind, along in ((axes[0], AXIAL, 2), (axes[1], LATERAL, 0)):
        keep = trial.group(kind)
        dots = ax.scatter(
            *percent[keep].T, c=trial.slip_mm[keep, along], s=2, cmap="viridis"
        )
        figure.colorbar(dots, ax=ax, label=f"d{'xyz'[along]} / mm")
        ax.set(
            title=f"{kind} slippage",
            xlabel="pupil x / % of the frame",
            ylabel="pupil y / %",
        )
        ax.invert_yaxis()
    for state in np.unique(trial.state):
        mine = trial.state == state
        middle, slip = percent[mine].mean(0), trial.slip_mm[mine][0]
        low, high = np.percentile(percent[mine], [2.5, 97.5], axis=0)
        reach = np.abs(np.stack([low - middle, high - middle]))
        axes[2].errorbar(
            *middle,
            xerr=reach[:, :1],
            yerr=reach[:, 1:],
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
    for ax, kind in zip(axes, (AXIAL, LATERAL), strict=True):
        for i, (result, colour) in enumerate(zip(results, COLOURS, strict=False)):
            trial = result.trial
            shift = (i - (len(results) - 1) / 2) * 1.1
            keep = trial.group(kind) & np.isfinite(result.gaze_deg)
            for point in np.unique(trial.stimulus[keep]):
                mine = keep & (trial.stimulus == point)
                x, y = trial.stimulus_deg[mine][0]
                ax.scatter(
                    x + shift,
                    y,
                    s=24 * result.gaze_deg[mine].mean() ** 2 + 2,
                    color=colour,
                    alpha=0.75,
                    lw=0,
                )
            ax.scatter(
                [], [], color=colour, label=f"{result.name}: {result.gaze(kind):.2f}°"
            )
        ax.set(
            title=f"{kind} slippage",
            xlabel="stimulus across / deg",
            ylabel="stimulus down / deg",
            aspect="equal",
        )
        ax.invert_yaxis()
        ax.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.18),
            ncols=len(results),
            fontsize=7,
        )
    return figure_png(figure)
