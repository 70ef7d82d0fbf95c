"""lens.h5 to a page over field and wavelength: focus and its diffraction limit, MTF,
distortion, field curvature, efficiency by cause.
"""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from codesign.commands.options.lens_report import Options
from codesign.evaluate import field_page
from metalens import design, lens, psf
from metalens.aberrations import OverField, over_field
from metalens.core import store
from metalens.core.errors import ConfigError
from metalens.core.report import Figure, KeyFigure, Section, Table, write_report
from metalens.lens import reach

FIELDS = 5  # field angles where none are given
AIRY, SAMPLES = 28.0, 192  # window in wavelength / NA, samples across it


@dataclass(frozen=True, eq=False, slots=True)
class FocusAtWavelength:
    """Figures of every field angle at one wavelength.

    figures: (angles,) FWHM, Strehl ratio, MTF50 and focusing efficiency.
    passed: (angles,) power behind the pillars over the power on the aperture, at the
    design wavelength: what reflection, absorption and other orders leave.
    stack: PSFs (angle, y, x) they were measured on.
    """

    wavelength_um: float
    figures: tuple[psf.FocusMetrics, ...]
    passed: tuple[float, ...]
    stack: psf.PsfStack


def run(options: Options) -> int:
    """Measure the lens over field and wavelength and write the page.

    Exit status 1 where the error estimate of a PSF stays above the tolerance.

    Args:
        options: of the command line.
    """
    device = lens.load(options.lens)
    view = _view(options, device)
    wavelengths_nm = options.wavelengths_nm or (device.wavelength_um * 1e3,)
    with options.claim(options.output, companions=(".json",)) as draft:
        by_wavelength = [
            measure_focus(device, view, nm * 1e-3, tolerance=options.tolerance)
            for nm in options.console.track(
                wavelengths_nm, total=len(wavelengths_nm), label="wavelengths"
            )
        ]
        angles_deg = tuple(math.degrees(x) for x, _ in view.angles_rad)
        field = over_field(device, angles_deg, depth_um=view.depths_um[0])
        values = report_values(by_wavelength, field)
        text = json.dumps(values, indent=1) + "\n"
        store.write_text(draft.path.with_suffix(".json"), text)
        shown = [focus_table(by_wavelength), *field_page.field_tables({"": field})]
        _write_page(draft.path, options.lens.name, by_wavelength, field, shown)
    failures = [
        f"{focus.wavelength_um * 1e3:g} nm: the relative error {focus.stack.error:.2g} "
        f"is above the tolerance {options.tolerance:g}"
        for focus in by_wavelength
        if not focus.stack.converged
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


def measure_focus(
    device: lens.Lens, view: psf.View, wavelength_um: float, *, tolerance: float
) -> FocusAtWavelength:
    """Figures of the focus at the field angles of a view and one wavelength.

    Args:
        device: the lens.
        view: one depth, angles and window.
        wavelength_um: in vacuum.
        tolerance: relative L2 error of the PSFs.
    """
    nodes = psf.SpectralNodes(np.array([wavelength_um]), np.ones(1), 0.0)
    stack = psf.from_lens(device, view, tolerance=tolerance, spectrum=nodes)
    figures = psf.focus_metrics(stack, device, power_error=design.power_error(device))
    passed = []
    for metrics in figures:
        angle, depth_um = metrics.angle_rad, metrics.depth_um
        light_um2 = float(psf.passed_um2(device, angle, (depth_um,))[0])
        passed.append(light_um2 / psf.incident_um2(device, angle, depth_um))
    return FocusAtWavelength(wavelength_um, figures, tuple(passed), stack)


def focus_table(by_wavelength: list[FocusAtWavelength]) -> Table:
    """Table of the focus: a row for each wavelength and field angle, errors of one
    sigma, and the diffraction limit of the aperture.

    Args:
        by_wavelength: figures of each wavelength.
    """
    head = (
        "wavelength / nm", "angle / °", "FWHM / µm", "limit", "Strehl", "MTF50 x / mm⁻¹", "y",
        "limit", "efficiency", "limit", "passed by pillars",
    )  # fmt: skip
    rows = []
    for focus in by_wavelength:
        for one, passed in zip(focus.figures, focus.passed, strict=True):
            rows.append((
                f"{focus.wavelength_um * 1e3:g}",
                f"{math.degrees(one.angle_rad[0]):.3g}",
                _with_error(one.fwhm_um, one.fwhm_error_um),
                f"{one.limit.fwhm_um:.3g}",
                _with_error(one.strehl, one.strehl_error),
                *(
                    _with_error(1e3 * value, 1e3 * error)
                    for value, error in zip(one.mtf50_per_um, one.mtf50_error_per_um, strict=True)
                ),
                f"{1e3 * one.limit.mtf50_per_um:.3g}",
                _with_error(one.efficiency, one.efficiency_error),
                f"{one.limit.efficiency:.3g}",
                f"{passed:.3g}",
            ))  # fmt: skip
    caption = (
        "Focus over field and wavelength, one-sigma errors. Efficiency: power within "
        "three FWHM over power on the aperture. Pillars pass, at the design wavelength, "
        "what reflection, absorption and other orders leave; the rest falls outside."
    )
    return Table(head, rows, caption)


def _with_error(value: float, error: float) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value:.4g} ± {error:.1g}"


def report_values(
    by_wavelength: list[FocusAtWavelength], field: OverField
) -> dict[str, Any]:
    """Every number of the report, for JSON.

    Args:
        by_wavelength: figures of each wavelength.
        field: aberrations at the design wavelength.
    """
    focus = [
        {
            "wavelength_um": one.wavelength_um,
            "error": one.stack.error,
            "angles": [
                asdict(metrics) | {"passed": passed}
                for metrics, passed in zip(one.figures, one.passed, strict=True)
            ],
        }
        for one in by_wavelength
    ]
    return {"focus": focus, "field": field_page.field_values(field)}


def _write_page(
    path: Path,
    name: str,
    by_wavelength: list[FocusAtWavelength],
    field: OverField,
    shown: list[Table],
) -> None:
    """Write the page: curves over the field, PSFs of each wavelength, tables."""
    from metalens.psf.plots import plot_montage

    axis = by_wavelength[0].figures[0]
    pictures = [
        Figure(field_page.plot_over_field({"": field}), field_page.CAPTION, wide=True),
        *(
            Figure(
                plot_montage(one.stack),
                f"PSF at {one.wavelength_um * 1e3:g} nm over the field angle (down).",
            )
            for one in by_wavelength
        ),
    ]
    write_report(
        path,
        f"Lens report: {name}",
        [Section("Pictures", items=pictures), Section("Tables", items=shown)],
        key_figures=[
            KeyFigure("Strehl ratio on axis", f"{axis.strehl:.3f}"),
            KeyFigure("focusing efficiency", f"{axis.efficiency:.3f}"),
            KeyFigure("largest distortion", f"{100 * np.nanmax(np.abs(field.distortion)):.2g} %"),
        ],
    )  # fmt: skip
