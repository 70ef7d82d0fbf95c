"""How far a lens reaches: the range of depths over which its image blurs, and how wide
it does, from its own focus.
"""

import math
from dataclasses import dataclass, field

from metalens.lens.record import Lens
from metalens.optics.layers import Layers


@dataclass(frozen=True, slots=True)
class ApertureSummary:
    """What determines the depth range of a lens; for one that is not designed yet."""

    radius_um: float
    wavelength_um: float
    sensor_distance_um: float
    source_distance_um: float = math.inf
    layers: Layers = field(default_factory=Layers)


def defocus_per_um(lens: Lens | ApertureSummary, depth_um: float) -> float:
    """Defocus 1/z - 1/z0 of a source against best focus, 1/um, with films in front
    replaced by the air that bends light as much.

    Args:
        lens: the lens.
        depth_um: distance of a source in front of the lens, um.
    """
    return 1 / _reduced(lens, depth_um) - 1 / _reduced(lens, lens.source_distance_um)


def blur_um(lens: Lens | ApertureSummary, depth_um: float) -> float:
    """Radius of the paraxial blur on the sensor of a source on the axis: R d |1/z -
    1/z0|, um.

    Args:
        lens: the lens.
        depth_um: distance of a source in front of the lens, um.
    """
    defocus = abs(defocus_per_um(lens, depth_um))
    return _illuminated_radius(lens) * sensor_reach_um(lens) * defocus


def sensor_reach_um(lens: Lens | ApertureSummary) -> float:
    """Reduced distance from pillars to sensor, um: the air that bends paraxial light as
    much as the media between them.

    Args:
        lens: the lens.
    """
    return lens.layers.after(lens.sensor_distance_um, lens.wavelength_um).reduced_um


def diffraction_um(lens: Lens | ApertureSummary) -> float:
    """Diffraction length wavelength / NA, with the paraxial numerical aperture of the
    image side, um.

    Args:
        lens: the lens.
    """
    return lens.wavelength_um * sensor_reach_um(lens) / _illuminated_radius(lens)


def window_um(
    lens: Lens | ApertureSummary, depths_um: tuple[float, ...], *, airy: float
) -> float:
    """Width of an image window: ``airy`` wavelength / NA, or 8 radii of the blur at the
    worst depth, um; 3 digits.

    Args:
        lens: the lens.
        depths_um: distances of sources, um.
        airy: least width in units of wavelength / NA.
    """
    blur = max(blur_um(lens, depth) for depth in depths_um)
    return _rounded(max(airy * diffraction_um(lens), 8 * blur), 3)


def disc_um(lens: Lens | ApertureSummary) -> float:
    """Radius of a defocused spot whose depth can just be resolved: 5.3 wavelength / NA,
    um; 2 digits.

    Args:
        lens: the lens.
    """
    return _rounded(5.3 * diffraction_um(lens), 2)


def pixel_um(lens: Lens | ApertureSummary) -> float:
    """Pixel pitch that samples most of the information of a spot: 0.88 wavelength / NA,
    um; 2 digits.

    Args:
        lens: the lens.
    """
    return _rounded(0.88 * diffraction_um(lens), 2)


def depth_step_um(lens: Lens | ApertureSummary, depth_um: float) -> float:
    """Depth step that changes the defocus at the rim by 0.115 waves: 0.23 wavelength z²
    / R², um; 2 digits.

    The image's change over it is close to a derivative. It is at most a fiftieth of the
    depth.

    Args:
        lens: the lens.
        depth_um: distance of the source, um.
    """
    step = (
        0.23
        * lens.wavelength_um
        * (_reduced(lens, depth_um) / _illuminated_radius(lens)) ** 2
    )
    return _rounded(min(step, 0.02 * depth_um), 2)


def sample_um(lens: Lens | ApertureSummary, pixel_um: float) -> float:
    """Sampling pitch of intensities: 0.86 wavelength / (4 sin(rim angle)), at most a
    quarter of a pixel, um; 2 digits.

    Args:
        lens: the lens.
        pixel_um: pitch of the pixels, um.
    """
    sine = math.sin(math.atan(_illuminated_radius(lens) / sensor_reach_um(lens)))
    return _rounded(min(0.86 * lens.wavelength_um / (4 * sine), pixel_um / 4), 2)


def depth_range_um(
    lens: Lens | ApertureSummary, *, digits: int = 2
) -> tuple[float, float]:
    """(near, far) depths at which the rim is 1.75 waves out of focus, R² |1/z - 1/z0| /
    (2 wavelength), um.

    Where no far depth is that far out of focus, it is ten times the near one. The near
    depth is at least the lens's diameter, or the depth of focus itself. Both are
    rounded to ``digits`` digits, and lie beyond the films in front.

    A lens of 1 mm and 850 nm designed for a source at 20 mm: 16 and 26 mm.

    Args:
        lens: the lens.
        digits: significant digits.
    """
    radius = _illuminated_radius(lens)
    largest_defocus = 3.5 * lens.wavelength_um / radius**2
    focus = _reduced(lens, lens.source_distance_um)
    films = _film_shortening(lens)
    near = max(1 / (1 / focus + largest_defocus), min(2 * radius, focus))
    far = 1 / max(1 / focus - largest_defocus, 0.1 / near)
    film_thickness = sum(film.thickness_um for film in lens.layers.front)
    return max(_rounded(near + films, digits), film_thickness), _rounded(
        far + films, digits
    )


def _illuminated_radius(lens: Lens | ApertureSummary) -> float:
    """Radius of the part that the light through the stop meets, at least one pitch of a
    lens, um.
    """
    footprint = lens.layers.footprint_um(lens.source_distance_um, lens.wavelength_um)
    if isinstance(lens, ApertureSummary):
        return min(lens.radius_um, footprint)
    return min(max(lens.diameters.radius_um, lens.diameters.pitch_um), footprint)


def _reduced(lens: Lens | ApertureSummary, depth_um: float) -> float:
    """Depth less the shortening by films in front, um."""
    return depth_um - _film_shortening(lens)


def _film_shortening(lens: Lens | ApertureSummary) -> float:
    """Shortening of the depth by films in front: Σ t (1 - 1/n), um."""
    before = lens.layers.before(math.inf, lens.wavelength_um)
    return sum(
        t * (1 - 1 / n)
        for n, t in zip(before.index[1:], before.thickness_um[1:], strict=True)
    )


def _rounded(value: float, digits: int) -> float:
    """Value rounded to significant digits."""
    return float(f"{value:.{digits}g}")
