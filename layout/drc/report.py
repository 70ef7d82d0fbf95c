"""Result of a design-rule check."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from layout.drc.geometry import SHARPEST_CORNER
from layout.process.process import DesignRules, LayerNumber
from layout.shapes.rectilinear import IntBox

MAX_LISTED = 500  # violations of one rule with their places
RULES = (
    "width",
    "space",
    "notch",
    "corner",
    "overlap",
    "foot",
    "off-grid",
    "density",
    "clearance",
)
_UNITS = {"corner": " degrees", "density": ""}


@dataclass(frozen=True)
class RuleViolation:
    """One place where a rule is violated.

    rule: one of ``RULES``.
    box: left, bottom, right, top around the place, database units.
    value: measured: nm, degrees of a "corner", a fraction for "density".
    limit: allowed, in the same unit.
    text: the cells concerned.
    """

    rule: str
    box: IntBox
    value: float
    limit: float
    text: str

    @property
    def centre(self) -> tuple[float, float]:
        """Middle of the box, database units."""
        left, bottom, right, top = self.box
        return (left + right) / 2, (bottom + top) / 2

    @property
    def summary(self) -> str:
        """Measured value, limit and cells, for a person."""
        unit = _UNITS.get(self.rule, " nm")
        return f"{self.value:.4g}{unit}, need {self.limit:.4g}; {self.text}"


@dataclass
class ViolationTally:
    """Number of violations, and the worst value in the unit of its rule."""

    count: int
    worst: float


@dataclass(frozen=True)
class LayerCoverage:
    """Whether the shapes of a layer were checked, and how many the hierarchy draws."""

    checked: bool
    shapes: int


@dataclass(eq=False)
class DrcReport:
    """Violations by rule, layer and cell, with the extreme sizes measured.

    unit_nm: database unit.
    limits: {rule: limit}, nm, degrees or a fraction.
    shapes: number of shapes checked.
    layers: {(layer, datatype): coverage} of a file; None for a mask plan, which is
        checked whole.
    tallies: {(rule, layer number, cell): tally}; all violations.
    violations: the first 500 of each rule, with their places.
    minimum_width_nm, minimum_space_nm, minimum_foot_space_nm: smallest measured, inf
        for none.
    maximum_density: largest fraction of any density window.
    """

    unit_nm: float
    limits: dict[str, float]
    shapes: int = 0
    layers: dict[LayerNumber, LayerCoverage] | None = None
    tallies: dict[tuple[str, int, str], ViolationTally] = field(default_factory=dict)
    violations: list[RuleViolation] = field(default_factory=list)
    minimum_width_nm: float = math.inf
    minimum_space_nm: float = math.inf
    minimum_foot_space_nm: float = math.inf
    maximum_density: float = 0.0
    _listed: dict[str, int] = field(default_factory=dict)

    @classmethod
    def empty(cls, unit_nm: float, rules: DesignRules) -> "DrcReport":
        """A report without findings; ``unit_nm`` is the database unit."""
        limits = dict.fromkeys(RULES, 0.0)
        limits |= dict.fromkeys(("space", "notch", "clearance"), rules.minimum_gap_nm)
        limits["width"] = rules.minimum_feature_nm
        limits["corner"] = SHARPEST_CORNER
        limits["foot"] = rules.minimum_foot_gap_nm
        limits["off-grid"] = float(rules.grid_nm)
        limits["density"] = rules.maximum_density
        return cls(unit_nm, limits)

    @property
    def counts(self) -> dict[str, int]:
        """{rule: number of violations}, all layers and cells."""
        counts = dict.fromkeys(RULES, 0)
        for (rule, _, _), tally in self.tallies.items():
            counts[rule] += tally.count
        return counts

    @property
    def is_empty(self) -> bool:
        """Whether no shape of the file was checked."""
        return self.layers is not None and not self.shapes

    @property
    def ok(self) -> bool:
        """Whether shapes were checked and no rule is violated."""
        return not self.is_empty and not self.tallies

    @property
    def violated(self) -> str:
        """The rules violated and how often, for a person; empty where all are kept."""
        counts = self.counts.items()
        return ", ".join(f"{count:,} {rule}" for rule, count in counts if count)

    @property
    def sizes(self) -> dict[str, float | None]:
        """The smallest sizes measured in nm; None where nothing was measured."""
        names = ("minimum_width_nm", "minimum_space_nm", "minimum_foot_space_nm")
        values = {name: getattr(self, name) for name in names}
        return {n: v if math.isfinite(v) else None for n, v in values.items()}

    @property
    def worst(self) -> list[dict[str, Any]]:
        """Count and worst value by rule, layer and cell, the most frequent first."""
        tallies = sorted(self.tallies.items(), key=lambda item: -item[1].count)
        return [
            {
                "rule": rule,
                "layer": layer,
                "cell": cell,
                "count": tally.count,
                "worst": tally.worst,
                "limit": self.limits[rule],
            }
            for (rule, layer, cell), tally in tallies
        ]

    @property
    def summary(self) -> str:
        """One line for a person."""
        violations = f"violations: {self.violated}" if self.violated else "no violation"
        return (
            f"{self.shapes:,} shapes: minimum space {format_size(self.minimum_space_nm)}, "
            f"minimum width {format_size(self.minimum_width_nm)}, "
            f"density up to {self.maximum_density:.1%}; {violations}"
        )

    def scale(self, rule: str) -> float:
        """Unit of the values of a rule, over that of the geometry."""
        return 1.0 if rule == "corner" else self.unit_nm

    def add(
        self,
        rule: str,
        count: int,
        *,
        layer: int,
        cell: str,
        worst: float,
        examples: Iterable[RuleViolation] = (),
    ) -> None:
        """Count violations, and list the first of them.

        Args:
            rule: one of ``RULES``.
            count: number of violations.
            layer: layer number, -1 where it has none.
            cell: cell that draws them.
            worst: worst value, in the unit of the rule.
            examples: the violations; no more are generated than the list takes.
        """
        if not count:
            return
        tally = self.tallies.setdefault((rule, layer, cell), ViolationTally(0, worst))
        tally.count += count
        choose = max if rule == "density" else min
        tally.worst = choose(tally.worst, worst)
        self.list_violations(rule, examples)

    def add_equal(
        self,
        rule: str,
        value: float,
        boxes: Iterable[IntBox],
        *,
        count: int,
        layer: int,
        cell: str,
        text: str = "",
    ) -> None:
        """Count violations of one value, and list the first of them.

        Args:
            rule: one of ``RULES``.
            value: measured, in the unit of the rule.
            boxes: around the violations; no more are generated than the list takes.
            count: number of violations.
            layer: layer number, -1 where it has none.
            cell: cell that draws them.
            text: the cells concerned, where these are more than ``cell``.
        """
        limit = self.limits[rule]
        examples = (
            RuleViolation(rule, box, value, limit, text or cell) for box in boxes
        )
        self.add(rule, count, layer=layer, cell=cell, worst=value, examples=examples)

    def list_violations(self, rule: str, violations: Iterable[RuleViolation]) -> None:
        """List violations of a rule as far as there is room, and generate no more.

        Args:
            rule: one of ``RULES``.
            violations: with their places.
        """
        room = MAX_LISTED - self._listed.get(rule, 0)
        before = len(self.violations)
        self.violations += islice(violations, room)
        self._listed[rule] = MAX_LISTED - room + len(self.violations) - before

    def measured(self, rule: str, value_nm: float) -> None:
        """Lower the smallest width, or the smallest space.

        Args:
            rule: "width", "space" or "notch"; a "corner" has no size.
            value_nm: measured.
        """
        if rule == "width":
            self.minimum_width_nm = min(self.minimum_width_nm, value_nm)
        elif rule != "corner":
            self.minimum_space_nm = min(self.minimum_space_nm, value_nm)


def format_size(size_nm: float | None) -> str:
    """A size with its unit, "none" where nothing was measured (None or inf).

    Args:
        size_nm: in nanometres.
    """
    measured = size_nm is not None and math.isfinite(size_nm)
    return f"{size_nm:.1f} nm" if measured else "none"
