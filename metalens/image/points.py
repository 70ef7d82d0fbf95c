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
from metalens.image import compiled, polarised
from metalens.image.rays import (
    Paths,
    Rays,
    landing_offset,
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
    components: of the fields of both polarisations, so many of the strongest mixtures
        (:mod:`metalens.image.polarised`), each as much work as a scalar; 0 for one
        scalar.
    flux: whether those give the flux through the sensor's plane, which a pixel counts, or |Ex|² + |Ey|² + |Ez|².
    period: of the nodes, in widths of the window. Light from beyond half of it is seen
    folded back.
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
        if not 0 <= self.components <= self.whole:
            raise PropagationError(
                f"{self.components} components of the field: need 0 to {self.whole}"
            )
        if not self.period >= SPARE:
            raise PropagationError(
                f"nodes of a period of {self.period} windows: need {SPARE} or more"
            )

    @property
    def whole(self) -> int:
        """Components that leave nothing out."""
        return polarised.OF_FLUX if self.flux else polarised.OF_ENERGY


@dataclass(frozen=True, eq=False, slots=True)
class Optics:
    """A lens in its surroundings: wave, layers, lens-sensor distance in um."""

    wave: Wave
    layers: Layers
    distance_um: float


@dataclass(frozen=True, eq=False, slots=True)
class Pupil:
    """Weight and phase of the rays of a field point; (nodes, nodes) float64.

    given: the light on the aperture. The squares of the weights are less: a node across
    the rim has the mean field.
    """

    weight: Tensor
    phase_rad: Tensor
    given: float


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Along one axis: (2 samples, points) light of the points of a transform on each
    sample, and below it the
    derivative of that by the sample's place in um; place_um: (samples,) from where the
    rays are seen."""

    both: Tensor
    place_um: Tensor


@dataclass(frozen=True, slots=True)
class Sampling:
    """period_um of the nodes, their number along an axis and their step of p, size of
    the padded transform, harmonics
    that are kept.

    beyond: share of the light that a sharp round rim at p bends beyond the period (half
    of it, less the spare, is h),
        4√2 / (π² k p h); the transform folds it back.
    dimmed: share that a window lacks and is given back: nodes are the mean of their
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


def sampling(
    optics: Optics, window: Window, wavelength_um: float, finest_um: float = math.inf
) -> Sampling:
    """Nodes that fill the aperture for a window on the axis, where it is widest in p;
    of the shorter wave.

    Args:
        optics: lens, light and distances at the nodes.
        wavelength_um: vacuum wavelength, um.
    """
    after = optics.layers.after(optics.distance_um, wavelength_um)
    edge = float(
        media.ray_direction(
            after, torch.tensor(optics.wave.radius_um, dtype=torch.float64)
        )
    )
    if edge > LARGEST_P * after.layers[0][0]:
        raise PropagationError(
            f"aperture of NA {edge:.2f}: the image engine takes up to {LARGEST_P}"
        )
    step = min(wavelength_um, finest_um) / (
        window.samples * window.step_um * window.period
    )
    period = wavelength_um / step
    nodes = 2 * math.ceil(edge / step) + 2
    harmonics = math.floor(2 * period / window.step_um)
    half = window.samples * window.step_um / 2 * window.period / SPARE
    stop = optics.layers.stop
    open_edge = (
        edge
        if stop is None
        else edge * min(1.0, stop.radius_um / optics.wave.radius_um)
    )
    beyond = min(
        4
        * math.sqrt(2)
        / (math.pi**2 * 2 * math.pi / wavelength_um * open_edge * half),
        0.5,
    )
    # the harmonics that are kept may not wrap round, and the autocorrelation only onto
    # the last three tenths of them, below 3e-4 of the sharpest image
    size = max(nodes + math.ceil(0.7 * harmonics) + 1, 2 * harmonics + 2)
    quick = 16 * scipy.fft.next_fast_len(
        -(-size // 16)
    )  # a third quicker than sizes that just factorise
    dimmed = beyond * math.pi**2 / (12 * SPARE * window.period)
    return Sampling(period, nodes, step, quick, harmonics, beyond, dimmed, window)


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
    """(points, depths, h, w) share of the light on the aperture that falls on each
    sample from a source of that size.

    The aperture is the stop where the layers have one.

    Source and sample are squares of one step: the light of a point, twice averaged over
    a square (sinc² in frequency,
    kept up to its second zero, 2 / step). Constant radiance is then kept to rounding,
    and nothing rings.

    Args:
        optics: lens, light and distances at the nodes.
        at_um: (points, [x, y]) float64 on the sensor: the source lies where a ray with
            tangents at_um / reduced
            distance through the middle of the lens comes from. Without films that is
            the chief ray.
        depths_um: (depths,) of the sources, inf for collimated light. wavelength_um: in
            vacuum.
        shift_um: the window's rays are seen from a place (x, y) beside
            :func:`metalens.image.rays.landing_offset`;
            the samples stay. A check of
            what the transform neglects.
        finest_um: shortest wavelength of a spectrum, whose nodes are then those of all
            its wavelengths.

    Returns:
        float32 on the device of ``at_um``; differentiable in what the wave's factor is.

    Raises:
        PropagationError: films thicker than the gaps, an aperture beyond ``LARGEST_P``.
    """
    grid = sampling(optics, window, wavelength_um, finest_um)
    own = (grid, depths_um, wavelength_um, min(wavelength_um, finest_um), shift_um)
    return torch.stack([_one(optics, place, *own) for place in at_um])


def _one(
    optics: Optics,
    place: Tensor,
    grid: Sampling,
    depths_um: Tensor,
    wavelength_um: float,
    finest_um: float,
    shift_um: tuple[float, float],
) -> Tensor:
    """(depths, h, w) PSFs of one field point, seen from where its light lands."""
    landing = landing_offset(
        optics.layers,
        optics.wave.carrier_rad,
        optics.wave.radius_um,
        (
            (float(place[0]), float(place[1])),
            optics.layers.after(optics.distance_um, finest_um),
        ),
        depths_um,
        finest_um,
    )
    ends = tuple(
        _to_samples(grid, offset, shift, place.device)
        for offset, shift in zip(landing, shift_um, strict=True)
    )
    seen_from = landing[0] + shift_um[0], landing[1] + shift_um[1]
    found, pupil = node_rays(optics, place, grid, wavelength_um, seen_from)
    after = optics.layers.after(optics.distance_um, wavelength_um)
    tangents = place / after.reduced_um
    paths = source_paths(optics.layers, tangents, found, depths_um, wavelength_um)
    light = node_fields(pupil, paths, wavelength_um)
    tilt = math.atan(math.hypot(*tangents.tolist()))
    factor = optics.wave.factor(found.x_um, found.y_um, wavelength_um, tilt)
    light = light if factor is None else light * factor.to(torch.complex64)
    total: float | Tensor = pupil.given * grid.size**2 * (1 - grid.dimmed)
    if optics.layers.stop is not None:
        shade, taken = stop_amplitudes(
            optics, tangents, found, depths_um, wavelength_um
        )
        light, total = light * shade, total * taken
    mixed = None
    if grid.window.components:
        fields = polarised.polarisation_factors(
            found, tangents, after.order, flux=grid.window.flux
        )
        mixed = dominant_components(fields, pupil.weight, grid.window.components)
    few = (
        1 if light.device.type == "cpu" else len(light)
    )  # one depth at a time stays in a processor's cache
    moves = [
        _move(slope, ends)
        for slope in (
            found.slope,
            *(found.curvature.unbind(1) if grid.window.curved else ()),
        )
    ]
    second_order = (
        (found.offset_p, found.offset_p[:, None]) if grid.window.curved else ()
    )
    parts = torch.split(light, few)
    return (
        torch.cat(
            [
                _shown(_fluxes(part, mixed, second_order, grid.size), ends, moves)
                for part in parts
            ]
        )
        / total
    )


def stop_amplitudes(
    optics: Optics,
    tangents: Tensor,
    found: Rays,
    depths_um: Tensor,
    wavelength_um: float,
) -> tuple[Tensor, Tensor]:
    """Of each source, (depths, nodes, nodes) amplitude behind the stop over that
    without, and (depths, 1, 1) light on
    the stop over that on the whole lens, of sources on the axis.

    Args:
        optics: lens, light and distances at the nodes.
        tangents: tangents of the field angles along x and y.
        found: what was computed.
        depths_um: source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
    """
    depths, radius = tuple(depths_um.tolist()), optics.wave.radius_um
    shade = through_stop(
        optics.layers, tuple(tangents.tolist()), found, depths, wavelength_um
    )
    each = [
        (optics.layers.footprint_um(depth, wavelength_um) / radius) ** 2
        for depth in depths
    ]
    return shade, torch.tensor(each, device=shade.device)[:, None, None]


def _shown(
    fluxes: list[Tensor], ends: tuple[Samples, ...], moves: list[Tensor]
) -> Tensor:
    """(depths, h, w) light of the transforms, moved to second order, on the samples."""
    plain, change = _moved(fluxes[0], ends, moves[0])
    shown = plain + change
    for flux, move in zip(fluxes[1:], moves[1:], strict=True):
        shown = shown + _moved(flux, ends, move)[1]
    return shown


def _fluxes(
    light: Tensor,
    mixed: VectorPupil | None,
    second_order: tuple[Tensor, ...],
    size: int,
) -> list[Tensor]:
    """(depths, size, size) |U|² of the transforms of the light on the nodes, and with
    ``second_order`` the flux along x and y.

    mixed: whose light adds up; None for the scalar.
    """
    total: list[Tensor] = []
    pupils = (
        [(1.0, None)]
        if mixed is None
        else zip(mixed.signs, mixed.pupils.to(torch.float32), strict=True)
    )
    for sign, pupil in pupils:
        part = light if pupil is None else light * pupil
        spectrum = torch.fft.fft2(part, s=(size, size))
        found = [torch.addcmul(spectrum.real.square(), spectrum.imag, spectrum.imag)]
        for along in second_order:
            other = torch.fft.fft2(part * along.to(part.real), s=(size, size))
            found.append(
                torch.addcmul(spectrum.real * other.real, spectrum.imag, other.imag)
            )
        total = (
            found
            if not total
            else [a + sign * b for a, b in zip(total, found, strict=True)]
        )
    return total


def _on_samples(
    power: Tensor, ends: tuple[Samples, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """(…, h, w) light on the samples, and its derivatives by their places along x and
    y.
    """
    along_x, along_y = ends
    height, width = len(along_y.place_um), len(along_x.place_um)
    rows = along_y.both @ power
    plain, down = rows[..., :height, :], rows[..., height:, :]
    shown = plain @ along_x.both.mT
    return shown[..., :width], shown[..., width:], down @ along_x.both[:width].mT


def _around(ends: tuple[Samples, ...]) -> Tensor:
    """([x, y], h, w) places of the samples from where the rays are seen, um."""
    y, x = torch.meshgrid(ends[1].place_um, ends[0].place_um, indexing="ij")
    return torch.stack([x, y])


def _move(slope: Tensor, ends: tuple[Samples, ...]) -> Tensor:
    """([x, y, divergence], h, w) of the shift s(δ)_j = δᵀ slope_j δ / 2."""
    at = _around(ends)
    turned = torch.einsum("jab,byx->jayx", slope.to(at), at)
    s = torch.einsum("jayx,ayx->jyx", turned, at) / 2
    return torch.cat([s, (turned[0, 0] + turned[1, 1])[None]])


def _moved(
    power: Tensor, ends: tuple[Samples, ...], move: Tensor
) -> tuple[Tensor, Tensor]:
    """(depths, h, w) power P (|U|², or a component of the flux) on the samples, and
    ∇·(s P): how it changes where it is
    moved by s (see :func:`_move`)."""
    plain, across, down = _on_samples(power, ends)
    return plain, plain * move[2] + move[0] * across + move[1] * down


def node_rays(
    optics: Optics,
    place: Tensor,
    grid: Sampling,
    wavelength_um: float,
    beside_um: tuple[float, float] = (0.0, 0.0),
) -> tuple[Rays, Pupil]:
    """The rays of the nodes to a place beside the field point, and the lens' carrier
    with the path to there.

    Args:
        optics: lens, light and distances at the nodes.
        grid: samples, step, depths and margin of the image.
        wavelength_um: vacuum wavelength, um.
    """
    after = optics.layers.after(optics.distance_um, wavelength_um)
    at = float(place[0]) + beside_um[0], float(place[1]) + beside_um[1]
    found = rays(
        after, optics.wave.radius_um, at, (grid.nodes, grid.step), place.device
    )
    phase = (
        optics.wave.carrier_rad(found.x_um, found.y_um)
        + 2 * math.pi / wavelength_um * found.away_um
    )
    return found, Pupil(
        found.whole * found.passed,
        phase,
        float((found.whole * found.width_um).sum()) / grid.step,
    )


def node_fields(pupil: Pupil, paths: Paths, wavelength_um: float) -> Tensor:
    """(depths, *shape) complex64 light on the nodes, the factor of the wave left out;
    compiled on the processor.

    Args:
        pupil: sampled pupil of the lens.
        wavelength_um: vacuum wavelength, um.
    """
    turns = pupil.phase_rad / (2 * math.pi)
    if turns.device.type == "cpu":
        given = pupil.weight, turns, paths.few_um / wavelength_um, paths.mix
        return torch.from_numpy(compiled.phasors(*(part.numpy() for part in given)))
    turns = turns + paths.um / wavelength_um
    angle = ((turns - torch.round(turns)) * (2 * math.pi)).to(torch.float32)
    return torch.polar(pupil.weight.to(torch.float32).expand_as(angle), angle)


@functools.lru_cache(maxsize=64)
def _to_samples(
    grid: Sampling, view_um: float, shift_um: float, device: torch.device
) -> Samples:
    """From the points of the padded transform to the samples along an axis: sinc² up to
    its second zero.

    Σ_h sinc²(h step / period) exp(2πi h (place / period + m / size)), h from -harmonics
    to harmonics, by a transform.
    Samples more than half a period from where the light lands are dark, since the
    transform has other light there; 1e-6 keeps the shape of a PSF of next to nothing.
    """
    window, harmonic = grid.window, np.arange(grid.harmonics + 1)
    box = np.sinc(harmonic / grid.period_um * window.step_um) ** 2
    place = (
        np.arange(window.samples) - (window.samples - 1) / 2
    ) * window.step_um - view_um
    seen_as = np.where(np.abs(place) <= grid.period_um / 2, 1.0, 1e-6)
    place = place - shift_um
    wave = (
        seen_as[:, None]
        * box
        * np.exp(2j * np.pi * (place[:, None] / grid.period_um * harmonic % 1))
    )
    scale = window.step_um / grid.period_um * grid.size
    light = scale * np.fft.irfft(wave, grid.size)
    slope = scale * np.fft.irfft(
        wave * (2j * np.pi / grid.period_um * harmonic), grid.size
    )
    found = [
        torch.from_numpy(a.astype(np.float32)).to(device)
        for a in (np.concatenate([light, slope]), place)
    ]
    return Samples(found[0], found[1])
