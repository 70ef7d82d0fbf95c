"""Solids of the pillars in a window of a lens: STL and STEP."""

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from layout.process.process import Process
from layout.shapes import region
from metalens.cell import Cell
from metalens.cell.shapes import EllipseArc, Outline, PolygonLoop
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import CellError, ProcessError
from metalens.core.units import nm
from metalens.lens import Lens
from metalens.library.axes import cell_of_sizes

# pillars that viewers and CAD kernels still open
MAX_PILLARS = {"STEP": 10_000, "STL": 500_000}
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
_PILLARS_PER_BLOCK = 4096
_UPRIGHT_UM = 1e-6
_STEP_TIME = "2000-01-01T00:00:00"  # in the header: the same bytes for the same solids
_SUBSTRATE_COLOUR, _PILLAR_COLOUR = (0.75, 0.85, 0.95), (0.25, 0.35, 0.75)


@dataclass(frozen=True, eq=False)
class SolidSection:
    """Outlines of a class of pillars at foot and top, with corresponding parts.

    name: label, by its size at half height in nm; "105_9" is 105.9.
    """

    name: str
    foot: Outline
    top: Outline

    @property
    def is_upright(self) -> bool:
        """Whether foot and top are equal, to 1e-6 um."""
        return abs(self.foot.radius_um - self.top.radius_um) < _UPRIGHT_UM


@dataclass(frozen=True, eq=False)
class SolidTile:
    """Pillars of a part of a lens as fabricated: axis at (0, 0), feet on z = 0.

    sections: of each class.
    x_um, y_um: (pillars,) centres, +y up.
    kind: (pillars,) class of each.
    height_um: of all pillars.
    pitch_um: of the lattice.
    site_um2: area of the unit cell of one pillar.
    """

    sections: tuple[SolidSection, ...]
    x_um: Array
    y_um: Array
    kind: Array
    height_um: float
    pitch_um: float
    site_um2: float


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A closed surface.

    vertices_um: (n, 3) corners.
    triangles: (m, 3) numbers of corners, counter-clockwise from outside.
    """

    vertices_um: Array
    triangles: Array


def cut_tile(
    lens: Lens,
    process: Process,
    *,
    side_um: float | None = None,
    centre_um: tuple[float, float] = (0.0, 0.0),
) -> SolidTile:
    """The pillars of a square of a lens as fabricated: bias, rounding, sidewalls.

    Args:
        lens: pillars that stand, of any shape.
        process: steps of the drawn sizes, bias and sidewall angle.
        side_um: side of the square; None: the whole lens.
        centre_um: x and y of its centre.

    Raises:
        ProcessError: no pillar in the square, sidewalls that leave no top or make the
            feet touch, openings of a film.
    """
    grid = lens.diameters
    x, y = abs(grid.x_um - centre_um[0]), abs(grid.y_um - centre_um[1])
    reach = np.inf if side_um is None else side_um / 2 + 1e-9
    columns = np.flatnonzero(x <= reach)
    rows = np.flatnonzero(y <= reach)
    sizes = np.zeros((0, 0))
    if len(rows) and len(columns):
        sizes = grid.diameter_um[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    row, column = np.nonzero(sizes)
    if not len(row):
        raise ProcessError(
            f"no pillar within {side_um} um around {centre_um}; move or enlarge the square"
        )
    size_um = np.asarray(sizes[row, column], float)
    row, column = rows[row], columns[column]
    if lens.cell.shape.hole:
        raise ProcessError(
            f"solids of {lens.cell.described}: only pillars that stand are written, "
            "not openings of a film"
        )
    sections, kind = _sections(lens, process, size_um, (row, column))
    return SolidTile(
        sections,
        grid.x_um[column],
        grid.y_um[row],
        kind,
        lens.cell.height_um,
        grid.pitch_um,
        grid.site_um2,
    )


def _label(width_nm: float, length_nm: float = 0.0, turn_deg: float = 0.0) -> str:
    """Name of a class without points, which CAD does not take."""
    sizes = [f"{s:.1f}".removesuffix(".0") for s in (width_nm, length_nm) if s]
    turn = f"_{turn_deg:g}deg" if turn_deg else ""
    return f"pillar_{'x'.join(sizes)}nm{turn}".replace(".", "_")


def _sections(
    lens: Lens, process: Process, size_um: Array, sites: tuple[Array, Array]
) -> tuple[tuple[SolidSection, ...], Array]:
    """Sections of pillars of any shape and rotation.

    Args:
        lens: sizes, lengths and rotations.
        process: bias, steps and sidewalls; corners of drawn discs round off.
        size_um: (pillars,) designed sizes.
        sites: rows and columns of the pillars.

    Returns:
        A section of each distinct (size, length, rotation), and (pillars,) which of
        them each pillar has.
    """
    grid = lens.diameters
    step = process.rules.diameter_step_nm
    is_disc = grid.plain and lens.cell.shape.kind == "circle"
    draw = process.written_diameter_nm if is_disc else process.bias.drawn_nm
    make = process.made_diameter_nm if is_disc else process.bias.fabricated_nm

    def drawn_steps(size_um: Array) -> Array:
        drawn = draw(np.asarray(size_um, float) / nm)
        return np.rint(drawn / step).astype(np.int64) * step

    keys = np.zeros((len(size_um), 3), np.int64)
    keys[:, 0] = drawn_steps(size_um)
    if grid.length_um is not None:
        keys[:, 1] = drawn_steps(grid.length_um[sites])
    if grid.angle_rad is not None:
        angle = np.degrees(grid.angle_rad[sites]) / process.rules.angle_step_deg
        turns = round(360 / process.rules.angle_step_deg)
        keys[:, 2] = np.rint(angle).astype(int) % turns
    distinct, kind = np.unique(keys, axis=0, return_inverse=True)
    made_nm = np.where(distinct[:, :2] > 0, make(distinct[:, :2]), 0.0)
    sections = tuple(
        _section(lens.cell, process, width, length, turn)
        for (width, length), turn in zip(
            made_nm.tolist(), distinct[:, 2].tolist(), strict=True
        )
    )
    return sections, kind.reshape(-1)


def _section(
    cell: Cell, process: Process, width: float, length: float, turn: int
) -> SolidSection:
    """Section of a pillar: outlines at foot and top, from that at half height.

    Args:
        cell: shape and height of the pillar.
        process: sidewall angle.
        width: fabricated size, nm.
        length: fabricated length, nm; 0: set by the shape.
        turn: rotation in steps of the process.

    Raises:
        ProcessError: the walls leave no top, close a hole or make the feet touch.
    """
    angle = turn * process.rules.angle_step_deg
    shape = cell_of_sizes(cell, width, length) if length else cell
    lean_um = cell.height_um * math.tan(math.radians(process.etch.sidewall_deg))
    is_impossible = True
    try:
        foot, middle, top = (
            shape.outline(width * nm, grow_um=grow_um).turned(math.radians(angle))
            for grow_um in (lean_um, 0, -lean_um)
        )
        is_impossible = not len(foot.parts) == len(middle.parts) == len(top.parts)
    except CellError:
        pass
    if not is_impossible:
        largest = max(foot, top, key=lambda outline: outline.radius_um)
        is_impossible = largest.gap_um(cell.lattice.steps_um(cell.pitch_um)) <= 0
    if is_impossible:
        raise ProcessError(
            f"walls of {process.etch.sidewall_deg} degrees over {cell.height_um} um "
            "leave nothing of the top, close a hole or make the feet touch, of a "
            f"{cell.shape.name} {width:.0f} nm wide on a pitch of "
            f"{cell.pitch_um / nm:.0f} nm"
        )
    return SolidSection(_label(width, length, angle), foot, top)


def check_count(pillars: SolidTile, form: str) -> None:
    """Refuse more pillars than a file can hold.

    Args:
        pillars: to be written.
        form: "STEP" or "STL".

    Raises:
        ProcessError: with the side of a square that would do.
    """
    limit = MAX_PILLARS[form]
    count = len(pillars.kind)
    if count > limit:
        side = (math.isqrt(limit) - 2) * math.sqrt(pillars.site_um2)
        raise ProcessError(
            f"{count:,} pillars are too many for {form} (at most {limit:,}); take a "
            f"square of the lens with side_um = {side:.1f} or less, or use the mask "
            "(OASIS) for the whole lens"
        )


def mesh_section(
    section: SolidSection, height_um: float, *, sides: int = 8
) -> TriangleMesh:
    """Triangulated surface of a pillar; volume between sections is linear in z.

    Args:
        section: outlines at foot and top.
        height_um: of the pillar.
        sides: edges of each curved part, of its area.
    """
    contours = [
        tuple(part.vertices(sides)[:: part.sign] for part in (low, high))
        for low, high in zip(section.foot.parts, section.top.parts, strict=True)
    ]
    foot, top = (np.concatenate([pair[end] for pair in contours]) for end in (0, 1))
    corner_count = len(foot)
    start = 0
    faces = []
    for low, _ in contours:
        at_foot = start + np.arange(len(low))
        next_at_foot = start + (np.arange(len(low)) + 1) % len(low)
        faces.append(np.stack([at_foot, next_at_foot, next_at_foot + corner_count], -1))
        faces.append(
            np.stack([at_foot, next_at_foot + corner_count, at_foot + corner_count], -1)
        )
        start += len(low)
    for end, order in ((0, -1), (1, 1)):
        cap = region.triangulate_region([pair[end] / nm for pair in contours])
        faces.append(cap[:, ::order] + end * corner_count)
    rings = [
        np.column_stack([ring, np.full(corner_count, z)])
        for ring, z in ((foot, 0.0), (top, height_um))
    ]
    return TriangleMesh(np.concatenate(rings), np.concatenate(faces))


def write_stl(path: str | Path, pillars: SolidTile) -> int:
    """Write binary STL in um, one closed surface a pillar.

    Args:
        path: of the file.
        pillars: of a window.

    Returns:
        Number of triangles.

    Raises:
        ProcessError: too many pillars. OSError: the target cannot be written.
    """
    check_count(pillars, "STL")
    meshes = (mesh_section(each, pillars.height_um) for each in pillars.sections)
    facets = np.stack([_facets(mesh) for mesh in meshes])
    triangles = facets.shape[1] * len(pillars.kind)
    header = b"tapered pillars, um, metalens-toolchain".ljust(80)
    places = np.column_stack([pillars.x_um, pillars.y_um]).astype(np.float32)
    with store.replace_atomically(path) as temporary, open(temporary, "wb") as file:
        file.write(header + struct.pack("<I", triangles))
        for start in range(0, len(places), _PILLARS_PER_BLOCK):
            block = slice(start, start + _PILLARS_PER_BLOCK)
            placed = facets[pillars.kind[block]]
            placed["corners"][..., :2] += places[block, None, None]
            file.write(placed.data)
    return int(triangles)


def _facets(mesh: TriangleMesh) -> Array:
    """(triangles,) binary STL records of a mesh: unit normals and corners, um."""
    corners = mesh.vertices_um[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), _FACET)
    facets["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    facets["corners"] = corners
    return facets


def write_step(path: str | Path, pillars: SolidTile) -> None:
    """Write STEP (AP214): an assembly of tapered pillars on a slab of substrate.

    Each class is stored once, as a cylinder, cone, extrusion or ruled loft, and placed
    at its sites; pillars are um.

    Args:
        path: of the file.
        pillars: at most 10,000.

    Raises:
        ProcessError: too many pillars.
    """
    check_count(pillars, "STEP")
    import copy

    from build123d import Color, Compound, Location, Solid, Unit, export_step

    x = pillars.x_um
    y = pillars.y_um
    margin = pillars.pitch_um
    size = float(np.ptp(x)) + margin, float(np.ptp(y)) + margin, 1.0
    corner = float(x.min()) - margin / 2, float(y.min()) - margin / 2, -1.0
    parts = [("substrate", Solid.make_box(*size), _SUBSTRATE_COLOUR, [corner])]
    for kind, section in enumerate(pillars.sections):
        members = pillars.kind == kind
        places = [(*p, 0.0) for p in np.column_stack([x[members], y[members]]).tolist()]
        body = _body(section, pillars.height_um)
        parts.append((section.name, body, _PILLAR_COLOUR, places))
    solids = []
    for label, body, colour, places in parts:
        body.label, body.color = label, Color(*colour)
        for place in places:
            solid = copy.copy(body)  # shares the geometry
            solid.location = Location(place)
            solids.append(solid)
    tile = Compound(label="metalens tile", children=solids)
    with store.replace_atomically(path) as file:
        export_step(tile, file, unit=Unit.MC, timestamp=_STEP_TIME)


def _body(section: SolidSection, height_um: float) -> Any:
    """Solid of a pillar: each part of its section, the holes cut out of the first."""
    pairs = zip(section.foot.parts, section.top.parts, strict=True)
    solid, *holes = (
        _loft(foot, top, height_um, is_upright=section.is_upright)
        for foot, top in pairs
    )
    for hole in holes:
        solid = (solid - hole).solid()
    return solid


def _loft(
    foot: EllipseArc | PolygonLoop,
    top: EllipseArc | PolygonLoop,
    height_um: float,
    *,
    is_upright: bool,
) -> Any:
    """Solid between two outlines: cylinder, cone, extrusion or ruled loft."""
    from build123d import Face, Solid

    if isinstance(foot, EllipseArc) and isinstance(top, EllipseArc):
        radii = foot.half_x_um, top.half_x_um
        if foot.half_x_um == foot.half_y_um and is_upright:
            return Solid.make_cylinder(radii[0], height_um)
        if foot.half_x_um == foot.half_y_um:
            return Solid.make_cone(*radii, height_um)
    if is_upright:
        return Solid.extrude(Face(_wire(foot, 0.0)), (0, 0, height_um))
    return Solid.make_loft([_wire(foot, 0.0), _wire(top, height_um)], ruled=True)


def _wire(part: EllipseArc | PolygonLoop, z_um: float) -> Any:
    """Closed curve of a part of an outline at a height, um."""
    from build123d import Location, Wire

    if isinstance(part, EllipseArc):
        ellipse = Wire.make_ellipse(part.half_x_um, part.half_y_um)
        turn = (0, 0, math.degrees(part.angle_rad))
        return ellipse.moved(Location((0, 0, z_um), turn))
    corners = [(x, y, z_um) for x, y in part.vertices(0).tolist()]
    return Wire.make_polygon(corners, close=True)
