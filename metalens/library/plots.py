"""Figures of pillar libraries and of the cell study."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from metalens.core import report, store
from metalens.core.store import write_bytes
from metalens.library.study import CellStudy, CellVerdict, round_to_tolerance

if TYPE_CHECKING:
    from metalens.library.axes import AxesLibrary
    from metalens.library.fit import ProxyFit
    from metalens.library.record import PillarLibrary

DEG, NM = 180 / np.pi, 1e3


def write_study(folder: Path, study: CellStudy, verdicts: list[CellVerdict]) -> None:
    """Write cell_study.json and cell_study.png to ``folder``, which must exist.

    Args:
        folder: that is written to.
        study: what is compared.
        verdicts: of all its cells.
    """
    values = {"study": asdict(study), "verdicts": [asdict(v) for v in verdicts]}
    store.write_text(
        folder / "cell_study.json",
        json.dumps(round_to_tolerance(values), indent=1) + "\n",
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
    figure, panels = report.make_figure(1, len(study.wavelengths_um), size=(9, 3.6))
    pitches, heights = study.pitches_um, study.heights_um
    for panel, wavelength in zip(np.ravel(panels), study.wavelengths_um, strict=True):
        values = [v.turns for v in verdicts if v.wavelength_um == wavelength]
        turns = np.reshape(values, (len(heights), len(pitches)))
        image = panel.imshow(
            turns, origin="lower", aspect="auto", vmin=0, vmax=2, cmap="RdYlBu"
        )
        for i, j in np.ndindex(*turns.shape):
            panel.text(j, i, f"{turns[i, j]:.2f}", ha="center", va="center", fontsize=7)
        panel.set_xticks(range(len(pitches)), [f"{NM * p:g}" for p in pitches])
        panel.set_yticks(range(len(heights)), [f"{NM * h:g}" for h in heights])
        panel.set(
            title=f"{NM * wavelength:g} nm",
            xlabel="pitch (nm)",
            ylabel="pillar height (nm)",
        )
        panel.grid(visible=False)
    figure.colorbar(image, ax=panels, label="smooth phase (turns)")
    write_bytes(path, report.figure_png(figure))


def library_figure(
    path: Path, library: "PillarLibrary", proxy_fit: "ProxyFit | None"
) -> None:
    """PNG of a library over the diameter: phase, |t| with its error bars, and those
    bars with the tolerance; the domain of the proxy is shaded.

    Args:
        path: of the PNG.
        library: the swept cell.
        proxy_fit: the fit of its proxy; None where there is none.
    """
    figure, panels = report.make_figure(3, 1, size=(7.5, 7), sharex=True)
    phase, level, bars = panels
    d = NM * library.diameter_um
    for i, j, k in np.ndindex(*library.t.shape[:3]):
        t, error = library.t[i, j, k], library.t_error[i, j, k]
        label = f"{NM * library.wavelength_um[k]:g} nm"
        if len(library.angle_rad) > 1:
            label += f", {DEG * library.angle_rad[j]:.3g}° {library.polarization[i]}"
        turns = np.unwrap(np.angle(t)) / (2 * np.pi)
        phase.plot(d, turns - turns[0], label=label)
        level.errorbar(d, np.abs(t), error)
        bars.semilogy(d, error)
    bars.axhline(library.sweep.bar, color="0.5", ls="--")
    if np.prod(library.t.shape[:3]) <= 12:
        phase.legend(fontsize=6, ncols=2)
    cell = library.cell
    phase.set(
        title=f"pitch {NM * cell.pitch_um:g} nm, height {NM * cell.height_um:g} nm, engine {library.engine}",
        ylabel="phase (turns)",
    )
    level.set(ylabel="|t|", ylim=(0, 1.05))
    bars.set(xlabel="diameter (nm)", ylabel="error bar of t")
    if proxy_fit is not None:
        domain_nm = [NM * v for v in proxy_fit.proxy.domain_um]
        for panel in (phase, level):
            panel.axvspan(*domain_nm, color="0.92", zorder=0)
    write_bytes(path, report.figure_png(figure))


def axes_library_figure(path: Path, library: "AxesLibrary") -> None:
    """PNG of a library over two sizes at its first wavelength: phase and |t| of light
    along x and along y. Pairs of sizes above the tolerance are blank.

    Args:
        path: of the PNG.
        library: over two sizes.
    """
    canvas, panels = report.make_figure(2, 2, size=(8, 6.6))
    extent_nm = NM * np.ravel([axis[[0, -1]] for axis in (library.x_um, library.y_um)])
    for row, name in enumerate("xy"):
        own_t = np.where(library.usable[0], library.t[0, ..., row, row], np.nan)
        turns = np.angle(own_t) / (2 * np.pi) % 1
        for panel, values, label, colours in (
            (panels[row][0], turns, "phase / turns", "twilight"),
            (panels[row][1], np.abs(own_t), "|t|", "viridis"),
        ):
            image = panel.imshow(
                values.T, origin="lower", extent=extent_nm, aspect="equal", cmap=colours
            )
            panel.set(
                title=f"{name}-polarised, {NM * library.wavelength_um[0]:g} nm",
                xlabel="along x / nm",
                ylabel="along y / nm",
            )
            panel.grid(visible=False)
            canvas.colorbar(image, ax=panel, label=label, shrink=0.8)
    write_bytes(path, report.figure_png(canvas))
