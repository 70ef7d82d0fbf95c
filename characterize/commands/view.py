"""Panels of a capture (its frames) and of an as-built lens: frames, fit and residual;
parameters; PSFs.
"""

from pathlib import Path

import numpy as np

from characterize.captures import capture as captures
from characterize.inference import AsBuilt
from characterize.model import PARAMETERS, PLACE
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.report import in_words
from metalens.psf import PsfStack
from metalens.view import ImagePanel, Panel, SliderAxis, TablePanel, at_brightest


def capture_panels(path: Path) -> list[Panel]:
    """Every frame of a capture, in counts, and what was written down with it.

    Args:
        path: the file.
    """
    read = captures.load(path)
    frames = np.asarray(read.frames, float)
    step = read.pixel_um if np.isfinite(read.pixel_um) else 1.0
    rows = [
        (
            name,
            *(
                round(float(v), 6) if np.isfinite(v) else "not stated"
                for v in (position, *np.degrees(angle), exposure)
            ),
        )
        for name, position, angle, exposure in zip(
            read.names, read.position_um, read.angle_rad, read.exposure_s, strict=True
        )
    ]
    about: list[tuple[str, object]] = [
        ("converter / bits", read.bits),
        ("pixel / µm", read.pixel_um),
        ("wavelength / µm", read.wavelength_um),
    ]
    about += [(in_words(key), str(value)) for key, value in sorted(read.about.items())]
    about += [("put right", text) for text in read.corrections]
    return [
        ImagePanel(
            "Frames", frames, [SliderAxis("frame", list(read.names))], step, "counts"
        ),
        TablePanel(
            "Stage",
            (
                "frame",
                "position / µm",
                "x angle / deg",
                "y angle / deg",
                "exposure / s",
            ),
            rows,
        ),
        TablePanel("As captured", ("name", "value"), about),
    ]


def asbuilt_panels(path: Path) -> list[Panel]:
    """The lens as built: its parameters with intervals, frames beside fit and residual,
    and its PSFs.

    Args:
        path: the file.
    """
    made = AsBuilt.load(path)
    axis = [
        SliderAxis(
            "frame",
            [_said(d, a) for d, a in zip(made.depth_um, made.angle_rad, strict=True)],
        )
    ]
    peak = float(made.measured.max())
    panels: list[Panel] = [
        TablePanel(
            "Parameters",
            ("parameter", "value", "95 % from", "to", "meaning"),
            [
                (name, float(v), *made.interval(name), PARAMETERS[PLACE[name]].meaning)
                for name, v in zip(made.names, made.value, strict=True)
            ],
        ),
        ImagePanel(
            "Frames as captured and as fitted",
            np.stack([made.measured, made.predicted]) / peak,
            [SliderAxis("shown", ["captured", "fitted"], blink=True), *axis],
            made.pixel_um,
            "of the brightest pixel",
        ),
        ImagePanel(
            "Captured less fitted",
            made.residual_sigma,
            axis,
            made.pixel_um,
            "sigma",
            signed=True,
        ),
        TablePanel("What is known", ("", "in words"), _words(made)),
    ]
    return [*panels, _psf(made.psf())]


def pupil_panels(path: Path) -> list[Panel]:
    """Any microscope pupil: its phase and amplitude, the stack beside the fit, and the
    numbers.

    Args:
        path: the file.
    """
    stored = store.load(path, "pupil")
    held, about = stored.arrays, stored.attributes
    names = [
        name.decode() if isinstance(name, bytes) else str(name)
        for name in held["names"].tolist()
    ]
    rows = list(zip(names, held["value"].tolist(), held["sigma"].tolist(), strict=True))
    planes = [SliderAxis("plane", held["position_um"].tolist(), "µm")]
    both = np.stack([held["measured"], held["predicted"]])
    step = 2 / held["phase_rad"].shape[-1]
    said = [(in_words(key), str(about[key])) for key in sorted(about) if key != "spec"]
    return [
        ImagePanel(
            "Phase in the pupil",
            np.nan_to_num(held["phase_rad"]),
            [],
            step,
            "rad",
            signed=True,
            across="radius",
        ),
        ImagePanel(
            "Amplitude in the pupil",
            np.nan_to_num(held["amplitude"]),
            [],
            step,
            "of its mean",
            across="radius",
        ),
        ImagePanel(
            "Stack as measured and as fitted",
            both / both.max(),
            [SliderAxis("shown", ["measured", "fitted"], blink=True), *planes],
            1.0,
            "of the brightest pixel",
            across="pixels",
        ),
        ImagePanel(
            "Measured less fitted",
            held["residual_sigma"],
            planes,
            1.0,
            "sigma",
            signed=True,
            across="pixels",
        ),
        TablePanel("Parameters", ("parameter", "value", "standard error"), rows),
        TablePanel("How good it is", ("", "value"), said),
    ]


def _psf(stack: PsfStack) -> Panel:
    values = np.asarray(stack.intensity)
    axes = [
        SliderAxis("field angle", [_said(None, pair) for pair in stack.angles_rad]),
        SliderAxis("depth", (1e-3 * stack.depths_um).tolist(), "mm"),
    ]
    values = values.reshape(
        len(axes[0].values), len(axes[1].values), *values.shape[-2:]
    )
    peak = float(values.max())
    return ImagePanel(
        "PSF as built",
        values / peak,
        at_brightest(axes, values),
        stack.step_um,
        "of the highest peak",
        optics=True,
    )


def _said(depth_um: float | None, angle_rad: Array) -> str:
    x, y = np.degrees(angle_rad)
    turn = f"{x:.3g}, {y:.3g} deg"
    return turn if depth_um is None else f"{1e-3 * depth_um:.4g} mm, {turn}"


def _words(made: AsBuilt) -> list[tuple[str, str]]:
    found = [("verdict", text) for text in made.verdicts]
    found += [("problem", text) for text in made.problems] + [
        ("caution", text) for text in made.cautions
    ]
    found += [("cannot be told apart", text) for text in made.degeneracies]
    return [
        *found,
        ("chi² per degree of freedom", f"{made.chi2_per_dof:.3f}"),
        ("search", made.reason),
    ]
