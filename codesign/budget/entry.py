"""One line of the error budget."""

import math
from dataclasses import dataclass

NONE = math.nan
TOTAL, MEASURED = "all links", "measured, all at once"


@dataclass(frozen=True, slots=True)
class BudgetEntry:
    """One link: rms phase error over the pillars (rad), relative L2 error of the PSFs,
    gaze error (rad, mean angle).

    nan where the link has none. method: how it was found. counted: whether the sum
    holds it; a cause that the reader
    was trained with is no error of its answer.
    """

    link: str
    phase_rad: float
    psf: float
    gaze_rad: float
    method: str
    counted: bool = True


def quadrature_difference(error: float, before: float) -> float:
    """What an error has more than before, in quadrature; 0 where it has less."""
    return math.sqrt(max(error**2 - before**2, 0.0))


def quadrature_total(found: list[BudgetEntry]) -> BudgetEntry:
    """The root of the sum of squares of what counts."""

    def together(name: str) -> float:
        values = (getattr(e, name) for e in found if e.counted)
        return math.sqrt(sum(v**2 for v in values if math.isfinite(v)))

    missing = [e.link for e in found if e.counted and math.isnan(e.gaze_rad)]
    said = "root of the sum of squares" + (
        f"; without {', '.join(missing)}" if missing else ""
    )
    return BudgetEntry(
        TOTAL, together("phase_rad"), together("psf"), together("gaze_rad"), said
    )
