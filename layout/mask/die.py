"""The die around the lens: aperture, alignment and orientation marks, label, dose-test array, witness cells.

Two lithography steps: the pillars with their marks, dose array, witness cells and label; and the aperture, drawn as
the openings of an opaque film over the lens, the marks and the test structures.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask import font
from layout.mask.plan import Figure, Lattice, MaskPlan, PillarClass
from layout.process import Process
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError

DOSES = tuple(0.8 + 0.05 * k for k in range(9))  # of the test array, relative to dose-to-size
_BLOCK = 16  # pillars along a block of the dose array
_WITNESS = 40  # pillars along a witness block
_SPACE = 8  # empty sites between blocks
_TESTED, _WITNESSED = 6, 8  # diameters that are repeated in the dose array and in the witness cells
_CLEAR_UM = 10.0  # between the structures on the die, and of the openings around them


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle in database units."""

    left: int
    bottom: int
    right: int
    top: int

    @property
    def polygon(self) -> Array:
        """Its corners."""
        return np.array(
            [[self.left, self.bottom], [self.right, self.bottom], [self.right, self.top], [self.left, self.top]]
        )

    def grown(self, by: int) -> "Box":
        """A rectangle that is larger by ``by`` on each side."""
        return Box(self.left - by, self.bottom - by, self.right + by, self.top + by)


def furnish(plan: MaskPlan, process: Process, *, radius_um: float, label: str) -> MaskPlan:
    """``plan`` (the lens alone) with everything else that stands on its die.

    Args:
        radius_um: of the aperture. label: text, where the process gives none.

    Raises:
        ProcessError: the die is too small for the aperture and its test structures, or the label cannot be drawn.
    """
    unit = _Units(plan)
    die = _outline(process, unit, radius_um)
    classes, lattices, windows = _tests(plan, process, unit, radius_um, die)
    marks, mark_windows = _marks(process, unit, die)
    words, label_window = _label(process, unit, die, label)
    openings = [disc(radius_um * unit.per_um, plan.axis, plan.grid)]
    openings += [unit.snapped(box).polygon for box in (*windows, *mark_windows, label_window)]
    layers = process.layers
    figures = (
        Figure("APERTURE", {layers.aperture: tuple(openings)}),
        Figure("MARKS", {layers.marks: marks}),
        Figure("LABEL", {layers.labels: words}),
        Figure("OUTLINE", {layers.outline: (die.polygon,)}),
    )
    return plan.replace(
        classes=(*plan.classes, *classes),
        lattices=(*plan.lattices, *lattices),
        figures=(*plan.figures, *figures),
        layer_names={**plan.layer_names, **_layer_names(process, classes)},
        doses={**plan.doses, **{made.layer: made.dose for made in classes}, **_plain_doses(process)},
    )


def disc(radius: float, centre: tuple[float, float], grid: int) -> Array:
    """Polygon of the area of a circle whose edges stay within half a grid step of it, at most 8000 vertices."""
    count = 4 * min(2000, max(8, math.ceil(math.pi / math.sqrt(grid / radius) / 4)))
    angle = (np.arange(count) + 0.5) * 2 * math.pi / count
    reach = radius * math.sqrt(2 * math.pi / count / math.sin(2 * math.pi / count))
    points = np.column_stack([np.cos(angle), np.sin(angle)]) * reach + centre
    return np.asarray(np.rint(points / grid) * grid, np.int64)


class _Units:
    """From micrometres to database units on the grid."""

    def __init__(self, plan: MaskPlan) -> None:
        self.per_um, self.grid, self.pitch = 1e3 / plan.unit_nm, plan.grid, plan.lattices[0].constant

    def __call__(self, length_um: float) -> int:
        return round(length_um * self.per_um / self.grid) * self.grid

    def snapped(self, box: Box) -> Box:
        """The box on the grid, no smaller."""
        g = self.grid
        return Box(box.left // g * g, box.bottom // g * g, -(-box.right // g) * g, -(-box.top // g) * g)


def _outline(process: Process, unit: _Units, radius_um: float) -> Box:
    die = process.die
    size = die.size_um or (2 * (radius_um + die.margin_um),) * 2
    half_x, half_y = unit(size[0] / 2), unit(size[1] / 2)
    return Box(-half_x, -half_y, half_x, half_y)


def _tests(
    plan: MaskPlan, process: Process, unit: _Units, radius_um: float, die: Box
) -> tuple[list[PillarClass], list[Lattice], list[Box]]:
    """Dose array left of the lens, witness cells right of it: classes, lattices, openings."""
    undosed = {made.diameter_units: made for made in plan.classes}
    sizes = [undosed[d] for d in sorted(undosed)]
    doses = [
        _variant(made, f"T{k}{made.name[1:4]}_{n}", (process.layers.dose[0], process.layers.dose[1] + k), dose)
        for k, dose in enumerate(DOSES)
        for n, made in enumerate(_spread(sizes, _TESTED))
    ]
    witnesses = [
        _variant(made, f"W{n}", process.layers.witness, 1.0) for n, made in enumerate(_spread(sizes, _WITNESSED))
    ]
    first = len(plan.classes) + 1
    dose_map = _blocks(np.arange(first, first + len(doses)).reshape(len(DOSES), -1), _BLOCK)
    columns = 2 if len(witnesses) > 1 else 1
    numbers = np.arange(first + len(doses), first + len(doses) + len(witnesses))
    witness_map = _blocks(np.pad(numbers, (0, -len(numbers) % columns)).reshape(-1, columns), _WITNESS)
    inner, outer = unit(radius_um + _CLEAR_UM), die.right - unit(process.die.street_um + _CLEAR_UM)
    middle = (inner + outer) // 2
    lattices, windows = [], []
    for name, sites, x in (("DOSETEST", dose_map, -middle), ("WITNESS", witness_map, middle)):
        lattice = _centred(name, sites, unit, x)
        box = _extent(lattice)
        if min(abs(box.left), abs(box.right)) < inner or max(abs(box.left), abs(box.right)) > outer:
            need = (box.right - box.left) / unit.per_um + 2 * _CLEAR_UM + process.die.street_um
            raise ProcessError(
                f"the die is too small for {name}: {need:.0f} um are needed between aperture and die edge; "
                "raise die.margin_um or die.size_um"
            )
        lattices.append(lattice)
        windows.append(box.grown(unit(_CLEAR_UM / 2)))
    return _same_length([*doses, *witnesses], plan), lattices, windows


def _variant(made: PillarClass, name: str, layer: tuple[int, int], dose: float) -> PillarClass:
    return dataclasses.replace(made, name=name, layer=layer, dose=dose, goal=dose)


def _same_length(classes: list[PillarClass], plan: MaskPlan) -> list[PillarClass]:
    """Classes with names as long as those of the lens: a letter and a running number."""
    length = len(plan.classes[0].name)
    digits = length - 1
    if len(classes) >= 10**digits:
        raise ProcessError(f"{len(classes)} test classes, names of {length} characters; take fewer")
    return [dataclasses.replace(c, name=f"{c.name[0]}{n:0{digits}}") for n, c in enumerate(classes)]


def _spread(sizes: Sequence[PillarClass], count: int) -> list[PillarClass]:
    """At most ``count`` of the sizes, evenly from the thinnest to the widest."""
    picked = np.unique(np.linspace(0, len(sizes) - 1, min(count, len(sizes))).round().astype(int))
    return [sizes[i] for i in picked]


def _blocks(numbers: Array, side: int) -> Array:
    """Class numbers (rows, columns) as square blocks of pillars with spaces between."""
    step = side + _SPACE
    sites = np.zeros((numbers.shape[0] * step - _SPACE, numbers.shape[1] * step - _SPACE), np.uint16)
    for (i, j), number in np.ndenumerate(numbers):
        sites[i * step : i * step + side, j * step : j * step + side] = number
    return sites


def _centred(name: str, sites: Array, unit: _Units, x: int) -> Lattice:
    rows, columns = sites.shape
    grid, pitch = unit.grid, unit.pitch
    left, top = x - (columns - 1) * pitch // 2, (rows - 1) * pitch // 2
    return Lattice.of(name, sites, pitch=pitch, x0=left // grid * grid, y0=top // grid * grid)


def _extent(lattice: Lattice) -> Box:
    reach = lattice.pitch // 2
    right, bottom = (lattice.columns - 1) * lattice.pitch, (lattice.rows - 1) * lattice.pitch
    return Box(lattice.x0, lattice.y0 - bottom, lattice.x0 + right, lattice.y0).grown(reach)


def _marks(process: Process, unit: _Units, die: Box) -> tuple[tuple[Array, ...], list[Box]]:
    """A cross in each corner, and an F beside the upper left one that no turn or mirror takes to itself."""
    arm, width = unit(process.die.mark_um / 2), unit(process.die.mark_width_um / 2)
    inset = unit(process.die.street_um + _CLEAR_UM) + arm
    shapes: list[Array] = []
    boxes = []
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        x, y = sx * (die.right - inset), sy * (die.top - inset)
        w, a = width, arm
        cross = [
            (w, w),
            (w, a),
            (-w, a),
            (-w, w),
            (-a, w),
            (-a, -w),
            (-w, -w),
            (-w, -a),
            (w, -a),
            (w, -w),
            (a, -w),
            (a, w),
        ]
        shapes.append(np.add(cross, (x, y)))
        boxes.append(Box(x - a, y - a, x + a, y + a).grown(unit(_CLEAR_UM / 2)))
    square = max(unit.grid, arm // 5 // unit.grid * unit.grid)
    left, bottom = die.left + inset + arm + unit(_CLEAR_UM), die.top - inset - arm
    shapes.append(_letter_f(left, bottom, square))
    boxes.append(Box(left, bottom, left + 5 * square, bottom + 7 * square).grown(unit(_CLEAR_UM / 2)))
    return tuple(shapes), boxes


def _letter_f(x: int, y: int, s: int) -> Array:
    corners = [(0, 0), (1, 0), (1, 3), (4, 3), (4, 4), (1, 4), (1, 6), (5, 6), (5, 7), (0, 7)]
    return np.add(np.multiply(corners, s), (x, y))


def _label(process: Process, unit: _Units, die: Box, default: str) -> tuple[tuple[Array, ...], Box]:
    """Along the lower edge, between the crosses; letters as large as fit, 35 um high at most."""
    words = process.die.label or default
    inset = unit(process.die.street_um + _CLEAR_UM)
    room = die.right - die.left - 2 * (inset + unit(process.die.mark_um + 2 * _CLEAR_UM))
    square = min(unit(5.0), room // max(1, 6 * len(words)) // unit.grid * unit.grid)
    if square < unit(0.5):
        raise ProcessError(f"label {words!r} does not fit on the die; shorten die.label or raise die.margin_um")
    long = font.width(words, square)
    x, y = -(long // 2) // unit.grid * unit.grid, die.bottom + inset
    box = Box(x, y, x + long, y + 7 * square).grown(unit(_CLEAR_UM / 2))
    return font.text(words, x=x, y=y, square=square), box


def _layer_names(process: Process, classes: Sequence[PillarClass]) -> dict[tuple[int, int], str]:
    layers = process.layers
    found = {made.layer: f"dose_test_dose_{made.dose:.2f}" for made in classes if made.layer[0] == layers.dose[0]}
    return found | {
        layers.aperture: "aperture",
        layers.marks: "marks",
        layers.labels: "label",
        layers.witness: "witness",
        layers.outline: "outline",
    }


def _plain_doses(process: Process) -> dict[tuple[int, int], float]:
    """Of the figures that are written, before any correction."""
    layers = process.layers
    return {layers.aperture: 1.0, layers.marks: 1.0, layers.labels: 1.0}
