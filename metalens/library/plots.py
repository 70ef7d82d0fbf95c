"""Figures of pillar libraries and of the cell study, and its numbers."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from metalens.core import report, store
from metalens.core.store import write_bytes
from metalens.core.units import nm
from metalens.library.record import PillarLibrary
from metalens.library.study import CellStudy, CellVerdict


def write_study(folder: Path, study: CellStudy, verdicts: list[CellVerdict]) -> None:
    """Write cell_study.json and cell_study.png to ``folder``, which must exist.

    Numbers have six digits, so that the text is the same on any machine.

    Args:
        folder: that is written to.
        study: what is compared.
        verdicts: of all its cells.
    """
    values = {"study": asdict(study), "verdicts": [asdict(v) for v in verdicts]}
    rounded = json.loads(
        json.dumps(values), parse_float=lambda text: float(f"{float(text):.6g}")
    )
    text = json.dumps(rounded, indent=1) + "\n"
    store.write_text(folder / "cell_study.json", text)
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
        panel.set_xticks(range(len(pitches)), [f"{p / nm:g}" for p in pitches])
        panel.set_yticks(range(len(heights)), [f"{h / nm:g}" for h in heights])
        panel.set(
            title=f"{wavelength / nm:g} nm",
            xlabel="pitch (nm)",
            ylabel="pillar height (nm)",
        )
        panel.grid(visible=False)
    figure.colorbar(image, ax=panels, label="smooth phase (turns)")
    write_bytes(path, report.figure_png(figure))


def library_figure(path: Path, library: PillarLibrary) -> None:
    """PNG of phase, and of |t| with its error bars, over the diameter; the domain of
    the proxy is shaded.

    Args:
        path: of the PNG.
        library: the swept cell.
    """
    figure, (phase, level) = report.make_figure(2, 1, size=(7.5, 5), sharex=True)
    size_nm = library.diameter_um / nm
    for i, j, k in np.ndindex(*library.t.shape[:3]):
        t = library.t[i, j, k]
        label = f"{library.wavelength_um[k] / nm:g} nm"
        if len(library.angle_rad) > 1:
            angle_deg = np.degrees(library.angle_rad[j])
            label += f", {angle_deg:.3g}° {library.polarization[i]}"
        turns = np.unwrap(np.angle(t)) / (2 * np.pi)
        phase.plot(size_nm, turns - turns[0], label=label)
        level.errorbar(size_nm, np.abs(t), library.t_error[i, j, k])
    phase.legend(fontsize=6, ncols=3)
    phase.set(ylabel="phase (turns)", title=library.cell.described)
    level.set(xlabel="diameter (nm)", ylabel="|t|", ylim=(0, 1.05))
    if library.proxy is not None:
        for panel in (phase, level):
            panel.axvspan(*np.divide(library.proxy.domain_um, nm), color="0.92")
    write_bytes(path, report.figure_png(figure))
