"""A wall that changes with height: u' = i P(z) w, w' = i Q(z) u by Gauss collocation,
of high order in z.

On a panel of height h with the m Gauss points c_j the derivative is a polynomial
through its values there, so with
a_jk = ∫_0^c_j l_k and b_k = ∫_0^1 l_k (Hairer, Norsett, Wanner, Solving Ordinary
Differential Equations I, II.7)

    u_j = u_0 + i h Σ a_jk P_k w_k,    w_j = w_0 + i h Σ a_jk Q_k u_k,    (u, w)_1 = (u, w)_0 + h Σ b_k (...)_k:

order 2 m where the waves are resolved, and |R| <= 1 for the stiff ones: those that
decay within nanometres live at
foot and top alone, where panels are short, and follow the others between. (A staircase
wakes them at every step: its
error falls as 1/steps, and grows with the number of harmonics.) P and Q stay symmetric,
and Gauss collocation keeps
quadratic invariants: power and reciprocity hold to rounding for any number of panels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa.stack import Pair, TangentialFields

Sample = Callable[
    [float], tuple[Array, Array]
]  # P and Q at this share of the height, 0 at the foot
EDGES = (
    0.0,
    0.025,
    0.09,
    0.26,
    0.5,
    0.74,
    0.91,
    0.975,
    1.0,
)  # of the panels: shorter towards foot and top
FIRST, MOST = 4, 10  # stages: 2e-3, 2e-5, 2e-7 of t for 4, 5, 6 and a wall of 0.03 rad


@lru_cache(maxsize=8)
def gauss_collocation(stages: int) -> tuple[Array, Array, Array]:
    """Points c (m,), weights b (m,) and integrals a (m, m) of the Lagrange polynomials
    on [0, 1].
    """
    x, w = np.polynomial.legendre.leggauss(stages)
    c = (x + 1) / 2
    powers = np.arange(stages)
    a = np.linalg.solve(
        np.vander(c, increasing=True).T, (c[:, None] ** (powers + 1) / (powers + 1)).T
    ).T
    return c, w / 2, a


@dataclass(frozen=True, slots=True)
class TiltedWall:
    """One section of a pillar: P and Q at a share of its height, 0 at its foot, and its
    height times k0.
    """

    sample: Sample
    reduced_height: float


@dataclass(frozen=True, eq=False, slots=True)
class CollocatedPanel:
    """A part of a wall, its unknowns put in: fields at the Gauss points from those at
    its upper end.

    share: (m,) of the height. step: -i times its reduced height. weights: (m,). P, Q:
    (m, n, n).
    u, w: (m n, 2 n) from (u, w) at the upper end.
    """

    share: Array
    step: complex
    weights: Array
    P: Array
    Q: Array
    u: Array
    w: Array

    @property
    def downwards(self) -> Array:
        """(2 n, 2 n) matrix from the fields (u, w) at the upper end to those at the
        lower end.
        """
        stages, n = self.P.shape[:2]
        both = np.eye(2 * n, dtype=complex)
        for half, part, field in (
            (slice(n), self.P, self.w),
            (slice(n, None), self.Q, self.u),
        ):
            inner = field.reshape(stages, n, -1)
            both[half] += self.step * np.einsum(
                "k,kij,kjl->il", self.weights, part, inner, optimize=True
            )
        return both


def collocate_panel(
    this: TiltedWall, low: float, high: float, stages: int
) -> CollocatedPanel:
    """The part of a wall between two shares of its height."""
    c, b, a = gauss_collocation(stages)
    share = high - c * (high - low)
    P, Q = (
        np.stack(part)
        for part in zip(*(this.sample(float(s)) for s in share), strict=True)
    )
    step = -1j * this.reduced_height * (high - low)
    n = P.shape[-1]

    def integrated(part: Array) -> Array:
        return np.asarray(
            (a[:, None, :, None] * part.transpose(1, 0, 2)[None]).reshape(
                stages * n, stages * n
            )
        )

    p, q = integrated(P), integrated(Q)
    start = np.tile(np.eye(n), (stages, 1))
    given = np.concatenate([start, step * (p @ start)], axis=1)
    u = np.linalg.solve(
        np.eye(stages * n) - step**2 * (p @ q), given
    )  # u = u0 + step p w, with w put in
    w = np.concatenate([np.zeros_like(start), start], axis=1) + step * (q @ u)
    return CollocatedPanel(share, step, b, P, Q, u, w)


def match_walls(
    walls: Sequence[TiltedWall], top: Pair, foot: Pair, source: Array, *, stages: int
) -> TangentialFields:
    """Fields that radiate into ``top``, and whose incident part gives foot V u + U w =
    source; see ``stack.match``.

    walls: foot first. stages: Gauss points of every panel.
    """
    n = len(source)
    pair = np.concatenate([np.diag(side) for side in top])
    scales = []
    for this in reversed(walls):
        for low, high in zip(EDGES[-2::-1], EDGES[:0:-1], strict=True):
            pair, scale = np.linalg.qr(
                collocate_panel(this, low, high, stages).downwards @ pair
            )
            scales.append(scale)
    U, V = pair[:n], pair[n:]
    a = np.linalg.solve(foot[1][:, None] * U + foot[0][:, None] * V, source)
    u, w = U @ a, V @ a
    for scale in reversed(scales):
        a = np.linalg.solve(scale, a)
    return TangentialFields(u, w, top[0] * a, top[1] * a, [], [])


def choose_stage_count(
    respond_at: Callable[[int], Array], tolerance: float
) -> tuple[int, float]:
    """Stages that leave less than a tenth of the tolerance, and the error they leave:
    as the last one changed t.
    """
    stages, t = FIRST, respond_at(FIRST)
    while True:
        finer = respond_at(stages + 1)
        left = float(np.abs(finer - t).max())
        stages, t = stages + 1, finer
        if left <= tolerance / 10 or stages >= MOST:
            return stages, left
