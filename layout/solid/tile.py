"""Pillars as solids: a tile of the lens with tapered pillars, and how many of them each
file format bears.
"""

from dataclasses import dataclass

import numpy as np

from layout.process import Process
from layout.solid.sections import Section, circles, sections
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.lens import Lens

# pillars a file may hold: beyond, viewers and CAD kernels give up, though the writers
# would not
LIMITS = {"STEP": 10_000, "STL": 500_000, "3MF": 200_000, "glTF": 50_000}


@dataclass(frozen=True, eq=False, slots=True)
class Tile:
    """Pillars of a part of a lens as the mask draws them: axis at (0, 0), +y up, feet
    on z = 0, tops at +z.

    foot_um, top_um: (classes,) diameters (that of the circle around it of a pillar that
    is not round); x_um, y_um:
    (pillars,) centres; kind: (pillars,) class of each. height_um: of all pillars.
    pitch_um: of the lattice.
    shaped: (classes,) sections of pillars that are not round, or turned. site_um2: area
    of one pillar's cell; 0: of a
    square lattice.
    """

    foot_um: Array
    top_um: Array
    x_um: Array
    y_um: Array
    kind: Array
    height_um: float
    pitch_um: float
    shaped: tuple[Section, ...] = ()
    site_um2: float = 0.0

    @property
    def sections(self) -> tuple[Section, ...]:
        """Of each class."""
        pairs = zip(
            self.names, self.foot_um.tolist(), self.top_um.tolist(), strict=True
        )
        return self.shaped or tuple(circles(*each) for each in pairs)

    @property
    def names(self) -> list[str]:
        """Label of each class, by its diameter at half height in nm; 105_9 is 105.9, as
        CAD takes no points.
        """
        if self.shaped:
            return [each.name for each in self.shaped]
        sizes = (
            f"{1e3 * d:.1f}".removesuffix(".0")
            for d in (self.foot_um + self.top_um) / 2
        )
        return [f"pillar_{size.replace('.', '_')}nm" for size in sizes]


def tile(
    lens: Lens,
    process: Process,
    *,
    side_um: float | None = None,
    centre_um: tuple[float, float] = (0.0, 0.0),
) -> Tile:
    """The pillars whose sites lie in a square of the lens (all of it without
    ``side_um``), as they will be made.

    Drawn in the steps of the process, then its bias (of a full lattice), corner
    rounding (of round ones) and tilted
    walls.

    Raises:
        ProcessError: no pillar in the square, a taper that leaves no top or makes the
            feet touch, openings of a film.
    """
    grid = lens.diameters
    away = abs(grid.x_um - centre_um[0]), abs(grid.y_um - centre_um[1])
    reach = np.inf if side_um is None else side_um / 2 + 1e-9
    columns, rows = np.flatnonzero(away[0] <= reach), np.flatnonzero(away[1] <= reach)
    part = np.zeros((0, 0))
    if len(rows) and len(columns):
        part = grid.diameter_um[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    row, column = np.nonzero(part)
    if not len(row):
        raise ProcessError(
            f"no pillar within {side_um} um around {centre_um}; move or enlarge the square"
        )
    place = grid.x_um[columns[column]], grid.y_um[rows[row]]
    if not (
        grid.plain and lens.cell.shape.kind == "circle" and not lens.cell.shape.hole
    ):
        found, kind = sections(lens, process, rows[row], columns[column])
        foot, top = (
            np.array([2 * getattr(each, end).radius_um for each in found])
            for end in ("foot", "top")
        )
        return Tile(
            foot,
            top,
            *place,
            kind,
            lens.cell.height_um,
            grid.pitch_um,
            found,
            grid.site_um2,
        )
    step = process.rules.diameter_step_nm
    drawn = np.rint(process.written_diameter_nm(part[row, column] * 1e3) / step).astype(
        np.int64
    )
    sizes, kind = np.unique(drawn, return_inverse=True)
    height = lens.cell.height_um
    top, foot = (
        d * 1e-3
        for d in process.top_foot_nm(
            process.made_diameter_nm(sizes * step), height * 1e3
        )
    )
    widest = np.maximum(top, foot)
    if min(top.min(), foot.min()) <= 0 or widest.max() >= grid.pitch_um:
        raise ProcessError(
            f"walls of {process.etch.sidewall_deg} degrees over {height} um make diameters from "
            f"{1e3 * min(top.min(), foot.min()):.0f} to {1e3 * widest.max():.0f} nm on a pitch of "
            f"{1e3 * grid.pitch_um:.0f} nm; need above 0 and below the pitch"
        )
    return Tile(foot, top, *place, kind, height, grid.pitch_um)


def check_count(pillars: Tile, form: str) -> None:
    """Refuse more pillars than a file of this form should hold.

    Raises:
        ProcessError: with the side of a square that would do.
    """
    limit, found = LIMITS[form], len(pillars.kind)
    if found > limit:
        side = (int(np.sqrt(limit)) - 1) * pillars.pitch_um
        if (
            pillars.site_um2
        ):  # rows closer or farther than columns: one more line on each side
            side = (int(np.sqrt(limit)) - 2) * float(np.sqrt(pillars.site_um2))
        raise ProcessError(
            f"{found:,} pillars are too many for {form} (at most {limit:,}); take a square of the lens with "
            f"side_um = {side:.1f} or less, or use the mask (OASIS) for the whole lens"
        )
