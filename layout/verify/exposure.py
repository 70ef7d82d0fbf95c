"""Verification of the exposure: what the written files and their dose table make."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from layout.formats.library import (
    MaskLibrary,
    PolygonStack,
    flatten_polygons,
    flatten_stacks,
)
from layout.mask.plan import MaskPlan, PillarArray
from layout.pec import bodies, correct, nodes, polygon_edges
from layout.pec.pillar_exposure import DrawnDiscs, DrawnKinds, DrawnOutlines
from layout.pec.polygon_edges import ExposedPolygons
from layout.pec.psf import THRESHOLD, PointExposure, point_exposure
from layout.pec.shapes import SPOTS, near_and_far
from layout.process import isolation
from layout.process.process import ExposureSettings, LayerNumber, Process
from layout.shapes import polygon, region
from layout.shapes.moments import points_along_edges
from layout.verify.report import EdgeErrors, ExposureReport, VerificationTally
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm

_PRODUCTS = 4e9  # of samples and sites that are summed exactly, at most
_CLOSE = 1e5  # products that the exact exposure by one shape costs
_FAR = 6.0  # ranges between two shapes at which a Gaussian is below exp(-36)


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
    keep: Callable[[ExposedRows], None] | None = None,
    samples: int = 1000,
) -> ExposureReport:
    """Expose and etch a mask that was read back, in simulation.

    Args:
        content: read back; sums over its placements are enough.
        plan: mask with the places of the pillars.
        doses: its dose table.
        process: point exposure, bias, etch and layers.
        keep: called with the rows of all lattices, in turn; memory is bounded.
        samples: pillars whose exposure is summed exactly as well; fewer, down to 16, on
            large masks.

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
        )
        y = body.rows_um(rows.first, len(rows.classes))
        tally.take((body.columns_um[column], y[row]), judged[pillar_class], values, box)
        if keep is not None:
            keep(rows)
    return ExposureReport(
        pillars,
        tally,
        box,
        _edges(
            scene.others,
            field.ranges.close,
            field.background.grid,
            field.background.far,
        ),
        process.exposure.tolerance,
        scene.undosed,
        *_sampled(scene, field, samples),
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
            content.cells[lattice.name], references=(), sums={}, pillars=None
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


@dataclass(frozen=True, eq=False)
class _Field:
    """Exposure of the drawn edges: a background, and what each pillar adds itself.

    ranges: Gaussians by reach.
    background: on nodes by far ranges, on sites by middle ones.
    own, slope: (classes + 1,) exposure of a pillar's edge by itself at unit dose, less
        what the node field counts for it, and its fall per um.
    spots: points and masses that represent other shapes.
    """

    ranges: bodies.ScatterRanges
    background: nodes.ScatterBackground
    own: Array
    slope: Array
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
        own, slope = scene.kinds.edge_exposure(counts > 0, point)
        far = ranges.far
        own = own - scene.kinds.area_um2 * float(far.density(np.array(0.0)))
        narrowest_um = float(far.widths_um.min(initial=1e3))
        grid = nodes.NodeGrid.over(
            _box(scene.bodies, scene.others.corners), narrowest_um
        )
        x, y, masses = polygon_edges.equivalent_spots(
            scene.others, narrowest_um / SPOTS
        )
        mass = grid.deposit(x, y, masses)[None]
        mass_of_class = scene.dose * scene.kinds.area_um2
        for body in scene.bodies:
            grid.gather(body, mass_of_class[None], mass)
        near = []
        if len(ranges.middle.widths_um):
            for body in scene.bodies:
                sites = np.concatenate(
                    [mass_of_class[classes] for _, classes in body.blocks()]
                )
                middle = correct.middle_convolution(body, ranges)
                near.append(middle(sites).astype(np.float32))
        background = nodes.ScatterBackground(grid, grid.convolution(far)(mass[0]), near)
        points = np.column_stack([x, y])
        return cls(ranges, background, own, slope, (points, masses))

    def rows(self, scene: WrittenMask, number: int, first: int, block: Array) -> Array:
        """(rows, columns) exposure of the drawn edges of a block, float.

        Background + dose * own.

        Args:
            scene: what a written mask exposes.
            number: of the lattice.
            first: row of the block.
            block: (rows, columns) classes.
        """
        exposure = self.background.at_sites(
            scene.bodies[number], number, first, len(block)
        )
        return np.asarray(exposure + (scene.dose * self.own)[block])


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
        for first, block in body.blocks():
            exposure = field.rows(scene, number, first, block)
            shift = 2 * (exposure - THRESHOLD) / slope[block]
            resist = (scene.size_um[block] + shift) / nm
            isolated: Array | float = 0.0
            if process.bias.isolated_nm:
                isolated = isolation.isolation_rows(
                    body.present,
                    first,
                    first + len(block),
                    (body.pitch_um, body.down_um),
                    process.bias.range_um,
                    centred=body.centred,
                )
            etch = process.made_diameter_nm if is_round else process.bias.fabricated_nm
            made = np.where(block > 0, etch(np.maximum(resist, 0), isolated), 0)
            yield ExposedRows(number, first, block, exposure / THRESHOLD, resist, made)


def _edges(
    others: ExposedPolygons,
    close: PointExposure,
    grid: nodes.NodeGrid,
    far: Array,
    unit_um: float = nm,
) -> EdgeErrors:
    """Exposure and position error at samples along the edges of polygons.

    The error is (exposure - THRESHOLD) / slope, in nm; the slope is a difference across
    the edge. Close Gaussians are summed in closed form over the polygons.
    """
    widest_close_um = float(close.widths_um.max(initial=0.0))
    points = polygon_edges.sample_edges(others, widest_close_um, unit_um=unit_um)
    positions = np.concatenate([points.at_um, *polygon_edges.points_across(points)])
    values = polygon_edges.exposure_at_edges(positions, others, close.terms)
    exposure, outside, inside = np.split(values, 3)
    x, y = points.at_um.T
    exposure = exposure + grid.sample(far, x, y)
    slope = np.maximum(inside - outside, 1e-12) / polygon_edges.ACROSS_UM
    return EdgeErrors(
        x, y, exposure / THRESHOLD, (exposure - THRESHOLD) / slope / nm, points.layer
    )


def verify_polygons(
    library: MaskLibrary, doses: Mapping[LayerNumber, float], exposure: ExposureSettings
) -> ExposureReport:
    """Expose the polygons of a mask that was read back, in simulation.

    A shape without a straight edge counts by the mean along its edges.

    Args:
        library: cells of the file.
        doses: of its dose table.
        exposure: point exposure and tolerance.

    Raises:
        ProcessError: no polygon with a dose.
    """
    unit = library.unit_nm * nm
    drawn = [(layer, p) for layer, p in flatten_polygons(library) if layer in doses]
    corners = [points * unit for _, points in drawn]
    dose = np.array([doses[layer] for layer, _ in drawn])
    others = ExposedPolygons(corners, dose, np.zeros(len(drawn), np.int64))
    near, _, grid, field = near_and_far(others, exposure)
    edges = _edges(others, near, grid, field, unit)
    shortest = 4 * float(near.widths_um.max()) / unit
    curved = [
        points_along_edges([contour * unit])
        for contour in region.union_contours(points for _, points in drawn)
        if np.hypot(*np.diff(contour, axis=0, append=contour[:1]).T).max() <= shortest
    ]
    if curved:
        at = np.concatenate(curved)
        values = polygon_edges.exposure_at_edges(at, others, near.terms)
        values = values + grid.sample(field, *at.T)
        means = values.reshape(len(curved), -1).mean(1) / THRESHOLD
        x, y = at.reshape(len(curved), -1, 2).mean(1).T
        zeros = np.zeros(len(curved), np.int64)
        more = x, y, means, zeros, zeros
        edges = EdgeErrors(*map(np.append, vars(edges).values(), more))
    undosed = tuple(sorted(library.layers - doses.keys()))
    tally = VerificationTally.empty()
    box = _box((), corners)
    return ExposureReport(0, tally, box, edges, exposure.tolerance, undosed)


# direct sums


def _sampled(scene: WrittenMask, field: _Field, samples: int) -> tuple[float, float]:
    """Compare the field with direct sums at sample pillars of the first lattice.

    Returns:
        Largest |exposure - 1| by direct sums over the exact shapes, relative to dose to
        size, and the largest difference of the field from these sums.
    """
    body = scene.bodies[0]
    widest_um = float(field.ranges.close.widths_um.max(initial=0.0))
    reach_um = _FAR * widest_um + 2 * np.sqrt(float(scene.kinds.wider_um2.max()))
    rows, columns = (1 + int(reach_um / step) for step in (body.down_um, body.pitch_um))
    sites = sum(each.rows * each.columns for each in scene.bodies)
    products = sites + len(field.spots[0]) + _CLOSE * rows * columns
    places = _some_pillars(scene, int(np.clip(_PRODUCTS / products, 16, samples)))
    exact = _distant_exposure(scene, field, *places)
    by_field = np.empty(len(exact))
    for n, (row, column) in enumerate(
        zip(*map(np.ndarray.tolist, places), strict=True)
    ):
        exact[n] += _close_exposure(scene, field, (row, column), (rows, columns))
        block = np.ascontiguousarray(body.source(row, row + 1))
        by_field[n] = field.rows(scene, 0, row, block)[0, column]
    worst_exposure = np.abs(exact / THRESHOLD - 1).max(initial=0.0)
    worst_field = np.abs(by_field - exact).max(initial=0.0) / THRESHOLD
    return float(worst_exposure), float(worst_field)


def _some_pillars(scene: WrittenMask, samples: int) -> tuple[Array, Array]:
    """Rows and columns of some ``samples`` dosed pillars, evenly over the first
    lattice.
    """
    body = scene.bodies[0]
    occupied = scene.dose > 0
    total = int(body.counts(len(occupied) - 1)[occupied].sum())
    stride = max(1, -(-total // samples))
    chosen = [np.empty(0, np.int64)]
    passed = 0
    for first, block in body.blocks():
        sites = np.flatnonzero(occupied[block])
        chosen.append(first * body.columns + sites[-passed % stride :: stride])
        passed += len(sites)
    rows, columns = np.divmod(np.concatenate(chosen), body.columns)
    return rows, columns


def _distant_exposure(
    scene: WrittenMask, field: _Field, rows: Array, columns: Array
) -> Array:
    """(samples,) exposure by far ranges, every shape as points.

    sum of dose * area * weight / (pi w^2) * exp(-r^2 / w^2), with widths w that the
    size of the mean pillar has widened.

    Args:
        scene: lattices with doses.
        field: Gaussians by reach, and points of other shapes.
        rows, columns: (samples,) of the samples on the first lattice.
    """
    lens = scene.bodies[0]
    at_x = lens.columns_um[columns]
    at_y = lens.rows_um(0, lens.rows)[rows]
    mass_of_class = (scene.dose * scene.kinds.area_um2).astype(np.float32)
    points, masses = field.spots
    total = np.zeros(len(at_x))
    for width, weight in field.ranges.far.terms:
        bell = _bell(points[:, 0], at_x, width) * _bell(points[:, 1], at_y, width)
        sums = masses @ bell
        for body in scene.bodies:
            bell_x = _bell(body.columns_um, at_x, width)
            for first, block in body.blocks():
                bell_y = _bell(body.rows_um(first, len(block)), at_y, width)
                sums += ((mass_of_class[block] @ bell_x) * bell_y).sum(0, dtype=float)
        total += weight / (np.pi * width**2) * sums
    return total


def _bell(positions: Array, centres: Array, width: float) -> Array:
    """(positions, centres) exp(-((position - centre) / width)^2), float32."""
    return np.asarray(
        np.exp(-(((positions[:, None] - centres) / width) ** 2)), np.float32
    )


def _close_exposure(
    scene: WrittenMask, field: _Field, site: tuple[int, int], span: tuple[int, int]
) -> float:
    """Exposure of the edges of a pillar by itself and by the shapes around it; close
    Gaussians are summed over the exact shapes.

    Args:
        scene: lattices with doses.
        field: Gaussians by reach.
        site: row and column of the pillar on the first lattice.
        span: rows and columns on each side that are in reach.
    """
    body, kinds = scene.bodies[0], scene.kinds
    row, column = site
    top, left = (max(at - reach, 0) for at, reach in zip(site, span, strict=True))
    below = min(row + span[0] + 1, body.rows)
    block = body.source(top, below)[:, left : column + span[1] + 1]
    pillar = int(block[row - top, column - left])
    i, j = np.nonzero(scene.dose[block] > 0)
    is_other = (i != row - top) | (j != column - left)
    i, j = i[is_other], j[is_other]
    entry = block[i, j]
    # rows run towards -y
    offset = np.column_stack(
        [(left + j - column) * body.pitch_um, (row - top - i) * body.down_um]
    )
    total = float(scene.dose[pillar] * field.own[pillar])
    edge = kinds.edge_points_um(pillar)
    for kind in np.unique(entry).tolist():
        places = edge[:, None] - offset[entry == kind]
        for width, weight in field.ranges.close.terms:
            exposure = kinds.exposure_at(kind, places, width)
            total += weight * float(scene.dose[kind] * exposure.sum(-1).mean())
    return total
