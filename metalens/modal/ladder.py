"""The ladder of meshes: which one to try first for a tolerance, and what its difference of forms is worth.

Each rung knows the factor by which half the difference of the two forms must be multiplied to bound the error of
their mean. Coarse meshes err alike in both forms where a resonance is steep, so their factor is above 1; on fine
ones the mean is far better than the difference says.
"""

from dataclasses import dataclass

from metalens.modal.mesh import MeshPlan


@dataclass(frozen=True, slots=True)
class Rung:
    """A mesh, its safety factor on half the difference of the forms, and the error it usually meets."""

    name: str
    plan: MeshPlan
    safety: float
    usual: float

    def error(self, half_difference: float) -> float:
        """Error estimate of the mean of both forms.

        What both forms miss alike (smooth waves on polynomials) is covered by a thousandth of the usual error.
        """
        return self.safety * half_difference + 1e-3 * self.usual


RUNGS = (
    Rung("coarse", MeshPlan(3, 3, 2, (0.7, 1.3), core=0.45), 4.0, 1e-2),
    Rung("fair", MeshPlan(3, 4, 3, (0.7, 1.3)), 3.0, 2e-3),
    Rung("good", MeshPlan(4, 5, 4, (0.7, 1.3)), 2.0, 5e-4),
    Rung("fine", MeshPlan(5, 5, 5, (0.7,), (0.85, 1.0), (0.15, 1.0), core=0.55), 1.5, 5e-5),
    Rung("finest", MeshPlan(6, 7, 6, (0.7, 1.3), (0.85, 1.0), (0.15, 1.0), core=0.55), 1.0, 1e-5),
    Rung("reference", MeshPlan(7, 7, 7, (0.7,), (0.75, 0.96, 1.0), (0.05, 0.3, 1.0), core=0.55), 1.0, 2e-6),
)


def first_rung(tolerance: float) -> int:
    """Index of the coarsest mesh that usually meets the tolerance."""
    return next((i for i, rung in enumerate(RUNGS) if rung.usual <= tolerance), len(RUNGS) - 1)
