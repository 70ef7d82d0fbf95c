"""Verification of the exposure: what the written files and their dose table make."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from layout.formats.library import NOTHING, MaskLibrary, PolygonStack, flatten_stacks
from layout.mask.plan import MaskPlan, PillarArray
from layout.pec import bodies, correct, nodes, sampled
from layout.pec.drawn import DrawnDiscs, DrawnKinds, DrawnOutlines
from layout.pec.psf import THRESHOLD, PointExposure, point_exposure
from layout.process import isolation
from layout.process.process import LayerNumber, Process
from layout.shapes import polygon, region
from layout.verify import polygon_edges
from layout.verify.polygon_edges import ExposedPolygons
from layout.verify.report import EdgeErrors, ExposureReport, VerificationTally
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm

_SAMPLES = 1000  # pillars whose exposure is summed exactly, on masks up to ...
_PRODUCTS = 4e9  # ... so many products of samples and sites
_SPOTS = 8  # along the narrowest Gaussian of the node field, of a polygon


@dataclass(frozen=True, eq=False, slots=True)
class WrittenMask:
    """What a written mask exposes with the pillars.

    bodies: lattices of class numbers. kinds: what each class draws. dose, layer,
    size_um: (classes + 1,) of each class; dose 0 where its layer has none. others: all
    other shapes. undosed: layers with shapes and no dose.
    """

    bodies: Sequence[PillarArray]
    kinds: DrawnKinds
    dose: Array
    layer: Array
    size_um: Array
    others: ExposedPolygons
    undosed: tuple[LayerNumber, ...]


@dataclass(frozen=True, eq=False, slots=True)
class ExposedRows:
    """Predicted sizes in some rows of a lattice, (rows, columns) each.

    number: of the lattice. first: row. classes: 0 for no pillar. exposure: of the drawn
    edge, relative to dose to size. resist_nm, made_nm: sizes in the resist and after
    the etch, at half height.
    """

    number: int
    first: int
    classes: Array
    exposure: Array
    resist_nm: Array
    made_nm: Array


def verify_exposure(
    content: MaskLibrary,
    plan: MaskPlan,
    doses: Mapping[LayerNumber, float],
    process: Process,
    *,
    height_um: float = 0.0,
    keep: Callable[[ExposedRows], None] | None = None,
) -> ExposureReport:
    """Expose and etch a mask that was read back, in simulation.

    Args:
        content: read back; sums over its placements are enough.
        plan: mask with the places of the pillars.
        doses: its dose table.
        process: point exposure, bias, etch and layers.
        height_um: of the pillars, for their feet.
        keep: called with the rows of all lattices, in turn; memory is bounded.

    Accuracy: the field on nodes to some 1e-4 (the result states the difference from
    direct sums); widths by the slope at the drawn edge, 3 % of a shift of 4 nm.

    Raises:
        ProcessError: the process has no point exposure, no pillar has a dose, or a
            class is not one outline.
    """
    point = point_exposure(process.exposure)
    scene = read_scene(content, plan, doses, process)
    field = _Field.of(scene, point)
    tally = VerificationTally.empty()
    box = _box(scene.bodies, ())
    judged = (scene.dose > 0) & (scene.layer != process.layers.dose[0])
    pillars = 0
    for rows in _develop(scene, field, plan, process):
        body = scene.bodies[rows.number]
        row, column = np.nonzero(scene.dose[rows.classes] > 0)
        pillar_class = rows.classes[row, column]
        pillars += len(pillar_class)
        values = (
            rows.exposure[row, column],
            scene.size_um[pillar_class] / nm,
            rows.resist_nm[row, column],
            rows.made_nm[row, column],
        )
        y = body.rows_um(rows.first, len(rows.classes))
        tally.take((body.columns_um[column], y[row]), judged[pillar_class], values, box)
        if keep is not None:
            keep(rows)
    top, foot = process.top_foot_nm(0.0, height_um / nm)
    return ExposureReport(
        pillars,
        tally,
        box,
        _edges(scene, field, point),
        float(foot - top) / 2,
        process.exposure.tolerance,
        scene.undosed,
        *_sampled(scene, field, point),
    )


def read_scene(
    content: MaskLibrary,
    plan: MaskPlan,
    doses: Mapping[LayerNumber, float],
    process: Process,
) -> WrittenMask:
    """Shapes, doses and layers of a file, on the lattices of its plan.

    Args:
        content: read back.
        plan: mask with classes and lattices.
        doses: relative dose of each layer.
        process: layers.

    Raises:
        ProcessError: a class that is not one outline, or no pillar with a dose.
    """
    layers = process.layers
    unit = content.unit_nm * nm
    skipped = {layers.aperture[0], layers.outline[0], layers.fields[0]}
    undosed: set[LayerNumber] = set()

    def exposed(cell: str) -> Iterator[PolygonStack]:
        for stack in flatten_stacks(content, cell):
            if stack.layer[0] not in skipped:
                if stack.layer in doses:
                    yield stack
                else:
                    undosed.add(stack.layer)

    used = np.flatnonzero(plan.counts()[1:] > 0) + 1
    contours: list[Sequence[Array]] = [()] * (len(plan.classes) + 1)
    dose, layer, size_um = np.zeros((3, len(plan.classes) + 1))
    for number in used.tolist():
        pillar = plan.classes[number - 1]
        stacks = list(exposed(plan.classes[number - 1].name))
        if not stacks:
            continue
        contours[number] = [
            contour * unit for contour in _one_outline(pillar.name, stacks)
        ]
        dose[number], layer[number] = doses[stacks[0].layer], stacks[0].layer[0]
        size_um[number] = pillar.diameter_nm * nm
    if not dose.any():
        raise ProcessError(
            "the mask holds no pillar with a dose; nothing can be verified"
        )
    kinds: DrawnKinds = DrawnOutlines(contours)
    if all(pillar.round for pillar in plan.classes):
        size_um = kinds.diameter_um
        kinds = DrawnDiscs(size_um)
    emptied = {
        lattice.name: dataclasses.replace(
            content.cells[lattice.name], placed=NOTHING, sums=None, pillars=None
        )
        for lattice in plan.lattices
    }
    content = dataclasses.replace(content, cells={**content.cells, **emptied})
    corners: list[Array] = []
    dose_and_layer: list[tuple[float, int]] = []
    for stack in exposed(plan.name):
        places = np.stack([stack.x, stack.y], -1)[:, None, None]
        outlines = (stack.outlines[None] + places).reshape(
            -1, *stack.outlines.shape[1:]
        )
        corners += list(outlines * unit)
        dose_and_layer += [(doses[stack.layer], stack.layer[0])] * len(outlines)
    table = np.array(dose_and_layer, float).reshape(-1, 2)
    return WrittenMask(
        [dataclasses.replace(lattice, unit_um=unit) for lattice in plan.lattices],
        kinds,
        dose,
        layer.astype(np.int64),
        size_um,
        ExposedPolygons(corners, table[:, 0], table[:, 1].astype(np.int64)),
        tuple(sorted(undosed)),
    )


def _one_outline(name: str, stacks: Sequence[PolygonStack]) -> list[Array]:
    """Contours of what a class of pillars draws, in database units.

    Raises:
        ProcessError: several outer contours, or shapes on several layers.
    """
    drawn = [
        outline + np.array(place)
        for stack in stacks
        for outline in stack.outlines
        for place in zip(stack.x, stack.y, strict=True)
    ]
    contours = drawn if len(drawn) == 1 else region.union_contours(drawn)
    outer = sum(polygon.twice_area(contour) > 0 for contour in contours)
    if outer != 1 or len({stack.layer for stack in stacks}) > 1:
        raise ProcessError(
            f"class {name} of pillars draws {outer} outlines; it is not verified as one"
        )
    return [np.asarray(contour, float) for contour in contours]


@dataclass(frozen=True, eq=False, slots=True)
class _Field:
    """Background exposure: on nodes by wide Gaussians, on the sites by middle ones.

    far: (y, x) on the nodes. near: (rows, columns) of each lattice; empty without
    middle range. own, slope: (classes + 1,) exposure of a pillar's edge by itself at
    unit dose, less what the node field counts for it, and its fall per um. close:
    (range, weight) of the Gaussians that nodes do not hold. spots: points and masses
    that represent other shapes.
    """

    ranges: bodies.ScatterRanges
    grid: nodes.NodeGrid
    far: Array
    near: Sequence[Array]
    own: Array
    slope: Array
    close: Sequence[tuple[float, float]]
    spots: tuple[Array, Array]

    @classmethod
    def of(cls, scene: WrittenMask, point: PointExposure) -> "_Field":
        """Sum the exposure of all shapes at the doses of a scene.

        Masses (dose times area) go to the nodes, for the far range, and to the sites,
        for the middle range; both are convolved with their Gaussians by FFT.

        Args:
            scene: what a written mask exposes.
            point: exposure of a beam.
        """
        counts = bodies.count_pillars(scene.bodies, len(scene.dose)) * (scene.dose > 0)
        densest = min(scene.bodies, key=lambda body: body.nearest_um)
        ranges = bodies.split_ranges(point, scene.kinds, counts, densest)
        own, slope = _of_themselves(scene, counts > 0, point)
        far = ranges.far
        own = own - scene.kinds.area_um2 * float(far.density(np.array(0.0)))
        narrowest_um = float(far.widths_um.min()) if len(far.widths_um) else 1e3
        grid = nodes.NodeGrid.over(
            _box(scene.bodies, scene.others.corners), narrowest_um
        )
        x, y, masses = polygon_edges.equivalent_spots(
            scene.others, narrowest_um / _SPOTS
        )
        mass = grid.deposit(x, y, masses)[None]
        mass_of_class = scene.dose * scene.kinds.area_um2
        for body in scene.bodies:
            across = grid.x.at(body.columns_um)
            for first, block in body.blocks():
                down = grid.y.at(body.rows_um(first, len(block)))
                nodes.gather_to_nodes(block, mass_of_class[None], *down, *across, mass)
        spacing = grid.y.spacing_um, grid.x.spacing_um
        far_convolution = nodes.gaussian_convolution(
            grid.shape, spacing, point=far, hollow=False
        )
        near = []
        if len(ranges.middle.widths_um):
            for body in scene.bodies:
                sites = np.concatenate(
                    [mass_of_class[classes] for _, classes in body.blocks()]
                )
                middle = correct.middle_convolution(body, ranges)
                near.append(middle(sites).astype(np.float32))
        close = [
            (float(width_um), float(weight))
            for width_um, weight in zip(point.widths_um, point.weights, strict=True)
            if width_um < bodies.COARSE * densest.nearest_um
        ]
        points = np.column_stack([x, y])
        return cls(
            ranges,
            grid,
            far_convolution(mass[0]),
            near,
            own,
            slope,
            close,
            (points, masses),
        )

    def rows(self, scene: WrittenMask, number: int, first: int, block: Array) -> Array:
        """(rows, columns) exposure of the drawn edges of a block, float.

        far field + middle field + dose * own.

        Args:
            scene: what a written mask exposes.
            number: of the lattice.
            first: row of the block.
            block: (rows, columns) classes.
        """
        body = scene.bodies[number]
        exposure = np.empty(block.shape, np.float32)
        nodes.interpolate_from_nodes(
            self.far,
            *self.grid.y.at(body.rows_um(first, len(block))),
            *self.grid.x.at(body.columns_um),
            exposure,
        )
        if self.near:
            exposure += self.near[number][first : first + len(block)]
        return np.asarray(exposure + (scene.dose * self.own)[block])


def _of_themselves(
    scene: WrittenMask, used: Array, point: PointExposure
) -> tuple[Array, Array]:
    """(classes + 1,) exposure of an edge by its own pillar at unit dose, and its slope.

    Classes of equal contours and different doses are computed once.

    Args:
        scene: what a written mask exposes.
        used: (classes + 1,) which classes occur.
        point: exposure of a beam.

    Returns:
        Exposure, and its fall per um that the edges move out.
    """
    if isinstance(scene.kinds, DrawnDiscs):
        return scene.kinds.edge_exposure(used, point)
    contours = scene.kinds.contours if isinstance(scene.kinds, DrawnOutlines) else ()
    first: dict[bytes, int] = {}
    representative = np.arange(len(contours))
    for number in np.flatnonzero(used).tolist():
        key = b"|".join(
            np.ascontiguousarray(contour).tobytes() for contour in contours[number]
        )
        representative[number] = first.setdefault(key, number)
    is_representative = np.zeros(len(contours), bool)
    is_representative[list(first.values())] = True
    own, slope = scene.kinds.edge_exposure(is_representative, point)
    return own[representative], slope[representative]


def _box(
    parts: Sequence[PillarArray], corners: Sequence[Array]
) -> tuple[float, float, float, float]:
    """Left, bottom, right, top of sites and shapes, um."""
    site_boxes = [np.array(body.box_um).reshape(2, 2) for body in parts]
    points = np.concatenate([*site_boxes, *corners])
    return *points.min(0).tolist(), *points.max(0).tolist()


def _develop(
    scene: WrittenMask, field: _Field, plan: MaskPlan, process: Process
) -> Iterator[ExposedRows]:
    """Size of each pillar in the resist and after the etch, by the threshold model.

    An edge comes out where the exposure is half of that of a wide area. A surplus of
    exposure moves both edges: resist = drawn + 2 (exposure - THRESHOLD) / slope. The
    bias of the etch depends on how isolated each pillar is.

    Yields:
        Blocks of rows of all lattices, in turn.
    """
    slope = np.maximum(scene.dose * field.slope, 1e-9)
    is_round = isinstance(scene.kinds, DrawnDiscs)
    for number, body in enumerate(scene.bodies):
        halo = 0
        if process.bias.isolated_nm:
            halo = isolation.isolation_halo(body.down_um, process.bias.range_um)
        for first, block in body.blocks():
            exposure = field.rows(scene, number, first, block)
            shift = 2 * (exposure - THRESHOLD) / slope[block]
            resist = (scene.size_um[block] + shift) / nm
            isolated: Array | float = 0.0
            if halo:
                low = max(0, first - halo)
                stop = min(body.rows, first + len(block) + halo)
                isolated = isolation.isolation_map(
                    body.source(low, stop) > 0,
                    (body.pitch_um, body.down_um),
                    process.bias.range_um,
                    centred=body.centred,
                )[first - low : first - low + len(block)]
            etch = process.made_diameter_nm if is_round else process.bias.made_nm
            made = np.where(block > 0, etch(np.maximum(resist, 0), isolated), 0)
            yield ExposedRows(number, first, block, exposure / THRESHOLD, resist, made)


def _edges(scene: WrittenMask, field: _Field, point: PointExposure) -> EdgeErrors:
    """Exposure and position error at samples along the edges of marks and labels.

    The error is (exposure - THRESHOLD) / slope, in nm; the slope is a difference across
    the edge. Close Gaussians are summed in closed form over the polygons.
    """
    widest_close_um = max((a for a, _ in field.close), default=0.0)
    points = polygon_edges.sample_edges(scene.others, widest_close_um)
    positions = np.concatenate([points.at_um, *polygon_edges.points_across(points)])
    close = polygon_edges.exposure_at_edges(positions, scene.others, field.close)
    exposure, outside, inside = np.split(close, 3)
    x, y = points.at_um.T
    exposure = exposure + field.grid.sample(field.far, x, y)
    slope = np.maximum(inside - outside, 1e-12) / polygon_edges.ACROSS_UM
    return EdgeErrors(
        x, y, exposure / THRESHOLD, (exposure - THRESHOLD) / slope / nm, points.layer
    )


def _sampled(
    scene: WrittenMask, field: _Field, point: PointExposure
) -> tuple[float, float]:
    """Compare the field with direct sums at sample pillars of the first lattice.

    Returns:
        Largest |exposure - 1| by direct sums over the exact shapes, relative to dose to
        size, and the largest difference of the field from these sums.
    """
    sites = sum(body.rows * body.columns for body in scene.bodies)
    samples = int(np.clip(_PRODUCTS / sites, 16, _SAMPLES))
    lattices = sampled.ExposedLattices(
        scene.bodies,
        scene.kinds,
        field.own
        + scene.kinds.area_um2 * float(field.ranges.far.density(np.array(0.0))),
        field.ranges,
        point,
        field.spots,
        lambda number, first, block: scene.dose[block],
    )
    rows, columns, exact = sampled.exact_edges(lattices, samples)
    worst_field = 0.0
    judged = scene.dose[_entries(scene, rows, columns)] > 0
    worst_exposure = float(np.abs(exact / THRESHOLD - 1)[judged].max(initial=0.0))
    for row in np.unique(rows).tolist():
        in_row = rows == row
        block = np.ascontiguousarray(scene.bodies[0].source(row, row + 1))
        by_field = field.rows(scene, 0, row, block)[0, columns[in_row]]
        worst_field = max(
            worst_field, float(np.abs(by_field - exact[in_row]).max()) / THRESHOLD
        )
    return worst_exposure, worst_field


def _entries(scene: WrittenMask, rows: Array, columns: Array) -> Array:
    """(n,) classes of pillars of the first lattice."""
    source = scene.bodies[0].source
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return np.array([source(row, row + 1)[0, column] for row, column in pairs])
