"""PSFs of single field points: the pupil in the direction p that all media share, as the window's centre sees it.

    x(p) = X - reach(p) p/|p|                 where the ray that arrives at X with direction p leaves the lens
    U(X + δ) = ∫ √spread(p) T(x) exp(ik [source path(x) + path(p)]) exp(ik p·δ) d²p

The transform is exact to first order in δ, and √spread keeps ∫|U|². Second order, Q = δᵀH(p)δ/2 with H = ∂p/∂X, is put
right on the samples: about the middle p0 of the pupil its slope s(δ) = ∇Q moves the light, and its curvature
M(δ) = ∇∇Q, where asked for, adds ∇·(M S) with the flux S = Re(U* W), W the transform of (p - p0) T.
The low frequencies of |U|² are the autocorrelation of the pupil; one padded transform gives all that squares of a
sample's size can show.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from metalens.field.waves import Wave
from metalens.ground.errors import PropagationError
from metalens.lens import Layers, Media, media

SPARE = 1.06  # period of the nodes per width of the window
VERGENCES = 5  # Chebyshev points of 1/z for the paths of many depths
LARGEST_P = 0.9  # of a ray, in units of the rarest index


@dataclass(frozen=True, slots=True)
class Window:
    """Square samples around a field point: an odd count along each axis, of width ``step_um``.

    curved: with the flux of the second order as well, three times the work.
    """

    samples: int
    step_um: float
    curved: bool = False

    def __post_init__(self) -> None:
        if self.samples < 3 or self.samples % 2 == 0 or not self.step_um > 0:
            raise PropagationError(f"window of {self.samples} samples of {self.step_um} um: need an odd count >= 3")


@dataclass(frozen=True, eq=False, slots=True)
class Optics:
    """A lens in its surroundings: wave, layers, lens-sensor distance in um."""

    wave: Wave
    layers: Layers
    distance_um: float


@dataclass(frozen=True, eq=False, slots=True)
class Pupil:
    """Rays from one field point's window: where they leave the lens, weight, phase; (nodes, nodes) float64.

    given: sum of squares of the weights if no face of a film reflected: the light on the aperture.
    aside: (nodes,) p - p0 along x and along y; middle: (x, y) of p0, the middle of the pupil.
    """

    x_um: Tensor
    y_um: Tensor
    weight: Tensor
    phase_rad: Tensor
    given: float
    aside: Tensor
    middle: Tensor


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Along one axis: (samples, points) light of the points of a transform on each sample, and its derivative by the
    sample's place in um; place_um: (samples,) from where the rays are seen."""

    light: Tensor
    slope: Tensor
    place_um: Tensor


@dataclass(frozen=True, slots=True)
class Sampling:
    """period_um of the nodes, their number along an axis, size of the padded transform, harmonics that are kept.

    beyond: share of the light that the rim bends beyond the window, 4√2 / (π² k p h) of a sharp round rim at p and a
        window of half width h; the transform folds it back, and it is taken off.
    """

    period_um: float
    nodes: int
    size: int
    harmonics: int
    beyond: float
    curved: bool


def sampling(optics: Optics, window: Window, wavelength_um: float) -> Sampling:
    """Nodes that fill the aperture for a window on the axis, where it is widest in p."""
    after = optics.layers.after(optics.distance_um, wavelength_um)
    rim = torch.tensor(optics.wave.radius_um, dtype=torch.float64)
    edge = float(media.direction(after, rim))
    if edge > LARGEST_P * after.layers[0][0]:
        raise PropagationError(f"aperture of NA {edge:.2f}: the image engine is scalar, up to {LARGEST_P}")
    period = window.samples * window.step_um * SPARE
    nodes = 2 * math.ceil(edge * period / wavelength_um) + 2
    harmonics = math.floor(2 * period / window.step_um)
    half = window.samples * window.step_um / 2
    beyond = min(4 * math.sqrt(2) / (math.pi**2 * 2 * math.pi / wavelength_um * edge * half), 0.5)
    # neither the autocorrelation nor the harmonics that are kept of it may wrap round
    size = max(nodes + harmonics + 1, 2 * harmonics + 2)
    return Sampling(period, nodes, scipy.fft.next_fast_len(size), harmonics, beyond, window.curved)


def psfs(
    optics: Optics,
    at_um: Tensor,
    *,
    depths_um: Tensor,
    wavelength_um: float,
    window: Window,
    shift_um: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """(points, depths, h, w) share of the light on the aperture that falls on each sample from a source of that size.

    Source and sample are squares of one step: the light of a point, twice averaged over a square (sinc² in frequency,
    kept up to its second zero, 2 / step). Constant radiance is then kept to rounding, and nothing rings.

    Args:
        at_um: (points, [x, y]) float64 on the sensor: the source lies where a ray with tangents at_um / reduced
            distance through the middle of the lens comes from. Without films that is the chief ray.
        depths_um: (depths,) of the sources, inf for collimated light. wavelength_um: in vacuum.
        shift_um: the window's rays are seen from a place (x, y) beside the field point; the samples stay. A check of
            what the transform neglects.

    Returns:
        float32 on the device of ``at_um``; differentiable in what the wave's factor is.

    Raises:
        PropagationError: films thicker than the gaps, an aperture too wide for a scalar image.
    """
    grid = sampling(optics, window, wavelength_um)
    ends = tuple(_to_samples(grid, window, shift, at_um.device) for shift in shift_um)
    return torch.stack([_one(optics, grid, place, depths_um, wavelength_um, (*ends,), shift_um) for place in at_um])


def _one(
    optics: Optics,
    grid: Sampling,
    place: Tensor,
    depths_um: Tensor,
    wavelength_um: float,
    ends: tuple[Samples, ...],
    shift_um: tuple[float, float],
) -> Tensor:
    """(depths, h, w) PSFs of one field point."""
    pupil = seen(optics, place, grid, wavelength_um, shift_um)
    tangents = place / optics.layers.after(optics.distance_um, wavelength_um).reduced_um
    paths = source_paths(optics, tangents, (pupil.x_um, pupil.y_um), depths_um, wavelength_um)
    turns = pupil.phase_rad / (2 * math.pi) + paths / wavelength_um
    angle = ((turns - torch.round(turns)) * (2 * math.pi)).to(torch.float32)
    light = torch.polar(pupil.weight.to(torch.float32).expand_as(angle), angle)
    tilt = math.atan(math.hypot(*tangents.tolist()))
    factor = optics.wave.factor(pupil.x_um, pupil.y_um, wavelength_um, tilt)
    light = light if factor is None else light * factor.to(torch.complex64)
    spectrum = torch.fft.fft2(light, s=(grid.size, grid.size))
    slope, curvature = bending(optics.layers.after(optics.distance_um, wavelength_um), pupil.middle)
    total = pupil.given * grid.size**2 / (1 - grid.beyond)
    found = _moved(spectrum.real.square() + spectrum.imag.square(), ends, slope)
    if not grid.curved:
        return found / total
    for j, aside in enumerate((pupil.aside, pupil.aside[:, None])):
        other = torch.fft.fft2(light * aside.to(light.real), s=(grid.size, grid.size))
        flux = spectrum.real * other.real + spectrum.imag * other.imag
        found = found + _bent(flux, ends, curvature[:, j])
    return found / total


def _on_samples(power: Tensor, ends: tuple[Samples, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """(…, h, w) light on the samples, and its derivatives by their places along x and y."""
    along_x, along_y = ends
    rows = torch.cat([along_y.light, along_y.slope]) @ power
    count = len(along_y.light)
    plain, down = rows[..., :count, :], rows[..., count:, :]
    return plain @ along_x.light.mT, plain @ along_x.slope.mT, down @ along_x.light.mT


def _around(ends: tuple[Samples, ...]) -> Tensor:
    """([x, y], h, w) places of the samples from where the rays are seen, um."""
    y, x = torch.meshgrid(ends[1].place_um, ends[0].place_um, indexing="ij")
    return torch.stack([x, y])


def _moved(power: Tensor, ends: tuple[Samples, ...], slope: Tensor) -> Tensor:
    """(depths, h, w) |U|² on the samples, moved by s(δ)_j = δᵀ slope_j δ / 2: I + ∇·(s I)."""
    plain, across, down = _on_samples(power, ends)
    at = _around(ends)
    turned = torch.einsum("jab,byx->jayx", slope.to(at), at)
    s = torch.einsum("jayx,ayx->jyx", turned, at) / 2
    return plain * (1 + turned[0, 0] + turned[1, 1]) + s[0] * across + s[1] * down


def _bent(flux: Tensor, ends: tuple[Samples, ...], curvature: Tensor) -> Tensor:
    """(depths, h, w) Σ_i ∂_i (M_i S) on the samples, M_i = δᵀ curvature_i δ / 2, S a component of the flux."""
    return _moved(flux, ends, curvature) - _on_samples(flux, ends)[0]


def bending(after: Media, middle: Tensor) -> tuple[Tensor, Tensor]:
    """(j, a, b) ∂H/∂p_j and (i, j, a, b) ∂²H/∂p_i∂p_j at a direction, 1/um.

    H = ∂p/∂X is 1/reach' along the ray's plane and p/reach across it; differences of 1e-3, exact to 1e-5 of them.
    """
    step = 1e-3
    unit = torch.eye(2, dtype=middle.dtype, device=middle.device) * step

    def slope(p: Tensor) -> Tensor:
        return torch.stack([_turning(after, p + e) - _turning(after, p - e) for e in unit]) / (2 * step)

    return slope(middle), torch.stack([slope(middle + e) - slope(middle - e) for e in unit]) / (2 * step)


def _turning(after: Media, p: Tensor) -> Tensor:
    """(2, 2) H: how the direction towards a window turns as the window moves."""
    size = torch.hypot(p[0], p[1]).clamp_min(1e-9)
    reach, unit = media.reach(after, size), p / size
    along, across = reach / (size * media.spread(after, size)), size / reach
    flat = torch.eye(2, dtype=p.dtype, device=p.device)
    turning: Tensor = across * flat + (along - across) * torch.outer(unit, unit)
    return turning


def seen(
    optics: Optics, place: Tensor, grid: Sampling, wavelength_um: float, shift_um: tuple[float, float] = (0.0, 0.0)
) -> Pupil:
    """The rays of the nodes for one window centre, and the lens' carrier with the path to that centre."""
    after = optics.layers.after(optics.distance_um, wavelength_um)
    centre = place + torch.tensor(shift_um, dtype=place.dtype, device=place.device)
    axis = (torch.arange(grid.nodes, dtype=torch.float64, device=place.device) - (grid.nodes - 1) / 2) * (
        wavelength_um / grid.period_um
    )
    radius = optics.wave.radius_um
    turn = torch.arange(256, dtype=torch.float64, device=place.device) * (2 * math.pi / 256)
    rim = centre - radius * torch.stack([torch.cos(turn), torch.sin(turn)], -1)
    far = torch.hypot(rim[:, 0], rim[:, 1]).clamp_min(1e-9)
    edge = media.direction(after, far)[:, None] * rim / far[:, None]
    middle = (edge.amin(0) + edge.amax(0)) / 2
    py, px = torch.meshgrid(axis + middle[1], axis + middle[0], indexing="ij")
    p = torch.hypot(px, py)
    p = p.clamp(1e-12, 0.98 * after.layers[0][0])
    out = media.reach(after, p) / p
    x, y = centre[0] - out * px, centre[1] - out * py
    r = torch.hypot(x, y).clamp_min(1e-9)
    # width of a node across the rim: how fast the radius changes with p
    step = torch.sqrt(media.spread(after, p)) * (wavelength_um / grid.period_um)
    inside = ((radius - r) / step + 0.5).clamp(0, 1)
    whole = inside * torch.sqrt(media.spread(after, p))
    phase = optics.wave.carrier_rad(x, y) + 2 * math.pi / wavelength_um * media.path(after, p)
    weight = whole * torch.sqrt(media.passed(after.order, p))
    return Pupil(x, y, weight, phase, float((whole**2).sum()), axis, middle)


def source_paths(
    optics: Optics, tangents: Tensor, at_um: tuple[Tensor, Tensor], depths_um: Tensor, wavelength_um: float
) -> Tensor:
    """(depths, *shape) optical path from each source to the lens at (x, y), less the path to its middle, um.

    More depths than ``VERGENCES`` are interpolated between that many Chebyshev points of 1/z: the path is smooth there
    (singular only where a source touches the lens), and the points cost what the sources would.
    """
    if len(depths_um) <= VERGENCES:
        return _source_paths(optics, tangents, at_um, depths_um, wavelength_um)
    low, high = float((1 / depths_um).min()), float((1 / depths_um).max())
    unit = np.cos(np.pi * (np.arange(VERGENCES) + 0.5) / VERGENCES)
    nodes = (low + high) / 2 + (high - low) / 2 * unit
    value = np.polynomial.chebyshev.chebvander(unit, VERGENCES - 1)
    wanted = (2 / depths_um.cpu().numpy() - low - high) / (high - low)
    mix = np.polynomial.chebyshev.chebvander(wanted, VERGENCES - 1) @ np.linalg.inv(value)
    few = _source_paths(optics, tangents, at_um, torch.from_numpy(1 / nodes), wavelength_um)
    return (torch.from_numpy(mix).to(few) @ few.flatten(1)).reshape(-1, *at_um[0].shape)


def _source_paths(
    optics: Optics, tangents: Tensor, at_um: tuple[Tensor, Tensor], depths_um: Tensor, wavelength_um: float
) -> Tensor:
    """As :func:`source_paths`, one depth after the other."""
    x, y = at_um
    slope = float(torch.hypot(tangents[0], tangents[1]))
    p = torch.tensor(slope / math.hypot(1, slope), dtype=torch.float64, device=x.device)
    out = []
    for depth in depths_um.tolist():
        if math.isinf(depth):
            out.append((tangents[0] * x + tangents[1] * y) / math.hypot(1, slope))
            continue
        before = optics.layers.before(depth, wavelength_um)
        back = media.reach(before, p) / slope if slope > 0 else torch.tensor(before.reduced_um, device=x.device)
        sx, sy = -back * tangents[0], -back * tangents[1]
        if len(before.layers) == 1:  # √(z² + ρ²) less the same at the middle, without cancellation
            extra = x * x + y * y - 2 * (x * sx + y * sy)
            chief = math.sqrt(depth**2 + float(sx) ** 2 + float(sy) ** 2)
            out.append(before.layers[0][0] * extra / (torch.sqrt(chief**2 + extra) + chief))
        else:
            away = torch.hypot(x - sx, y - sy)
            out.append(media.chord(before, away) - media.chord(before, torch.hypot(sx, sy)))
    return torch.stack(out)


@functools.lru_cache(maxsize=64)
def _to_samples(grid: Sampling, window: Window, shift_um: float, device: torch.device) -> Samples:
    """From the points of the padded transform to the samples along an axis: sinc² up to its second zero."""
    harmonic = np.arange(1, grid.harmonics + 1)
    box = np.sinc(harmonic / grid.period_um * window.step_um) ** 2
    place = (np.arange(window.samples) - (window.samples - 1) / 2) * window.step_um - shift_um
    turns = (place[:, None] / grid.period_um + np.arange(grid.size) / grid.size) % 1
    angle = 2 * np.pi * turns[..., None] * harmonic
    scale = window.step_um / grid.period_um
    light = scale * (1 + 2 * np.cos(angle) @ box)
    slope = scale * -2 * np.sin(angle) @ (box * harmonic * 2 * np.pi / grid.period_um)
    found = [torch.from_numpy(a.astype(np.float32)).to(device) for a in (light, slope, place)]
    return Samples(found[0], found[1], found[2])
