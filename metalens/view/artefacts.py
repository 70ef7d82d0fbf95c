"""Panels of the artefacts of the optics core: library, lens, PSF stack; and of any
other HDF5 artefact, plainly.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from metalens import lens as lenses
from metalens import library as libraries
from metalens import psf
from metalens.core import report, store
from metalens.core.arrays import Array
from metalens.core.errors import StoreError
from metalens.library import axes
from metalens.view import standing
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

MOST_SAMPLES = (
    40_000_000  # float32 values of one figure: 160 MB before they are deflated
)


def library_panels(path: Path) -> list[Panel]:
    """t, r and their error bars over every parameter, with the stretches that
    resonances take.

    Args:
        path: file to read or write.
    """
    made = libraries.load(path)
    axes = [
        SliderAxis("polarisation", list(made.polarization)),
        SliderAxis("angle", np.degrees(made.angle_rad).tolist(), "deg"),
        SliderAxis("wavelength", (1e3 * made.wavelength_um).tolist(), "nm"),
    ]
    x, error = 1e3 * made.diameter_um, made.t_error
    phase = np.unwrap(np.angle(made.t), axis=-1)
    bands = [
        (1e3 * (d - w), 1e3 * (d + w)) for _, _, _, d, w in made.resonances.tolist()
    ]
    return [
        CurvePanel(
            "Transmission of the pillar",
            x,
            "diameter / nm",
            {"|t|": np.abs(made.t), "|r|": np.abs(made.r)},
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
            {
                "phase": np.arcsin(
                    np.minimum(1, error / np.maximum(np.abs(made.t), 1e-12))
                )
                / (2 * math.pi)
            },
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
    """Phase, level and error bar over both sizes; what is left out has phase and level
    0.

    Args:
        path: file to read or write.
    """
    made = axes.load(path)
    names = [
        SliderAxis("polarisation", ["x", "y"]),
        SliderAxis("wavelength", (1e3 * made.wavelength_um).tolist(), "nm"),
    ]
    own = np.stack([made.t[..., k, k] for k in (0, 1)]).swapaxes(
        -1, -2
    )  # the size along x runs to the right
    step = float(made.x_um[1] - made.x_um[0])
    kept = made.usable.swapaxes(-1, -2)
    middle = [1e3 * float(v[0] + v[-1]) / 2 for v in (made.x_um, made.y_um)]
    words = (
        f"Along x the size along x, along y that along y, from their middles ({middle[0]:.4g} and {middle[1]:.4g} nm); "
        f"{1 - made.usable.mean():.1%} is left out (error bars above {made.sweep.bar:g})."
    )
    turns = np.where(kept, np.angle(own) / (2 * math.pi) % 1, 0.0)
    held = [tuple(row) for row in (made.held_out * (1, 1e3, 1e3, 1, 1)).tolist()]
    return [
        ImagePanel("Phase", turns, names, step, "turns", words),
        ImagePanel(
            "Level", np.where(kept, np.abs(own), 0.0), names, step, "|t|", words
        ),
        ImagePanel(
            "Error bar",
            made.t_error.swapaxes(-1, -2),
            names[1:],
            step,
            "|t - exact| at most",
            words,
        ),
        TablePanel(
            "Pairs held out",
            (
                "wavelength",
                "x / nm",
                "y / nm",
                "error of the interpolation",
                "error bar",
            ),
            held,
        ),
    ]


def lens_panels(path: Path) -> list[Panel]:
    """Every pillar, and what it does to the light.

    Args:
        path: file to read or write.
    """
    lens = lenses.load(path)
    diameter = lens.diameters.diameter_um
    if not lens.diameters.plain:
        return [
            standing.draw_pillars(lens),
            standing.draw_phase(lens),
            _section(diameter, lens),
        ]
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
        _section(lens.diameters.diameter_um, lens),
    ]


def _section(diameter: Array, lens: lenses.Lens) -> CurvePanel:
    """Phase along the middle row."""
    middle = diameter[len(diameter) // 2]
    held = middle > 0
    phase = lens.phase_rad()[len(diameter) // 2]
    x = lens.diameters.x_um[held]
    wrapped = (phase[held] / (2 * math.pi)) % 1
    return CurvePanel(
        "Phase along the middle row",
        x,
        "x / µm",
        {"phase modulo a turn": wrapped},
        "turns",
    )


def psf_panels(path: Path) -> list[Panel]:
    """PSFs with sliders over all that they depend on, and the error by cause.

    Args:
        path: file to read or write.
    """
    stack = psf.load(path)
    return [*_psfs([stack], [path.stem]), _budgets([stack], ["error"])]


def lights_panels(path: Path) -> list[Panel]:
    """The PSF files of a folder, a slider over them: one lens in light of several
    wavelengths or polarisations.

    Args:
        path: file to read or write.

    Raises:
        StoreError: a file that is no PSF stack, or of other depths, angles or samples
            than the first.
    """
    files = sorted(path.glob("*.h5"))
    stacks = [psf.load(file) for file in files]
    for file, stack in zip(files, stacks, strict=True):
        for what in ("depths_um", "angles_rad", "step_um"):
            if not np.array_equal(getattr(stack, what), getattr(stacks[0], what)):
                raise StoreError(
                    f"{file} has other {what} than {files[0].name}: look at them one by one"
                )
        if np.shape(stack.intensity) != np.shape(stacks[0].intensity):
            raise StoreError(
                f"{file} has other samples than {files[0].name}: look at them one by one"
            )
    names = [
        f"{file.stem}, {_light(stack)}"
        for file, stack in zip(files, stacks, strict=True)
    ]
    return [*_psfs(stacks, names), _budgets(stacks, names)]


def _light(stack: psf.PsfStack) -> str:
    """Its wavelength, or the first and last of a spectrum."""
    waves = [
        f"{1e3 * w:.4g}" for w in np.asarray(stack.wavelengths_um)[[0, -1]].tolist()
    ]
    return f"{waves[0]} nm" if waves[0] == waves[1] else f"{waves[0]} to {waves[1]} nm"


def _psfs(stacks: list[psf.PsfStack], lights: list[str]) -> list[Panel]:
    """Stacks on one grid, with a slider over them where there are several."""
    first = stacks[0]
    some = slice(
        None, None, math.ceil(len(stacks) * first.intensity.size / MOST_SAMPLES)
    )  # of the depths
    values = np.stack(
        [np.asarray(stack.intensity)[..., some, :, :] for stack in stacks]
    )
    energy = np.stack([np.asarray(stack.energy_um2)[..., some] for stack in stacks])
    depth = 1e-3 * first.depths_um[some]
    names = [SliderAxis("depth", depth.tolist(), "mm")]
    if values.ndim >= 5:
        names.insert(
            0, SliderAxis("field angle", [_angle(pair) for pair in first.angles_rad])
        )
    while values.ndim - 3 > len(names):
        names.insert(
            0,
            SliderAxis("lens", list(range(values.shape[values.ndim - 3 - len(names)]))),
        )
    if len(stacks) > 1:
        names.insert(0, SliderAxis("light", lights))
    else:
        values, energy = values[0], energy[0]
    peak, names = float(values.max()), at_brightest(names, values)
    lines = {
        "peak": values.max(axis=(-2, -1)) / peak,
        "light in the window": energy / energy.max(),
    }
    worst = max(stacks, key=lambda stack: stack.error)
    return [
        ImagePanel(
            "Point spread function",
            values / peak,
            names,
            first.step_um,
            "of the highest peak",
            f"Samples of {first.step_um:g} um; stated relative error {worst.error:.1e} ({worst.reason}).",
            optics=True,
        ),
        CurvePanel(
            "Over depth", depth, "depth / mm", lines, "of the largest", names[:-1]
        ),
    ]


def _budgets(stacks: list[psf.PsfStack], names: list[str]) -> TablePanel:
    """The error of the PSFs by cause; what is not known of a cause is a dash."""
    held = [dataclasses.asdict(stack.budget) for stack in stacks]
    rows = [
        (
            report.in_words(cause),
            *("–" if math.isnan(one[cause]) else one[cause] for one in held),
        )
        for cause in held[0]
    ]
    words = "Relative L2 error of the intensity that each cause brings; –: not known for this lens."
    return TablePanel("Budget of the error", ("cause", *names), rows, words)


def far_field_panels(path: Path) -> list[Panel]:
    """Light over direction cosines, what cones about the axis hold, and the beams.

    Args:
        path: file to read or write.
    """
    stored = store.load(path, "far-field")
    held, about = stored.arrays, stored.attributes
    share = np.asarray(held["share"], float)
    sine = np.asarray(held["sine"])
    angles = held["angles_deg"]
    step = float(sine[1] - sine[0])
    names = [SliderAxis("light from", [_degrees(pair) for pair in angles])]
    edges = np.degrees(
        np.arcsin(np.minimum(1.0, step * np.arange(1, held["rings"].shape[-1] + 1)))
    )
    beams = [
        (_degrees(angles[int(i)]), x, y, part)
        for i, x, y, part in held["beams"].tolist()
    ]
    words = (
        f"Direction cosines along x and y of light of {1e3 * float(about['wavelength_um']):g} nm, in squares "
        f"{step:.3g} wide; relative error {float(np.max(held['error'])):.1e}."
    )
    passed = ", ".join(
        f"{_degrees(pair)}: {part:.3f}"
        for pair, part in zip(angles, held["transmitted"], strict=True)
    )
    cone = {"share": np.cumsum(held["rings"], axis=-1)}
    return [
        ImagePanel(
            "Far field",
            share / share.max(),
            names,
            step,
            "of the brightest",
            words,
            across="sine",
        ),
        CurvePanel(
            "Light within a cone about the axis",
            edges,
            "angle / deg",
            cone,
            "share of the light that passes",
            names,
        ),
        TablePanel(
            "Beams",
            ("light from", "sine x", "sine y", "share"),
            beams,
            f"Passes the pillars from {passed}.",
        ),
    ]


def near_field_panels(path: Path) -> list[Panel]:
    """Both cuts and the maps of a pillar's field: |E|, |H| and the parts of E, and the refractive index.

    Args:
        path: file to read or write.
    """
    stored = store.load(path, "near-field")
    held, about = stored.arrays, stored.attributes
    step = float(about["step_um"])
    heights = SliderAxis("height", (1e3 * held["heights_um"]).tolist(), "nm")
    out: list[Panel] = []
    for name, title in (
        ("xz", "Along x and z"),
        ("yz", "Along y and z"),
        ("xy", "Across, along x and y"),
    ):
        e, h = np.abs(held[f"{name}/e"]), np.abs(held[f"{name}/h"])
        shown = np.stack(
            [
                np.sqrt((e**2).sum(axis=0)),
                *e,
                np.sqrt((h**2).sum(axis=0)),
                held[f"{name}/index"].real,
            ]
        )
        up = shown if name == "xy" else shown[..., ::-1, :]
        parts = SliderAxis("part", ["|E|", "|Ex|", "|Ey|", "|Ez|", "|H|", "index"])
        words = (
            f"For light of {1e3 * float(about['wavelength_um']):g} nm and electric amplitude 1 (H times the impedance "
            f"of vacuum); relative error {float(about[f'error_{name}']):.1e} (root mean square)."
        )
        if name != "xy":
            words += f" Light goes upwards; z from {held['z_um'][0]:.4g} to {held['z_um'][-1]:.4g} um, 0 at the foot."
        out.append(
            ImagePanel(
                title,
                up,
                [parts, heights] if name == "xy" else [parts],
                step,
                "",
                words,
            )
        )
    return out


def _angle(pair: Array) -> str:
    return _degrees(np.degrees(pair))


def _degrees(pair: Array) -> str:
    x, y = pair
    return f"{x:.3g}, {y:.3g} deg"


def plain_panels(path: Path) -> list[Panel]:
    """Any artefact: its arrays as images or curves, its attributes as a table.

    Args:
        path: file to read or write.
    """
    stored = store.load(path)
    out: list[Panel] = []
    for name, array in sorted(stored.arrays.items()):
        if (
            array.dtype.kind not in "fiu"
            or array.size == 0
            or array.size > MOST_SAMPLES
        ):
            continue
        if array.ndim >= 2 and min(array.shape[-2:]) >= 8:
            axes = [
                SliderAxis(f"axis {i}", list(range(n)))
                for i, n in enumerate(array.shape[:-2])
            ]
            out.append(
                ImagePanel(
                    name,
                    _finite(array),
                    axes,
                    1.0,
                    signed=bool(array.min() < 0),
                    across="samples",
                )
            )
        elif array.ndim == 1 and len(array) >= 8:
            out.append(
                CurvePanel(
                    name, np.arange(len(array)), "index", {name: _finite(array)}, ""
                )
            )
    rows = [(key, _short(value)) for key, value in sorted(stored.attributes.items())]
    rows += [
        (name, f"{a.dtype} {tuple(a.shape)}")
        for name, a in sorted(stored.arrays.items())
    ]
    return [*out, TablePanel("Content", ("name", "value"), rows)]


def _finite(array: Array) -> Array:
    return np.asarray(np.nan_to_num(np.asarray(array, float)))


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 200 else text[:197] + "..."
