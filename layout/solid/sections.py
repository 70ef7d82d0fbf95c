"""Sections of pillars that are not round, or turned one by one, as they will be made:
at the foot and at the top.
"""

import math
from dataclasses import dataclass

import numpy as np

from layout.process import Process
from metalens.cell import Cell
from metalens.cell.shapes import Conic, Outline
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError, ProcessError
from metalens.ground.units import nm
from metalens.lens import Lens
from metalens.pillars.axes import sized

_UPRIGHT_UM = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class Section:
    """What a class of pillars is: its name, and its outline at the foot and at the top,
    alike in their parts.
    """

    name: str
    foot: Outline
    top: Outline

    @property
    def upright(self) -> bool:
        """Whether top and foot are the same, to 1e-6 um."""
        return abs(self.foot.radius_um - self.top.radius_um) < _UPRIGHT_UM

    def volume_um3(self, height_um: float) -> float:
        """Between the two outlines, whose half axes and corners go straight from one to
        the other: exact.
        """
        return (
            height_um
            / 6
            * (self.foot.area_um2 + 4 * self._middle() + self.top.area_um2)
        )

    def _middle(self) -> float:
        total = 0.0
        for low, high in zip(self.foot.parts, self.top.parts, strict=True):
            if isinstance(low, Conic) and isinstance(high, Conic):
                sides = (
                    (low.half_x_um + high.half_x_um) / 2,
                    (low.half_y_um + high.half_y_um) / 2,
                )
                total += low.sign * math.pi * sides[0] * sides[1]
            else:
                x, y = ((low.vertices(0) + high.vertices(0)) / 2).T
                total += low.sign * float(
                    (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
                )
        return total


def circles(name: str, foot_um: float, top_um: float) -> Section:
    """Of a round pillar with these diameters."""
    return Section(name, *(Outline((Conic(d / 2, d / 2),)) for d in (foot_um, top_um)))


def sections(
    lens: Lens, process: Process, row: Array, column: Array
) -> tuple[tuple[Section, ...], Array]:
    """The classes of pillars of a lens at these sites, and (n,) which each of them is.

    Sizes and turns in the steps in which the mask draws them, edges as the bias makes
    them, walls tilted.

    Raises:
        ProcessError: openings of a film; walls that leave no top, close a hole or make
            the feet touch.
    """
    d, cell = lens.diameters, lens.cell
    if cell.shape.hole:
        raise ProcessError(
            f"solids of {cell.described}: pillars that stand are written, not openings of a film"
        )
    turns = round(360 / process.rules.angle_step_deg)
    keys = np.zeros((len(row), 3), np.int64)
    keys[:, 0] = _drawn(d.diameter_um[row, column], process)
    if d.length_um is not None:
        keys[:, 1] = _drawn(d.length_um[row, column], process)
    if d.angle_rad is not None:
        keys[:, 2] = (
            np.rint(
                np.degrees(d.angle_rad[row, column]) / process.rules.angle_step_deg
            ).astype(int)
            % turns
        )
    used, kind = np.unique(keys, axis=0, return_inverse=True)
    found = tuple(_section(cell, process, *key) for key in used.tolist())
    return found, kind.reshape(-1)


def _drawn(size_um: Array, process: Process) -> Array:
    step = process.rules.diameter_step_nm
    return np.asarray(
        np.rint(process.bias.drawn_nm(np.asarray(size_um, float) / nm) / step).astype(
            np.int64
        )
        * step
    )


def _section(
    cell: Cell, process: Process, drawn: int, length: int, turn: int
) -> Section:
    """What becomes of a drawn size (nm), length (nm; 0: by the shape) and turn (steps)."""
    made, long = (
        float(process.bias.made_nm(np.array(float(size)))) for size in (drawn, length)
    )
    shaped = sized(cell, made, long) if length else cell
    lean_um = cell.height_um * math.tan(math.radians(process.etch.sidewall_deg))
    turn_deg = turn * process.rules.angle_step_deg
    try:
        foot, middle, top = (
            shaped.outline(made * nm, grow_um=g).turned(math.radians(turn_deg))
            for g in (lean_um, 0, -lean_um)
        )
        closed = not len(foot.parts) == len(middle.parts) == len(top.parts)
    except CellError:
        closed = True
    if (
        closed
        or max(foot, top, key=lambda o: o.radius_um).gap_um(
            cell.lattice.steps_um(cell.pitch_um)
        )
        <= 0
    ):
        raise ProcessError(
            f"walls of {process.etch.sidewall_deg} degrees over {cell.height_um} um leave nothing of the top, "
            f"close a hole or make the feet touch, of a {cell.shape.name} {made:.0f} nm wide on a pitch of "
            f"{cell.pitch_um / nm:.0f} nm"
        )
    name = (
        f"pillar_{made:.1f}".removesuffix(".0")
        + (f"x{long:.1f}".removesuffix(".0") if length else "")
        + "nm"
    )
    return Section(
        (name + (f"_{turn_deg:g}deg" if turn else "")).replace(".", "_"), foot, top
    )
