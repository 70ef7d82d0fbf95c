"""The sequence of meshes: which one to try first for a tolerance, and how its error is
estimated.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from metalens.modal.case import RARER, MeshSolution
from metalens.modal.mesh import MeshPlan


@dataclass(frozen=True, slots=True)
class ErrorFactors:
    """Of the parts of an error estimate, see the module; zeros are left out.

    rim, waves: of both halves of the forms' difference. flat, steep, oblique: relative
    error of transverse wavenumbers
    squared that both forms share, ``flat + steep (waves in a pitch / SIZE)⁶``,
    ``oblique`` more off normal incidence.
    moved: of the change from meshes before. slanted: least value of waves off normal
    incidence; at_cutoff: of rim and
    waves where an order is at its cutoff, where the forms err alike, and less beside
    it. grazing: of the change that
    exact cutoffs make.
    """

    rim: float
    waves: float
    flat: float = 0.0
    steep: float = 0.0
    oblique: float = 0.0
    moved: float = 0.0
    slanted: float = 0.0
    at_cutoff: float = 2.6
    grazing: float = 0.15

    def bound(self, found: MeshSolution, before: Sequence[MeshSolution] = ()) -> float:
        """Error estimate of a solution, after the meshes ``before``."""
        near = self.at_cutoff * found.cutoff
        waves = max(self.waves, near, self.slanted if found.bloch > 0 else 0.0)
        shared = self.flat + self.oblique * (found.bloch > 0)
        shared += self.steep * (found.size / SIZE) ** STEEP
        parts = (
            max(self.rim, near) * found.rim + waves * found.waves + shared * found.drift
        )
        change = self.moved * max(
            (damped_change(found, one) for one in before[-COMPARED:]), default=0.0
        )
        if before and found.regime_factor >= RARER:
            change = max(change, ALIKE * found.cutoff * mesh_change(found, before[-1]))
        return parts + self.grazing * found.grazing + change


@dataclass(frozen=True, slots=True)
class DampedEstimate:
    """Of the estimate after two meshes for cells unlike those of lenses whose waves are
    all damped.

    moved: of the farthest change since them, each as far as the forms have drawn
    together. forms: of half their
    difference. shared: relative error of transverse wavenumbers squared in both forms.
    """

    moved: float
    forms: float
    shared: float

    def bound(self, found: MeshSolution, before: Sequence[MeshSolution]) -> float:
        """Error estimate; infinite where it does not apply."""
        meshes = (*before[-COMPARED:], found)
        damped = min(one.damping for one in meshes) >= DAMPED
        beyond_it = (
            found.bloch > 0 or found.regime_factor >= RARER or found.size > MOST_WAVES
        )
        if len(meshes) <= COMPARED or not damped or beyond_it or found.cutoff > NEAREST:
            return math.inf
        change = max(contracted_change(found, one) for one in meshes[:-1])
        return (
            self.moved * change + self.forms * found.spread + self.shared * found.drift
        )


@dataclass(frozen=True, slots=True)
class MeshChoice:
    """A mesh for discs up to ``up_to`` pitches wide, and the factors of its estimate;
    after: in place of them with the
    change from meshes before, for cells unlike those of lenses. usual: in place of that
    of the rung."""

    plan: MeshPlan
    up_to: float
    factors: ErrorFactors
    after: ErrorFactors
    usual: float | None = None


@dataclass(frozen=True, slots=True)
class MeshLevel:
    """Meshes of one accuracy, thinnest disc first.

    usual: the estimate that most pillars of many waves in a pitch end with.
    alone: factors outside the calibrated regime, by this mesh alone.
    settling: estimate outside the regime after two coarser meshes.
    """

    name: str
    choices: tuple[MeshChoice, ...]
    usual: float
    alone: ErrorFactors
    settling: DampedEstimate | None = None

    @property
    def weak(self) -> float:
        """Modes that carry less than this may be left out: far below the error of the
        mesh.
        """
        return float(max(1e-13, 1e-3 * self.usual**1.1))

    def choice(self, rho: float) -> MeshChoice:
        """The mesh for a disc of ``rho`` pitches."""
        return next(c for c in self.choices if rho <= c.up_to)

    def error(
        self,
        found: MeshSolution,
        rho: float,
        before: Sequence[MeshSolution] = (),
        *,
        mesh: MeshChoice | None = None,
    ) -> float:
        """Error estimate of the mean of both forms, of t and r.

        Args:
            found: the solution. rho: diameter over pitch.
            before: solutions on coarser meshes, which cells outside the calibrated
                regime are judged by where there are any.
            mesh: what was solved on; where that is not the level's own for the diameter,
                the wider of both estimates counts.
        """
        if found.regime_factor and before:
            bound = self.choice(rho).after.bound(found, before)
            if self.settling:
                bound = min(bound, self.settling.bound(found, before))
        elif found.regime_factor:
            bound = found.regime_factor * self.alone.bound(found)
        else:
            own = self.choice(rho)
            judges = (own, mesh) if mesh and mesh.plan != own.plan else (own,)
            bound = max(one.factors.bound(found) for one in judges)
            bound = second_order_bound(bound)
        return bound + UNSEEN * self.usual * (found.bloch > 0) + 1e-12


def second_order_bound(first: float) -> float:
    """An estimate of first order with the orders beyond it: at most twice as much, or
    twice ``RESONANT``.

    Near a resonance of amplitude a, S changes by a / (1 - x) - a = first / (1 - first / a)
    for a shift of x of the way to it, with ``first`` = a x.
    """
    whole = first / max(0.5, 1 - first / RESONANT)
    return max(first, min(whole, 2 * RESONANT))


def damped_change(found: MeshSolution, before: MeshSolution) -> float:
    """Change ``found`` made since the mesh ``before`` (:func:`contracted_change`) over the
    damping of round trips: at most ``AMPLIFIED`` times the change.
    """
    most = AMPLIFIED * mesh_change(found, before)
    return min(
        most, contracted_change(found, before) / min(1.0, max(found.damping, 1e-9))
    )


def contracted_change(found: MeshSolution, before: MeshSolution) -> float:
    """Change ``found`` made since a mesh ``before``, times the root of how far the forms
    have drawn together since: errors decay no slower.
    """
    together = min(1.0, found.spread / before.spread) if before.spread > 0 else 1.0
    return mesh_change(found, before) * math.sqrt(together)


def mesh_change(found: MeshSolution, before: MeshSolution) -> float:
    """Largest change of an element of the scattering matrix ``found`` since a mesh
    ``before``.
    """
    return float(np.abs(found.matrix - before.matrix).max())


SIZE, STEEP = (
    2.0,
    6,
)  # what polynomials of degree p get wrong of a wave goes as the 2 p-th power of its elements, and 3
# is the least degree
LARGE, FALL = (
    1.4,
    3,
)  # waves in a pitch from which on meshes have their usual estimates, and how these fall below
AMPLIFIED = 6.0  # with a factor of a third, twice the change is the most that is told
# amplitude of a resonance, of those that move an answer by a hundredth and more
RESONANT = 0.1
# in a pitch: beyond, degree four errs alike in both forms by up to all that the change
# tells
MOST_WAVES = 2.5
DAMPED = 0.1  # of a wave in a round trip: where each loses more, no resonance is sharp
# of ``cutoff``: nearer to a cutoff both forms err alike, by up to nine times half their
# difference
NEAREST = 0.5
ALIKE = 1.5  # of the last change, of discs of the rarer medium at a cutoff
COMPARED = 2  # meshes before, the last, that cells unlike those of lenses are judged by
# of the usual estimate: oblique waves in a layer without contrast err a little that
# nothing shows
UNSEEN = 0.02
TINY, SLIM, THIN, NARROW = (
    0.03,
    0.2,
    0.3,
    0.8,
)  # diameters in pitches: too thin to be told apart; whose forms err by
# what is singular at the rim alone; around which they err apart; whose gap is resolved
# late, in both forms alike
BOTH = (0.7, 1.3)
STEEPER = (
    0.7,
    1.45,
)  # few functions resolve the rim better with a second exponent between that of theory and 1.7
GOOD = MeshPlan(5, 5, 5, BOTH)
GOOD_MIDDLE = MeshPlan(
    4, 6, 6, BOTH, core=0.6
)  # angular degree 5 misplaces the first order by 2e-5, 6 by 8e-7
GOOD_WIDE = MeshPlan(
    4, 6, 5, BOTH, core=0.6
)  # the gap of a wide disc varies along the rim: its angular degree counts
FINE = MeshPlan(5, 5, 5, (0.7,), (0.85, 1.0), (0.15, 1.0), core=0.55)
FINER = MeshPlan(5, 6, 5, BOTH, (0.85, 1.0), (0.15, 1.0))
FINEST = MeshPlan(6, 7, 6, BOTH, (0.85, 1.0), (0.15, 1.0), core=0.55)
REFERENCE = MeshPlan(7, 7, 7, (0.7,), (0.75, 0.96, 1.0), (0.05, 0.3, 1.0), core=0.55)
COARSE, COARSE_WIDE = (
    MeshPlan(3, 3, 2, STEEPER, core=0.45),
    MeshPlan(3, 4, 2, STEEPER, core=0.55),
)
FAIR, FAIR_WIDE = (
    MeshPlan(3, 4, 3, STEEPER, core=0.6),
    MeshPlan(4, 4, 3, STEEPER, core=0.55),
)
EVEN = MeshPlan(4, 4, 4, BOTH)
SETTLED, WIDE = (
    ErrorFactors(0.6, 2.0, moved=0.31, at_cutoff=1.0),
    ErrorFactors(2.5, 1.8, moved=0.33),
)
UNSETTLED = ErrorFactors(9.0, 9.0, moved=0.33)  # of elements of degree three and four
SLIM_FACTORS = ErrorFactors(
    0.9, 0.08, 4e-9, 4e-8, oblique=1.5e-7, slanted=1.7, at_cutoff=1.0
)
SLIM_GOOD = MeshChoice(GOOD, SLIM, SLIM_FACTORS, SETTLED, usual=1.2e-5)
ON_GOOD = (  # discs that leave a wide or a narrow gap
    MeshChoice(
        GOOD_WIDE,
        NARROW,
        ErrorFactors(0.4, 1.0, 2e-7, 6e-7, oblique=1.2e-7, at_cutoff=1.0),
        WIDE,
    ),
    MeshChoice(
        GOOD_WIDE,
        1.0,
        ErrorFactors(0.6, 2.5, 2e-7, 6e-7, oblique=1.2e-7, at_cutoff=1.0),
        WIDE,
    ),
)


def _finer(
    plan: MeshPlan, safety: float, flat: float, oblique: float = 0.0
) -> tuple[MeshChoice, ...]:
    """One mesh for all discs, with factors of the worst cells: too few were solved on
    finer ones to tell them apart.
    """
    usually = ErrorFactors(1.2 * safety, 1.2 * safety, flat, flat, oblique=oblique)
    wide = ErrorFactors(2 * safety, 2 * safety, flat, flat, oblique=oblique)
    narrow = ErrorFactors(4 * safety, 3 * safety, 2 * flat, flat, oblique=oblique)
    after = ErrorFactors(3.0, 3.0, moved=0.33)
    ends = (0.7, usually), (NARROW, wide), (1.0, narrow)
    return tuple(MeshChoice(plan, end, factors, after) for end, factors in ends)


def _alone(safety: float, flat: float, oblique: float = 0.0) -> ErrorFactors:
    return ErrorFactors(5 * safety, 5 * safety, 5 * flat, 5 * flat, oblique=5 * oblique)


ON_FINER = _finer(FINER, 0.5, 4e-8, 1e-7)


def _rough(*choices: MeshChoice) -> tuple[MeshChoice, ...]:
    """Near a cutoff both forms err alike, and the more the fewer elements there are."""
    return tuple(
        replace(one, factors=replace(one.factors, at_cutoff=4.6)) for one in choices
    )


RUNGS = (
    MeshLevel(
        "coarse",
        _rough(
            MeshChoice(
                COARSE,
                TINY,
                ErrorFactors(1.2, 1.2, 1e-5, 1e-5, oblique=2e-4),
                UNSETTLED,
            ),
            MeshChoice(
                COARSE,
                SLIM,
                ErrorFactors(1.05, 0.12, 6.3e-7, 2.5e-6, oblique=4.4e-5, slanted=1.7),
                UNSETTLED,
                3e-4,
            ),
            MeshChoice(
                COARSE,
                THIN,
                ErrorFactors(0.5, 0.62, 6.3e-6, 2.5e-5, oblique=3.8e-5, slanted=1.7),
                UNSETTLED,
                usual=1e-3,
            ),
            MeshChoice(
                COARSE,
                0.6,
                ErrorFactors(0.5, 3.1, 3.8e-6, 5e-4, oblique=3.8e-5),
                UNSETTLED,
            ),
            MeshChoice(
                COARSE,
                0.7,
                ErrorFactors(3.8, 1.2, 3.8e-5, 1.9e-4, oblique=3.8e-5),
                UNSETTLED,
            ),
            MeshChoice(
                COARSE_WIDE, NARROW, ErrorFactors(0.5, 1.0, 4.4e-5, 3.8e-5), UNSETTLED
            ),
            MeshChoice(
                COARSE_WIDE, 1.0, ErrorFactors(0.62, 5.6, 4.4e-5, 3.8e-5), UNSETTLED
            ),
        ),
        2e-3,
        alone=ErrorFactors(7.0, 7.0, 3e-4, 3e-4, oblique=1e-3),
    ),
    MeshLevel(
        "fair",
        _rough(
            MeshChoice(
                FAIR, TINY, ErrorFactors(1.2, 1.2, 3e-6, 8e-6, oblique=1e-5), UNSETTLED
            ),
            MeshChoice(
                FAIR,
                SLIM,
                ErrorFactors(0.95, 0.09, 1e-7, 1e-6, oblique=1e-6, slanted=1.7),
                UNSETTLED,
                8e-5,
            ),
            MeshChoice(
                FAIR,
                THIN,
                ErrorFactors(0.81, 0.62, 1e-6, 1e-5, slanted=1.7),
                UNSETTLED,
                usual=2e-4,
            ),
            MeshChoice(FAIR, 0.6, ErrorFactors(0.44, 1.0, 1.2e-6, 1.3e-4), UNSETTLED),
            MeshChoice(
                FAIR,
                0.7,
                ErrorFactors(0.8, 1.3, 1.3e-5, 3.2e-5, oblique=1.4e-5),
                UNSETTLED,
            ),
            MeshChoice(
                FAIR_WIDE,
                NARROW,
                ErrorFactors(1.1, 1.0, 1.8e-5, 1.3e-5, oblique=1.1e-5),
                UNSETTLED,
            ),
            MeshChoice(
                FAIR_WIDE,
                1.0,
                ErrorFactors(5.6, 3.8, 3.8e-5, 1.3e-5, oblique=1.1e-5),
                UNSETTLED,
            ),
        ),
        4e-4,
        alone=ErrorFactors(7.0, 7.0, 1e-4, 1e-4, oblique=5e-5),
    ),
    MeshLevel(
        "even",
        (
            MeshChoice(
                EVEN, TINY, ErrorFactors(0.6, 0.6, 1e-6, 2e-6, oblique=4e-6), UNSETTLED
            ),
            MeshChoice(
                EVEN,
                SLIM,
                ErrorFactors(0.95, 0.13, 2.5e-8, 2.5e-7, oblique=2.3e-7, slanted=1.7),
                UNSETTLED,
                2.5e-5,
            ),
            MeshChoice(
                EVEN,
                THIN,
                ErrorFactors(0.69, 0.62, 2.5e-7, 2.5e-6, slanted=1.7),
                UNSETTLED,
                usual=5e-5,
            ),
            MeshChoice(EVEN, 0.6, ErrorFactors(0.5, 3.2, 1.6e-6, 1e-5), UNSETTLED),
            MeshChoice(EVEN, 0.7, ErrorFactors(0.62, 5.4, 6.3e-6, 5e-6), UNSETTLED),
            *ON_GOOD,
        ),
        2.5e-4,
        alone=ErrorFactors(9.0, 9.0, 3e-5, 3e-5, oblique=2e-5),
        settling=DampedEstimate(moved=1.05, forms=1.05, shared=4.5e-6),
    ),
    MeshLevel(
        "good",
        (
            MeshChoice(
                GOOD,
                TINY,
                ErrorFactors(0.6, 0.6, 1.5e-7, 3e-7, oblique=3e-7, at_cutoff=1.0),
                SETTLED,
            ),
            SLIM_GOOD,
            MeshChoice(
                GOOD,
                THIN,
                ErrorFactors(
                    0.69,
                    0.62,
                    3.7e-8,
                    3.8e-7,
                    oblique=1.2e-7,
                    slanted=1.7,
                    at_cutoff=1.0,
                ),
                SETTLED,
                usual=2.5e-5,
            ),
            MeshChoice(
                GOOD_MIDDLE,
                0.6,
                ErrorFactors(0.44, 1.2, 6.2e-8, 3.8e-7, oblique=1.2e-7, at_cutoff=1.0),
                SETTLED,
            ),
            MeshChoice(
                GOOD_WIDE,
                0.7,
                ErrorFactors(0.44, 1.2, 6.2e-8, 3.8e-7, oblique=1.2e-7, at_cutoff=1.0),
                SETTLED,
            ),
            *ON_GOOD,
        ),
        1e-4,
        alone=ErrorFactors(3.0, 3.0, 1e-6, 1e-6, oblique=1.5e-6),
    ),
    # what "fine" adds to "good" is lost on wide discs, whose gap it does not divide:
    # they go on to "finer"
    MeshLevel(
        "fine",
        (*_finer(FINE, 1.0, 3e-7, 3e-7)[:1], *ON_FINER[1:]),
        2.5e-5,
        _alone(1.0, 3e-7, 3e-7),
    ),
    MeshLevel("finer", ON_FINER, 8e-6, _alone(0.5, 4e-8, 1e-7)),
    MeshLevel(
        "finest", _finer(FINEST, 0.35, 2e-8, 5e-8), 3e-6, _alone(0.35, 2e-8, 5e-8)
    ),
    MeshLevel("reference", _finer(REFERENCE, 0.3, 1e-8), 1e-6, _alone(0.3, 1e-8)),
)


def first_rung(tolerance: float, rho: float | None = None, size: float = LARGE) -> int:
    """Index of the coarsest mesh that usually meets a tolerance.

    Args:
        tolerance: of t and r. rho: diameter in pitches; None: of most pillars.
        size: waves in a pitch of a cell in the calibrated regime; estimates fall as the
            third power of it.
    """
    fewer = min(1.0, size / LARGE) ** FALL

    def usual(rung: MeshLevel) -> float:
        return fewer * ((None if rho is None else rung.choice(rho).usual) or rung.usual)

    return next(
        (i for i, rung in enumerate(RUNGS) if usual(rung) <= tolerance), len(RUNGS) - 1
    )
