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

from metalens.core.arrays import Array
from metalens.rcwa.layer import FourierModes
from metalens.rcwa.stack import Pair, foot_pair, layer_reflection
from metalens.rcwa.wall import EDGES, CollocatedPanel, TiltedWall, collocate_panel


@dataclass(frozen=True, eq=False, slots=True)
class RegionModes:
    """A layer by its modes, and its height times k0."""

    part: FourierModes
    height: float


@dataclass(frozen=True, eq=False, slots=True)
class PanelSteps:
    """A tilted wall by the matrices of its panels from their upper to their lower ends,
    foot first.
    """

    downwards: tuple[Array, ...]


@dataclass(frozen=True, eq=False, slots=True)
class RegionFields:
    """Of waves in one region, (..., k) of k of them. up, down: (n, k) of its modes, at
    foot and top; or of a tilted
    wall ends: (panels + 1, 2 n, k) fields (u, w) at the ends of the panels, foot first.
    """

    up: Array
    down: Array
    ends: Array

    def beside(self, other: "RegionFields") -> "RegionFields":
        """These waves and others."""
        pairs = ((self.up, other.up), (self.down, other.down), (self.ends, other.ends))
        return RegionFields(*(np.concatenate(pair, axis=-1) for pair in pairs))

    @property
    def upside_down(self) -> "RegionFields":
        """The same, seen in a frame that is turned upside down."""
        n = self.ends.shape[1] // 2
        return RegionFields(
            self.down, self.up, self.ends[::-1] * np.repeat([1.0, -1.0], n)[:, None]
        )


@dataclass(frozen=True, eq=False, slots=True)
class LayerRegion:
    """A film or section: as it is, with transposed operators, and these upside down.

    height: times k0. panels, panels_transposed: of a tilted wall, foot first.
    """

    height: float
    plain: RegionModes | PanelSteps
    transposed: RegionModes | PanelSteps
    reverse: RegionModes | PanelSteps
    panels: tuple[CollocatedPanel, ...] = ()
    panels_transposed: tuple[CollocatedPanel, ...] = ()


def of_modes(part: FourierModes, height: float) -> LayerRegion:
    """An upright section, or a film."""
    if part.symmetric:
        same = RegionModes(part, height)
        return LayerRegion(height, same, same, same)
    W, V = np.linalg.inv(part.V).T, np.linalg.inv(part.W).T
    turned = RegionModes(
        FourierModes(part.P.T, part.Q.T, part.q, W, V, symmetric=False), height
    )
    return LayerRegion(height, RegionModes(part, height), turned, turned)


def of_wall(this: TiltedWall, stages: int, *, symmetric: bool) -> LayerRegion:
    """A tilted section."""

    def transposed(share: float) -> tuple[Array, Array]:
        P, Q = this.sample(share)
        return P.T, Q.T

    def panels(wall: TiltedWall) -> tuple[CollocatedPanel, ...]:
        return tuple(
            collocate_panel(wall, low, high, stages)
            for low, high in itertools.pairwise(EDGES)
        )

    plain = panels(this)
    turned = plain if symmetric else panels(TiltedWall(transposed, this.reduced_height))
    steps = PanelSteps(tuple(part.downwards for part in plain))
    reverse = PanelSteps(tuple(_reversed(matrix) for matrix in steps.downwards[::-1]))
    other = steps if symmetric else PanelSteps(tuple(part.downwards for part in turned))
    return LayerRegion(this.reduced_height, steps, other, reverse, plain, turned)


def _reversed(matrix: Array) -> Array:
    """Of a panel with transposed operators and upside down: the inverse, with w turned,
    of a symplectic matrix.
    """
    n = len(matrix) // 2
    return np.block(
        [[matrix[n:, n:].T, matrix[:n, n:].T], [matrix[n:, :n].T, matrix[:n, :n].T]]
    )


def match_regions(
    regions: Sequence[RegionModes | PanelSteps], top: Pair, foot: Pair, sources: Array
) -> tuple[list[RegionFields], Array, Array]:
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


def _down(
    region: RegionModes | PanelSteps, pair: Pair
) -> tuple[Pair, tuple[Array, ...]]:
    if isinstance(region, RegionModes):
        back, kept, fade = layer_reflection(region.part, region.height, pair)
        return foot_pair(region.part, back, kept, fade), (back, fade)
    both = np.concatenate([np.diag(side) if side.ndim == 1 else side for side in pair])
    made: list[Array] = [both]
    for matrix in reversed(region.downwards):
        both, scale = np.linalg.qr(matrix @ both)
        made += [scale, both]
    n = len(both) // 2
    return (both[:n], both[n:]), tuple(made)


def _up(
    region: RegionModes | PanelSteps, state: tuple[Array, ...], here: Array
) -> tuple[RegionFields, Array]:
    n = len(here) // 2
    if isinstance(region, RegionModes):
        part, (back, fade) = region.part, state
        up = (np.linalg.solve(part.W, here[:n]) + np.linalg.solve(part.V, here[n:])) / 2
        down = back @ up[: len(fade)]
        late = np.zeros_like(up)
        late[: len(fade)] = fade[:, None] * up[: len(fade)]
        return RegionFields(up, down, np.zeros((1, 0, here.shape[1]))), np.concatenate(
            [part.W @ (late + down), part.V @ (late - down)]
        )
    a, ends = state[-1].conj().T @ here, [here]
    for scale, both in zip(state[-2::-2], state[-3::-2], strict=True):
        a = np.linalg.solve(scale, a)
        ends.append(both @ a)
    none = np.zeros((0, here.shape[1]))
    return RegionFields(none, none, np.array(ends)), ends[-1]
