"""Both polarisations of a field point, as a few pupils whose images add.

What a pixel counts is the power through its face, S_z = Re(Ex Hy* - Ey Hx*), whatever
the slope of the rays. Of rays
that leave a lens in directions b with the fields E and H = b x E, two polarisations
together,

    S_z = Σ_c s_c |∫ f_c(p) S(p) exp(ik p·δ) d²p|²    S: the scalar; f_c: (Ex ± Hy)/2, (Ey ± Hx)/2; s_c = ±1
        = Σ_c s_c |∫ g_c(p) S(p) exp(ik p·δ) d²p|²    g_c: principal axes of Σ_c s_c f_c(p) f_c(p'), light as weight

Of the eight g_c four are not 0, and the first is nearly 1: on the axis S_z is I0² - I2²
of Richards and Wolf (1959),
with (1 + cos θ)/(2 √cos θ) = 1 + O(θ⁴) in I0. So |S|² of the scalar, whose rays carry
their power, is the flux to 7e-5
of a PSF at NA 0.24 and 4e-3 at NA 0.6. |Ex|² + |Ey|² + |Ez|², six f_c with s_c = 1, weighs every ray by 1/cos θ: it
differs from the flux by 1e-2 and 0.1 there, and by more from the side. A field point
keeps the light that its pupil
passes; fields are how it lies on the window.
"""

import torch
from torch import Tensor

from metalens.image.rays import Rays
from metalens.psf import VectorPupil, beyond_faces, of_flux, transmitted_polarization

OF_FLUX, OF_ENERGY = 4, 6  # components that leave nothing out
STEEPEST = (
    1e-3  # cos² in the rarest medium of nodes beyond the rim, which have no light
)


def factors(
    seen: Rays, tangents: Tensor, order: tuple[float, ...], *, flux: bool
) -> VectorPupil:
    """Both polarisations on the nodes, float64: of the flux through the sensor's plane
    (8), or of |E|² (6 as
    :func:`metalens.psf.transmitted_polarization`); squares with their signs add up to
    2, and to 2 / cos
    θ.

    Args:
        tangents: slopes (x, y) of the chief ray in air. order: indices of the media
            from the pillars to the sensor.
    """
    q, p = torch.meshgrid(
        seen.aside + seen.middle[1], seen.aside + seen.middle[0], indexing="ij"
    )
    room = (1 - STEEPEST) * min(order) ** 2 / (p * p + q * q).clamp_min(STEEPEST)
    p, q = (side * torch.sqrt(room.clamp_max(1)) for side in (p, q))
    first, b = (_directions(p / n, q / n) for n in (order[0], order[-1]))
    slope = torch.cat([tangents, tangents.new_ones(1)])
    electric = beyond_faces(
        transmitted_polarization(slope / slope.norm(), first), first, order
    )
    return of_flux(electric, b) if flux else VectorPupil(electric, (1.0,) * OF_ENERGY)


def _directions(p: Tensor, q: Tensor) -> Tensor:
    """(3, y, x) unit vectors towards the sensor from their parts along x and y."""
    return torch.stack([p, q, torch.sqrt(1 - p * p - q * q)])
