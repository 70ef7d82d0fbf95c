"""Settings of ``metalens psf``: depths, angles, window, source and spectrum, from a
file or from the command line.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from metalens import design, lens, propagate, psf
from metalens.core import config
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.lens import reach
from metalens.optics import Layers
from metalens.psf import spectrum as spectra

MOST_SAMPLES, MOST_DEPTHS = 16_384, 100_000
AIRY = 28.0  # width of a window in units of wavelength / NA


@dataclass(frozen=True, slots=True)
class PsfSettings:
    """What is computed; kept in the file.

    depths_mm: nearest and farthest source, and the largest step between depths; left
    out: infinity for a lens for collimated light, else 21 depths, its focus among them,
    over which the rim
        of this lens goes from 1.75 waves out of focus on one side to as many on the
        other.
    sources_mm: in place of depths_mm, the depth of every source; inf for a plane wave.
    angles_deg: field angles along x, arctangents of the light's slope dx/dz in air: the
    image of a positive angle lies
        at +x; left out: 0 and the half field over which a hyperbolic lens of this focus
        is diffraction-limited (Strehl ratio 0.8), or the angles that a lens was
        measured at. angles_y_deg: along y (down), one for each or none for 0.
    window_um, samples: full width along x of the window that follows the chief ray, and
    samples along it; without a
        width 28 wavelength / NA, or 8 blur radii at the worst depth where that is more.
    height_um: its height, of samples as far apart; 0 for a square window.
    offset_um: [x, y] from the chief ray to the window's middle.
    source_um: full size of an incoherent source: diameter of a disc, side of a square,
    full width at half maximum of a
        gaussian; 0 for a point. source_deg: the same as an angle, for sources at
        infinity too.
    source_shape: disc, square or gaussian.
    led_fwhm_nm: width of the diode about the design wavelength; 0 for one wavelength.
    spectrum: in place of led_fwhm_nm, CSV files of wavelength in nm and value whose
    product is the spectrum (LED,
        filter, sensor).
    wavelengths_nm: in place of both, wavelengths in vacuum whose intensities add.
    weights: of each; none for equal.
    tolerance: relative L2 error of the PSFs.
    polarisation: ``scalar`` (the flux through the sensor's plane, to fourth order in
    NA), ``flux`` (that of both
        polarisations, which a pixel counts), ``vector`` (Ex, Ey, Ez of both, squares
        added), or ``auto``: the scalar
        where its distance to the flux is below the tolerance, else the flux.
    layers: films in front and behind in place of the lens file's, as in DESIGN.toml.
    light: polarisation along x or y, for a lens of pillars of two sizes; both: the mean
    of the two, where they are
        focused from and to the same distances (any light, for other lenses).
    own_cell: solve rows of unlike pillars and tilted light for the lens's own cell
    (seconds to minutes): the PSFs then
        hold the factor of those neighbours, the error budget what is left. A lens of
        ``design --own-cell`` holds its
        rows. Without either, pillars are taken one by one, and those terms are rough,
        of the default cell.
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
    spectrum: tuple[Path, ...] = ()
    wavelengths_nm: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    tolerance: float = 1e-4
    polarisation: psf.Polarisation = "scalar"
    layers: Layers | None = None
    own_cell: bool = False
    light: Literal["both", "x", "y"] = "both"

    def __post_init__(self) -> None:
        self._check_sources()
        self._check_window()
        self._check_light()

    def _check_sources(self) -> None:
        """Depths, angles and the size of a source."""
        near, far, step = self.depths_mm or (1.0, 1.0, 1.0)
        if not (0 < near <= far < np.inf and step > 0):
            raise ConfigError(
                f"depths_mm = {self.depths_mm}: need nearest, farthest and step with 0 < nearest <= farthest"
            )
        if not all(depth > 0 for depth in self.sources_mm):
            raise ConfigError(
                f"sources_mm = {self.sources_mm}: need depths above 0, inf for a plane wave"
            )
        if (far - near) / step > MOST_DEPTHS or max(
            map(abs, (*(self.angles_deg or ()), *self.angles_y_deg, 0.0))
        ) >= 90:
            raise ConfigError(
                f"depths_mm = {self.depths_mm}, angles_deg = {self.angles_deg}: need at most {MOST_DEPTHS} depths, "
                "angles within 90 degrees"
            )
        along_x = len(self.angles_deg or ())
        if self.angles_deg == () or len(self.angles_y_deg) not in (0, along_x):
            raise ConfigError(
                f"{along_x} angles along x, {len(self.angles_y_deg)} along y: need one for each"
            )
        if (self.source_um and self.source_deg) or not (
            self.source_um >= 0 and 0 <= self.source_deg < 90
        ):
            raise ConfigError(
                f"source_um = {self.source_um}, source_deg = {self.source_deg}: need one of both, or 0 for a point"
            )
        if self.source_um and math.inf in self.sources_mm:
            raise ConfigError(
                f"source_um = {self.source_um}, sources_mm = {self.sources_mm}: a source at infinity has no size in "
                "um; give source_deg"
            )

    def _check_window(self) -> None:
        width = 1.0 if self.window_um is None else self.window_um
        if not (2 <= self.samples <= MOST_SAMPLES and 0 < width < np.inf):
            raise ConfigError(
                f"samples = {self.samples}, window_um = {self.window_um}: need 2 to {MOST_SAMPLES} samples, window > 0"
            )
        if self.window_um is None:
            if self.height_um:
                raise ConfigError(f"height_um = {self.height_um}: need window_um too")
            return
        down = self.samples_y
        if not (self.height_um >= 0 and 1 <= down <= MOST_SAMPLES):
            raise ConfigError(
                f"height_um = {self.height_um}: need 0, or a height of 1 to {MOST_SAMPLES} samples"
            )
        step = self.window_um / self.samples
        if self.height_um and abs(self.height_um / step - down) > 1e-6 * down:
            raise ConfigError(
                f"height_um = {self.height_um}: need a whole number of samples of window_um / samples = {step:g} "
                f"um, as {down * step:g}"
            )

    def _check_light(self) -> None:
        """Tolerance and spectrum."""
        if not (0 < self.tolerance < 1 and self.led_fwhm_nm >= 0):
            raise ConfigError(
                f"tolerance = {self.tolerance}, led_fwhm_nm = {self.led_fwhm_nm}: need 0 < tolerance < 1, width >= 0"
            )
        if bool(self.spectrum) + bool(self.led_fwhm_nm) + bool(self.wavelengths_nm) > 1:
            raise ConfigError(
                "two of spectrum, led_fwhm_nm and wavelengths_nm are given: each is the whole spectrum; give one"
            )
        if not all(0 < nm < np.inf for nm in self.wavelengths_nm):
            raise ConfigError(
                f"wavelengths_nm = {self.wavelengths_nm}: need wavelengths above 0"
            )
        good = len(self.weights) == len(self.wavelengths_nm) and sum(self.weights) > 0
        if self.weights and not (good and min(self.weights) >= 0):
            raise ConfigError(
                f"weights = {self.weights} for wavelengths_nm = {self.wavelengths_nm}: need one of 0 or more for each"
            )

    @property
    def samples_y(self) -> int:
        """Samples along y."""
        return (
            round(self.height_um / self.width_um * self.samples)
            if self.height_um
            else self.samples
        )

    @property
    def width_um(self) -> float:
        """Of the window.

        Raises:
            ConfigError: it is that of a lens, and no lens was named (:meth:`about`).
        """
        if self.window_um is None:
            raise ConfigError("window_um is left to the lens, and there is none")
        return self.window_um

    def about(self, made: lens.Lens, angles_rad: Array | None = None) -> "PsfSettings":
        """These with depths, angles and window of this lens where they were left out.

        angles_rad: (n, 2) angles that it was measured at, in place of its field's.
        """
        filled = self
        if self.angles_deg is None:
            x, y = _angles_deg(made, angles_rad)
            filled = replace(filled, angles_deg=x, angles_y_deg=y)
        collimated = math.isinf(made.source_distance_um)
        if not self.sources_mm and self.depths_mm is None:
            if collimated:
                filled = replace(filled, sources_mm=(math.inf,))
            else:
                near, far = (depth * 1e-3 for depth in reach.depth_range_um(made))
                depths = np.linspace(near, far, 21)
                focus_mm = made.source_distance_um * 1e-3
                if near < focus_mm < far:  # one of them lies in focus
                    depths[np.abs(1 / depths - 1 / focus_mm).argmin()] = focus_mm
                filled = replace(
                    filled,
                    depths_mm=(near, far, (far - near) / 20),
                    sources_mm=tuple(depths.tolist()),
                )
        if self.window_um is not None:
            return filled
        ends = self.sources_mm or (filled.depths_mm or filled.sources_mm)[:2]
        ends_um = tuple(z * 1e3 for z in ends)
        return replace(filled, window_um=reach.window_um(made, ends_um, airy=AIRY))

    @property
    def view(self) -> "psf.View":
        """Depths, angles, window and source in um and rad.

        Raises:
            ConfigError: depths or window are those of a lens, and no lens was named
                (:meth:`about`).
        """
        if self.sources_mm:
            depths = np.array(self.sources_mm) * 1e3
        elif self.depths_mm is None:
            raise ConfigError("depths_mm are left to the lens, and there is none")
        else:
            near, far, step = self.depths_mm
            depths = (
                np.linspace(near, far, int(np.ceil((far - near) / step - 1e-9)) + 1)
                * 1e3
            )
        if self.angles_deg is None:
            raise ConfigError("angles_deg are left to the lens, and there is none")
        along_y = self.angles_y_deg or (0.0,) * len(self.angles_deg)
        pairs = [
            tuple(np.deg2rad([x, y]).tolist())
            for x, y in zip(self.angles_deg, along_y, strict=True)
        ]
        angles = tuple(propagate.to_angle_pair(pair) for pair in pairs)
        window = self.width_um, self.width_um / self.samples * self.samples_y
        return psf.View(
            tuple(depths.tolist()),
            angles,
            window,
            (self.samples, self.samples_y),
            self.offset_um,
            self.source,
        )

    @property
    def source(self) -> "psf.Extent | None":
        """Size and shape of the source, None for a point."""
        if not (self.source_um or self.source_deg):
            return None
        return psf.Extent(
            self.source_shape,
            self.source_um,
            2 * math.tan(math.radians(self.source_deg) / 2),
        )

    def spectrum_of(
        self, made: lens.Lens
    ) -> spectra.SpectralNodes | spectra.Source | spectra.MeasuredSpectrum | None:
        """Wavelengths with weights, a diode or measured curves; None for the design
        wavelength alone.
        """
        if self.wavelengths_nm:
            share = np.array(self.weights or [1.0] * len(self.wavelengths_nm))
            return spectra.SpectralNodes(
                np.array(self.wavelengths_nm) * 1e-3, share / share.sum(), 0.0
            )
        if self.spectrum:
            return spectra.read_measured_spectrum(
                self.spectrum, within_um=made.proxy.wavelengths_um
            )
        return (
            spectra.Source(made.wavelength_um * 1e3, self.led_fwhm_nm)
            if self.led_fwhm_nm
            else None
        )


def _angles_deg(
    made: lens.Lens, angles_rad: Array | None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(x, y) field angles that a lens was measured at, or of its field."""
    if angles_rad is not None and len(angles_rad):
        x, y = np.rad2deg(np.unique(angles_rad, axis=0)).T
        return tuple(x.tolist()), tuple(y.tolist())
    distances = made.sensor_distance_um, made.source_distance_um
    focus = design.Focus(made.wavelength_um, *distances, made.layers)
    radius_um = made.diameters.radius_um + made.diameters.pitch_um / 2
    half = math.degrees(design.field_angle(focus, radius_um))
    return (0.0, float(f"{half:.2g}")), (0.0, 0.0)


def read_psf_settings(path: Path | None, over: dict[str, Any]) -> PsfSettings:
    """Settings of a file (None: those of the record) with what was given on the command
    line in their place.

    Args:
        path: file to read or write.

    Raises:
        ConfigError: as :func:`metalens.core.config.load`.
    """
    table = {} if path is None else config.read(path, PsfSettings, empty=False)
    given = {name: value for name, value in over.items() if value is not None}
    where = " and ".join(
        [
            *([str(path)] if path is not None else []),
            *(["the command line"] if given else []),
        ]
    )
    return config.from_table(table | given, PsfSettings, where=where or "metalens psf")
