"""Sections with curved rims: circle, ellipse, ring."""

from dataclasses import dataclass
from typing import Literal

from metalens.cell.shapes.outline import EllipseArc, Outline
from metalens.core.errors import CellError


@dataclass(frozen=True, slots=True)
class Circle:
    """A disc; its size is the diameter. hole: the disc is the opening in a film of the
    pillar's material.

    kind: of the shape.
    """

    hole: bool = False
    kind: Literal["circle"] = "circle"

    @property
    def name(self) -> str:
        """In words, for reports."""
        return "circle"

    def outline(self, size_um: float, *, grow_um: float = 0.0) -> Outline:
        """The section of this diameter, wider by ``grow_um``."""
        half = _half(size_um + grow_um)
        return Outline((EllipseArc(half, half),))


@dataclass(frozen=True, slots=True)
class Ellipse:
    """Its size is the axis along x before the turn; ratio: of the other axis to it.

    angle_rad: in the plane, from +x towards +y. grow_um moves both axes (not
    quite a parallel curve: the error
    is of second order in grow / axis).
    hole: an opening in a film. kind: of the shape.
    """

    ratio: float = 1.0
    angle_rad: float = 0.0
    hole: bool = False
    kind: Literal["ellipse"] = "ellipse"

    def __post_init__(self) -> None:
        if not 0.01 <= self.ratio <= 100:
            raise CellError(
                f"ellipse ratio = {self.ratio}: need the other axis over the size, 0.01 to 100"
            )

    @property
    def name(self) -> str:
        """In words, for reports."""
        return f"ellipse 1:{self.ratio:g}"

    def outline(self, size_um: float, *, grow_um: float = 0.0) -> Outline:
        """The section of this size, wider by ``grow_um`` along every axis."""
        half = (_half(size_um + grow_um), _half(self.ratio * size_um + grow_um))
        return Outline((EllipseArc(*half, self.angle_rad),))


@dataclass(frozen=True, slots=True)
class Ring:
    """A disc with a round hole; its size is the outer diameter. ratio: of the inner to
    the outer diameter.

    hole: an opening in a film. kind: of the shape.
    """

    ratio: float = 0.5
    hole: bool = False
    kind: Literal["ring"] = "ring"

    def __post_init__(self) -> None:
        if not 0 < self.ratio < 1:
            raise CellError(
                f"ring ratio = {self.ratio}: need the inner over the outer diameter, between 0 and 1"
            )

    @property
    def name(self) -> str:
        """In words, for reports."""
        return f"ring {self.ratio:g}"

    def outline(self, size_um: float, *, grow_um: float = 0.0) -> Outline:
        """The section of this outer diameter; ``grow_um`` widens the rim and closes the
        hole.
        """
        outer = _half(size_um + grow_um)
        inner = self.ratio * size_um / 2 - grow_um / 2
        rim = EllipseArc(outer, outer)
        return Outline(
            (rim, EllipseArc(inner, inner, sign=-1)) if inner > 0 else (rim,)
        )


def _half(width_um: float) -> float:
    """Half of a width, um.

    Raises:
        CellError: no width above 0.
    """
    if not width_um > 0:
        raise CellError(
            f"an outline {width_um:.4g} um wide: nothing is left; need a larger size or less bias"
        )
    return width_um / 2
