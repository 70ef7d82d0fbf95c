"""Marks of a die: crosses, coarse and fine, an F for its orientation, verniers and
boxes in boxes for its two steps.
"""

from dataclasses import dataclass

import numpy as np

from layout.mask import font
from layout.mask.plan import MaskPlan
from layout.process.process import Process
from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

CLEAR_UM = 10.0  # between the structures on the die, and of the openings around them
_QUARTER = np.array([[0, 1], [-1, 0]])  # turn, counter-clockwise


@dataclass(frozen=True)
class VernierShape:
    """Bars of a vernier, and the box in a box beside it.

    bars: on each side of the middle one.
    width_share: width of a bar over the pitch.
    bar_um, middle_bar_um: length of a bar, and of the middle one.
    gap_um: from the film's edge to the bars.
    inner_um, outer_um: sides of the boxes.
    """

    bars: int = 10
    width_share: float = 0.375
    bar_um: float = 12.0
    middle_bar_um: float = 16.0
    gap_um: float = 2.0
    inner_um: float = 10.0
    outer_um: float = 20.0


VERNIER = VernierShape()


@dataclass(frozen=True)
class MarkBox:
    """A rectangle in database units."""

    left: int
    bottom: int
    right: int
    top: int

    @property
    def polygon(self) -> Array:
        """Its corners."""
        return rectilinear.box_corners([self.left, self.bottom, self.right, self.top])

    def grown(self, by: int) -> "MarkBox":
        """A rectangle that is larger by ``by`` on each side."""
        return MarkBox(self.left - by, self.bottom - by, self.right + by, self.top + by)

    def meets(self, other: "MarkBox") -> bool:
        """Whether both have more than their edges in common."""
        across = self.left < other.right and other.left < self.right
        return across and self.bottom < other.top and other.bottom < self.top


def bounding_box(polygon: Array) -> MarkBox:
    """The box around a polygon."""
    return MarkBox(*(int(v) for v in (*polygon.min(0), *polygon.max(0))))


class DatabaseUnits:
    """From micrometres to database units on the grid."""

    def __init__(self, plan: MaskPlan) -> None:
        self.per_um = 1e3 / plan.unit_nm
        self.grid = plan.grid
        self.pitch = plan.lattices[0].constant

    def __call__(self, length_um: float) -> int:
        return round(length_um * self.per_um / self.grid) * self.grid

    def fifth(self, length: int) -> int:
        """A fifth of a length, down to the grid and at least one step of it.

        A fine cross has arms and lines of a fifth of the coarse one.
        """
        return max(self.grid, length // 5 // self.grid * self.grid)

    def snapped(self, box: MarkBox) -> MarkBox:
        """The box on the grid, no smaller."""
        g = self.grid
        return MarkBox(
            box.left // g * g,
            box.bottom // g * g,
            -(-box.right // g) * g,
            -(-box.top // g) * g,
        )


def alignment_crosses(
    process: Process, unit: DatabaseUnits, die: MarkBox
) -> tuple[tuple[Array, ...], list[MarkBox]]:
    """A coarse and a fine cross in each corner of the die, and an F in one corner.

    The F, next to the upper left cross, differs from all its rotations and mirror
    images.

    Args:
        process: size of marks and street.
        unit: of the plan.
        die: outline of the die.

    Returns:
        Polygons, and the windows that the aperture opens around them.
    """
    arm = unit(process.die.mark_um / 2)
    width = unit(process.die.mark_width_um / 2)
    inset = unit(process.die.street_um + CLEAR_UM) + arm
    fine = unit.fifth(arm)
    thin = unit.fifth(width)
    shapes: list[Array] = []
    boxes = []
    for sign_x, sign_y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        x, y = sign_x * (die.right - inset), sign_y * (die.top - inset)
        fine_y = y - sign_y * (arm + unit(CLEAR_UM) + fine)
        for centre, reach, half in (((x, y), arm, width), ((x, fine_y), fine, thin)):
            shapes.append(cross_polygon(*centre, reach, half))
            boxes.append(bounding_box(shapes[-1]).grown(unit(CLEAR_UM / 2)))
    square = max(2, arm // 10 // unit.grid * 2) * unit.grid
    left = die.left + inset + arm + unit(CLEAR_UM)
    bottom = die.top - inset - arm
    shapes += font.text_rectangles("F", x=left, y=bottom, square=square)
    boxes.append(
        MarkBox(left, bottom, left + 5 * square, bottom + 7 * square).grown(
            unit(CLEAR_UM / 2)
        )
    )
    return tuple(shapes), boxes


def cross_polygon(x: int, y: int, arm: int, half: int) -> Array:
    """(12, 2) corners of a cross at (x, y): arms of length ``arm`` from its middle,
    twice ``half`` wide.
    """
    upper = np.array([(half, half), (half, arm), (-half, arm)])
    quarters = [upper @ np.linalg.matrix_power(_QUARTER, k) for k in range(4)]
    return np.asarray(np.concatenate(quarters) + np.array([x, y]))


def wafer_cross(
    unit: DatabaseUnits, mark_um: float, width_um: float
) -> tuple[Array, ...]:
    """Four bars for the coarse alignment about (0, 0), and a fine cross in the middle
    that they leave free.

    Args:
        unit: of the plan.
        mark_um: arm length.
        width_um: line width.
    """
    arm = unit(mark_um / 2)
    half = unit(width_um / 2)
    inner = 2 * unit.fifth(arm)
    upright = np.array([[-half, inner], [half, inner], [half, arm], [-half, arm]])
    bars = [upright @ np.linalg.matrix_power(_QUARTER, k) for k in range(4)]
    return (*bars, cross_polygon(0, 0, inner // 2, unit.fifth(half)))


def vernier_scales(
    process: Process, unit: DatabaseUnits, die: MarkBox
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Verniers along x and y and a box in a box, left of the upper right cross: drawn
    with the pillars, and opened with the aperture.

    Args:
        process: pitch and step of the verniers, and whether there are any.
        unit: of the plan.
        die: outline of the die.

    Raises:
        ProcessError: the die is too narrow for them, or the step of the vernier is
            below the grid.
    """
    if not process.die.verniers:
        return (), ()
    pitch = unit(process.die.vernier_pitch_um)
    step = unit(process.die.vernier_step_nm * 1e-3)
    if step < unit.grid:
        raise ProcessError(
            f"die.vernier_step_nm = {process.die.vernier_step_nm}: need at least the grid of {process.rules.grid_nm} nm"
        )
    half_length = VERNIER.bars * (pitch + step) + pitch // 2
    clear = unit(CLEAR_UM)
    arm = unit(process.die.mark_um / 2)
    inset = unit(process.die.street_um + CLEAR_UM)
    bar_height = unit(VERNIER.middle_bar_um + 2 * VERNIER.gap_um)
    top = die.top - inset - bar_height
    right = die.right - inset - 2 * arm - 2 * clear
    vertical = right - bar_height, die.top - inset - half_length
    half_outer = unit(VERNIER.outer_um / 2)
    box_centre = (
        vertical[0] - bar_height - clear - half_outer,
        die.top - inset - half_outer,
    )
    horizontal = box_centre[0] - half_outer - clear - half_length, top
    square = unit.fifth(arm)
    right_of_cross = die.right - horizontal[0] + half_length
    need = right_of_cross + inset + 2 * arm + 2 * clear + 5 * square
    if need > die.right - die.left:
        raise ProcessError(
            f"the die is too narrow for VERNIERS: {need / unit.per_um:.0f} um are "
            "needed; raise die.margin_um or die.size_um, or set die.verniers = false"
        )
    drawn: list[Array] = []
    openings: list[Array] = []
    for centre, turn in ((horizontal, np.eye(2, dtype=int)), (vertical, _QUARTER)):
        bars, windows = _vernier(unit, pitch, step)
        drawn += [bar @ turn + np.array(centre) for bar in bars]
        openings += [bar @ turn + np.array(centre) for bar in windows]
    for shapes, half in ((drawn, unit(VERNIER.inner_um / 2)), (openings, half_outer)):
        shapes.append(MarkBox(*box_centre, *box_centre).grown(half).polygon)
    return tuple(drawn), tuple(openings)


def _vernier(
    unit: DatabaseUnits, pitch: int, step: int
) -> tuple[list[Array], list[Array]]:
    """Bars of a vernier about (0, 0), in database units; the middle one is longer.

    The drawn bars, in steps of ``pitch``, stand above the axis. The bars opened in the film,
    in steps of ``pitch + step``, are below it. An upright scale has its drawn bars on the
    left.

    Returns:
        Drawn bars; openings, the last of which is the window around the drawn bars.
    """
    half = max(
        unit.grid, round(pitch * VERNIER.width_share / 2 / unit.grid) * unit.grid
    )
    gap = unit(VERNIER.gap_um)
    drawn = []
    openings = []
    for n in range(-VERNIER.bars, VERNIER.bars + 1):
        end = gap + unit(VERNIER.bar_um if n else VERNIER.middle_bar_um)
        x, opened_x = n * pitch, n * (pitch + step)
        drawn.append(MarkBox(x - half, gap, x + half, end).polygon)
        openings.append(MarkBox(opened_x - half, -end, opened_x + half, -gap).polygon)
    reach = VERNIER.bars * pitch + pitch // 2
    window = MarkBox(-reach, 0, reach, 2 * gap + unit(VERNIER.middle_bar_um))
    return drawn, [*openings, unit.snapped(window).polygon]
