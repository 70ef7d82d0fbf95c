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
    size_um: (classes + 1,) of each class, dose 0 where its layer has none.
    others: all other shapes. undosed: layers with shapes and no dose.
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
    """What comes out in some rows of a lattice, (rows, columns) each.

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
    """Expose and etch a mask that was read back, whose pillars stand where ``plan`` has
    them.

    Args:
        content: read back; sums over its placements are enough.
        doses: its dose table. height_um: of the pillars, for their feet.
        keep: is given the rows of all lattices, in turn; memory is bounded.
        process: point exposure, bias, etch and layers.

    Accuracy: the field on nodes to some 1e-4 (the result states the difference from
    direct sums); widths by the slope at the drawn edge, 3 % of a shift of 4 nm.

    Raises:
        ProcessError: no point exposure is given, no pillar has a dose, or a class is
            not one outline.
    """
    point = point_exposure(process.exposure)
    scene = read_scene(content, plan, doses, process)
    field = _Field.of(scene, point)
    total = VerificationTally.empty()
    box = _box(scene.bodies, ())
    judged = (scene.dose > 0) & (scene.layer != process.layers.dose[0])
    count = 0
    for rows in _develop(scene, field, plan, process):
        body = scene.bodies[rows.number]
        row, column = np.nonzero(scene.dose[rows.classes] > 0)
        kind = rows.classes[row, column]
        count += len(kind)
        values = (
            rows.exposure[row, column],
            scene.size_um[kind] / nm,
            rows.resist_nm[row, column],
            rows.made_nm[row, column],
        )
        y = body.rows_um(rows.first, len(rows.classes))
        total.take((body.columns_um[column], y[row]), judged[kind], values, box)
        if keep is not None:
            keep(rows)
    top, foot = process.top_foot_nm(0.0, height_um / nm)
    return ExposureReport(
        count,
        total,
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
    dose, layer, size = np.zeros((3, len(plan.classes) + 1))
    for k in used.tolist():
        made = plan.classes[k - 1]
        stacks = list(exposed(plan.classes[k - 1].name))
        if not stacks:
            continue
        contours[k] = [c * unit for c in _one_outline(made.name, stacks)]
        dose[k], layer[k] = doses[stacks[0].layer], stacks[0].layer[0]
        size[k] = made.diameter_nm * nm
    if not dose.any():
        raise ProcessError(
            "the mask holds no pillar with a dose; nothing can be verified"
        )
    kinds: DrawnKinds = DrawnOutlines(contours)
    if all(made.round for made in plan.classes):
        size = kinds.diameter_um
        kinds = DrawnDiscs(size)
    empty = {
        l.name: dataclasses.replace(
            content.cells[l.name], placed=NOTHING, sums=None, pillars=None
        )
        for l in plan.lattices
    }
    content = dataclasses.replace(content, cells={**content.cells, **empty})
    corners: list[Array] = []
    others: list[tuple[float, int]] = []
    for stack in exposed(plan.name):
        places = np.stack([stack.x, stack.y], -1)[:, None, None]
        shapes = (stack.outlines[None] + places).reshape(-1, *stack.outlines.shape[1:])
        corners += list(shapes * unit)
        others += [(doses[stack.layer], stack.layer[0])] * len(shapes)
    table = np.array(others, float).reshape(-1, 2)
    return WrittenMask(
        [dataclasses.replace(l, unit_um=unit) for l in plan.lattices],
        kinds,
        dose,
        layer.astype(np.int64),
        size,
        ExposedPolygons(corners, table[:, 0], table[:, 1].astype(np.int64)),
        tuple(sorted(undosed)),
    )


def _one_outline(name: str, stacks: Sequence[PolygonStack]) -> list[Array]:
    """Contours of what a class of pillars draws, in database units."""
    drawn = [
        outline + np.array(place)
        for stack in stacks
        for outline in stack.outlines
        for place in zip(stack.x, stack.y, strict=True)
    ]
    found = drawn if len(drawn) == 1 else region.union_contours(drawn)
    outer = sum(polygon.twice_area(c) > 0 for c in found)
    if outer != 1 or len({stack.layer for stack in stacks}) > 1:
        raise ProcessError(
            f"class {name} of pillars draws {outer} outlines; it is not verified as one"
        )
    return [np.asarray(c, float) for c in found]


@dataclass(frozen=True, eq=False, slots=True)
class _Field:
    """Background of all that is exposed: on nodes by wide Gaussians, on the sites by
    those that reach neighbours only.

    own, slope: (classes + 1,) exposure of a pillar's edge by itself at unit dose, less
    what the node field counts for it, and its fall per um.
    close: (range, weight) of the Gaussians that nodes do not hold. spots: points and
    masses that stand for other shapes.
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
        """The field of the doses of a scene."""
        number = bodies.count_pillars(scene.bodies, len(scene.dose)) * (scene.dose > 0)
        densest = min(scene.bodies, key=lambda body: body.nearest_um)
        ranges = bodies.split_ranges(point, scene.kinds, number, densest)
        own, slope = _of_themselves(scene, number > 0, point)
        far = ranges.far
        own = own - scene.kinds.area_um2 * float(far.density(np.array(0.0)))
        width = float(far.widths_um.min()) if len(far.widths_um) else 1e3
        grid = nodes.NodeGrid.over(_box(scene.bodies, scene.others.corners), width)
        x, y, spots = polygon_edges.equivalent_spots(scene.others, width / _SPOTS)
        mass = grid.deposit(x, y, spots)[None]
        carried = scene.dose * scene.kinds.area_um2
        for body in scene.bodies:
            across = grid.x.at(body.columns_um)
            for first, block in body.blocks():
                down = grid.y.at(body.rows_um(first, len(block)))
                nodes.gather_to_nodes(block, carried[None], *down, *across, mass)
        spacing = grid.y.spacing_um, grid.x.spacing_um
        reach = nodes.gaussian_convolution(grid.shape, spacing, point=far, hollow=False)
        near = []
        if len(ranges.middle.widths_um):
            for body in scene.bodies:
                sites = np.concatenate([carried[b] for _, b in body.blocks()])
                middle = correct.middle_convolution(body, ranges)
                near.append(middle(sites).astype(np.float32))
        close = [
            (float(a), float(w))
            for a, w in zip(point.widths_um, point.weights, strict=True)
            if a < bodies.COARSE * densest.nearest_um
        ]
        points = np.column_stack([x, y])
        return cls(
            ranges, grid, reach(mass[0]), near, own, slope, close, (points, spots)
        )

    def rows(self, scene: WrittenMask, number: int, first: int, block: Array) -> Array:
        """(rows, columns) exposure of the drawn edges of a block."""
        body = scene.bodies[number]
        out = np.empty(block.shape, np.float32)
        nodes.interpolate_from_nodes(
            self.far,
            *self.grid.y.at(body.rows_um(first, len(block))),
            *self.grid.x.at(body.columns_um),
            out,
        )
        if self.near:
            out += self.near[number][first : first + len(block)]
        return np.asarray(out + (scene.dose * self.own)[block])


def _of_themselves(
    scene: WrittenMask, used: Array, point: PointExposure
) -> tuple[Array, Array]:
    """(classes + 1,) exposure of edges by the pillar itself and its slope; classes of
    one outline and several doses are worked out once.
    """
    if isinstance(scene.kinds, DrawnDiscs):
        return scene.kinds.edge_exposure(used, point)
    contours = scene.kinds.contours if isinstance(scene.kinds, DrawnOutlines) else ()
    first: dict[bytes, int] = {}
    same = np.arange(len(contours))
    for k in np.flatnonzero(used).tolist():
        key = b"|".join(np.ascontiguousarray(c).tobytes() for c in contours[k])
        same[k] = first.setdefault(key, k)
    once = np.zeros(len(contours), bool)
    once[list(first.values())] = True
    own, slope = scene.kinds.edge_exposure(once, point)
    return own[same], slope[same]


def _box(
    parts: Sequence[PillarArray], corners: Sequence[Array]
) -> tuple[float, float, float, float]:
    """Left, bottom, right, top of sites and shapes."""
    ends = [np.array(body.box_um).reshape(2, 2) for body in parts]
    every = np.concatenate([*ends, *corners])
    return *every.min(0).tolist(), *every.max(0).tolist()


def _develop(
    scene: WrittenMask, field: _Field, plan: MaskPlan, process: Process
) -> Iterator[ExposedRows]:
    """Threshold model: an edge comes out where the exposure is half of what a wide area
    receives; then the bias of the etch, for how alone each pillar stands.
    """
    steep = np.maximum(scene.dose * field.slope, 1e-9)
    is_round = isinstance(scene.kinds, DrawnDiscs)
    for number, body in enumerate(scene.bodies):
        reach = 0
        if process.bias.isolated_nm:
            reach = isolation.isolation_halo(body.down_um, process.bias.range_um)
        for first, block in body.blocks():
            exposure = field.rows(scene, number, first, block)
            shift = 2 * (exposure - THRESHOLD) / steep[block]
            resist = (scene.size_um[block] + shift) / nm
            alone: Array | float = 0.0
            if reach:
                low = max(0, first - reach)
                end = min(body.rows, first + len(block) + reach)
                alone = isolation.isolation_map(
                    body.source(low, end) > 0,
                    (body.pitch_um, body.down_um),
                    process.bias.range_um,
                    centred=body.centred,
                )[first - low : first - low + len(block)]
            etch = process.made_diameter_nm if is_round else process.bias.made_nm
            made = np.where(block > 0, etch(np.maximum(resist, 0), alone), 0)
            yield ExposedRows(number, first, block, exposure / THRESHOLD, resist, made)


def _edges(scene: WrittenMask, field: _Field, point: PointExposure) -> EdgeErrors:
    """Exposure at samples along the edges of marks and labels, and where across each
    edge it is the threshold; closed form for close Gaussians.
    """
    core = max((a for a, _ in field.close), default=0.0)
    points = polygon_edges.sample_edges(scene.others, core)
    every = np.concatenate([points.at_um, *polygon_edges.points_across(points)])
    close = polygon_edges.exposure_at_edges(every, scene.others, field.close)
    here, outside, inside = np.split(close, 3)
    x, y = points.at_um.T
    here = here + field.grid.sample(field.far, x, y)
    slope = np.maximum(inside - outside, 1e-12) / polygon_edges.ACROSS_UM
    return EdgeErrors(
        x, y, here / THRESHOLD, (here - THRESHOLD) / slope / nm, points.layer
    )


def _sampled(
    scene: WrittenMask, field: _Field, point: PointExposure
) -> tuple[float, float]:
    """Of direct sums over the exact shapes, at sample pillars of the first lattice: the
    largest |exposure - 1|, and the largest difference of the field from them.
    """
    sites = sum(body.rows * body.columns for body in scene.bodies)
    samples = int(np.clip(_PRODUCTS / sites, 16, _SAMPLES))
    exposed = sampled.ExposedLattices(
        scene.bodies,
        scene.kinds,
        field.own
        + scene.kinds.area_um2 * float(field.ranges.far.density(np.array(0.0))),
        field.ranges,
        point,
        field.spots,
        lambda number, first, block: scene.dose[block],
    )
    rows, columns, exact = sampled.exact_edges(exposed, samples)
    worst = 0.0
    judged = scene.dose[_entries(scene, rows, columns)] > 0
    off = float(np.abs(exact / THRESHOLD - 1)[judged].max(initial=0.0))
    for row in np.unique(rows).tolist():
        mine = rows == row
        block = np.ascontiguousarray(scene.bodies[0].source(row, row + 1))
        fast = field.rows(scene, 0, row, block)[0, columns[mine]]
        worst = max(worst, float(np.abs(fast - exact[mine]).max()) / THRESHOLD)
    return off, worst


def _entries(scene: WrittenMask, rows: Array, columns: Array) -> Array:
    """(n,) classes of pillars of the first lattice."""
    source = scene.bodies[0].source
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return np.array([source(row, row + 1)[0, column] for row, column in pairs])
