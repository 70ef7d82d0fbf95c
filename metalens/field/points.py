"""PSFs of single field points: the pupil in the direction p that all media share, as the window's centre sees it.

    x(p) = X - reach(p) p/|p|                 where the ray that arrives at X with direction p leaves the lens
    U(X + δ) = ∫ √spread(p) T(x) exp(ik [source path(x) + path(p)]) exp(ik p·δ) d²p

The transform is exact to first order in δ, and √spread keeps ∫|U|². The low frequencies of |U|² are the
autocorrelation of the pupil; one padded transform gives all that squares of a sample's size can show.
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
from metalens.lens import Layers, media

SPARE = 1.06  # period of the nodes per width of the window
VERGENCES = 5  # Chebyshev points of 1/z for the paths of many depths
LARGEST_P = 0.9  # of a ray, in units of the rarest index


@dataclass(frozen=True, slots=True)
class Window:
    """Square samples around a field point: an odd count along each axis, of width ``step_um``."""

    samples: int
    step_um: float

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
    """

    x_um: Tensor
    y_um: Tensor
    weight: Tensor
    phase_rad: Tensor
    given: float


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
    return Sampling(period, nodes, scipy.fft.next_fast_len(size), harmonics, beyond)


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
    rows, columns = _to_samples(grid, window, shift_um, at_um.device)
    return torch.stack(
        [_one(optics, grid, place, depths_um, wavelength_um, (rows, columns), shift_um) for place in at_um]
    )


def _one(
    optics: Optics,
    grid: Sampling,
    place: Tensor,
    depths_um: Tensor,
    wavelength_um: float,
    ends: tuple[Tensor, Tensor],
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
    transfer = torch.fft.rfft2(spectrum.real**2 + spectrum.imag**2)
    low = grid.harmonics + 1
    kept = torch.cat([transfer[:, :low, :low], transfer[:, 1 - low :, :low]], 1)
    total = pupil.given * grid.size**2 / (1 - grid.beyond)
    return ((ends[0] @ kept) @ ends[1]).real / total


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
    return Pupil(x, y, whole * torch.sqrt(media.passed(after.order, p)), phase, float((whole**2).sum()))


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


@functools.lru_cache(maxsize=32)
def _to_samples(
    grid: Sampling, window: Window, shift_um: tuple[float, float], device: torch.device
) -> tuple[Tensor, Tensor]:
    """(samples, all harmonics) for y and (harmonics >= 0, samples) for x: transfer function to light on samples."""
    harmonic = np.arange(grid.harmonics + 1) / grid.period_um
    box = np.sinc(harmonic * window.step_um) ** 2 * (window.step_um / grid.period_um)
    place = (np.arange(window.samples) - (window.samples - 1) / 2) * window.step_um
    in_y = np.exp(-2j * np.pi * (place[:, None] - shift_um[1]) * harmonic) * box
    in_x = np.exp(-2j * np.pi * (place[:, None] - shift_um[0]) * harmonic) * box * np.where(harmonic == 0, 1.0, 2.0)
    rows = np.concatenate([in_y, in_y[:, 1:][:, ::-1].conj()], 1)
    return (
        torch.from_numpy(rows).to(torch.complex64).to(device),
        torch.from_numpy(in_x.T.copy()).to(torch.complex64).to(device),
    )
