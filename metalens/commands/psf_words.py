"""What ``metalens psf`` says of PSFs: numbers for programs, lines and tables for
people.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from metalens import psf
from metalens.commands.design import format_place
from metalens.core.report import Figure, KeyFigure, Section, Table

DARK = 0.1  # share of the light in the window, below which it holds no image
BUDGET_WORDS = (
    "What computation and model are wrong by, each alone, the worst over angles: the terms of the model are those "
    "of a perfect lens of the same aperture."
)
FIGURES = (
    "x / deg",
    "y / deg",
    "source / mm",
    "FWHM / um",
    "limit",
    "Strehl ratio",
    "MTF50 along x / mm",
    "along y",
    "limit",
    "efficiency",
    "limit",
)


@dataclass(frozen=True, slots=True)
class Computed:
    """stack: PSFs. figures: of the sharpest depth of every angle. meets_um: (x, y, z)
    behind the lens where rays of the design source meet, None where they do not.
    scan: along z, of a lens for collimated light.
    """

    stack: psf.PsfStack
    figures: tuple[psf.FocusMetrics, ...]
    meets_um: tuple[float, float, float] | None
    scan: "psf.FocusScan | None" = None


def tolerance_excess(stack: psf.PsfStack) -> str:
    """That the computed error is above the tolerance, and its cure; else empty.

    Args:
        stack: PSFs over angle, depth and wavelength.
    """
    if stack.converged:
        return ""
    error = _budget(stack).computed
    return f"the relative error {error:.2g} is above the tolerance {stack.tolerance:g}: {_budget(stack).cure}"


def dark_window(found: Computed) -> str:
    """That windows hold hardly any light, and where the rays meet; else empty.

    Args:
        found: what was computed.
    """
    missed = [one for one in found.figures if not one.window_share >= DARK]
    if not missed:
        return ""
    angles = ", ".join(_angle(one.angle_rad) for one in missed)
    share = max(one.window_share for one in missed)
    meets = found.meets_um
    where = (
        "rays of the design source meet nowhere (psf --far-field shows where its light goes)"
        if meets is None
        else f"rays of the design source meet {format_place(meets)}; --offset-um moves the window"
    )
    return f"the window of {angles} holds {share:.2g} of the light: {where}"


def psf_text(target: Path, found: Computed) -> str:
    """Lines for people.

    Args:
        target: output file.
        found: what was computed.
    """
    stack = found.stack
    counts = (
        ("angle", stack.angles_rad),
        ("depth", stack.depths_um),
        ("wavelength", stack.weights),
    )
    shape = " x ".join(
        f"{len(all_of)} {name}{'s' * (len(all_of) != 1)}" for name, all_of in counts
    )
    lines = [
        f"{target}: {shape}, relative error {stack.error:.2g} ({stack.reason})",
        f"  {_budget(stack).text}",
        *(_figures(one) for one in found.figures),
    ]
    if found.scan is not None:
        ends = found.scan.shift_um[[0, -1]]
        lines.append(
            f"  scan behind the lens, {ends[0]:+.3g} to {ends[1]:+.3g} um about the sensor: brightest at "
            f"{found.scan.best_um:+.2g} um"
        )
    meets = found.meets_um
    if meets is not None and math.hypot(*meets[:2]) > stack.step_um:
        lines.append(f"  rays of the design source meet {format_place(meets)}")
    return "\n".join(lines)


def _figures(one: psf.FocusMetrics) -> str:
    where = f"  at {_angle(one.angle_rad)}, source at {_depth(one.depth_um)}"
    if not one.window_share >= DARK:
        return f"{where}: no image, {one.window_share:.2g} of the light in the window"
    mtf = " / ".join(f"{1e3 * f:.4g}" for f in one.mtf50_per_um)
    error = 1e3 * max(one.mtf50_error_per_um)
    return (
        f"{where}: FWHM {one.fwhm_um:.4g} +- {one.fwhm_error_um:.2g} um (diffraction limit {one.limit.fwhm_um:.4g}), "
        f"Strehl ratio {one.strehl:.3f} +- {one.strehl_error:.2g},\n"
        f"    MTF50 along x / y {mtf} +- {error:.2g} cycles/mm (limit {1e3 * one.limit.mtf50_per_um:.4g}, cut-off "
        f"{1e3 * one.limit.cutoff_per_um:.4g}),\n"
        f"    focusing efficiency {one.efficiency:.3f} +- {one.efficiency_error:.2g}: power within three FWHM over "
        f"power on the aperture (limit {one.limit.efficiency:.3f}); {one.window_share:.1%} of the light in the window"
    )


def _angle(angle_rad: tuple[float, float]) -> str:
    x, y = np.rad2deg(angle_rad)
    return f"({x:.3g}, {y:.3g}) deg"


def _depth(depth_um: float) -> str:
    return "infinity" if math.isinf(depth_um) else f"{1e-3 * depth_um:.4g} mm"


def psf_numbers(found: Computed) -> dict[str, Any]:
    """Numbers for programs; None for what JSON does not know.

    Args:
        found: what was computed.
    """
    stack = found.stack
    values: dict[str, Any] = {
        "error": stack.error,
        "computed_error": _budget(stack).computed,
        "budget": {name: _plain(v) for name, v in asdict(_budget(stack)).items()},
        "tolerance": stack.tolerance,
        "converged": stack.converged,
        "reason": stack.reason,
        "depths_um": [_plain(depth) for depth in stack.depths_um.tolist()],
        "angles_rad": stack.angles_rad.tolist(),
        "wavelengths_um": stack.wavelengths_um.tolist(),
        "focus": [_plain(asdict(one)) for one in found.figures],
    }
    meets = found.meets_um
    values["rays_meet_um"] = None if meets is None else list(meets)
    if found.scan is not None:
        names = ("shift_um", "peak", "fwhm_um")
        scan = {name: _plain(getattr(found.scan, name).tolist()) for name in names}
        values["z_scan"] = scan | {"best_um": found.scan.best_um}
    return values


def _plain(value: Any) -> Any:
    """A value with None in place of numbers that are not finite."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _budget(stack: psf.PsfStack) -> psf.Budget:
    return stack.budget or psf.Budget(stack.error)


def key_figures(found: Computed) -> list[KeyFigure]:
    """What was computed, how well, and what the focus is worth.

    Args:
        found: what was computed.
    """
    stack, budget, best = found.stack, _budget(found.stack), found.figures[0]
    shape = len(stack.angles_rad), len(stack.depths_um), len(stack.wavelengths_um)
    figures = [
        KeyFigure("field angles × depths × wavelengths", " × ".join(map(str, shape))),
        KeyFigure(
            "relative error of what is computed",
            f"{budget.computed:.2g}",
            stack.converged,
        ),
        KeyFigure("with what the model leaves out", f"{budget.total:.2g}"),
        KeyFigure("focusing efficiency", f"{best.efficiency:.3f}"),
        KeyFigure("Strehl ratio", f"{best.strehl:.3f}"),
    ]
    if math.isnan(budget.outside):
        return figures
    beside = KeyFigure("of the light falls beside the window", f"{budget.outside:.2g}")
    return [*figures, beside]


def psf_sections(found: Computed, pictures: dict[str, bytes]) -> list[Section]:
    """Of the report; pictures by their captions.

    Args:
        found: what was computed.
    """
    stack = found.stack
    figures = [Figure(image, caption, wide=True) for caption, image in pictures.items()]
    focus = Table(
        FIGURES,
        [
            [
                *(f"{x:.3g}" for x in np.rad2deg(one.angle_rad)),
                "∞" if math.isinf(one.depth_um) else f"{1e-3 * one.depth_um:.4g}",
                f"{one.fwhm_um:.4g} ± {one.fwhm_error_um:.2g}",
                one.limit.fwhm_um,
                f"{one.strehl:.3f} ± {one.strehl_error:.2g}",
                *(f"{1e3 * f:.4g}" for f in one.mtf50_per_um),
                1e3 * one.limit.mtf50_per_um,
                f"{one.efficiency:.3f} ± {one.efficiency_error:.2g}",
                one.limit.efficiency,
            ]
            for one in found.figures
        ],
        "The sharpest depth of every field angle; efficiency: power within three FWHM over power on the aperture.",
    )
    energy = np.asarray(stack.energy_um2)
    rows = [
        [f"{x:.3g}", f"{y:.3g}", float(e.min()), float(e.max())]
        for (x, y), e in zip(np.rad2deg(stack.angles_rad), energy, strict=True)
    ]
    table = Table(
        ("x / deg", "y / deg", "least", "most"),
        rows,
        "Light in the window for unit irradiance, µm², over depth.",
    )
    return [
        Section("Pictures", items=figures),
        Section("Focus", items=[focus]),
        Section("Error by cause", BUDGET_WORDS, [_budget_table(stack)]),
        Section("Energy", f"Method: {stack.reason}.", [table]),
    ]


def _budget_table(stack: psf.PsfStack) -> Table:
    found = _budget(stack)
    rows = [
        [name, "not known" if math.isnan(v) else f"{v:.2g}"]
        for name, v in asdict(found).items()
    ]
    rows += [
        ["computed", f"{found.computed:.2g}"],
        ["of the device", f"{found.total:.2g}"],
    ]
    return Table(
        ("cause", "relative L2"),
        rows,
        "The tolerance is about what is computed; outside is a share of light.",
    )
