"""Choice of pillars for several channels at once: wavelengths, or polarisations."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from metalens.core.arrays import Array
from metalens.core.threads import run_split

_STARTS = 16  # initial pistons of the alternating minimisation
_ROUNDS = 40  # most iterations from each
_CONVERGED_RAD = 1e-3  # pistons that move less have converged
_ROWS = 256  # sites whose sums (1) stay in a processor's cache


@dataclass(frozen=True, eq=False)
class CandidateTable:
    """Candidate pillars for several channels, and the sums that rank them.

    Weighted squared error (1) of candidate j at a site with target phases phi_c:
    sum_c w_c |t_cj - exp(i phi_c)|².

    t: (channels, n) complex transmission of each candidate.
    weights: (channels,) w of (1), above 0.
    common_piston: whether all channels share one piston.
    """

    t: Array
    weights: Array
    common_piston: bool = False

    @cached_property
    def factors(self) -> Array:
        """(2 channels, n) float32 coefficients of cos phi and sin phi in (1)."""
        weighted = -2 * self.weights[:, None] * self.t
        return np.concatenate([weighted.real, weighted.imag]).astype(np.float32)

    @cached_property
    def power(self) -> Array:
        """(n,) sum_c w_c |t_cj|², the part of (1) that no phase changes."""
        return np.asarray(self.weights @ np.abs(self.t) ** 2, np.float32)

    def sums(self, phases_rad: Array) -> Array:
        """Sums (1) less the sum of the weights.

        Args:
            phases_rad: (channels, sites) wanted phases, pistons included.

        Returns:
            (sites, n) float32.
        """
        phasors = np.concatenate([np.cos(phases_rad), np.sin(phases_rad)])
        return np.asarray(self.power + phasors.astype(np.float32).T @ self.factors)

    def nearest(self, phases_rad: Array) -> Array:
        """(sites,) indices of the candidates of the least sums (1)."""
        return self._over_sites(phases_rad, lambda sums: sums.argmin(1)).astype(int)

    def between(self, phases_rad: Array) -> Array:
        """(sites,) fractional indices of the least sums in a table over one size.

        Vertices of the parabolas through the least sums and their two neighbours; the
        ends of the table as they are.

        Args:
            phases_rad: (channels, sites) target phases, pistons included.
        """
        return self._over_sites(phases_rad, _vertices)

    def _over_sites(self, phases_rad: Array, choose: Callable[[Array], Array]) -> Array:
        """(sites,) results of ``choose``, in threads by blocks of sites.

        Args:
            phases_rad: (channels, sites) target phases, pistons included.
            choose: (sites, n) sums (1) of a block to its (sites,) results.
        """
        out = np.empty(phases_rad.shape[1])

        def work(start: int, stop: int) -> None:
            for a in range(start, stop, _ROWS):
                some = slice(a, min(a + _ROWS, stop))
                out[some] = choose(self.sums(phases_rad[:, some]))

        run_split(len(out), work)
        return out

    def pistons(self, phases_rad: Array) -> Array:
        """(channels,) pistons of the least sum over sites, the best of 16 starts.

        Args:
            phases_rad: (channels, sites) wanted phases of a sample of sites.
        """
        count = 1 if self.common_piston else len(self.t)
        starts = np.random.default_rng(0).uniform(0, 2 * np.pi, (_STARTS, count))
        results = [self._converged(phases_rad, start) for start in starts]
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
        for _ in range(_ROUNDS):
            pick = self.sums(phases + pistons[:, None]).argmin(1)
            peaks = self.weights * (self.t[:, pick] * np.exp(-1j * phases)).sum(1)
            peaks = peaks.sum(keepdims=True) if self.common_piston else peaks
            previous = pistons
            pistons = np.broadcast_to(np.angle(peaks), len(self.t))
            change = np.angle(np.exp(1j * (pistons - previous)))
            if np.abs(change).max() < _CONVERGED_RAD:
                break
        least = self.sums(phases + pistons[:, None]).min(1)
        return float(least.sum(dtype=float)), pistons


def _vertices(sums: Array) -> Array:
    """(sites,) vertices of parabolas through the least of each row of sums."""
    last, row = sums.shape[1] - 1, np.arange(len(sums))
    best = sums.argmin(1)
    inner = best.clip(1, last - 1)
    before, here, after = (sums[row, inner + i].astype(float) for i in (-1, 0, 1))
    bend = before - 2 * here + after
    off = (before - after) / (2 * np.maximum(bend, 1e-30))
    return np.asarray(inner + np.where((best == inner) & (bend > 0), off, best - inner))
