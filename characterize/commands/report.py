"""One page on a fit: pictures of measured, predicted and residual, parameters with
intervals, cautions in words.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from characterize.inference import AsBuilt, identifiability, invert_information
from characterize.model import PARAMETERS, PLACE
from characterize.pupil import PupilFit
from metalens.core import report, store
from metalens.core.arrays import Array

BESIDE = (
    ".html",
    "_frames.png",
    "_parameters.png",
    "_posterior.png",
)  # endings of the files that are written with a fit


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
        report.Section("Images", f"{fit.reason}.", [frames]),
        report.Section(
            "Pupil", "", [maps, report.Table(("parameter", "value", "1 sigma"), rows)]
        ),
        report.Section("Read with care", "\n\n".join(fit.cautions)),
    ]
    if fit.problems:
        sections.insert(0, report.Section("Problems", "\n\n".join(fit.problems)))
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
    well_known = [
        sigma < 0.5 * typical_sigma(name)
        for name, sigma in zip(result.names, result.sigma, strict=True)
    ]
    known_share = float(np.mean(well_known))
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
    pictures = {"frames": _every_frame(result), "parameters": _intervals(result)}
    pictures |= {"posterior": _posterior(result, truth or {})} if result.curves else {}
    for name, picture in pictures.items():
        store.write_bytes(path.with_name(f"{path.stem}_{name}.png"), picture)
    frames_caption = (
        "One column a frame. Square root of the light above background, one scale down each column; the residual runs "
        "from -5 (blue) to 5 sigma (red): noise alone looks like even speckle, structure is what the model leaves over."
    )
    intervals_caption = (
        "95 % intervals in the typical uncertainty of each parameter, with what these captures cannot tell (thin); "
        "pale: what would be left if all causes that nobody stated were absent; grey: what was known beforehand."
    )
    sections = [
        report.Section("What is known", "\n\n".join(result.verdicts)),
        report.Section(
            "Frames",
            result.reason + ".",
            [report.Figure(pictures["frames"], frames_caption, wide=True)],
        ),
        report.Section(
            "Parameters",
            "",
            [
                report.Figure(pictures["parameters"], intervals_caption, wide=True),
                _parameters(result),
            ],
        ),
        *_curves(pictures, truth),
        report.Section("What the frames fix", "\n\n".join(result.identifiable)),
        report.Section(
            "What they cannot tell, and what to measure next",
            "\n\n".join(result.degeneracies) or "Nothing.",
        ),
        report.Section("Put right or assumed on the way", "\n\n".join(result.cautions)),
    ]
    if result.problems:
        sections.insert(0, report.Section("Problems", "\n\n".join(result.problems)))
    lead = "The lens that was really made, from what the bench saw: how it differs from the design, and how surely."
    report.write_report(
        path, "The lens as built", sections, lead=lead, key_figures=key_figures
    )


def _curves(
    pictures: dict[str, bytes], truth: Mapping[str, float] | None
) -> list[report.Section]:
    """Section with the picture of the posteriors and its caption; none without the
    picture.
    """
    if "posterior" not in pictures:
        return []
    caption = (
        "What the frames and prior knowledge leave open about each parameter, the 95 % interval shaded; dashed: if all "
        "causes that the frames cannot tell and nobody stated were absent. Grey bars: "
    )
    caption += "draws, where the posterior is bent or double. Grey line: the design."
    caption += " Red line: the hidden truth." if truth is not None else ""
    return [
        report.Section(
            "Posterior of each parameter",
            "",
            [report.Figure(pictures["posterior"], caption, wide=True)],
        )
    ]


def _posterior(result: AsBuilt, truth: Mapping[str, float]) -> bytes:
    """PNG of the posterior density of every parameter, four panels a row.

    Solid: profile density with unstated causes; dashed: without them; shaded: 95 %
    interval; grey bars: draws; grey line: design (0); red line: truth.
    """
    from matplotlib.figure import Figure

    names = [name for name in result.names if name in result.curves]
    rows = -(-len(names) // 4)
    figure = Figure(figsize=(9, 1.35 * rows + 0.2))
    axes = figure.subplots(
        rows, 4, squeeze=False, gridspec_kw={"hspace": 0.9, "wspace": 0.12}
    ).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, name in zip(axes, names, strict=False):
        low, high = result.interval(name)
        truths = [truth[name]] if name in truth else []
        margin = 0.4 * (high - low)
        start = min([low - margin, *truths])
        stop = max([high + margin, *truths])
        grid = np.linspace(start - 0.02 * margin, stop + 0.02 * margin, 300)
        curve = result.curves[name]
        axis.set_axis_on()
        axis.axvspan(low, high, color="#1f6feb", alpha=0.12, linewidth=0)
        axis.plot(
            grid,
            identifiability.profile_density(
                _widened_profile(result, name, curve), grid
            ),
            color="#1f6feb",
            linewidth=1.2,
        )
        axis.plot(
            grid,
            identifiability.profile_density(curve, grid),
            color="#1f6feb",
            linewidth=0.6,
            linestyle=(0, (3, 2)),
        )
        if len(result.draws):
            draws = result.draws[:, result.names.index(name)]
            axis.hist(
                draws,
                bins=24,
                range=(grid[0], grid[-1]),
                density=True,
                color="#999",
                alpha=0.5,
            )
        if grid[0] < 0 < grid[-1]:
            axis.axvline(0, color="#888", linewidth=0.7)
        for value in truths:
            axis.axvline(value, color="#d1242f", linewidth=1.2)
        axis.set_title(name, fontsize=7, pad=2)
        axis.set_yticks([])
        axis.tick_params(labelsize=6)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
    return report.figure_png(figure)


def _widened_profile(result: AsBuilt, name: str, curve: Array) -> Array:
    """(2, points) profile of a parameter, widened to its interval with unstated causes.

    Each side of the value is stretched by (total interval) / (interval within the
    model), about the value.

    Args:
        curve: (2, points) parameter values and profile within the model.
    """
    value = float(result.value[result.names.index(name)])
    sides = zip(result.interval(name), result.within_model(name), strict=True)
    below, above = (
        (outer - value) / (inner - value) if inner != value else 1.0
        for outer, inner in sides
    )
    return np.stack(
        [
            value + np.where(curve[0] < value, below, above) * (curve[0] - value),
            curve[1],
        ]
    )


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


def typical_sigma(name: str) -> float:
    """Typical standard error of a parameter, in its unit.

    Args:
        name: name of the parameter.
    """
    return PARAMETERS[PLACE[name]].scale


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
    from matplotlib.figure import Figure

    fitted = [
        i
        for i, name in enumerate(result.names)
        if name != "log_gain" and not name.startswith("background")
    ]
    names = [result.names[i] for i in fitted]
    unit = np.array([typical_sigma(name) for name in names])
    value = result.value[fitted] / unit
    information = np.diag(
        invert_information(result.within_covariance) - result.information
    )[fitted]
    prior = np.maximum(information, 1e-12) ** -0.5 / unit
    figure = Figure(figsize=(7, 0.22 * len(names) + 0.8))
    axis = figure.add_subplot()
    rows = np.arange(len(names))[::-1]
    axis.barh(
        rows,
        2 * 1.96 * np.minimum(prior, 1e3),
        left=-1.96 * np.minimum(prior, 1e3),
        color="#e4e4e4",
    )
    total_error, model_error = (
        np.abs(
            np.array([interval(name) for name in names]) / unit[:, None]
            - value[:, None]
        ).T
        for interval in (result.interval, result.within_model)
    )
    axis.errorbar(
        value, rows, xerr=model_error, fmt="none", ecolor="#9ec1f7", linewidth=3.5
    )
    axis.errorbar(
        value,
        rows,
        xerr=total_error,
        fmt="o",
        markersize=3,
        color="#1f6feb",
        capsize=2,
        linewidth=1.2,
    )
    axis.axvline(0, color="#444", linewidth=0.8)
    axis.set_yticks(
        rows,
        [f"{name}  (1 = {scale:g})" for name, scale in zip(names, unit, strict=True)],
        fontsize=7,
    )
    axis.set_xscale("symlog", linthresh=1)
    axis.set_xlim(-60, 60)
    axis.set_xlabel(
        "value less design, in typical uncertainties (linear inside +-1)", fontsize=8
    )
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
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
    from matplotlib.figure import Figure

    frame_count = len(residual_sigma)
    band_rows = len(stacks) + 1
    columns = min(12, frame_count)
    bands = -(-frame_count // columns)
    aspect = residual_sigma.shape[1] / residual_sigma.shape[2]
    figure = Figure(
        figsize=(1.15 * columns + 0.4, 1.2 * aspect * band_rows * bands + 0.25 * bands)
    )
    axes = figure.subplots(
        band_rows * bands,
        columns,
        squeeze=False,
        gridspec_kw={"wspace": 0.04, "hspace": 0.06},
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for frame in range(frame_count):
        band, column = divmod(frame, columns)
        cells = axes[band * band_rows : (band + 1) * band_rows, column]
        medians = [float(np.median(stack[frame])) for stack in stacks]
        top = max(
            float(stack[frame].max()) - low
            for stack, low in zip(stacks, medians, strict=True)
        )
        for cell, stack, low in zip(cells, stacks, medians, strict=False):
            cell.imshow(
                np.sqrt(np.maximum(stack[frame] - low, 0)),
                cmap="magma",
                vmin=0,
                vmax=max(top, 1e-9) ** 0.5,
            )
        cells[-1].imshow(residual_sigma[frame], cmap="RdBu_r", vmin=-5, vmax=5)
        cells[0].set_title(titles[frame] if titles else f"{frame}", fontsize=7, pad=3)
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
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 2.7))
    for panel, (values, title, colours) in enumerate(
        (
            (fit.phase_rad, "phase / rad", "twilight"),
            (fit.amplitude, "amplitude", "viridis"),
        ),
        1,
    ):
        axis = figure.add_subplot(1, 2, panel)
        figure.colorbar(axis.imshow(values, cmap=colours), ax=axis)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    return report.figure_png(figure)
