"""Tables and plots of lenses over the field angle: distortion, field curvature, light
and MTF.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from metalens.aberrations import OverField, frequencies_per_mm, over_field
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.report import Table, figure_png, make_figure
from metalens.lens import Lens

CAPTIONS = {
    "field": "Over the field angle: distortion; focus behind (+) or before the sensor, of close rays, "
    "tangential (drawn through) and sagittal (dashed); relative illumination and, dotted, vignetting.",
    "mtf": "Modulation transfer over the field angle, of all light through the lens, a frequency each: tangential "
    "drawn through, sagittal dashed.",
}


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
        angles, frequencies = self.angles_deg, self.frequencies_per_mm
        if angles is not None and not (angles and max(map(abs, angles)) < 85):
            raise ConfigError(
                f"angles_deg = {angles}: need one field angle or more, between -85 and 85"
            )
        if frequencies is not None and not (frequencies and min(frequencies) > 0):
            raise ConfigError(
                f"frequencies_per_mm = {frequencies}: need one or more, all above 0"
            )
        if self.depth_mm is not None and not self.depth_mm > 0:
            raise ConfigError(
                f"depth_mm = {self.depth_mm}: need a depth above 0, or inf"
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


def field_values(aberrations: OverField) -> dict[str, Any]:
    """Every number of one lens, ready for JSON: None in place of nan and inf.

    Args:
        aberrations: aberrations over the field.
    """
    arrays = {
        name: _json_value(np.asarray(getattr(aberrations, name)))
        for name in aberrations.__slots__
        if name != "left_out"
    }
    return arrays | {"left_out": list(aberrations.left_out)}


def _json_value(array: Array) -> Any:
    """Nested lists of floats, None in place of nan and inf."""
    if array.ndim:
        return [_json_value(part) for part in array]
    return float(array) if math.isfinite(array) else None


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
    for name, aberrations in field_aberrations.items():
        for k, angle in enumerate(aberrations.angles_deg):
            label = name if k == 0 else ""
            focus = [_format_value(value, 1) for value in aberrations.close_um[k]]
            distortion, vignetting = (
                _format_value(100 * value[k], 2)
                for value in (aberrations.distortion, aberrations.vignetting)
            )
            chief_ray = _format_value(aberrations.chief_um[k, 0], 2)
            light = _format_value(aberrations.illumination[k], 3)
            rows.append(
                (label, f"{angle:g}", chief_ray, distortion, *focus, vignetting, light)
            )
            mtf = [
                _format_value(value, 3)
                for pair in aberrations.mtf[k].T
                for value in pair
            ]
            mtf_rows.append((label, f"{angle:g}", *mtf))
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
        f"Over the field along x, sources at {', '.join(sorted(depths))}, design wavelength. Foci behind (+) or before "
        f"the sensor, T tangential and S sagittal; illumination relative to 0°.{notes}"
    )


def _format_value(value: float, digits: int) -> str:
    if not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def plot_over_field(field_aberrations: Mapping[str, OverField]) -> bytes:
    """PNG of distortion, field curvature, illumination and vignetting over the field
    angle.

    Args:
        field_aberrations: aberrations over the field by name of the lens.
    """
    figure, panels = make_figure(1, 3, size=(10.5, 3.4))
    for name, aberrations in field_aberrations.items():
        order = np.argsort(aberrations.angles_deg)
        angle = aberrations.angles_deg[order]
        colour = (
            panels[0]
            .plot(angle, 100 * aberrations.distortion[order], ".-", label=name)[0]
            .get_color()
        )
        for axis, style in ((0, "-"), (1, "--")):
            panels[1].plot(
                angle, aberrations.close_um[order, axis], style, color=colour
            )
        panels[2].plot(angle, aberrations.illumination[order], ".-", color=colour)
        panels[2].plot(angle, aberrations.vignetting[order], ":", color=colour)
    panels[0].set(title="distortion", ylabel="distortion / %")
    panels[1].set(title="field curvature", ylabel="focus from the sensor / µm")
    panels[2].set(
        title="illumination and vignetting", ylabel="share", ylim=(-0.03, None)
    )
    panels[0].legend(fontsize=7)
    for panel in panels:
        panel.set_xlabel("field angle / °")
    return figure_png(figure)


def mtf_picture(field_aberrations: Mapping[str, OverField]) -> bytes:
    """PNG of the MTF over the field angle, a panel for each frequency.

    Args:
        field_aberrations: aberrations over the field by name of the lens.
    """
    frequencies = next(iter(field_aberrations.values())).frequencies_per_mm
    figure, panels = make_figure(
        1,
        len(frequencies),
        size=(1 + 3.2 * len(frequencies), 3.2),
        squeeze=False,
        sharey=True,
    )
    for name, aberrations in field_aberrations.items():
        order = np.argsort(aberrations.angles_deg)
        for k, panel in enumerate(panels[0]):
            line = panel.plot(
                aberrations.angles_deg[order],
                aberrations.mtf[order, 0, k],
                ".-",
                label=name,
            )
            colour = line[0].get_color()
            panel.plot(
                aberrations.angles_deg[order],
                aberrations.mtf[order, 1, k],
                ".--",
                color=colour,
            )
    for panel, frequency in zip(panels[0], frequencies, strict=True):
        panel.set(
            title=f"{frequency:g} periods per mm", xlabel="field angle / °", ylim=(0, 1)
        )
    panels[0, 0].set_ylabel("modulation")
    panels[0, 0].legend(fontsize=7)
    return figure_png(figure)
