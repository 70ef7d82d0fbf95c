"""The ladder of meshes: which one to try first for a tolerance, and how its error is estimated.

Two things are wrong in the mean of both forms. Near the rim, where the field is singular, the forms err apart: their
difference bounds it. Smooth waves on polynomials err alike: what relative error they have in the transverse
wavenumbers squared is a property of the mesh and of how much of the cell the disc fills, found by comparing with
finer meshes; the solution knows how much it moves for it (``drift``). One guided wave of a tall disc of middle size
may have the same wavenumber in both forms, by accident, and be wrong in both: there the difference says nothing and
``Choice.middle`` counts. The factors were calibrated on some seven hundred pillars (index 1.8 to 4, with and without
absorption, up to 20 degrees, 5 to 98 % of the pitch; drawn at cutoffs and resonances, nearly touching, thin, tall)
and some three hundred of any kind (``Case.strange``: steep light, many orders, low steps, discs of the rarer medium)
against finer meshes; a slow test and the benchmark ``hard_cells`` hold them against pillars drawn anew. On two more
seeds 1327 of 1328 bars of the two coarse meshes held, the nearest at 0.73 of its bar (a tall pillar), though the
median is at a sixteenth: the factors are those of the tail. The one that did not (1.00) and a hole whose mesh "good"
was six times off are sharp resonances of a disc of the rarer medium; a guided mode of a thin layer of low contrast was
32 times off (seed 8641 of ``engines``, 3 of 3400 cells). ``engine.climb`` judges cells unlike those of lenses by the
two meshes before. Where an order is near its cutoff both forms err alike, so that more than their difference is told;
around a thin disc they err apart, and less than half of it is. On degree 5 the mean of both forms errs by a tenth of
half their difference or less, at cutoffs too, but for discs whose gap is narrow.
"""

from dataclasses import dataclass
from typing import Protocol

from metalens.modal.mesh import MeshPlan


@dataclass(frozen=True, slots=True)
class Choice:
    """A mesh for discs up to ``up_to`` pitches wide, and the relative error of transverse wavenumbers squared that
    both forms share on it: ``thin + wide * rho**4``, ``middle`` more for discs that are not thin, whose one guided
    wave the forms may place alike, and ``oblique`` more off normal incidence (sharp resonances). safety, at_cutoff,
    strange: in place of those of the rung, where the mean of both forms is that much better than their difference."""

    plan: MeshPlan
    up_to: float
    thin: float
    wide: float = 0.0
    oblique: float = 0.0
    middle: float = 0.0
    safety: float | None = None
    at_cutoff: float | None = None
    strange: float | None = None

    def shared(self, rho: float, bloch: float) -> float:
        """The error shared by both forms at this diameter in pitches and half Bloch phase."""
        return self.thin + self.wide * rho**4 + self.oblique * (bloch > 0) + self.middle * (rho > MIDDLE)


@dataclass(frozen=True, slots=True)
class Rung:
    """Meshes of one accuracy, thinnest disc first.

    safety: factor on half the difference of the forms. usual: the estimate that most pillars end with.
    at_cutoff, thin, strange: that factor where an order is near its cutoff, for discs thinner than ``THIN`` pitches,
    and for cells unlike those of lenses.
    """

    name: str
    choices: tuple[Choice, ...]
    safety: float
    usual: float
    at_cutoff: float = 2.6
    thin: float = 0.35
    strange: float = 2.5

    @property
    def weak(self) -> float:
        """Modes that carry less than this may be left out: far below the error of the mesh."""
        return float(max(1e-13, 1e-3 * self.usual**1.1))

    def choice(self, rho: float) -> Choice:
        """The mesh for a disc of ``rho`` pitches."""
        return next(c for c in self.choices if rho <= c.up_to)

    def error(self, found: "Measured", rho: float) -> float:
        """Error estimate of the mean of both forms.

        A disc that nearly fills the cell leaves a gap that the angular functions resolve late, in both forms alike.
        """
        return self.bound(self.choice(rho).shared(rho, found.bloch), found, rho)

    def bound(self, shared: float, found: "Measured", rho: float) -> float:
        """``error`` with the relative error ``shared`` of transverse wavenumbers squared."""
        shared *= max(1.0, found.size / SIZE) ** STEEP
        own = self.choice(rho)
        safety = self.safety if own.safety is None else own.safety
        if rho > NARROW:
            safety, shared = safety * GAP, shared * GAP / 2
        if found.grazing:
            safety = max(safety, self.at_cutoff if own.at_cutoff is None else own.at_cutoff)
        elif TINY <= rho < THIN and not found.strange:
            safety, shared = min(safety, self.thin), shared * SMALL
        if found.strange:
            at_least = self.strange if own.strange is None else own.strange
            safety, shared = max(safety, found.strange * at_least), shared * STRANGE
        return safety * found.spread + shared * found.drift + GRAZING * found.grazing + UNSEEN * self.usual + 1e-12


class Measured(Protocol):
    """What a solution tells of its own error; see ``engine.Solution``."""

    @property
    def spread(self) -> float:
        """Half the difference of both forms."""
        ...

    @property
    def drift(self) -> float:
        """How far the answer moves for a relative error of one in the transverse wavenumbers squared."""
        ...

    @property
    def grazing(self) -> float:
        """How far exact cutoffs of the orders near grazing move the answer."""
        ...

    @property
    def bloch(self) -> float:
        """Half Bloch phase in rad, 0 at normal incidence."""
        ...

    @property
    def size(self) -> float:
        """Wavelengths in a pitch, in the densest medium of the layer."""
        ...

    @property
    def strange(self) -> float:
        """How unlike the cells of lenses it is, 0 for these; see ``case.Case``."""
        ...


NARROW, GAP = 0.9, 3.0  # from this diameter in pitches, the safety factor times this, the shared error times its half
SIZE, STEEP = 2.0, 6  # above so many waves in a pitch the shared error rises as their sixth power: what polynomials of
# degree p get wrong of a wave goes as the 2 p-th power of its elements, and 3 is the least degree
MIDDLE = 0.3  # above this diameter in pitches, ``Choice.middle`` counts
THIN, SMALL = 0.25, 0.2  # below this diameter in pitches the forms err mostly apart; share of the shared error
TINY = 0.03  # in pitches: thinner ones are too thin for that
STRANGE = 5.0  # times the shared error, for cells unlike those of lenses
GRAZING = 0.15  # of the change that exact cutoffs make: it bounds nothing by itself, but the forms err alike there
UNSEEN = 0.02  # of the usual estimate: plane waves in a layer without contrast err a little that nothing shows
BOTH = (0.7, 1.3)
STEEPER = (0.7, 1.45)  # few functions resolve the rim better with a second exponent between that of theory and 1.7
GOOD = MeshPlan(5, 5, 5, BOTH)
FINE = MeshPlan(5, 5, 5, (0.7,), (0.85, 1.0), (0.15, 1.0), core=0.55)
FINER = MeshPlan(5, 6, 5, BOTH, (0.85, 1.0), (0.15, 1.0))
FINEST = MeshPlan(6, 7, 6, BOTH, (0.85, 1.0), (0.15, 1.0), core=0.55)
REFERENCE = MeshPlan(7, 7, 7, (0.7,), (0.75, 0.96, 1.0), (0.05, 0.3, 1.0), core=0.55)
RUNGS = (
    Rung(
        "coarse",
        (
            Choice(MeshPlan(3, 3, 2, STEEPER, core=0.45), 0.7, 6e-6, 3e-5, oblique=2e-4, middle=3.5e-5),
            Choice(MeshPlan(3, 4, 2, STEEPER, core=0.55), 1.0, 4e-5, 7e-5, oblique=5e-5),
        ),
        1.2,
        2e-3,
        at_cutoff=4.6,
        thin=0.7,
        strange=7.0,
    ),
    Rung(
        "fair",
        (
            Choice(MeshPlan(3, 4, 3, STEEPER, core=0.6), 0.7, 3e-6, 5e-6, oblique=1e-5, middle=1.5e-5),
            Choice(MeshPlan(4, 4, 3, STEEPER, core=0.55), 1.0, 0.0, 5e-5, oblique=1e-5),
        ),
        1.2,
        4e-4,
        at_cutoff=4.6,
        thin=0.6,
        strange=7.0,
    ),
    Rung(
        "even",
        (
            Choice(MeshPlan(4, 4, 4, BOTH), 0.7, 1e-6, 1.5e-5, oblique=4e-6, middle=2e-6),
            Choice(GOOD, NARROW, 1.5e-7, oblique=3e-7, safety=0.3, at_cutoff=1.0, strange=3.0),
            Choice(GOOD, 1.0, 1.5e-7, oblique=3e-7, strange=3.0),
        ),
        0.6,
        2.5e-4,
        strange=9.0,
    ),
    Rung(
        "good",
        (
            Choice(GOOD, 0.7, 1.5e-7, oblique=3e-7, at_cutoff=1.0),
            Choice(GOOD, NARROW, 1.5e-7, oblique=3e-7, safety=0.3, at_cutoff=1.0),
            Choice(GOOD, 1.0, 1.5e-7, oblique=3e-7),
        ),
        0.6,
        1e-4,
        strange=3.0,
    ),
    Rung("fine", (Choice(FINE, 1.0, 5e-8, oblique=3e-7),), 0.5, 2.5e-5),
    Rung("finer", (Choice(FINER, 1.0, 2e-8, oblique=1e-7),), 0.4, 8e-6),
    Rung("finest", (Choice(FINEST, 1.0, 1e-8, oblique=5e-8),), 0.3, 3e-6),
    Rung("reference", (Choice(REFERENCE, 1.0, 5e-9),), 0.25, 1e-6),
)


def first_rung(tolerance: float) -> int:
    """Index of the coarsest mesh that usually meets the tolerance."""
    return next((i for i, rung in enumerate(RUNGS) if rung.usual <= tolerance), len(RUNGS) - 1)
