"""From a lens and a process to the plan of its mask."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from layout.mask import cells, die, shaped, tone
from layout.mask.plan import MaskPlan, PillarArray, PillarClass, pillar_classes
from layout.process import names
from layout.process.process import Process
from metalens.cell.shapes import Circle
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm
from metalens.lens import DiameterMap, Lens

UNIT_NM = 1.0
Furniture = Literal[
    "die", "aperture", "none"
]  # marks, label and test structures, or the opening of the lens alone


@dataclass(frozen=True, eq=False)
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
    pitch, row_pitch = (pitch_units(step, process) for step in diameters.steps_um)
    drawn_classes, classes = _drawn(source, process)
    rows, columns = drawn_classes.shape
    x0, y0, axis = _origin((rows, columns), (pitch, row_pitch), process.rules.grid_nm)

    def upside_down(first: int, end: int) -> Array:
        return drawn_classes.source(rows - end, rows - first)[::-1]

    lattice = PillarArray(
        "LENS",
        rows,
        columns,
        pitch,
        x0,
        y0,
        upside_down,
        row_pitch,
        diameters.lattice.centred,
    )
    drawn_plan = MaskPlan(
        name=name,
        classes=classes,
        lattices=(lattice,),
        unit_nm=UNIT_NM,
        grid=process.rules.grid_nm,
        axis=axis,
    )
    radius_um = diameters.radius_um + diameters.pitch_um / 2
    if furniture == "die":
        label = _label(source, radius_um)
        drawn_plan = die.add_die_frame(
            drawn_plan, process, radius_um=radius_um, label=label
        )
    elif furniture == "aperture":
        drawn_plan = die.open_aperture(drawn_plan, process, radius_um=radius_um)
    if process.tone == "negative":
        drawn_plan = tone.reverse_tone(drawn_plan, process)
    drawn_plan = _name_layers(drawn_plan, source, process)
    return DrawnMask(drawn_plan, drawn_classes, radius_um)


def _name_layers(
    plan: MaskPlan, source: Lens | DiameterMap, process: Process
) -> MaskPlan:
    """The plan with names and doses of the layers that it draws on; dose 1 but in the
    dose test.
    """
    layers = process.layers
    kinds = {getattr(layers, f.name)[0]: f.name for f in dataclasses.fields(layers)}
    kinds[layers.labels[0]] = "label"
    if isinstance(source, Lens) and source.cell.shape.hole:
        kinds[layers.pillar[0]] = "opening"
    test = {p.layer: p.dose for p in plan.classes if p.role == "dose"}
    names = {layer: kinds[layer[0]] for layer in plan.layers}
    names |= {layer: f"dose_test_dose_{dose:.2f}" for layer, dose in test.items()}
    doses = dict.fromkeys(plan.layers - {layers.outline}, 1.0) | test
    return plan.replace(layer_names=names, doses=doses)


def die_surroundings(
    source: Lens | DiameterMap,
    process: Process,
    *,
    name: str,
    size_um: tuple[float, float],
    clear_um: float,
    label: str,
) -> MaskPlan:
    """Marks, label, dose test and witness cells around a die of other things.

    Args:
        source: lens whose pillars the test structures repeat.
        process: rules, layers and die.
        name: of the top cell.
        size_um: (x, y) of the die.
        clear_um: half the width, about the middle, that the test structures leave free.
        label: text on the die.

    Raises:
        ProcessError: as :func:`plan`.
    """
    frame_process = dataclasses.replace(
        process, die=dataclasses.replace(process.die, size_um=size_um, label=label)
    )
    lens_mask = draw_mask(source, frame_process, name=name, furniture="none")
    framed = die.add_die_frame(
        lens_mask.plan, frame_process, radius_um=clear_um, label=label, around=True
    )
    figures = [figure for figure in framed.figures if figure.name != "APERTURE"]
    aperture = next(figure for figure in framed.figures if figure.name == "APERTURE")
    openings = {
        layer: shapes[1:] for layer, shapes in aperture.polygons.items()
    }  # without that of the lens
    frame = framed.replace(
        lattices=framed.lattices[:0:-1],
        figures=(dataclasses.replace(aperture, polygons=openings), *figures),
    )
    return _name_layers(frame, source, process)


def wafer_mark(
    source: Lens | DiameterMap,
    process: Process,
    *,
    name: str,
    mark_um: float,
    width_um: float,
) -> MaskPlan:
    """An alignment cross of a wafer, with witness cells.

    Args:
        source: lens whose pillars the witness cells repeat.
        process: rules and layers.
        name: of the top cell.
        mark_um: arm length.
        width_um: line width.

    Raises:
        ProcessError: as :func:`plan`.
    """
    lens_mask = draw_mask(source, process, name=name, furniture="none")
    mark = die.add_wafer_mark(
        lens_mask.plan, process, mark_um=mark_um, width_um=width_um
    )
    return _name_layers(mark, source, process)


def _drawn(
    source: Lens | DiameterMap, process: Process
) -> tuple[cells.DrawnClasses, tuple[PillarClass, ...]]:
    """The pillars of a lens as classes, and the polygons of each."""
    if isinstance(source, Lens):
        disc = isinstance(source.cell.shape, Circle) and not source.cell.shape.hole
        if source.diameters.angle_rad is not None or not disc:
            return shaped.shape_classes(source, process, unit_nm=UNIT_NM)
    drawn_classes = cells.quantise_diameters(
        source.diameters if isinstance(source, Lens) else source, process
    )
    rules = process.rules
    return drawn_classes, pillar_classes(
        drawn_classes.diameters_nm,
        layer=process.layers.pillar,
        grid=rules.grid_nm,
        unit_nm=UNIT_NM,
        vertices=rules.vertices,
    )


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


def _label(source: Lens | DiameterMap, radius_um: float) -> str:
    """Default label of a die: profile, wavelength, diameter and pitch of the lens."""
    pitch_nm = (source.diameters if isinstance(source, Lens) else source).pitch_um / nm
    size = f"{2 * radius_um / 1e3:.3g}MM P{pitch_nm:.4g}"
    if isinstance(source, Lens):
        return f"{source.profile} {source.wavelength_um / nm:.0f}NM {size}"
    return f"LENS {size}"
