"""Whether a phase brings light together at all: where the rays of the design source meet the sensor."""

import numpy as np

from metalens.design.profiles import Focus
from metalens.design.sites import PhaseOf
from metalens.lens import media

RAYS = 25  # along an axis
SPREAD = 0.2  # rms distance of the rays on the sensor, of that on the lens, up to which they are said to meet
DARK = 1e-3  # of the peak of a perfect lens, below which the place where they meet is dark: a vortex


def focuses(phase: PhaseOf, focus: Focus, *, radius_um: float, pitch_um: float) -> bool:
    """Whether rays from the design source meet in one bright spot of the sensor.

    The slope of the phase is its difference over one pitch, wrapped; an axicon, a hologram and a plain vortex scatter
    their rays, a vortex in a focus leaves the middle of its ring dark.
    """
    axis = (np.arange(RAYS) - (RAYS - 1) / 2) * (2 * radius_um / RAYS)
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) <= radius_um - pitch_um
    if inside.sum() < RAYS:
        return True  # a few pillars: every phase is a lens
    half, k = pitch_um / 2, 2 * np.pi / focus.wavelength_um
    steps = [phase(axis + half, axis) - phase(axis - half, axis), phase(axis, axis + half) - phase(axis, axis - half)]
    slope = [((s + np.pi) % (2 * np.pi) - np.pi) / pitch_um / k for s in steps]
    away = np.sqrt(x**2 + y**2 + focus.source_distance_um**2)
    px, py = slope[0] + x / away, slope[1] + y / away
    after = focus.layers.after(focus.sensor_distance_um, focus.wavelength_um)
    w = px**2 + py**2
    if (w[inside] >= after.layers[0][0] ** 2).mean() > SPREAD:
        return False
    inside &= w < 0.999 * after.layers[0][0] ** 2
    bend = media.bend(after.layers, np.where(inside, w, 0.0))
    meets = [(a + bend * p)[inside] for a, p in ((x, px), (y, py))]
    if np.hypot(*(m.std() for m in meets)) > SPREAD * np.hypot(x[inside].std(), y[inside].std()):
        return False
    lit = np.exp(1j * (phase(axis, axis) + k * focus.path_um(x**2 + y**2)))[np.hypot(x, y) <= radius_um]
    centred = np.hypot(*(m.mean() for m in meets)) * radius_um * k / focus.sensor_distance_um < 1
    return not centred or abs(lit.mean()) ** 2 > DARK
