"""Choice of pillars for several channels at once: wavelengths, or polarisations."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from metalens.core.arrays import Array


@dataclass(frozen=True, eq=False)
class CandidateTable:
    """Candidate pillars for several channels, and the sums that rank them.

    Weighted squared error (1) of candidate j at a site with target phases phi_c:
    sum_c w_c |t_cj - exp(i phi_c)|², a squared distance in 2 x channels dimensions.

    t: (channels, n) complex transmission of each candidate.
    weights: (channels,) w of (1), above 0.
    common_piston: whether all channels share one piston.
    """

    t: Array
    weights: Array
    common_piston: bool = False

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self._coordinates(self.t), leafsize=24)  # fastest of 4 to 200

    def _coordinates(self, amplitudes: Array) -> Array:
        """(n, 2 channels) real coordinates whose squared distances are (1).

        Args:
            amplitudes: (channels, n) complex.
        """
        scaled = np.sqrt(self.weights)[:, None] * amplitudes
        return np.concatenate([scaled.real, scaled.imag]).T

    def nearest(self, phases_rad: Array) -> Array:
        """(sites,) indices of the candidates of the least sums (1).

        Args:
            phases_rad: (channels, sites) target phases, pistons included.
        """
        goals = self._coordinates(np.exp(1j * phases_rad))
        return np.asarray(self._tree.query(goals, workers=-1)[1])

    def _sums(self, index: Array, phases_rad: Array) -> Array:
        """(sites,) sums (1) of one candidate at each site."""
        error = np.abs(self.t[:, index] - np.exp(1j * phases_rad)) ** 2
        return np.asarray(self.weights @ error)

    def between(self, phases_rad: Array) -> Array:
        """(sites,) fractional indices of the least sums in a table over one size.

        Vertices of the parabolas through the least sums and their two neighbours; the
        ends of the table as they are.

        Args:
            phases_rad: (channels, sites) target phases, pistons included.
        """
        best = self.nearest(phases_rad)
        inner = best.clip(1, self.t.shape[1] - 2)
        before, here, after = (self._sums(inner + i, phases_rad) for i in (-1, 0, 1))
        curvature = before - 2 * here + after
        offset = (before - after) / (2 * np.maximum(curvature, 1e-30))
        has_vertex = (best == inner) & (curvature > 0)
        return np.asarray(inner + np.where(has_vertex, offset, best - inner))

    def pistons(self, phases_rad: Array, *, starts: int = 16) -> Array:
        """(channels,) pistons of the least sum over sites, the best of several starts.

        Args:
            phases_rad: (channels, sites) wanted phases of a sample of sites.
            starts: random initial pistons; the sum has several minima.
        """
        count = 1 if self.common_piston else len(self.t)
        draw = np.random.default_rng(0).uniform(0, 2 * np.pi, (starts, count))
        results = [self._converged(phases_rad, start) for start in draw]
        return min(results, key=lambda result: result[0])[1]

    def _converged(self, phases: Array, start: Array) -> tuple[float, Array]:
        """Least sum over the sites and its pistons, by alternating minimisation.

        In turn: the best candidate of every site for the pistons, then the best pistons
        arg(sum_sites w t exp(-i phi)) for these candidates.

        Args:
            phases: (channels, sites) target phases, rad.
            start: (channels,) or (1,) initial pistons, rad.
        """
        pistons = np.broadcast_to(start, len(self.t))
        for _ in range(40):
            pick = self.nearest(phases + pistons[:, None])
            peaks = self.weights * (self.t[:, pick] * np.exp(-1j * phases)).sum(1)
            peaks = peaks.sum(keepdims=True) if self.common_piston else peaks
            previous = pistons
            pistons = np.broadcast_to(np.angle(peaks), len(self.t))
            change = np.angle(np.exp(1j * (pistons - previous)))
            if np.abs(change).max() < 1e-3:  # rad
                break
        return float(self._sums(pick, phases + pistons[:, None]).sum()), pistons
