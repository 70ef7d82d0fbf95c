"""Proximity effect correction: a dose for every shape, so that all edges are exposed at
dose to size.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.class_store import hold_on_disk
from layout.mask.plan import EXPOSED, FigureCell, MaskPlan, PillarArray, PillarClass
from layout.pec import bodies, psf
from layout.pec.bodies import ExposureTable, ScatterRanges
from layout.pec.marks import ExposedMarks, cut_marks
from layout.pec.nodes import (
    MOST_NODES,
    RadialConvolution,
    ScatterBackground,
    gaussian_convolution,
)
from layout.pec.pillar_exposure import DrawnDiscs, DrawnKinds, DrawnOutlines
from layout.pec.psf import THRESHOLD, PointExposure
from layout.process.process import ExposureSettings, LayerNumber
from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm

_ROUNDED = 0.75  # of the tolerance, for doses rounded to the ladder
_SOFTEST_UM = 0.7e-3  # that rounded doses may change a width by
NONE = np.iinfo(np.uint8).max  # dose class of a site without pillar


def correct_plans(
    plans: Sequence[MaskPlan], exposure: ExposureSettings
) -> list[tuple[MaskPlan, "DoseLadder"]]:
    """Plans that are written in one job, with a dose for every shape.

    Args:
        plans: each with the lens, if any, as its first lattice.
        exposure: point exposure, tolerance and number of doses.

    Returns:
        The dosed plans, every dose rounded to the nearest of one geometric series for
        all of them, and that series.

    Raises:
        ProcessError: a negative tone; no pillar; no or an unreadable point exposure;
            pillars finer than its core; a lens too large for a middle range of the
            point exposure.
    """
    wanted = [solve_doses(plan, exposure) for plan in plans]
    ladder = dose_ladder([doses.spans(exposure) for doses in wanted], exposure)
    return [(apply_dose_classes(doses, ladder), ladder) for doses in wanted]


# doses


@dataclass(frozen=True, eq=False)
class DoseLadder:
    """Doses of a job, in equal steps of the logarithm.

    factors: (doses,) relative doses, rising.
    needed: number of doses that the tolerance needs; the writer may hold fewer.
    """

    factors: Array
    needed: int

    def nearest(self, dose: Array) -> Array:
        """Class of the nearest dose on the logarithmic scale, uint8.

        Args:
            dose: relative doses of any shape.
        """
        span = float(np.log(self.factors[-1] / self.factors[0]))
        per_log = (len(self.factors) - 1) / span if span > 0 else 0.0
        level = np.rint(np.log(np.maximum(dose, 1e-9) / self.factors[0]) * per_log)
        return np.asarray(np.clip(level, 0, len(self.factors) - 1), np.uint8)


def dose_ladder(
    spans: Sequence[tuple[float, float, float]], settings: ExposureSettings
) -> DoseLadder:
    """The doses of a job, at most ``maximum_classes``, in a geometric series.

    A quarter of the tolerance is reserved for the background of rounded doses, and for
    what changes across a piece of a mark. With the ratio of :meth:`WantedDoses.spans`,
    the step is 2 ln(1 + 0.75 / ratio).

    Args:
        spans: of all dies of a job, from :meth:`WantedDoses.spans`.
        settings: tolerance, and number of doses.
    """
    least = min(low for low, _, _ in spans)
    span = max(high for _, high, _ in spans) / least
    step = 2 * np.log1p(_ROUNDED / max(ratio for _, _, ratio in spans))
    needed = max(1, int(np.ceil(np.log(span) / step - 1e-9)))
    count = min(needed, settings.maximum_classes)
    return DoseLadder(least * span ** ((np.arange(count) + 0.5) / count), needed)


@dataclass(frozen=True, eq=False)
class WantedDoses:
    """Doses that give every edge of a plan its exposure, before they are rounded.

    lattices: of pillars, in um.
    table: what each kind of pillar exposes.
    ranges: of the point exposure.
    background: that belongs to the doses.
    """

    plan: MaskPlan
    lattices: Sequence[PillarArray]
    table: ExposureTable
    ranges: ScatterRanges
    background: ScatterBackground
    marks: ExposedMarks

    def of_pillars(self, number: int, first: int, block: Array) -> Array:
        """Dose that gives each pillar's edge its exposure, for rows of a lattice.

        dose = (THRESHOLD goal - background) / own, with the exposures of
        :class:`ExposureTable`.

        Args:
            number: of the lattice.
            first: row of the block.
            block: (rows, columns) classes.

        Returns:
            (rows, columns) relative doses; values at sites without pillar mean nothing.
        """
        lattice = self.lattices[number]
        table = self.table
        background = self.background.at_sites(lattice, number, first, len(block))
        own_exposure = np.where(table.used, table.own, 1.0)
        return np.asarray(
            ((THRESHOLD * table.goal)[block] - background) / own_exposure[block]
        )

    def classes(
        self, number: int, first: int, block: Array, ladder: DoseLadder
    ) -> Array:
        """(rows, columns) uint8 dose class of rows of a lattice; 255: no pillar."""
        level = ladder.nearest(self.of_pillars(number, first, block))
        return np.where(block > 0, level, np.uint8(NONE))

    def spans(self, settings: ExposureSettings) -> tuple[float, float, float]:
        """Least and largest dose, and how finely doses must be graded.

        A relative change of a dose changes the exposure of its own edge by less,
        because the background stays. The ratio of both changes, over the allowed
        relative change of the exposure, is the third number.

        Allowed is the tolerance, or less where the edge is so soft that the tolerance
        moves it by more than 0.7 nm of width.

        Args:
            settings: with the tolerance of the exposure.
        """
        table = self.table
        tolerance = settings.tolerance
        ends = []
        for number, lattice in enumerate(self.lattices):
            for first, block in lattice.blocks():
                kind = block[block > 0]
                if len(kind):
                    dose = self.of_pillars(number, first, block)[block > 0]
                    goal = THRESHOLD * table.goal[kind]
                    allowed_per_dose = _SOFTEST_UM * table.slope[kind] / 2 / goal
                    allowed = np.minimum(tolerance, allowed_per_dose * dose)
                    ratio = dose * table.own[kind] / goal / allowed
                    ends.append((dose.min(), dose.max(), ratio.max()))
        dose = self.marks.doses(self.background.far)
        if len(dose):
            near, middle = self.ranges.near, self.ranges.middle
            point = near if len(near.widths_um) else middle
            allowed = np.minimum(tolerance, straight_edge_error(point) * dose)
            ratio = dose * self.marks.own / THRESHOLD / allowed
            ends.append((dose.min(), dose.max(), ratio.max()))
        least, largest, finest = np.array(ends).T
        return float(least.min()), float(largest.max()), float(finest.max())


def straight_edge_error(point: PointExposure) -> float:
    """Relative change of exposure that changes the width of a line by 0.7 nm.

    A line of dose 1 has the slope sum weights / (sqrt(pi) widths) at its edge.

    Args:
        point: narrow terms of the point exposure.
    """
    steep = float((point.weights / point.widths_um).sum()) / np.sqrt(np.pi)
    return float(_SOFTEST_UM * steep / 2 / THRESHOLD)


def solve_doses(plan: MaskPlan, exposure: ExposureSettings) -> WantedDoses:
    """The doses that all shapes of a plan need, before they are rounded to classes.

    Near Gaussians are in the table of each pillar kind; middle and far Gaussians form a
    background that depends on all doses (:func:`_backgrounds`).

    Args:
        plan: every dose 1.
        exposure: point exposure and tolerance.

    Raises:
        ProcessError: as :func:`correct_plans`.
    """
    if plan.standing is not None:
        raise ProcessError(
            "a dose per pillar needs drawn pillars, but tone is 'negative' (the gaps "
            "are drawn); draw the pillars, or set exposure.correct = false"
        )
    unit = plan.unit_nm * nm
    lattices = [dataclasses.replace(lattice, unit_um=unit) for lattice in plan.lattices]
    point = psf.point_exposure(exposure)
    goal = np.array([1.0, *(pillar.goal for pillar in plan.classes)])
    kinds = _drawn(plan, unit)
    counts = bodies.count_pillars(lattices, len(goal))
    densest = min(lattices, key=lambda lattice: lattice.nearest_um)
    ranges = bodies.split_ranges(point, kinds, counts, densest)
    table = bodies.exposure_table(
        kinds, goal, counts, point=point, ranges=ranges, body=densest
    )
    tolerance = min(exposure.tolerance, straight_edge_error(point))
    marks = cut_marks(plan, lattices, kinds.area_um2, ranges, tolerance)
    background = _backgrounds(lattices, table, ranges, marks)
    return WantedDoses(plan, lattices, table, ranges, background, marks)


def _drawn(plan: MaskPlan, unit: float) -> DrawnKinds:
    """Classes as discs where all are round, else as polygons; um."""
    if all(pillar.round for pillar in plan.classes):
        return DrawnDiscs(
            np.array([0.0, *(pillar.diameter_nm * nm for pillar in plan.classes)])
        )
    return DrawnOutlines(
        [
            (),
            *(
                [contour * unit for contour in pillar.contours]
                for pillar in plan.classes
            ),
        ]
    )


# backgrounds


def _backgrounds(
    lattices: Sequence[PillarArray],
    table: ExposureTable,
    ranges: ScatterRanges,
    marks: ExposedMarks,
) -> ScatterBackground:
    """Background exposure at the doses sought, by alternating relaxation.

    The far field comes from all shapes, through the nodes; the middle field from
    neighbours on the same lattice. Both depend on the doses, and the doses on both:
    dose = (THRESHOLD goal - far - middle) / own. Each is relaxed with the other fixed,
    until the far field changes by less than 1e-7, at most 12 times.
    """
    grid = marks.grid
    # a pillar of dose (THRESHOLD goal - field) / own deposits area times that dose
    sums = np.zeros((2, *grid.shape))
    for lattice in lattices:
        grid.gather(
            lattice, np.stack([table.per_own, table.per_own * table.goal]), sums
        )
    mass, goal = sums
    far_convolution = grid.convolution(ranges.far)
    middles = [
        middle_convolution(lattice, ranges)
        for lattice in lattices
        if len(ranges.middle.widths_um)
    ]
    field = solve_background(far_convolution, mass, THRESHOLD * goal, marks=marks)
    middle_fields: list[Array] = []
    for _ in range(12 if middles else 0):
        middle_fields = []
        carried = np.zeros(grid.shape)
        far = ScatterBackground(grid, field, ())
        for lattice, middle in zip(lattices, middles, strict=True):
            classes = lattice.whole()
            far_field = far.at_sites(lattice, 0, 0, lattice.rows)
            per_own = table.per_own.take(classes)
            source = (THRESHOLD * table.goal.take(classes) - far_field) * per_own
            middle_field = solve_background(middle, per_own, source, bound_below=0.9)
            middle_fields.append(middle_field.astype(np.float32))
            rows, columns = np.nonzero(classes)
            x = lattice.columns_um[columns]
            y = lattice.rows_um(0, lattice.rows)[rows]
            carried += grid.deposit(x, y, (middle_field * per_own)[rows, columns])
        previous = field
        field = solve_background(
            far_convolution, mass, THRESHOLD * goal - carried, marks=marks
        )
        if np.abs(field - previous).max() < 1e-7:
            break
    return ScatterBackground(grid, field, middle_fields)


def middle_convolution(body: PillarArray, ranges: ScatterRanges) -> RadialConvolution:
    """Convolution on the sites of a lattice with the Gaussians that reach neighbours
    only.

    Args:
        body: lattice of pillars.
        ranges: point exposure by reach.

    Raises:
        ProcessError: more than 40 million sites.
    """
    if body.rows * body.columns > MOST_NODES:
        raise ProcessError(
            f"a lens of {body.rows} x {body.columns} sites with a point exposure that holds Gaussians of "
            f"{np.array2string(ranges.middle.widths_um, precision=3)} um: such middle ranges are corrected on at most "
            f"{MOST_NODES:,} sites; give a point exposure of core and backscatter alone"
        )
    return gaussian_convolution(
        (body.rows, body.columns),
        (body.down_um, body.pitch_um),
        point=ranges.middle,
        hollow=True,
    )


def solve_background(
    convolution: RadialConvolution,
    mass: Array,
    source: Array,
    *,
    bound_below: float = 0.0,
    marks: ExposedMarks | None = None,
) -> Array:
    """Solve B = K * [source - B mass + marks(B)] for the background B, to 1e-8.

    B <- B + step (K * [...] - B), with step = 2 / (2 + bound - bound_below). The
    eigenvalues of K * mass lie between -bound_below and bound, its largest row sum.

    Args:
        convolution: with the kernel K.
        mass: (y, x) mass that a background of 1 takes away.
        source: (y, x) mass without background.
        bound_below: bound of the negative eigenvalues.
        marks: marks and labels, whose doses also depend on B; None: no marks.
    """
    has_marks = marks is not None and len(marks.own) > 0
    total_mass = mass
    if marks is not None and has_marks:
        total_mass = mass + marks.deposited(1 / marks.own)
    bound = float(convolution(total_mass).max())
    step = 2 / (2 + bound - bound_below)
    convergence = max(1 - step * (1 - bound_below), step * (1 + bound) - 1, 1e-3)
    field = np.zeros_like(mass)
    for _ in range(int(np.ceil(np.log(1e-8) / np.log(convergence)))):
        deposited = source - field * mass
        if marks is not None and has_marks:
            deposited = deposited + marks.deposited(marks.doses(field))
        change = convolution(deposited) - field
        field += step * change
        if np.abs(change).max() < 1e-9:
            break
    return field


# the dosed plan


def apply_dose_classes(doses: WantedDoses, ladder: DoseLadder) -> MaskPlan:
    """The plan with corrected doses: classes of diameter and dose, marks and labels in
    pieces of one dose each.

    Args:
        doses: doses of the plan.
        ladder: of all that is written in one job.
    """
    plan = doses.plan
    classes, lookup = _classes(doses, ladder)
    lattices = tuple(
        _redrawn(doses, ladder, number, lookup) for number in range(len(plan.lattices))
    )
    figures, mark_doses = _figures(doses, ladder)
    replaced = {pillar.layer for pillar in plan.classes} | {
        layer
        for figure in plan.figures
        if figure.name in EXPOSED
        for layer in figure.polygons
    }
    other_doses, other_names = (
        {layer: value for layer, value in values.items() if layer not in replaced}
        for values in (plan.doses, plan.layer_names)
    )
    kinds: dict[int, str] = {}
    for (number, _), name in plan.layer_names.items():
        kinds.setdefault(number, name.partition("_dose_")[0])
    dosed = {pillar.layer: pillar.dose for pillar in classes} | mark_doses
    titles = {
        layer: layer_title(kinds.get(layer[0], "shape"), dose)
        for layer, dose in dosed.items()
    }
    return plan.replace(
        classes=classes,
        lattices=lattices,
        figures=figures,
        doses=other_doses | dosed,
        layer_names=other_names | titles,
    )


def layer_title(kind: str, level: float) -> str:
    """Name of a layer that says its relative dose.

    Args:
        kind: of shapes.
        level: relative dose.
    """
    return f"{kind}_dose_{level:.4f}"


def _classes(
    doses: WantedDoses, ladder: DoseLadder
) -> tuple[tuple[PillarClass, ...], Array]:
    """Split each pillar class by the dose classes that its pillars need.

    Args:
        doses: doses of the plan.
        ladder: of all that is written in one job.

    Returns:
        New classes of one outline and dose each, the datatype raised by the dose class,
        and (old class, dose class) -> number of the new class.
    """
    plan = doses.plan
    occurs = np.zeros((len(plan.classes) + 1, NONE + 1), bool)
    for number, lattice in enumerate(doses.lattices):
        for first, block in lattice.blocks():
            occurs[block, doses.classes(number, first, block, ladder)] = True
    used = np.argwhere(occurs[:, :NONE])
    bases: dict[str, LayerNumber] = {}
    for pillar in plan.classes:
        bases[pillar.role] = min(pillar.layer, bases.get(pillar.role, pillar.layer))
    lookup = np.zeros(occurs.shape, np.uint8 if len(used) <= 255 else np.uint16)
    classes = []
    digits = max(6, len(str(len(used))))
    for n, (k, j) in enumerate(used.tolist(), 1):
        old = plan.classes[k - 1]
        base, datatype = bases[old.role]
        name = f"{old.name[0]}{old.diameter_units:0{digits}}N{n:0{digits}}"
        dose = float(ladder.factors[j])
        layer = base, datatype + j
        classes.append(dataclasses.replace(old, name=name, layer=layer, dose=dose))
        lookup[k, j] = n
    return tuple(classes), lookup


def _redrawn(
    doses: WantedDoses, ladder: DoseLadder, number: int, lookup: Array
) -> PillarArray:
    """A lattice with the numbers of the new classes, in a scratch file.

    Args:
        doses: doses of the plan.
        ladder: of all that is written in one job.
        number: of the lattice.
        lookup: (old class, dose class) -> number of the new class.
    """
    lattice = doses.plan.lattices[number]

    def blocks() -> Iterator[tuple[int, Array]]:
        for first, block in lattice.blocks():
            yield first, lookup[block, doses.classes(number, first, block, ladder)]

    sites = hold_on_disk((lattice.rows, lattice.columns), lookup.dtype, blocks())
    return dataclasses.replace(lattice, source=sites)


def _figures(
    wanted_doses: WantedDoses, ladder: DoseLadder
) -> tuple[tuple[FigureCell, ...], dict[LayerNumber, float]]:
    """Exposed figures in pieces, each piece on the datatype of its dose.

    Args:
        wanted_doses: doses of the plan.
        ladder: of all that is written in one job.

    Returns:
        All figures of the plan, and the relative dose of each new layer.
    """
    plan = wanted_doses.plan
    marks = wanted_doses.marks
    level = ladder.nearest(marks.doses(wanted_doses.background.far))
    doses: dict[LayerNumber, float] = {}
    figures = list(plan.figures)
    for figure_number, figure in enumerate(plan.figures):
        if figure.name not in EXPOSED:
            continue
        shapes: dict[LayerNumber, tuple[Array, ...]] = {}
        for layer_index, layer in enumerate(figure.polygons):
            in_layer = (marks.figure == (figure_number, layer_index)).all(1)
            for dose_class in np.unique(level[in_layer]).tolist():
                boxes = marks.boxes[in_layer & (level == dose_class)]
                dosed_layer = (layer[0], layer[1] + dose_class)
                shapes[dosed_layer] = tuple(map(rectilinear.box_corners, boxes))
                doses[dosed_layer] = float(ladder.factors[dose_class])
        figures[figure_number] = dataclasses.replace(figure, polygons=shapes)
    return tuple(figures), doses
