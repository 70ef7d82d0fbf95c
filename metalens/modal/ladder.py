"""The ladder of meshes: which one to try first for a tolerance, and how its error is estimated.

Two things are wrong in the mean of both forms. Near the rim, where the field is singular, the forms err apart: their
difference bounds it. Smooth waves on polynomials err alike: what relative error they have in the transverse
wavenumbers squared is a property of the mesh and of how much of the cell the disc fills, found once by comparing
with the next finer meshes; the solution knows how much it moves for it (``drift``).
"""

from dataclasses import dataclass

from metalens.modal.mesh import MeshPlan


@dataclass(frozen=True, slots=True)
class Rung:
    """A mesh and its error model.

    safety: factor on half the difference of the forms. thin, wide: relative error of transverse wavenumbers squared
    for a thin pillar and what a pillar of the size of the cell adds. usual: the estimate that it usually ends with.
    """

    name: str
    plan: MeshPlan
    safety: float
    thin: float
    wide: float
    usual: float

    def error(self, spread: float, drift: float, rho: float) -> float:
        """Error estimate of the mean of both forms, for a disc of ``rho`` pitches; see ``engine.Solution``."""
        return self.safety * spread + (self.thin + self.wide * rho**4) * drift + 1e-12


RUNGS = (
    Rung("coarse", MeshPlan(3, 3, 2, (0.7, 1.3), core=0.45), 1.5, 1e-4, 5e-4, 1e-2),
    Rung("fair", MeshPlan(3, 4, 3, (0.7, 1.3)), 1.5, 1.5e-5, 7e-5, 2e-3),
    Rung("good", MeshPlan(4, 5, 4, (0.7, 1.3)), 1.5, 3e-6, 0.0, 5e-4),
    Rung("fine", MeshPlan(5, 5, 5, (0.7,), (0.85, 1.0), (0.15, 1.0), core=0.55), 1.0, 1e-6, 0.0, 5e-5),
    Rung("finest", MeshPlan(6, 7, 6, (0.7, 1.3), (0.85, 1.0), (0.15, 1.0), core=0.55), 1.0, 1e-7, 0.0, 1e-5),
    Rung(
        "reference",
        MeshPlan(7, 7, 7, (0.7,), (0.75, 0.96, 1.0), (0.05, 0.3, 1.0), core=0.55),
        1.0,
        5e-8,
        0.0,
        2e-6,
    ),
)


def first_rung(tolerance: float) -> int:
    """Index of the coarsest mesh that usually meets the tolerance."""
    return next((i for i, rung in enumerate(RUNGS) if rung.usual <= tolerance), len(RUNGS) - 1)
