"""One page on a fit: pictures of measured, predicted and residual, parameters with intervals, cautions in words."""

from pathlib import Path

import numpy as np

from characterize.pupilfit import PupilFit
from metalens import report
from metalens.store import Array


def pupil_report(path: Path, fit: PupilFit) -> None:
    """Write the page of a generic pupil fit."""
    score = fit.held_out or fit.agreement
    keys = [
        report.KeyFigure("NCC, " + ("held-out" if fit.held_out else "fitted"), f"{score.ncc:.4f}", score.ncc >= 0.975),
        report.KeyFigure("NRMSE", f"{score.nrmse:.3f}", score.nrmse <= 0.2),
        report.KeyFigure("chi² / dof", f"{fit.chi2_per_dof:.2f}"),
    ]
    images = report.Figure(
        frames_figure((fit.measured, fit.predicted), fit.residual_sigma, ("measured", "fitted")),
        "Every plane: measured, fitted (square root of the light), residual in standard deviations.",
        wide=True,
    )
    maps = report.Figure(_maps(fit), "Phase (rad) and amplitude of the pupil.")
    rows = [(n, float(v), float(s)) for n, v, s in zip(fit.names, fit.value, fit.sigma, strict=True)]
    sections = [
        report.Section("Images", f"{fit.reason}.", [images]),
        report.Section("Pupil", "", [maps, report.Table(("parameter", "value", "1 sigma"), rows)]),
        report.Section("Read with care", "\n\n".join(fit.cautions)),
    ]
    report.write(path, "Pupil from a through-focus stack", sections, key_figures=keys)


def frames_figure(stacks: tuple[Array, ...], residual_sigma: Array, labels: tuple[str, ...]) -> bytes:
    """PNG of at most 12 frames: one row for each stack, the last for the residual in sigma (-5 to 5)."""
    from matplotlib.figure import Figure

    chosen = np.unique(np.linspace(0, len(residual_sigma) - 1, min(12, len(residual_sigma))).round().astype(int))
    rows = len(stacks) + 1
    figure = Figure(figsize=(1.1 * len(chosen), 1.2 * rows))
    axes = figure.subplots(rows, len(chosen), squeeze=False)
    for column, frame in enumerate(chosen):
        top = max(float(stack[frame].max()) for stack in stacks)
        for row, stack in enumerate(stacks):
            light = np.sqrt(np.maximum(stack[frame] - np.median(stack[frame]), 0))
            axes[row, column].imshow(light, cmap="magma", vmin=0, vmax=max(top, 1e-9) ** 0.5)
        axes[-1, column].imshow(residual_sigma[frame], cmap="RdBu_r", vmin=-5, vmax=5)
        axes[0, column].set_title(f"{frame}", fontsize=7)
    for row, label in enumerate((*labels, "residual / sigma")):
        axes[row, 0].set_ylabel(label, fontsize=7)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    return report.png(figure)


def _maps(fit: PupilFit) -> bytes:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 2.7))
    for place, (values, title, colours) in enumerate(
        ((fit.phase_rad, "phase / rad", "twilight"), (fit.amplitude, "amplitude", "viridis")), 1
    ):
        axis = figure.add_subplot(1, 2, place)
        figure.colorbar(axis.imshow(values, cmap=colours), ax=axis)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    return report.png(figure)
