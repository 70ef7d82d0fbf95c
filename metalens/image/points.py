"""PSFs of single field points: the pupil in the direction p that all media share, as
the window's centre sees it.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from metalens.core.errors import PropagationError
from metalens.image.rays import (
    OF_ENERGY,
    OF_FLUX,
    Rays,
    landing_offset,
    polarisation_factors,
    rays,
    source_paths,
    through_stop,
)
from metalens.image.waves import Wave
from metalens.optics import Layers, media
from metalens.psf import VectorPupil, dominant_components

SPARE = 1.06  # period of the nodes per width of the window
LARGEST_P = 0.9  # of a ray, in units of the rarest index


@dataclass(frozen=True, slots=True)
class Window:
    """Square samples around a field point: an odd count along each axis, of width
    ``step_um``.

    curved: with the flux of the second order as well, three times the work.
    components: number of the strongest mixtures of both polarisations' fields
        (:func:`metalens.image.rays.polarisation_factors`), each as much work as a scalar; 0 for one
        scalar.
    flux: whether those give the flux through the sensor's plane, which a pixel counts,
        or |Ex|² + |Ey|² + |Ez|².
    period: of the nodes, in widths of the window. The transform folds light from beyond
        half of it onto the window.
    """

    samples: int
    step_um: float
    curved: bool = False
    components: int = 0
    flux: bool = True
    period: float = SPARE

    def __post_init__(self) -> None:
        if self.samples < 3 or self.samples % 2 == 0 or not self.step_um > 0:
            raise PropagationError(
                f"window of {self.samples} samples of {self.step_um} um: need an odd count >= 3"
            )

    @property
    def whole(self) -> int:
        """Components that leave nothing out."""
        return OF_FLUX if self.flux else OF_ENERGY


@dataclass(frozen=True, eq=False, slots=True)
class Optics:
    """A lens in its surroundings: wave, layers, lens-sensor distance in um."""

    wave: Wave
    layers: Layers
    distance_um: float


@dataclass(frozen=True, eq=False, slots=True)
class WindowSamples:
    """Along one axis: (2 samples, points) light of the points of a transform on each
    sample, and below it the
    derivative of that by the sample's place in um; place_um: (samples,) from where the
    rays are traced to."""

    both: Tensor
    place_um: Tensor


@dataclass(frozen=True, slots=True)
class PupilSampling:
    """period_um of the nodes, their number along an axis and their step of p, size of
    the padded transform, harmonics
    that are kept.

    beyond: share of the light that a sharp round rim at p diffracts beyond the period (half
    of it, less the spare, is h),
        4√2 / (π² k p h); the transform folds it back.
    dimmed: share that a window lacks and is lens_light back: nodes are the mean of their
    width at the rim, whose light at X
        is so times sinc²(X / period): ∫ (1 - sinc²) d(4√2 / (π² k p X)) over the
        window, to second order.
    """

    period_um: float
    nodes: int
    step: float
    size: int
    harmonics: int
    beyond: float
    dimmed: float
    window: Window


def pupil_sampling(
    optics: Optics, window: Window, wavelength_um: float, finest_um: float = math.inf
) -> PupilSampling:
    """Nodes of the pupil and size of its padded transform for one window.

    Nodes are at equal steps of p = n sin θ. They fill the aperture as a window on the
    axis sees it, where it is widest in p. Their step is the wavelength over the period.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        window: samples of the PSF and period of the nodes.
        wavelength_um: vacuum wavelength, um.
        finest_um: shortest wavelength of a spectrum, um; it sets the step.
    """
    after = optics.layers.after(optics.distance_um, wavelength_um)
    radius = torch.tensor(optics.wave.radius_um, dtype=torch.float64)
    edge_p = float(media.ray_direction(after, radius))
    if edge_p > LARGEST_P * after.layers[0][0]:
        raise PropagationError(
            f"aperture of NA {edge_p:.2f}: the image engine takes up to {LARGEST_P}"
        )
    step = min(wavelength_um, finest_um) / (
        window.samples * window.step_um * window.period
    )
    period = wavelength_um / step
    nodes = 2 * math.ceil(edge_p / step) + 2
    harmonics = math.floor(2 * period / window.step_um)
    half_um = window.samples * window.step_um / 2 * window.period / SPARE
    stop = optics.layers.stop
    open_edge_p = edge_p
    if stop is not None:
        open_edge_p *= min(1.0, stop.radius_um / optics.wave.radius_um)
    denominator = math.pi**2 * 2 * math.pi / wavelength_um * open_edge_p * half_um
    beyond = min(4 * math.sqrt(2) / denominator, 0.5)
    # the harmonics that are kept may not wrap round, and the autocorrelation only onto
    # the last three tenths of them, below 3e-4 of the sharpest image
    size = max(nodes + math.ceil(0.7 * harmonics) + 1, 2 * harmonics + 2)
    # multiples of 16 are a third quicker than sizes that just factorise
    padded_size = 16 * scipy.fft.next_fast_len(-(-size // 16))
    dimmed = beyond * math.pi**2 / (12 * SPARE * window.period)
    return PupilSampling(
        period, nodes, step, padded_size, harmonics, beyond, dimmed, window
    )


def psfs(
    optics: Optics,
    at_um: Tensor,
    *,
    depths_um: Tensor,
    wavelength_um: float,
    window: Window,
    shift_um: tuple[float, float] = (0.0, 0.0),
    finest_um: float = math.inf,
) -> Tensor:
    """(points, depths, h, w) PSFs: share of the light on the aperture on each sample.

    The aperture is the stop where the layers have one. Source and sample are squares of
    one step: the light of a point is averaged twice over a square (sinc² in frequency,
    cut off at its second zero, 2 / step). Constant radiance then stays constant to
    rounding, without ringing.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        at_um: (points, [x, y]) float64 on the sensor. The source lies on the ray with
            tangents at_um / reduced distance through the middle of the lens. Without
            films that is the chief ray.
        depths_um: (depths,) of the sources, inf for collimated light.
        wavelength_um: in vacuum.
        window: samples of the PSFs and components of the field.
        shift_um: (x, y) from :func:`metalens.image.rays.landing_offset` to where the
            window's rays are traced; the samples stay. It checks the second-order
            transform.
        finest_um: shortest wavelength of a spectrum, whose nodes are then those of all
            its wavelengths.

    Returns:
        float32 on the device of ``at_um``; differentiable in what the wave's factor is.

    Raises:
        PropagationError: films thicker than the gaps, an aperture beyond ``LARGEST_P``.
    """
    grid = pupil_sampling(optics, window, wavelength_um, finest_um)
    shared = (grid, depths_um, wavelength_um, min(wavelength_um, finest_um), shift_um)
    return torch.stack([_point_psfs(optics, place, *shared) for place in at_um])


def _point_psfs(
    optics: Optics,
    place: Tensor,
    grid: PupilSampling,
    depths_um: Tensor,
    wavelength_um: float,
    finest_um: float,
    shift_um: tuple[float, float],
) -> Tensor:
    """(depths, h, w) PSFs of one field point: light on each sample over that on the
    aperture.

    The field on the pupil's nodes is transformed to the sensor, where |U|² is summed
    over each sample. The window's rays are traced to where the light lands.

    Args:
        place: (x, y) field point on the sensor, um.
        depths_um: (depths,) source depths from the lens, um.
        shift_um: (x, y) from the landing place to where the rays are traced, um.
    """
    finest_media = optics.layers.after(optics.distance_um, finest_um)
    landing = landing_offset(
        optics.layers,
        optics.wave.carrier_rad,
        optics.wave.radius_um,
        ((float(place[0]), float(place[1])), finest_media),
        depths_um,
        finest_um,
    )
    to_samples = tuple(
        _to_samples(grid, offset, shift, place.device)
        for offset, shift in zip(landing, shift_um, strict=True)
    )
    centre_um = landing[0] + shift_um[0], landing[1] + shift_um[1]
    bundle, light, total = _pupil_fields(
        optics, place, grid, depths_um, wavelength_um, centre_um
    )
    after = optics.layers.after(optics.distance_um, wavelength_um)
    mixed = None
    if grid.window.components:
        tangents = place / after.reduced_um
        fields = polarisation_factors(
            bundle, tangents, after.order, flux=grid.window.flux
        )
        weight = bundle.whole * bundle.passed
        mixed = dominant_components(fields, weight, grid.window.components)
    slopes: tuple[Tensor, ...] = (bundle.slope,)
    second_order: tuple[Tensor, ...] = ()
    if grid.window.curved:
        slopes += bundle.curvature.unbind(1)
        second_order = bundle.offset_p, bundle.offset_p[:, None]
    moves = [_move(slope, to_samples) for slope in slopes]
    # one depth at a time stays in a processor's cache
    at_once = 1 if light.device.type == "cpu" else len(light)
    images = []
    for part in torch.split(light, at_once):
        fluxes = _fluxes(part, mixed, second_order, grid.size)
        moved = [
            _moved(flux, to_samples, move)
            for flux, move in zip(fluxes, moves, strict=True)
        ]
        images.append(moved[0][0] + sum(change for _, change in moved))
    return torch.cat(images) / total


def _pupil_fields(
    optics: Optics,
    place: Tensor,
    grid: PupilSampling,
    depths_um: Tensor,
    wavelength_um: float,
    centre_um: tuple[float, float],
) -> tuple[Rays, Tensor, Tensor]:
    """Rays from the pupil's nodes, fields on the nodes, and light on the aperture.

    A field is √(spread · power passed) exp(iφ): φ is the lens' carrier plus 2π/λ times
    the paths from the source and to the window's centre, times the wave's factor and
    the amplitude behind the stop.

    Args:
        place: (x, y) field point on the sensor, um.
        depths_um: (depths,) source depths from the lens, um.
        centre_um: (x, y) from the field point to where the rays go, um.

    Returns:
        (rays, (depths, nodes, nodes) complex64 fields, (depths, 1, 1) light). The
            squares of the weights are less than the light: a node across the rim has
            the mean field.
    """
    wave, layers = optics.wave, optics.layers
    after = layers.after(optics.distance_um, wavelength_um)
    x, y = place.tolist()
    tangents = x / after.reduced_um, y / after.reduced_um
    bundle = rays(
        after,
        wave.radius_um,
        (x + centre_um[0], y + centre_um[1]),
        (grid.nodes, grid.step),
        place.device,
    )
    path_um = bundle.away_um + source_paths(
        layers, tangents, bundle, depths_um, wavelength_um
    )
    carrier = wave.carrier_rad(bundle.x_um, bundle.y_um)
    phase = carrier + 2 * math.pi / wavelength_um * path_um
    angle = torch.remainder(phase, 2 * math.pi).to(torch.float32)
    weight = (bundle.whole * bundle.passed).to(torch.float32)
    light = torch.polar(weight.expand_as(angle), angle)
    tilt = math.atan(math.hypot(*tangents))
    factor = wave.factor(bundle.x_um, bundle.y_um, wavelength_um, tilt)
    if factor is not None:
        light = light * factor.to(torch.complex64)
    lens_light = float((bundle.whole * bundle.width_um).sum()) / grid.step
    stop_share = torch.ones(len(depths_um), device=light.device)
    if layers.stop is not None:
        light = light * through_stop(layers, tangents, bundle, depths_um, wavelength_um)
        # light on the stop over that on the whole lens, of sources on the axis
        footprints = [layers.footprint_um(d, wavelength_um) for d in depths_um.tolist()]
        stop_share = (torch.tensor(footprints).to(stop_share) / wave.radius_um) ** 2
    total = lens_light * grid.size**2 * (1 - grid.dimmed) * stop_share
    return bundle, light, total[:, None, None]


def _fluxes(
    light: Tensor,
    mixed: VectorPupil | None,
    second_order: tuple[Tensor, ...],
    size: int,
) -> list[Tensor]:
    """(depths, size, size) |U|² of the pupil's transform; with ``second_order`` also
    the flux Re(U* U_a) along x and y.

    U is the padded FFT of the light, U_a that of the light times offset a.

    Args:
        light: (depths, nodes, nodes) complex field on the pupil's nodes.
        mixed: pupils of the polarisation components, whose light adds with their signs;
            None for one scalar.
        second_order: offsets of p along x and along y; empty for |U|² alone.
        size: of the padded transform.
    """
    total: list[Tensor] = []
    pupils = (
        [(1.0, None)]
        if mixed is None
        else zip(mixed.signs, mixed.pupils.to(torch.float32), strict=True)
    )
    for sign, pupil in pupils:
        field = light if pupil is None else light * pupil
        u = torch.fft.fft2(field, s=(size, size))
        fluxes = [torch.addcmul(u.real.square(), u.imag, u.imag)]
        for offset in second_order:
            u_a = torch.fft.fft2(field * offset.to(field.real), s=(size, size))
            fluxes.append(torch.addcmul(u.real * u_a.real, u.imag, u_a.imag))
        if not total:
            total = fluxes
            continue
        total = [a + sign * b for a, b in zip(total, fluxes, strict=True)]
    return total


def _move(slope: Tensor, to_samples: tuple[WindowSamples, ...]) -> Tensor:
    """([x, y, divergence], h, w) of the shift s(δ)_j = δᵀ slope_j δ / 2, in um.

    δ is the place of a sample from where the rays are traced to.

    Args:
        slope: (2, 2, 2) symmetric matrices slope_j, 1/um.
    """
    along_x, along_y = to_samples
    y, x = torch.meshgrid(along_y.place_um, along_x.place_um, indexing="ij")
    delta = torch.stack([x, y])
    gradient = torch.einsum("jab,byx->jayx", slope.to(delta), delta)
    shift = torch.einsum("jayx,ayx->jyx", gradient, delta) / 2
    return torch.cat([shift, (gradient[0, 0] + gradient[1, 1])[None]])


def _moved(
    power: Tensor, to_samples: tuple[WindowSamples, ...], move: Tensor
) -> tuple[Tensor, Tensor]:
    """(depths, h, w) power P on the samples, and ∇·(s P), its change by the shift s.

    Args:
        power: (depths, size, size) |U|², or a component of the flux.
        move: shift s along x and y, and its divergence (:func:`_move`).
    """
    along_x, along_y = to_samples
    height, width = len(along_y.place_um), len(along_x.place_um)
    rows = along_y.both @ power
    both = rows[..., :height, :] @ along_x.both.mT
    plain, by_x = both[..., :width], both[..., width:]
    by_y = rows[..., height:, :] @ along_x.both[:width].mT
    return plain, plain * move[2] + move[0] * by_x + move[1] * by_y


@functools.lru_cache(maxsize=64)
def _to_samples(
    grid: PupilSampling, view_um: float, shift_um: float, device: torch.device
) -> WindowSamples:
    """Matrix from the points of the padded transform to the samples along one axis.

    Its element of sample and point m is Σ_h sinc²(h step / period)
    exp(2πi h (place / period + m / size)), h from -harmonics to harmonics: sinc² up to
    its second zero, by a transform. Samples more than half a period from where the
    light lands are dark, as the transform folds other light onto them. Their factor
    1e-6 keeps the shape of a PSF that has next to no light.

    Args:
        view_um: from the field point to where the light lands, um.
        shift_um: from there to where the rays are traced, um.
    """
    window = grid.window
    harmonic = np.arange(grid.harmonics + 1)
    box = np.sinc(harmonic / grid.period_um * window.step_um) ** 2
    index = np.arange(window.samples) - (window.samples - 1) / 2
    place = index * window.step_um - view_um
    inside = np.where(np.abs(place) <= grid.period_um / 2, 1.0, 1e-6)
    place = place - shift_um
    turns = place[:, None] / grid.period_um * harmonic % 1
    spectrum = inside[:, None] * box * np.exp(2j * np.pi * turns)
    scale = window.step_um / grid.period_um * grid.size
    light = scale * np.fft.irfft(spectrum, grid.size)
    slope = scale * np.fft.irfft(
        spectrum * (2j * np.pi / grid.period_um * harmonic), grid.size
    )
    matrix = np.concatenate([light, slope]).astype(np.float32)
    return WindowSamples(
        torch.from_numpy(matrix).to(device),
        torch.from_numpy(place.astype(np.float32)).to(device),
    )
