"""Tables and plots of lenses over the field angle: distortion, field curvature, light
and MTF.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from codesign.settings import LEAST, check_ranges
from metalens.aberrations import OverField, frequencies_per_mm, over_field
from metalens.core import report
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.report import Table, figure_png, make_figure
from metalens.lens import Lens

CAPTION = (
    "Over the field angle: distortion; focus behind (+) or before the sensor, of close rays, tangential (drawn "
    "through) and sagittal (dashed); relative illumination and, dotted, vignetting; modulation transfer of all light "
    "through the lens, tangential drawn through, sagittal dashed."
)


@dataclass(frozen=True, slots=True)
class FieldSetting:
    """How lenses are looked at over the field.

    angles_deg: field angles along x, of either sign; left out, those of [axial].
    frequencies_per_mm: of the MTF; left out, an eighth, a quarter and a half of 2 NA /
    wavelength of the first lens.
    depth_mm: of the sources, inf for collimated light; left out, the focus that each
    lens was made for.
    """

    angles_deg: tuple[float, ...] | None = field(
        default=None, metadata={"signed": True}
    )
    frequencies_per_mm: tuple[float, ...] | None = None
    depth_mm: float | None = None

    def __post_init__(self) -> None:
        empty = [
            name
            for name in ("angles_deg", "frequencies_per_mm")
            if getattr(self, name) == ()
        ]
        if empty:
            raise ConfigError(f"{empty[0]} = (): need one or more")
        above_0 = (LEAST, math.inf)
        check_ranges(
            self, angles_deg=(-84.9, 84.9), frequencies_per_mm=above_0, depth_mm=above_0
        )

    def of(self, lens: Lens, first: Lens, angles_deg: tuple[float, ...]) -> OverField:
        """Aberrations of a lens over the field.

        Args:
            lens: lens to analyse.
            first: lens that gives the default frequencies.
            angles_deg: default field angles.
        """
        return over_field(
            lens,
            self.angles_deg or angles_deg,
            depth_um=None if self.depth_mm is None else 1e3 * self.depth_mm,
            frequencies=self.frequencies_per_mm or frequencies_per_mm(first),
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
        field_aberrations: aberrations over the field by name of the lens.
    """
    head = (
        "lens", "angle / °", "chief ray x / µm", "distortion / %", "close rays T / µm", "S / µm",
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
        Table(("lens", "angle / °", *columns), mtf_rows, "Modulation transfer over the field, of all light through the lens "
              "(T tangential: along x, S sagittal: along y)."),
    ]  # fmt: skip


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
        f"Over the field along x, sources at {', '.join(sorted(depths))}, at the "
        "wavelength of each lens. Foci behind (+) or before the sensor, T tangential "
        f"and S sagittal; illumination relative to 0°.{notes}"
    )


def _rounded(values: Array) -> Any:
    """Numbers of three decimals, None where there is none."""
    return report.finite_or_none((np.round(values, 3) + 0.0).tolist())


def plot_over_field(field_aberrations: Mapping[str, OverField]) -> bytes:
    """PNG of distortion, field curvature, illumination with vignetting, and the MTF of
    every frequency, over the field angle.

    Args:
        field_aberrations: aberrations over the field by name of the lens.
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
