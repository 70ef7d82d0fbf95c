"""Tables and plots of a lens over the field angle: distortion, field curvature, light
and MTF.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from metalens.aberrations import OverField
from metalens.core import report
from metalens.core.arrays import Array
from metalens.core.report import Table, figure_png, make_figure

CAPTION = (
    "Over the field angle: distortion; focus behind (+) or before the sensor, of close rays, tangential (drawn "
    "through) and sagittal (dashed); relative illumination and, dotted, vignetting; modulation transfer of all light "
    "through the lens, tangential drawn through, sagittal dashed."
)
MTF_CAPTION = (
    "Modulation transfer over the field, of all light through the lens (T tangential: "
    "along x, S sagittal: along y)."
)


def field_values(aberrations: OverField) -> Any:
    """Every number of one lens, ready for JSON: None in place of nan and inf.

    Args:
        aberrations: over the field.
    """
    return report.finite_or_none({
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name in aberrations.__slots__
        for value in [getattr(aberrations, name)]
    })  # fmt: skip


def field_tables(field_aberrations: Mapping[str, OverField]) -> list[Table]:
    """Table of distortion, foci and light over the field angle, and table of the MTF.

    Args:
        field_aberrations: aberrations over the field by wavelength.
    """
    head = (
        "wavelength", "angle / °", "chief ray x / µm", "distortion / %", "close rays T / µm", "S / µm",
        "vignetting / %", "illumination",
    )  # fmt: skip
    rows, mtf_rows = [], []
    for name, one in field_aberrations.items():
        for k, angle in enumerate(one.angles_deg):
            begin = name if k == 0 else "", f"{angle:g}"
            percent = 100 * one.distortion[k], 100 * one.vignetting[k]
            numbers = (
                one.chief_um[k, 0], percent[0], *one.close_um[k], percent[1],
                one.illumination[k],
            )  # fmt: skip
            rows.append((*begin, *_rounded(np.array(numbers))))
            mtf_rows.append((*begin, *_rounded(one.mtf[k].T.ravel())))
    frequencies = next(iter(field_aberrations.values())).frequencies_per_mm
    columns = [f"{part} at {f:g} / mm" for f in frequencies for part in "TS"]
    return [
        Table(head, rows, _caption(field_aberrations)),
        Table(("wavelength", "angle / °", *columns), mtf_rows, MTF_CAPTION),
    ]


def _caption(field_aberrations: Mapping[str, OverField]) -> str:
    depths = {
        f"{1e-3 * aberrations.depth_um:.4g} mm"
        if math.isfinite(aberrations.depth_um)
        else "infinity"
        for aberrations in field_aberrations.values()
    }
    notes = "".join(
        f"\n{name}: {line}."
        for name, aberrations in field_aberrations.items()
        for line in aberrations.left_out
    )
    return (
        f"Over the field along x, sources at {', '.join(sorted(depths))}. Foci behind "
        "(+) or before the sensor, T tangential and S sagittal; illumination relative "
        f"to 0°.{notes}"
    )


def _rounded(values: Array) -> Any:
    """Numbers of three decimals, None where there is none."""
    return report.finite_or_none((np.round(values, 3) + 0.0).tolist())


def plot_over_field(field_aberrations: Mapping[str, OverField]) -> bytes:
    """PNG of distortion, field curvature, illumination with vignetting, and the MTF of
    every frequency, over the field angle.

    Args:
        field_aberrations: aberrations over the field by wavelength.
    """
    frequencies = next(iter(field_aberrations.values())).frequencies_per_mm
    titles = [
        "distortion / %",
        "focus from the sensor / µm",
        "illumination, vignetting",
        *(f"MTF at {frequency:g} / mm" for frequency in frequencies),
    ]
    figure, panels = make_figure(1, len(titles), size=(3.4 * len(titles), 3.4))
    for number, (name, one) in enumerate(field_aberrations.items()):
        order = np.argsort(one.angles_deg)
        pairs = [one.close_um, *np.moveaxis(one.mtf, 2, 0)]
        curves = [
            (0, 100 * one.distortion, ".-"),
            (2, one.illumination, ".-"),
            (2, one.vignetting, ":"),
        ]
        for panel, pair in zip((1, *range(3, len(titles))), pairs, strict=True):
            curves += [(panel, pair[:, 0], ".-"), (panel, pair[:, 1], ".--")]
        for panel, curve, style in curves:
            panels[panel].plot(
                one.angles_deg[order],
                curve[order],
                style,
                color=f"C{number}",
                label=name,
            )
    if len(field_aberrations) > 1:
        panels[0].legend(fontsize=7)
    for panel, title in zip(panels, titles, strict=True):
        panel.set(title=title, xlabel="field angle / °")
    return figure_png(figure)
