"""Quick PSFs of smooth pupil phases: two matrix products an image, for design studies
and first guesses.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from metalens.core.errors import PropagationError
from metalens.image.rays import middle_direction
from metalens.optics import Layers
from metalens.optics.paths import axial_path_difference, sensor_path, source_path


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
    def step_um(self) -> float:
        """Width of a node on the aperture."""
        return 2 * self.radius_um / self.nodes

    @property
    def field_step_um(self) -> float:
        """Coarsest sampling of the field: lambda / (2 sin of the rim's angle); of the
        intensity, half of it.
        """
        return self.wavelength_um / (2 * self.edge)


@dataclass(frozen=True, slots=True)
class Field:
    """A place in the field: ``angle_rad`` from the axis, in the direction
    ``azimuth_rad`` from +x.
    """

    angle_rad: float = 0.0
    azimuth_rad: float = 0.0

    @property
    def tangents(self) -> tuple[float, float]:
        """(x, y) of the chief ray."""
        size = math.tan(self.angle_rad)
        return size * math.cos(self.azimuth_rad), size * math.sin(self.azimuth_rad)


@dataclass(frozen=True, eq=False, slots=True)
class PupilView:
    """The pupil from the window's centre, on (nodes, nodes) direction cosines; float64.

    x_um, y_um: where the rays leave the lens. weight: share of each cell inside the
    aperture, and the solid angle.
    node: index of the nearest node of the pupil, row * nodes + column; None where they
    are the same, on the axis.
    lens_rad: hyperbolic phase of the focus and path to the window's centre, less that
    of the lens' centre.
    """

    x_um: Tensor
    y_um: Tensor
    weight: Tensor
    node: Tensor | None
    lens_rad: Tensor


def node_cosines(pupil: Pupil) -> Tensor:
    """(nodes,) direction cosines of the nodes from their middle.

    Args:
        pupil: sampled pupil of the lens.
    """
    return (torch.arange(pupil.nodes, dtype=torch.float64) - (pupil.nodes - 1) / 2) * (
        2 * pupil.edge / pupil.nodes
    )


@functools.lru_cache(maxsize=16)
def kernel(pupil: Pupil, sample_um: float, samples: int) -> Tensor:
    """(samples, nodes) Fourier transform from direction cosines to the samples of a
    window.

    Args:
        pupil: sampled pupil of the lens.
        sample_um: step of the samples, um.
    """
    position = (
        torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2
    ) * sample_um
    k = 2 * math.pi / pupil.wavelength_um
    return torch.exp(-1j * k * position[:, None] * node_cosines(pupil)).to(
        torch.complex64
    )


def coordinates(pupil: Pupil) -> tuple[Tensor, Tensor]:
    """(x, y) on the lens, um, of the pupil's nodes: two (nodes, nodes) arrays."""
    q = node_cosines(pupil)
    qy, qx = torch.meshgrid(q, q, indexing="ij")
    stretch = pupil.sensor_distance_um / torch.sqrt((1 - qx**2 - qy**2).clamp_min(1e-3))
    return qx * stretch, qy * stretch


@functools.lru_cache(maxsize=16)
def radius(pupil: Pupil) -> Tensor:
    """(nodes, nodes) distance of the nodes from the axis on the lens, um.

    Args:
        pupil: sampled pupil of the lens.
    """
    return torch.hypot(*coordinates(pupil))


def amplitude(pupil: Pupil) -> Tensor:
    """(nodes, nodes) weight of the nodes: the share of the rim cells inside the
    aperture, and the solid angle.

    Args:
        pupil: sampled pupil of the lens.
    """
    q = node_cosines(pupil)
    q2 = q[:, None] ** 2 + q**2
    step = 2 * pupil.edge / pupil.nodes
    inside = ((pupil.edge - torch.sqrt(q2)) / step + 0.5).clamp(0, 1)
    return inside / (1 - q2).clamp_min(0.5)


def aperture_light(pupil: Pupil, window_um: float) -> float:
    """Σ |U|² of the light on the aperture, by which PSFs are divided, in nodes.

    It is the area of the aperture in nodes, less the part that a window lacks. A node
    across the rim has the mean field of its width, which dims its light at X by
    sinc²(X / period). A sharp rim at p sends 4√2 / (π² k p X) of the light beyond ±X.
    The window thus lacks ∫ (1 - sinc²) of that, here to second order.

    Args:
        pupil: sampled pupil of the lens.
        window_um: side of the window, um.
    """
    step = 2 * pupil.edge / pupil.nodes
    k = 2 * math.pi / pupil.wavelength_um
    nodes = math.pi * (pupil.radius_um / pupil.sensor_distance_um / step) ** 2
    dimmed = 2 * math.sqrt(2) * window_um / (3 * k * pupil.edge * pupil.period_um**2)
    return nodes * (1 - dimmed)


def psf(
    phase_rad: Tensor,
    pupil: Pupil,
    *,
    depths_um: Tensor,
    focus_um: float,
    fields: Sequence[Field] | None = None,
    sample_um: float = 0.75,
    samples: int = 192,
) -> Tensor:
    """Intensity around the chief ray of point sources behind a lens that focuses
    ``focus_um`` and adds ``phase_rad``.

    Args:
        phase_rad: (nodes, nodes) on the pupil's nodes, differentiable.
        depths_um: (images,) of the sources in front of the lens, along the axis.
        focus_um: source distance that the hyperbolic part of the lens images onto the
            sensor.
        fields: (images,) directions of the sources; all on the axis without.
        sample_um: of the window, at most half of ``pupil.field_step_um``.

    Returns:
        (images, samples, samples): share of the light through the aperture on each
        sample; float32.

    Raises:
        PropagationError: the window is wider than the period of the nodes.
    """
    if samples * sample_um > pupil.period_um * (1 + 1e-9):
        raise PropagationError(
            f"window of {samples * sample_um:.0f} um is wider than the period {pupil.period_um:.0f} um; "
            "raise Pupil.nodes or take a smaller window"
        )
    to_window = kernel(pupil, sample_um, samples)
    k = 2 * math.pi / pupil.wavelength_um
    added_phase = wrap_phase(phase_rad).float()
    angles, weights = [], []
    for depth, field in zip(
        depths_um.tolist(), fields or [Field()] * len(depths_um), strict=True
    ):
        view = view_pupil(pupil, field, float(focus_um))
        path = source_path(view.x_um, view.y_um, field.tangents, 1 / depth)
        lens_phase = wrap_phase(view.lens_rad + k * path).float()
        angles.append(
            lens_phase
            + (added_phase if view.node is None else added_phase.reshape(-1)[view.node])
        )
        weights.append(view.weight.float())
    image = to_window @ (
        torch.polar(torch.stack(weights), torch.stack(angles)) @ to_window.mT
    )
    share = (sample_um / pupil.period_um) ** 2 / aperture_light(
        pupil, samples * sample_um
    )  # Parseval over a period
    return (image.real**2 + image.imag**2) * share


@functools.lru_cache(maxsize=64)
def view_pupil(pupil: Pupil, field: Field, focus_um: float) -> PupilView:
    """The pupil as viewed from where the chief ray of a field meets the sensor.

    Nodes are at equal steps of the direction cosines from that place, centred on those
    that the aperture fills. On the axis they are the pupil's own nodes.

    Args:
        pupil: sampled aperture of the lens.
        field: direction of the source.
        focus_um: source distance that the lens images onto the sensor, um.
    """
    d = pupil.sensor_distance_um
    k = 2 * math.pi / pupil.wavelength_um
    if not field.angle_rad:
        x, y = coordinates(pupil)
        return PupilView(
            x,
            y,
            amplitude(pupil),
            None,
            -k * axial_path_difference(x**2 + y**2, focus_um),
        )
    cx, cy = (d * t for t in field.tangents)
    air = Layers().after(d, pupil.wavelength_um)
    centre = torch.tensor((cx, cy), dtype=torch.float64)
    mx, my = (-middle_direction(air, pupil.radius_um, centre)).tolist()
    qy, qx = torch.meshgrid(
        node_cosines(pupil) + my, node_cosines(pupil) + mx, indexing="ij"
    )
    cosine2 = (1 - qx**2 - qy**2).clamp_min(1e-3)
    x = cx + qx * d / torch.sqrt(cosine2)
    y = cy + qy * d / torch.sqrt(cosine2)
    r2 = x**2 + y**2
    n = pupil.nodes
    # of the nodes, on the lens, across the line of sight
    step = 2 * pupil.edge / n * d / torch.sqrt(cosine2)
    weight = ((pupil.radius_um - torch.sqrt(r2)) / step + 0.5).clamp(0, 1) / cosine2
    path = torch.sqrt(r2 + d**2)
    row, column = (
        torch.round(a / path * n / (2 * pupil.edge) + (n - 1) / 2)
        .clamp(0, n - 1)
        .long()
        for a in (y, x)
    )
    focus = axial_path_difference(r2, d) + axial_path_difference(r2, focus_um)
    return PupilView(
        x, y, weight, row * n + column, k * (sensor_path(x, y, (cx, cy), d) - focus)
    )


def wrap_phase(phase_rad: Tensor) -> Tensor:
    """Phase less whole turns, -π to π rad, with the gradient of the phase.

    Args:
        phase_rad: phase, rad.
    """
    return phase_rad - 2 * math.pi * torch.round(phase_rad.detach() / (2 * math.pi))
