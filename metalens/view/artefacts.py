"""Panels of the artefacts of the optics core: library, lens, PSFs."""

import dataclasses
import math
from pathlib import Path

import numpy as np

from metalens import lens as lenses
from metalens import library as libraries
from metalens import psf
from metalens.core import report
from metalens.core.arrays import Array
from metalens.library import axes
from metalens.view.panels import (
    ClassMapPanel,
    CurvePanel,
    ImagePanel,
    Panel,
    SliderAxis,
    TablePanel,
    at_brightest,
    classes_of,
)

MOST_SAMPLES = 40_000_000  # float32 values of one figure: 160 MB before compression


def library_panels(path: Path) -> list[Panel]:
    """Curves of t, r, phase and error bar over the diameter; resonances are shaded.

    Args:
        path: of the library.
    """
    library = libraries.load(path)
    axes = [
        SliderAxis("polarisation", list(library.polarization)),
        SliderAxis("angle", np.degrees(library.angle_rad).tolist(), "deg"),
        SliderAxis("wavelength", (1e3 * library.wavelength_um).tolist(), "nm"),
    ]
    x = 1e3 * library.diameter_um
    error = library.t_error
    phase = np.unwrap(np.angle(library.t), axis=-1)
    relative = error / np.maximum(np.abs(library.t), 1e-12)
    phase_error = np.arcsin(np.minimum(1, relative))
    bands = [
        (1e3 * (diameter - width), 1e3 * (diameter + width))
        for _, _, _, diameter, width in library.resonances.tolist()
    ]
    return [
        CurvePanel(
            "Transmission of the pillar",
            x,
            "diameter / nm",
            {"|t|": np.abs(library.t), "|r|": np.abs(library.r)},
            "magnitude",
            axes,
            {"|t|": error, "|r|": error},
            bands,
            f"Bands: error bars of the solver, at most {error.max():.1e}. Shaded: resonances, to their half-width.",
        ),
        CurvePanel(
            "Phase of the pillar",
            x,
            "diameter / nm",
            {"phase": phase / (2 * math.pi)},
            "turns",
            axes,
            {"phase": phase_error / (2 * math.pi)},
            bands,
        ),
        CurvePanel(
            "Error bar of t",
            x,
            "diameter / nm",
            {"error bar": error},
            "|t - exact| at most",
            axes,
            scale="log",
        ),
    ]


def axes_panels(path: Path) -> list[Panel]:
    """Images of phase, |t| and error bar over both sizes.

    Excluded pairs of sizes have phase and |t| 0.

    Args:
        path: of the library.
    """
    library = axes.load_axes_library(path)
    names = [
        SliderAxis("polarisation", ["x", "y"]),
        SliderAxis("wavelength", (1e3 * library.wavelength_um).tolist(), "nm"),
    ]
    t = np.stack([library.t[..., k, k] for k in (0, 1)]).swapaxes(
        -1, -2
    )  # the size along x runs to the right
    step = float(library.x_um[1] - library.x_um[0])
    usable = library.usable.swapaxes(-1, -2)
    middle = [1e3 * float(v[0] + v[-1]) / 2 for v in (library.x_um, library.y_um)]
    words = (
        f"Along x the size along x, along y that along y, from their middles ({middle[0]:.4g} and {middle[1]:.4g} nm); "
        f"{1 - library.usable.mean():.1%} is left out (error bars above {library.sweep.bar:g})."
    )
    turns = np.where(usable, np.angle(t) / (2 * math.pi) % 1, 0.0)
    return [
        ImagePanel("Phase", turns, names, step, "turns", words),
        ImagePanel(
            "Level", np.where(usable, np.abs(t), 0.0), names, step, "|t|", words
        ),
        ImagePanel(
            "Error bar",
            library.t_error.swapaxes(-1, -2),
            names[1:],
            step,
            "|t - exact| at most",
            words,
        ),
    ]


def lens_panels(path: Path) -> list[Panel]:
    """A map of every pillar with its phase and |T|, and the phase along the middle row.

    Of turned pillars, of two sizes, or on another lattice the phase alone.

    Args:
        path: of the lens.
    """
    lens = lenses.load(path)
    diameter = lens.diameters.diameter_um
    if not lens.diameters.plain:
        return [_section(lens)]
    index, sizes = classes_of(diameter)
    return [
        ClassMapPanel(
            "Pillars",
            index,
            1e3 * sizes,
            lens.diameters.pitch_um,
            "nm",
            "Diameters. Drag to move, wheel or + and - to zoom: far away the mean over the sites of a pixel is shown, "
            "near by every pillar in its size.",
            {
                "phase / turns": lens.proxy.phase_rad(sizes, lens.wavelength_um)
                / (2 * math.pi),
                "|T|": lens.proxy.transmission(sizes, lens.wavelength_um),
            },
        ),
        _section(lens),
    ]


def _section(lens: lenses.Lens) -> CurvePanel:
    """Phase modulo one turn along the middle row of pillars."""
    row = len(lens.diameters.diameter_um) // 2
    pillars = lens.diameters.diameter_um[row] > 0
    return CurvePanel(
        "Phase along the middle row",
        lens.diameters.x_um[pillars],
        "x / µm",
        {"phase modulo a turn": (lens.phase_rad()[row][pillars] / (2 * math.pi)) % 1},
        "turns",
    )


def psf_panels(path: Path) -> list[Panel]:
    """PSFs with sliders over angle, depth and so on, their peak and energy over depth,
    and the error by cause.

    Of a large stack every n-th depth is shown.

    Args:
        path: of the PSFs.
    """
    stack = psf.load(path)
    shown = slice(None, None, math.ceil(stack.intensity.size / MOST_SAMPLES))
    values = np.asarray(stack.intensity)[..., shown, :, :]
    energy = np.asarray(stack.energy_um2)[..., shown]
    depth = 1e-3 * stack.depths_um[shown]
    sliders = [SliderAxis("depth", depth.tolist(), "mm")]
    if values.ndim >= 4:
        angles = [_degrees(np.degrees(pair)) for pair in stack.angles_rad]
        sliders.insert(0, SliderAxis("field angle", angles))
    while values.ndim - 2 > len(sliders):
        count = values.shape[values.ndim - 3 - len(sliders)]
        sliders.insert(0, SliderAxis("lens", list(range(count))))
    peak = float(values.max())
    sliders = at_brightest(sliders, values)
    lines = {
        "peak": values.max(axis=(-2, -1)) / peak,
        "light in the window": energy / energy.max(),
    }
    causes = [
        (report.in_words(cause), "–" if math.isnan(error) else error)
        for cause, error in dataclasses.asdict(stack.budget).items()
    ]
    return [
        ImagePanel(
            "Point spread function",
            values / peak,
            sliders,
            stack.step_um,
            "of the highest peak",
            f"Samples of {stack.step_um:g} um; stated relative error {stack.error:.1e} ({stack.reason}).",
            optics=True,
        ),
        CurvePanel(
            "Over depth", depth, "depth / mm", lines, "of the largest", sliders[:-1]
        ),
        TablePanel(
            "Budget of the error",
            ("cause", "error"),
            causes,
            "Relative L2 error of the intensity that each cause brings; –: not known for this lens.",
        ),
    ]


def _degrees(pair: Array) -> str:
    x, y = pair
    return f"{x:.3g}, {y:.3g} deg"
