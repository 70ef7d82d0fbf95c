"""Both polarisations of a field point, as a few pupils whose images add."""

import torch
from torch import Tensor

from metalens.image.rays import Rays
from metalens.psf import VectorPupil, beyond_faces, of_flux, transmitted_polarization

OF_FLUX, OF_ENERGY = 4, 6  # components that leave nothing out


def polarisation_factors(
    bundle: Rays, tangents: Tensor, order: tuple[float, ...], *, flux: bool
) -> VectorPupil:
    """Factors of both polarisations on the pupil's nodes, (components, nodes, nodes).

    The flux through the sensor's plane has 8, whose squares with their signs add up to
    2. |E|² has 6 (:func:`metalens.psf.transmitted_polarization`), whose squares add up
    to 2 / cos θ.

    Args:
        bundle: rays of the nodes.
        tangents: (x, y) slopes of the chief ray in air.
        order: indices of the media from the pillars to the sensor.
        flux: whether the flux, else |E|².
    """
    q, p = torch.meshgrid(
        bundle.offset_p + bundle.middle[1],
        bundle.offset_p + bundle.middle[0],
        indexing="ij",
    )
    # nodes beyond the rim, which have no light, keep cos² = 1e-3 in the rarest medium
    scale2 = (1 - 1e-3) * min(order) ** 2 / (p * p + q * q).clamp_min(1e-3)
    p, q = (side * torch.sqrt(scale2.clamp_max(1)) for side in (p, q))
    first, last = (_directions(p / n, q / n) for n in (order[0], order[-1]))
    slope = torch.cat([tangents, tangents.new_ones(1)])
    electric = beyond_faces(
        transmitted_polarization(slope / slope.norm(), first), first, order
    )
    return (
        of_flux(electric, last) if flux else VectorPupil(electric, (1.0,) * OF_ENERGY)
    )


def _directions(p: Tensor, q: Tensor) -> Tensor:
    """(3, y, x) unit vectors towards the sensor from their parts along x and y."""
    return torch.stack([p, q, torch.sqrt(1 - p * p - q * q)])
