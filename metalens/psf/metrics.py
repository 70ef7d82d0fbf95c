"""What a PSF stack is worth: modulation transfer, encircled energy, width, and axial
information (paper Eq. 11).
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.errors import PropagationError
from metalens.psf.record import PsfStack

Normalisation = Literal["sum", "l2", "none"]


def mtf(stack: PsfStack, *, frequencies_per_um: Array) -> Array:
    """Modulation transfer along x and y: (…, depth, 2, frequency), 1 at frequency 0.

    |Σ PSF exp(-2πi f x)| of the PSF summed over the other axis (sagittal and tangential
    for a field along x).
    Light outside the window does not count.
    """
    psf = stack.numpy().intensity
    along_x, along_y = (
        np.exp(-2j * np.pi * np.outer(a, frequencies_per_um))
        for a in (stack.x_um, stack.y_um)
    )
    lines = psf.sum(-2) @ along_x, psf.sum(-1) @ along_y
    return np.asarray(np.abs(np.stack(lines, axis=-2)))


def encircled(stack: PsfStack, *, radii_um: Array, of_window: bool = True) -> Array:
    """Share of the light within circles about the centroid of each PSF: (…, depth,
    radius).

    Args:
        of_window: of the light in the window; else the light in um² for unit irradiance
            at the lens.

    Accuracy: samples cut by the circle count in part, by distance.
    """
    plain = stack.numpy()
    cx, cy = centroid(stack)
    dy = stack.y_um[:, None] - cy[..., None, None]
    dx = stack.x_um - cx[..., None, None]
    distance = np.hypot(dy, dx)
    flat = plain.intensity.reshape(-1, distance.shape[-2] * distance.shape[-1])
    pairs = zip(flat, distance.reshape(flat.shape), strict=True)
    found = [
        _within(light, away, np.asarray(radii_um, float), stack.step_um)
        for light, away in pairs
    ]
    out = np.reshape(found, (*plain.intensity.shape[:-2], len(radii_um)))
    return out if of_window else out * plain.energy_um2[..., None]


def _within(light: Array, distance_um: Array, radii_um: Array, step_um: float) -> Array:
    """(radius,) Σ light · clip((radius - distance) / step + 1/2, 0, 1), by sums along
    the distance.
    """
    order = np.argsort(distance_um)
    away, power = distance_um[order], light[order].astype(float)
    sums = (
        np.concatenate([[0.0], np.cumsum(power)]),
        np.concatenate([[0.0], np.cumsum(power * away)]),
    )
    whole, part = (
        np.searchsorted(away, radii_um + sign * step_um / 2) for sign in (-1, 1)
    )
    edge = ((radii_um / step_um + 0.5) * (sums[0][part] - sums[0][whole])) - (
        sums[1][part] - sums[1][whole]
    ) / step_um
    return np.asarray(sums[0][whole] + edge)


def blur_um(light: Array, step_um: float, held: Array | float = 1.0) -> Array:
    """(…,) radius of the even disc whose light lies as far apart as that of (…, y, x):
    by quarters along x and y.

    The middle half of a disc of radius b lies within 0.404 b of its middle along an
    axis.

    Args:
        held: (…,) share of the whole light that (…, y, x) is. What lies outside counts
            on either side; the disc is at
            most one as bright as the window on the mean, √(area / π held), and that
            where less than half is held.
    """
    held, found = np.clip(held, 1e-6, 1.0), []
    for axis in (-1, -2):
        total = np.cumsum(light.sum(axis), -1)
        parts = [np.clip(0.5 + side / held, 0, 1)[..., None] for side in (-0.25, 0.25)]
        quarters = [(total < part * total[..., -1:]).sum(-1) for part in parts]
        found.append((quarters[1] - quarters[0] + 1) / 2 * step_um)
    even = step_um * np.sqrt(light.shape[-1] * light.shape[-2] / (math.pi * held))
    apart = np.hypot(*found) / (0.404 * math.sqrt(2))
    return np.asarray(np.where(held < 0.5, even, np.minimum(apart, even)))


def centroid(stack: PsfStack) -> tuple[Array, Array]:
    """(x, y) centre of the light from the window centre, um; each (…, depth)."""
    psf = stack.numpy().intensity
    return (psf.sum(-2) * stack.x_um).sum(-1), (psf.sum(-1) * stack.y_um).sum(-1)


def axial_information(
    stack: PsfStack, *, normalisation: Normalisation
) -> tuple[Array, Array]:
    """I(z) of Eq. 11, per mm², between neighbouring depths: (middle depths in um, (…,
    depth - 1)).

    I(z) = Σ ((P(z + Δz) - P(z)) / Δz)² with the PSFs normalised by their sum, by their
    Euclidean norm, or weighted
    with their energy ("none"). The normalisation decides which lens wins: always name
    it. The value belongs to the
    stack's own samples at one position; for pixels use
    :func:`metalens.psf.pixels.on_pixels` first and average over
    shifts (:func:`metalens.fisher.axial_information` does).

    Raises:
        PropagationError: fewer than two depths, or depths that repeat or are infinite.
    """
    plain = stack.numpy()
    steps = np.diff(plain.depths_um)
    if steps.size == 0 or not (np.isfinite(steps) & (steps != 0)).all():
        raise PropagationError(
            "axial information needs at least two different finite depths"
        )
    psf = plain.intensity
    if normalisation == "l2":
        psf = psf / np.sqrt((psf**2).sum((-1, -2), keepdims=True))
    elif normalisation == "none":
        psf = psf * plain.energy_um2[..., None, None]
    slope = np.diff(psf, axis=-3) / (steps[:, None, None] * 1e-3)
    return (plain.depths_um[1:] + plain.depths_um[:-1]) / 2, np.asarray(
        (slope**2).sum((-1, -2))
    )


def information_by_name(
    stack: PsfStack, names: Sequence[Normalisation] = ("sum", "l2")
) -> dict[str, Array]:
    """I(z) under several normalisations, by name."""
    return {name: axial_information(stack, normalisation=name)[1] for name in names}
