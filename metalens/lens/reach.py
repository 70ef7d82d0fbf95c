"""How far a lens reaches: the range of depths over which its image blurs, and how wide it does, from its own focus."""

import math

from metalens.lens.record import Lens

DEFOCUS_WAVES = 1.75  # at the rim, at both ends of the range: the blur is then 3.5 wavelength / NA in radius


def defocus_per_um(lens: Lens, depth_um: float) -> float:
    """1 / z of a source less that of best focus, 1/um, films in front taken as the air that bends light as much."""
    return 1 / _reduced(lens, depth_um) - 1 / _reduced(lens, lens.source_distance_um)


def blur_um(lens: Lens, depth_um: float) -> float:
    """Radius of the paraxial blur on the sensor of a source on the axis: R d |1/z - 1/z0|."""
    return lens.diameters.radius_um * sensor_reach_um(lens) * abs(defocus_per_um(lens, depth_um))


def sensor_reach_um(lens: Lens) -> float:
    """Distance in air that bends paraxial light as much as the media between pillars and sensor."""
    return lens.layers.after(lens.sensor_distance_um, lens.wavelength_um).reduced_um


def diffraction_um(lens: Lens) -> float:
    """Wavelength over the paraxial numerical aperture of the image side, um."""
    return lens.wavelength_um * sensor_reach_um(lens) / max(lens.diameters.radius_um, lens.diameters.pitch_um)


def depth_range_um(lens: Lens, *, digits: int = 2) -> tuple[float, float]:
    """(near, far) depths at which the rim is 1.75 waves out of focus, R² |1/z - 1/z0| / (2 wavelength).

    Where no depth is that far out of focus, far is ten times near; near is at least the lens's diameter, or the
    depth of focus itself. Rounded to ``digits`` digits, and beyond the films in front.

    A lens of 1 mm and 850 nm that is made for 20 mm: 16 and 26 mm.
    """
    radius = max(lens.diameters.radius_um, lens.diameters.pitch_um)
    most = 2 * DEFOCUS_WAVES * lens.wavelength_um / radius**2
    focus, films = _reduced(lens, lens.source_distance_um), _thinner(lens)
    near = max(1 / (1 / focus + most), min(2 * radius, focus))
    far = 1 / max(1 / focus - most, 0.1 / near)
    thick = sum(film.thickness_um for film in lens.layers.front)
    return max(_rounded(near + films, digits), thick), _rounded(far + films, digits)


def _reduced(lens: Lens, depth_um: float) -> float:
    return depth_um - _thinner(lens)


def _thinner(lens: Lens) -> float:
    """What films in front take off the depth: sum of t (1 - 1/n)."""
    before = lens.layers.before(math.inf, lens.wavelength_um)
    return sum(t * (1 - 1 / n) for n, t in zip(before.index[1:], before.thickness_um[1:], strict=True))


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")
