"""Design-rule check of a lens's own mask: exact, by classes of neighbouring pillars on
its lattices.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
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
from layout.drc.report import MAX_LISTED, DrcReport, Violation
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
from layout.process.process import DesignRules, KeepOutZone
from layout.shapes import region
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MAX_OUTLINES = (
    1500  # distinct outlines of a lattice: the table of pairs grows as their square
)


def check_plan(
    plan: MaskPlan, rules: DesignRules, *, foot_nm: Array | None = None
) -> DrcReport:
    """Check width, space, overlap, grid, density, exclusion zones and clearance of a
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
        _check_negative_frame(plan, rules, report)
        plan = plan.standing
    for lattice in plan.lattices:
        counts = _check_density(plan, lattice, rules, report)
        _LatticeCheck(plan, lattice, rules, counts, report).run(foot_nm)
    _check_figures(plan, rules, report)
    for zone, lattice in itertools.product(rules.exclusion, plan.lattices):
        _check_zone(plan, lattice, zone, report)
    _check_clearance(plan, rules, report)
    return report


# pillars


@dataclass(eq=False, slots=True)
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
        """Report the violations of the lattice and its smallest sizes."""
        used = np.flatnonzero(self.counts[1:]) + 1
        if not len(used):
            return
        outlines, kind = _distinct_outlines(self.plan.classes, used)
        self._check_widths(outlines, kind, used)
        foot, growth = np.zeros((2, len(outlines) + 1))
        limit = self.rules.minimum_gap_nm / self.plan.unit_nm
        measured = limit
        if foot_nm is not None:
            drawn = np.array([self.plan.classes[k - 1].diameter_nm for k in used])
            np.maximum.at(foot, kind[used], foot_nm[used - 1])
            np.maximum.at(growth, kind[used], foot_nm[used - 1] - drawn)
            if not all(self.plan.classes[k - 1].round for k in used):
                widest = self.rules.minimum_foot_gap_nm + growth.max()
                measured = max(limit, widest / self.plan.unit_nm)
        radius = np.array(
            [0.0, *(np.hypot(*outline[0].T).max() for outline in outlines)]
        )
        foot_reach = (foot.max() + self.rules.minimum_foot_gap_nm) / self.plan.unit_nm
        vectors = lattice_vectors(
            self.lattice, max(2 * radius.max() + measured, foot_reach)
        )
        table = np.zeros((len(vectors), len(radius), len(radius)), np.int64)
        for block, new, _ in self._blocks(vectors):
            count_pairs(block, new, kind, vectors, table)
        steps = vectors * (self.lattice.pitch, self.lattice.down)
        spaces = self._measure_pairs(table, steps, outlines, radius, measured)
        nearest = min(spaces.values(), default=math.inf)
        self.report.measured("space", nearest * self.plan.unit_nm)
        close = {key: space for key, space in spaces.items() if space < limit - 1e-9}
        if close:
            self._report_pairs(kind, vectors, table, close)
        if foot_nm is not None:
            if all(self.plan.classes[k - 1].round for k in used):
                self._check_feet(*self._foot_spaces(table, steps, foot))
            else:
                pairs = np.array(list(spaces), np.int64).reshape(-1, 3)
                _, first, second = pairs.T
                drawn_nm = np.array(list(spaces.values())) * self.plan.unit_nm
                self._check_feet(
                    drawn_nm - (growth[first] + growth[second]) / 2,
                    table[tuple(pairs.T)],
                )

    def _check_widths(
        self, outlines: list[tuple[Array, ...]], kind: Array, used: Array
    ) -> None:
        """Width and notches of each class."""
        for number, contours in enumerate(outlines, 1):
            reach = 4 * float(np.abs(contours[0]).max())
            worst: dict[str, float] = {}
            for found in measure_polygon(contours, reach, reach):
                value = found.value * self.report.scale(found.rule)
                worst[found.rule] = min(worst.get(found.rule, math.inf), value)
            classes = used[kind[used] == number]
            for rule, value in worst.items():
                self.report.measured(rule, value)
                limit = self.report.limits[rule]
                if value >= limit - 1e-9:
                    continue
                for k in classes.tolist():
                    shape = self.plan.classes[k - 1]
                    boxes = (
                        _moved_box(shape.outline, x, y) for x, y in self._sites_of(k)
                    )
                    shown = (
                        Violation(rule, box, value, limit, shape.name) for box in boxes
                    )
                    count = int(self.counts[k])
                    self.report.add(
                        rule,
                        count,
                        layer=shape.layer[0],
                        cell=shape.name,
                        worst=value,
                        examples=shown,
                    )

    def _measure_pairs(
        self,
        table: Array,
        steps: Array,
        outlines: list[tuple[Array, ...]],
        radius: Array,
        limit: float,
    ) -> dict[tuple[int, int, int], float]:
        """{(vector, outline, outline): space}, database units, of all pairs below the
        limit and of the nearest.

        Pairs are measured in the order of the least space their radii allow, until none
        can be nearer.
        """
        vector, first, second = np.nonzero(table)
        filled = (first > 0) & (second > 0)
        vector = vector[filled]
        first = first[filled]
        second = second[filled]
        bound = np.hypot(*steps[vector].T) - radius[first] - radius[second]
        order = np.argsort(bound, kind="stable")
        edges = [contour_edges(outline[:1]) for outline in outlines]
        spaces: dict[tuple[int, int, int], float] = {}
        nearest = math.inf
        for batch in np.array_split(order, max(1, len(order) // 256)):
            if not len(batch) or bound[batch[0]] >= max(limit, nearest):
                break
            found, _ = measure_separation(
                edges, first[batch] - 1, second[batch] - 1, steps[vector[batch]]
            )
            nearest = min(nearest, float(found.min()))
            keys = zip(
                vector[batch].tolist(),
                first[batch].tolist(),
                second[batch].tolist(),
                strict=True,
            )
            spaces |= dict(zip(keys, found.tolist(), strict=True))
        return spaces

    def _report_pairs(
        self,
        kind: Array,
        vectors: Array,
        table: Array,
        close: dict[tuple[int, int, int], float],
    ) -> None:
        """Count the pairs below the limit, and list the first."""
        layer = self.plan.classes[0].layer[0]
        unit = self.plan.unit_nm
        for rule in ("overlap", "space"):
            keys = {
                key: space * unit
                for key, space in close.items()
                if (space <= 0) == (rule == "overlap")
            }
            if not keys:
                continue
            marked = np.zeros(table.shape, bool)
            marked[tuple(np.array(list(keys)).T)] = True
            shown = self._close_pairs(rule, kind, vectors, marked, keys)
            count, worst = int(table[marked].sum()), min(keys.values())
            self.report.add(
                rule,
                count,
                layer=layer,
                cell=self.lattice.name,
                worst=worst,
                examples=shown,
            )

    def _close_pairs(
        self,
        rule: str,
        kind: Array,
        vectors: Array,
        marked: Array,
        values: dict[tuple[int, int, int], float],
    ) -> Iterator[Violation]:
        """Violations of marked pairs (vector, outline, outline), with a box around both
        pillars.
        """
        limit = self.rules.minimum_gap_nm
        for block, new, top in self._blocks(vectors):
            found = np.empty((MAX_LISTED, 3), np.int64)
            count = locate_pairs(block, new, kind, vectors, marked, found)
            for row, column, vector in found[:count].tolist():
                right, up = vectors[vector].tolist()
                one = int(block[row, column])
                two = int(block[row - up, column + right])
                shapes = self.plan.classes[one - 1], self.plan.classes[two - 1]
                places = (
                    self._place(top + row, column),
                    self._place(top + row - up, column + right),
                )
                both = [
                    shape.outline + place
                    for shape, place in zip(shapes, places, strict=True)
                ]
                text = f"{shapes[0].name} to {shapes[1].name} in {self.lattice.name}"
                value = values[vector, int(kind[one]), int(kind[two])]
                yield Violation(rule, contour_box(both), value, limit, text)

    def _foot_spaces(
        self, table: Array, steps: Array, foot: Array
    ) -> tuple[Array, Array]:
        """Spaces between the feet of discs for each kind of pair, nm, and the number of
        such pairs.
        """
        vector, first, second = np.nonzero(table)
        filled = (first > 0) & (second > 0)
        vector = vector[filled]
        first = first[filled]
        second = second[filled]
        away = np.hypot(*steps[vector].T) * self.plan.unit_nm
        return away - (foot[first] + foot[second]) / 2, table[vector, first, second]

    def _check_feet(self, spaces_nm: Array, pairs: Array) -> None:
        """Enter the pairs of feet that are nearer than the rule.

        Args:
            spaces_nm: (n,) between feet, of all pairs that can be too near, and of the
                nearest: of discs by their diameters, of other shapes between the drawn
                polygons less what both walls lean out.
            pairs: (n,) how many there are of each.
        """
        lattice, limit = self.lattice, self.rules.minimum_foot_gap_nm
        least = float(spaces_nm.min(initial=math.inf))
        count = int(pairs[spaces_nm < limit - 1e-9].sum())
        layer = self.plan.classes[int(np.flatnonzero(self.counts[1:])[0])].layer[0]
        self.report.minimum_foot_space_nm = min(
            self.report.minimum_foot_space_nm, least
        )
        corners = np.array(
            [self._place(0, 0), self._place(lattice.rows, lattice.columns)]
        )
        shown = Violation(
            "foot",
            contour_box([corners]),
            least,
            limit,
            f"feet of etched pillars in {lattice.name}",
        )
        self.report.add(
            "foot", count, layer=layer, cell=lattice.name, worst=least, examples=[shown]
        )

    def _sites_of(self, class_number: int) -> Iterator[tuple[int, int]]:
        """(x, y) of all sites of a class."""
        for top, block in self.lattice.blocks():
            for row, column in np.argwhere(block == class_number).tolist():
                yield self._place(top + row, column)

    def _place(self, row: int, column: int) -> tuple[int, int]:
        return (
            self.lattice.x0 + column * self.lattice.pitch,
            self.lattice.y0 - row * self.lattice.down,
        )

    def _blocks(self, vectors: Array) -> Iterator[tuple[Array, int, int]]:
        """(class numbers, rows repeated from the block before, number of the first
        row).
        """
        above = int(vectors[:, 1].max())
        repeated = None
        rows = max(above, BLOCK_SITES // self.lattice.columns, 1)
        for top, block in self.lattice.blocks(rows):
            whole = block if repeated is None else np.concatenate([repeated, block])
            new = len(whole) - len(block)
            yield whole, new, top - new
            repeated = whole[-above:].copy()


def _distinct_outlines(
    classes: tuple[PillarClass, ...], used: Array
) -> tuple[list[tuple[Array, ...]], Array]:
    """Distinct contours, and (classes + 1,) number of each class among them from 1 on,
    0 for unused ones.
    """
    numbers: dict[bytes, int] = {}
    outlines = []
    kind = np.zeros(len(classes) + 1, np.int64)
    for k in used.tolist():
        contours = [
            np.ascontiguousarray(contour, np.int64)
            for contour in classes[k - 1].contours
        ]
        key = b"/".join(contour.tobytes() for contour in contours)
        if key not in numbers:
            outlines.append(tuple(clean_contour(contour) for contour in contours))
            numbers[key] = len(outlines)
        kind[k] = numbers[key]
    if len(outlines) > MAX_OUTLINES:
        raise ProcessError(
            f"{len(outlines)} distinct outlines, at most {MAX_OUTLINES}; raise diameter_step_nm"
        )
    return outlines, kind


def lattice_vectors(lattice: PillarArray, reach: float) -> Array:
    """(m, 2) columns to the right and rows up to all sites nearer than ``reach``, one
    of each opposite pair.

    The nearest sites on all sides are always among them.

    Args:
        lattice: of the pillars.
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


@compile_loop
def locate_pairs(
    block: Array, new: int, kind: Array, vectors: Array, marked: Array, found: Array
) -> int:
    """Fill ``found`` (n, 3) with row, column, vector of marked pairs; arguments as in
    :func:`count_pairs`.

    Args:
        block: (rows, columns) class numbers.
        new: first row that counts.
        kind: (classes + 1,) outline number of each class.
        vectors: (m, 2) columns to the right and rows up.
    """
    rows, columns = block.shape
    count = 0
    for m in range(len(vectors)):
        right, up = vectors[m]
        for row in range(max(new, up), rows):
            for column in range(max(0, -right), min(columns, columns - right)):
                if marked[
                    m, kind[block[row, column]], kind[block[row - up, column + right]]
                ]:
                    if count == len(found):
                        return count
                    found[count] = row, column, m
                    count += 1
    return count


# density


def _check_density(
    plan: MaskPlan, lattice: PillarArray, rules: DesignRules, report: DrcReport
) -> Array:
    """Sites of each class number; windows denser than the rule are entered into the
    report.
    """
    half = rules.density_window_um * 1e3 / plan.unit_nm / 2
    across, down = (
        max(1, round(half / step)) for step in (lattice.pitch, lattice.down)
    )
    tiles = math.ceil(lattice.rows / down) + 1, math.ceil(lattice.columns / across) + 1
    area = np.array([0.0, *(shape.twice_area / 2 for shape in plan.classes)])
    counts, covered = np.zeros(len(area), np.int64), np.zeros(tiles)
    for top, block in lattice.blocks():
        add_coverage(block, top, area, (down, across), counts, covered)
    report.shapes += int(counts[1:].sum())
    windows = covered[:-1, :-1] + covered[1:, :-1] + covered[:-1, 1:] + covered[1:, 1:]
    width, height = 2 * across * lattice.pitch, 2 * down * lattice.down
    density = windows / (float(width) * height)
    worst = float(density.max(initial=0.0))
    report.maximum_density = max(report.maximum_density, worst)
    dense = np.argwhere(density > rules.maximum_density)
    shown = []
    for row, column in dense[:MAX_LISTED].tolist():
        x = lattice.x0 + column * across * lattice.pitch
        y = lattice.y0 - row * down * lattice.down
        box = (x, y - height, x + width, y)
        shown.append(
            Violation(
                "density",
                box,
                float(density[row, column]),
                rules.maximum_density,
                lattice.name,
            )
        )
    layer = plan.classes[0].layer[0]
    report.add(
        "density",
        len(dense),
        layer=layer,
        cell=lattice.name,
        worst=worst,
        examples=shown,
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


# figures, grid, zones


def _check_figures(plan: MaskPlan, rules: DesignRules, report: DrcReport) -> None:
    """Width and notch of marks, labels and apertures, merged by layer number."""
    polygons: dict[int, list[Array]] = {}
    for figure in plan.figures:
        if figure.name not in UNDRAWN:
            for layer, drawn in figure.polygons.items():
                polygons.setdefault(layer[0], []).extend(
                    np.asarray(points, np.int64) for points in drawn
                )
    for number, merged in polygons.items():
        _check_merged(merged, rules, {}, number, f"figures of layer {number}", report)


def _check_negative_frame(
    plan: MaskPlan, rules: DesignRules, report: DrcReport
) -> None:
    """Frame written around the lattices of a negative tone: its width is a space, its
    notches are widths.
    """
    drawn = [tone.lattice_box(lattice, plan.grid) for lattice in plan.lattices]
    aperture = {
        layer
        for figure in plan.figures
        if figure.name == "APERTURE"
        for layer in figure.polygons
    }
    for figure in plan.figures:
        if figure.name not in (*UNDRAWN, "CLEAR"):
            for layer, polygons in figure.polygons.items():
                drawn += polygons if layer not in aperture else ()
    names = {"width": "space", "notch": "width"}
    _check_merged(
        drawn,
        rules,
        names,
        plan.classes[0].layer[0],
        "frame of the negative tone",
        report,
    )


def _check_merged(
    polygons: list[Array],
    rules: DesignRules,
    names: dict[str, str],
    layer: int,
    text: str,
    report: DrcReport,
) -> None:
    """Widths and notches of the union of polygons; ``names`` renames the rules."""
    cleaned = (clean_contour(contour) for contour in region.union_contours(polygons))
    contours = [contour for contour in cleaned if len(contour) > 2]
    if not contours:
        return
    limit = {rule: report.limits[names.get(rule, rule)] for rule in ("width", "notch")}
    unit = report.unit_nm
    for found in measure_polygon(
        contours, limit["width"] / unit, limit["notch"] / unit
    ):
        value = found.value * unit
        if value >= limit[found.rule] - 1e-9:
            continue
        rule = names.get(found.rule, found.rule)
        shown = Violation(rule, found.box, value, limit[found.rule], text)
        report.measured(rule, value)
        report.add(rule, 1, layer=layer, cell=text, worst=value, examples=[shown])


def _check_grid(plan: MaskPlan, report: DrcReport) -> None:
    """Classes, lattices and figures with coordinates off the grid."""
    grid = plan.grid
    layer = plan.classes[0].layer[0] if plan.classes else -1
    for shape in plan.classes:
        off = _off_grid(shape.polygons, grid)
        _report_off_grid(off, grid, shape.layer[0], shape.name, report)
    for lattice in plan.lattices:
        first = np.array([[lattice.x0, lattice.y0]])
        steps = np.array([[lattice.pitch, lattice.down]])
        is_off = bool(_off_grid([first, steps], grid))
        _report_off_grid([first] if is_off else [], grid, layer, lattice.name, report)
    for figure in plan.figures:
        for number, polygons in figure.polygons.items():
            off = _off_grid(polygons, grid)
            _report_off_grid(off, grid, number[0], figure.name, report)


def _off_grid(polygons: Iterable[Array], grid: int) -> list[Array]:
    """Polygons with a coordinate off the grid."""
    return [p for p in map(np.asarray, polygons) if (p % grid).any()]


def _report_off_grid(
    polygons: list[Array], grid: int, layer: int, cell: str, report: DrcReport
) -> None:
    boxes = (contour_box([points]) for points in polygons)
    shown = (Violation("off-grid", box, 0.0, float(grid), cell) for box in boxes)
    report.add(
        "off-grid", len(polygons), layer=layer, cell=cell, worst=0.0, examples=shown
    )


def _check_zone(
    plan: MaskPlan, lattice: PillarArray, zone: KeepOutZone, report: DrcReport
) -> None:
    """Pillars that share area with an exclusion zone."""
    scale = 1e3 / plan.unit_nm
    left, bottom = zone.x_um * scale, zone.y_um * scale
    right = left + zone.width_um * scale
    top = bottom + zone.height_um * scale
    box = left, bottom, right, top
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    for number, places in _sites_near(plan, lattice, box):
        shape = plan.classes[number - 1]
        low = shape.outline.min(0) + places
        high = shape.outline.max(0) + places
        meets = ((low < box[2:]) & (high > box[:2])).all(1)
        inside = ((low >= box[:2]) & (high <= box[2:])).all(1)
        for n in np.flatnonzero(meets & ~inside).tolist():
            moved = [contour + places[n] for contour in shape.contours]
            meets[n] = region.overlap_area(moved, [corners]) > 1e-9
        hit = places[meets]
        text = f"{shape.name} in {zone.name}"
        boxes = (_moved_box(shape.outline, x, y) for x, y in hit.tolist())
        shown = (Violation("exclusion", found, 0.0, 0.0, text) for found in boxes)
        report.add(
            "exclusion",
            len(hit),
            layer=shape.layer[0],
            cell=shape.name,
            worst=0.0,
            examples=shown,
        )


def _sites_near(
    plan: MaskPlan, lattice: PillarArray, box: tuple[float, float, float, float]
) -> Iterator[tuple[int, Array]]:
    """(class number, (n, 2) places) of the pillars that can reach into a box."""
    reach = max(int(np.abs(shape.outline).max()) for shape in plan.classes)
    left = max(0, math.floor((box[0] - reach - lattice.x0) / lattice.pitch))
    right = min(
        lattice.columns, math.ceil((box[2] + reach - lattice.x0) / lattice.pitch) + 1
    )
    top = max(0, math.floor((lattice.y0 - box[3] - reach) / lattice.down))
    bottom = min(
        lattice.rows, math.ceil((lattice.y0 - box[1] + reach) / lattice.down) + 1
    )
    if left >= right or top >= bottom:
        return
    block = lattice.source(top, bottom)[:, left:right]
    for number in np.unique(block[block > 0]).tolist():
        row, column = np.nonzero(block == number)
        x = lattice.x0 + (column + left) * lattice.pitch
        y = lattice.y0 - (row + top) * lattice.down
        yield number, np.column_stack([x, y])


def _check_clearance(plan: MaskPlan, rules: DesignRules, report: DrcReport) -> None:
    """Lattices, marks, labels and verniers keep the minimum space from each other, box
    to box.
    """
    outlines = (int(np.abs(shape.outline).max()) for shape in plan.classes)
    reach = max(outlines, default=0)
    names, boxes = [], []
    for lattice in plan.lattices:
        right = (lattice.columns - 1) * lattice.pitch
        down = (lattice.rows - 1) * lattice.down
        names.append(lattice.name)
        boxes.append(
            (
                lattice.x0 - reach,
                lattice.y0 - down - reach,
                lattice.x0 + right + reach,
                lattice.y0 + reach,
            )
        )
    for figure in plan.figures:
        if figure.name in EXPOSED:
            for points in itertools.chain.from_iterable(figure.polygons.values()):
                names.append(figure.name)
                boxes.append(contour_box([np.asarray(points)]))
    box = np.array(boxes).reshape(-1, 4)
    layer = plan.classes[0].layer[0] if plan.classes else -1
    limit = rules.minimum_gap_nm
    for one, two in find_close_boxes(box, limit / plan.unit_nm).tolist():
        across = np.maximum(
            np.maximum(box[one, :2] - box[two, 2:], box[two, :2] - box[one, 2:]), 0
        )
        value = float(np.hypot(*across)) * plan.unit_nm
        if names[one] != names[two] and value < limit:
            around = contour_box([box[[one, two]].reshape(-1, 2)])
            shown = Violation(
                "clearance", around, value, limit, f"{names[one]} to {names[two]}"
            )
            report.add(
                "clearance",
                1,
                layer=layer,
                cell=names[one],
                worst=value,
                examples=[shown],
            )


def _moved_box(outline: Array, x: int, y: int) -> tuple[int, int, int, int]:
    return contour_box([outline + np.array([x, y])])
