"""One page on a fit: pictures of measured, predicted and residual, parameters with intervals, cautions in words."""

from pathlib import Path

import numpy as np

from characterize.asbuilt import AsBuilt
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


def asbuilt_report(path: Path, result: AsBuilt) -> None:
    """Write the page of an as-built lens: designed, built, residual; intervals; correlations; what to measure next."""
    keys = [
        report.KeyFigure("verdict", "trusted" if result.trusted else "refused by its checks", result.trusted),
        report.KeyFigure("chi² / dof", f"{result.chi2_per_dof:.3f}", 0.9 < result.chi2_per_dof < 1.15),
        report.KeyFigure("frames", str(len(result.measured))),
    ]
    images = frames_figure(
        (result.nominal, result.measured, result.predicted),
        result.residual_sigma,
        ("as designed", "measured", "as built"),
    )
    low_high = [result.interval(name) for name in result.names]
    rows = [
        (name, float(v), float(s), f"{low:.4g} to {high:.4g}")
        for name, v, s, (low, high) in zip(result.names, result.value, result.sigma, low_high, strict=True)
    ]
    parameters = report.Table(("parameter", "value", "1 sigma", "95 % interval"), rows)
    seen = "Square root of the light above background; residuals from -5 (blue) to 5 sigma (red)."
    sections = [
        report.Section("Frames", result.reason + ".", [report.Figure(images, seen, wide=True)]),
        report.Section(
            "Parameters", "", [parameters, report.Figure(_correlation(result), "Correlation of parameters.")]
        ),
        report.Section("What the frames fix", "\n\n".join(result.identifiable)),
        report.Section(
            "What they cannot tell, and what to measure next", "\n\n".join(result.degeneracies) or "Nothing."
        ),
        report.Section("Put right or assumed on the way", "\n\n".join(result.cautions)),
    ]
    if result.problems:
        sections.insert(0, report.Section("Problems", "\n\n".join(result.problems)))
    report.write(path, "The lens as built", sections, key_figures=keys)


def _correlation(result: AsBuilt) -> bytes:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 5.4))
    axis = figure.add_subplot()
    figure.colorbar(axis.imshow(result.correlation, cmap="RdBu_r", vmin=-1, vmax=1), ax=axis)
    axis.set_xticks(range(len(result.names)), result.names, rotation=90, fontsize=6)
    axis.set_yticks(range(len(result.names)), result.names, fontsize=6)
    return report.png(figure)


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
