"""From a lens and a process to the plan of its mask."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from layout.mask import cells, die, shaped, tone
from layout.mask.plan import MaskPlan, PillarArray, PillarClass, pillar_classes
from layout.process import names
from layout.process.process import LayerNumber, LayerTable, Process
from metalens.cell.shapes import Circle
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm
from metalens.lens import DiameterMap, Lens

UNIT_NM = 1.0
Furniture = Literal[
    "die", "aperture", "none"
]  # marks, label and test structures, or the opening of the lens alone


@dataclass(frozen=True, eq=False, slots=True)
class DrawnMask:
    """The plan of a lens before any correction.

    plan: of the die.
    cells: quantised pillars of the lens.
    radius_um: of its aperture.
    """

    plan: MaskPlan
    cells: cells.DrawnClasses
    radius_um: float


def plan(
    source: Lens | DiameterMap,
    process: Process,
    *,
    name: str = "METALENS",
    furnished: bool = True,
) -> MaskPlan:
    """The mask of a lens, every dose 1.

    Args:
        source: a lens, or its diameters alone.
        process: rules, bias, tone, layers and die.
        name: of the top cell.
        furnished: with aperture, marks, label, dose-test array and witness cells.

    Raises:
        ProcessError: a pitch off the grid, pillars that the process cannot draw (row
            and column named), too many classes, a die that is too small, coordinates
            beyond 32 bits, an illegal name.
        LensError: invalid diameters.
    """
    furniture: Furniture = "die" if furnished else "none"
    return draw_mask(source, process, name=name, furniture=furniture).plan


def draw_mask(
    source: Lens | DiameterMap,
    process: Process,
    *,
    name: str = "METALENS",
    furniture: Furniture = "die",
) -> DrawnMask:
    """As :func:`plan`, with the quantised pillars that a report needs.

    Args:
        source: a lens, or its diameters alone.
        process: rules, bias, tone, layers and die.
        name: of the top cell.
        furniture: what stands around the lens.
    """
    names.check_cell_name(name)
    diameters = source.diameters if isinstance(source, Lens) else source
    across, down = (pitch_units(step, process) for step in diameters.steps_um)
    found, classes = _drawn(source, process)
    rows, columns = found.sites.shape
    x0, y0, axis = _origin((rows, columns), (across, down), process.rules.grid_nm)
    sites = found.sites.upside_down()
    lattice = PillarArray(
        "LENS",
        rows,
        columns,
        across,
        x0,
        y0,
        sites.source,
        sites.array,
        down,
        diameters.lattice.centred,
    )
    bare = MaskPlan(
        name=name,
        classes=classes,
        lattices=(lattice,),
        unit_nm=UNIT_NM,
        grid=process.rules.grid_nm,
        layer_names={process.layers.pillar: _word(source)},
        doses={process.layers.pillar: 1.0},
        axis=axis,
    )
    radius_um = diameters.radius_um + diameters.pitch_um / 2
    if furniture == "die":
        label = _label(source, radius_um)
        bare = die.add_die_frame(bare, process, radius_um=radius_um, label=label)
    elif furniture == "aperture":
        bare = die.open_aperture(bare, process, radius_um=radius_um)
    if process.tone == "negative":
        bare = tone.reverse_tone(bare, process)
    check_layers(bare, process.layers)
    return DrawnMask(bare, found, radius_um)


def _word(source: Lens | DiameterMap) -> str:
    """What the drawn shapes of a lens are called."""
    return (
        "opening" if isinstance(source, Lens) and source.cell.shape.hole else "pillar"
    )


def die_surroundings(
    source: Lens | DiameterMap,
    process: Process,
    *,
    name: str,
    size_um: tuple[float, float],
    clear_um: float,
    label: str,
) -> DrawnMask:
    """Marks, label, dose test and witness cells of the pillars of ``source`` around a
    die of other things.

    clear_um: half the width, about the middle, that the test structures leave free.

    Args:
        process: rules, layers and die.
        name: of the top cell.
        size_um: (x, y) of the die.

    Raises:
        ProcessError: as :func:`plan`.
    """
    own = dataclasses.replace(
        process, die=dataclasses.replace(process.die, size_um=size_um, label=label)
    )
    made = draw_mask(source, own, name=name, furniture="none")
    whole = die.add_die_frame(
        made.plan, own, radius_um=clear_um, label=label, around=True
    )
    figures = [f for f in whole.figures if f.name != "APERTURE"]
    aperture = next(f for f in whole.figures if f.name == "APERTURE")
    openings = {
        layer: shapes[1:] for layer, shapes in aperture.polygons.items()
    }  # without that of the lens
    bare = whole.replace(
        lattices=whole.lattices[:0:-1],
        figures=(dataclasses.replace(aperture, polygons=openings), *figures),
    )
    return dataclasses.replace(made, plan=bare)


def wafer_mark(
    source: Lens | DiameterMap,
    process: Process,
    *,
    name: str,
    mark_um: float,
    width_um: float,
) -> DrawnMask:
    """An alignment cross of a wafer, with witness cells of the pillars of ``source``.

    Args:
        process: rules and layers.
        name: of the top cell.
        mark_um: arm length.
        width_um: line width.

    Raises:
        ProcessError: as :func:`plan`.
    """
    made = draw_mask(source, process, name=name, furniture="none")
    bare = die.add_wafer_mark(made.plan, process, mark_um=mark_um, width_um=width_um)
    return dataclasses.replace(made, plan=bare)


def _drawn(
    source: Lens | DiameterMap, process: Process
) -> tuple[cells.DrawnClasses, tuple[PillarClass, ...]]:
    """The pillars as classes, and what is drawn for each."""
    if isinstance(source, Lens):
        disc = isinstance(source.cell.shape, Circle) and not source.cell.shape.hole
        if source.diameters.angle_rad is not None or not disc:
            return shaped.shape_classes(source, process, unit_nm=UNIT_NM)
    found = cells.quantise_diameters(
        source.diameters if isinstance(source, Lens) else source, process
    )
    return found, _plain_classes(found.diameters_nm, process)


def pitch_units(pitch_um: float, process: Process) -> int:
    """A step of the lattice in database units.

    Args:
        pitch_um: of the lattice.
        process: with the grid.

    Raises:
        ProcessError: it is no multiple of the grid.
    """
    steps = pitch_um / nm / process.rules.grid_nm
    if abs(steps - round(steps)) > 1e-6:
        raise ProcessError(
            f"pitch {pitch_um / nm:.6g} nm is no multiple of the grid of {process.rules.grid_nm} nm: the sites would "
            "lie off the grid; choose another pitch or a finer grid_nm"
        )
    return round(steps) * process.rules.grid_nm


def _origin(
    shape: tuple[int, ...], steps: tuple[int, int], grid: int
) -> tuple[int, int, tuple[float, float]]:
    """First site on the grid such that the axis is at (0, 0), or half a grid step off
    where it cannot be.
    """
    half_x = (shape[1] - 1) * steps[0] / 2
    half_y = (shape[0] - 1) * steps[1] / 2
    x0 = math.floor(-half_x / grid) * grid
    y0 = math.ceil(half_y / grid) * grid
    return x0, y0, (x0 + half_x, y0 - half_y)


def _plain_classes(diameters: Array, process: Process) -> tuple[PillarClass, ...]:
    rules = process.rules
    return pillar_classes(
        diameters,
        layer=process.layers.pillar,
        grid=rules.grid_nm,
        unit_nm=UNIT_NM,
        vertices=rules.vertices,
        shape=rules.shape,
    )


def check_layers(plan: MaskPlan, layers: LayerTable) -> None:
    """Refuse datatypes of the doses that are layers of something else.

    Args:
        plan: with its doses.
        layers: of the process.

    Raises:
        ProcessError: such a datatype.
    """
    fixed = {getattr(layers, f.name): f.name for f in dataclasses.fields(layers)}
    kinds = {getattr(layers, f.name)[0]: f.name for f in dataclasses.fields(layers)}
    seen: dict[LayerNumber, str] = {}
    drawn: list[tuple[LayerNumber, str]] = [
        (made.layer, made.role) for made in plan.classes
    ]
    drawn += [
        (layer, kinds[layer[0]])
        for figure in plan.figures
        for layer in figure.polygons
        if layer[0] in kinds
    ]
    for layer, kind in drawn:
        taken = seen.setdefault(layer, kind)
        if fixed.get(layer, kind) != kind or taken != kind:
            other = taken if taken != kind else fixed[layer]
            raise ProcessError(
                f"layer {layer[0]}/{layer[1]} is a dose of the {kind} layer and the {other} layer; give "
                f"{kind} and {other} different layer numbers"
            )


def _label(source: Lens | DiameterMap, radius_um: float) -> str:
    pitch_nm = (source.diameters if isinstance(source, Lens) else source).pitch_um / nm
    size = f"{2 * radius_um / 1e3:.3g}MM P{pitch_nm:.4g}"
    if isinstance(source, Lens):
        return f"{source.profile} {source.wavelength_um / nm:.0f}NM {size}"
    return f"LENS {size}"
