"""How far a lens reaches: the range of depths over which its image blurs, and how wide
it does, from its own focus.
"""

import math
from dataclasses import dataclass, field

from metalens.lens.record import Lens
from metalens.optics.layers import Layers


@dataclass(frozen=True, slots=True)
class ApertureSummary:
    """What of a lens decides how far it reaches: for a lens that is yet to be made."""

    radius_um: float
    wavelength_um: float
    sensor_distance_um: float
    source_distance_um: float = math.inf
    layers: Layers = field(default_factory=Layers)


def defocus_per_um(lens: Lens | ApertureSummary, depth_um: float) -> float:
    """1 / z of a source less that of best focus, 1/um, films in front taken as the air
    that bends light as much.

    Args:
        lens: the lens.
        depth_um: distance of a source in front of the lens, um.
    """
    return 1 / _reduced(lens, depth_um) - 1 / _reduced(lens, lens.source_distance_um)


def blur_um(lens: Lens | ApertureSummary, depth_um: float) -> float:
    """Radius of the paraxial blur on the sensor of a source on the axis: R d |1/z -
    1/z0|.

    Args:
        lens: the lens.
        depth_um: distance of a source in front of the lens, um.
    """
    return (
        _illuminated_um(lens, _aperture(lens).radius_um)
        * sensor_reach_um(lens)
        * abs(defocus_per_um(lens, depth_um))
    )


def sensor_reach_um(lens: Lens | ApertureSummary) -> float:
    """Distance in air that bends paraxial light as much as the media between pillars
    and sensor.

    Args:
        lens: the lens.
    """
    return lens.layers.after(lens.sensor_distance_um, lens.wavelength_um).reduced_um


def diffraction_um(lens: Lens | ApertureSummary) -> float:
    """Wavelength over the paraxial numerical aperture of the image side, um.

    Args:
        lens: the lens.
    """
    return lens.wavelength_um * sensor_reach_um(lens) / _widest(lens)


def window_um(
    lens: Lens | ApertureSummary, depths_um: tuple[float, ...], *, airy: float
) -> float:
    """Width of a window: ``airy`` wavelength / NA, or 8 radii of the blur at the worst
    of these depths; 3 digits.

    Args:
        lens: the lens.
        depths_um: distances of sources, um.
    """
    blur = max(blur_um(lens, depth) for depth in depths_um)
    return _rounded(max(airy * diffraction_um(lens), 8 * blur), 3)


def disc_um(lens: Lens | ApertureSummary) -> float:
    """Radius of a defocused spot at which its depth can be resolved: 5.3 wavelength /
    NA, 2 digits.

    Args:
        lens: the lens.
    """
    return _rounded(5.3 * diffraction_um(lens), 2)


def pixel_um(lens: Lens | ApertureSummary) -> float:
    """Pixel pitch that samples most of the information of a spot: 0.88 wavelength / NA,
    2 digits.

    Args:
        lens: the lens.
    """
    return _rounded(0.88 * diffraction_um(lens), 2)


def depth_step_um(lens: Lens | ApertureSummary, depth_um: float) -> float:
    """Step of depth that moves the rim by 0.115 waves against the middle: 0.23
    wavelength z² / R², 2 digits.

    Short enough that the image's change over it is a derivative; never above a fiftieth
    of the depth.

    Args:
        lens: the lens.
        depth_um: distance of the source, um.
    """
    step = 0.23 * lens.wavelength_um * (_reduced(lens, depth_um) / _widest(lens)) ** 2
    return _rounded(min(step, 0.02 * depth_um), 2)


def sample_um(lens: Lens | ApertureSummary, pixel_um: float) -> float:
    """Sampling of intensities: 0.86 of wavelength / 4 sin(rim), at most a quarter of a
    pixel; 2 digits.

    Args:
        lens: the lens.
        pixel_um: pitch of the pixels, um.
    """
    sine = math.sin(math.atan(_widest(lens) / sensor_reach_um(lens)))
    return _rounded(min(0.86 * lens.wavelength_um / (4 * sine), pixel_um / 4), 2)


def depth_range_um(
    lens: Lens | ApertureSummary, *, digits: int = 2
) -> tuple[float, float]:
    """(near, far) depths at which the rim is 1.75 waves out of focus, R² |1/z - 1/z0| /
    (2 wavelength).

    Where no depth is that far out of focus, far is ten times near; near is at least the
    lens's diameter, or the depth of focus itself. Rounded to ``digits`` digits, and
    beyond the films in front.

    A lens of 1 mm and 850 nm that is made for 20 mm: 16 and 26 mm.
    """
    radius = _widest(lens)
    most = 3.5 * lens.wavelength_um / radius**2
    focus = _reduced(lens, lens.source_distance_um)
    films = _thinner(lens)
    near = max(1 / (1 / focus + most), min(2 * radius, focus))
    far = 1 / max(1 / focus - most, 0.1 / near)
    thick = sum(film.thickness_um for film in lens.layers.front)
    return max(_rounded(near + films, digits), thick), _rounded(far + films, digits)


def _aperture(lens: Lens | ApertureSummary) -> ApertureSummary:
    if isinstance(lens, ApertureSummary):
        return lens
    distances = lens.sensor_distance_um, lens.source_distance_um
    return ApertureSummary(
        lens.diameters.radius_um, lens.wavelength_um, *distances, lens.layers
    )


def _widest(lens: Lens | ApertureSummary) -> float:
    """Radius, at least one pitch, of the illuminated part."""
    radius = (
        lens.radius_um
        if isinstance(lens, ApertureSummary)
        else max(lens.diameters.radius_um, lens.diameters.pitch_um)
    )
    return _illuminated_um(lens, radius)


def _illuminated_um(lens: Lens | ApertureSummary, radius_um: float) -> float:
    return min(
        radius_um, lens.layers.footprint_um(lens.source_distance_um, lens.wavelength_um)
    )


def _reduced(lens: Lens | ApertureSummary, depth_um: float) -> float:
    return depth_um - _thinner(lens)


def _thinner(lens: Lens | ApertureSummary) -> float:
    """What films in front take off the depth: sum of t (1 - 1/n)."""
    before = lens.layers.before(math.inf, lens.wavelength_um)
    return sum(
        t * (1 - 1 / n)
        for n, t in zip(before.index[1:], before.thickness_um[1:], strict=True)
    )


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")
