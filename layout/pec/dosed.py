"""A mask with its doses: everything that is exposed together is corrected together, a
datatype for each dose.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.build import check_layers
from layout.mask.held import hold_on_disk
from layout.mask.plan import EXPOSED, FigureCell, MaskPlan, PillarArray, PillarClass
from layout.pec import correct as dose
from layout.pec.assign import DoseLadder, dose_ladder
from layout.pec.bodies import ExposedRectangles
from layout.pec.correct import DoseSolution
from layout.pec.drawn import DrawnDiscs, DrawnKinds, DrawnOutlines
from layout.process.process import ExposureSettings, LayerNumber, LayerTable
from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm


@dataclass(frozen=True, eq=False, slots=True)
class WantedPlan:
    """A plan and the doses that it wants.

    boxes: (n, 4) pieces of its figures; of: (n, 2) figure and layer number of each.
    """

    plan: MaskPlan
    doses: dose.WantedDoses
    boxes: Array
    of: Array


def solve_wanted_doses(plan: MaskPlan, exposure: ExposureSettings) -> WantedPlan:
    """The doses that everything on a plan needs, before they are rounded to classes.

    Args:
        exposure: point exposure and tolerance.

    Raises:
        ProcessError: as :func:`layout.pec.correct.correct`.
    """
    if plan.standing is not None:
        raise ProcessError(
            "a dose per pillar needs drawn pillars, but tone is 'negative' (the gaps "
            "are drawn); draw the pillars, or set exposure.correct = false"
        )
    unit = plan.unit_nm * nm
    parts = [dataclasses.replace(l, unit_um=unit) for l in plan.lattices]
    goals = np.array([1.0, *(made.goal for made in plan.classes)])
    boxes, of, group = _pieces(plan, parts, exposure)
    cut = ExposedRectangles(boxes * unit, group, np.ones(len(boxes)))
    found = dose.solve_doses(parts, _drawn(plan, unit), goals, exposure, cut=cut)
    return WantedPlan(plan, found, boxes, of)


def correct(mask: MaskPlan, exposure: ExposureSettings) -> MaskPlan:
    """Proximity effect correction: a plan with a dose for every shape.

    Args:
        mask: of a die, every dose 1.
        exposure: point exposure, tolerance and number of doses.

    Raises:
        ProcessError: no plan; as :func:`correct_plans`.

    Accuracy:
        Edges of all shapes are at dose to size within the tolerance, as
        :func:`layout.verify.exposure.verify_exposure` finds.
    """
    if not isinstance(mask, MaskPlan):
        raise ProcessError(
            f"{type(mask).__name__} is no plan: doses are found for plans of lenses; "
            "lay a doses.csv beside a file made elsewhere"
        )
    return correct_plans([mask], exposure)[0][0]


def correct_plans(
    plans: Sequence[MaskPlan],
    exposure: ExposureSettings,
    layers: LayerTable | None = None,
) -> list[tuple[MaskPlan, DoseSolution]]:
    """Plans that are written in one job, with a dose for every shape.

    Args:
        plans: each with the lens, if any, as its first lattice.
        exposure: point exposure, tolerance and number of doses.
        layers: whose numbers no dose may take; None: not checked.

    Returns:
        The dosed plans, every dose rounded to the nearest of one geometric series for
        all of them.

    Raises:
        ProcessError: as :func:`layout.pec.correct.solve_doses`; a negative tone;
            datatypes of the doses that are layers of something else.
    """
    wanted = [solve_wanted_doses(plan, exposure) for plan in plans]
    steps = dose_ladder([one.doses.range for one in wanted], exposure)
    made = [apply_dose_classes(one, *steps) for one in wanted]
    for plan, _ in made:
        if layers is not None:
            check_layers(plan, layers)
    return made


def apply_dose_classes(
    wanted: WantedPlan, ladder: DoseLadder, needed: int
) -> tuple[MaskPlan, DoseSolution]:
    """The plan with corrected doses: classes of diameter and dose, marks and labels in
    pieces of one dose each.

    ladder, needed: of all that is written in one job.

    Args:
        wanted: doses of the plan.
    """
    plan, boxes, of = wanted.plan, wanted.boxes, wanted.of
    found = dose.round_doses(wanted.doses, ladder, needed)
    classes, lookup, names = _classes(plan, found)
    lattices = tuple(_redrawn(l, n, found, lookup) for n, l in enumerate(plan.lattices))
    figures, more = _figures(plan, found, (boxes, of))
    doses = {**{made.layer: made.dose for made in classes}, **more}
    kept = {
        layer: level
        for layer, level in plan.doses.items()
        if layer not in _replaced(plan)
    }
    titled = {
        **_untitled(plan),
        **names,
        **{layer: _name(plan, layer, level) for layer, level in more.items()},
    }
    return (
        plan.replace(
            classes=classes,
            lattices=lattices,
            figures=figures,
            doses={**kept, **doses},
            layer_names=titled,
        ),
        found,
    )


def _drawn(plan: MaskPlan, unit: float) -> DrawnKinds:
    """The classes as discs where all stand for one, else as polygons."""
    if all(made.round for made in plan.classes):
        return DrawnDiscs(
            np.array([0.0, *(made.diameter_nm * nm for made in plan.classes)])
        )
    return DrawnOutlines(
        [(), *([c * unit for c in made.contours] for made in plan.classes)]
    )


def _replaced(plan: MaskPlan) -> set[LayerNumber]:
    """Layers whose shapes get datatypes of their own."""
    return {made.layer for made in plan.classes} | {
        layer
        for figure in plan.figures
        if figure.name in EXPOSED
        for layer in figure.polygons
    }


def _untitled(plan: MaskPlan) -> dict[LayerNumber, str]:
    gone = _replaced(plan)
    return {
        layer: name for layer, name in plan.layer_names.items() if layer not in gone
    }


def _name(plan: MaskPlan, layer: LayerNumber, level: float) -> str:
    kind = next(
        (name for (number, _), name in plan.layer_names.items() if number == layer[0]),
        "shape",
    )
    return layer_title(kind, level)


def layer_title(kind: str, level: float) -> str:
    """Name of a layer that says its relative dose.

    Args:
        kind: of shapes.
        level: relative dose.
    """
    return f"{kind}_dose_{level:.4f}"


def _pieces(
    plan: MaskPlan, parts: Sequence[PillarArray], exposure: ExposureSettings
) -> tuple[Array, Array, Array]:
    """Rectangles of all exposed figures, cut: (n, 4) boxes, (n, 2) figure and layer
    number, (n,) shape.
    """
    whole, of, group = (
        [np.empty((0, 4), np.int64)],
        [np.empty((0, 2), np.int64)],
        [np.empty(0, np.int64)],
    )
    shapes = 0
    for f, figure in enumerate(plan.figures):
        if figure.name not in EXPOSED:
            continue
        for m, polygons in enumerate(figure.polygons.values()):
            boxes = np.concatenate([rectilinear.split_rectilinear(p) for p in polygons])
            whole.append(boxes)
            of.append(np.tile([f, m], (len(boxes), 1)))
            group.append(shapes + _touching(boxes))
            shapes = int(group[-1].max()) + 1
    every = np.concatenate(whole)
    step_um = plan.grid * plan.unit_nm * nm
    made, box = dose.fracture_by_surroundings(
        every // plan.grid, parts, exposure, step_um=step_um
    )
    return made * plan.grid, np.concatenate(of)[box], np.concatenate(group)[box]


def _touching(boxes: Array) -> Array:
    """(n,) number of the connected shape that each rectangle belongs to.

    A sweep along the longer side of them all: memory grows with the touching pairs.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    axis = int(np.argmax(boxes[:, 2:].max(0) - boxes[:, :2].min(0)))
    order = np.argsort(boxes[:, axis], kind="stable")
    swept = boxes[order]
    ends = np.searchsorted(swept[:, axis], swept[:, 2 + axis], side="right")
    other, first, second = 1 - axis, [], []
    for n, end in enumerate(ends.tolist()):
        ahead = swept[n + 1 : end]
        met = (ahead[:, other] <= swept[n, 2 + other]) & (
            ahead[:, 2 + other] >= swept[n, other]
        )
        touched = order[n + 1 : end][met]
        second.append(touched)
        first.append(np.full(len(touched), order[n]))
    i, j = np.concatenate(first), np.concatenate(second)
    pairs = coo_matrix((np.ones(len(i)), (i, j)), (len(boxes), len(boxes)))
    return np.asarray(connected_components(pairs, directed=False)[1], np.int64)


def _classes(
    plan: MaskPlan, found: DoseSolution
) -> tuple[tuple[PillarClass, ...], Array, dict[LayerNumber, str]]:
    """Classes of diameter and dose, (old class, dose) -> new class number, and names of
    their layers.
    """
    used = np.argwhere(found.pairs > 0)
    bases: dict[str, LayerNumber] = {}
    for made in plan.classes:
        bases[made.role] = min(made.layer, bases.get(made.role, made.layer))
    datatypes: dict[str, list[int]] = {kind: [] for kind in bases}
    for k, j in used.tolist():
        kind = plan.classes[k - 1].role
        if j not in datatypes[kind]:
            datatypes[kind].append(j)
    number = {
        kind: {j: n for n, j in enumerate(sorted(js))} for kind, js in datatypes.items()
    }
    lookup = np.zeros(
        (len(plan.classes) + 1, 256), np.uint8 if len(used) <= 255 else np.uint16
    )
    classes, names = [], {}
    digits = max(6, len(str(len(used))))
    for n, (k, j) in enumerate(used.tolist(), 1):
        old = plan.classes[k - 1]
        kind, level = old.role, float(found.ladder.factors[j])
        layer = (bases[kind][0], bases[kind][1] + number[kind][j])
        names[layer] = layer_title({"dose": "dose_test"}.get(kind, kind), level)
        name = f"{old.name[0]}{old.diameter_units:0{digits}}N{n:0{digits}}"
        classes.append(dataclasses.replace(old, name=name, layer=layer, dose=level))
        lookup[k, j] = n
    return tuple(classes), lookup, names


def _redrawn(
    lattice: PillarArray, number: int, found: DoseSolution, lookup: Array
) -> PillarArray:
    """A lattice with the classes of diameter and dose, in blocks of rows."""

    def blocks() -> Iterator[tuple[int, Array]]:
        for first, block in lattice.blocks():
            yield first, lookup[block, found.classes(number, first, block)]

    kept = hold_on_disk((lattice.rows, lattice.columns), lookup.dtype, blocks())
    return kept.within(lattice)


def _figures(
    plan: MaskPlan, found: DoseSolution, cut: tuple[Array, Array]
) -> tuple[tuple[FigureCell, ...], Mapping[LayerNumber, float]]:
    """The exposed figures in pieces, each on the datatype of its dose, and the doses of
    these.
    """
    (boxes, of), doses = cut, {}
    figures = list(plan.figures)
    layers = {layer for f in plan.figures if f.name in EXPOSED for layer in f.polygons}
    sharing = {
        layer[0]: sorted({int(j) for j in found.rect_class[_on(plan, of, layer[0])]})
        for layer in layers
    }
    for f, figure in enumerate(plan.figures):
        if figure.name not in EXPOSED:
            continue
        shapes: dict[LayerNumber, tuple[Array, ...]] = {}
        for m, layer in enumerate(figure.polygons):
            mine = (of == (f, m)).all(1)
            for n, j in enumerate(sharing[layer[0]]):
                some = boxes[mine & (found.rect_class == j)]
                if len(some):
                    own = (layer[0], layer[1] + n)
                    shapes[own] = tuple(rectilinear.box_corners(box) for box in some)
                    doses[own] = float(found.ladder.factors[j])
        figures[f] = dataclasses.replace(figure, polygons=shapes)
    return tuple(figures), doses


def _on(plan: MaskPlan, of: Array, number: int) -> Array:
    """(n,) whether each piece is drawn on this layer number."""
    table = [[layer[0] for layer in figure.polygons] for figure in plan.figures]
    return np.array([table[f][m] == number for f, m in of.tolist()], bool)
