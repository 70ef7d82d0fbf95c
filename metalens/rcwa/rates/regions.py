"""What lies between the half-spaces, and the fields in it of several waves at once,
also of the transposed operators.

A change of the operators anywhere changes an amplitude that leaves by i ∫ (u~^T dQ u -
w~^T dP w) dz, with tilde the
fields of a wave sent the other way in the medium with P^T and Q^T (Lagrange's identity
of u' = i P w, w' = i Q u).
The transposed modes are the inverses of the modes, V^-T and W^-T; a step of Gauss
collocation is symplectic, so that
the same identity holds from one end of it to the other, and for the values at its
points, to rounding.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from metalens.ground.arrays import Array
from metalens.rcwa.layer import Layer
from metalens.rcwa.stack import Pair, foot_pair, reflection
from metalens.rcwa.wall import EDGES, Panel, Wall, panel


@dataclass(frozen=True, eq=False, slots=True)
class Modes:
    """A layer by its modes, and its height times k0."""

    part: Layer
    height: float


@dataclass(frozen=True, eq=False, slots=True)
class Steps:
    """A tilted wall by the matrices of its panels from their upper to their lower ends,
    foot first.
    """

    downwards: tuple[Array, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Fields:
    """Of waves in one region, (..., k) of k of them. up, down: (n, k) of its modes, at
    foot and top; or of a tilted
    wall ends: (panels + 1, 2 n, k) fields (u, w) at the ends of the panels, foot first.
    """

    up: Array
    down: Array
    ends: Array

    def beside(self, other: "Fields") -> "Fields":
        """These waves and others."""
        pairs = ((self.up, other.up), (self.down, other.down), (self.ends, other.ends))
        return Fields(*(np.concatenate(pair, axis=-1) for pair in pairs))

    @property
    def upside_down(self) -> "Fields":
        """The same, seen in a frame that is turned upside down."""
        n = self.ends.shape[1] // 2
        return Fields(
            self.down, self.up, self.ends[::-1] * np.repeat([1.0, -1.0], n)[:, None]
        )


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """A film or section: as it is, with transposed operators, and these upside down.

    height: times k0. panels, panels_transposed: of a tilted wall, foot first.
    """

    height: float
    plain: Modes | Steps
    transposed: Modes | Steps
    reverse: Modes | Steps
    panels: tuple[Panel, ...] = ()
    panels_transposed: tuple[Panel, ...] = ()


def of_modes(part: Layer, height: float) -> Region:
    """An upright section, or a film."""
    if part.symmetric:
        same = Modes(part, height)
        return Region(height, same, same, same)
    W, V = np.linalg.inv(part.V).T, np.linalg.inv(part.W).T
    turned = Modes(Layer(part.P.T, part.Q.T, part.q, W, V, symmetric=False), height)
    return Region(height, Modes(part, height), turned, turned)


def of_wall(this: Wall, stages: int, *, symmetric: bool) -> Region:
    """A tilted section."""

    def transposed(share: float) -> tuple[Array, Array]:
        P, Q = this.sample(share)
        return P.T, Q.T

    def panels(wall: Wall) -> tuple[Panel, ...]:
        return tuple(
            panel(wall, low, high, stages) for low, high in itertools.pairwise(EDGES)
        )

    plain = panels(this)
    turned = plain if symmetric else panels(Wall(transposed, this.reduced_height))
    steps = Steps(tuple(part.downwards for part in plain))
    reverse = Steps(tuple(_reversed(matrix) for matrix in steps.downwards[::-1]))
    other = steps if symmetric else Steps(tuple(part.downwards for part in turned))
    return Region(this.reduced_height, steps, other, reverse, plain, turned)


def _reversed(matrix: Array) -> Array:
    """Of a panel with transposed operators and upside down: the inverse, with w turned,
    of a symplectic matrix.
    """
    n = len(matrix) // 2
    return np.block(
        [[matrix[n:, n:].T, matrix[:n, n:].T], [matrix[n:, :n].T, matrix[:n, :n].T]]
    )


def match(
    regions: Sequence[Modes | Steps], top: Pair, foot: Pair, sources: Array
) -> tuple[list[Fields], Array, Array]:
    """Fields that radiate into ``top``, and whose incident part gives foot V u + U w =
    sources; see ``stack.match``.

    sources: (n, k). Returns the fields of every region, foot first, and (2 n, k) those
    at the foot and at the top.
    """
    pair: Pair = top
    returns: list[tuple[Array, ...]] = []
    for region in reversed(regions):
        pair, state = _down(region, pair)
        returns.append(state)
    U, V = (np.diag(side) if side.ndim == 1 else side for side in pair)
    a = np.linalg.solve(foot[1][:, None] * U + foot[0][:, None] * V, sources)
    here = start = np.concatenate([U @ a, V @ a])
    found = []
    for region, state in zip(regions, reversed(returns), strict=True):
        fields, here = _up(region, state, here)
        found.append(fields)
    return found, start, here


def _down(region: Modes | Steps, pair: Pair) -> tuple[Pair, tuple[Array, ...]]:
    if isinstance(region, Modes):
        back, kept, fade = reflection(region.part, region.height, pair)
        return foot_pair(region.part, back, kept, fade), (back, fade)
    both = np.concatenate([np.diag(side) if side.ndim == 1 else side for side in pair])
    made: list[Array] = [both]
    for matrix in reversed(region.downwards):
        both, scale = np.linalg.qr(matrix @ both)
        made += [scale, both]
    n = len(both) // 2
    return (both[:n], both[n:]), tuple(made)


def _up(
    region: Modes | Steps, state: tuple[Array, ...], here: Array
) -> tuple[Fields, Array]:
    n = len(here) // 2
    if isinstance(region, Modes):
        part, (back, fade) = region.part, state
        up = (np.linalg.solve(part.W, here[:n]) + np.linalg.solve(part.V, here[n:])) / 2
        down = back @ up[: len(fade)]
        late = np.zeros_like(up)
        late[: len(fade)] = fade[:, None] * up[: len(fade)]
        return Fields(up, down, np.zeros((1, 0, here.shape[1]))), np.concatenate(
            [part.W @ (late + down), part.V @ (late - down)]
        )
    a, ends = state[-1].conj().T @ here, [here]
    for scale, both in zip(state[-2::-2], state[-3::-2], strict=True):
        a = np.linalg.solve(scale, a)
        ends.append(both @ a)
    none = np.zeros((0, here.shape[1]))
    return Fields(none, none, np.array(ends)), ends[-1]
