"""One page on a fit: pictures of measured, predicted and residual, parameters with
intervals, cautions in words.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from characterize.inference import REACH, AsBuilt, identifiability, invert_information
from characterize.model import PARAMETERS, PLACE, typical_scales
from characterize.pupil import PupilFit
from metalens.core import report, store
from metalens.core.arrays import Array

COMPANIONS = (
    ".html",
    "_frames.png",
    "_parameters.png",
    "_posterior.png",
)  # endings of the files that are written with a fit
_BLUE = "#1f6feb"
_CAPTIONS = {
    "frames": "One column a frame. Square root of the light above background, one "
    "scale down each column; the residual runs from -5 (blue) to 5 sigma (red): noise "
    "alone looks like even speckle, structure is what the model leaves over.",
    "parameters": "95 % intervals in the typical uncertainty of each parameter, with "
    "what these captures cannot tell (thin); pale: what would be left if all causes "
    "that nobody stated were absent; grey: what was known beforehand.",
    "posterior": "What the frames and prior knowledge leave open about each parameter "
    "if all causes that nobody stated were absent. Shaded: its 95 % interval, and the "
    "wider one with those causes. Grey bars: draws, with those causes too. Grey line: "
    "the design.",
}


def pupil_report(path: Path, fit: PupilFit) -> None:
    """Write the HTML page of a pupil fit: images, pupil maps, parameters, cautions.

    Args:
        path: the page to write.
        fit: the fitted pupil.
    """
    score = fit.held_out or fit.agreement
    key_figures = [
        report.KeyFigure(
            "NCC, " + ("held-out" if fit.held_out else "fitted"),
            f"{score.ncc:.4f}",
            score.ncc >= 0.975,
        ),
        report.KeyFigure("NRMSE", f"{score.nrmse:.3f}", score.nrmse <= 0.2),
        report.KeyFigure("chi² / dof", f"{fit.chi2_per_dof:.2f}"),
    ]
    frames = report.Figure(
        frames_figure(
            (fit.measured, fit.predicted), fit.residual_sigma, ("measured", "fitted")
        ),
        "Every plane: measured, fitted (square root of the light), residual in standard deviations.",
        wide=True,
    )
    maps = report.Figure(_maps(fit), "Phase (rad) and amplitude of the pupil.")
    rows = [
        (name, float(value), float(sigma))
        for name, value, sigma in zip(fit.names, fit.value, fit.sigma, strict=True)
    ]
    sections = [
        report.Section("Problems", "\n\n".join(fit.problems)),
        report.Section("Images", f"{fit.reason}.", [frames]),
        report.Section(
            "Pupil", "", [maps, report.Table(("parameter", "value", "1 sigma"), rows)]
        ),
        report.Section("Read with care", "\n\n".join(fit.cautions)),
    ]
    sections = sections[not fit.problems :]
    report.write_report(
        path, "Pupil from a through-focus stack", sections, key_figures=key_figures
    )


def asbuilt_report(
    path: Path, result: AsBuilt, *, truth: Mapping[str, float] | None = None
) -> None:
    """Write the HTML page of an as-built lens and its pictures (``STEM_frames.png``,
    ``_parameters.png``, ``_posterior.png``).

    The page shows every frame as designed, measured, fitted and residual; intervals and
    posterior curves of the parameters; correlations; what to measure next.

    Args:
        path: the page to write.
        result: the as-built lens.
        truth: true values by name, drawn with the posteriors; None where unknown.
    """
    is_known = result.sigma < 0.5 * typical_scales(result.names)
    known_share = float(is_known.mean())
    key_figures = [
        report.KeyFigure(
            "verdict",
            "trusted" if result.trusted else "refused by its checks",
            result.trusted,
        ),
        report.KeyFigure(
            "chi² / dof", f"{result.chi2_per_dof:.3f}", 0.9 < result.chi2_per_dof < 1.15
        ),
        report.KeyFigure("frames", str(len(result.measured))),
        report.KeyFigure(
            "parameters", f"{len(result.names)}, {known_share:.0%} well known"
        ),
    ]
    figures = {
        name: report.Figure(picture, _CAPTIONS[name], wide=True)
        for name, picture in (
            ("frames", _every_frame(result)),
            ("parameters", _intervals(result)),
            ("posterior", _posterior(result, truth or {}) if result.curves else b""),
        )
        if picture
    }
    for name, figure in figures.items():
        store.write_bytes(path.with_name(f"{path.stem}_{name}.png"), figure.png)
    degeneracies = "\n\n".join(result.degeneracies) or "Nothing."
    sections = [
        report.Section("Problems", "\n\n".join(result.problems)),
        report.Section("What is known", "\n\n".join(result.verdicts)),
        report.Section("Frames", result.reason + ".", [figures["frames"]]),
        report.Section("Parameters", "", [figures["parameters"], _parameters(result)]),
        report.Section(
            "Posterior of each parameter",
            "Red line: the hidden truth." if truth is not None else "",
            [figures[name] for name in ("posterior",) if name in figures],
        ),
        report.Section("What the frames fix", "\n\n".join(result.identifiable)),
        report.Section("What they cannot tell, and what to measure next", degeneracies),
        report.Section("Put right or assumed on the way", "\n\n".join(result.cautions)),
    ]
    report.write_report(
        path,
        "The lens as built",
        [section for section in sections if section.text or section.items],
        lead="The lens that was really made, from what the bench saw: how it differs "
        "from the design, and how surely.",
        key_figures=key_figures,
    )


def _posterior(result: AsBuilt, truth: Mapping[str, float]) -> bytes:
    """PNG of the posterior density of every parameter, four panels a row.

    Line: profile density within the model; shaded: statistical and total 95 % interval;
    grey bars: draws; grey line: design (0); red line: truth.
    """
    names = [name for name in result.names if name in result.curves]
    rows = -(-len(names) // 4)
    figure, panels = report.make_figure(
        rows, 4, size=(9, 1.35 * rows + 0.2), squeeze=False
    )
    for axis in panels.flat[len(names) :]:
        axis.set_axis_off()
    for axis, name in zip(panels.flat, names, strict=False):
        low, high = result.interval(name)
        truths = [truth[name]] if name in truth else []
        margin = 0.4 * (high - low)
        grid = np.linspace(
            min([low - margin, *truths]), max([high + margin, *truths]), 300
        )
        axis.axvspan(low, high, color=_BLUE, alpha=0.1, linewidth=0)
        axis.axvspan(*result.within_model(name), color=_BLUE, alpha=0.15, linewidth=0)
        density = identifiability.profile_density(result.curves[name], grid)
        axis.plot(grid, density, color=_BLUE)
        if len(result.draws):
            draws = result.draws[:, result.names.index(name)]
            span = grid[0], grid[-1]
            axis.hist(draws, bins=24, range=span, density=True, color="#999", alpha=0.5)
        if grid[0] < 0 < grid[-1]:
            axis.axvline(0, color="#888", linewidth=0.7)
        for value in truths:
            axis.axvline(value, color="#d1242f", linewidth=1.2)
        axis.set_title(name, fontsize=7)
        axis.set_yticks([])
        axis.tick_params(labelsize=6)
    return report.figure_png(figure)


def _parameters(result: AsBuilt) -> report.Table:
    """Table of all parameters: value, standard error, both 95 % intervals, the causes
    that widen them most, meaning.
    """
    rows = []
    for name, value, sigma in zip(
        result.names, result.value, result.sigma, strict=True
    ):
        intervals = (
            "{:.4g} to {:.4g}".format(*interval(name))
            for interval in (result.interval, result.within_model)
        )
        rows.append(
            (
                name,
                float(value),
                float(sigma),
                *intervals,
                ", ".join(result.most(name)),
                PARAMETERS[PLACE[name]].meaning,
            )
        )
    interval_heads = "total 95 %", "statistical 95 %", "widened mostly by"
    heads = ("parameter", "value", "1 sigma", *interval_heads, "meaning")
    return report.Table(heads, rows)


def _every_frame(result: AsBuilt) -> bytes:
    """PNG of all frames as designed, measured, as built and residual, with depth and
    angle as titles.
    """
    stacks = result.nominal, result.measured, result.predicted
    titles = [
        f"{z / 1e3:.3g} mm" if z >= 1e3 else f"{z:.3g} um" for z in result.depth_um
    ]
    if np.ptp(result.angle_rad) > 0:
        titles = [
            f"{title}\n{np.degrees(angle[0]):.3g}°"
            for title, angle in zip(titles, result.angle_rad, strict=True)
        ]
    return frames_figure(
        stacks,
        result.residual_sigma,
        ("as designed", "measured", "as built"),
        titles=titles,
    )


def _intervals(result: AsBuilt) -> bytes:
    """PNG of the 95 % intervals of all parameters, in units of their typical standard
    errors, on the prior's interval.

    Prior information of a parameter is the diagonal of the inverse covariance within
    the model less the information of the frames.
    """
    fitted = [
        i
        for i, name in enumerate(result.names)
        if name != "log_gain" and not name.startswith("background")
    ]
    names = [result.names[i] for i in fitted]
    unit = typical_scales(names)
    value = result.value[fitted] / unit
    information = np.diag(
        invert_information(result.within_covariance) - result.information
    )[fitted]
    half_prior = np.minimum(np.maximum(information, 1e-12) ** -0.5 / unit, 1e3) * REACH
    figure, axis = report.make_figure(size=(7, 0.22 * len(names) + 0.8))
    rows = np.arange(len(names))[::-1]
    axis.barh(rows, 2 * half_prior, left=-half_prior, color="#e4e4e4")
    for interval, style in (
        (result.within_model, {"fmt": "none", "ecolor": "#9ec1f7", "linewidth": 3.5}),
        (result.interval, {"fmt": "o", "markersize": 3, "color": _BLUE, "capsize": 2}),
    ):
        limits = np.array([interval(name) for name in names]).T / unit
        axis.errorbar(value, rows, xerr=np.abs(limits - value), **style)
    axis.axvline(0, color="#444", linewidth=0.8)
    labels = [f"{n}  (1 = {scale:g})" for n, scale in zip(names, unit, strict=True)]
    axis.set_yticks(rows, labels, fontsize=7)
    axis.set_xscale("symlog", linthresh=1)
    axis.set_xlim(-60, 60)
    axis.set_xlabel(
        "value less design, in typical uncertainties (linear inside +-1)", fontsize=8
    )
    return report.figure_png(figure)


def frames_figure(
    stacks: tuple[Array, ...],
    residual_sigma: Array,
    labels: tuple[str, ...],
    *,
    titles: Sequence[str] = (),
) -> bytes:
    """PNG of all frames, twelve columns to a band: a row for each stack, and a last row
    for the residual in sigma (-5 to 5).

    Frames show the square root of the light above their median, on one scale for all
    stacks of a column.

    Args:
        stacks: (n, y, x) frames of every row.
        residual_sigma: (n, y, x) residual over its standard deviation.
        labels: label of each stack.
        titles: title of each frame; numbers without them.
    """
    frame_count, rows, columns = residual_sigma.shape
    across = min(12, frame_count)
    bands = -(-frame_count // across)
    band_rows = len(stacks) + 1
    height = 1.2 * rows / columns * band_rows * bands + 0.25 * bands
    figure, axes = report.make_figure(
        band_rows * bands, across, size=(1.15 * across + 0.4, height), squeeze=False
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for frame in range(frame_count):
        band, column = divmod(frame, across)
        cells = axes[band * band_rows : (band + 1) * band_rows, column]
        light = [
            np.sqrt(np.maximum(stack[frame] - np.median(stack[frame]), 0))
            for stack in stacks
        ]
        top = max(max(image.max() for image in light), 1e-5)
        for cell, image in zip(cells[:-1], light, strict=True):
            cell.imshow(image, cmap="magma", vmin=0, vmax=top)
        cells[-1].imshow(residual_sigma[frame], cmap="RdBu_r", vmin=-5, vmax=5)
        cells[0].set_title(titles[frame] if titles else f"{frame}", fontsize=7)
        if column == 0:
            for cell, label in zip(cells, (*labels, "residual / sigma"), strict=True):
                cell.text(
                    -0.06,
                    0.5,
                    label,
                    transform=cell.transAxes,
                    rotation=90,
                    ha="right",
                    va="center",
                    fontsize=7,
                )
    return report.figure_png(figure)


def _maps(fit: PupilFit) -> bytes:
    """PNG of the phase and amplitude maps of a pupil."""
    figure, axes = report.make_figure(1, 2, size=(6, 2.7))
    for axis, values, title, colours in (
        (axes[0], fit.phase_rad, "phase / rad", "twilight"),
        (axes[1], fit.amplitude, "amplitude", "viridis"),
    ):
        figure.colorbar(axis.imshow(values, cmap=colours), ax=axis)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    return report.figure_png(figure)
