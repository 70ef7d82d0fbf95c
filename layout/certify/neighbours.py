"""Exposure of a pillar's rim by the discs beside it, through a Gaussian too narrow for
pixels.

The mean over the rim of one disc of what another exposes (non-central chi-square of two
degrees) depends on the two
radii and the gap g between them. Its logarithm plus (g / range)^2 is smooth, and
interpolated in all three. Through a
Gaussian wider than the discs each counts as one more Gaussian, of the same second
moment.
"""

from dataclasses import dataclass

import numpy as np

from layout.files.squares import Squares, first_from
from layout.process import compiled
from metalens.ground.arrays import Array

WIDER = 1.5  # diameters: in a Gaussian beyond, a disc is its second moment
_FAR = 6.0  # ranges: a wider gap lets nothing over
_REACH = 4.0  # ranges at which a Gaussian disc no longer counts: exp(-16)
_RADII, _GAPS, _RIM = 12, 46, 48  # _RIM: points of half of a rim
_NOTHING = 1e-30


def reach_um(range_um: float, widest_um: float) -> float:
    """Distance of centres at which two discs no longer count."""
    return (
        _REACH * range_um
        if range_um > WIDER * widest_um
        else widest_um + _FAR * range_um
    )


@dataclass(frozen=True, eq=False, slots=True)
class Pairs:
    """log_mean: (radii, radii, gaps) of the mean over the rim of the first by the
    second, of unit exposure at its own
    centre, plus the squared gap in ranges; radius from ``least`` in steps, gap from 0
    in steps (nearer ones as those
    that touch). Empty where discs are as Gaussians. reach_um: as above.
    """

    range_um: float
    least_um: float
    step_um: float
    gap_um: float
    reach_um: float
    log_mean: Array

    @classmethod
    def of(cls, radius_um: Array, range_um: float) -> "Pairs":
        """For pillars of these radii."""
        least, most = float(radius_um.min()), float(radius_um.max())
        radii = np.linspace(least, max(most, least * (1 + 1e-6)), _RADII)
        gaps = np.linspace(0, _FAR * range_um, _GAPS)
        wide = range_um > WIDER * 2 * most
        log = np.empty((0, 0, 0)) if wide else _log_mean(radii, gaps, range_um)
        steps = float(radii[1] - radii[0]), float(gaps[1])
        return cls(range_um, least, *steps, reach_um(range_um, 2 * most), log)

    def __call__(
        self,
        at: tuple[Array, Array, Array, Array],
        around: tuple[Array, Array, Array, Array],
    ) -> Array:
        """(n,) exposure of each rim; x, y, mass and radius of those looked at, and of
        all near them, themselves too.
        """
        squares = Squares.of(around[0], around[1], self.reach_um)
        x, y, strength, radius = (v[squares.order] for v in self._strong(around))
        order, key = squares.seen_by(at[0], at[1])
        steps = self.range_um, self.least_um, self.step_um, self.gap_um
        out = np.zeros(len(order))
        near = x, y, strength, radius
        _sum(
            order,
            key,
            self._strong(at),
            near,
            squares.key,
            squares.columns,
            self.log_mean,
            steps,
            out,
        )
        return out

    def _strong(
        self, discs: tuple[Array, Array, Array, Array]
    ) -> tuple[Array, Array, Array, Array]:
        """x, y, exposure at their own centres, radius; of Gaussians the mass over pi."""
        x, y, mass, radius = discs
        if not self.log_mean.size:
            return x, y, mass / np.pi, radius
        return (
            x,
            y,
            mass / (np.pi * radius**2) * -np.expm1(-((radius / self.range_um) ** 2)),
            radius,
        )


def _log_mean(radii: Array, gaps: Array, range_um: float) -> Array:
    from scipy.special import chndtr

    seen, other, gap = np.meshgrid(radii, radii, gaps, indexing="ij")
    angle = np.pi * (np.arange(_RIM) + 0.5) / _RIM
    apart = seen + other + gap
    square = (
        apart[..., None] ** 2
        + seen[..., None] ** 2
        - 2 * (apart * seen)[..., None] * np.cos(angle)
    )
    mean = chndtr(
        2 * (other[..., None] / range_um) ** 2, 2.0, 2 * square / range_um**2
    ).mean(-1)
    log = np.log(np.maximum(np.nan_to_num(mean), _NOTHING))
    return np.asarray(
        log + (gap / range_um) ** 2 - np.log(-np.expm1(-((other / range_um) ** 2)))
    )


@compiled
def _mean(log_mean: Array, one: float, two: float, gap: float, square: float) -> float:
    """Trilinear in steps of radius, radius and gap, less the ``square`` of the gap;
    straight on beyond the table.
    """
    i, j = (
        min(max(int(one), 0), log_mean.shape[0] - 2),
        min(max(int(two), 0), log_mean.shape[1] - 2),
    )
    k = min(int(gap), log_mean.shape[2] - 2)
    a, b, c = one - i, two - j, gap - k
    low = (1 - a) * ((1 - b) * log_mean[i, j, k] + b * log_mean[i, j + 1, k]) + a * (
        (1 - b) * log_mean[i + 1, j, k] + b * log_mean[i + 1, j + 1, k]
    )
    high = (1 - a) * (
        (1 - b) * log_mean[i, j, k + 1] + b * log_mean[i, j + 1, k + 1]
    ) + a * ((1 - b) * log_mean[i + 1, j, k + 1] + b * log_mean[i + 1, j + 1, k + 1])
    return float(np.exp((1 - c) * low + c * high - square))


@compiled
def _sum(
    order: Array,
    at_key: Array,
    at: tuple[Array, Array, Array, Array],
    near: tuple[Array, Array, Array, Array],
    key: Array,
    columns: int,
    log_mean: Array,
    steps: tuple[float, float, float, float],
    out: Array,
) -> None:
    x, y, strength, radius = near
    at_x, at_y, at_strength, at_radius = at
    reach, least, step, gap_step = steps
    wide, starts = log_mean.shape[0] == 0, np.zeros(3, np.int64)
    for m in range(order.shape[0]):
        n = order[m]
        here_x, here_y, own = at_x[n], at_y[n], at_radius[n]
        one = (own - least) / step
        itself = (
            1 / (reach * reach + 1.5 * own * own)
            if wide
            else _mean(log_mean, one, one, 0.0, 0.0)
        )
        total = -at_strength[n] * itself  # which is among them
        for r in range(3):
            middle = at_key[m] + (r - 1) * columns
            starts[r] = first_from(key, middle - 1, starts[r])
            k = starts[r]
            while k < key.shape[0] and key[k] <= middle + 1:
                dx, dy, other = x[k] - here_x, y[k] - here_y, radius[k]
                away = dx * dx + dy * dy
                if wide:
                    square = reach * reach + other * other / 2 + own * own
                    if away < 16 * square:
                        total += strength[k] * np.exp(-away / square) / square
                elif away < (own + other + _FAR * reach) * (own + other + _FAR * reach):
                    gap = max(np.sqrt(away) - own - other, 0.0)
                    two, square = (other - least) / step, (gap / reach) * (gap / reach)
                    total += strength[k] * _mean(
                        log_mean, one, two, gap / gap_step, square
                    )
                k += 1
        out[n] = total
