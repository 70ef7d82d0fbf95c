"""lens.h5 or asbuilt.h5 to psf.h5: PSFs over depth, field angle and wavelength to a
stated error, with plots.

An interruption leaves what stood at the output; the same command begins anew.
"""

import math
import pkgutil
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from metalens import design, lens, propagate, psf
from metalens.cell import describe_order_loss
from metalens.commands import far_field
from metalens.commands.common import CommonOptions, MaybeOutput
from metalens.commands.design import format_place
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.report import Figure, KeyFigure, Section, summary_table, write_report
from metalens.core.store import Provenance, write_bytes
from metalens.lens import reach
from metalens.optics import Layers
from metalens.psf import export as psf_export
from metalens.psf import spectrum as spectra

MOST_SAMPLES, MOST_DEPTHS = 16_384, 100_000
AIRY = 28.0  # width of a window in units of wavelength / NA


@dataclass(frozen=True, slots=True)
class PsfSettings:
    """What is computed; kept in the file.

    depths_mm: nearest and farthest source, and the largest step between depths. Left
        out, infinity for a lens for collimated light, else 21 depths, its focus among
        them, over which the rim of this lens goes from 1.75 waves out of focus on one
        side to as many on the other.
    sources_mm: in place of depths_mm, the depth of every source; inf for a plane wave.
    angles_deg: field angles along x, arctangents of the light's slope dx/dz in air: the
        image of a positive angle lies at +x; left out: 0 and the half field over which
        a hyperbolic lens of this focus is diffraction-limited (Strehl ratio 0.8), or
        the angles that a lens was measured at. angles_y_deg: along y (down), one for
        each or none for 0.
    window_um, samples: full width along x of the window that follows the chief ray, and
        samples along it; without a width 28 wavelength / NA, or 8 blur radii at the
        worst depth where that is more.
    height_um: its height, of samples as far apart; 0 for a square window.
    offset_um: [x, y] from the chief ray to the window's middle.
    source_um: full size of an incoherent source: diameter of a disc, side of a square,
        full width at half maximum of a gaussian; 0 for a point. source_deg: the same as
        an angle, for sources at infinity too.
    source_shape: disc, square or gaussian.
    led_fwhm_nm: width of the diode about the design wavelength; 0 for one wavelength.
    source, filter, sensor: in place of led_fwhm_nm, curves over wavelength whose
        product is the spectrum: spectrum of the source, transmission of a filter,
        response of the sensor; any of the three. Each is a CSV file of wavelength (nm,
        or um where its column says so) and value, or a name of colour-science ("D65").
    spectrum: more such curves.
    wavelengths_nm: in place of both, wavelengths in vacuum whose intensities add.
    weights: of each; none for equal.
    tolerance: relative L2 error of the PSFs.
    polarisation: ``scalar`` (the flux through the sensor's plane, to fourth order in
        NA), ``flux`` (that of both polarisations, which a pixel counts), ``vector``
        (Ex, Ey, Ez of both, squares added), or ``auto``: the scalar where its distance
        to the flux is below the tolerance, else the flux.
    layers: films in front and behind in place of the lens file's, as in DESIGN.toml.
    light: polarisation along x or y, for a lens of pillars of two sizes; both: the mean
        of the two, where they are focused from and to the same distances (any light,
        for other lenses).
    own_cell: solve rows of non-identical pillars of the lens's own cell (seconds to
        minutes): the PSFs then hold the factor of those neighbours, the error budget
        what is left. A lens of ``design --own-cell`` holds its rows. Without either,
        pillars are taken one by one, and that term is rough, of the default cell.
    """

    depths_mm: tuple[float, float, float] | None = None
    sources_mm: tuple[float, ...] = field(default=(), metadata={"may_be_inf": True})
    angles_deg: tuple[float, ...] | None = None
    angles_y_deg: tuple[float, ...] = ()
    window_um: float | None = None
    samples: int = 192
    height_um: float = 0.0
    offset_um: tuple[float, float] = (0.0, 0.0)
    source_um: float = 0.0
    source_deg: float = field(default=0.0, metadata={"signed": False})
    source_shape: psf.SourceShape = "disc"
    led_fwhm_nm: float = 0.0
    source: Path | None = None
    filter: Path | None = None
    sensor: Path | None = None
    spectrum: tuple[Path, ...] = ()
    wavelengths_nm: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    tolerance: float = 1e-4
    polarisation: psf.Polarisation = "scalar"
    layers: Layers | None = None
    own_cell: bool = False
    light: Literal["both", "x", "y"] = "both"

    def __post_init__(self) -> None:
        """Refuse settings out of range, and settings that exclude one another.

        Raises:
            ConfigError: naming the settings and what is needed.
        """
        near, far, step = self.depths_mm or (1.0, 1.0, 1.0)
        depths = 0 < near <= far < math.inf and step > 0
        along_x, along_y = self.angles_deg, self.angles_y_deg
        pairs = along_x != () and len(along_y) in (0, len(along_x or ()))
        width = 1.0 if self.window_um is None else self.window_um
        fits = 2 <= self.samples <= MOST_SAMPLES and 0 < width < math.inf
        rows = self.height_um / width * self.samples if fits else 1.0
        whole = abs(rows - round(rows)) <= 1e-6 * rows
        lights = self.curves, self.led_fwhm_nm, self.wavelengths_nm
        checks = {
            "depths_mm": (
                depths and (far - near) / step <= MOST_DEPTHS,
                "nearest, farthest and step with 0 < nearest <= farthest, and at most "
                f"{MOST_DEPTHS} depths",
            ),
            "sources_mm": (
                all(depth > 0 for depth in self.sources_mm),
                "depths above 0, inf for a plane wave",
            ),
            "angles_deg, angles_y_deg": (
                pairs,
                "angles along x, and along y none or one for each",
            ),
            "samples, window_um": (
                fits,
                f"2 to {MOST_SAMPLES} samples, and a window above 0",
            ),
            "height_um, window_um": (
                not self.height_um
                or (self.window_um and whole and 1 <= round(rows) <= MOST_SAMPLES),
                f"window_um, and a height of a whole number of up to {MOST_SAMPLES} "
                "samples of window_um / samples",
            ),
            "source, filter, sensor, spectrum, led_fwhm_nm, wavelengths_nm": (
                sum(map(bool, lights)) <= 1,
                "curves, a diode or wavelengths, each is the whole spectrum",
            ),
        }
        for names, (met, need) in checks.items():
            if not met:
                stated = [
                    f"{name} = {getattr(self, name)}" for name in names.split(", ")
                ]
                raise ConfigError(f"{', '.join(stated)}: need {need}")

    @property
    def samples_y(self) -> int:
        """Samples along y, of a window with a width."""
        if not self.height_um or self.window_um is None:
            return self.samples
        return round(self.height_um / self.window_um * self.samples)

    def about(
        self, device: lens.Lens, angles_rad: Array | None = None
    ) -> "PsfSettings":
        """Settings for one lens, with its depths, angles and window where they were
        left out.

        Depths: infinity for a lens for collimated light, else 21 even ones over
        :func:`metalens.lens.reach.depth_range_um`, of which the nearest in 1/z is moved
        into focus.

        Args:
            device: the lens.
            angles_rad: (n, 2) angles at which it was measured, in place of its field's.
        """
        filled = self
        if self.angles_deg is None:
            x, y = _angles_deg(device, angles_rad)
            filled = replace(filled, angles_deg=x, angles_y_deg=y)
        if not self.sources_mm and self.depths_mm is None:
            if math.isinf(device.source_distance_um):
                filled = replace(filled, sources_mm=(math.inf,))
            else:
                near, far = (depth * 1e-3 for depth in reach.depth_range_um(device))
                depths = np.linspace(near, far, 21)
                focus_mm = device.source_distance_um * 1e-3
                if near < focus_mm < far:
                    depths[np.abs(1 / depths - 1 / focus_mm).argmin()] = focus_mm
                filled = replace(filled, sources_mm=tuple(depths.tolist()))
        if self.window_um is not None:
            return filled
        ends = filled.sources_mm or (filled.depths_mm or ())[:2]
        ends_um = tuple(z * 1e3 for z in ends)
        return replace(filled, window_um=reach.window_um(device, ends_um, airy=AIRY))

    @property
    def view(self) -> "psf.View":
        """Depths, angles, window and source in um and rad.

        Raises:
            ConfigError: what is left to the lens was not filled in (:meth:`about`).
        """
        depths = np.array(self.sources_mm)
        if not self.sources_mm and self.depths_mm:
            near, far, step = self.depths_mm
            depths = np.linspace(
                near, far, int(np.ceil((far - near) / step - 1e-9)) + 1
            )
        if not depths.size or self.angles_deg is None or self.window_um is None:
            raise ConfigError(
                "depths_mm, angles_deg or window_um are left to the lens, and there is none"
            )
        along_y = self.angles_y_deg or (0.0,) * len(self.angles_deg)
        angles = [
            propagate.to_angle_pair(np.deg2rad(pair))
            for pair in zip(self.angles_deg, along_y, strict=True)
        ]
        return psf.View(
            tuple((depths * 1e3).tolist()),
            tuple(angles),
            (self.window_um, self.window_um / self.samples * self.samples_y),
            (self.samples, self.samples_y),
            self.offset_um,
            self.source_extent,
        )

    @property
    def curves(self) -> tuple[Path, ...]:
        """Curves whose product is the spectrum."""
        stated = self.source, self.filter, self.sensor, *self.spectrum
        return tuple(curve for curve in stated if curve is not None)

    @property
    def source_extent(self) -> "psf.SourceExtent | None":
        """Size and shape of the source, None for a point."""
        if not (self.source_um or self.source_deg):
            return None
        return psf.SourceExtent(
            self.source_shape,
            self.source_um,
            2 * math.tan(math.radians(self.source_deg) / 2),
        )

    def spectrum_of(
        self, device: lens.Lens
    ) -> spectra.SpectralNodes | spectra.Source | spectra.MeasuredSpectrum | None:
        """The spectrum for a lens: wavelengths with weights, a diode or measured
        curves.

        None for the design wavelength alone.

        Args:
            device: the lens; a diode is centred at its wavelength.
        """
        if self.wavelengths_nm:
            share = np.array(self.weights or [1.0] * len(self.wavelengths_nm))
            return spectra.SpectralNodes(
                np.array(self.wavelengths_nm) * 1e-3, share / share.sum(), 0.0
            )
        if self.curves:
            return spectra.read_measured_spectrum(
                self.curves, within_um=device.proxy.wavelengths_um
            )
        if not self.led_fwhm_nm:
            return None
        return spectra.Source(device.wavelength_um * 1e3, self.led_fwhm_nm)


def _angles_deg(
    device: lens.Lens, angles_rad: Array | None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(x, y) field angles in deg: those of the captures, else 0 and the half field
    along x.

    Args:
        device: the lens.
        angles_rad: (n, 2) angles at which it was measured; None for a design.
    """
    if angles_rad is not None and len(angles_rad):
        x, y = np.rad2deg(np.unique(angles_rad, axis=0)).T
        return tuple(x.tolist()), tuple(y.tolist())
    radius_um = device.diameters.radius_um + device.diameters.pitch_um / 2
    half = math.degrees(design.field_angle(design.lens_focus(device), radius_um))
    return (0.0, float(f"{half:.2g}")), (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ComputedPsfs:
    """stack: PSFs. figures: of the sharpest depth of every angle. meets_um: (x, y, z)
    behind the lens where rays of the design source meet, None where they do not.
    scan: along z, of a lens for collimated light.
    """

    stack: psf.PsfStack
    figures: tuple[psf.FocusMetrics, ...]
    meets_um: tuple[float, float, float] | None
    scan: "psf.FocusScan | None" = None


# by kind of file, the record whose ``load`` gives an as-built lens: its ``design``, the
# (n, 2) field angles ``angle_rad`` of its captures, ``psf_stack(view, tolerance=)`` and
# their relative L2 error ``psf_posterior(view)``; filled by the command line
SOURCES: dict[str, str] = {}
CAPTIONS = {
    "xz": "Slice through the PSF along depth, centre row of the window, each depth at its own full scale.",
    "montage": "PSFs over depth (across) and field angle (down); square root of intensity.",
    "mtf": "Modulation transfer along x (thick) and y (thin) up to the cut-off, that of an ideal round aperture dotted, "
    "and the share of the window's light inside a circle.",
    "zscan": "Irradiance along x on planes behind the lens for light along the axis, and its peak and width over the "
    "plane's shift from the sensor.",
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
        source: CSV file of the source's spectrum (wavelength in nm or um, value), or a
            name of colour-science (D65).
        filter: the same of a filter's transmission.
        sensor: the same of the sensor's response. The spectrum is their product.
        spectrum: more such curves.
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
    source: Path | None = None
    filter: Path | None = None
    sensor: Path | None = None
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
        """Those of the file with the options in their place.

        Raises:
            ConfigError: as :func:`metalens.core.config.load`.
        """
        stated: dict[str, Any] = {}
        for name in PsfSettings.__slots__:
            value = getattr(self, name, None)
            if isinstance(value, tuple):
                value = [str(v) if isinstance(v, Path) else v for v in value]
            elif isinstance(value, Path):
                value = str(value)
            if value is not None:
                stated[name] = value
        if self.config is None:
            return config.from_table(stated, PsfSettings, where="the command line")
        table = config.read(self.config, PsfSettings, empty=False)
        where = f"{self.config}{' and the command line' if stated else ''}"
        return config.from_table(table | stated, PsfSettings, where=where)


def run(options: Options) -> int:
    """Compute PSFs, write them and draw them.

    Exit status 1 where the error estimate stays above the tolerance, pillars are hardly
    known, or a window holds hardly any of the light.

    Args:
        options: of the command line.
    """
    if options.far_field:
        return _run_far_field(options)
    target = options.output or Path("psf.h5")
    settings = options.settings
    psf_export.check_psf_format(target)
    device, built = _read(options.lens)
    if settings.layers is not None:
        device = replace(device, layers=settings.layers)
    settings = settings.about(device, None if built is None else built.angle_rad)
    ends = (*(f"_{name}.png" for name in CAPTIONS), ".html")
    with options.claim(target, companions=ends) as draft:
        computed = _compute(options.lens, settings, device, built)
        _write(draft.path, computed, page=options.report)
    failures = [
        tolerance_excess(computed.stack),
        device.proxy.doubt,
        dark_window(computed),
    ]
    shortest = float(computed.stack.wavelengths_um.min())
    return options.console.report(
        f"{target}: PSFs within a relative error of {computed.stack.error:.2g}",
        psf_values(computed),
        notes=[_place_note(computed), describe_order_loss(device.cell, shortest)],
        failures=failures,
    )


def _run_far_field(options: Options) -> int:
    """Compute, write and draw the far field of a design; exit status 0.

    Raises:
        ConfigError: another output than .h5, or a lens that is no design.
    """
    target = options.output or Path("far_field.h5")
    if target.suffix.lower() != ".h5":
        raise ConfigError(f"{target}: a far field is written as .h5")
    kind = store.kind_of(options.lens)
    if kind in SOURCES:
        raise ConfigError(
            f"{options.lens}: the far field of a design (lens.h5), not of a file of kind {kind}"
        )
    device = lens.load(options.lens)
    request = far_field.far_field_request(options, device)
    inputs = {options.lens.name: store.sha256(options.lens)}
    with options.claim(target, companions=("_far.png", ".html")) as draft:
        fields = far_field.compute_far_fields(device, request)
        far_field.save_far_fields(
            draft.path, request, fields, inputs=inputs, page=options.report
        )
    return options.console.report(
        f"{target}: shares of the light that passes the pillars, by beams and cones",
        far_field.far_field_values(request, fields),
    )


def _read(path: Path) -> tuple[lens.Lens, Any]:
    """The design in a file, and the as-built lens where the file is of such a kind.

    :data:`SOURCES` names the kinds; None for a design.
    """
    kind = store.kind_of(path)
    if kind not in SOURCES:
        return lens.load(path), None
    built = pkgutil.resolve_name(SOURCES[kind]).load(path)
    return built.design, built


def _compute(
    path: Path, settings: PsfSettings, device: lens.Lens, built: Any
) -> ComputedPsfs:
    """PSFs, figures of the sharpest depth of every angle, and a scan along z.

    The scan is of a lens for collimated light. With ``own_cell`` solved neighbours are
    in the PSFs.

    Args:
        path: of the lens file.
        settings: with nothing left to the lens.
        device: the design.
        built: the as-built lens; None for a design.
    """
    if built is not None:
        stack = _of_built(path, settings, built)
        figures = psf.focus_metrics(stack, device)
        return ComputedPsfs(stack, figures, design.lens_meeting_um(device))
    device = _in_light(path, device, settings)
    if settings.own_cell:
        device = replace(device, neighbours=design.solve_coupling_rows(device))
    stack = _of_design(device, settings, _provenance(path, settings))
    figures = psf.focus_metrics(stack, device, power_error=design.power_error(device))
    bright = figures[0].window_share >= DARK
    scan = _scan(device, settings, stack) if bright else None
    return ComputedPsfs(stack, figures, design.lens_meeting_um(device), scan)


def _scan(
    device: lens.Lens, settings: PsfSettings, stack: psf.PsfStack
) -> "psf.FocusScan | None":
    """Irradiance along z behind a lens for collimated light; None where sources were
    stated.
    """
    if not math.isinf(device.source_distance_um) or settings.sources_mm != (math.inf,):
        return None
    nodes = psf.SpectralNodes(stack.wavelengths_um, stack.weights, 0.0)
    return psf.focus_scan(device, offset_um=settings.offset_um, nodes=nodes)


def _write(path: Path, computed: ComputedPsfs, *, page: bool) -> None:
    """Write the PSFs, their pictures, and with ``page`` the report.

    Args:
        path: of the PSFs; pictures are NAME_xz.png and so on.
        computed: PSFs and figures.
        page: whether to write NAME.html.
    """
    from metalens.psf import plots as psf_plots

    psf_export.export_psf(path, computed.stack)
    limits = (metrics.limit for metrics in computed.figures)
    limit = max(limits, key=lambda limit: limit.cutoff_per_um)
    pictures = psf_plots.psf_pictures(computed.stack, limit=limit, scan=computed.scan)
    for name, image in pictures.items():
        write_bytes(path.with_name(f"{path.stem}_{name}.png"), image)
    if page:
        focus = computed.figures[0]
        figures = [
            Figure(image, CAPTIONS[name], wide=True) for name, image in pictures.items()
        ]
        write_report(
            path.with_suffix(".html"),
            "Point spread functions",
            [
                Section("Pictures", items=figures),
                Section("Result", items=[summary_table(psf_values(computed))]),
            ],
            key_figures=[
                KeyFigure("relative error", f"{computed.stack.error:.2g}"),
                KeyFigure("focusing efficiency", f"{focus.efficiency:.3f}"),
                KeyFigure("Strehl ratio", f"{focus.strehl:.3f}"),
            ],
        )


def _of_built(path: Path, settings: PsfSettings, built: Any) -> psf.PsfStack:
    """PSFs of an as-built lens, with the posterior of its fit in their error.

    Args:
        path: of the file.
        settings: with nothing left to the lens.
        built: the as-built lens.

    Raises:
        ConfigError: settings that are for a design.
    """
    for name in ("led_fwhm_nm", "curves", "wavelengths_nm", "layers", "own_cell"):
        if getattr(settings, name):
            raise ConfigError(
                f"{path}: {name} is for a design; this {store.kind_of(path)} file has the wavelength and layers that "
                "were fitted"
            )
    if settings.polarisation in ("flux", "vector"):
        raise ConfigError(
            f"{path}: polarisation = {settings.polarisation!r} is for a design; a {store.kind_of(path)} file is one scalar"
        )
    stack: psf.PsfStack = built.psf_stack(settings.view, tolerance=settings.tolerance)
    posterior = built.psf_posterior(settings.view)
    budget = replace(stack.budget, posterior=posterior)
    return replace(
        stack,
        error=math.hypot(stack.error, posterior),
        budget=budget,
        provenance=_provenance(path, settings),
    )


def _in_light(path: Path, device: lens.Lens, settings: PsfSettings) -> lens.Lens:
    """The lens for the polarisation in the settings.

    Args:
        path: of the lens file, for messages.
        device: the lens.
        settings: with ``light``: both, x or y.

    Raises:
        ConfigError: light along x or y of a lens that has no such response.
    """
    if settings.light == "both" or (
        device.pairs is None and device.one_light == f"light along {settings.light}"
    ):
        return device
    if device.pairs is not None:
        return device.for_polarization(settings.light)
    response = f"know {device.one_light} alone"
    if device.hand or not device.one_light:
        response = (
            "are turned, for circular light" if device.hand else "treat x and y alike"
        )
    raise ConfigError(
        f"{path}: light = {settings.light!r} is for pillars of two sizes; these {response}"
    )


def _of_design(
    device: lens.Lens, settings: PsfSettings, provenance: Provenance
) -> psf.PsfStack:
    """PSFs of a design; with pillars of two sizes the mean of light along x and y.

    Args:
        device: the lens.
        settings: with nothing left to the lens.
        provenance: of the stack.

    Raises:
        ConfigError: x and y are focused at other distances.
    """

    def stack_of(polarised: lens.Lens) -> psf.PsfStack:
        return psf.from_lens(
            polarised,
            settings.view,
            tolerance=settings.tolerance,
            spectrum=settings.spectrum_of(polarised),
            provenance=provenance,
            polarisation=settings.polarisation,
        )

    if device.pairs is None or settings.light != "both":
        return stack_of(device)
    x, y = device.for_polarization("x"), device.for_polarization("y")
    if (x.sensor_distance_um, x.source_distance_um) != (
        y.sensor_distance_um,
        y.source_distance_um,
    ):
        raise ConfigError(
            "light along x and y is focused at other distances by this lens: give light = 'x' or 'y'"
        )
    return psf.mean_over_polarizations(stack_of(x), stack_of(y))


def _provenance(path: Path, settings: PsfSettings) -> Provenance:
    files = [path, *(file for file in settings.curves if file.is_file())]
    return Provenance(
        config.dumps(settings), {file.name: store.sha256(file) for file in files}
    )


DARK = 0.1  # least share of the light in a window that holds an image


def tolerance_excess(stack: psf.PsfStack) -> str:
    """Message that the computed error is above the tolerance, with its cure; else
    empty.

    Args:
        stack: PSFs over angle, depth and wavelength.
    """
    if stack.converged:
        return ""
    error = stack.budget.computed
    return f"the relative error {error:.2g} is above the tolerance {stack.tolerance:g}: {stack.budget.cure}"


def dark_window(computed: ComputedPsfs) -> str:
    """Message that windows hold hardly any light, and where the rays meet; else empty.

    Args:
        computed: PSFs and figures.
    """
    dark = [metrics for metrics in computed.figures if not metrics.window_share >= DARK]
    if not dark:
        return ""
    angles = ", ".join(
        "({:.3g}, {:.3g}) deg".format(*np.rad2deg(metrics.angle_rad))
        for metrics in dark
    )
    share = max(metrics.window_share for metrics in dark)
    meets = computed.meets_um
    where = (
        "rays of the design source meet nowhere (psf --far-field shows where its light goes)"
        if meets is None
        else f"rays of the design source meet {format_place(meets)}; --offset-um moves the window"
    )
    return f"the window of {angles} holds {share:.2g} of the light: {where}"


def _place_note(computed: ComputedPsfs) -> str:
    """Where rays of the design source meet, in words, where that is off the axis."""
    meets = computed.meets_um
    if meets is None or math.hypot(*meets[:2]) <= computed.stack.step_um:
        return ""
    return f"rays of the design source meet {format_place(meets)}"


def psf_values(computed: ComputedPsfs) -> dict[str, Any]:
    """Result of the command as a dictionary for JSON.

    Args:
        computed: PSFs and figures.
    """
    stack = computed.stack
    values: dict[str, Any] = {
        "error": stack.error,
        "computed_error": stack.budget.computed,
        "budget": asdict(stack.budget),
        "tolerance": stack.tolerance,
        "converged": stack.converged,
        "reason": stack.reason,
        "depths_um": stack.depths_um.tolist(),
        "angles_rad": stack.angles_rad.tolist(),
        "wavelengths_um": stack.wavelengths_um.tolist(),
        "focus": [asdict(metrics) for metrics in computed.figures],
        "rays_meet_um": computed.meets_um,
    }
    if computed.scan is not None:
        names = ("shift_um", "peak", "fwhm_um")
        scan = {name: getattr(computed.scan, name).tolist() for name in names}
        values["z_scan"] = scan | {"best_um": computed.scan.best_um}
    return values
