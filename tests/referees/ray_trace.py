"""Rays through a lens of known phase, one at a time: Snell by bisection, the grating
equation by its own slope.
"""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Lens:
    """φ = -k (√(ρ² + d²) + √(ρ² + z²)), ρ from the vertex; z inf for a lens made for
    collimated light.

    front, behind: (index, thickness) in the order of the light, air or cover left out.
    stop: (radius, distance, centre).
    """

    sensor_um: float
    depth_um: float
    vertex: tuple[float, float] = (0.0, 0.0)
    front: tuple[tuple[float, float], ...] = ()
    behind: tuple[tuple[float, float], ...] = ()
    stop: tuple[float, float, tuple[float, float]] | None = None

    def slope(self, x):
        """(2,) grad φ / k."""
        away = np.asarray(x) - self.vertex
        rho2 = away @ away
        far = (
            0.0 if math.isinf(self.depth_um) else 1 / math.sqrt(rho2 + self.depth_um**2)
        )
        return -away * (1 / math.sqrt(rho2 + self.sensor_um**2) + far)

    def source(self, angle_deg, depth_um):
        """(2,) place of the source whose ray to the middle of the lens has this angle
        along x in air.
        """
        sine = math.sin(math.radians(angle_deg))
        return np.array([-walk(self.before(depth_um), sine), 0.0])

    def before(self, depth_um):
        """Media from source to pillars."""
        return [(1.0, depth_um - sum(t for _, t in self.front)), *self.front]

    def arriving(self, x, angle_deg, depth_um):
        """(2,) n sin θ of the source's light at x."""
        if math.isinf(depth_um):
            return np.array([math.sin(math.radians(angle_deg)), 0.0])
        return heading(
            self.before(depth_um), np.asarray(x) - self.source(angle_deg, depth_um)
        )

    def to_stop(self):
        """Media between stop and pillars."""
        left, out = self.stop[1], []
        for n, t in reversed(self.front):
            out.append((n, min(t, left)))
            left -= out[-1][1]
        return [*out, (1.0, left)]

    def crossing(self, x, angle_deg, depth_um):
        """(2,) where the ray to x goes through the plane of the stop."""
        p = self.arriving(x, angle_deg, depth_um)
        size = math.hypot(*p)
        return np.asarray(x) - (walk(self.to_stop(), size) * p / size if size else 0.0)

    def middle(self, angle_deg, depth_um):
        """(2,) where the ray through the middle of the stop meets the pillars, by
        repeated correction.
        """
        x = np.zeros(2)
        for _ in range(60 if self.stop else 0):
            x = x - self.crossing(x, angle_deg, depth_um) + self.stop[2]
        return x

    def lands(self, x, angle_deg, depth_um, sensor_um=None):
        """(2,) where the ray through x meets a sensor; the gap before the films changes
        with its distance.
        """
        p = self.arriving(x, angle_deg, depth_um) + self.slope(x)
        gap = (sensor_um or self.sensor_um) - sum(t for _, t in self.behind)
        size = math.hypot(*p)
        return np.asarray(x) + (
            walk([(1.0, gap), *self.behind], size) * p / size if size else 0.0
        )


def walk(media, sine):
    """Lateral way of a ray with n sin θ."""
    return sum(t * math.tan(math.asin(sine / n)) for n, t in media)


def heading(media, away):
    """(2,) n sin θ of the ray that goes so far aside."""
    reach = math.hypot(*away)
    if reach == 0:
        return np.zeros(2)
    low, high = 0.0, min(n for n, t in media if t > 0)
    for _ in range(200):
        half = (low + high) / 2
        low, high = (half, high) if walk(media, half) < reach else (low, half)
    return low * np.asarray(away) / reach
