"""A figure of a library over two sizes: phase and level of both polarisations, and
where the bars are too long.
"""

from pathlib import Path
from typing import Any

import numpy as np

from metalens.core import report
from metalens.core.arrays import Array
from metalens.core.store import write_bytes
from metalens.library.axes.record import AxesLibrary

NM = 1e3


def axes_library_figure(path: Path, library: AxesLibrary) -> None:
    """PNG of the first wavelength; pairs of sizes above the tolerance are blank."""
    canvas, panels = report.make_figure(2, 3, size=(11, 6.6))
    t, usable = library.t[0], library.usable[0]
    for row, name in enumerate("xy"):
        own = np.where(usable, t[..., row, row], np.nan)
        title = f"{name}-polarised, {NM * library.wavelength_um[0]:g} nm"
        _map(
            canvas,
            panels[row][0],
            library,
            np.angle(own) / (2 * np.pi) % 1,
            (title, "phase / turns"),
            "twilight",
        )
        _map(canvas, panels[row][1], library, np.abs(own), (title, "|t|"), "viridis")
    bar = np.log10(np.maximum(library.t_error[0], 1e-6))
    _map(
        canvas, panels[0][2], library, bar, ("error bar", "log10 |t - exact|"), "magma"
    )
    _held_out(panels[1][2], library)
    write_bytes(path, report.figure_png(canvas))


def _map(
    canvas: Any,
    panel: Any,
    library: AxesLibrary,
    values: Array,
    words: tuple[str, str],
    colours: str,
) -> None:
    ends = [
        NM * v
        for v in (library.x_um[0], library.x_um[-1], library.y_um[0], library.y_um[-1])
    ]
    image = panel.imshow(
        values.T,
        origin="lower",
        extent=ends,
        aspect="equal",
        cmap=colours,
        interpolation="nearest",
    )
    panel.set(title=words[0], xlabel="along x / nm", ylabel="along y / nm")
    panel.grid(visible=False)
    canvas.colorbar(image, ax=panel, label=words[1], shrink=0.8)


def _held_out(panel: Any, library: AxesLibrary) -> None:
    """Errors of pairs that were solved but not interpolated, over their bars."""
    error, bar = library.held_out[:, 3], library.held_out[:, 4]
    panel.loglog(bar, np.maximum(error, 1e-6), ".")
    ends = np.array([bar.min() / 2, 2 * bar.max()])
    panel.loglog(ends, ends, lw=0.8)
    panel.set(
        title="pairs held out",
        xlabel="error bar of the entry",
        ylabel="error of the interpolation",
    )
