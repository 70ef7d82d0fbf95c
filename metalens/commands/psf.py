"""lens.h5 to psf.h5: PSF stack over depth, field angle and wavelength to a stated error, with plots beside it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from metalens import config, lens, propagate, psf, psf_export, psf_plots, spectrum, store
from metalens.commands import Common, Output
from metalens.errors import ConfigError
from metalens.report import Figure, KeyFigure, Section, Table, write
from metalens.store import Provenance, write_bytes

CAPTIONS = {
    "xz": "Slice through the PSF along depth, centre row of the window, each depth at its own full scale.",
    "montage": "PSFs over depth (across) and field angle (down); square root of intensity.",
    "mtf": "Modulation transfer along x (thick) and y (thin), and the share of the window's light inside a circle.",
    "information": "I(z) of Eq. 11 under two normalisations and three binnings; the normalisation decides the ranking.",
}


@dataclass(frozen=True, slots=True)
class Settings:
    """What is computed; kept in the file.

    depths_mm: nearest and farthest source, and the largest step between depths.
    angles_deg: field angles along x; angles_y_deg: along y, one for each or none for 0.
    window_um, samples: of the square window that follows the chief ray.
    led_fwhm_nm: width of the diode about the design wavelength; 0 for one wavelength.
    tolerance: relative L2 error of the PSFs.
    """

    depths_mm: tuple[float, float, float] = (16.0, 26.0, 0.5)
    angles_deg: tuple[float, ...] = (0.0, 10.0, 20.0)
    angles_y_deg: tuple[float, ...] = ()
    window_um: float = 144.0
    samples: int = 192
    led_fwhm_nm: float = 0.0
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        near, far, step = self.depths_mm
        if not (0 < near <= far < np.inf and step > 0):
            raise ConfigError(
                f"depths_mm = {self.depths_mm}: need nearest, farthest and step with 0 < nearest <= farthest"
            )
        if not self.angles_deg or (self.angles_y_deg and len(self.angles_y_deg) != len(self.angles_deg)):
            raise ConfigError(
                f"{len(self.angles_deg)} angles along x, {len(self.angles_y_deg)} along y: need one for each"
            )
        if not (0 < self.tolerance < 1 and self.led_fwhm_nm >= 0):
            raise ConfigError(
                f"tolerance = {self.tolerance}, led_fwhm_nm = {self.led_fwhm_nm}: need 0 < tolerance < 1, width >= 0"
            )

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
        lens: lens.h5.
        output: the PSF file to write, .h5 (which all other commands read), .tif or .mat; plots are written beside it as
            NAME_xz.png and so on.
        config: PSF.toml with depths_mm, angles_deg, angles_y_deg, window_um, samples, led_fwhm_nm, tolerance; without
            it 16 to 26 mm in steps of 0.5 mm at 0, 10 and 20 degrees.
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
    settings = Settings() if options.config is None else config.load(options.config, Settings)
    if options.tolerance is not None:
        settings = replace(settings, tolerance=options.tolerance)
    made = lens.load(options.lens)
    psf_export.check(options.output)
    target = options.claim(options.output)
    nodes = _spectrum(made, settings)
    provenance = Provenance(config.dumps(settings), {options.lens.name: store.sha256(options.lens)})
    stack = psf.from_lens(made, settings.view, tolerance=settings.tolerance, spectrum=nodes, provenance=provenance)
    psf_export.write(target, stack)
    pictures = psf_plots.pictures(stack)
    for name, image in pictures.items():
        write_bytes(target.with_name(f"{target.stem}_{name}.png"), image)
    if options.report:
        _report(target.with_suffix(".html"), stack, pictures)
    shape = f"{len(stack.angles_rad)} angles x {len(stack.depths_um)} depths x {len(stack.weights)} wavelengths"
    state = "" if stack.converged else f"; above the tolerance {stack.tolerance:g}: raise it or widen the window"
    text = f"{target}: {shape}, relative error {stack.error:.2g} ({stack.reason}){state}"
    options.console.result(_summary(stack), text)
    return 0 if stack.converged else 1


def _spectrum(made: lens.Lens, settings: Settings) -> spectrum.Nodes | None:
    """Wavelengths of the diode, no more than the tolerance needs; None for one wavelength."""
    if settings.led_fwhm_nm == 0:
        return None
    near = settings.depths_mm[0] * 1e3
    path = spectrum.path_span(made.diameters.radius_um, made.sensor_distance_um, near)
    source = spectrum.Source(made.wavelength_um * 1e3, settings.led_fwhm_nm)
    return spectrum.nodes(source, path_um=path, tolerance=max(settings.tolerance, 1e-4))


def _summary(stack: psf.PsfStack) -> dict[str, object]:
    return {
        "error": stack.error,
        "tolerance": stack.tolerance,
        "converged": stack.converged,
        "reason": stack.reason,
        "depths_um": stack.depths_um.tolist(),
        "angles_rad": stack.angles_rad.tolist(),
        "wavelengths_um": stack.wavelengths_um.tolist(),
    }


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
        [Section("Pictures", items=figures), Section("Energy", f"Method: {stack.reason}.", [table])],
        key_figures=[KeyFigure("relative error", f"{stack.error:.2g}", stack.converged)],
    )
