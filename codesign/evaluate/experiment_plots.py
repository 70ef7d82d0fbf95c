"""Figs. 9 to 11 of the paper for runs of one's own: masks, pupil centres under
slippage, gaze errors by stimulus.
"""

from collections.abc import Sequence

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
from codesign.evaluate.shown import ExperimentConfig
from metalens.core import report

COLOURS = ("#e9812b", "#1f6feb", "#2a9d8f", "#6d597a")


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
    scenes, net = source.run.scenes(EXPERIMENT), source.run.trainer.model.net
    prepared, slips = prepare_run(source, image=config.image), config.slips_mm
    sensor = experiment_sensors([source], config)[0]
    points = len(config.stimuli_deg)
    count = min(subjects, config.subjects)
    figure, axes = report.make_figure(
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
    return report.figure_png(figure)


def plot_ambiguity(result: RunResult) -> bytes:
    """Fig. 10: pupil centres of all stimuli under axial and lateral slippage, and their
    means with ranges.

    Args:
        result: of one run.
    """
    trial, percent = result.trial, result.centre * 100
    figure, axes = report.make_figure(1, 3, size=(10.5, 3.2))
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
    return report.figure_png(figure)


def plot_gaze_errors(results: Sequence[RunResult]) -> bytes:
    """Fig. 11: mean gaze error at every stimulus, as the size of its marker, under
    axial and lateral slippage.

    Args:
        results: one a run.
    """
    figure, axes = report.make_figure(1, 2, size=(10.5, 3.8))
    for ax, kind in zip(axes, (AXIAL, LATERAL), strict=True):
        for i, (result, colour) in enumerate(zip(results, COLOURS, strict=False)):
            trial, shift = result.trial, (i - (len(results) - 1) / 2) * 1.1
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
    return report.figure_png(figure)
