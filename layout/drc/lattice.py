"""Design-rule check of a lens's own mask: exact, by classes of neighbouring pillars on
its lattices.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from layout.drc.geometry import (
    clean_contour,
    contour_box,
    contour_edges,
    find_close_boxes,
    measure_polygon,
    measure_separation,
)
from layout.drc.report import MAX_LISTED, DrcReport, RuleViolation
from layout.mask import tone
from layout.mask.plan import (
    BLOCK_SITES,
    EXPOSED,
    UNDRAWN,
    MaskPlan,
    PillarArray,
    PillarClass,
)
from layout.process.jit import compile_loop
from layout.process.process import DesignRules
from layout.shapes import rectilinear, region
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MAX_OUTLINES = (
    1500  # distinct outlines of a lattice: the table of pairs grows as their square
)


def check_plan(
    plan: MaskPlan, rules: DesignRules, *, foot_nm: Array | None = None
) -> DrcReport:
    """Check width, space, overlap, grid, density and clearance of a
    mask plan.

    Neighbouring pillars are counted by class pair and lattice vector; each such pair is
    measured once, polygon to polygon. Of a negative tone the pillars that remain are
    checked, and the frame that is written around them.

    Args:
        plan: lattices of pillar classes, and figures.
        rules: limits.
        foot_nm: (classes,) diameter of each class at its foot after the etch; None:
            feet are not checked.

    Returns:
        Report with the smallest width and space of all pillars, also above the limits.

    Raises:
        ProcessError: more than 1500 distinct outlines.

    Accuracy:
        Exact for width, space (Euclidean), overlap and grid; density in windows that
        step by half their size.
    """
    report = DrcReport.empty(plan.unit_nm, rules)
    _check_grid(plan, report)
    if plan.standing is not None:
        _check_negative_frame(plan, report)
        plan = plan.standing
    for lattice in plan.lattices:
        counts = _check_density(plan, lattice, rules, report)
        _LatticeCheck(plan, lattice, rules, counts, report).run(foot_nm)
    _check_figures(plan, report)
    _check_clearance(plan, rules, report)
    return report


# pillars


@dataclass(eq=False)
class _LatticeCheck:
    """Widths and spaces of one lattice. counts: (classes + 1,) sites of each class
    number.
    """

    plan: MaskPlan
    lattice: PillarArray
    rules: DesignRules
    counts: Array
    report: DrcReport

    def run(self, foot_nm: Array | None) -> None:
        """Enter the violations of the lattice and its smallest sizes into the report.

        Pairs of pillars are counted by (lattice vector, outline, outline), and the
        space of each such triple is measured once. Feet of discs follow from their
        diameters; feet of other shapes from the drawn space less half the growth of
        both.

        Args:
            foot_nm: (classes,) diameter of each class at its foot; None: feet are not
                checked.
        """
        used = np.flatnonzero(self.counts[1:]) + 1
        if not len(used):
            return
        outlines, outline_of_class = _distinct_outlines(self.plan.classes, used)
        self._check_widths(outlines, outline_of_class, used)
        drawn_nm = np.zeros(len(outlines) + 1)
        growth_nm = np.full(len(outlines) + 1, -math.inf)
        unit = self.plan.unit_nm
        limit = measured_below = self.rules.minimum_gap_nm / unit
        foot_reach = 0.0
        is_round = all(self.plan.classes[k - 1].round for k in used)
        if foot_nm is not None:
            diameter_nm = np.array([self.plan.classes[k - 1].diameter_nm for k in used])
            growth = foot_nm[used - 1] - diameter_nm
            np.maximum.at(drawn_nm, outline_of_class[used], diameter_nm)
            np.maximum.at(growth_nm, outline_of_class[used], growth)
            widest_nm = growth_nm.max() + self.rules.minimum_foot_gap_nm
            foot_reach = (drawn_nm.max() + widest_nm) / unit
            if not is_round:
                measured_below = max(limit, widest_nm / unit)
        radius = np.array(
            [0.0, *(np.hypot(*outline[0].T).max() for outline in outlines)]
        )
        vectors = lattice_vectors(
            self.lattice, max(2 * radius.max() + measured_below, foot_reach)
        )
        table = np.zeros((len(vectors), len(radius), len(radius)), np.int64)
        for block, first_new_row, _ in self._blocks(vectors):
            count_pairs(block, first_new_row, outline_of_class, vectors, table)
        kinds = np.argwhere(table[:, 1:, 1:]) + np.array([0, 1, 1])
        pairs = table[tuple(kinds.T)]
        steps = vectors[kinds[:, 0]] * (self.lattice.pitch, self.lattice.down)
        spaces = self._measure_pairs(
            kinds[:, 1:], steps, outlines, radius, measured_below
        )
        spaces_nm = spaces * unit
        self.report.measured("space", float(spaces_nm.min(initial=math.inf)))
        is_overlap = spaces <= 0
        for rule, is_broken in (
            ("overlap", is_overlap),
            ("space", ~is_overlap & (spaces < limit - 1e-9)),
        ):
            values_nm = np.full(table.shape, np.nan)
            values_nm[tuple(kinds[is_broken].T)] = spaces_nm[is_broken]
            self.report.add(
                rule,
                int(pairs[is_broken].sum()),
                layer=self.plan.classes[0].layer[0],
                cell=self.lattice.name,
                worst=float(spaces_nm[is_broken].min(initial=math.inf)),
                examples=self._close_pairs(rule, outline_of_class, vectors, values_nm),
            )
        if foot_nm is not None:
            if is_round:
                distance_nm = np.hypot(*steps.T) * unit
                spaces_nm = distance_nm - drawn_nm[kinds[:, 1:]].sum(1) / 2
            foot_spaces_nm = spaces_nm - growth_nm[kinds[:, 1:]].sum(1) / 2
            self._check_feet(foot_spaces_nm, pairs)

    def _check_widths(
        self, outlines: list[tuple[Array, ...]], outline_of_class: Array, used: Array
    ) -> None:
        """Report width and notches of each distinct outline, for all its classes.

        Args:
            outlines: contours of each distinct outline, database units.
            outline_of_class: (classes + 1,) outline number of each class, from 1 on.
            used: class numbers that occur on the lattice.
        """
        for number, contours in enumerate(outlines, 1):
            reach = 4 * float(np.abs(contours[0]).max())
            worst: dict[str, float] = {}
            for measurement in measure_polygon(contours, reach, reach):
                value = measurement.value * self.report.scale(measurement.rule)
                worst[measurement.rule] = min(
                    worst.get(measurement.rule, math.inf), value
                )
            classes = used[outline_of_class[used] == number]
            for rule, value in worst.items():
                self.report.measured(rule, value)
                limit = self.report.limits[rule]
                if value >= limit - 1e-9:
                    continue
                for k in classes.tolist():
                    pillar = self.plan.classes[k - 1]
                    self.report.add_equal(
                        rule,
                        value,
                        (
                            contour_box([pillar.outline + site])
                            for site in self._sites_of(k)
                        ),
                        count=int(self.counts[k]),
                        layer=pillar.layer[0],
                        cell=pillar.name,
                    )

    def _measure_pairs(
        self,
        outlines_of_pair: Array,
        steps: Array,
        outlines: list[tuple[Array, ...]],
        radius: Array,
        limit: float,
    ) -> Array:
        """Euclidean space of each kind of pair, database units, nearest pairs first.

        The space of a pair is at least |step| - radius - radius. Pairs are measured in
        the order of this bound, until it reaches both the limit and the smallest space
        so far.

        Args:
            outlines_of_pair: (n, 2) outline numbers, from 1 on, of each kind of pair.
            steps: (n, 2) displacement of the second pillar, database units.
            outlines: contours of each distinct outline; only the outer one is measured.
            radius: (outlines + 1,) largest distance of a corner from the site.
            limit: spaces below it are all measured.

        Returns:
            (n,) spaces of all pairs below the limit and of the nearest; inf of others.
        """
        least_space = np.hypot(*steps.T) - radius[outlines_of_pair].sum(1)
        order = np.argsort(least_space, kind="stable")
        edges = [contour_edges(outline[:1]) for outline in outlines]
        spaces = np.full(len(steps), math.inf)
        for batch in np.array_split(order, max(1, len(order) // 256)):
            if not len(batch) or least_space[batch[0]] >= max(limit, spaces.min()):
                break
            first, second = outlines_of_pair[batch].T - 1
            spaces[batch], _ = measure_separation(edges, first, second, steps[batch])
        return spaces

    def _close_pairs(
        self, rule: str, outline_of_class: Array, vectors: Array, values_nm: Array
    ) -> Iterator[RuleViolation]:
        """Violations of some kinds of pairs, with a box around both pillars.

        Args:
            rule: name of the rule.
            outline_of_class: (classes + 1,) outline number of each class.
            vectors: (vectors, 2) columns to the right and rows up.
            values_nm: (vectors, outlines + 1, outlines + 1) space of each kind of pair
                that is listed; NaN of others.
        """
        limit = self.rules.minimum_gap_nm
        is_listed = ~np.isnan(values_nm)
        for block, first_new_row, top in self._blocks(vectors):
            for vector in np.flatnonzero(is_listed.any((1, 2))).tolist():
                right, up = vectors[vector].tolist()
                low, left = max(first_new_row, up), max(0, -right)
                below = block[low:, left : block.shape[1] - max(0, right)]
                above = block[low - up : len(block) - up, left + right :]
                above = above[:, : below.shape[1]]
                hits = is_listed[vector][
                    outline_of_class[below], outline_of_class[above]
                ]
                for row, column in np.argwhere(hits)[:MAX_LISTED]:
                    numbers = int(below[row, column]), int(above[row, column])
                    x, y = self.lattice.positions(top + low + row, left + column)
                    shapes = [self.plan.classes[number - 1] for number in numbers]
                    step = right * self.lattice.pitch, up * self.lattice.down
                    moved = [shapes[0].outline + np.array([x, y])]
                    moved.append(shapes[1].outline + np.add((x, y), step))
                    first, second = outline_of_class[list(numbers)].tolist()
                    yield RuleViolation(
                        rule,
                        contour_box(moved),
                        float(values_nm[vector, first, second]),
                        limit,
                        f"{' to '.join(shape.name for shape in shapes)} in "
                        f"{self.lattice.name}",
                    )

    def _check_feet(self, spaces_nm: Array, pairs: Array) -> None:
        """Report the pairs of feet whose space is below the rule.

        Args:
            spaces_nm: (n,) space between the feet for each kind of pair; complete below
                the rule, and with the smallest one.
            pairs: (n,) number of pairs of each kind.
        """
        lattice = self.lattice
        limit = self.rules.minimum_foot_gap_nm
        smallest = float(spaces_nm.min(initial=math.inf))
        count = int(pairs[spaces_nm < limit - 1e-9].sum())
        layer = self.plan.classes[int(np.flatnonzero(self.counts[1:])[0])].layer[0]
        self.report.minimum_foot_space_nm = min(
            self.report.minimum_foot_space_nm, smallest
        )
        ends = np.array([0, lattice.rows]), np.array([0, lattice.columns])
        corners = np.column_stack(lattice.positions(*ends))
        self.report.add_equal(
            "foot",
            smallest,
            [contour_box([corners])],
            count=count,
            layer=layer,
            cell=lattice.name,
            text=f"feet of etched pillars in {lattice.name}",
        )

    def _sites_of(self, class_number: int) -> Iterator[Array]:
        """(2,) x and y of all sites of a class."""
        for top, block in self.lattice.blocks():
            row, column = np.nonzero(block == class_number)
            yield from np.column_stack(self.lattice.positions(top + row, column))

    def _blocks(self, vectors: Array) -> Iterator[tuple[Array, int, int]]:
        """Blocks of rows, each preceded by the last rows of the block before.

        The repeated rows hold the upper partners of pairs that cross the border.

        Args:
            vectors: (m, 2) columns to the right and rows up of the second site of a
                pair.

        Yields:
            (class numbers, number of repeated rows, lattice row of the first row).
        """
        halo = int(vectors[:, 1].max())
        repeated = None
        rows = max(halo, BLOCK_SITES // self.lattice.columns, 1)
        for top, block in self.lattice.blocks(rows):
            extended = block if repeated is None else np.concatenate([repeated, block])
            first_new_row = len(extended) - len(block)
            yield extended, first_new_row, top - first_new_row
            repeated = extended[-halo:].copy()


def _distinct_outlines(
    classes: tuple[PillarClass, ...], used: Array
) -> tuple[list[tuple[Array, ...]], Array]:
    """Distinct contours of the classes, and which of them each class draws.

    Args:
        classes: of the plan.
        used: class numbers, from 1 on, that occur.

    Returns:
        Cleaned contours of each distinct outline, and (classes + 1,) its number, from 1
        on, for each class; 0: not used.

    Raises:
        ProcessError: more than 1500 distinct outlines.
    """
    numbers: dict[bytes, int] = {}
    outlines = []
    outline_of_class = np.zeros(len(classes) + 1, np.int64)
    for k in used.tolist():
        contours = [
            np.ascontiguousarray(contour, np.int64)
            for contour in classes[k - 1].contours
        ]
        key = b"/".join(contour.tobytes() for contour in contours)
        if key not in numbers:
            outlines.append(tuple(clean_contour(contour) for contour in contours))
            numbers[key] = len(outlines)
        outline_of_class[k] = numbers[key]
    if len(outlines) > MAX_OUTLINES:
        raise ProcessError(
            f"{len(outlines)} distinct outlines, at most {MAX_OUTLINES}; raise diameter_step_nm"
        )
    return outlines, outline_of_class


def lattice_vectors(lattice: PillarArray, reach: float) -> Array:
    """Lattice vectors shorter than ``reach``, one of each opposite pair.

    The nearest sites on all sides are always included.

    Args:
        lattice: of the pillars.
        reach: database units.

    Returns:
        (m, 2) columns to the right and rows up.
    """
    nearest = 2 if lattice.centred else 1
    across = max(nearest, int(reach // lattice.pitch))
    up = max(1, int(reach // lattice.down))
    vectors = []
    for j, i in itertools.product(range(up + 1), range(-across, across + 1)):
        is_half = j > 0 or i > 0
        is_nearest = abs(i) <= nearest and j <= 1
        if is_half and (
            is_nearest or math.hypot(i * lattice.pitch, j * lattice.down) < reach
        ):
            vectors.append((i, j))
    return np.array(vectors)


@compile_loop
def count_pairs(
    block: Array, new: int, kind: Array, vectors: Array, table: Array
) -> None:
    """Add to ``table`` (vectors, kinds, kinds) the pairs whose lower site stands in row
    ``new`` or below it.

    Args:
        block: (rows, columns) class numbers.
        new: first row that counts.
        kind: (classes + 1,) outline number of each class, 0 for none.
        vectors: (m, 2) columns to the right and rows up of the second site.
        table: counts.
    """
    rows, columns = block.shape
    for m in range(len(vectors)):
        right, up = vectors[m]
        for row in range(max(new, up), rows):
            for column in range(max(0, -right), min(columns, columns - right)):
                table[
                    m, kind[block[row, column]], kind[block[row - up, column + right]]
                ] += 1


# density


def _check_density(
    plan: MaskPlan, lattice: PillarArray, rules: DesignRules, report: DrcReport
) -> Array:
    """Check the area density in windows of 2 x 2 tiles, which step by one tile.

    Args:
        plan: areas of the classes.
        lattice: whose sites are summed.
        rules: edge of a window and largest density.
        report: receives the windows denser than the rule, and the largest density.

    Returns:
        (classes + 1,) number of sites of each class.
    """
    half_window = rules.density_window_um * 1e3 / plan.unit_nm / 2
    tile_columns, tile_rows = (
        max(1, round(half_window / step)) for step in (lattice.pitch, lattice.down)
    )
    tiles = (
        math.ceil(lattice.rows / tile_rows) + 1,
        math.ceil(lattice.columns / tile_columns) + 1,
    )
    area = np.array([0.0, *(shape.twice_area / 2 for shape in plan.classes)])
    counts = np.zeros(len(area), np.int64)
    covered = np.zeros(tiles)
    for top, block in lattice.blocks():
        add_coverage(block, top, area, (tile_rows, tile_columns), counts, covered)
    report.shapes += int(counts[1:].sum())
    windows = covered[:-1, :-1] + covered[1:, :-1] + covered[:-1, 1:] + covered[1:, 1:]
    width, height = 2 * tile_columns * lattice.pitch, 2 * tile_rows * lattice.down
    density = windows / (float(width) * height)
    worst = float(density.max(initial=0.0))
    report.maximum_density = max(report.maximum_density, worst)
    dense = np.argwhere(density > rules.maximum_density)
    boxes = []
    for row, column in dense[:MAX_LISTED].tolist():
        x = lattice.x0 + column * tile_columns * lattice.pitch
        y = lattice.y0 - row * tile_rows * lattice.down
        boxes.append(((x, y - height, x + width, y), float(density[row, column])))
    limit, cell = rules.maximum_density, lattice.name
    violations = (RuleViolation("density", *each, limit, cell) for each in boxes)
    layer = plan.classes[0].layer[0]
    report.add(
        "density",
        len(dense),
        layer=layer,
        cell=lattice.name,
        worst=worst,
        examples=violations,
    )
    return counts


@compile_loop
def add_coverage(
    block: Array,
    top: int,
    area: Array,
    tile: tuple[int, int],
    counts: Array,
    covered: Array,
) -> None:
    """Add the sites of each class to ``counts``, and their area to ``covered`` in tiles
    of (rows, columns) sites.

    Args:
        block: (rows, columns) class numbers.
        top: number of the first row.
        area: (classes + 1,) area of each class.
        tile: rows and columns of a tile.
        counts: (classes + 1,) sites.
        covered: (tile rows, tile columns) area.
    """
    for row in range(block.shape[0]):
        tile_row = (top + row) // tile[0]
        for column in range(block.shape[1]):
            number = block[row, column]
            counts[number] += 1
            covered[tile_row, column // tile[1]] += area[number]


# figures, grid


def _check_figures(plan: MaskPlan, report: DrcReport) -> None:
    """Width and notch of marks, labels and apertures, merged by layer number."""
    polygons: dict[int, list[Array]] = {}
    for figure in plan.figures:
        if figure.name not in UNDRAWN:
            for layer, drawn in figure.polygons.items():
                polygons.setdefault(layer[0], []).extend(
                    np.asarray(points, np.int64) for points in drawn
                )
    for number, drawn_on_layer in polygons.items():
        _check_merged(drawn_on_layer, {}, number, f"figures of layer {number}", report)


def _check_negative_frame(plan: MaskPlan, report: DrcReport) -> None:
    """Check the frame written around the lattices of a negative tone.

    Clear areas remain as structures: a width of the frame counts as a space, a notch of
    it as a width.
    """
    drawn = [tone.lattice_box(lattice, plan.grid) for lattice in plan.lattices]
    for figure in plan.figures:
        if figure.name == "FRAME":
            drawn += itertools.chain.from_iterable(figure.polygons.values())
    rule_names = {"width": "space", "notch": "width"}
    _check_merged(
        drawn,
        rule_names,
        plan.classes[0].layer[0],
        "frame of the negative tone",
        report,
    )


def _check_merged(
    polygons: list[Array],
    names: dict[str, str],
    layer: int,
    cell: str,
    report: DrcReport,
) -> None:
    """Report widths and notches below the rules of the union of polygons.

    Args:
        polygons: (n, 2) corners each, database units.
        names: rule that a measured "width" or "notch" is reported as, if another.
        layer: number of the layer, for the report.
        cell: what the polygons are, for the report.
        report: receives the violations.
    """
    cleaned = (clean_contour(contour) for contour in region.union_contours(polygons))
    contours = [contour for contour in cleaned if len(contour) > 2]
    if not contours:
        return
    limits_nm = {
        rule: report.limits[names.get(rule, rule)] for rule in ("width", "notch")
    }
    unit = report.unit_nm
    for measurement in measure_polygon(
        contours, limits_nm["width"] / unit, limits_nm["notch"] / unit
    ):
        value = measurement.value * unit
        if value >= limits_nm[measurement.rule] - 1e-9:
            continue
        rule = names.get(measurement.rule, measurement.rule)
        report.measured(rule, value)
        report.add_equal(
            rule, value, [measurement.box], count=1, layer=layer, cell=cell
        )


def _check_grid(plan: MaskPlan, report: DrcReport) -> None:
    """Classes, lattices and figures with coordinates, or steps, off the grid."""
    report.limits["off-grid"] = float(plan.grid)
    drawn: list[tuple[int, str, Sequence[Array], tuple[int, ...]]] = [
        (pillar.layer[0], pillar.name, pillar.polygons, ()) for pillar in plan.classes
    ]
    for one in plan.lattices:
        first_site = np.array([[one.x0, one.y0]])
        layer = plan.classes[0].layer[0]
        drawn.append((layer, one.name, [first_site], (one.pitch, one.down)))
    for figure in plan.figures:
        for number, shapes in figure.polygons.items():
            drawn.append((number[0], figure.name, shapes, ()))
    for layer, cell, polygons, steps in drawn:
        is_off = any(step % plan.grid for step in steps)
        off = [p for p in map(np.asarray, polygons) if is_off or (p % plan.grid).any()]
        boxes = (contour_box([points]) for points in off)
        report.add_equal("off-grid", 0.0, boxes, count=len(off), layer=layer, cell=cell)


def _check_clearance(plan: MaskPlan, rules: DesignRules, report: DrcReport) -> None:
    """Report lattices and figures whose boxes are closer than the minimum space.

    The distance is Euclidean, box to box. Shapes of one figure are not compared with
    each other.
    """
    reach = max(int(np.abs(pillar.outline).max()) for pillar in plan.classes)
    names = [lattice.name for lattice in plan.lattices]
    around = np.array([-reach, -reach, reach, reach])
    boxes = [np.array(lattice.box) + around for lattice in plan.lattices]
    for figure in plan.figures:
        if figure.name in EXPOSED:
            for points in itertools.chain.from_iterable(figure.polygons.values()):
                names.append(figure.name)
                boxes.append(np.array(contour_box([np.asarray(points)])))
    box = np.array(boxes)
    limit = rules.minimum_gap_nm
    for first, second in find_close_boxes(box, limit / plan.unit_nm).tolist():
        distance = rectilinear.box_distance(box[[first]], box[second])[0]
        distance_nm = float(distance) * plan.unit_nm
        if names[first] != names[second] and distance_nm < limit:
            report.add_equal(
                "clearance",
                distance_nm,
                [contour_box([box[[first, second]].reshape(-1, 2)])],
                count=1,
                layer=plan.classes[0].layer[0],
                cell=names[first],
                text=f"{names[first]} to {names[second]}",
            )
