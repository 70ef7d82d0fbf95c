"""lens.h5 or asbuilt.h5 to psf.h5: PSFs over depth, field angle and wavelength to a
stated error, with plots.

An interruption leaves what stood at the output; the same command begins anew.
"""

import importlib
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import tyro

from metalens import design, lens, psf
from metalens.cell import describe_order_loss
from metalens.commands import far_field
from metalens.commands import psf_words as words
from metalens.commands.common import CommonOptions, MaybeOutput
from metalens.commands.psf_settings import PsfSettings, read_psf_settings
from metalens.core import config, store, transaction
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.report import write_report
from metalens.core.store import Provenance, write_bytes
from metalens.psf import export as psf_export

# by kind of file, the module whose ``load`` gives a :class:`AsBuiltSource`; filled by
# the
# command line
SOURCES: dict[str, str] = {}
CAPTIONS = {
    "xz": "Slice through the PSF along depth, centre row of the window, each depth at its own full scale.",
    "montage": "PSFs over depth (across) and field angle (down); square root of intensity.",
    "mtf": "Modulation transfer along x (thick) and y (thin) up to the cut-off, that of an ideal round aperture dotted, "
    "and the share of the window's light inside a circle.",
    "zscan": "Irradiance along x on planes behind the lens for light along the axis, and its peak and width over the "
    "plane's shift from the sensor.",
    "information": "I(z) of Eq. 11 under two normalisations and three binnings; the normalisation decides the ranking.",
}


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens psf``.

    Attributes:
        lens: lens.h5, or asbuilt.h5 for the lens that was made (its process and wave
            front included).
        output: the file to write, psf.h5 if left out: .h5 (which all other commands
            read), .tif, .mat or .fits;
            plots are written beside it as NAME_xz.png and so on.
        config: PSF.toml with any of the settings below, own_cell, [[layers.front]] and
            [[layers.behind]]. What follows
            stands in place of the file's.
        depths_mm: nearest and farthest source, and the largest step between depths;
            left out: 21 depths about the
            focus of this lens, to 1.75 waves out of focus; of a lens for collimated
            light infinity, with a scan along z behind the lens (NAME_zscan.png).
        sources_mm: the depth of every source, in place of depths_mm; inf for a plane
            wave.
        angles_deg: field angles along x; the image of a positive angle lies at +x. Left
            out: 0 and the half field over which a hyperbolic lens of this focus is
            diffraction-limited; of asbuilt.h5 the angles of the captures.
        angles_y_deg: field angles along y (down), one for each of angles_deg.
        window_um: full width along x of the window about the chief ray; left out: what
            the blur of this lens needs.
        samples: samples along the window's width.
        height_um: height of the window, of samples as far apart; 0 for a square.
        offset_um: x and y from the chief ray to the window's middle.
        source_um: full size of a source that is no point (diameter, side, or width at
            half maximum).
        source_deg: the same as an angle; for sources at infinity too.
        source_shape: disc, square or gaussian.
        led_fwhm_nm: width of the diode about the design wavelength, silicon's response
            included.
        spectrum: CSV files of wavelength in nm and value, whose product is the spectrum
            (LED, filter, sensor).
        wavelengths_nm: wavelengths whose intensities add.
        weights: of those wavelengths; left out: equal.
        polarisation: scalar, flux, vector or auto.
        light: of pillars of two sizes: polarised along x, along y, or both together.
        tolerance: relative L2 error.
        far_field: in place of PSFs, the light far behind the lens over direction
            cosines, with the share of every beam
            (deflectors, holograms, axicons): far_field.h5, NAME_far.png. Takes
            sources_mm (one; left out, a plane
            wave), angles_deg, angles_y_deg, wavelengths_nm (one) and samples (squares
            across all directions).
        report: also write NAME.html.
    """

    lens: tyro.conf.Positional[Path]
    output: MaybeOutput = None
    config: Path | None = None
    depths_mm: tuple[float, float, float] | None = None
    sources_mm: tuple[float, ...] | None = field(
        default=None, metadata={"may_be_inf": True}
    )
    angles_deg: tuple[float, ...] | None = None
    angles_y_deg: tuple[float, ...] | None = None
    window_um: float | None = None
    samples: int | None = None
    height_um: float | None = None
    offset_um: tuple[float, float] | None = None
    source_um: float | None = None
    source_deg: float | None = None
    source_shape: psf.SourceShape | None = None
    led_fwhm_nm: float | None = None
    spectrum: tuple[Path, ...] | None = None
    wavelengths_nm: tuple[float, ...] | None = None
    weights: tuple[float, ...] | None = None
    polarisation: psf.Polarisation | None = None
    light: Literal["both", "x", "y"] | None = None
    tolerance: float | None = None
    far_field: bool = False
    report: bool = False

    @property
    def settings(self) -> PsfSettings:
        """Those of the file with the options in their place."""
        table: dict[str, Any] = {}
        for name in PsfSettings.__slots__:
            value = getattr(self, name, None)
            if isinstance(value, tuple):
                value = [str(v) if isinstance(v, Path) else v for v in value]
            table[name] = value
        return read_psf_settings(self.config, table)


def run(options: Options) -> int:
    """Compute, write, draw; exit 1 where the error estimate stays above the tolerance,
    pillars are hardly known, or a window holds hardly any of the light.

    Args:
        options: of the command line.
    """
    if options.far_field:
        return _far(options)
    target, settings = options.output or Path("psf.h5"), options.settings
    psf_export.check_psf_format(target)
    made, built = _read(options.lens)
    made = made if settings.layers is None else replace(made, layers=settings.layers)
    settings = settings.about(made, None if built is None else built.angle_rad)
    view = settings.view
    pixels = (
        len(view.depths_um)
        * len(view.angles_rad)
        * settings.samples
        * settings.samples_y
    )
    ends = (*(f"_{name}.png" for name in CAPTIONS), ".html")
    with options.claim(
        target, companions=ends, room=transaction.ROOM + 4 * pixels
    ) as draft:
        found = _compute(options.lens, settings, made, built)
        _write(draft.path, found, page=options.report)
    failures = [
        words.tolerance_excess(found.stack),
        made.proxy.doubt,
        words.dark_window(found),
    ]
    values = words.psf_numbers(found) | {"doubt": made.proxy.doubt}
    text = words.psf_text(target, found)
    text += describe_order_loss(made.cell, float(found.stack.wavelengths_um.min()))
    return options.console.judged(values, text, failures)


def _far(options: Options) -> int:
    """Compute, write, draw the far field of a design."""
    target = options.output or Path("far_field.h5")
    if target.suffix.lower() != ".h5":
        raise ConfigError(f"{target}: a far field is written as .h5")
    kind = store.kind_of(options.lens)
    if kind in SOURCES:
        raise ConfigError(
            f"{options.lens}: the far field of a design (lens.h5), not of a file of kind {kind}"
        )
    made = lens.load(options.lens)
    wanted, inputs = (
        far_field.far_field_request(options, made),
        {options.lens.name: store.sha256(options.lens)},
    )
    with options.claim(
        target,
        companions=("_far.png", ".html"),
        room=transaction.ROOM + 4 * wanted.samples**2,
    ) as draft:
        found = far_field.compute_far_fields(made, wanted, options.console)
        far_field.save_far_fields(
            draft.path, wanted, found, inputs=inputs, page=options.report
        )
    options.console.result(
        far_field.far_field_values(wanted, found),
        far_field.far_field_text(target, wanted, found),
    )
    return 0


class AsBuiltSource(Protocol):
    """A lens that was made, with the PSFs of what was made."""

    @property
    def design(self) -> lens.Lens:
        """What was to be made."""

    @property
    def angle_rad(self) -> Array:
        """(n, 2) field angles of the captures."""

    def psf_stack(self, view: "psf.View", *, tolerance: float) -> "psf.PsfStack":
        """PSFs (angle, depth, y, x)."""

    def psf_posterior(self, view: "psf.View") -> float:
        """Relative L2 error of the PSFs by what the captures leave open."""


def _read(path: Path) -> tuple[lens.Lens, AsBuiltSource | None]:
    """The design of a file, and what was made of it where the file is of another kind
    that the command line knows.
    """
    kind = store.kind_of(path)
    if kind not in SOURCES:
        return lens.load(path), None
    found: AsBuiltSource = importlib.import_module(SOURCES[kind]).load(path)
    return found.design, found


def _compute(
    path: Path, settings: PsfSettings, made: lens.Lens, built: AsBuiltSource | None
) -> words.Computed:
    """PSFs, the figures of the sharpest of every angle, and a scan behind a lens for
    collimated light.
    """
    if built is not None:
        stack = _of_built(path, settings, built)
        figures = psf.focus_metrics(stack, made)
        return words.Computed(stack, figures, design.lens_meeting_um(made))
    made = _in_light(path, made, settings)
    known = _own_cell(made, settings) if settings.own_cell else None
    if known is not None and isinstance(known.neighbours, lens.NeighbourRows):
        made = replace(made, neighbours=known.neighbours)
    stack = _of_design(made, settings, known, _provenance(path, settings))
    figures = psf.focus_metrics(stack, made, power_error=design.power_error(made))
    lit = figures[0].window_share >= words.DARK
    scan = _scan(made, settings, stack) if lit else None
    return words.Computed(stack, figures, design.lens_meeting_um(made), scan)


def _scan(
    made: lens.Lens, settings: PsfSettings, stack: psf.PsfStack
) -> "psf.FocusScan | None":
    """Behind a lens for collimated light, unless its sources were stated."""
    if not math.isinf(made.source_distance_um) or settings.sources_mm != (math.inf,):
        return None
    nodes = psf.SpectralNodes(stack.wavelengths_um, stack.weights, 0.0)
    return psf.focus_scan(made, offset_um=settings.offset_um, nodes=nodes)


def _write(path: Path, found: words.Computed, *, page: bool) -> None:
    """The file of PSFs, its pictures, and with ``page`` its report."""
    from metalens.psf import plots as psf_plots

    psf_export.export_psf(path, found.stack)
    limit = max((one.limit for one in found.figures), key=lambda one: one.cutoff_per_um)
    pictures = psf_plots.psf_pictures(found.stack, limit=limit, scan=found.scan)
    for name, image in pictures.items():
        write_bytes(path.with_name(f"{path.stem}_{name}.png"), image)
    if page:
        sections = words.psf_sections(
            found, {CAPTIONS[n]: i for n, i in pictures.items()}
        )
        write_report(
            path.with_suffix(".html"),
            "Point spread functions",
            sections,
            key_figures=words.key_figures(found),
        )


def _of_built(path: Path, settings: PsfSettings, given: AsBuiltSource) -> psf.PsfStack:
    """PSFs of a kind of file that the command line knows a source for, the posterior of
    its fit in their error.
    """
    for name in ("led_fwhm_nm", "spectrum", "wavelengths_nm", "layers", "own_cell"):
        if getattr(settings, name):
            raise ConfigError(
                f"{path}: {name} is for a design; this {store.kind_of(path)} file has the wavelength and layers that "
                "were fitted"
            )
    if settings.polarisation in ("flux", "vector"):
        stated = f"polarisation = {settings.polarisation!r} is for a design; a {store.kind_of(path)} file is one scalar"
        raise ConfigError(f"{path}: {stated}")
    found = given.psf_stack(settings.view, tolerance=settings.tolerance)
    posterior = given.psf_posterior(settings.view)
    budget = replace(found.budget or psf.Budget(found.error), posterior=posterior)
    return replace(
        found,
        error=math.hypot(found.error, posterior),
        budget=budget,
        provenance=_provenance(path, settings),
    )


def _in_light(path: Path, made: lens.Lens, settings: PsfSettings) -> lens.Lens:
    """The lens for the polarisation that is asked for."""
    if settings.light == "both" or (
        made.pairs is None and made.one_light == f"light along {settings.light}"
    ):
        return made
    if made.pairs is not None:
        return made.seen(settings.light)
    known = f"know {made.one_light} alone" if made.one_light else "treat x and y alike"
    known = "are turned, for circular light" if made.hand else known
    raise ConfigError(
        f"{path}: light = {settings.light!r} is for pillars of two sizes; these {known}"
    )


def _of_design(
    made: lens.Lens,
    settings: PsfSettings,
    known: psf.LeftOut | None,
    provenance: Provenance,
) -> psf.PsfStack:
    """PSFs of a lens file; of pillars of two sizes the mean of light along x and y."""

    def of(one: lens.Lens) -> psf.PsfStack:
        return psf.from_lens(
            one,
            settings.view,
            tolerance=settings.tolerance,
            spectrum=settings.spectrum_of(one),
            provenance=provenance,
            polarisation=settings.polarisation,
            left_out=known,
        )

    if made.pairs is None or settings.light != "both":
        return of(made)
    x, y = made.seen("x"), made.seen("y")
    if (x.sensor_distance_um, x.source_distance_um) != (
        y.sensor_distance_um,
        y.source_distance_um,
    ):
        raise ConfigError(
            "light along x and y is focused at other distances by this lens: give light = 'x' or 'y'"
        )
    return psf.mean_over_polarizations(of(x), of(y))


def _provenance(path: Path, settings: PsfSettings) -> Provenance:
    files = [path, *(file for file in settings.spectrum if file.is_file())]
    return Provenance(
        config.dumps(settings), {file.name: store.sha256(file) for file in files}
    )


def _own_cell(made: lens.Lens, settings: PsfSettings) -> psf.LeftOut:
    """Neighbours and angle of the lens's own pillars, at the largest aperture and angle
    of the view.
    """
    apertures = [psf.sine_aperture(made, angle) for angle in settings.view.angles_rad]
    incidence = max(
        float(np.arctan(np.hypot(*np.tan(angle)))) for angle in settings.view.angles_rad
    )
    return design.left_out(made, aperture=max(apertures), incidence_rad=incidence)
