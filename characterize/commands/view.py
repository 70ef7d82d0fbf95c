"""Panels of a capture (its frames) and of an as-built lens: frames, fit and residual;
parameters; PSFs.
"""

import math
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
    """Panels of a capture: its frames in counts, its stage table, its description.

    Args:
        path: the file.
    """
    capture = captures.load(path)
    step = capture.pixel_um if np.isfinite(capture.pixel_um) else 1.0
    columns = (
        capture.position_um,
        *np.degrees(capture.angle_rad).T,
        capture.exposure_s,
    )
    numbers = np.stack(columns, 1).round(6).tolist()
    rows = [
        (name, *("not stated" if math.isnan(v) else v for v in values))
        for name, values in zip(capture.names, numbers, strict=True)
    ]
    description: list[tuple[str, object]] = [
        ("converter / bits", capture.bits),
        ("pixel / µm", capture.pixel_um),
        ("wavelength / µm", capture.wavelength_um),
    ]
    description += [
        (in_words(key), str(value)) for key, value in sorted(capture.about.items())
    ]
    description += [("put right", text) for text in capture.corrections]
    return [
        ImagePanel(
            "Frames",
            np.asarray(capture.frames, float),
            [SliderAxis("frame", list(capture.names))],
            step,
            "counts",
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
        TablePanel("As captured", ("name", "value"), description),
    ]


def asbuilt_panels(path: Path) -> list[Panel]:
    """Panels of an as-built lens: parameters with intervals, measured and fitted
    frames, residuals, PSFs.

    Args:
        path: the file.
    """
    lens = AsBuilt.load(path)
    axis = [
        SliderAxis(
            "frame",
            [
                _frame_label(d, a)
                for d, a in zip(lens.depth_um, lens.angle_rad, strict=True)
            ],
        )
    ]
    peak = float(lens.measured.max())
    panels: list[Panel] = [
        TablePanel(
            "Parameters",
            ("parameter", "value", "95 % from", "to", "meaning"),
            [
                (name, float(v), *lens.interval(name), PARAMETERS[PLACE[name]].meaning)
                for name, v in zip(lens.names, lens.value, strict=True)
            ],
        ),
        ImagePanel(
            "Frames as captured and as fitted",
            np.stack([lens.measured, lens.predicted]) / peak,
            [SliderAxis("shown", ["captured", "fitted"], blink=True), *axis],
            lens.pixel_um,
            "of the brightest pixel",
        ),
        ImagePanel(
            "Captured less fitted",
            lens.residual_sigma,
            axis,
            lens.pixel_um,
            "sigma",
            signed=True,
        ),
        TablePanel("What is known", ("", "in words"), _words(lens)),
    ]
    return [*panels, _psf(lens.psf())]


def pupil_panels(path: Path) -> list[Panel]:
    """Panels of a pupil file: phase and amplitude, measured and fitted stack,
    residuals, parameters, agreement.

    Args:
        path: the file.
    """
    stored = store.load(path, "pupil")
    arrays, attributes = stored.arrays, stored.attributes
    names = [name.decode() for name in arrays["names"].tolist()]
    rows = list(
        zip(names, arrays["value"].tolist(), arrays["sigma"].tolist(), strict=True)
    )
    planes = [SliderAxis("plane", arrays["position_um"].tolist(), "µm")]
    both = np.stack([arrays["measured"], arrays["predicted"]])
    step = 2 / arrays["phase_rad"].shape[-1]
    attribute_rows = [
        (in_words(key), str(attributes[key]))
        for key in sorted(attributes)
        if key != "spec"
    ]
    return [
        ImagePanel(
            "Phase in the pupil",
            np.nan_to_num(arrays["phase_rad"]),
            [],
            step,
            "rad",
            signed=True,
            across="radius",
        ),
        ImagePanel(
            "Amplitude in the pupil",
            np.nan_to_num(arrays["amplitude"]),
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
            arrays["residual_sigma"],
            planes,
            1.0,
            "sigma",
            signed=True,
            across="pixels",
        ),
        TablePanel("Parameters", ("parameter", "value", "standard error"), rows),
        TablePanel("How good it is", ("", "value"), attribute_rows),
    ]


def _psf(stack: PsfStack) -> Panel:
    """Panel of PSFs over field angle and depth, as shares of the highest peak."""
    values = np.asarray(stack.intensity)
    axes = [
        SliderAxis(
            "field angle", [_frame_label(None, pair) for pair in stack.angles_rad]
        ),
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


def _frame_label(depth_um: float | None, angle_rad: Array) -> str:
    x, y = np.degrees(angle_rad)
    turn = f"{x:.3g}, {y:.3g} deg"
    return turn if depth_um is None else f"{1e-3 * depth_um:.4g} mm, {turn}"


def _words(lens: AsBuilt) -> list[tuple[str, str]]:
    """(kind, sentence) of every verdict, problem, caution and degeneracy."""
    rows = [("verdict", text) for text in lens.verdicts]
    rows += [("problem", text) for text in lens.problems] + [
        ("caution", text) for text in lens.cautions
    ]
    rows += [("not identifiable", text) for text in lens.degeneracies]
    return [
        *rows,
        ("chi² per degree of freedom", f"{lens.chi2_per_dof:.3f}"),
        ("search", lens.reason),
    ]
