"""What a design-rule check found."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from layout.process import Rules


class HasUnit(Protocol):
    """A mask that knows its database unit."""

    @property
    def unit_nm(self) -> float:
        """Database unit."""
        ...


RULES = (
    "gap",
    "overlap",
    "foot",
    "feature",
    "off-grid",
    "density",
    "exclusion",
    "structures",
)
MOST_SHOWN = 500  # of one rule


@dataclass(frozen=True, slots=True)
class Violation:
    """One place where a rule is broken.

    box: (left, bottom, right, top) around it, database units. value, limit: found and
    allowed (nm, or a share).
    text: the cells that are concerned.
    """

    rule: str
    box: tuple[int, int, int, int]
    value: float
    limit: float
    text: str

    @property
    def centre(self) -> tuple[float, float]:
        """Middle of the box, database units."""
        return (self.box[0] + self.box[2]) / 2, (self.box[1] + self.box[3]) / 2


def told(size_nm: float | None) -> str:
    """A size that was found, with its unit; "none" where there was nothing to measure."""
    return (
        "none" if size_nm is None or not math.isfinite(size_nm) else f"{size_nm:.1f} nm"
    )


@dataclass(eq=False, slots=True)
class DrcReport:
    """Result of the check.

    pillars: all that were checked. counts: {rule: violations}, all of them;
    ``violations`` lists up to 500 of each.
    minimum_gap_nm, minimum_foot_gap_nm, minimum_feature_nm: the smallest found (inf
    where there is none).
    maximum_density: of any window.
    limits: {rule: limit}. limit_gap: in database units.
    """

    unit_nm: float
    limits: Mapping[str, float]
    limit_gap: float
    pillars: int = 0
    minimum_gap_nm: float = math.inf
    minimum_foot_gap_nm: float = math.inf
    minimum_feature_nm: float = math.inf
    maximum_density: float = 0.0
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(RULES, 0))
    violations: list[Violation] = field(default_factory=list)
    _listed: dict[str, int] = field(default_factory=lambda: dict.fromkeys(RULES, 0))

    @classmethod
    def empty(cls, plan: HasUnit, rules: Rules) -> "DrcReport":
        """A report before the first finding."""
        limits = {
            "gap": rules.minimum_gap_nm,
            "overlap": 0.0,
            "foot": rules.minimum_foot_gap_nm,
            "feature": rules.minimum_feature_nm,
            "off-grid": float(rules.grid_nm),
            "density": rules.maximum_density,
            "exclusion": 0.0,
            "structures": rules.minimum_gap_nm,
        }
        return cls(plan.unit_nm, limits, rules.minimum_gap_nm / plan.unit_nm)

    @property
    def ok(self) -> bool:
        """Whether no rule is broken."""
        return not any(self.counts.values())

    @property
    def sizes(self) -> dict[str, float | None]:
        """The smallest gap and feature that were found; None where there was nothing to
        measure.
        """
        found = {
            "minimum_gap_nm": self.minimum_gap_nm,
            "minimum_feature_nm": self.minimum_feature_nm,
        }
        found |= {"minimum_foot_gap_nm": self.minimum_foot_gap_nm}
        return {
            name: value if math.isfinite(value) else None
            for name, value in found.items()
        }

    def has_room(self, rule: str) -> bool:
        """Whether another violation of a rule would be listed."""
        return self._listed[rule] < MOST_SHOWN

    def add(self, rule: str, count: int, violation: Violation | None) -> None:
        """Count violations; list one."""
        self.add_all(rule, count, () if violation is None else (violation,))

    def add_all(self, rule: str, count: int, shown: Iterable[Violation]) -> None:
        """Count violations; list the first of them, as many as lists hold: no more of
        ``shown`` are made.
        """
        self.counts[rule] += count
        before = len(self.violations)
        self.violations += itertools.islice(shown, MOST_SHOWN - self._listed[rule])
        self._listed[rule] += len(self.violations) - before

    def exchanged(self) -> "DrcReport":
        """The report with gaps as features and features as gaps, of a mask whose clear
        areas stay.
        """
        name = {"gap": "feature", "feature": "gap"}
        other = dataclasses.replace(
            self,
            minimum_gap_nm=self.minimum_feature_nm,
            minimum_feature_nm=self.minimum_gap_nm,
            counts={rule: self.counts[name.get(rule, rule)] for rule in RULES},
            violations=[
                dataclasses.replace(v, rule=name.get(v.rule, v.rule))
                for v in self.violations
            ],
        )
        other._listed = {rule: self._listed[name.get(rule, rule)] for rule in RULES}
        return other

    @property
    def broken(self) -> str:
        """The rules that are broken, with how often, for a person; empty where all are
        kept.
        """
        return ", ".join(
            f"{count:,} {rule}" for rule, count in self.counts.items() if count
        )

    @property
    def summary(self) -> str:
        """One line for a person."""
        return (
            f"{self.pillars:,} pillars: smallest gap {told(self.minimum_gap_nm)}, "
            f"thinnest {told(self.minimum_feature_nm)}, density up to {self.maximum_density:.1%}; "
            + (f"violations: {self.broken}" if self.broken else "no violation")
        )
