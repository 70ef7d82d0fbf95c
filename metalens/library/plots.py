"""Figures of pillar libraries and of the cell study."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from metalens.core import report, store
from metalens.core.arrays import Array
from metalens.core.store import replace_atomically, write_bytes
from metalens.library.study import (
    CellStudy,
    CellVerdict,
    round_to_tolerance,
    study_markdown,
)

if TYPE_CHECKING:
    from metalens.library.axes import AxesLibrary
    from metalens.library.fit import ProxyFit
    from metalens.library.record import PillarLibrary

DEG, NM = 180 / np.pi, 1e3


def write_study(
    folder: Path, study: CellStudy, verdicts: list[CellVerdict], *, command: str
) -> None:
    """Write cell_study.json, README.md and cell_study.png to ``folder``, which must
    exist.

    Args:
        folder: that is written to.
        study: what is compared.
        verdicts: of all its cells.
        command: that wrote the page, shown in it.
    """
    values = {"study": asdict(study), "verdicts": [asdict(v) for v in verdicts]}
    store.write_text(
        folder / "cell_study.json",
        json.dumps(round_to_tolerance(values), indent=1) + "\n",
    )
    store.write_text(
        folder / "README.md", study_markdown(study, verdicts, command=command)
    )
    study_figure(folder / "cell_study.png", study, verdicts)


def study_figure(path: Path, study: CellStudy, verdicts: list[CellVerdict]) -> None:
    """PNG of the turns covered over pitch and height, one panel per wavelength; the
    colour scale is centred on one full turn.

    Args:
        path: of the PNG.
        study: what is compared.
        verdicts: of all its cells.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained", dpi=110)
    panels = figure.subplots(1, len(study.wavelengths_um), sharey=True, squeeze=False)[
        0
    ]
    pitch = NM * np.array(study.pitches_um)
    height = NM * np.array(study.heights_um)
    for panel, wavelength in zip(panels, study.wavelengths_um, strict=True):
        values = [v.turns for v in verdicts if v.wavelength_um == wavelength]
        turns = np.array(values[: len(height) * len(pitch)]).reshape(
            len(height), len(pitch)
        )
        image = panel.imshow(
            turns, origin="lower", aspect="auto", vmin=0, vmax=2, cmap="RdYlBu"
        )
        for i, j in np.ndindex(*turns.shape):
            weight = "bold" if turns[i, j] >= 1 else "normal"
            panel.text(
                j,
                i,
                f"{turns[i, j]:.2f}",
                ha="center",
                va="center",
                fontsize=7,
                fontweight=weight,
            )
        panel.set_xticks(range(len(pitch)), [f"{p:g}" for p in pitch], fontsize=8)
        panel.set_yticks(range(len(height)), [f"{h:g}" for h in height], fontsize=8)
        panel.set(title=f"{NM * wavelength:g} nm", xlabel="pitch (nm)")
    panels[0].set_ylabel("pillar height (nm)")
    figure.colorbar(image, ax=panels, label="smooth phase (turns)")
    _write(figure, path)


def library_figure(
    path: Path, library: "PillarLibrary", proxy_fit: "ProxyFit | None"
) -> None:
    """PNG of a library over the diameter: phase, |t|, error bars with the tolerance,
    and the residuals of the proxy.

    Args:
        path: of the PNG.
        library: the swept cell.
        proxy_fit: the fit of its proxy; None where there is none.
    """
    figure = Figure(figsize=(7.5, 8.5), layout="constrained", dpi=110)
    phase, level, bars, residual_panel = figure.subplots(
        4, 1, sharex=True, height_ratios=(3, 2, 1.2, 1.8)
    )
    d = NM * library.diameter_um
    for i, j, k in np.ndindex(*library.t.shape[:3]):
        t, error = library.t[i, j, k], library.t_error[i, j, k]
        label = f"{NM * library.wavelength_um[k]:g} nm"
        if len(library.angle_rad) > 1:
            label += f", {DEG * library.angle_rad[j]:.3g}° {library.polarization[i]}"
        magnitude = np.abs(t)
        turns = np.unwrap(np.angle(t)) / (2 * np.pi)
        style: dict[str, Any] = {"lw": 0.9, "elinewidth": 2.5, "alpha": 0.9}
        phase.errorbar(
            d,
            turns - turns[0],
            error / np.maximum(magnitude, error) / (2 * np.pi),
            label=label,
            **style,
        )
        level.errorbar(d, magnitude, error, **style)
        bars.semilogy(d, error, lw=0.9)
    phase.set_ylabel("phase (turns)")
    level.set(ylabel="|t|", ylim=(0, 1.05))
    bars.axhline(library.sweep.bar, color="0.5", lw=0.8, ls="--")
    bars.set_ylabel("error bar of t")
    if library.t.shape[0] * library.t.shape[1] * library.t.shape[2] <= 12:
        phase.legend(fontsize=7)
    cell = library.cell
    phase.set_title(
        f"pitch {NM * cell.pitch_um:g} nm, height {NM * cell.height_um:g} nm, engine {library.engine}"
    )
    if proxy_fit is not None:
        _residuals(residual_panel, library, proxy_fit)
        for panel in (phase, level):
            panel.axvspan(
                *(NM * v for v in proxy_fit.proxy.domain_um), color="0.92", zorder=0
            )
    residual_panel.set(xlabel="diameter (nm)", ylabel="proxy - library")
    _write(figure, path)


def _residuals(panel: Any, library: "PillarLibrary", fit: "ProxyFit") -> None:
    """Plot the deviation of the proxy from the entries of its domain, phase (rad) and
    |T|, averaged over the polarisations.
    """
    proxy = fit.proxy
    low, high = proxy.domain_um
    inside = (library.diameter_um >= low - 1e-9) & (library.diameter_um <= high + 1e-9)
    d = library.diameter_um[inside]
    mean = library.t[..., inside].mean(axis=0)
    is_first = True
    for j, k in np.ndindex(*mean.shape[:2]):
        light = (float(library.wavelength_um[k]), float(library.angle_rad[j]))
        phase_error = np.angle(np.exp(1j * proxy.phase_rad(d, *light)) / mean[j, k])
        panel.plot(
            NM * d, phase_error, "C0.", ms=2, label="phase (rad)" if is_first else None
        )
        panel.plot(
            NM * d,
            proxy.transmission(d, *light) - np.abs(mean[j, k]),
            "C1.",
            ms=2,
            label="|T|" if is_first else None,
        )
        is_first = False
    panel.legend(fontsize=7)


def _write(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    with replace_atomically(path) as part:
        figure.savefig(part, format="png", metadata={"Software": "metalens"})


def axes_library_figure(path: Path, library: "AxesLibrary") -> None:
    """PNG of a library over two sizes at its first wavelength: phase, |t|, error bars
    and held-out pairs.

    Pairs of sizes above the tolerance are blank.

    Args:
        path: of the PNG.
        library: over two sizes.
    """
    canvas, panels = report.make_figure(2, 3, size=(11, 6.6))
    t, usable = library.t[0], library.usable[0]
    for row, name in enumerate("xy"):
        own_t = np.where(usable, t[..., row, row], np.nan)
        title = f"{name}-polarised, {NM * library.wavelength_um[0]:g} nm"
        _map(
            canvas,
            panels[row][0],
            library,
            np.angle(own_t) / (2 * np.pi) % 1,
            (title, "phase / turns"),
            "twilight",
        )
        _map(canvas, panels[row][1], library, np.abs(own_t), (title, "|t|"), "viridis")
    bar = np.log10(np.maximum(library.t_error[0], 1e-6))
    _map(
        canvas, panels[0][2], library, bar, ("error bar", "log10 |t - exact|"), "magma"
    )
    _held_out(panels[1][2], library)
    write_bytes(path, report.figure_png(canvas))


def _map(
    canvas: Any,
    panel: Any,
    library: "AxesLibrary",
    values: Array,
    labels: tuple[str, str],
    colours: str,
) -> None:
    """Draw (x, y) values over the two sizes, with a colour bar.

    Args:
        canvas: figure that takes the colour bar.
        panel: axes of the map.
        library: whose sizes are the axes.
        values: (m, n).
        labels: title, and label of the colour bar.
        colours: name of the colour map.
    """
    extent_nm = [
        NM * v
        for v in (library.x_um[0], library.x_um[-1], library.y_um[0], library.y_um[-1])
    ]
    image = panel.imshow(
        values.T,
        origin="lower",
        extent=extent_nm,
        aspect="equal",
        cmap=colours,
        interpolation="nearest",
    )
    panel.set(title=labels[0], xlabel="along x / nm", ylabel="along y / nm")
    panel.grid(visible=False)
    canvas.colorbar(image, ax=panel, label=labels[1], shrink=0.8)


def _held_out(panel: Any, library: "AxesLibrary") -> None:
    """Plot the errors of the held-out pairs over their error bars."""
    error, bar = library.held_out[:, 3], library.held_out[:, 4]
    panel.loglog(bar, np.maximum(error, 1e-6), ".")
    ends = np.array([bar.min() / 2, 2 * bar.max()])
    panel.loglog(ends, ends, lw=0.8)
    panel.set(
        title="pairs held out",
        xlabel="error bar of the entry",
        ylabel="error of the interpolation",
    )
