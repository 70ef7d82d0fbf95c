"""lens.h5 to a page over field and wavelength: focus and its diffraction limit, MTF,
distortion, field curvature, efficiency by cause.
"""

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from codesign.commands.options.lens_report import Options
from codesign.evaluate import field_page
from metalens import design, lens, psf
from metalens.aberrations import OverField, frequencies_per_mm, over_field
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.report import Figure, KeyFigure, Section, Table, write_report
from metalens.lens import reach
from metalens.psf import plots

FIELDS = 5  # field angles where none are given
AIRY, SAMPLES = 28.0, 192  # window in wavelength / NA, samples across it


@dataclass(frozen=True, eq=False, slots=True)
class LensAtWavelength:
    """A lens at one wavelength over its field angles.

    focus: (angles,) FWHM, Strehl ratio, MTF50 and focusing efficiency.
    shares: (angles, 3) light behind the pillars over that on the aperture (reflection,
    absorption and other orders take the rest), share of it in the window of the PSF,
    share of that within three FWHM; their product is the efficiency.
    stack: PSFs (angle, y, x) they were measured on. field: aberrations.
    """

    focus: tuple[psf.FocusMetrics, ...]
    shares: Array
    stack: psf.PsfStack
    field: OverField

    @property
    def name(self) -> str:
        """The wavelength in words."""
        return f"{1e3 * self.stack.wavelengths_um[0]:g} nm"


def run(options: Options) -> int:
    """Measure the lens over field and wavelength and write the page.

    Exit status 1 where the error estimate of a PSF stays above the tolerance.

    Args:
        options: of the command line.
    """
    device = lens.load(options.lens)
    view = _view(options, device)
    waves_um = [nm * 1e-3 for nm in options.wavelengths_nm] or [device.wavelength_um]
    with options.claim(options.output, companions=(".json",)) as draft:
        measured = [
            measure_lens(
                replace(device, wavelength_um=wave),
                view,
                tolerance=options.tolerance,
                frequencies=options.frequencies_per_mm or frequencies_per_mm(device),
            )
            for wave in options.console.track(
                waves_um, total=len(waves_um), label="wavelengths"
            )
        ]
        values = {one.name: report_values(one) for one in measured}
        text = json.dumps(values, indent=1) + "\n"
        store.write_text(draft.path.with_suffix(".json"), text)
        fields = {one.name: one.field for one in measured}
        shown = [focus_table(measured), *field_page.field_tables(fields)]
        _write_page(draft.path, options.lens.name, measured, shown)
    failures = [
        f"{one.name}: the relative error {one.stack.error:.2g} is above the tolerance "
        f"{options.tolerance:g}"
        for one in measured
        if not one.stack.converged
    ]
    text = "\n\n".join(table.text for table in shown)
    return options.console.judged(values, f"{text}\n\n{options.output}", failures)


def _view(options: Options, device: lens.Lens) -> psf.View:
    """Depth, angles and window of the PSFs.

    Raises:
        ConfigError: a depth or wavelength that is not above 0.
    """
    depth_um = device.source_distance_um
    if options.depth_mm is not None:
        depth_um = 1e3 * options.depth_mm
    if not (depth_um > 0 and all(nm > 0 for nm in options.wavelengths_nm)):
        raise ConfigError(
            f"depth_mm = {options.depth_mm}, wavelengths_nm = {options.wavelengths_nm}: "
            "need lengths above 0"
        )
    angles_deg = options.angles_deg
    if not angles_deg:
        radius_um = device.diameters.radius_um + device.diameters.pitch_um / 2
        edge = design.field_angle(design.lens_focus(device), radius_um)
        angles_deg = tuple(np.linspace(0, math.degrees(edge), FIELDS).tolist())
    return psf.View(
        (depth_um,),
        tuple((math.radians(angle), 0.0) for angle in angles_deg),
        reach.window_um(device, (depth_um,), airy=AIRY),
        SAMPLES,
    )


def measure_lens(
    device: lens.Lens,
    view: psf.View,
    *,
    tolerance: float,
    frequencies: tuple[float, ...],
) -> LensAtWavelength:
    """Focus, efficiency and aberrations of a lens at its wavelength.

    Args:
        device: the lens.
        view: one depth, angles and window.
        tolerance: relative L2 error of the PSFs.
        frequencies: of the MTF over the field, per mm.
    """
    stack = psf.from_lens(device, view, tolerance=tolerance)
    focus = psf.focus_metrics(stack, device, power_error=design.power_error(device))
    shares = []
    for one in focus:
        passed = float(psf.passed_um2(device, one.angle_rad, view.depths_um)[0])
        passed /= psf.incident_um2(device, one.angle_rad, view.depths_um[0])
        within = one.efficiency / (passed * one.window_share)
        shares.append((passed, one.window_share, within))
    angles_deg = tuple(math.degrees(x) for x, _ in view.angles_rad)
    field = over_field(
        device, angles_deg, depth_um=view.depths_um[0], frequencies=frequencies
    )
    return LensAtWavelength(focus, np.array(shares), stack, field)


def focus_table(measured: list[LensAtWavelength]) -> Table:
    """Table of the focus: a row for each wavelength and field angle, errors of one
    sigma, and the diffraction limit of the aperture.

    Args:
        measured: the lens at each wavelength.
    """
    head = (
        "wavelength", "angle / °", "FWHM / µm", "limit", "Strehl", "MTF50 T / mm⁻¹", "S", "limit",
        "efficiency", "limit", "behind the pillars", "in the window", "in three FWHM",
    )  # fmt: skip
    rows = []
    for at_wave in measured:
        for one, shares in zip(at_wave.focus, at_wave.shares, strict=True):
            pairs = zip(one.mtf50_per_um, one.mtf50_error_per_um, strict=True)
            rows.append((
                at_wave.name,
                f"{math.degrees(one.angle_rad[0]):.3g}",
                _with_error(one.fwhm_um, one.fwhm_error_um),
                f"{one.limit.fwhm_um:.3g}",
                _with_error(one.strehl, one.strehl_error),
                *(_with_error(1e3 * value, 1e3 * error) for value, error in pairs),
                f"{1e3 * one.limit.mtf50_per_um:.3g}",
                _with_error(one.efficiency, one.efficiency_error),
                f"{one.limit.efficiency:.3g}",
                *(f"{share:.3g}" for share in shares),
            ))  # fmt: skip
    caption = (
        "Focus over field and wavelength, one-sigma errors; T tangential (along x), S "
        "sagittal. Efficiency, power within three FWHM over power on the aperture, is "
        "the product of the last three columns: what reflection, absorption and other "
        "orders leave behind the pillars, its share in the window, and of that in the "
        "focus."
    )
    return Table(head, rows, caption)


def _with_error(value: float, error: float) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value:.4g} ± {error:.1g}"


def report_values(measured: LensAtWavelength) -> dict[str, Any]:
    """Every number of one wavelength, for JSON.

    Args:
        measured: the lens at that wavelength.
    """
    names = ("behind_pillars", "in_window", "in_focus")
    return {
        "error": measured.stack.error,
        "focus": [
            asdict(one) | dict(zip(names, shares, strict=True))
            for one, shares in zip(
                measured.focus, measured.shares.tolist(), strict=True
            )
        ],
        "field": field_page.field_values(measured.field),
    }


def _write_page(
    path: Path, name: str, measured: list[LensAtWavelength], shown: list[Table]
) -> None:
    """Write the page: curves over the field, PSFs and MTF of each wavelength, tables."""
    fields = {one.name: one.field for one in measured}
    curves = field_page.plot_over_field(fields)
    pictures = [Figure(curves, field_page.CAPTION, wide=True)]
    for one in measured:
        montage = plots.plot_montage(one.stack)
        transfer = plots.plot_mtf(one.stack, limit=one.focus[0].limit)
        pictures += [
            Figure(montage, f"PSF at {one.name} over the field angle (down)."),
            Figure(transfer, f"MTF and encircled energy at {one.name}.", wide=True),
        ]
    axis = measured[0].focus[0]
    distortion = max(float(np.nanmax(np.abs(f.distortion))) for f in fields.values())
    write_report(
        path,
        f"Lens report: {name}",
        [Section("Pictures", items=pictures), Section("Tables", items=shown)],
        key_figures=[
            KeyFigure(
                f"Strehl ratio on axis, {measured[0].name}", f"{axis.strehl:.3f}"
            ),
            KeyFigure("focusing efficiency", f"{axis.efficiency:.3f}"),
            KeyFigure("largest distortion", f"{100 * distortion:.2g} %"),
        ],
    )
