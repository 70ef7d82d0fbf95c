"""The optics that training moves: a focus and a few dozen orthonormal polynomials of
phase, and their PSFs.
"""

import functools
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from codesign.batches import parallel
from codesign.optics import families
from codesign.optics.families import Family, StartingPhase
from codesign.optics.lens_errors import (
    LensError,
    LensErrors,
    PhaseRates,
    phase_rates,
    pillar_proxy,
    variance_rad2,
    wave_front_rad,
)
from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, TrainingError
from metalens.design import Focus, PhaseOf, profiles
from metalens.image import (
    Field,
    Grid,
    Imager,
    Optics,
    Pupil,
    PupilView,
    aperture_light,
    coordinates,
    radius,
    uniform_imager,
    view_pupil,
)
from metalens.library import DEFAULT_CELL, Proxy
from metalens.optics import Layers
from metalens.optics.paths import source_path


@dataclass(frozen=True, slots=True)
class OpticsConfig:
    """The lens in front of the sensor, and how finely training sees it.

    aperture_mm, sensor_distance_mm, wavelength_nm: of the lens.
    focus_mm: source distance that the hyperbolic part images onto the sensor.
    polynomials: orthonormal terms of order 2 and above that training moves; 0 for a
    fixed lens. family: of these terms:
        "free" form, or "radial" ones alone (one of them is a focus that moves).
    zones: rings of a double helix added to the hyperbolic phase; 0 for none.
    parts, apart_um: sectors of the aperture whose images lie on a circle of that
    diameter; 1 for a whole aperture.
    foci_mm: source distances of rings of equal area, from the middle to the rim; none
    for one focus.
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
    spread: LensErrors = field(default_factory=LensErrors)
    angle_deg: float = 0.0
    image: Literal["true", "uniform"] = "true"
    fwhm_nm: float = 0.0
    filter_nm: float = 0.0
    image_tolerance: float = 0.015
    family: Family = "free"
    parts: int = 1
    apart_um: float = 0.0
    foci_mm: tuple[float, ...] = ()
    layers: Layers | None = None
    cell: Cell = DEFAULT_CELL

    def __post_init__(self) -> None:
        low, high = self.depths_mm
        if not (0 < low < high and self.depth_count >= 2):
            raise ConfigError(
                f"depths_mm = {self.depths_mm}, depth_count = {self.depth_count}: need 0 < least < largest and a count "
                "of 2 or more"
            )
        if (
            min(
                self.aperture_mm,
                self.sensor_distance_mm,
                self.wavelength_nm,
                self.focus_mm,
                self.sample_um,
            )
            <= 0
        ):
            raise ConfigError(
                "aperture, sensor distance, wavelength, focus and sample must all be above 0"
            )
        if not abs(self.angle_deg) <= 40:
            raise ConfigError(
                f"angle_deg = {self.angle_deg}: need a field angle of -40 to 40 degrees"
            )
        StartingPhase(
            self.focus, 1.0, self.zones, self.parts, self.apart_um, self.foci_mm
        )
        if not (
            self.fwhm_nm >= 0 and self.filter_nm >= 0 and 0 < self.image_tolerance < 1
        ):
            raise ConfigError(
                f"fwhm_nm = {self.fwhm_nm}, filter_nm = {self.filter_nm}, image_tolerance = {self.image_tolerance}: "
                "need widths of 0 or more and a tolerance between 0 and 1"
            )
        if self.image == "uniform" and (
            self.fwhm_nm or self.filter_nm or self.layers is not None
        ):
            raise ConfigError(
                f"fwhm_nm = {self.fwhm_nm}, filter_nm = {self.filter_nm}, layers = {self.layers} with image = "
                "'uniform', an image of one wavelength in air: need image = 'true', or widths of 0 and no layers"
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
    def fine(self) -> int:
        """Samples of the intensity to one of ``sample_um``: at most lambda / (4 NA)
        apart, an odd number.
        """
        need = math.ceil(self.sample_um / (self.pupil.field_step_um / 2))
        return need + 1 - need % 2

    @property
    def start(self) -> StartingPhase:
        """The fixed phase on top of the focus."""
        foci = tuple(f * 1e3 for f in self.foci_mm)
        return StartingPhase(
            self.focus,
            self.aperture_mm * 500,
            self.zones,
            self.parts,
            self.apart_um,
            foci,
        )

    @property
    def passed(self) -> float:
        """Share of the source's light that the filter passes: both Gaussian, about the
        same wavelength.
        """
        return (
            self.filter_nm / math.hypot(self.fwhm_nm, self.filter_nm)
            if self.filter_nm
            else 1.0
        )

    @property
    def pupil(self) -> Pupil:
        """The aperture with as many nodes as the window of the PSFs needs."""
        rough = Pupil(
            self.aperture_mm * 500,
            self.sensor_distance_mm * 1e3,
            self.wavelength_nm * 1e-3,
        )
        width = self.window_samples * self.sample_um * 1.05
        nodes = max(64, math.ceil(width * 2 * rough.edge / rough.wavelength_um / 2) * 2)
        return Pupil(
            rough.radius_um, rough.sensor_distance_um, rough.wavelength_um, nodes
        )

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

    intensity: (depths, h, w) share of the light. depths_um: (depths,). plane: of a lens
    that is made, what forms its
    true image; None of a lens whose PSFs on axis alone are known.
    """

    intensity: Tensor
    depths_um: Tensor = field(repr=False)
    plane: Optics | None = field(default=None, repr=False)


def lens_psf_stack(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    *,
    error: LensError | None = None,
    shared: bool = False,
) -> PixelPsfStack:
    """PSFs of the lens whose polynomial coefficients are these, on samples of the
    image; differentiable.

    Each is the light on square samples, low-passed to what the grid of the samples can
    show: so it does not depend
    on where a source falls on the grid, and no optimiser can exploit that. The low
    frequencies of the intensity are
    the autocorrelation of the pupil, exact from one padded transform of the pupil's
    nodes a depth.

    Args:
        coefficients_rad: (polynomials,) in rad of root-mean-square phase over the
            aperture.
        error: one draw of ``settings.spread``.
        shared: every process of a training computes its part of the depths, and all
            get the whole stack; all of them must call.

    Raises:
        TrainingError: a coefficient is not finite.
    """
    if not bool(torch.isfinite(coefficients_rad).all()):
        raise TrainingError(
            "the optics left the finite numbers: lower the learning rate of the optics"
        )
    phase = added_phase(settings, coefficients_rad)
    if error is not None:
        phase = phase + _error_phase(settings, error)
    carriers, shape = _carriers(settings)
    count = len(carriers)
    rows = parallel.shared_rows(count) if shared else torch.arange(count)
    if len(rows) < count:
        carriers = carriers[rows]
    turn = torch.polar(
        torch.ones_like(phase, dtype=torch.float32),
        torch.remainder(phase, 2 * math.pi).float(),
    )
    field = torch.fft.fft2(carriers * turn, s=shape)
    transfer = torch.fft.rfft2(field.real**2 + field.imag**2)
    to_rows, to_columns = _sample_rows(settings)
    low = len(to_columns)
    kept = torch.cat([transfer[:, :low, :low], transfer[:, 1 - low :, :low]], 1)
    light = (to_rows @ (kept @ to_columns)).real
    if shared:
        light = parallel.gather_rows(light, rows, count)
    if error is not None:
        light = scatter_loss(
            settings, light, variance_rad2(error.state(), settings.phase_rates)
        )
    return PixelPsfStack(light, settings.depths_um)


def added_phase(settings: OpticsConfig, coefficients_rad: Tensor) -> Tensor:
    """(nodes, nodes) phase on top of the hyperbolic focus: what the lens starts from,
    and the polynomials.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
    """
    phase = _start(settings)
    if settings.polynomials:
        phase = phase + torch.einsum(
            "n,nyx->yx", coefficients_rad.double(), _modes(settings)
        )
    return phase


def phase_of(settings: OpticsConfig, coefficients_rad: Array) -> PhaseOf:
    """The trained phase as a function of pillar positions, for
    :func:`metalens.design.make`.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
    """
    count, family = settings.polynomials, settings.family
    mix = _polynomials(settings.pupil, count, family)[1] if count else torch.zeros(0, 0)
    weights = (
        (mix.T @ torch.as_tensor(coefficients_rad, dtype=torch.float64)).tolist()
        if len(mix)
        else []
    )
    rim = settings.aperture_mm * 500

    def phase(x_um: Array, y_um: Array) -> Array:
        x, y = (torch.from_numpy(np.asarray(a, float)) for a in (x_um, y_um[:, None]))
        focused = torch.from_numpy(
            profiles.hyperbolic_phase(x_um, y_um[:, None], settings.focus)
        )
        total = focused + settings.start.phase_rad(x, y)
        for weight, term in zip(
            weights,
            families.phase_terms(x / rim, y / rim, len(weights), family),
            strict=True,
        ):
            total = total + weight * term
        return total.numpy()

    return phase


def stack_imager(
    settings: OpticsConfig, made: PixelPsfStack, frame: int, *, margin: int
) -> Imager:
    """Shift-invariant imager of square frames of ``frame`` samples, margin included.

    Args:
        settings: of the lens and its image. made: PSFs over depth.
    """
    return uniform_imager(
        made.intensity,
        made.depths_um,
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
def _polynomials(
    pupil: Pupil, count: int, family: Family = "free"
) -> tuple[Tensor, Tensor]:
    """Terms on the nodes, orthonormal over the aperture (unit root mean square), and
    their mix of the plain ones.
    """
    x, y = (c / pupil.radius_um for c in coordinates(pupil))
    raw = torch.stack(families.phase_terms(x, y, count, family))
    inside = radius(pupil) <= pupil.radius_um
    samples = raw[:, inside]
    _, upper = torch.linalg.qr(samples.T)
    mix = torch.linalg.inv(upper).T * math.sqrt(samples.shape[1])
    return torch.einsum("nm,myx->nyx", mix, raw) * inside, mix


@functools.lru_cache(maxsize=8)
def _modes(settings: OpticsConfig) -> Tensor:
    """(polynomials, nodes, nodes) terms where the rays of the nodes leave the lens."""
    terms, mix = _polynomials(settings.pupil, settings.polynomials, settings.family)
    if not settings.angle_deg:
        return terms
    seen, rim = _seen(settings), settings.pupil.radius_um
    raw = torch.stack(
        families.phase_terms(
            seen.x_um / rim, seen.y_um / rim, len(mix), settings.family
        )
    )
    return torch.einsum("nm,myx->nyx", mix, raw) * (seen.weight > 0)


@functools.lru_cache(maxsize=8)
def _start(settings: OpticsConfig) -> Tensor:
    return settings.start.phase_rad(_seen(settings).x_um, _seen(settings).y_um)


@functools.lru_cache(maxsize=8)
def _seen(settings: OpticsConfig) -> PupilView:
    """The pupil from where the chief ray meets the sensor; its nodes are those of the
    lens on axis.
    """
    return view_pupil(
        settings.pupil, Field(math.radians(settings.angle_deg)), settings.focus_mm * 1e3
    )


@functools.lru_cache(maxsize=8)
def _carriers(settings: OpticsConfig) -> tuple[Tensor, tuple[int, int]]:
    """(depths, nodes, nodes) light of every source on the pupil behind the hyperbolic
    lens; size of its transforms.

    The size leaves the autocorrelation free of wrap-around at all frequencies that are
    kept. complex64.
    """
    seen, k = _seen(settings), 2 * math.pi / settings.pupil.wavelength_um
    tangents = Field(math.radians(settings.angle_deg)).tangents
    paths = [
        source_path(seen.x_um, seen.y_um, tangents, 1 / float(z))
        for z in settings.depths_um
    ]
    angle = torch.remainder(seen.lens_rad + k * torch.stack(paths), 2 * math.pi)
    size = scipy.fft.next_fast_len(settings.pupil.nodes + len(_kept(settings)))
    light = torch.polar(seen.weight, angle)
    if settings.layers is not None and settings.layers.stop is not None:
        about = (
            settings.pupil.wavelength_um,
            (seen.x_um.numpy(), seen.y_um.numpy()),
            settings.pupil.step_um,
        )
        shadows = [
            settings.layers.shadow(tangents, float(z), *about)
            for z in settings.depths_um
        ]
        light = light * torch.from_numpy(np.stack(shadows))
    return light.to(torch.complex64), (size, size)


def _kept(settings: OpticsConfig) -> Tensor:
    """Share of each harmonic of the pupil's period that the grid of the samples can
    show, of those that nodes have.
    """
    edge = settings.pupil.period_um / (2 * settings.sample_um)
    last = min(math.floor(edge + 0.5), settings.pupil.nodes)
    number = torch.arange(last + 1, dtype=torch.float64)
    return (edge - number + 0.5).clamp(
        0, 1
    )  # the last in part, so that the width of the period does not matter


@functools.lru_cache(maxsize=8)
def _sample_rows(settings: OpticsConfig) -> tuple[Tensor, Tensor]:
    """(samples, all frequencies) and (frequencies >= 0, samples): transfer function to
    the light on each sample.
    """
    pupil, size = settings.pupil, settings.window_samples
    kept = _kept(settings)
    harmonic = torch.arange(len(kept), dtype=torch.float64) / pupil.period_um
    place = (
        torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    ) * settings.sample_um
    half = torch.exp(2j * math.pi * place[:, None] * harmonic) * (
        kept * torch.sinc(harmonic * settings.sample_um)
    )
    rows = torch.cat([half, half[:, 1:].flip(1).conj()], 1)
    columns = half * torch.where(
        harmonic == 0, 1.0, 2.0
    )  # the other half of the frequencies is its conjugate
    given = (
        aperture_light(pupil, size * settings.sample_um)
        * _carriers(settings)[1][0] ** 2
    )
    scale = (settings.sample_um / pupil.period_um) ** 2 / given
    return (rows * scale).to(torch.complex64), columns.mT.contiguous().to(
        torch.complex64
    )


def phase_at(
    settings: OpticsConfig,
    coefficients_rad: Tensor,
    x_um: Tensor,
    y_um: Tensor,
    *,
    error: LensError | None = None,
) -> Tensor:
    """Phase on top of the hyperbolic focus at any places, float64; differentiable in
    the coefficients.

    Args:
        settings: of the lens and its image.
        coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        x_um: x on the lens. y_um: y on the lens.
        error: assembly and process error of one lens; None for none.
    """
    rim = settings.aperture_mm * 500
    total = settings.start.phase_rad(x_um, y_um)
    if settings.polynomials:
        weights = (
            _polynomials(settings.pupil, settings.polynomials, settings.family)[1].mT
            @ coefficients_rad.double()
        )
        terms = torch.stack(
            families.phase_terms(
                x_um / rim, y_um / rim, settings.polynomials, settings.family
            )
        )
        total = total + torch.einsum("n,nyx->yx", weights.to(terms.device), terms)
    return (
        total
        if error is None
        else total + _wave_front(settings, error, x_um / rim, y_um / rim)
    )


def _error_phase(settings: OpticsConfig, error: LensError) -> Tensor:
    seen, rim = _seen(settings), settings.pupil.radius_um
    return _wave_front(settings, error, seen.x_um / rim, seen.y_um / rim)


def _wave_front(
    settings: OpticsConfig, error: LensError, x: Tensor, y: Tensor
) -> Tensor:
    """Phase of one made lens less that of its design, at places in units of the rim's
    radius.
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
    """Light of pillars that the process made wrong: their phases differ by more than a
    smooth wave front.

    With the phases of a lens spread evenly over a turn, an error of variance V leaves
    exp(-V) of the light in the
    image (Marechal) and sends the rest straight on, over the shadow of the aperture.

    Args:
        settings: of the lens and its image.
    """
    kept = math.exp(-variance)
    shadow = settings.sample_um**2 / (math.pi * (settings.aperture_mm * 500) ** 2)
    return kept * light + (1 - kept) * shadow
