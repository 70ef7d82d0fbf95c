"""The die around the lens: aperture, alignment and orientation marks, label, dose-test
array, witness cells.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from layout.mask import font, marks
from layout.mask.marks import CLEAR_UM, DatabaseUnits, MarkBox
from layout.mask.plan import FigureCell, MaskPlan, PillarArray, PillarClass, Role
from layout.process.process import LayerNumber, Process
from layout.shapes import polygon
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

_LETTERS = {"dose": "T", "witness": "W"}  # of the names of test classes


@dataclasses.dataclass(frozen=True)
class TestBlocks:
    """Blocks of equal pillars: dose test, and witness cells of dose 1.

    doses: of the dose test, relative to dose to size.
    dose_sizes, witness_sizes, wafer_sizes: diameters of the lens that are repeated in
        the dose test, in the witness cells, and at a mark of the wafer.
    dose_side, witness_side, wafer_side: pillars along a block of these.
    space: empty sites between blocks.
    """

    doses: tuple[float, ...] = tuple(0.8 + 0.05 * k for k in range(9))
    dose_sizes: int = 6
    dose_side: int = 16
    witness_sizes: int = 8
    witness_side: int = 40
    wafer_sizes: int = 3
    wafer_side: int = 16
    space: int = 8


BLOCKS = TestBlocks()


def add_die_frame(
    plan: MaskPlan,
    process: Process,
    *,
    radius_um: float,
    label: str,
    around: bool = False,
) -> MaskPlan:
    """The plan of a lens with everything else on its die.

    Args:
        plan: the lens alone.
        process: layers and die.
        radius_um: of the aperture.
        label: text, where the process gives none.
        around: whether the die holds other things, for which ``radius_um`` about the
            middle stays free along x.

    Raises:
        ProcessError: the die is too small for the aperture and its test structures,
            which would overlap, or the label cannot be drawn.
    """
    unit = DatabaseUnits(plan)
    size = process.die.size_um or (2 * (radius_um + process.die.margin_um),) * 2
    half_x, half_y = unit(size[0] / 2), unit(size[1] / 2)
    die = MarkBox(-half_x, -half_y, half_x, half_y)
    classes, lattices, windows = _tests(plan, process, unit, radius_um, die)
    crosses, mark_windows = marks.alignment_crosses(process, unit, die)
    scales, scale_openings = marks.vernier_scales(process, unit, die)
    letters, label_window = _label(process, unit, die, label)
    _refuse_overlaps(
        {
            "DOSETEST": windows[:1],
            "WITNESS": windows[1:],
            "MARKS": mark_windows,
            "VERNIERS": [
                marks.bounding_box(shape) for shape in (*scales, *scale_openings)
            ],
            "LABEL": [label_window],
        },
        (plan.axis, 0.0 if around else radius_um * unit.per_um),
        unit,
        die,
    )
    openings = [aperture_polygon(radius_um * unit.per_um, plan.axis, plan.grid)]
    openings += [
        unit.snapped(box).polygon for box in (*windows, *mark_windows, label_window)
    ]
    openings += scale_openings
    layers = process.layers
    figures = (
        FigureCell("APERTURE", {layers.aperture: tuple(openings)}),
        FigureCell("MARKS", {layers.marks: crosses}),
        *([FigureCell("VERNIERS", {layers.marks: scales})] if scales else []),
        FigureCell("LABEL", {layers.labels: letters}),
        FigureCell("OUTLINE", {layers.outline: (die.polygon,)}),
    )
    return plan.replace(
        classes=(*plan.classes, *classes),
        lattices=(*plan.lattices, *lattices),
        figures=(*plan.figures, *figures),
    )


def open_aperture(plan: MaskPlan, process: Process, *, radius_um: float) -> MaskPlan:
    """The plan of a lens with the opening of its aperture and nothing else.

    Args:
        plan: the lens alone.
        process: layers.
        radius_um: of the opening.
    """
    layer = process.layers.aperture
    unit = DatabaseUnits(plan)
    figure = FigureCell(
        "APERTURE",
        {layer: (aperture_polygon(radius_um * unit.per_um, plan.axis, plan.grid),)},
    )
    return plan.replace(figures=(*plan.figures, figure))


def add_wafer_mark(
    plan: MaskPlan, process: Process, *, mark_um: float, width_um: float
) -> MaskPlan:
    """An alignment cross of a wafer about (0, 0), coarse and fine.

    Witness cells stand between two of its arms.

    Args:
        plan: of a lens, whose pillars the witness cells repeat.
        process: layers.
        mark_um: arm length.
        width_um: line width.
    """
    unit = DatabaseUnits(plan)
    layers = process.layers
    sizes = sorted(plan.classes, key=lambda pillar: pillar.diameter_units)
    witnesses = [
        _variant(pillar, "witness", layers.witness)
        for pillar in _spread(sizes, BLOCKS.wafer_sizes)
    ]
    sites = _blocks(
        np.arange(len(witnesses))[None] + 1, BLOCKS.wafer_side, plan.lattices[0]
    )
    middle = unit(mark_um / 4)
    lattice = _centred("WITNESS", sites, plan, middle)
    lattice = dataclasses.replace(lattice, y0=lattice.y0 + middle)
    half = unit(mark_um / 2)
    window = unit.snapped(
        MarkBox(-half, -half, half, half).grown(unit(CLEAR_UM / 2))
    ).polygon
    figures = (
        FigureCell("APERTURE", {layers.aperture: (window,)}),
        FigureCell("MARKS", {layers.marks: marks.wafer_cross(unit, mark_um, width_um)}),
    )
    classes = tuple(_named(witnesses, plan))
    return plan.replace(classes=classes, lattices=(lattice,), figures=figures)


def aperture_polygon(radius: float, centre: tuple[float, float], grid: int) -> Array:
    """Polygon of the area of a circle, with edges within half a grid step of it.

    It has at most 8000 vertices.

    Args:
        radius: database units.
        centre: x and y, database units.
        grid: step of the coordinates.
    """
    count = 4 * min(2000, max(8, math.ceil(math.pi / math.sqrt(grid / radius) / 4)))
    return polygon.disc_polygon(radius, centre, count, grid)


def _tests(
    plan: MaskPlan,
    process: Process,
    unit: DatabaseUnits,
    radius_um: float,
    die: MarkBox,
) -> tuple[list[PillarClass], list[PillarArray], list[MarkBox]]:
    """Dose array on the left of the lens, witness cells on its right.

    Sizes, doses and blocks are those of :data:`BLOCKS`.

    Args:
        plan: the lens alone.
        process: layers and die.
        unit: from um to database units.
        radius_um: of the aperture.
        die: outline of the die.

    Returns:
        Classes, lattices, and the openings around both.

    Raises:
        ProcessError: no room between aperture and edge of the die.
    """
    layers = process.layers
    class_of_diameter = {pillar.diameter_units: pillar for pillar in plan.classes}
    diameters = [class_of_diameter[units] for units in sorted(class_of_diameter)]
    doses = [
        _variant(pillar, "dose", (layers.dose[0], layers.dose[1] + level), dose)
        for level, dose in enumerate(BLOCKS.doses)
        for pillar in _spread(diameters, BLOCKS.dose_sizes)
    ]
    witnesses = [
        _variant(pillar, "witness", layers.witness)
        for pillar in _spread(diameters, BLOCKS.witness_sizes)
    ]
    first_number = len(plan.classes) + 1
    lens_lattice = plan.lattices[0]
    dose_numbers = first_number + np.arange(len(doses))
    dose_map = _blocks(
        dose_numbers.reshape(len(BLOCKS.doses), -1), BLOCKS.dose_side, lens_lattice
    )
    columns = 2 if len(witnesses) > 1 else 1
    numbers = first_number + len(doses) + np.arange(len(witnesses))
    witness_map = _blocks(
        np.pad(numbers, (0, -len(numbers) % columns)).reshape(-1, columns),
        BLOCKS.witness_side,
        lens_lattice,
    )
    least_x = unit(radius_um + CLEAR_UM)
    largest_x = die.right - unit(process.die.street_um + CLEAR_UM)
    centre_x = (least_x + largest_x) // 2
    lattices = []
    windows = []
    for name, sites, x in (
        ("DOSETEST", dose_map, -centre_x),
        ("WITNESS", witness_map, centre_x),
    ):
        lattice = _centred(name, sites, plan, x)
        reach = max(lattice.constant, lattice.down) // 2
        box = MarkBox(*lattice.box).grown(reach)
        nearest_x, farthest_x = sorted([abs(box.left), abs(box.right)])
        if nearest_x < least_x or farthest_x > largest_x:
            need = (
                (box.right - box.left) / unit.per_um
                + 2 * CLEAR_UM
                + process.die.street_um
            )
            raise ProcessError(
                f"the die is too small for {name}: {need:.0f} um are needed between aperture and die edge; "
                "raise die.margin_um or die.size_um"
            )
        lattices.append(lattice)
        windows.append(box.grown(unit(CLEAR_UM / 2)))
    return _named([*doses, *witnesses], plan), lattices, windows


def _refuse_overlaps(
    boxes: dict[str, list[MarkBox]],
    aperture: tuple[tuple[float, float], float],
    unit: DatabaseUnits,
    die: MarkBox,
) -> None:
    """Refuse structures that overlap each other or the aperture.

    Args:
        boxes: {name: boxes of the structures}.
        aperture: centre and radius, database units.
        unit: from um to database units.
        die: outline of the die, for the message.

    Raises:
        ProcessError: the first overlap, with the names of both.
    """
    (x, y), radius = aperture
    overlaps = [
        f"{name} and the aperture"
        for name, own in boxes.items()
        for box in own
        if math.hypot(
            max(box.left - x, x - box.right, 0), max(box.bottom - y, y - box.top, 0)
        )
        < radius
    ]
    overlaps += [
        f"{first} and {second}"
        for first, second in itertools.combinations(boxes, 2)
        if any(a.meets(b) for a in boxes[first] for b in boxes[second])
    ]
    if overlaps:
        size = f"{(die.right - die.left) / unit.per_um:.0f} x {(die.top - die.bottom) / unit.per_um:.0f} um"
        remedies = {
            "VERNIERS": "set die.verniers = false",
            "MARKS": "draw smaller marks (die.mark_um)",
        }
        advice = "".join(
            f", or {remedy}" for name, remedy in remedies.items() if name in overlaps[0]
        )
        raise ProcessError(
            f"{overlaps[0]} overlap on a die of {size}; raise die.margin_um or die.size_um{advice}"
        )


def _variant(
    pillar: PillarClass, role: Role, layer: LayerNumber, dose: float = 1.0
) -> PillarClass:
    """A pillar class of the same shape in another role, layer and dose."""
    return dataclasses.replace(pillar, role=role, layer=layer, dose=dose, goal=dose)


def _named(classes: list[PillarClass], plan: MaskPlan) -> list[PillarClass]:
    """Classes with names as long as those of the lens: a letter and a running number."""
    digits = len(plan.classes[0].name) - 1
    return [
        dataclasses.replace(pillar, name=f"{_LETTERS[pillar.role]}{number:0{digits}}")
        for number, pillar in enumerate(classes)
    ]


def _spread(sizes: Sequence[PillarClass], count: int) -> list[PillarClass]:
    """At most ``count`` of the sizes, evenly from the thinnest to the widest."""
    picked = np.unique(
        np.linspace(0, len(sizes) - 1, min(count, len(sizes))).round().astype(int)
    )
    return [sizes[i] for i in picked]


def _blocks(numbers: Array, side: int, lattice: PillarArray) -> Array:
    """Sites with blocks of equal pillars, and empty sites between the blocks.

    Args:
        numbers: (rows, columns) class number of each block.
        side: pillars along a block.
        lattice: of the lens; on a centred lattice every other site is empty.

    Returns:
        (rows, columns) uint16 class numbers of the sites.
    """
    columns_per_site = 2 if lattice.centred else 1
    filled = np.pad(np.ones((side, side), np.uint16), (0, BLOCKS.space))
    blocks = np.kron(numbers.astype(np.uint16), filled)[
        : -BLOCKS.space, : -BLOCKS.space
    ]
    sites = blocks.repeat(columns_per_site, axis=1)
    if lattice.centred:  # every other site, those of neighbouring rows in turn
        sites[np.add.outer(*map(np.arange, sites.shape)) % 2 == 1] = 0
    return sites


def _centred(name: str, sites: Array, plan: MaskPlan, x: int) -> PillarArray:
    """A lattice of sites about (x, 0), with the pitches of the lens.

    Args:
        name: of the lattice.
        sites: (rows, columns) class numbers.
        plan: the lens, with its lattice and grid.
        x: of the centre, database units.
    """
    (rows, columns), grid, lens_lattice = sites.shape, plan.grid, plan.lattices[0]
    left = x - (columns - 1) * lens_lattice.pitch // 2
    top = (rows - 1) * lens_lattice.down // 2
    lattice = PillarArray.of(
        name,
        sites,
        pitch=lens_lattice.pitch,
        x0=left // grid * grid,
        y0=top // grid * grid,
    )
    return dataclasses.replace(
        lattice, row_pitch=lens_lattice.row_pitch, centred=lens_lattice.centred
    )


def _label(
    process: Process, unit: DatabaseUnits, die: MarkBox, default: str
) -> tuple[tuple[Array, ...], MarkBox]:
    """Letters of the label along the lower edge of the die, and the box around them.

    The letters are as large as fit between the crosses, 35 um high at most.

    Args:
        process: label and die.
        unit: from um to database units.
        die: outline of the die.
        default: text where the process gives none.

    Raises:
        ProcessError: squares of the letters would be below 0.5 um.
    """
    text = process.die.label or default
    inset = unit(process.die.street_um + CLEAR_UM)
    free_width = (
        die.right - die.left - 2 * (inset + unit(process.die.mark_um + 2 * CLEAR_UM))
    )
    double_grid = 2 * unit.grid  # halves of a square join letters
    square = (
        min(unit(5.0), free_width // max(1, 6 * len(text))) // double_grid * double_grid
    )
    if square < unit(0.5):
        raise ProcessError(
            f"label {text!r} does not fit on the die; shorten die.label or raise die.margin_um"
        )
    width = (6 * len(text) - 1) * square
    x, y = -(width // 2) // unit.grid * unit.grid, die.bottom + inset
    box = MarkBox(x, y, x + width, y + 7 * square).grown(unit(CLEAR_UM / 2))
    return font.text_rectangles(text, x=x, y=y, square=square), box
