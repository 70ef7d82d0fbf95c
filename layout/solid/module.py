"""The camera module around the lens as solids: filter, die with aperture, mount,
sensor, flex, held by joints.

The stack that the paper proposes for smart glasses (Sec. 6): 0.5 mm NIR filter, 0.3 mm
substrate, 2 mm to the sensor,
a package of 0.5 mm, a flex of 0.2 mm: 3.5 mm in all, less than 2 mm wide. z runs with
the light from the pillars' feet.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from layout.process import Process
from layout.solid.step import Piece, write_pieces
from metalens.ground.errors import ProcessError
from metalens.lens import Lens

# part: colour (red, green, blue, opacity)
COLOURS = {
    "nir_filter": (0.35, 0.05, 0.10, 0.6),
    "die": (0.70, 0.85, 0.95, 0.5),
    "aperture": (0.05, 0.05, 0.05, 1.0),
    "metalens": (0.45, 0.25, 0.75, 1.0),
    "mount": (0.35, 0.38, 0.42, 1.0),
    "sensor": (0.15, 0.35, 0.25, 1.0),
    "flex": (0.90, 0.55, 0.15, 1.0),
}


@dataclass(frozen=True, slots=True)
class Module:
    """Sizes in mm.

    filter_mm, substrate_mm, spacing_mm, sensor_mm, flex_mm: thicknesses along the
    light.
    side_mm: of the mount; filter_side_mm, die_side_mm, sensor_side_mm: of what it
    holds.
    aperture_mm: diameter of the lens. clearance_mm: on each side between the mount and
    what slides into it.
    ledge_mm: thickness of the shelf that the die rests on. film_mm: of the aperture
    metal. height_mm: of the pillars.
    """

    filter_mm: float = 0.5
    substrate_mm: float = 0.3
    spacing_mm: float = 2.0
    sensor_mm: float = 0.5
    flex_mm: float = 0.2
    side_mm: float = 1.9
    filter_side_mm: float = 1.8
    die_side_mm: float = 1.5
    sensor_side_mm: float = 1.5
    aperture_mm: float = 1.0
    clearance_mm: float = 0.02
    ledge_mm: float = 0.2
    film_mm: float = 0.00015
    height_mm: float = 0.0007

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not 0 < value < 100:
                raise ProcessError(
                    f"{name} = {value}: need a length above 0 (and below 100 mm)"
                )
        for held, room in (
            ("die_side_mm", "side_mm"),
            ("sensor_side_mm", "side_mm"),
            ("aperture_mm", "die_side_mm"),
        ):
            wall = (getattr(self, room) - getattr(self, held)) / 2 - self.clearance_mm
            if wall < 0.1:
                raise ProcessError(
                    f"{held} = {getattr(self, held)} leaves {wall:.3f} mm on each side within {room} = "
                    f"{getattr(self, room)}, need 0.1: make it smaller"
                )
        if self.ledge_mm >= self.spacing_mm:
            raise ProcessError(
                f"ledge_mm = {self.ledge_mm} fills the spacing of {self.spacing_mm} mm"
            )

    @property
    def stack_mm(self) -> float:
        """Thickness of the module."""
        return (
            self.filter_mm
            + self.substrate_mm
            + self.spacing_mm
            + self.sensor_mm
            + self.flex_mm
        )


def around(lens: Lens, process: Process) -> Module:
    """A module for a lens: its aperture, height, substrate to sensor distance; wider
    parts for a wider lens.

    The substrate is that of the paper's stack (0.3 mm), or the die's own where it is
    thinner.
    """
    default = Module()
    aperture = 2 * (lens.diameters.radius_um + lens.diameters.pitch_um / 2) / 1e3
    wider = max(0.0, aperture - default.aperture_mm)
    spacing = lens.sensor_distance_um / 1e3
    return replace(
        default,
        aperture_mm=aperture,
        spacing_mm=spacing,
        ledge_mm=min(default.ledge_mm, spacing / 4),
        substrate_mm=min(default.substrate_mm, process.die.thickness_um / 1e3),
        height_mm=lens.cell.height_um / 1e3,
        side_mm=default.side_mm + wider,
        filter_side_mm=default.filter_side_mm + wider,
        die_side_mm=default.die_side_mm + wider,
        sensor_side_mm=default.sensor_side_mm + wider,
    )


@dataclass(frozen=True, slots=True)
class Clearance:
    """Two neighbouring parts: their least distance, and the volume they share (0 unless
    they collide).
    """

    first: str
    second: str
    distance_mm: float
    shared_mm3: float


def assemble(module: Module) -> Any:
    """build123d ``Compound`` of the module: each part modelled at its own origin and
    seated by its joint.
    """
    from build123d import Color, Compound

    parts = _parts(module)
    mount = parts["mount"]
    for name, seat in _seats(module).items():
        _joint(mount, name, seat)
        _joint(parts[name], "seat", 0.0)
        mount.joints[name].connect_to(parts[name].joints["seat"])
    for name, part in parts.items():
        part.label, part.color = name, Color(*COLOURS[name])
    return Compound(label="metalens module", children=[parts[name] for name in COLOURS])


def _seats(module: Module) -> dict[str, float]:
    """z in mm at which each part begins."""
    return {
        "nir_filter": -module.substrate_mm - module.filter_mm,
        "die": -module.substrate_mm,
        "aperture": 0.0,
        "metalens": 0.0,
        "sensor": module.spacing_mm,
        "flex": module.spacing_mm + module.sensor_mm,
    }


def _parts(module: Module) -> dict[str, Any]:
    from build123d import Align, Box, Cylinder, Pos

    bottom = (Align.CENTER, Align.CENTER, Align.MIN)

    def box(side: float, height: float) -> Any:
        return Box(side, side, height, align=bottom)

    die_room = module.die_side_mm + 2 * module.clearance_mm
    sensor_room = module.sensor_side_mm + 2 * module.clearance_mm
    rest = module.film_mm  # the ledge touches the metal of the aperture
    opening = (module.aperture_mm + module.die_side_mm) / 2
    mount = Pos(0, 0, -module.substrate_mm) * box(
        module.side_mm, module.substrate_mm + module.spacing_mm + module.sensor_mm
    )
    mount -= Pos(0, 0, -module.substrate_mm) * box(die_room, module.substrate_mm + rest)
    mount -= Cylinder(opening / 2, module.spacing_mm, align=bottom)
    below = rest + module.ledge_mm
    mount -= Pos(0, 0, below) * box(
        sensor_room, module.spacing_mm + module.sensor_mm - below
    )
    film = box(module.die_side_mm, module.film_mm) - Cylinder(
        module.aperture_mm / 2, module.film_mm, align=bottom
    )
    return {
        "nir_filter": box(module.filter_side_mm, module.filter_mm),
        "die": box(module.die_side_mm, module.substrate_mm),
        "aperture": film,
        "metalens": Cylinder(module.aperture_mm / 2, module.height_mm, align=bottom),
        "mount": mount,
        "sensor": box(module.sensor_side_mm, module.sensor_mm),
        "flex": box(module.side_mm, module.flex_mm),
    }


def _joint(part: Any, label: str, z_mm: float) -> None:
    from build123d import Location, RigidJoint

    RigidJoint(label, part, Location((0, 0, z_mm)))


def clearances(assembly: Any) -> list[Clearance]:
    """Least distance and shared volume of every pair of parts of an assembly.

    Raises:
        ProcessError: two parts share more than 1e-9 mm^3: they collide.
    """
    found = []
    parts = list(assembly.children)
    for n, first in enumerate(parts):
        for second in parts[n + 1 :]:
            common = first & second
            shared = float(common.volume) if common is not None else 0.0
            if shared > 1e-9:
                raise ProcessError(
                    f"{first.label} and {second.label} collide: they share {shared:.2g} mm^3"
                )
            found.append(
                Clearance(
                    first.label, second.label, float(first.distance_to(second)), shared
                )
            )
    return found


def write_module(path: str | Path, module: Module) -> list[Clearance]:
    """STEP of the module with labels and colours; returns the clearances that were
    checked before.

    Raises:
        ProcessError: parts collide. OSError: the target cannot be written.
    """
    from OCP.TopLoc import TopLoc_Location

    assembly = assemble(module)
    checked = clearances(assembly)
    pieces = []
    for part in assembly.children:
        place = part.location.position
        solid = part.solid().wrapped.Located(TopLoc_Location())
        pieces.append(
            Piece(
                part.label,
                solid,
                COLOURS[part.label][:3],
                [(place.X, place.Y, place.Z)],
            )
        )
    write_pieces(path, assembly.label, pieces, unit_m=1e-3)
    return checked


def picture(module: Module, *, cut: bool = True) -> bytes:
    """PNG of the module in perspective, for reports; ``cut`` takes a quarter of the
    mount away.

    The shades are of a lamp over the left shoulder.
    """
    import numpy as np
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    from metalens.ground import report

    figure, axes = report.canvas(1, 1, size=(5.2, 5.6), subplot_kw={"projection": "3d"})
    parts = assemble(module).children
    for part in parts:
        shown = (
            _without_quarter(part)
            if cut and part.label in ("mount", "nir_filter", "flex")
            else part
        )
        if shown is None:
            continue
        points, faces = shown.tessellate(0.02, 0.2)
        corners = np.array([(p.X, p.Y, -p.Z) for p in points])[np.array(faces)]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        light = 0.55 + 0.45 * abs(normal @ np.array([0.35, -0.6, 0.72]))
        red, green, blue, opacity = COLOURS[part.label]
        shade = np.column_stack(
            [light[:, None] * [red, green, blue], np.full(len(light), opacity)]
        )
        axes.add_collection3d(
            Poly3DCollection(corners, facecolors=np.clip(shade, 0, 1), linewidths=0)
        )
    half = module.side_mm / 2
    low = -(module.spacing_mm + module.sensor_mm + module.flex_mm)
    axes.set(
        xlim=(-half, half),
        ylim=(-half, half),
        zlim=(low, module.substrate_mm + module.filter_mm),
    )
    axes.set_box_aspect((module.side_mm, module.side_mm, module.stack_mm))
    axes.view_init(elev=22, azim=-50)
    axes.set_axis_off()
    return report.png(figure)


def _without_quarter(part: Any) -> Any:
    from build123d import Align, Box

    corner = Box(10, 10, 100, align=(Align.MIN, Align.MAX, Align.CENTER))
    rest = part - corner
    return rest if rest is not None and rest.volume > 0 else None
