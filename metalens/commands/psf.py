"""lens.h5 or asbuilt.h5 to psf.h5: PSFs over depth, field angle and wavelength to a stated error, with plots."""

import importlib
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from metalens import design, lens, propagate, psf
from metalens.commands.common import Common, Output
from metalens.ground import config, store, transaction
from metalens.ground.errors import ConfigError
from metalens.ground.report import Figure, KeyFigure, Section, Table, write
from metalens.ground.store import Provenance, write_bytes
from metalens.lens import Layers
from metalens.psf import export as psf_export
from metalens.psf import plots as psf_plots
from metalens.psf import spectrum

SOURCES: dict[str, str] = {}  # module with ``stack(path, view, tolerance)`` by kind of file, filled by the command line
CAPTIONS = {
    "xz": "Slice through the PSF along depth, centre row of the window, each depth at its own full scale.",
    "montage": "PSFs over depth (across) and field angle (down); square root of intensity.",
    "mtf": "Modulation transfer along x (thick) and y (thin), and the share of the window's light inside a circle.",
    "information": "I(z) of Eq. 11 under two normalisations and three binnings; the normalisation decides the ranking.",
}
MOST_SAMPLES, MOST_DEPTHS = 16_384, 100_000
BUDGET_WORDS = (
    "What computation and model are wrong by, each alone, the worst over angles: the terms of the model are those "
    "of a perfect lens of the same aperture."
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is computed; kept in the file.

    depths_mm: nearest and farthest source, and the largest step between depths.
    angles_deg: field angles along x; angles_y_deg: along y, one for each or none for 0.
    window_um, samples: of the square window that follows the chief ray.
    led_fwhm_nm: width of the diode about the design wavelength; 0 for one wavelength.
    tolerance: relative L2 error of the PSFs.
    polarisation: ``scalar``, ``vector`` (Ex, Ey, Ez of both polarisations), or ``auto``: the scalar where its error is
        below the tolerance.
    spectrum: in place of led_fwhm_nm, CSV files of wavelength in nm and value whose product is the spectrum (LED,
        filter, sensor).
    layers: films in front and behind in place of the lens file's, as in DESIGN.toml.
    own_cell: solve rows of unlike pillars and tilted light for the lens's own cell, for the error budget (seconds to a
        minute); without it those terms are rough, of the default cell.
    """

    depths_mm: tuple[float, float, float] = (16.0, 26.0, 0.5)
    angles_deg: tuple[float, ...] = (0.0, 10.0, 20.0)
    angles_y_deg: tuple[float, ...] = ()
    window_um: float = 144.0
    samples: int = 192
    led_fwhm_nm: float = 0.0
    tolerance: float = 1e-4
    polarisation: psf.Polarisation = "scalar"
    spectrum: tuple[Path, ...] = ()
    layers: Layers | None = None
    own_cell: bool = False

    def __post_init__(self) -> None:
        near, far, step = self.depths_mm
        if not (0 < near <= far < np.inf and step > 0):
            raise ConfigError(
                f"depths_mm = {self.depths_mm}: need nearest, farthest and step with 0 < nearest <= farthest"
            )
        if not (2 <= self.samples <= MOST_SAMPLES and 0 < self.window_um < np.inf):
            raise ConfigError(
                f"samples = {self.samples}, window_um = {self.window_um}: need 2 to {MOST_SAMPLES} samples, window > 0"
            )
        if (far - near) / step > MOST_DEPTHS or max(map(abs, (*self.angles_deg, *self.angles_y_deg, 0.0))) >= 90:
            raise ConfigError(
                f"depths_mm = {self.depths_mm}, angles_deg = {self.angles_deg}: need at most {MOST_DEPTHS} depths, "
                "angles within 90 degrees"
            )
        if not self.angles_deg or (self.angles_y_deg and len(self.angles_y_deg) != len(self.angles_deg)):
            raise ConfigError(
                f"{len(self.angles_deg)} angles along x, {len(self.angles_y_deg)} along y: need one for each"
            )
        if not (0 < self.tolerance < 1 and self.led_fwhm_nm >= 0):
            raise ConfigError(
                f"tolerance = {self.tolerance}, led_fwhm_nm = {self.led_fwhm_nm}: need 0 < tolerance < 1, width >= 0"
            )
        if self.spectrum and self.led_fwhm_nm:
            raise ConfigError("spectrum and led_fwhm_nm are both given: a measured spectrum holds the diode; give one")

    @property
    def view(self) -> psf.View:
        """Depths, angles and window in um and rad."""
        near, far, step = self.depths_mm
        depths = np.linspace(near, far, int(np.ceil((far - near) / step - 1e-9)) + 1) * 1e3
        along_y = self.angles_y_deg or (0.0,) * len(self.angles_deg)
        pairs = [tuple(np.deg2rad([x, y]).tolist()) for x, y in zip(self.angles_deg, along_y, strict=True)]
        angles = tuple(propagate.angles(pair) for pair in pairs)
        return psf.View(tuple(depths.tolist()), angles, self.window_um, self.samples)


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens psf``.

    Attributes:
        lens: lens.h5, or asbuilt.h5 for the lens that was made (its process and wave front included).
        output: the PSF file to write, .h5 (which all other commands read), .tif, .mat or .fits; plots are written
            beside it as NAME_xz.png and so on.
        config: PSF.toml with depths_mm, angles_deg, angles_y_deg, window_um, samples, led_fwhm_nm, tolerance,
            polarisation, spectrum, own_cell, [[layers.front]] and [[layers.behind]]; without it 16 to 26 mm in steps of
            0.5 mm at 0, 10 and 20 degrees.
        tolerance: relative L2 error, in place of the one in the settings.
        report: also write NAME.html.
    """

    lens: tyro.conf.Positional[Path]
    output: Output = Path("psf.h5")
    config: Path | None = None
    tolerance: float | None = None
    report: bool = False


def run(options: Options) -> int:
    """Compute, write, draw; exit 1 where the error estimate stays above the tolerance."""
    settings = Settings() if options.config is None else config.load(options.config, Settings, empty=False)
    if options.tolerance is not None:
        settings = replace(settings, tolerance=options.tolerance)
    psf_export.check(options.output)
    target, view = options.output, settings.view
    pixels = len(view.depths_um) * len(view.angles_rad) * settings.samples**2
    ends = (*(f"_{name}.png" for name in CAPTIONS), ".html")
    with options.claim(target, beside=ends, room=transaction.ROOM + 4 * pixels) as draft:
        stack = _make(options, settings, draft.path)
    shape = f"{len(stack.angles_rad)} angles x {len(stack.depths_um)} depths x {len(stack.weights)} wavelengths"
    state = "" if stack.converged else f"; above the tolerance {stack.tolerance:g}: raise it or widen the window"
    text = f"{target}: {shape}, relative error {stack.error:.2g} ({stack.reason}){state}\n  {_budget(stack).text}"
    options.console.result(_summary(stack), text)
    return 0 if stack.converged else 1


def _make(options: Options, settings: Settings, path: Path) -> psf.PsfStack:
    """Compute, write, draw."""
    stack = _stack(options.lens, settings)
    psf_export.write(path, stack)
    pictures = psf_plots.pictures(stack)
    for name, image in pictures.items():
        write_bytes(path.with_name(f"{path.stem}_{name}.png"), image)
    if options.report:
        _report(path.with_suffix(".html"), stack, pictures)
    return stack


def _stack(path: Path, settings: Settings) -> psf.PsfStack:
    """PSFs of a lens file, or of another kind of file that the command line knows a source for."""
    kind, provenance = store.load(path).kind, Provenance(config.dumps(settings), {path.name: store.sha256(path)})
    if kind in SOURCES:
        for name in ("led_fwhm_nm", "spectrum", "layers", "own_cell"):
            if getattr(settings, name):
                raise ConfigError(
                    f"{path}: {name} is for a design; this {kind} file has the wavelength and layers that were fitted"
                )
        if settings.polarisation == "vector":
            raise ConfigError(f"{path}: polarisation = 'vector' is for a design; a {kind} file is one scalar")
        found: psf.PsfStack = importlib.import_module(SOURCES[kind]).stack(path, settings.view, settings.tolerance)
        return replace(found, provenance=provenance)
    made = lens.load(path)
    if settings.layers is not None:
        made = replace(made, layers=settings.layers)
    inputs = dict(provenance.inputs) | {file.name: store.sha256(file) for file in settings.spectrum if file.is_file()}
    return psf.from_lens(
        made,
        settings.view,
        tolerance=settings.tolerance,
        spectrum=_spectrum(made, settings),
        provenance=replace(provenance, inputs=inputs),
        polarisation=settings.polarisation,
        left_out=_own_cell(made, settings) if settings.own_cell else None,
    )


def _own_cell(made: lens.Lens, settings: Settings) -> psf.LeftOut:
    """Neighbours and angle of the lens's own pillars, at the largest aperture and angle of the view."""
    apertures = [psf.aperture(made, angle) for angle in settings.view.angles_rad]
    incidence = max(float(np.arctan(np.hypot(*np.tan(angle)))) for angle in settings.view.angles_rad)
    return design.left_out(made, aperture=max(apertures), incidence_rad=incidence)


def _spectrum(made: lens.Lens, settings: Settings) -> spectrum.Nodes | None:
    """Wavelengths of the diode, no more than the tolerance needs; None for one wavelength."""
    if settings.led_fwhm_nm == 0 and not settings.spectrum:
        return None
    near = settings.depths_mm[0] * 1e3
    path = spectrum.path_span(made.diameters.radius_um, made.sensor_distance_um, near)
    source: spectrum.Source | spectrum.Measured
    if settings.spectrum:
        source = spectrum.measured(settings.spectrum, within_um=made.proxy.wavelengths_um)
    else:
        source = spectrum.Source(made.wavelength_um * 1e3, settings.led_fwhm_nm)
    return spectrum.nodes(source, path_um=path, tolerance=settings.tolerance / 2)


def _summary(stack: psf.PsfStack) -> dict[str, object]:
    return {
        "error": stack.error,
        "budget": {name: None if math.isnan(v) else v for name, v in asdict(_budget(stack)).items()},
        "tolerance": stack.tolerance,
        "converged": stack.converged,
        "reason": stack.reason,
        "depths_um": stack.depths_um.tolist(),
        "angles_rad": stack.angles_rad.tolist(),
        "wavelengths_um": stack.wavelengths_um.tolist(),
    }


def _budget(stack: psf.PsfStack) -> psf.Budget:
    return stack.budget or psf.Budget(stack.error)


def _budget_table(stack: psf.PsfStack) -> Table:
    found = _budget(stack)
    rows = [[name, "not known" if math.isnan(v) else f"{v:.2g}"] for name, v in asdict(found).items()]
    rows += [["computed", f"{found.computed:.2g}"], ["of the device", f"{found.total:.2g}"]]
    return Table(
        ("cause", "relative L2"), rows, "The tolerance is about what is computed; outside is a share of light."
    )


def _report(path: Path, stack: psf.PsfStack, pictures: dict[str, bytes]) -> None:
    """One page with all pictures and the energies."""
    energy = np.asarray(stack.energy_um2)
    rows = [
        [f"{x:.3g}", f"{y:.3g}", float(e.min()), float(e.max())]
        for (x, y), e in zip(np.rad2deg(stack.angles_rad), energy, strict=True)
    ]
    table = Table(
        ("x / deg", "y / deg", "least", "most"), rows, "Light in the window for unit irradiance, um², over depth."
    )
    figures = [Figure(image, CAPTIONS[name], wide=True) for name, image in pictures.items()]
    write(
        path,
        "Point spread functions",
        [
            Section("Pictures", items=figures),
            Section("Error by cause", BUDGET_WORDS, [_budget_table(stack)]),
            Section("Energy", f"Method: {stack.reason}.", [table]),
        ],
        key_figures=[KeyFigure("relative error", f"{stack.error:.2g}", stack.converged)],
    )
