"""DESIGN.toml to lens.h5: a hyperbolic, double-helix, cubic, Fisher or own phase made
of printable pillars.
"""

import importlib
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from metalens import design, lens, library
from metalens.cell import Cell, describe_order_loss
from metalens.commands import design_words as words
from metalens.commands import paired, several
from metalens.commands.common import CommonOptions, Output
from metalens.commands.paired import YPolarizationTarget
from metalens.commands.several import AdditionalWavelength
from metalens.core import config, reading, store, transaction
from metalens.core.errors import ConfigError
from metalens.core.report import Console
from metalens.core.store import write_bytes
from metalens.design import (
    ConversionMetrics,
    Cubic,
    DoubleHelix,
    Focus,
    FocusCheck,
    Limits,
    PhaseMap,
    PhaseOf,
    Quality,
    check_focus,
)
from metalens.design.free_form import FisherSettings, ResolvedFisherSettings
from metalens.lens import Lens
from metalens.lens import picture as lens_plot
from metalens.library import PillarLibrary, axes
from metalens.optics import Layers, check_gaps
from metalens.psf import FocusMetrics

if TYPE_CHECKING:
    from metalens.image import Pupil

_WAVELENGTH_NM = 850.0  # where neither the design nor its library says one
OBJECTIVES: dict[str, str] = {}  # module by name, filled by the command line
Profile = Literal["hyperbolic", "double-helix", "cubic", "fisher", "map"]


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
    the order that the light meets
        them: films that the phase is corrected for; the gap behind the pillars is
            filled by the cell's cover.
    double_helix, cubic, fisher, map: of the profile of that name; ``fisher`` looks for
    a source distance of its own,
        about the one that is given.
    along_y: [along_y] with profile, distances and their tables: what light polarised
    along y is to see, where the
        library is one over two sizes; without it the same as light along x.
    hand: of the circular light that comes, where the library is for circular light:
    right (x + iy) or left. The phase
        is then made by the turn of pillars of one size.
    wavelengths: [[wavelengths]] with wavelength_nm, weight and distances: light beside
    the design's own that the same
        pillars are to serve, by least squares over wavelengths (an achromatic lens
        where distances are left out).
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
        several.check_single_wavelength_profile(self.wavelengths, self.profile)
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

    def at(self, held_um: Iterable[float]) -> "DesignSettings":
        """The same, its wavelength filled in from those that the library holds."""
        told, only = self.wavelength_nm, {round(1e3 * wave, 6) for wave in held_um}
        return replace(
            self,
            wavelength_nm=told or (only.pop() if len(only) == 1 else _WAVELENGTH_NM),
        )


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens design``.

    Attributes:
        config: DESIGN.toml.
        output: the lens file to write.
        process: PROCESS.toml whose printable pillars and gaps bound the diameters, in
            place of [limits].
        skip_focus_check: leave out the exact diffraction sum around the focus.
        accept_partial_turn: where the pillars cover less than a turn, take the nearest;
            the loss is stated.
        own_cell: solve rows of its own unlike pillars (minutes), for efficiency, lens
            file, PSFs, images; else rough.
    """

    config: tyro.conf.Positional[Path]
    output: Output = Path("lens.h5")
    process: Path | None = None
    skip_focus_check: bool = False
    accept_partial_turn: bool = False
    own_cell: bool = False


def run(options: Options) -> int:
    """Design the lens, check its focus, write it; exit 1 where light does not focus as
    it should or pillars are hardly
    known."""
    wanted = config.load(options.config, DesignSettings, empty=False)
    target, read = options.output, _read(wanted, options.config)
    if wanted.library is not None and paired.is_two_size_library(
        options.config.parent / wanted.library
    ):
        return _paired(wanted, options, read)
    if wanted.along_y is not None:
        raise ConfigError(
            "along_y: one phase for x and one for y need a library over two sizes (lengths_um); give it"
        )
    with options.claim(target, beside=(".png", "_fisher.png"), inputs=read) as draft:
        made = _make(wanted, options, draft.path)
    focus = made.wanted.focus
    lost = describe_order_loss(made.lens.cell, focus.wavelength_um, made.loss)
    head, layers = (
        _head(made.wanted, target, made.quality)
        + words.pillar_accuracy_text(made.lens)
        + lost,
        made.wanted.layers,
    )
    about_focus = made.quality, made.check, made.unlike, made.figures
    values = words.design_values(*about_focus) | several.wavelength_values(made.beside)
    values |= words.proxy_error(made.lens.proxy) | {"loss": made.loss}
    text = words.design_text(head, layers, *about_focus, several=bool(made.beside))
    text += several.wavelength_text(made.beside, layers)
    if made.quality.turns < 1 and not made.beside:
        about = made.lens.proxy, made.lens.cell, made.wanted.limits
        text += f"\n  for a whole turn: {design.phase_coverage_hint(*about, made.quality.turns)}"
    if made.conversion is not None:
        values["circular"] = {"hand": made.wanted.hand, **asdict(made.conversion)}
        text = f"{text}\n{words.conversion_text(made.conversion, made.quality, made.wanted.hand)}"
    if made.judged is not None:
        values["fisher"], text = made.judged.values, f"{text}\n\n{made.judged.text}"
    checks = (made.check, *(one.check for one in made.beside))
    return options.console.judged(
        values, text, [*words.focus_failures(checks), made.lens.proxy.doubt]
    )


def _head(wanted: DesignSettings, target: Path, quality: Quality) -> str:
    return (
        f"{target}: {wanted.profile} lens of {quality.pillars:,} pillars, {wanted.aperture_mm} mm, "
        f"{1e3 * wanted.focus.wavelength_um:g} nm"
    )


def _paired(wanted: DesignSettings, options: Options, read: list[Path]) -> int:
    """A lens of pillars of two sizes, for light along x and along y."""
    if options.own_cell:
        raise ConfigError(
            "own_cell: rows of pillars of two sizes are not solved; leave --own-cell out"
        )
    if wanted.wavelengths:
        raise ConfigError(
            "wavelengths: need a library of pillars of one size; this one is over two (lengths_um)"
        )
    with options.claim(options.output, beside=(".png",), inputs=read) as draft:
        path = options.config.parent / (wanted.library or "")
        made_of, inputs = (
            axes.load(path),
            {file.name: reading.sha256(file) for file in (path, options.config)},
        )
        wanted = wanted.at(made_of.wavelength_um.tolist())
        made_of.at(wanted.focus.wavelength_um)
        if options.process is not None:
            wanted = replace(
                wanted, limits=_printable(options.process, made_of.cell, wanted.limits)
            )
            inputs[options.process.name] = reading.sha256(options.process)
        wanted = replace(wanted, layers=wanted.layers.covered_by(made_of.cell.cover))
        radius_um = wanted.aperture_mm * 500
        phase, focus, _ = _phase(wanted, options, radius_um)
        if wanted.along_y is None:
            other: tuple[PhaseOf | None, Focus] = None, focus
        else:
            other = paired.y_polarization_phase(
                wanted.along_y, focus, options.config, radius_um=radius_um
            )
        about = store.Provenance(config=config.dumps(wanted), inputs=inputs)
        made, split = design.assign_polarization_multiplexed(
            (phase, other[0]),
            (focus, other[1]),
            aperture_um=2 * radius_um,
            library=made_of,
            limits=wanted.limits,
            profile=wanted.profile,
            provenance=about,
        )
        profiles = wanted.profile, (wanted.along_y or wanted).profile
        checks = paired.check_both_foci(made, profiles, skip=options.skip_focus_check)
        figures = paired.figures(made, split)
        lens.save(draft.path, made)
        write_bytes(draft.path.with_suffix(".png"), lens_plot.lens_picture(made))
    head = _head(wanted, options.output, split.x)
    head += describe_order_loss(made_of.cell, wanted.focus.wavelength_um)
    values = paired.polarization_values(split, checks, figures)
    text = paired.polarization_text(head, wanted.layers, split, checks, figures)
    return options.console.judged(values, text, words.focus_failures(checks))


def _read(wanted: DesignSettings, where: Path) -> list[Path]:
    """The files that the config names."""
    maps = [
        one
        for one in (wanted.map, wanted.along_y.map if wanted.along_y else None)
        if one is not None
    ]
    return ([where.parent / wanted.library] if wanted.library else []) + [
        where.parent / one.file for one in maps
    ]


def _make(wanted: DesignSettings, options: Options, path: Path) -> "DesignOutcome":
    """Design, check and write the lens with its pictures."""
    made_of, inputs = _pillars(wanted, options.config, options.console)
    cell, proxy = made_of.cell, library.proxy_of(made_of)
    transaction.check_room(
        options.output, int(math.pi * (1e3 * wanted.aperture_mm / cell.pitch_um) ** 2)
    )  # 4 each
    wanted = wanted.at(proxy.wavelengths_um)
    proxy.at(
        wanted.focus.wavelength_um
    )  # outside the library it is refused here, not after the search for a phase
    if options.process is not None:
        wanted = replace(
            wanted, limits=_printable(options.process, cell, wanted.limits)
        )
        inputs[options.process.name] = reading.sha256(options.process)
    inputs[options.config.name] = reading.sha256(options.config)
    wanted = replace(wanted, layers=wanted.layers.covered_by(cell.cover))
    own = _located(wanted, options.config)
    if wanted.profile == "map" and own is not None and own.file.is_file():
        inputs[own.file.name] = reading.sha256(own.file)
    radius_um = wanted.aperture_mm * 500
    phase, focus, judged = _phase(wanted, options, radius_um)
    about: dict[str, Any] = {
        "aperture_um": 2 * radius_um,
        "limits": wanted.limits,
        "profile": wanted.profile,
    }
    about["provenance"] = store.Provenance(config=config.dumps(wanted), inputs=inputs)
    conversion: ConversionMetrics | None = None
    others: list[Quality] = []
    lights = [
        design.WavelengthTarget(*_phase(one, options, radius_um)[:2], w)
        for one, w in several.designs_by_wavelength(wanted, made_of)
    ]
    if lights:
        made, (quality, *others) = design.assign_multi_wavelength(
            lights, cell=cell, proxy=proxy, **about
        )
    elif made_of.turned is not None:
        made, quality, conversion = design.assign_geometric_phase(
            phase, focus, library=made_of, hand=wanted.hand, **about
        )
    else:
        partial = options.accept_partial_turn
        made, quality = design.make(
            phase, focus, cell=cell, proxy=proxy, accept_partial_turn=partial, **about
        )
    meets = wanted.profile != "map" or words.focus_problem(
        phase, focus, radius_um, cell, options.console
    )
    quality = replace(quality, focuses=meets)
    made, found = words.solve_coupling(
        made, quality, conversion, radius_um, solve=options.own_cell
    )
    checked = _checkable(wanted, options, quality)
    check = (
        check_focus(made, expected=quality.strehl if others else 1.0)
        if checked
        else None
    )
    beside = several.judge_wavelengths(
        made, wanted.wavelengths, lights[1:], others, check=checked
    )
    figures = words.focus_figures(made, quality)
    lens.save(path, made)
    write_bytes(path.with_suffix(".png"), lens_plot.lens_picture(made))
    if judged is not None:
        write_bytes(path.with_name(f"{path.stem}_fisher.png"), judged.picture)
    lost = made_of.mean_loss(made.diameters.diameter_um, wanted.focus.wavelength_um)
    return DesignOutcome(
        wanted, quality, check, figures, judged, conversion, found, made, beside, lost
    )


@dataclass(frozen=True, slots=True)
class DesignOutcome:
    """What a design is worth. wanted: as it was filled in; check: of its focus;
    figures:
    of its PSF; judged: of a free form; conversion: of
    circular light; unlike: what neighbours leave of the efficiency; beside: of the
    other wavelengths; loss: mean share that is absorbed or in other orders."""

    wanted: DesignSettings
    quality: Quality
    check: FocusCheck | None
    figures: FocusMetrics | None
    judged: "_Judged | None"
    conversion: ConversionMetrics | None
    unlike: design.NeighbourCouplingLoss | None
    lens: Lens
    beside: tuple[several.WavelengthMetrics, ...]
    loss: float


def _checkable(wanted: DesignSettings, options: Options, quality: Quality) -> bool:
    """Whether the exact sum makes sense: a lens with one focus, small enough to hold
    every pillar's phase at once.
    """
    if wanted.profile != "hyperbolic" or options.skip_focus_check:
        return False
    if quality.pillars > words.MOST_SUMMED:
        options.console.say(
            f"the exact sum around the focus is left out: more than {words.MOST_SUMMED:,} pillars"
        )
    return quality.pillars <= words.MOST_SUMMED


@dataclass(frozen=True, slots=True)
class _Judged:
    """What a free-form design is worth: numbers, text, PNG."""

    values: dict[str, Any]
    text: str
    picture: bytes


def _phase(
    wanted: DesignSettings, options: Options, radius_um: float
) -> tuple[PhaseOf, Focus, _Judged | None]:
    """The phase of the profile, what it images onto what, and for a free form how it
    compares.
    """
    if wanted.profile == "fisher":
        return _free_form(wanted, options, radius_um)
    shape: dict[str, DoubleHelix | Cubic | PhaseMap | None] = {
        "double-helix": wanted.double_helix,
        "cubic": wanted.cubic,
        "map": _located(wanted, options.config),
    }
    return (
        design.phase_of(shape.get(wanted.profile), wanted.focus, radius_um=radius_um),
        wanted.focus,
        None,
    )


def _free_form(
    wanted: DesignSettings, options: Options, radius_um: float
) -> tuple[PhaseOf, Focus, _Judged | None]:
    """A designed phase; where it was made for axial information, beside simple lenses
    tuned as hard.
    """
    from metalens.design.free_form import design_pupil, fisher_profile
    from metalens.design.free_form import report as reports

    console, settings = options.console, wanted.fisher.about(wanted.focus, radius_um)
    pupil = design_pupil(wanted.focus, radius_um, settings)
    objective = (
        _scene_objective(settings, pupil) if settings.objective == "scenes" else None
    )
    console.say(f"free form: {settings.starts} starts of {settings.iterations} steps")
    phase, found = fisher_profile(
        wanted.focus, radius_um=radius_um, settings=settings, objective=objective
    )
    least, mean = (
        float(found.score.encircled.min()),
        float(found.score.information.mean()),
    )
    figure = (
        f"I(z) {mean:.3f} /mm²"
        if objective is None
        else f"Eq. 6 {-mean:.3f} (0 without blur)"
    )
    console.say(
        f"free form: {figure}, encircled energy {least:.2f} or more; {found.reason}"
    )
    focus = replace(wanted.focus, source_distance_um=found.focus_um)
    if objective is not None:
        return phase, focus, None
    console.say(
        "tuning a hyperbolic lens and a double helix for the same pixels, depths and angles"
    )
    lenses = reports.judge_designs(found, pupil, settings)
    picture = reports.report_picture(lenses, pupil, settings)
    return (
        phase,
        focus,
        _Judged(
            reports.report_values(lenses, settings),
            reports.report_text(lenses, settings),
            picture,
        ),
    )


def _scene_objective(settings: ResolvedFisherSettings, pupil: "Pupil") -> Any:
    """Eq. 6 on rendered eyes, of a package above this one: named by the command line,
    loaded only when asked for.
    """
    return importlib.import_module(OBJECTIVES["scenes"]).SceneObjective(pupil, settings)


def _pillars(
    wanted: DesignSettings, where: Path, console: Console
) -> tuple[PillarLibrary, dict[str, str]]:
    """The library of the pillars, and the hash of its file if there is one."""
    if wanted.library is not None:
        path = where.parent / wanted.library
        return library.load(path), {path.name: reading.sha256(path)}
    cell = wanted.cell or library.DEFAULT_CELL
    waves = (
        wanted.focus.wavelength_um,
        *(1e-3 * one.wavelength_nm for one in wanted.wavelengths),
    )
    return library.sweep(cell, wavelengths_um=tuple(sorted(waves)), console=console), {}


def _printable(path: Path, cell: Cell, limits: Limits) -> Limits:
    """The limits of a process file, through a package above this one that the command
    line names.
    """
    module = importlib.import_module(OBJECTIVES["process"])
    thinnest, gap = module.printable_limits(
        path, pitch_um=cell.pitch_um, height_um=cell.height_um
    )
    return replace(limits, min_diameter_nm=thinnest, min_gap_nm=gap)


def _located(wanted: DesignSettings, where: Path) -> PhaseMap | None:
    """The phase map with its file relative to the config."""
    if wanted.map is None:
        return None
    return replace(wanted.map, file=where.parent / wanted.map.file)
