"""What ``metalens design`` says of a lens: numbers for programs, lines for people."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace

from metalens import design
from metalens.cell import Cell
from metalens.core.errors import ConfigError
from metalens.core.report import Console
from metalens.design import (
    ConversionMetrics,
    Focus,
    FocusCheck,
    NeighbourCouplingLoss,
    PhaseOf,
    Quality,
)
from metalens.lens import Lens
from metalens.library import Proxy
from metalens.optics import Layers
from metalens.psf import FocusMetrics


def focus_problem(
    phase: PhaseOf, focus: Focus, radius_um: float, cell: Cell, console: Console
) -> bool:
    """Whether a map focuses on the sensor; where it does elsewhere, it is said where."""
    if design.has_focus(phase, focus, radius_um=radius_um, pitch_um=cell.pitch_um):
        return True
    elsewhere = design.meeting_um(
        phase, focus, radius_um=radius_um, pitch_um=cell.pitch_um
    )
    distance = focus.sensor_distance_um
    if elsewhere is not None and abs(elsewhere[2] / distance - 1) > 0.01:
        stated = f"source at {focus.source_distance_um / 1e3:g} mm, sensor at {distance / 1e3:g} mm"
        console.say(f"the rays of the map meet {place(elsewhere)}; {stated}")
    return False


def place(at_um: tuple[float, float, float]) -> str:
    """A place behind the lens, for a person."""
    x, y, z = (round(value, 3) + 0.0 for value in at_um)
    return f"at ({x:+.4g}, {y:+.4g}) um, {z * 1e-3:.4g} mm behind the lens"


def solve_coupling(
    made: Lens,
    quality: Quality,
    conversion: ConversionMetrics | None,
    radius_um: float,
    *,
    solve: bool,
) -> tuple[Lens, NeighbourCouplingLoss | None]:
    """The lens, holding its rows where they are to be solved, and what unlike
    neighbours leave of the light in the
    focus, by those or rough; None where there is no such number.

    Raises:
        ConfigError: it is to be solved and cannot be.
    """
    if conversion is not None or not quality.focuses:
        if solve:
            why = (
                "pillars that are turned"
                if conversion is not None
                else "a phase without a focus"
            )
            raise ConfigError(
                f"own_cell: {why}: no rows are solved for it; leave --own-cell out"
            )
        return made, None
    if not solve:
        return made, design.estimate_neighbour_coupling_loss(made, radius_um=radius_um)
    made = replace(
        made, neighbours=design.solve_coupling_rows(made, radius_um=radius_um)
    )
    return made, design.neighbour_coupling_loss(made, radius_um=radius_um)


# pillars of a focus check: 2.6 mm at a pitch of 0.3 um, half a minute on two cores
MOST_SUMMED = 60_000_000


def focus_figures(made: Lens, quality: Quality) -> FocusMetrics | None:
    """Of the PSF of the design source; None of a phase without a focus, of a lens of
    more pillars than fit in memory at once, and where torch is not installed.
    """
    if not quality.focuses or quality.pillars > MOST_SUMMED:
        return None
    try:
        return design.focus_figures(made)
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        return None


def design_values(
    quality: Quality,
    check: FocusCheck | None,
    unlike: NeighbourCouplingLoss | None = None,
    figures: FocusMetrics | None = None,
) -> dict[str, object]:
    """Numbers of a lens, of the check of its focus, of its neighbours and of its PSF;
    None for what JSON does not know.
    """
    values: dict[str, object] = {"pillars": quality.pillars, "focuses": quality.focuses}
    if quality.focuses:
        values |= {
            "numerical_aperture": quality.numerical_aperture,
            "field_of_view_deg": math.degrees(quality.field_of_view_rad),
            **_of_psf(figures),
        }
    values |= {
        "wavefront_efficiency": quality.wavefront_efficiency,
        "sampled_aperture": quality.sampled_aperture,
        "steepest": quality.steepest,
        "transmission": quality.transmission,
        "strehl": quality.strehl,
        "max_phase_error_rad": quality.max_phase_error_rad,
        "rms_phase_error_rad": quality.rms_phase_error_rad,
        "turns": quality.turns,
    }
    if check is not None:
        along = None if math.isnan(check.z_um) else check.z_um  # JSON knows no nan
        values |= {
            "focus_x_um": check.x_um,
            "focus_y_um": check.y_um,
            "focus_z_um": along,
        }
        values |= {"exact_strehl": check.strehl, "focus_passed": check.passed}
    if unlike is not None:
        values["neighbours"] = asdict(unlike)
    return values


def _of_psf(figures: FocusMetrics | None) -> dict[str, object]:
    """Focusing efficiency and widths of the PSF of the design source; none computed:
    none.
    """
    if figures is None:
        return {"efficiency": None}
    names = "efficiency", "efficiency_error", "fwhm_um", "fwhm_error_um", "mtf50_per_um"
    found = {name: getattr(figures, name) for name in names}
    found |= {"psf_strehl": figures.strehl, "psf_strehl_error": figures.strehl_error}
    found = {
        name: None if isinstance(v, float) and math.isnan(v) else v
        for name, v in found.items()
    }
    return found | {"diffraction_limit": asdict(figures.limit)}


def focus_failures(checks: Sequence[FocusCheck | None]) -> list[str]:
    """Of every focus that is not as it should be, what is wrong with it."""
    return [
        f"{'the focus is dim' if check.placed else 'no focus where it should be'}: a Strehl ratio of "
        f"{check.strehl:.3f}, expected {check.expected:.3f}"
        for check in checks
        if check is not None and not check.passed
    ]


def _cone(quality: Quality) -> list[str]:
    """Aperture and field of a lens that has a focus."""
    if not quality.focuses:
        return [
            "  light of this phase meets in no one bright spot of the sensor: no focusing efficiency, NA or field"
        ]
    return [
        f"  NA {quality.numerical_aperture:.3f} towards the sensor; diffraction-limited field "
        f"{math.degrees(quality.field_of_view_rad):.1f} deg (Strehl ratio 0.8, hyperbolic lens of this focus)"
    ]


def conversion_text(found: ConversionMetrics, quality: Quality, hand: str) -> str:
    """What becomes of circular light, in words."""
    whole = quality.strehl * found.converted
    return (
        f"  {hand} circular light, pillars of {1e3 * found.size_um:.1f} nm: {found.converted:.3f} +- "
        f"{found.converted_error:.2g} leaves with the other hand and the wanted phase ({whole:.3f} in the focus), "
        f"{found.unconverted:.2g} +- {found.unconverted_error:.1g} with the same hand and no phase;\n"
        f"  pillars are taken as turned alone, which is {found.isolated_error:.2g} of t off the solved lattice"
    )


def _neighbours(found: NeighbourCouplingLoss) -> str:
    """What neighbours leave of the power in the focus, in words."""
    if found.pillars:
        rows = ", ".join(map(str, found.pillars))
        return (
            f"  unlike neighbours leave {found.share:.3f} +- {found.error:.2g} of the power of pillars one by one, "
            f"counted in the PSF (rows of {rows} of its own pillars solved)"
        )
    most = min(1.0, max(1 - found.share, 0.0) + found.error)
    return (
        f"  that is of pillars one by one: unlike neighbours may cost as much as {most:.1%} of it "
        "(rough, of another cell; --own-cell solves rows of these pillars, and PSFs and images then hold them)"
    )


def _psf(figures: FocusMetrics | None, quality: Quality) -> list[str]:
    """FWHM, Strehl ratio and focusing efficiency of the PSF, in words."""
    if figures is None:
        why = "more pillars than fit in memory, or torch is not installed"
        return [f"  no focusing efficiency: {why}"] if quality.focuses else []
    return [
        f"  PSF of the design source: focusing efficiency {figures.efficiency:.3f} +- {figures.efficiency_error:.2g} "
        f"(power within three FWHM over power on the aperture; {figures.limit.efficiency:.3f} without losses and "
        f"aberrations),\n  FWHM {figures.fwhm_um:.4g} +- {figures.fwhm_error_um:.2g} um (diffraction limit "
        f"{figures.limit.fwhm_um:.4g}), Strehl ratio {figures.strehl:.3f} +- {figures.strehl_error:.2g}"
    ]


def _films(layers: Layers) -> list[str]:
    """What the light passes beside the pillars."""
    found = []
    for where, films in (("front", layers.front), ("behind", layers.behind)):
        if films:
            named = ", ".join(
                f"{film.thickness_um:g} um {film.material}" for film in films
            )
            found.append(f"  phase corrected for layers {where}: {named}")
    if layers.stop is not None:
        found.append(
            f"  aperture stop of {2 * layers.stop.radius_um:g} um, {layers.stop.distance_um:g} um before the pillars"
            + (
                ""
                if layers.stop.centred
                else f", its middle at {layers.stop.centre_um} um"
            )
        )
    return found


def proxy_error(proxy: Proxy) -> dict[str, object]:
    """How far the curve that stands for the pillars is from the solved ones, at the
    most.
    """
    return {
        "proxy_phase_error_rad": proxy.max_phase_error_rad,
        "proxy_transmission_error": proxy.max_transmission_error,
        "entry_error": proxy.entry_error,
    }


def pillar_accuracy_text(made: Lens) -> str:
    """What is known of its pillars, in words: how close to solved ones; for which
    light, where pillars of one
    size answer x and y apart."""
    phase, level = made.proxy.max_phase_error_rad, made.proxy.max_transmission_error
    known = (
        f"\n  what follows takes pillars by a curve, within {phase:.1e} rad and {level:.1e} of |T| of those solved for "
        "the library"
    )
    if not made.one_light:
        return known
    return known + (
        f"\n  all of it for {made.one_light}: {made.cell.described} answers x and y apart, and the library\n"
        "  holds no more (of rectangles and ellipses lengths_um in [sweep] makes one for both)"
    )


def design_text(
    head: str,
    layers: Layers,
    quality: Quality,
    check: FocusCheck | None,
    unlike: NeighbourCouplingLoss | None = None,
    figures: FocusMetrics | None = None,
    *,
    several: bool = False,
) -> str:
    """Lines about a lens below a head; layers: films that its phase is corrected for;
    figures: of its PSF; several: whether its pillars are
    a compromise between wavelengths."""
    lines = [
        head,
        *_cone(quality),
        *_psf(figures, quality),
        f"  wave-front efficiency {quality.wavefront_efficiency:.3f}, mean |T|² {quality.transmission:.3f}, "
        f"Strehl ratio of the pillars {quality.strehl:.4f}, largest phase error {quality.max_phase_error_rad:.2g} rad",
        *([] if unlike is None else [_neighbours(unlike)]),
        *_films(layers),
    ]
    if quality.steepest > quality.sampled_aperture:
        lines.append(
            f"  at the rim the phase is steeper than the lattice samples (sine {quality.steepest:.3f}, "
            f"{quality.sampled_aperture:.3f} without aliases): there light leaves in other directions too; take a "
            "smaller pitch"
        )
    if several or quality.turns < 1:
        why = (
            "the compromise between wavelengths is"
            if several
            else "the nearest stands in for the phases that none has,"
        )
        lines.append(
            f"  the pillars cover {quality.turns:.3f} of a turn: {why} {quality.rms_phase_error_rad:.2g} rad rms off, "
            f"which costs {1 - quality.strehl:.1%} of the peak"
        )
    if check is not None:
        lines.append(f"  exact diffraction sum: {check.text}")
    return "\n".join(lines)
