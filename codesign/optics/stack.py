"""The optics that training moves: a focus and a few dozen orthonormal polynomials of
phase, and their PSFs.
"""
# ruff: noqa: RUF009  (records of settings are frozen)

import contextlib
import functools
import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from codesign.batches import parallel
from codesign.optics.lens_errors import (
    DrawnLensErrors,
    LensErrors,
    PhaseRates,
    phase_rates,
    pillar_proxy,
    variance_rad2,
    wave_front_rad,
)
from codesign.settings import LARGEST, LEAST, check_ranges
from metalens import library
from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, LensError, TrainingError
from metalens.core.store import Provenance
from metalens.design import Focus, PhaseOf, make, profiles
from metalens.image import (
    Field,
    Grid,
    Imager,
    Optics,
    PillarWave,
    Pupil,
    PupilView,
    SmoothWave,
    Wave,
    aperture_light,
    cell_um,
    coordinates,
    radius,
    uniform_imager,
    view_pupil,
)
from metalens.lens import DiameterMap, Lens
from metalens.library import DEFAULT_CELL, Proxy
from metalens.optics import Layers
from metalens.optics.paths import sensor_path, source_path
from metalens.psf import Source

Family = Literal["free", "radial"]


@dataclass(frozen=True, slots=True)
class OpticsConfig:
    """The lens in front of the sensor, and how finely training sees it.

    aperture_mm, sensor_distance_mm, wavelength_nm: of the lens.
    focus_mm: source distance that the hyperbolic part images onto the sensor.
    parameters: what training moves: "polynomials" of phase, or the "diameters" of all
    pillars through the proxy of their cell (paper Eq. 2), phase and transmission over
    the whole spectrum; of the true image, and for lenses of some 0.1 mm.
    polynomials: orthonormal terms of order 2 and above that training moves; 0 for a
    fixed lens. family: of these terms:
        "free" form, or "radial" ones alone (one of them is a focus that moves).
    zones: rings of a double helix added to the hyperbolic phase; 0 for none.
    depths_mm: (least, largest) depth of the PSF stack. depth_count: its samples, at
    equal steps of 1/z.
    sample_um: of the PSFs; the image is formed on this grid before the pixels integrate
    it.
    window_samples: of the PSFs.
    tolerance: of the low-rank PSF basis.
    spread: of the lenses that are made.
    angle_deg: field angle, towards +x, of the middle of the image; of all of it where
    ``image`` is "uniform".
    image: "true", every part of the image through the PSFs of its own field angle and
    of the whole spectrum; or
        "uniform", one PSF a depth, of one chief ray and one wavelength: much faster,
        wrong by what a run's report says.
    fwhm_nm: spectral width of the light source about ``wavelength_nm``, 0 for one
    wavelength. filter_nm: width of a
        band-pass filter before the sensor, 0 for none; the light that it stops is lost.
        Of the true image alone.
    image_tolerance: of the true image, relative L2 of a texture.
    layers: films around the lens and an aperture stop, as in DESIGN.toml, for the true
    image alone.
    cell: unit cell that the lens is made of, as in CELL.toml: its pillars are those of
    the lens file, and what a process does to them is what training draws.
    """

    aperture_mm: float = 1.0
    sensor_distance_mm: float = 2.0
    wavelength_nm: float = 850.0
    focus_mm: float = 20.0
    polynomials: int = 35
    zones: int = 0
    depths_mm: tuple[float, float] = (12.0, 50.0)
    depth_count: int = 24
    sample_um: float = 9.0
    window_samples: int = 33
    tolerance: float = field(default=3e-3, metadata={"above": 0})
    spread: LensErrors = LensErrors()
    angle_deg: float = 0.0
    image: Literal["true", "uniform"] = "true"
    fwhm_nm: float = 0.0
    filter_nm: float = 0.0
    image_tolerance: float = 0.015
    family: Family = "free"
    layers: Layers | None = None
    cell: Cell = DEFAULT_CELL
    parameters: Literal["polynomials", "diameters"] = "polynomials"

    def __post_init__(self) -> None:
        low, high = self.depths_mm
        if not (0 < low < high and self.depth_count >= 2):
            raise ConfigError(
                f"depths_mm = {self.depths_mm}, depth_count = {self.depth_count}: need 0 < least < largest and a count "
                "of 2 or more"
            )
        lengths = (
            "aperture_mm", "sensor_distance_mm", "wavelength_nm", "focus_mm", "sample_um",
        )  # fmt: skip
        check_ranges(self, **dict.fromkeys(lengths, (LEAST, LARGEST)))
        counts = ("zones", "polynomials", "fwhm_nm", "filter_nm")
        check_ranges(self, **dict.fromkeys(counts, (0, LARGEST)))
        check_ranges(self, angle_deg=(-40, 40), image_tolerance=(LEAST, 1))
        if self.image == "uniform" and (
            self.fwhm_nm or self.filter_nm or self.layers is not None
        ):
            raise ConfigError(
                f"fwhm_nm = {self.fwhm_nm}, filter_nm = {self.filter_nm}, layers = {self.layers} with image = "
                "'uniform', an image of one wavelength in air: need image = 'true', or widths of 0 and no layers"
            )
        if self.parameters == "diameters" and (
            self.image == "uniform" or any(self.spread.deviations)
        ):
            raise ConfigError(
                f"parameters = 'diameters' with image = '{self.image}' and spread "
                f"{self.spread.deviations}: need image = 'true' and no spread"
            )
        if self.filter_nm and not self.fwhm_nm:
            raise ConfigError(
                f"filter_nm = {self.filter_nm} before a source of one wavelength: give fwhm_nm too"
            )
        if self.window_samples < 3 or self.window_samples % 2 == 0:
            raise ConfigError(
                f"window_samples = {self.window_samples}: need an odd number of 3 or more"
            )
        values = (
            self.depth_count
            * (self.pupil.nodes + self.pupil.period_um / (2 * self.sample_um)) ** 2
        )
        if values > 5e8:  # 4 GB
            raise ConfigError(
                f"PSFs by transforms of {values:.1e} values, need 5e8 or less; check the units in {self}"
            )

    @property
    def light(self) -> Source | None:
        """The light that reaches the sensor; None for one wavelength.

        A Gaussian line of width a behind a Gaussian filter of width b has the width
        a b / √(a² + b²).
        """
        width = self.fwhm_nm * self.passed
        return Source(self.wavelength_nm, width) if width else None

    @property
    def passed(self) -> float:
        """Fraction b / √(a² + b²) of the source's light that the filter passes.

        Both are Gaussian about the same wavelength, of widths a and b.
        """
        if not self.filter_nm:
            return 1.0
        return self.filter_nm / math.hypot(self.fwhm_nm, self.filter_nm)

    @property
    def pupil(self) -> Pupil:
        """Aperture with the number of nodes that the window of the PSFs needs, 64 or
        more.
        """
        rough = Pupil(
            self.aperture_mm * 500,
            self.sensor_distance_mm * 1e3,
            self.wavelength_nm * 1e-3,
        )
        width = self.window_samples * self.sample_um * 1.05
        nodes = max(64, math.ceil(width * 2 * rough.edge / rough.wavelength_um / 2) * 2)
        return replace(rough, nodes=nodes)

    @property
    def depths_um(self) -> Tensor:
        """(depths,) ascending, at equal steps of 1/z, float64."""
        low, high = self.depths_mm
        return 1e3 / torch.linspace(
            1 / low, 1 / high, self.depth_count, dtype=torch.float64
        )

    @property
    def proxy(self) -> Proxy:
        """Phase and transmission of the cell's pillars over their diameter."""
        return pillar_proxy(self.cell, self.focus.wavelength_um)

    @property
    def phase_rates(self) -> PhaseRates:
        """What a process does to the phases of this cell's pillars."""
        return phase_rates(self.cell, self.focus.wavelength_um)

    @property
    def focus(self) -> Focus:
        """What the hyperbolic part images onto the sensor."""
        distances = self.sensor_distance_mm * 1e3, self.focus_mm * 1e3
        return Focus(self.wavelength_nm * 1e-3, *distances, self.layers or Layers())


@dataclass(frozen=True, eq=False, slots=True)
class PixelPsfStack:
    """PSFs over depth on the grid of the image.

    intensity: (depths, h, w) fraction of the light per sample. depths_um: (depths,).
    plane: of a fabricated lens, what forms its true image; None of a lens whose PSFs
    are known on axis alone.
    """

    intensity: Tensor
    depths_um: Tensor = field(repr=False)
    plane: Optics | None = field(default=None, repr=False)


def lens_psf_stack(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    *,
    error: DrawnLensErrors | None = None,
    shared: bool = False,
) -> PixelPsfStack:
    """PSFs over depth of the lens of these coefficients, on samples of the image.

    Each is the fraction of the light on a square sample, low-passed to the band of the
    sample grid. So it does not depend on where a source falls on the grid.
    Differentiable in the coefficients; see :func:`sampled_light`.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) in rad of root-mean-square phase over the
            aperture, or (pillars,).
        error: one draw of ``settings.spread``; adds its wave front and scattered light.
        shared: every process of a training computes its part of the depths, and all
            get the whole stack; all of them must call.

    Raises:
        TrainingError: a coefficient is not finite.
    """
    if not bool(torch.isfinite(coefficients_rad).all()):
        raise TrainingError(
            "the optics left the finite numbers: lower the learning rate of the optics"
        )
    count = settings.depth_count
    rows = parallel.shared_rows(count) if shared else torch.arange(count)
    wave = lens_wave(settings, coefficients_rad, error)
    light = psfs_over_depth(settings, wave, settings.pupil, rows)
    if shared:
        light = parallel.gather_rows(light, rows, count)
    if error is not None:
        variance = variance_rad2(error.state(), settings.phase_rates)
        light = scatter_loss(settings, light, variance)
    return PixelPsfStack(light, settings.depths_um)


def psfs_over_depth(
    settings: OpticsConfig, wave: Wave, pupil: Pupil, rows: Tensor
) -> Tensor:
    """(rows, h, w) PSFs of any lens plane with the focus of the settings.

    The wave on the pupil is t exp(i (focus + k (sensor path + source path))).

    Args:
        settings: of the lens and its image.
        wave: lens plane, of which the transmission t relative to the focus is taken.
        pupil: sampled aperture; its sensor distance may differ from the design's.
        rows: numbers of the depths.
    """
    view, waves = _carriers(settings, pupil)
    angle_rad = math.radians(settings.angle_deg)
    factor = wave.factor(view.x_um, view.y_um, pupil.wavelength_um, angle_rad)
    if factor is not None:
        waves = waves * factor.to(waves)
    grid = pupil, settings.sample_um, settings.window_samples
    # one by one, so that a depth's bits do not depend on who computes the others
    return torch.stack([sampled_light(waves[row], *grid) for row in rows])


def lens_wave(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    error: DrawnLensErrors | None = None,
) -> SmoothWave | PillarWave:
    """Lens plane of these coefficients for :func:`metalens.image.imager`.

    Differentiable in the coefficients: a smooth phase, or pillars by their diameters.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        error: assembly and process error of one lens; None for none.
    """
    if settings.parameters == "diameters":
        return pillar_wave(settings, coefficients_rad)
    added = None
    if settings.polynomials or settings.zones or error is not None:
        added = functools.partial(phase_at, settings, coefficients_rad, error=error)
    return SmoothWave(settings.focus, settings.aperture_mm * 500, added)


def pillar_phase(settings: OpticsConfig, coefficients_rad: Tensor) -> PhaseOf:
    """The trained phase, rad, as a function of pillar positions in um.

    The sum of the hyperbolic focus and :func:`phase_at`, for
    :func:`metalens.design.make`; computed in blocks of 64 rows.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
    """

    def phase(x_um: Array, y_um: Array) -> Array:
        x, y = (torch.from_numpy(np.asarray(a, float)) for a in (x_um, y_um[:, None]))
        blocks = [
            phase_at(settings, coefficients_rad, x, rows) for rows in torch.split(y, 64)
        ]
        focus = profiles.hyperbolic_phase(x_um, y_um[:, None], settings.focus)
        return np.asarray(focus + torch.cat(blocks).numpy())

    return phase


def trained_lens(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    provenance: Provenance | None = None,
) -> Lens:
    """The lens file of trained coefficients: pillars of a phase, or given diameters.

    For polynomials the pillars are chosen for their phase from a library over the light
    of training. The library spans 1.25 line widths to either side (0.3 % of a Gaussian
    lies outside). Where pillars then cover less than a turn of phase, it spans half of
    that, and at last the central wavelength alone.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) of the phase, rad, or (pillars,).
        provenance: of the file.
    """
    if settings.parameters == "diameters":
        start = starting_lens(settings)
        sizes = pillar_diameters(settings, coefficients_rad).numpy().astype(np.float32)
        return replace(
            start,
            diameters=DiameterMap(sizes, start.diameters.pitch_um),
            provenance=provenance or Provenance(),
        )
    middle_um = settings.focus.wavelength_um
    light = settings.light
    width_um = 0.0 if light is None else light.fwhm_nm * 1e-3

    def lens_of_band(half_um: float) -> Lens:
        offsets_um = np.linspace(-half_um, half_um, 5 if half_um else 1)
        wavelengths_um = tuple((offsets_um + middle_um).tolist())
        cells = library.sweep(settings.cell, wavelengths_um=wavelengths_um)
        lens, _ = make(
            pillar_phase(settings, coefficients_rad),
            settings.focus,
            aperture_um=settings.aperture_mm * 1e3,
            cell=cells.cell,
            proxy=library.proxy_of(cells),
            profile="codesign",
            provenance=provenance,
        )
        return lens

    for half_um in (1.25 * width_um, 0.625 * width_um) if width_um else ():
        with contextlib.suppress(LensError):
            return lens_of_band(half_um)
    return lens_of_band(0.0)


@functools.lru_cache(maxsize=2)
def starting_lens(settings: OpticsConfig) -> Lens:
    """The lens that training of diameters begins with: of the focus and its rings.

    Args:
        settings: of the lens and its image.
    """
    plain = replace(settings, parameters="polynomials", polynomials=0)
    return trained_lens(plain, torch.zeros(0, dtype=torch.float64))


def count_parameters(settings: OpticsConfig) -> int:
    """Coefficients of a lens: polynomials, or pillars.

    Args:
        settings: of the lens and its image.
    """
    if settings.parameters == "polynomials":
        return settings.polynomials
    return int(np.count_nonzero(starting_lens(settings).diameters.diameter_um))


def pillar_diameters(settings: OpticsConfig, coefficients_rad: Tensor) -> Tensor:
    """(y, x) diameter of every pillar in um, 0 where there is none; differentiable.

    A coefficient of 1 moves a pillar by 1 rad of the proxy's mean slope. Diameters are
    clipped to the proxy's domain and moved to the nearest edge of its resonances; the
    gradient is that without the clipping.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (pillars,) change of each from :func:`starting_lens`.
    """
    lens = starting_lens(settings)
    start = torch.from_numpy(lens.diameters.diameter_um)
    domain_um = lens.proxy.domain_um
    low, high = domain_um
    ends = lens.proxy.phase_rad(np.array(domain_um), lens.wavelength_um)
    um_per_rad = (high - low) / float(ends[1] - ends[0])
    diameter = start[start > 0].double() + um_per_rad * coefficients_rad.double()
    clipped = diameter.detach().clamp(low, high)
    for first, last in lens.proxy.gaps_um:
        edge = torch.where(clipped - first < last - clipped, first, last)
        clipped = torch.where((first < clipped) & (clipped < last), edge, clipped)
    # value of the clipped diameter, gradient of the diameter itself
    clipped = clipped + diameter - diameter.detach()
    return torch.zeros_like(start, dtype=torch.float64).masked_scatter(
        start > 0, clipped
    )


def pillar_wave(settings: OpticsConfig, coefficients_rad: Tensor) -> PillarWave:
    """Lens plane of these diameters, phase and transmission by the proxy;
    differentiable.

    Args:
        settings: of the lens and its image. coefficients_rad: (pillars,).
    """
    lens = starting_lens(settings)
    window_um = settings.window_samples * settings.sample_um
    spacing_um = cell_um(
        lens.layers, lens.wavelength_um, window_um, lens.sensor_distance_um
    )
    diameter_um = pillar_diameters(settings, coefficients_rad).float()
    return PillarWave(lens, diameter_um=diameter_um, cell_um=spacing_um)


def lens_settings(lens: Lens, fwhm_nm: float) -> OpticsConfig:
    """Image settings of a lens file without a run: pixels of 18 um, an error of 3 %.

    Args:
        lens: whose cell, films, distances and aperture they are.
        fwhm_nm: spectral width of the light.
    """
    return OpticsConfig(
        aperture_mm=2e-3 * lens.diameters.radius_um,
        sensor_distance_mm=1e-3 * lens.sensor_distance_um,
        wavelength_nm=1e3 * lens.wavelength_um,
        focus_mm=min(1e-3 * lens.source_distance_um, LARGEST),
        polynomials=0,
        sample_um=18.0,
        window_samples=17,
        layers=lens.layers,
        fwhm_nm=fwhm_nm,
        image_tolerance=0.03,
        cell=lens.cell,
    )


def stack_imager(
    settings: OpticsConfig, stack: PixelPsfStack, frame: int, *, margin: int
) -> Imager:
    """Shift-invariant imager of square frames of ``frame`` samples, margin included.

    Args:
        settings: of the lens and its image. stack: PSFs over depth.
    """
    return uniform_imager(
        stack.intensity,
        stack.depths_um,
        grid_of(settings, frame, margin),
        tolerance=settings.tolerance,
    )


def grid_of(settings: OpticsConfig, frame: int, margin: int) -> Grid:
    """Square frames of ``frame`` samples, margin included.

    Args:
        settings: of the lens and its image.
    """
    side = frame - 2 * margin
    depths = settings.depths_mm[0] * 1e3, settings.depths_mm[1] * 1e3
    return Grid(
        (side, side), settings.sample_um, depths, margin, settings.window_samples
    )


@functools.lru_cache(maxsize=8)
def _orthonormal_mix(pupil: Pupil, count: int, family: Family) -> Tensor:
    """(count, count) matrix to orthonormal phase terms; row n gives term n as a sum of
    the plain terms.

    The terms have unit root mean square over the aperture, by a QR decomposition of the
    plain ones.
    """
    x, y = (c / pupil.radius_um for c in coordinates(pupil))
    raw = torch.stack(phase_terms(x, y, count, family))
    samples = raw[:, radius(pupil) <= pupil.radius_um]
    _, upper = torch.linalg.qr(samples.T)
    mix: Tensor = torch.linalg.inv(upper).T * math.sqrt(samples.shape[1])
    return mix


@functools.lru_cache(maxsize=8)
def _carriers(settings: OpticsConfig, pupil: Pupil) -> tuple[PupilView, Tensor]:
    """The pupil from where the chief ray meets the sensor, and (depths, nodes,
    nodes) complex64 wave of every source behind the hyperbolic lens and its stop.
    """
    field = Field(math.radians(settings.angle_deg))
    tangents, distance_um = field.tangents, pupil.sensor_distance_um
    view = view_pupil(pupil, field, settings.focus_mm * 1e3)
    place_um = view.x_um, view.y_um
    focus = SmoothWave(replace(settings.focus, layers=Layers()), pupil.radius_um)
    centre_um = tangents[0] * distance_um, tangents[1] * distance_um
    path_um = sensor_path(*place_um, centre_um, distance_um)
    depths_um = settings.depths_um.tolist()
    paths_um = path_um + torch.stack(
        [source_path(*place_um, tangents, 1 / z) for z in depths_um]
    )
    k = 2 * math.pi / pupil.wavelength_um
    phase = torch.remainder(focus.carrier_rad(*place_um) + k * paths_um, 2 * math.pi)
    light = torch.polar(view.weight, phase)
    if settings.layers is not None and settings.layers.stop is not None:
        nodes_um = view.x_um.numpy(), view.y_um.numpy()
        grid = pupil.wavelength_um, nodes_um, pupil.step_um
        shadows = [settings.layers.shadow(tangents, z, *grid) for z in depths_um]
        light = light * torch.from_numpy(np.stack(shadows))
    return view, light.to(torch.complex64)


def sampled_light(wave: Tensor, pupil: Pupil, sample_um: float, samples: int) -> Tensor:
    """(..., samples, samples) fraction of the aperture's light on each square sample.

    Low-passed to the band of the sample grid. The transfer function at low frequencies
    is the autocorrelation of the pupil wave, from one zero-padded transform that leaves
    them free of wrap-around; its inverse transform is evaluated at the samples.

    Args:
        wave: (..., nodes, nodes) complex64 on the nodes of the pupil.
        pupil: aperture and its nodes. sample_um: side of a sample. samples: along a
            side.
    """
    to_rows, to_columns, size = _sample_rows(pupil, sample_um, samples)
    field = torch.fft.fft2(wave, s=(size, size))
    transfer = torch.fft.rfft2(field.real**2 + field.imag**2)
    low = len(to_columns)
    band = torch.cat([transfer[..., :low, :low], transfer[..., 1 - low :, :low]], -2)
    light: Tensor = (to_rows @ (band @ to_columns)).real
    return light


@functools.lru_cache(maxsize=8)
def _sample_rows(
    pupil: Pupil, sample_um: float, samples: int
) -> tuple[Tensor, Tensor, int]:
    """Matrices from the transfer function to the light on each sample, and the padded
    size.

    Returns:
        rows (samples, all frequencies) along y; columns (frequencies >= 0, samples)
        along x; nodes of the padded transform. Each frequency carries exp(2 pi i f p)
        at sample positions p, times the sinc of a square sample.
    """
    edge = pupil.period_um / (2 * sample_um)  # harmonics that the samples can show
    number = torch.arange(
        min(math.floor(edge + 0.5), pupil.nodes) + 1, dtype=torch.float64
    )
    # the last harmonic has a partial weight, continuous in the period
    weight = (edge - number + 0.5).clamp(0, 1)
    size = scipy.fft.next_fast_len(pupil.nodes + len(weight))
    harmonic = number / pupil.period_um
    position = torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2
    positive = torch.exp(2j * math.pi * sample_um * position[:, None] * harmonic) * (
        weight * torch.sinc(harmonic * sample_um)
    )
    rows = torch.cat([positive, positive[:, 1:].flip(1).conj()], 1)
    # the other half of the frequencies is its conjugate
    columns = positive * torch.where(harmonic == 0, 1.0, 2.0)
    total = aperture_light(pupil, samples * sample_um) * size**2
    scale = (sample_um / pupil.period_um) ** 2 / total
    return (
        (rows * scale).to(torch.complex64),
        columns.mT.contiguous().to(torch.complex64),
        size,
    )


def phase_at(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    x_um: Tensor,
    y_um: Tensor,
    *,
    error: DrawnLensErrors | None = None,
) -> Tensor:
    """Phase added to the hyperbolic focus at any points of the lens, rad, float64.

    Differentiable in the coefficients.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        x_um: x on the lens. y_um: y on the lens.
        error: assembly and process error of one lens; None for none.
    """
    x, y = (place_um / (settings.aperture_mm * 500) for place_um in (x_um, y_um))
    total = double_helix_phase(x, y, settings.zones)
    if settings.polynomials:
        kind = settings.polynomials, settings.family
        weights = _orthonormal_mix(settings.pupil, *kind).mT @ coefficients_rad.double()
        terms = torch.stack(phase_terms(x, y, *kind))
        total = total + torch.einsum("n,nyx->yx", weights.to(terms.device), terms)
    return total if error is None else total + _wave_front(settings, error, x, y)


def _wave_front(
    settings: OpticsConfig, error: DrawnLensErrors, x: Tensor, y: Tensor
) -> Tensor:
    """Phase of one fabricated lens minus that of its design, rad.

    Defocus -k dz (R / s)² rho² / 2 by an error dz of the sensor distance s, coma and
    astigmatism in waves, and the wave front of the process.

    Args:
        x, y: coordinates over the radius R of the rim.
    """
    pupil = settings.pupil
    rho2 = x**2 + y**2
    focus_um, tilt, astigmatism = error.assembly()
    k = 2 * math.pi / pupil.wavelength_um
    defocus = (
        -k * focus_um * (pupil.radius_um / pupil.sensor_distance_um) ** 2 / 2 * rho2
    )
    assembled = defocus + 2 * math.pi * (tilt * rho2 * x + astigmatism * (x**2 - y**2))
    return assembled + wave_front_rad(error.state(), x, y, settings.phase_rates)


def scatter_loss(settings: OpticsConfig, light: Tensor, variance: float) -> Tensor:
    """PSFs with the light that unequal pillars scatter: s L + (1 - s) shadow, s =
    exp(-V).

    With the phases of a lens spread evenly over a turn, a phase error of variance V
    leaves exp(-V) of the light in the image (Marechal). The rest goes straight on, over
    the shadow of the aperture.

    Args:
        settings: of the lens and its image.
        light: (..., h, w) fraction of the light per sample.
        variance: of the pillars' phases about a smooth wave front, rad².
    """
    strehl = math.exp(-variance)
    shadow = settings.sample_um**2 / (math.pi * (settings.aperture_mm * 500) ** 2)
    return strehl * light + (1 - strehl) * shadow


def double_helix_phase(x: Tensor, y: Tensor, zones: int) -> Tensor:
    """Phase of a double helix over the unit disc, rad, float64; zero for no zones.

    Vortices (2 k - 1) theta in k = 1 … ``zones`` rings of equal area.

    Args:
        x, y: coordinates over the radius of the lens. zones: rings.
    """
    x, y = x + torch.zeros_like(y), y + torch.zeros_like(x)
    if not zones:
        return torch.zeros_like(x, dtype=torch.float64)
    ring = torch.ceil(zones * (x**2 + y**2)).clamp(1, zones)
    return (2 * ring - 1) * torch.atan2(y, x)


def phase_terms(x: Tensor, y: Tensor, count: int, family: Family) -> list[Tensor]:
    """The first ``count`` polynomial phase terms over the unit disc, not orthogonal.

    free: rho^n cos(m theta), rho^n sin(m theta) for n = 2, 3, …, |m| <= n of the parity
    of n. radial: rho^2, rho^4, …

    Args:
        x, y: coordinates over the radius of the lens. count: of terms.
        family: "free" or "radial".
    """
    square = x**2 + y**2
    # by recurrence: products of x and y cost a tenth of powers and cosines
    radial_powers = [square]  # rho^2, rho^4, …
    cosine = [torch.ones_like(square), x]  # rho^m cos(m theta)
    sine = [torch.zeros_like(square), y]  # rho^m sin(m theta)
    if family == "radial":
        while len(radial_powers) < count:
            radial_powers.append(radial_powers[-1] * square)
        return radial_powers[:count]
    terms: list[Tensor] = []
    order = 2
    while len(terms) < count:
        cosine.append(cosine[-1] * x - sine[-1] * y)
        sine.append(sine[-1] * x + cosine[-2] * y)
        radial_powers.append(radial_powers[-1] * square)
        for m in range(-order, order + 1, 2):
            wave = (cosine if m >= 0 else sine)[abs(m)]
            index = (order - abs(m)) // 2
            terms.append(radial_powers[index - 1] * wave if index else wave)
        order += 1
    return terms[:count]
