"""Exposure of a pillar's rim by the discs beside it, through a Gaussian as narrow as they are: exact, from a table.

The mean over the rim of one disc of what another exposes (non-central chi-square of two degrees) depends on the two
radii and the gap between them; its logarithm is smooth, and interpolated in all three.
"""

from dataclasses import dataclass

import numpy as np

from layout.certify.background import Bins
from layout.process import compiled
from metalens.ground.arrays import Array

WIDER = 1.5  # diameters: in a Gaussian beyond, a disc is its second moment
_FAR = 6.0  # ranges: a wider gap lets nothing over
_RADII, _GAPS, _RIM = 6, 61, 96
_NOTHING = 1e-30


def reach_um(range_um: float, widest_um: float) -> float:
    """Distance of centres at which two discs no longer count."""
    return widest_um + _FAR * range_um


@dataclass(frozen=True, eq=False, slots=True)
class Pairs:
    """log_mean: (radii, radii, gaps) mean over the rim of the first by the second of unit dose; radius from ``least``
    in steps, gap from 0 in steps (nearer ones as those that touch).
    """

    range_um: float
    least_um: float
    step_um: float
    gap_um: float
    log_mean: Array

    @classmethod
    def of(cls, radius_um: Array, range_um: float) -> "Pairs":
        """The table for pillars of these radii."""
        from scipy.special import chndtr

        least, most = float(radius_um.min()), float(radius_um.max())
        radii = np.linspace(least, max(most, least * (1 + 1e-6)), _RADII)
        gaps = np.linspace(0, _FAR * range_um, _GAPS)
        seen, other, gap = np.meshgrid(radii, radii, gaps, indexing="ij")
        angle = 2 * np.pi * (np.arange(_RIM) + 0.5) / _RIM
        apart = seen + other + gap
        square = apart[..., None] ** 2 + seen[..., None] ** 2 - 2 * (apart * seen)[..., None] * np.cos(angle)
        mean = chndtr(2 * (other[..., None] / range_um) ** 2, 2.0, 2 * square / range_um**2).mean(-1)
        log = np.log(np.maximum(np.nan_to_num(mean), _NOTHING))
        return cls(range_um, least, float(radii[1] - radii[0]), float(gaps[1]), log)

    def __call__(self, at: tuple[Array, Array, Array, Array], around: tuple[Array, Array, Array, Array]) -> Array:
        """(n,) exposure of each rim; x, y, mass and radius of those looked at, and of all near them, themselves too."""
        bins = Bins.of(around[0], around[1], reach_um(self.range_um, 2 * float(around[3].max())))
        x, y, mass, radius = (v[bins.order] for v in around)
        place = bins.columns, bins.left_um, bins.bottom_um, bins.side_um
        out = np.zeros(len(at[0]))
        steps = self.least_um, self.step_um, self.gap_um
        _sum(*at, x, y, mass, radius, bins.starts, *place, self.log_mean, *steps, out)
        return out


@compiled
def _mean(log_mean: Array, one: float, two: float, gap: float) -> float:
    """Trilinear in steps of radius, radius and gap; 0 beyond the last gap."""
    i, j = min(max(int(one), 0), log_mean.shape[0] - 2), min(max(int(two), 0), log_mean.shape[1] - 2)
    k = int(gap)
    if k >= log_mean.shape[2] - 1:
        return 0.0
    a, b, c = one - i, two - j, gap - k
    low = (1 - a) * ((1 - b) * log_mean[i, j, k] + b * log_mean[i, j + 1, k]) + a * (
        (1 - b) * log_mean[i + 1, j, k] + b * log_mean[i + 1, j + 1, k]
    )
    high = (1 - a) * ((1 - b) * log_mean[i, j, k + 1] + b * log_mean[i, j + 1, k + 1]) + a * (
        (1 - b) * log_mean[i + 1, j, k + 1] + b * log_mean[i + 1, j + 1, k + 1]
    )
    return float(np.exp((1 - c) * low + c * high))


@compiled
def _sum(
    x: Array,
    y: Array,
    mass: Array,
    radius: Array,
    near_x: Array,
    near_y: Array,
    near_mass: Array,
    near_radius: Array,
    starts: Array,
    columns: int,
    left: float,
    bottom: float,
    side: float,
    log_mean: Array,
    least: float,
    step: float,
    gap_step: float,
    out: Array,
) -> None:
    rows = (starts.shape[0] - 1) // columns
    for n in range(x.shape[0]):
        row, column = int((y[n] - bottom) // side), int((x[n] - left) // side)
        one = (radius[n] - least) / step
        total = -mass[n] / (np.pi * radius[n] ** 2) * _mean(log_mean, one, one, 0.0)  # itself, which is among them
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                for k in range(starts[r * columns + c], starts[r * columns + c + 1]):
                    gap = np.hypot(near_x[k] - x[n], near_y[k] - y[n]) - radius[n] - near_radius[k]
                    dose = near_mass[k] / (np.pi * near_radius[k] ** 2)
                    total += dose * _mean(log_mean, one, (near_radius[k] - least) / step, max(gap, 0.0) / gap_step)
        out[n] = total
