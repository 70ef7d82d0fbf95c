"""What a process leaves uncertain: standard deviations by name, and lenses drawn from
them.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.cell import Cell
from metalens.core.errors import ProcessError
from metalens.fabrication.perturbations import PERTURBATIONS, Drawn, lacking
from metalens.fabrication.state import State

DRAWN: dict[str, Drawn] = {
    row.drawn.name: row.drawn for row in PERTURBATIONS if row.drawn
}  # by entry, in the table's order
_Entries: Any = dataclasses.make_dataclass(
    "_Entries",
    [(name, float, entry.sigma) for name, entry in DRAWN.items()],
    frozen=True,
)


@dataclass(frozen=True)
class Spread(_Entries):  # type: ignore[misc]
    """Standard deviations of what the process leaves uncertain, one of every entry of
    :data:`DRAWN`.

    bias_nm: of all pillars together. gradient_nm: bias from one edge of the lens to the
    other, in a random direction.
    bow_nm: bias from centre to edge. height_nm, index, sidewall_deg: of the whole lens.
    width_nm, length_nm, turn_deg: of the sides of all rectangles or ellipses and of
    their turn; none unless stated.
    pedestal_nm, cap_nm: of the heights of films under and on a layered pillar's own
    material; none unless stated.
    """

    def __post_init__(self) -> None:
        for name, value in self.values().items():
            if not (value >= 0 and math.isfinite(value)):
                raise ProcessError(f"{name} = {value}: need a finite value >= 0")

    def values(self) -> dict[str, float]:
        """Standard deviations by entry."""
        return {name: float(getattr(self, name)) for name in DRAWN}

    @property
    def stated(self) -> dict[str, float]:
        """The same without entries that no process has unless it says so."""
        return {
            name: value
            for name, value in self.values().items()
            if value or DRAWN[name].sigma
        }

    def check(self, cell: Cell) -> None:
        """Refuse what pillars of this cell cannot have.

        Raises:
            ProcessError: naming the entry.
        """
        apart = {row.drawn.name: row.name for row in PERTURBATIONS if row.drawn}
        for name, value in self.stated.items():
            if value and apart[name] in lacking(cell):
                raise ProcessError(
                    f"spread.{name} = {value:g}: {cell.described} has none; need 0"
                )

    @classmethod
    def only(cls, **values: float) -> "Spread":
        """These standard deviations, and none of anything else."""
        return cls(**(dict.fromkeys(DRAWN, 0.0) | values))


@dataclass(frozen=True, slots=True)
class Draw:
    """One lens of a process: amounts by entry of the spread, and the direction that the
    lens drew for its gradients.
    """

    amounts: dict[str, float]
    turn_rad: float = 0.0

    def state(self) -> State:
        """The causes that these amounts mean."""
        found: dict[str, float] = {}
        for row in PERTURBATIONS:
            if row.drawn and row.drawn.name in self.amounts:
                found[row.name] = (
                    self.amounts[row.drawn.name]
                    * row.drawn.share
                    * self._direction(row.name)
                )
        return State.of(found)

    def _direction(self, cause: str) -> float:
        """1, or cosine and sine of the direction for the first and second cause of one
        entry.
        """
        entry = next(
            row.drawn.name for row in PERTURBATIONS if row.name == cause and row.drawn
        )
        together = [
            row.name for row in PERTURBATIONS if row.drawn and row.drawn.name == entry
        ]
        return (
            1.0
            if len(together) == 1
            else (math.cos, math.sin)[together.index(cause)](self.turn_rad)
        )


def draws(spread: Spread, count: int, *, seed: int) -> list[Draw]:
    """``count`` lenses of a process: normal amounts, gradients in any direction."""
    random, stated = np.random.default_rng(seed), spread.stated
    sigma = np.array(list(stated.values()))
    normal, turns = (
        random.standard_normal((count, len(sigma))) * sigma,
        random.uniform(0, 2 * np.pi, count),
    )
    return [
        Draw(dict(zip(stated, row.tolist(), strict=True)), float(turn))
        for row, turn in zip(normal, turns, strict=True)
    ]
