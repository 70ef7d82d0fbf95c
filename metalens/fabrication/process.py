"""State and spread of the perturbations of a process, lenses drawn from it, and its part
of PROCESS.toml.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from metalens.cell import Cell
from metalens.core import config
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, ProcessError, nearest_name_hint
from metalens.fabrication.bias import Bias, read_csv
from metalens.fabrication.perturbations import (
    PERTURBATIONS,
    CDError,
    DrawnPerturbation,
    Kind,
    ResponseError,
    WavefrontError,
    inapplicable_names,
    of_kind,
    polynomial_coefficients,
    response_errors,
)

DRAWN: dict[str, DrawnPerturbation] = {
    row.drawn.name: row.drawn for row in PERTURBATIONS if row.drawn
}  # by entry, in the table's order
_Entries: Any = dataclasses.make_dataclass(
    "_Entries",
    [(name, float, entry.sigma) for name, entry in DRAWN.items()],
    frozen=True,
)


@dataclass(frozen=True, eq=False, slots=True)
class State:
    """How much of each cause a lens has: (causes,) in the order and units of
    :data:`metalens.fabrication.PERTURBATIONS`.
    """

    amounts: Array

    @classmethod
    def of(cls, values: Mapping[str, float] | None = None) -> Self:
        """The state with these amounts by name, all others 0 (as designed).

        Raises:
            ConfigError: an unknown name.
        """
        names = [row.name for row in PERTURBATIONS]
        for name in values or {}:
            if name not in names:
                raise ConfigError(
                    f"unknown cause {name!r}{nearest_name_hint(name, names)}"
                )
        return cls(np.array([(values or {}).get(name, 0.0) for name in names]))

    def __getitem__(self, name: str) -> float:
        return float(self.amounts[[row.name for row in PERTURBATIONS].index(name)])

    def bias_polynomial_um(self) -> Array:
        """(i, j) coefficients of u^i v^j of the change of the diameters."""
        return self._polynomial(CDError)

    def bias_um(self, u: Array, v: Array) -> Array:
        """Change of the diameters at lens places over the radius; shapes broadcast."""
        u, v = np.broadcast_arrays(u, v)
        return np.asarray(
            np.polynomial.polynomial.polyval2d(u, v, self.bias_polynomial_um())
        )

    def phase_rad(self, u: Array, v: Array) -> Array:
        """Phase added to the wave front at lens places over the radius; shapes
        broadcast.
        """
        u, v = np.broadcast_arrays(u, v)
        return np.asarray(
            np.polynomial.polynomial.polyval2d(u, v, self._polynomial(WavefrontError))
        )

    def has_wavefront_error(self) -> bool:
        """Whether the wave front has any phase of its own."""
        return bool(self._amounts(WavefrontError).any())

    def response_amounts(self) -> Array:
        """(pillar-response errors,) amounts in um, rad and 1, as the pillars'
        derivatives take them.
        """
        return self._amounts(ResponseError) * [row.unit for row, _ in response_errors()]

    def _amounts(self, kind: Kind) -> Array:
        """Amounts of the causes that act in one way, in the order of the table."""
        return self.amounts[[n for n, _ in of_kind(kind)]]

    def _polynomial(self, kind: type[CDError] | type[WavefrontError]) -> Array:
        return np.asarray(
            np.tensordot(self._amounts(kind), polynomial_coefficients(kind), 1)
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
        """Standard deviations that are above 0, or whose default is."""
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
        row_names = {row.drawn.name: row.name for row in PERTURBATIONS if row.drawn}
        for name, value in self.stated.items():
            if value and row_names[name] in inapplicable_names(cell):
                raise ProcessError(
                    f"spread.{name} = {value:g}: {cell.described} has none; need 0"
                )

    @classmethod
    def only(cls, **values: float) -> "Spread":
        """These standard deviations, and none of anything else."""
        return cls(**(dict.fromkeys(DRAWN, 0.0) | values))


@dataclass(frozen=True, slots=True)
class Draw:
    """A random lens of a process.

    amounts: by entry of the spread. turn_rad: direction of its gradients.
    """

    amounts: dict[str, float]
    turn_rad: float = 0.0

    def state(self) -> State:
        """State of a lens: amount of each entry × share × direction cosine or sine.

        The latter are of the first and second cause of one entry, 1 where it has one.
        """
        rows = [row for row in PERTURBATIONS if row.drawn]
        causes = Counter(row.drawn.name for row in rows if row.drawn)
        components = (math.cos(self.turn_rad), math.sin(self.turn_rad))
        before = Counter[str]()
        amounts: dict[str, float] = {}
        for row in rows:
            if row.drawn and row.drawn.name in self.amounts:
                entry = row.drawn.name
                direction = components[before[entry]] if causes[entry] > 1 else 1.0
                before[entry] += 1
                amounts[row.name] = self.amounts[entry] * row.drawn.share * direction
        return State.of(amounts)


def draw_lenses(spread: Spread, count: int, *, seed: int) -> list[Draw]:
    """Random lenses of a process: normal amounts, uniform direction of the gradients.

    Args:
        spread: standard deviations of the process.
        count: number of lenses.
        seed: of the random generator.
    """
    random = np.random.default_rng(seed)
    stated = spread.stated
    sigma = np.array(list(stated.values()))
    normal = random.standard_normal((count, len(sigma))) * sigma
    turns = random.uniform(0, 2 * np.pi, count)
    return [
        Draw(dict(zip(stated, row.tolist(), strict=True)), float(turn))
        for row, turn in zip(normal, turns, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class PrintedProcess:
    """bias: of what is drawn. spread: of the process. diameter_step_nm: of the mask's
    pillars.
    """

    bias: Bias = field(default_factory=Bias)
    spread: Spread = field(default_factory=Spread)
    diameter_step_nm: float = 2.0  # one class of pillars each


def of_process(path: str | Path) -> PrintedProcess:
    """Bias, spread and diameter step of a PROCESS.toml; ``layout`` reads its other
    tables.

    CSV files that it names lie in its folder.

    Args:
        path: of PROCESS.toml.

    Raises:
        ConfigError: missing file, not TOML, or a wrong entry, with file and key.
        ProcessError: a bias table that is unreadable or impossible.
    """
    path = Path(path)
    table = config.read(path, PrintedProcess)
    entries: dict[str, Any] = {
        name: table[name] for name in ("bias", "spread") if name in table
    }
    rules = table.get("rules", {})
    if isinstance(rules, dict) and "diameter_step_nm" in rules:
        entries["diameter_step_nm"] = rules["diameter_step_nm"]
    printed = config.from_table(entries, PrintedProcess, where=str(path))
    return dataclasses.replace(printed, bias=with_table(printed.bias, path.parent))


def with_table(bias: Bias, folder: str | Path) -> Bias:
    """``bias`` with the CSV file that it names read in from ``folder``."""
    if bias.csv is None:
        return bias
    return dataclasses.replace(
        bias, csv=None, table_nm=read_csv(Path(folder) / bias.csv)
    )
