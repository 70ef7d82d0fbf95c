"""DESIGN.toml to lens.h5: a hyperbolic, double-helix, cubic, Fisher or own phase made
of printable pillars.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import tyro

from metalens import design, lens, library
from metalens.cell import Cell, describe_order_loss
from metalens.cli import load_above
from metalens.commands.common import CommonOptions, Output
from metalens.core import config, store
from metalens.core.errors import ConfigError
from metalens.core.report import CommandConsole
from metalens.core.store import write_bytes
from metalens.design import (
    Cubic,
    DesignMetrics,
    DoubleHelix,
    Focus,
    Limits,
    PhaseMap,
    PhaseOf,
)
from metalens.design.free_form import FisherSettings
from metalens.lens import Lens
from metalens.lens import picture as lens_plot
from metalens.library import PillarLibrary, axes
from metalens.optics import Layers, check_gaps

_WAVELENGTH_NM = 850.0  # where neither the design nor its library says one
# pillars whose PSF is computed with the design: 2.6 mm at a pitch of 0.3 um
MOST_PILLARS = 60_000_000
Profile = Literal["hyperbolic", "double-helix", "cubic", "fisher", "map"]


@dataclass(frozen=True, slots=True)
class YPolarizationTarget:
    """What light polarised along y is to see.

    profile: which phase. sensor_distance_mm, source_distance_mm: what is imaged onto
    what (inf for a collimated beam).
    double_helix, cubic, map: of the profile of that name.
    """

    profile: Literal["hyperbolic", "double-helix", "cubic", "map"] = "hyperbolic"
    sensor_distance_mm: float = field(default=2.0, metadata={"above": 0})
    source_distance_mm: float = field(
        default=20.0, metadata={"may_be_inf": True, "above": 0}
    )
    double_helix: DoubleHelix = field(default_factory=DoubleHelix)
    cubic: Cubic = field(default_factory=Cubic)
    map: PhaseMap | None = None

    def __post_init__(self) -> None:
        if self.profile == "map" and self.map is None:
            raise ConfigError(
                "along_y: profile 'map' needs a table [along_y.map] with file and pitch_um"
            )


@dataclass(frozen=True, slots=True)
class AdditionalWavelength:
    """Another wavelength that the same pillars are to serve.

    wavelength_nm: of that light. weight: of its squared errors, against 1 of the
        design's own wavelength.
    sensor_distance_mm, source_distance_mm: what is imaged onto what (inf for a
        collimated beam); left out, as at the design's own wavelength.
    """

    wavelength_nm: float = field(metadata={"above": 0})
    weight: float = field(default=1.0, metadata={"above": 0})
    sensor_distance_mm: float | None = field(default=None, metadata={"above": 0})
    source_distance_mm: float | None = field(
        default=None, metadata={"may_be_inf": True, "above": 0}
    )


@dataclass(frozen=True, slots=True)
class DesignSettings:
    """The content of DESIGN.toml.

    profile: which phase.
    aperture_mm: diameter of the round aperture, up to 10.
    wavelength_nm: of the design; left out, that of a library which holds one, else 850.
    sensor_distance_mm, source_distance_mm: what is imaged onto what (inf for a
        collimated beam).
    library: library.h5 of the pillar cell, relative to the config; without it ``cell``
        is swept first.
    cell: the pillar cell, where no library is given.
    limits: what the process prints.
    layers: [[layers.front]] and [[layers.behind]] with material and thickness_um, in
        the order that the light meets them: films that the phase is corrected for; the
        gap behind the pillars is filled by the cell's cover.
    double_helix, cubic, fisher, map: of the profile of that name; ``fisher`` looks for
        a source distance of its own, about the one that is given.
    along_y: [along_y] with profile, distances and their tables: what light polarised
        along y is to see, where the library is one over two sizes; without it the same
        as light along x.
    hand: of the circular light that comes, where the library is for circular light:
        right (x + iy) or left. The phase is then made by the turn of pillars of one
        size.
    wavelengths: [[wavelengths]] with wavelength_nm, weight and distances: further
        wavelengths that the same pillars are to serve, by least squares over
        wavelengths (an achromatic lens where distances are left out).
    """

    profile: Profile = "hyperbolic"
    aperture_mm: float = 1.0
    wavelength_nm: float | None = field(default=None, metadata={"above": 0})
    sensor_distance_mm: float = field(default=2.0, metadata={"above": 0})
    source_distance_mm: float = field(
        default=20.0, metadata={"may_be_inf": True, "above": 0}
    )
    library: Path | None = None
    cell: Cell | None = None
    limits: Limits = field(default_factory=Limits)
    double_helix: DoubleHelix = field(default_factory=DoubleHelix)
    cubic: Cubic = field(default_factory=Cubic)
    fisher: FisherSettings = field(default_factory=FisherSettings)
    map: PhaseMap | None = None
    layers: Layers = field(default_factory=Layers)
    hand: Literal["right", "left"] = "right"
    along_y: YPolarizationTarget | None = None
    wavelengths: tuple[AdditionalWavelength, ...] = ()

    def __post_init__(self) -> None:
        """Refuse an aperture out of range and settings that exclude one another.

        Raises:
            ConfigError: naming the setting.
        """
        if not 0 < self.aperture_mm <= 10:
            raise ConfigError(
                f"aperture_mm = {self.aperture_mm}: need a diameter above 0 and up to 10 mm"
            )
        if self.profile == "map" and self.map is None:
            raise ConfigError(
                "profile 'map' needs a table [map] with file and pitch_um"
            )
        if self.library is not None and self.cell is not None:
            raise ConfigError(
                "library and cell are both given; a library holds its cell: give one of them"
            )
        if self.wavelengths and self.profile in ("fisher", "map"):
            raise ConfigError(
                f"wavelengths: profile '{self.profile}' is of one; "
                "need hyperbolic, double-helix or cubic"
            )
        check_gaps(
            self.layers, self.sensor_distance_mm * 1e3, self.source_distance_mm * 1e3
        )

    @property
    def focus(self) -> Focus:
        """What is imaged onto what, in um, through which films."""
        distances = self.sensor_distance_mm * 1e3, self.source_distance_mm * 1e3
        return Focus(
            (self.wavelength_nm or _WAVELENGTH_NM) * 1e-3, *distances, self.layers
        )

    def at(self, library_um: Iterable[float]) -> "DesignSettings":
        """Settings with the wavelength filled in from those of the library.

        That of a library of one wavelength, else 850 nm; a stated wavelength stays.

        Args:
            library_um: wavelengths of the library, um.
        """
        library_nm = {round(1e3 * wave, 6) for wave in library_um}
        default = library_nm.pop() if len(library_nm) == 1 else _WAVELENGTH_NM
        return replace(self, wavelength_nm=self.wavelength_nm or default)

    def phase(self, folder: Path) -> PhaseOf:
        """Target phase of a profile that needs no search, as a function of position.

        Args:
            folder: that file names are relative to.
        """
        shapes: dict[str, DoubleHelix | Cubic | PhaseMap | None] = {
            "double-helix": self.double_helix,
            "cubic": self.cubic,
            "map": self.map and replace(self.map, file=folder / self.map.file),
        }
        return design.phase_of(
            shapes.get(self.profile), self.focus, radius_um=self.aperture_mm * 500
        )

    def along(self, target: "YPolarizationTarget") -> "DesignSettings":
        """The same lens with the target of light along y."""
        values = {f.name: getattr(target, f.name) for f in fields(target)}
        return replace(self, **values, along_y=None)

    def at_wavelength(self, light: "AdditionalWavelength") -> "DesignSettings":
        """The same lens with the target of another wavelength."""
        return replace(
            self,
            wavelength_nm=light.wavelength_nm,
            sensor_distance_mm=light.sensor_distance_mm or self.sensor_distance_mm,
            source_distance_mm=light.source_distance_mm or self.source_distance_mm,
            wavelengths=(),
        )


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens design``.

    Attributes:
        config: DESIGN.toml.
        output: the lens file to write.
        process: PROCESS.toml whose printable pillars and gaps bound the diameters, in
            place of [limits].
        skip_focus_check: do not judge place and Strehl ratio of the focus.
        accept_partial_turn: where the pillars cover less than a turn, take the nearest;
            the loss is stated.
        own_cell: solve rows of its own non-identical pillars (minutes), for efficiency,
            lens file, PSFs, images; else rough.
    """

    config: tyro.conf.Positional[Path]
    output: Output = Path("lens.h5")
    process: Path | None = None
    skip_focus_check: bool = False
    accept_partial_turn: bool = False
    own_cell: bool = False


def run(options: Options) -> int:
    """Design the lens, check its focus and write it.

    Exit status 1 where light does not focus as it should or the pillars' own errors are
    large.

    Args:
        options: of the command line.

    Raises:
        ConfigError: settings that need another library.
    """
    settings = config.load(options.config, DesignSettings, empty=False)
    folder, target = options.config.parent, options.output
    path = None if settings.library is None else folder / settings.library
    two_size = path is not None and store.kind_of(path) == axes.KIND
    maps = [one.map for one in (settings, settings.along_y) if one and one.map]
    inputs = [*([path] if path else []), *(folder / shape.file for shape in maps)]
    if two_size and (options.own_cell or settings.wavelengths):
        raise ConfigError(
            "own_cell: rows of pillars of two sizes are not solved; leave --own-cell out"
            if options.own_cell
            else "wavelengths: need a library of pillars of one size; this one is over "
            "two (lengths_um)"
        )
    if settings.along_y is not None and not two_size:
        raise ConfigError(
            "along_y: one phase for x and one for y need a library over two sizes "
            "(lengths_um); give it"
        )
    with options.claim(target, companions=(".png",), inputs=inputs) as draft:
        design_lens = _design_two_sizes if two_size else _design_one_size
        designed, settings, values, notes, failures = design_lens(settings, options)
        lens.save(draft.path, designed)
        write_bytes(draft.path.with_suffix(".png"), lens_plot.lens_picture(designed))
    title = (
        f"{target}: {settings.profile} lens of {values['pillars']:,} pillars, "
        f"{settings.aperture_mm} mm, {1e3 * designed.wavelength_um:g} nm"
    )
    doubt = "" if two_size else designed.proxy.doubt
    return options.console.report(
        title, values, notes=notes, failures=[*failures, doubt]
    )


# lens, settings as filled in, values for JSON, notes, and failures
_Outcome = tuple[Lens, DesignSettings, dict[str, Any], list[str], list[str]]


def _design_two_sizes(settings: DesignSettings, options: Options) -> _Outcome:
    """Design a lens of pillars of two sizes, for light along x and along y.

    Args:
        settings: of the design.
        options: of the command line.

    Returns:
        Lens, settings as filled in, values for JSON, notes, and failures.
    """
    path = options.config.parent / (settings.library or "")
    pillars = axes.load_axes_library(path)
    inputs = {path.name: store.sha256(path)}
    settings = settings.at(pillars.wavelength_um.tolist())
    pillars.at(settings.focus.wavelength_um)
    settings = _fill_limits(settings, options, pillars.cell, inputs)
    phase, focus, _ = _find_phase(settings, options)
    phase_y: PhaseOf | None = None
    focus_y = focus
    if settings.along_y is not None:
        target = settings.along(settings.along_y)
        phase_y = target.phase(options.config.parent)
        focus_y = target.focus
    designed, metrics = design.assign_polarization_multiplexed(
        (phase, phase_y), (focus, focus_y), library=pillars, **_common(settings, inputs)
    )
    values: dict[str, Any] = {"pillars": metrics.x.pillars}
    failures = []
    lights: tuple[Literal["x", "y"], ...] = ("x", "y")
    profiles = settings.profile, (settings.along_y or settings).profile
    for i, light in enumerate(lights):
        quality = (metrics.x, metrics.y)[i]
        hyperbolic = profiles[i] == "hyperbolic"
        own, failure = _judge(
            designed.for_polarization(light), quality, options, wanted=hyperbolic
        )
        failures.append(failure)
        del own["turns"]  # of a single diameter
        values[f"along_{light}"] = own | {
            "wavefront_efficiency_error": metrics.wavefront_efficiency_error[i],
            "leaked": metrics.leaked[i],
        }
    lost = describe_order_loss(pillars.cell, settings.focus.wavelength_um)
    return designed, settings, values, [lost], failures


def _design_one_size(settings: DesignSettings, options: Options) -> _Outcome:
    """Design a lens of pillars of one size: at one wavelength or several, or rotated.

    Args:
        settings: of the design.
        options: of the command line.

    Returns:
        Lens, settings as filled in, values for JSON, notes, and failures.

    Raises:
        ConfigError: several wavelengths of rotated pillars.
    """
    pillars, inputs = _pillars(settings, options.config.parent, options.console)
    cell = pillars.cell
    proxy = library.proxy_of(pillars)
    folder = options.config.parent
    settings = settings.at(proxy.wavelengths_um)
    proxy.at(settings.focus.wavelength_um)  # refused here, not after the search
    settings = _fill_limits(settings, options, cell, inputs)
    if settings.profile == "map" and settings.map:
        file = Path(folder / settings.map.file)
        if file.is_file():
            inputs[file.name] = store.sha256(file)
    phase, focus, values = _find_phase(settings, options)
    common = _common(settings, inputs)
    rotated = pillars.turned is not None
    targets: list[DesignSettings] = []
    others: list[DesignMetrics] = []
    if settings.wavelengths:
        if rotated:
            raise ConfigError(
                "wavelengths: turned pillars make one phase at all of them; need a "
                "library for any light"
            )
        targets = [settings.at_wavelength(light) for light in settings.wavelengths]
        weights = [light.weight for light in settings.wavelengths]
        lights = [
            design.WavelengthTarget(at.phase(folder), at.focus, weight)
            for at, weight in zip([settings, *targets], [1.0, *weights], strict=True)
        ]
        designed, (quality, *others) = design.assign_multi_wavelength(
            lights, cell=cell, proxy=proxy, **common
        )
    elif rotated:
        designed, quality, conversion = design.assign_geometric_phase(
            phase, focus, library=pillars, hand=settings.hand, **common
        )
        values["circular"] = {"hand": settings.hand, **asdict(conversion)}
    else:
        partial = options.accept_partial_turn
        designed, quality = design.make(
            phase, focus, cell=cell, proxy=proxy, accept_partial_turn=partial, **common
        )
    radius_um = settings.aperture_mm * 500
    notes = [describe_order_loss(cell, focus.wavelength_um)]
    if settings.profile == "map":
        meets = design.has_focus(
            phase, focus, radius_um=radius_um, pitch_um=cell.pitch_um
        )
        quality = replace(quality, focuses=meets)
        if not meets:
            notes.append(_meeting_note(phase, focus, radius_um, cell))
    if designed.one_light:
        notes.append(
            f"for {designed.one_light} only: {cell.described} has another response for x "
            "and y (lengths_um in [sweep] makes a library for both)"
        )
    designed, coupling = _couple(designed, quality, options, rotated=rotated)
    checkable = settings.profile == "hyperbolic"
    expected = quality.strehl if others else 1.0
    own, failure = _judge(
        designed, quality, options, wanted=checkable, expected=expected
    )
    values = own | values
    if coupling is not None:
        values["neighbours"] = asdict(coupling)
    failures = [failure]
    by_wavelength = []
    for light, target, other in zip(settings.wavelengths, targets, others, strict=True):
        at_wavelength = replace(
            designed,
            wavelength_um=target.focus.wavelength_um,
            sensor_distance_um=target.focus.sensor_distance_um,
            source_distance_um=target.focus.source_distance_um,
        )
        own, failure = _judge(
            at_wavelength, other, options, wanted=checkable, expected=other.strehl
        )
        failures.append(failure)
        named = {"wavelength_nm": light.wavelength_nm, "weight": light.weight}
        by_wavelength.append(named | own)
    if by_wavelength:
        values["wavelengths"] = by_wavelength
    elif quality.turns < 1:
        hint = design.phase_coverage_hint(proxy, cell, settings.limits, quality.turns)
        notes.append(f"for a whole turn: {hint}")
    if quality.steepest > quality.sampled_aperture:
        notes.append(
            "at the rim the phase is steeper than the lattice samples: light leaves in "
            "other directions too; take a smaller pitch"
        )
    values |= {
        "proxy_phase_error_rad": proxy.max_phase_error_rad,
        "proxy_transmission_error": proxy.max_transmission_error,
        "entry_error": proxy.entry_error,
        "loss": pillars.mean_loss(designed.diameters.diameter_um, focus.wavelength_um),
    }
    return designed, settings, values, notes, failures


def _common(settings: DesignSettings, inputs: dict[str, str]) -> dict[str, Any]:
    """Arguments that all assignments of pillars share."""
    return {
        "aperture_um": settings.aperture_mm * 1e3,
        "limits": settings.limits,
        "profile": settings.profile,
        "provenance": store.Provenance(config=config.dumps(settings), inputs=inputs),
    }


def _fill_limits(
    settings: DesignSettings, options: Options, cell: Cell, inputs: dict[str, str]
) -> DesignSettings:
    """Settings with the limits of a process file, and the cell's cover behind the
    pillars.

    The process file is read by a package above this one. Hashes of the files that are
    read are added to ``inputs``.

    Args:
        settings: of the design.
        options: of the command line.
        cell: unit cell of the pillars.
        inputs: SHA-256 by file name.
    """
    inputs[options.config.name] = store.sha256(options.config)
    layers = settings.layers.covered_by(cell.cover)
    if options.process is None:
        return replace(settings, layers=layers)
    inputs[options.process.name] = store.sha256(options.process)
    thinnest, gap = load_above("process").printable_limits(
        options.process, pitch_um=cell.pitch_um, height_um=cell.height_um
    )
    limits = replace(settings.limits, min_diameter_nm=thinnest, min_gap_nm=gap)
    return replace(settings, layers=layers, limits=limits)


def _pillars(
    settings: DesignSettings, folder: Path, console: CommandConsole
) -> tuple[PillarLibrary, dict[str, str]]:
    """The library of the pillars, and the SHA-256 of its file by name.

    Without a library file the cell is swept at the wavelengths of the design.

    Args:
        settings: of the design.
        folder: that file names are relative to.
        console: for the progress of the sweep.
    """
    if settings.library is not None:
        path = folder / settings.library
        return library.load(path), {path.name: store.sha256(path)}
    others = (1e-3 * light.wavelength_nm for light in settings.wavelengths)
    waves = tuple(sorted((settings.focus.wavelength_um, *others)))
    cell = settings.cell or library.DEFAULT_CELL
    return library.sweep(cell, wavelengths_um=waves, console=console), {}


def _find_phase(
    settings: DesignSettings, options: Options
) -> tuple[PhaseOf, Focus, dict[str, Any]]:
    """Target phase of the profile, its focus, and figures of a free form for JSON.

    Args:
        settings: of the design.
        options: of the command line.
    """
    if settings.profile != "fisher":
        return settings.phase(options.config.parent), settings.focus, {}
    from metalens.design.free_form import fisher_profile

    radius_um = settings.aperture_mm * 500
    search = settings.fisher.about(settings.focus, radius_um)
    options.console.say(
        f"free form: {search.starts} starts of {search.iterations} steps"
    )
    phase, free_form = fisher_profile(
        settings.focus, radius_um=radius_um, settings=search
    )
    figures = {
        "focus_um": free_form.focus_um,
        "mean_information": float(free_form.score.information.mean()),
        "least_encircled_energy": float(free_form.score.encircled.min()),
        "outcome": free_form.reason,
    }
    focus = replace(settings.focus, source_distance_um=free_form.focus_um)
    return phase, focus, {"fisher": figures}


def _meeting_note(phase: PhaseOf, focus: Focus, radius_um: float, cell: Cell) -> str:
    """Where the rays of a map meet, in words, for a map without a focus on the
    sensor.
    """
    meets = design.meeting_um(phase, focus, radius_um=radius_um, pitch_um=cell.pitch_um)
    sensor, source = focus.sensor_distance_um, focus.source_distance_um
    if meets is None or abs(meets[2] / sensor - 1) <= 0.01:
        return "the rays of the map meet in no bright spot of the sensor"
    return (
        f"the rays of the map meet {format_place(meets)}; source at "
        f"{source / 1e3:g} mm, sensor at {sensor / 1e3:g} mm"
    )


def format_place(at_um: tuple[float, float, float]) -> str:
    """A place behind the lens in words: x and y in um, z in mm.

    Args:
        at_um: x, y and z.
    """
    x, y, z = (round(value, 3) + 0.0 for value in at_um)
    return f"at ({x:+.4g}, {y:+.4g}) um, {z * 1e-3:.4g} mm behind the lens"


def _couple(
    designed: Lens, quality: DesignMetrics, options: Options, *, rotated: bool
) -> tuple[Lens, design.NeighbourCouplingLoss | None]:
    """The lens, with solved rows under ``--own-cell``, and its neighbour coupling loss.

    The loss is None for rotated pillars and phases without a focus.

    Args:
        designed: the lens.
        quality: of its pillars.
        options: of the command line.
        rotated: whether its phase is geometric.

    Raises:
        ConfigError: ``--own-cell`` for such pillars or phases.
    """
    if rotated or not quality.focuses:
        if options.own_cell:
            why = "pillars that are turned" if rotated else "a phase without a focus"
            raise ConfigError(
                f"own_cell: {why}: no rows are solved for it; leave --own-cell out"
            )
        return designed, None
    if not options.own_cell:
        return designed, design.estimate_neighbour_coupling_loss(designed)
    designed = replace(designed, neighbours=design.solve_coupling_rows(designed))
    return designed, design.neighbour_coupling_loss(designed)


def _judge(
    designed: Lens,
    quality: DesignMetrics,
    options: Options,
    *,
    wanted: bool,
    expected: float = 1.0,
) -> tuple[dict[str, Any], str]:
    """Figures of a lens and of the PSF of its design source, and its failure.

    The PSF is left out of a phase without a focus, of a lens of more pillars than fit
    in memory at once, and where torch is not installed. The failure is empty where the
    focus passes or is not judged.

    Args:
        designed: the lens.
        quality: of its pillars.
        options: of the command line.
        wanted: whether the profile has a focus that can be judged.
        expected: Strehl ratio that the phase errors leave.
    """
    values = asdict(quality)
    field_deg = math.degrees(values.pop("field_of_view_rad"))
    if not quality.focuses:
        del values["numerical_aperture"]
        return values, ""
    values |= {"field_of_view_deg": field_deg, "efficiency": None}
    judged = wanted and not options.skip_focus_check
    if quality.pillars > MOST_PILLARS or find_spec("torch") is None:
        if judged:
            options.console.say(
                f"no focus check: it needs torch and at most {MOST_PILLARS:,} pillars"
            )
        return values, ""
    check = design.check_focus(designed, axial=judged, expected=expected)
    figures = check.figures
    names = "efficiency", "efficiency_error", "fwhm_um", "fwhm_error_um", "mtf50_per_um"
    values |= {name: getattr(figures, name) for name in names} | {
        "psf_strehl": figures.strehl,
        "psf_strehl_error": figures.strehl_error,
        "diffraction_limit": asdict(figures.limit),
    }
    if not judged:
        return values, ""
    values |= {
        "focus_x_um": check.x_um,
        "focus_y_um": check.y_um,
        "focus_z_um": check.z_um,
        "focus_passed": check.passed,
    }
    problem = "the focus is dim" if check.placed else "no focus where it should be"
    failure = (
        f"{problem}: a Strehl ratio of {figures.strehl:.3f}, expected "
        f"{check.expected:.3f}"
    )
    return values, "" if check.passed else failure
