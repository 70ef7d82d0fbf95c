"""A lens reduced to what draws of its process need: few sums over the pillars, weighted
anew for each draw.
"""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.study.focus import FocusSums
from layout.study.pillars import Curve, classify_pillars
from metalens.core import executor, threads
from metalens.core.arrays import Array
from metalens.fabrication import Draw, ResponseRates, Spread, State, draw_lenses
from metalens.lens import Lens

_BAND, _PARTS = (
    16,
    16,
)  # rows that are summed at once, by any one worker; parts of a lens that workers take


@dataclass(frozen=True, eq=False)
class SpreadModel:
    """Sums over the pillars of a lens for all draws of its process.

    curve: t of the kinds of pillars (sizes to 0.05 nm). count: (kinds,) pillars of
    each. basis: (rank, kinds) B_k, orthonormal over pillars.
    moments: (rank, nodes y, nodes x) sums of the pillars. radius_um: of the lens.
    degree: of the Chebyshev series of the weights of the basis in the local bias.
    """

    curve: Curve
    focus: FocusSums
    count: Array
    basis: Array
    moments: Array
    radius_um: float
    degree: int = 10

    def drawn(self, lenses: Sequence[State]) -> Array:
        """(lenses, nodes y, nodes x) moments of lenses that a process makes.

        The weight of each basis function is a Chebyshev series in the local bias. A
        phase error of the wavefront multiplies the moments at the nodes.

        Args:
            lenses: states of the process.
        """
        x = self.focus.nodes_x_um / self.radius_um
        y = self.focus.nodes_y_um[:, None] / self.radius_um
        knots = np.cos(np.pi * (np.arange(self.degree + 1) + 0.5) / (self.degree + 1))
        lens_moments = []
        for state in lenses:
            bias = state.bias_um(x, y)
            mean_bias = (bias.max() + bias.min()) / 2
            half_range = (bias.max() - bias.min()) / 2 + 1e-9
            curves = self.curve(mean_bias + half_range * knots, state)
            weights = (curves * self.count) @ self.basis.conj().T
            coefficients = np.polynomial.chebyshev.chebfit(knots, weights, self.degree)
            at_nodes = np.polynomial.chebyshev.chebval(
                (bias - mean_bias) / half_range, coefficients
            )
            moments = (at_nodes * self.moments).sum(0)
            lens_moments.append(
                moments * np.exp(1j * state.phase_rad(x, y))
                if state.has_wavefront_error()
                else moments
            )
        return np.stack(lens_moments)


def reduce_spread(
    lens: Lens,
    sens: ResponseRates,
    focus: FocusSums,
    spread: Spread,
    *,
    seed: int,
    samples: int = 160,
    tolerance: float = 3e-4,
) -> SpreadModel:
    """Reduce a lens to sums over its pillars for a basis of their transmissions.

    The basis are the leading singular vectors of t over the kinds of pillars, for
    random draws at random places of the lens.

    Args:
        lens: as designed.
        sens: sensitivities of its pillars.
        focus: sums of a window.
        spread: of the process.
        seed: of the random draws.
        samples: number of the random draws.
        tolerance: share, in amplitude, of the variation that the basis may miss.
    """
    index, count, curve = classify_pillars(lens, sens)
    states = [draw.state() for draw in draw_lenses(spread, samples, seed=seed)]
    rng = np.random.default_rng(seed)
    radius = np.sqrt(rng.uniform(0, 1, samples))
    angle = rng.uniform(0, 2 * np.pi, samples)
    u, v = radius * np.cos(angle), radius * np.sin(angle)
    curves = [
        curve(state.bias_um(x, y), state)[0]
        for state, x, y in zip(states, u, v, strict=True)
    ]
    weight = np.sqrt(count)
    with threads.one_blas_thread():  # the same bits on any machine's number of them
        singular, directions = np.linalg.svd(
            np.stack(curves) * weight, full_matrices=False
        )[1:]
    missed_share = np.sqrt(np.cumsum(singular[::-1] ** 2)[::-1] / (singular**2).sum())
    rank = max(1, int((missed_share > tolerance).sum()))
    basis = directions[:rank] / weight
    columns = np.concatenate([np.zeros((rank, 1)), basis], axis=1).astype(np.complex64)
    bounds = [len(index) * i // _PARTS for i in range(_PARTS + 1)]
    parts = [
        (start, index[start:stop], np.asarray(lens.geometric_rad(slice(start, stop))))
        for start, stop in itertools.pairwise(bounds)
    ]
    moments = functools.reduce(
        np.add, executor.gather_parallel(_summed, (focus, columns), parts)
    )
    return SpreadModel(curve, focus, count, basis, moments, lens.diameters.radius_um)


def _summed(about: tuple[FocusSums, Array], part: tuple[int, Array, Array]) -> Array:
    """(rank, nodes y, nodes x) sums over rows of pillars.

    Args:
        about: sums of the window, and the (rank, 1 + kinds) basis.
        part: first row; (rows, x) kind of each site; geometric phase of the rotation
            of each, or of all.
    """
    (focus, columns), (first, index, phase_rad) = about, part
    turn = np.broadcast_to(np.exp(1j * phase_rad).astype(np.complex64), index.shape)
    moments = np.zeros(
        (len(columns), len(focus.nodes_y_um), len(focus.nodes_x_um)), complex
    )
    for start in range(0, len(index), _BAND):
        band = slice(start, start + _BAND)
        amplitudes = columns[:, index[band]] * turn[band]
        moments += focus.project(
            amplitudes, slice(first + start, first + start + amplitudes.shape[1])
        )
    return moments


def reduction_error(model: SpreadModel, lenses: Sequence[Draw]) -> float:
    """Largest rms relative error of t over the pillars in any draw, at the centre and
    on both sides of the edge.

    Args:
        model: reduced lens.
        lenses: draws of the process.
    """
    worst = 0.0
    for draw in lenses:
        state = draw.state()
        radius = np.array([0.0, 1.0, -1.0])
        bias = state.bias_um(
            radius * np.cos(draw.turn_rad), radius * np.sin(draw.turn_rad)
        )
        curves = model.curve(bias, state)
        weights = (curves * model.count) @ model.basis.conj().T
        relative_square = (
            (abs(curves - weights @ model.basis) ** 2)
            @ model.count
            / (abs(curves) ** 2 @ model.count)
        )
        worst = max(worst, float(np.sqrt(relative_square.max())))
    return worst
