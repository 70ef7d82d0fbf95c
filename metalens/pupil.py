"""Quick PSFs of smooth pupil phases on axis: two matrix products a depth, for design studies and first guesses.

The pupil is sampled in direction cosines q as seen from the window's centre, in which the lens-to-window
propagation is a Fourier transform to first order in the window's size. Pillars are not resolved; the full lens goes
through :mod:`metalens.psf`.
"""

import functools
import math
from dataclasses import dataclass

import torch

from metalens.errors import PropagationError

Tensor = torch.Tensor


@dataclass(frozen=True, slots=True)
class Pupil:
    """A round aperture in front of a sensor.

    nodes: samples across the aperture; PSFs wider than ``period_um`` wrap around.
    """

    radius_um: float = 500.0
    sensor_distance_um: float = 2000.0
    wavelength_um: float = 0.85
    nodes: int = 160

    @property
    def edge(self) -> float:
        """Direction cosine of the rim."""
        return self.radius_um / math.hypot(self.radius_um, self.sensor_distance_um)

    @property
    def period_um(self) -> float:
        """Width within which a PSF is free of wrap-around."""
        return self.wavelength_um * self.nodes / (2 * self.edge)

    @property
    def field_step_um(self) -> float:
        """Coarsest sampling of the field: lambda / (2 sin of the rim's angle); of the intensity, half of it."""
        return self.wavelength_um / (2 * self.edge)


def axis(pupil: Pupil) -> Tensor:
    """(nodes,) direction cosines of the nodes from their middle."""
    return (torch.arange(pupil.nodes, dtype=torch.float64) - (pupil.nodes - 1) / 2) * (2 * pupil.edge / pupil.nodes)


@functools.lru_cache(maxsize=16)
def kernel(pupil: Pupil, sample_um: float, samples: int) -> Tensor:
    """(samples, nodes) Fourier transform from direction cosines to the samples of a window."""
    position = (torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * sample_um
    k = 2 * math.pi / pupil.wavelength_um
    return torch.exp(-1j * k * position[:, None] * axis(pupil)).to(torch.complex64)


def coordinates(pupil: Pupil) -> tuple[Tensor, Tensor]:
    """(x, y) on the lens, um, of the pupil's nodes: two (nodes, nodes) arrays."""
    q = axis(pupil)
    qy, qx = torch.meshgrid(q, q, indexing="ij")
    stretch = pupil.sensor_distance_um / torch.sqrt((1 - qx**2 - qy**2).clamp_min(1e-3))
    return qx * stretch, qy * stretch


@functools.lru_cache(maxsize=16)
def radius(pupil: Pupil) -> Tensor:
    """(nodes, nodes) distance of the nodes from the axis on the lens, um."""
    return torch.hypot(*coordinates(pupil))


def amplitude(pupil: Pupil) -> Tensor:
    """(nodes, nodes) weight of the nodes: the share of the rim cells inside the aperture, and the solid angle."""
    q = axis(pupil)
    q2 = q[:, None] ** 2 + q**2
    step = 2 * pupil.edge / pupil.nodes
    inside = ((pupil.edge - torch.sqrt(q2)) / step + 0.5).clamp(0, 1)
    return inside / (1 - q2).clamp_min(0.5)


def spherical_path(radius_um: Tensor, distance_um: float) -> Tensor:
    """Extra path from an axial point out to ``radius_um``: sqrt(r² + z²) - z, without cancellation."""
    r2 = radius_um**2
    return r2 / (torch.sqrt(r2 + distance_um**2) + distance_um)


def psf(
    phase_rad: Tensor,
    pupil: Pupil,
    *,
    depths_um: Tensor,
    focus_um: float,
    sample_um: float = 0.75,
    samples: int = 192,
) -> Tensor:
    """Intensity of axial point sources behind a lens that focuses ``focus_um`` and adds ``phase_rad``.

    Args:
        phase_rad: (nodes, nodes) on the pupil's nodes, differentiable.
        depths_um: (depths,) of the sources in front of the lens.
        focus_um: source distance that the hyperbolic part of the lens images onto the sensor.
        sample_um: of the window, at most half of ``pupil.field_step_um``.

    Returns:
        (depths, samples, samples): share of the light through the aperture on each sample; float32.

    Raises:
        PropagationError: the window is wider than the period of the nodes.
    """
    if samples * sample_um > pupil.period_um * (1 + 1e-9):
        raise PropagationError(
            f"window of {samples * sample_um:.0f} um is wider than the period {pupil.period_um:.0f} um; "
            "raise Pupil.nodes or take a smaller window"
        )
    to_window = kernel(pupil, sample_um, samples)
    defocus, weight = _tables(pupil, float(focus_um))
    k = 2 * math.pi / pupil.wavelength_um
    path = torch.stack([spherical_path(radius(pupil), depth) - defocus for depth in depths_um.tolist()])
    angle = wrapped(k * path).float() + wrapped(phase_rad).float()
    field = torch.polar(weight.expand_as(angle), angle)
    image = to_window @ (field @ to_window.mT)
    return (image.real**2 + image.imag**2) * _share(pupil, sample_um)


def wrapped(phase_rad: Tensor) -> Tensor:
    """The phase less whole turns, so that single precision holds it; the gradient is that of the phase."""
    return phase_rad - 2 * math.pi * torch.round(phase_rad.detach() / (2 * math.pi))


@functools.lru_cache(maxsize=16)
def _tables(pupil: Pupil, focus_um: float) -> tuple[Tensor, Tensor]:
    return spherical_path(radius(pupil), focus_um), amplitude(pupil).float()


def _share(pupil: Pupil, sample_um: float) -> float:
    """Scale from |field|² to the share of the light: Parseval over one period of the nodes."""
    return float((sample_um / pupil.period_um) ** 2 / (amplitude(pupil) ** 2).sum())
