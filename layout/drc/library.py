"""Design-rule check of any mask: hierarchical sweep for width, space, notch and grid."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from layout.drc.geometry import (
    ShapeMeasurement,
    clean_contour,
    contour_box,
    contour_edges,
    find_close_boxes,
    is_convex,
    measure_polygon,
    measure_separation,
)
from layout.drc.lattice import check_plan
from layout.drc.report import MAX_LISTED, DrcReport, LayerCoverage, RuleViolation
from layout.formats.library import UPRIGHT, MaskLibrary, Orientation, group_equal
from layout.formats.reading import read_mask
from layout.mask.plan import MaskPlan
from layout.process.process import DesignRules, LayerNumber
from layout.shapes import region
from layout.shapes.rectilinear import IntBox, box_corners
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

# database units: two corners, each rounded by up to half a unit along x and along y
GRID_TOLERANCE = 2**0.5
Metric = Literal["projection", "euclidean"]
LayerChoice = tuple[int, int | None]  # layer number; datatype, None: all together


def check(mask: MaskPlan | MaskLibrary | str | Path, rules: DesignRules) -> DrcReport:
    """Check the design rules of a mask.

    Args:
        mask: plan of a lens (pairs of classes on its lattices), cells, or a GDSII or
            OASIS file (hierarchical sweep, all layers).
        rules: limits.

    Raises:
        MaskFileError: a file that cannot be read.
        ProcessError: a plan of too many outlines.
    """
    if isinstance(mask, MaskPlan):
        return check_plan(mask, rules)
    library = mask if isinstance(mask, MaskLibrary) else read_mask(Path(mask))
    return check_library(library, rules)


def check_library(
    content: MaskLibrary,
    rules: DesignRules,
    *,
    layers: Collection[LayerChoice] | None = None,
    negative: Collection[int] = (),
    metric: Metric = "projection",
    max_elements: int = 50_000_000,
) -> DrcReport:
    """Check width, space, notch, corners and grid of all shapes below the top cells.

    The datatypes of a layer number are checked together; shapes that touch are merged.
    A cell reference whose bounding box keeps the minimum space from everything around
    it is checked once for all its instances; any other is expanded where it stands.

    Args:
        content: cells of a GDSII or OASIS file.
        rules: limits; minimum feature is the width, minimum gap the space and the
            notch.
        layers: (layer, datatype) to check, each by itself; datatype None: all datatypes
            together. None: all layer numbers of the file.
        negative: layer numbers exposed together whose clear areas remain: their spaces
            are checked as widths.
        metric: of the space between shapes; widths and notches are always measured in
            projection.
        max_elements: shapes and references expanded at once, some 100 bytes of memory
            each.

    Returns:
        Report with the coverage of every layer.

    Raises:
        MaskFileError: no top cell, a reference without its cell, a recursive hierarchy,
            too many elements.

    Accuracy:
        Exact for shapes in whole database units, references at multiples of 90 degrees.
        Shapes rotated otherwise are rounded to database units: their widths are
        measured before rotation, their spaces have ``GRID_TOLERANCE``.
    """
    if not content.tops:
        raise MaskFileError(
            "the mask has no top cell: its cells reference each other in a circle"
        )
    report = DrcReport.empty(content.unit_nm, rules)
    shapes = content.count_shapes()
    if layers is None:
        layers = [(number, None) for number in sorted({number for number, _ in shapes})]
    groups = [
        {
            layer
            for layer in shapes
            if layer[0] == number and datatype in (None, layer[1])
        }
        for number, datatype in layers
    ]
    checked = set().union(*groups)
    report.layers = {
        layer: LayerCoverage(layer in checked, shapes[layer])
        for layer in sorted(shapes)
    }
    clear = {layer for layer in checked if layer[0] in negative}
    for group in groups:
        if group - clear:
            _LayerCheck(content, group - clear, rules, metric, max_elements).run(report)
    if clear:
        limits = replace(
            rules,
            minimum_gap_nm=rules.minimum_feature_nm,
            minimum_feature_nm=rules.minimum_gap_nm,
        )
        names = {"width": "space", "space": "width", "notch": "width"}
        _LayerCheck(content, clear, limits, metric, max_elements, names).run(report)
    return report


@dataclass(frozen=True, eq=False)
class _Element:
    """A distinct polygon, or a distinct cell reference of one orientation.

    cell: that holds the polygon, or is referenced.
    turn: orientation of the reference, None for a polygon.
    contours: of the merged polygon; the bounding box of a reference.
    designed: contours before a rotation that rounds them.
    rounded: whether the corners were rounded.
    """

    cell: str
    turn: Orientation | None
    contours: tuple[Array, ...]
    designed: tuple[Array, ...]
    rounded: bool


@dataclass(frozen=True, eq=False)
class _Placements:
    """(n,) number of the element, and (n, 2) place of each; int32 where that holds
    them.
    """

    element: Array
    xy: Array

    def select(self, members: Array) -> "_Placements":
        """The placements of some indices, or of a mask."""
        return _Placements(self.element[members], self.xy[members])


def _concatenate(parts: Sequence[_Placements]) -> _Placements:
    """Placements of all parts, in their order."""
    element = [np.empty(0, np.int32), *(part.element for part in parts)]
    xy = [np.empty((0, 2), np.int32), *(part.xy for part in parts)]
    return _Placements(np.concatenate(element), np.concatenate(xy))


def _narrowed(xy: Array) -> Array:
    """Places as int32 where that holds them."""
    reach = max(-int(xy.min(initial=0)), int(xy.max(initial=0)))
    return xy.astype(np.int32) if reach < 2**31 else xy


class _LayerCheck:
    """Check of some layer numbers taken as one layer."""

    def __init__(
        self,
        content: MaskLibrary,
        layers: set[LayerNumber],
        rules: DesignRules,
        metric: Metric,
        max_elements: int,
        rule_names: dict[str, str] | None = None,
    ) -> None:
        self.content = content
        self.layers = layers
        self.rules = rules
        self.metric = metric
        self.max_elements = max_elements
        self.rule_names = rule_names or {}
        self.layer = min(layers)[0]
        self.width = rules.minimum_feature_nm / content.unit_nm
        self.space = rules.minimum_gap_nm / content.unit_nm
        self.elements: list[_Element] = []
        self.numbers: dict[tuple[str, object, Orientation], int] = {}
        self.polygons = cache(self._polygons)
        self.references = cache(self._references)
        self.bounding_box = cache(self._bounding_box)
        self.check_cell = cache(self._check_cell)
        self.measure_element = cache(self._measure_element)

    def run(self, report: DrcReport) -> None:
        """Enter the findings of all top cells together into a report."""
        tops = [
            self._reference(name, UPRIGHT)
            for name in self.content.tops
            if self.bounding_box(name) is not None
        ]
        placed = _Placements(
            np.array(tops, np.int32), np.zeros((len(tops), 2), np.int32)
        )
        top_report = self._check_placements(self.content.tops[0], placed)
        report.shapes += top_report.shapes
        for rule in ("width", "space"):
            report.measured(
                self.rule_names.get(rule, rule),
                getattr(top_report, f"minimum_{rule}_nm"),
            )
        self._copy_findings(
            top_report,
            report,
            UPRIGHT,
            np.zeros((1, 2), np.int64),
            names=self.rule_names,
        )
        self._check_grid(report)

    # hierarchy

    def _polygons(self, cell: str) -> list[tuple[Array, Array]]:
        """Distinct polygons of a cell on the checked layers, and where each stands.

        Returns:
            [((corners, 2) polygon with its lowest corner at 0, (n, 2) its places)].
        """
        layers = self.content.cells[cell].polygons.items()
        polygons = [
            polygon
            for layer, drawn in layers
            if layer in self.layers
            for polygon in drawn
        ]
        distinct_polygons = []
        for _, indices in group_equal(
            np.array([len(points) for points in polygons], int)
        ):
            points = np.stack([polygons[n] for n in indices.tolist()]).astype(np.int64)
            places = points.min(1)
            outlines = (points - places[:, None]).reshape(len(points), -1)
            distinct, number_of_polygon = np.unique(
                outlines, axis=0, return_inverse=True
            )
            for number, members in group_equal(number_of_polygon.ravel()):
                distinct_polygons.append(
                    (distinct[number].reshape(-1, 2), places[members])
                )
        return distinct_polygons

    def _references(self, cell: str) -> list[tuple[str, Orientation, Array]]:
        """(referenced cell, orientation, (n, 2) places) of all references that draw on
        the layer.
        """
        return [
            (child, turn, np.array([x, y]).T)
            for child, turn, x, y in self.content.cells[cell].instances()
            if self.bounding_box(child) is not None
        ]

    def _bounding_box(self, cell: str) -> IntBox | None:
        """Box around all that a cell draws on the layer; None for nothing."""
        corners = []
        for outline, places in self.polygons(cell):
            corners += [outline.min(0) + places.min(0), outline.max(0) + places.max(0)]
        for child, turn, places in self.references(cell):
            left, bottom, right, top = _turned_box(self.bounding_box(child), turn)
            low, high = np.array([left, bottom]), np.array([right, top])
            corners += [places.min(0) + low, places.max(0) + high]
        return contour_box([np.array(corners)]) if corners else None

    def _contents(self, cell: str, turn: Orientation) -> _Placements:
        """Polygons and references directly in a cell of some orientation."""
        numbered = []
        for outline, places in self.polygons(cell):
            number = self._polygon(cell, outline, turn)
            if number >= 0:
                numbered.append((number, places))
        numbered += [
            (self._reference(child, turn.after(own)), places)
            for child, own, places in self.references(cell)
        ]
        placed = []
        for number, places in numbered:
            xy = np.column_stack(turn.apply(*places.T.astype(np.int64)))
            numbers = np.full(len(xy), number, np.int32)
            placed.append(_Placements(numbers, _narrowed(xy)))
        return _concatenate(placed)

    def _polygon(self, cell: str, outline: Array, turn: Orientation) -> int:
        """Number of the element of a polygon; -1 where it has no area."""
        key = (cell, outline.tobytes(), turn)
        if key not in self.numbers:
            contours = _merged_contours([np.column_stack(turn.apply(*outline.T))])
            designed = (
                contours
                if turn.quarter or turn.scale != 1
                else _merged_contours([outline])
            )
            element = _Element(cell, None, contours, designed, not turn.quarter)
            self.numbers[key] = self._add_element(element) if contours else -1
        return self.numbers[key]

    def _reference(self, cell: str, turn: Orientation) -> int:
        """Number of the element of a cell reference."""
        key = (cell, None, turn)
        if key not in self.numbers:
            box = box_corners(_turned_box(self.bounding_box(cell), turn))
            self.numbers[key] = self._add_element(
                _Element(cell, turn, (box,), (), False)
            )
        return self.numbers[key]

    def _add_element(self, element: _Element) -> int:
        self.elements.append(element)
        return len(self.elements) - 1

    def _expand(self, placed: _Placements) -> _Placements:
        """Replace references by the elements of their cells, one level down.

        Args:
            placed: references only.

        Raises:
            MaskFileError: more elements than ``max_elements``.
        """
        parts = []
        total = 0
        for number, members in group_equal(placed.element):
            element = self.elements[number]
            contents = self._contents(element.cell, element.turn or UPRIGHT)
            places = placed.xy[members].astype(np.int64)
            total += len(places) * len(contents.element)
            if total > self.max_elements:
                raise MaskFileError(
                    f"instances of cell {element.cell!r} are closer than the minimum "
                    "space to other shapes; expanding them takes more than "
                    f"{self.max_elements:,} elements (metalens check --max-shapes)"
                )
            xy = _narrowed((places[:, None] + contents.xy).reshape(-1, 2))
            parts.append(_Placements(np.tile(contents.element, len(places)), xy))
        return _concatenate(parts)

    # sweep

    def _check_cell(self, cell: str) -> DrcReport:
        """Findings of one instance of a cell, in its own coordinates."""
        return self._check_placements(cell, self._contents(cell, UPRIGHT))

    def _check_placements(self, cell: str, placed: _Placements) -> DrcReport:
        """Report of placed elements of a cell.

        References that are close to anything are expanded, level by level, until only
        polygons are close. A reference that stays isolated counts as its cell, checked
        once.

        Args:
            cell: name of the cell, for the report.
            placed: polygons and references.
        """
        report = DrcReport.empty(self.content.unit_nm, self.rules)
        isolated = []
        while True:
            pairs, distance, _ = self._close_pairs(placed)
            is_close = np.zeros(len(placed.element), bool)
            is_close[pairs[distance < max(self.space, 1.0)]] = True
            turns = [element.turn for element in self.elements]
            is_reference = np.array([turn is not None for turn in turns], bool)[
                placed.element
            ]
            is_scaled = np.array(
                [turn is not None and turn.scale != 1 for turn in turns], bool
            )[placed.element]
            is_expanded = is_reference & (is_close | is_scaled)
            isolated.append(placed.select(~is_close & ~is_expanded))
            if not is_expanded.any():
                break
            placed = _concatenate(
                [
                    placed.select(is_close & ~is_reference),
                    self._expand(placed.select(is_expanded)),
                ]
            )
        self._check_isolated(_concatenate(isolated), report)
        self._check_close(cell, placed.select(is_close), report)
        return report

    def _close_pairs(self, placed: _Placements) -> tuple[Array, Array, Array]:
        """Pairs of placed elements whose boxes are closer than the minimum space.

        Equal pairs (elements and offset) are measured once.

        Returns:
            (n, 2) indices of placements, (n,) Euclidean distances and (n,) distances in
            the projection metric, database units.
        """
        occurs = np.bincount(placed.element, minlength=len(self.elements)) > 0
        elements = [self.elements[number] for number in np.flatnonzero(occurs)]
        element = (np.cumsum(occurs, dtype=np.int32) - 1)[placed.element]
        corners = [contour_box(each.contours) for each in elements]
        boxes = np.array(corners, float).reshape(-1, 4)
        distance = max(self.space, 1.0)
        pairs = find_close_boxes(boxes, distance, which=element, shift=placed.xy)
        first, second = element[pairs].T
        offset = placed.xy[pairs[:, 1]].astype(np.int64) - placed.xy[pairs[:, 0]]
        _, example, which = _distinct_rows(np.column_stack([first, second, offset]))
        edges = [contour_edges(element.contours) for element in elements]
        euclidean, projected = measure_separation(
            edges, first[example], second[example], offset[example]
        )
        return pairs, euclidean[which], projected[which]

    def _check_isolated(self, placed: _Placements, report: DrcReport) -> None:
        """Widths and notches of isolated polygons, and the findings of isolated
        references.
        """
        for number, members in group_equal(placed.element):
            element = self.elements[number]
            places = placed.xy[members]
            if element.turn is None:
                report.shapes += len(members)
                self._check_polygon(number, places, report)
                continue
            cell_report = self.check_cell(element.cell)
            report.shapes += cell_report.shapes * len(members)
            report.measured("width", cell_report.minimum_width_nm)
            report.measured("space", cell_report.minimum_space_nm)
            self._copy_findings(cell_report, report, element.turn, places)

    def _copy_findings(
        self,
        cell_report: DrcReport,
        report: DrcReport,
        turn: Orientation,
        places: Array,
        names: dict[str, str] | None = None,
    ) -> None:
        """Count the violations of a cell for all its instances, and list some of them.

        Args:
            cell_report: of one instance.
            report: receives the violations.
            turn: orientation of the instances.
            places: (n, 2) places of the instances.
            names: {rule: name under which it is reported}; None: no rule is renamed.
        """
        names = names or {}
        for (rule, layer, cell), tally in cell_report.tallies.items():
            rule = names.get(rule, rule)
            report.add(
                rule,
                tally.count * len(places),
                layer=layer,
                cell=cell,
                worst=tally.worst,
            )
        copies = f"; in each of {len(places):,} instances" if len(places) > 1 else ""
        violations_of_rule: dict[str, list[RuleViolation]] = {}
        for violation in cell_report.violations:
            violations_of_rule.setdefault(
                names.get(violation.rule, violation.rule), []
            ).append(violation)
        for rule, violations in violations_of_rule.items():
            report.list_violations(
                rule, _instance_violations(rule, violations, turn, places, copies)
            )

    def _measure_element(self, number: int) -> list[ShapeMeasurement]:
        """Widths and notches of an element, each element once."""
        return measure_polygon(self.elements[number].designed, self.width, self.space)

    def _check_polygon(self, number: int, places: Array, report: DrcReport) -> None:
        """Report widths, notches and corners of one polygon, at each of its places.

        Where only corners rounded after a rotation are known, values within
        ``GRID_TOLERANCE`` of the limit pass.

        Args:
            number: of the element.
            places: (n, 2) places.
            report: receives the violations.
        """
        element = self.elements[number]
        unit = self.content.unit_nm
        tolerance = (
            GRID_TOLERANCE * unit
            if element.rounded and element.designed is element.contours
            else 0.0
        )
        for measurement in self.measure_element(number):
            limit = report.limits[measurement.rule]
            value = measurement.value * report.scale(measurement.rule)
            if measurement.rule == "width" or value < limit - tolerance - 1e-9:
                report.measured(measurement.rule, value)
            if value >= limit - tolerance - 1e-9:
                continue
            box = np.array(
                contour_box(element.contours) if element.rounded else measurement.box
            )
            boxes = (
                tuple((box + np.array([x, y, x, y])).tolist())
                for x, y in places.tolist()
            )
            report.add_equal(
                measurement.rule,
                value,
                boxes,
                count=len(places),
                layer=self.layer,
                cell=element.cell,
            )

    def _check_close(self, cell: str, placed: _Placements, report: DrcReport) -> None:
        """Check elements close to others: merge those that touch, then measure.

        Reported are widths and notches of each merged polygon, and the space of each
        close pair in the metric of the check.
        """
        report.shapes += len(placed.element)
        pairs, distance, projected = self._close_pairs(placed)
        if (distance == 0).any():
            placed = self._merge_touching(cell, placed, pairs[distance == 0])
            pairs, distance, projected = self._close_pairs(placed)
        for number, members in group_equal(placed.element):
            self._check_polygon(number, placed.xy[members], report)
        unit = self.content.unit_nm
        limit = report.limits["space"]
        is_rounded = np.array([element.rounded for element in self.elements], bool)[
            placed.element
        ]
        tolerance = GRID_TOLERANCE * unit * is_rounded[pairs].any(1)
        value = unit * (distance if self.metric == "euclidean" else projected)
        violating = (value < limit - tolerance - 1e-9) & (distance > 0)
        worst = float(value[violating].min(initial=np.inf))
        report.measured("space", worst)
        violations = self._space_violations(
            placed, pairs[violating], value[violating], limit
        )
        report.add(
            "space",
            int(violating.sum()),
            layer=self.layer,
            cell=cell,
            worst=worst,
            examples=violations,
        )

    def _space_violations(
        self, placed: _Placements, pairs: Array, values: Array, limit: float
    ) -> Iterator[RuleViolation]:
        """Boxes around pairs of polygons."""
        for pair, value in zip(pairs, values.tolist(), strict=True):
            elements = [
                self.elements[number] for number in placed.element[pair].tolist()
            ]
            moved = [
                element.contours[0] + xy
                for element, xy in zip(elements, placed.xy[pair], strict=True)
            ]
            text = f"{elements[0].cell} to {elements[1].cell}, layer {self.layer}"
            yield RuleViolation("space", contour_box(moved), value, limit, text)

    def _merge_touching(
        self, cell: str, placed: _Placements, pairs: Array
    ) -> _Placements:
        """Replace each group of connected polygons by their union.

        Args:
            cell: name of the cell, for the report.
            placed: polygons.
            pairs: (n, 2) placements that touch or overlap.

        Returns:
            Polygons that touch nothing, and the unions.
        """
        count = len(placed.element)
        graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), (count, count))
        component = connected_components(graph, directed=False)[1]
        is_single = np.bincount(component)[component] == 1
        order = np.argsort(component, kind="stable")
        order = order[~is_single[order]]
        numbers = []
        for members in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
            elements = [
                self.elements[number] for number in placed.element[members].tolist()
            ]
            moved = [
                c + xy
                for e, xy in zip(elements, placed.xy[members], strict=True)
                for c in e.contours
            ]
            contours = _merged_contours(moved)
            rounded = any(element.rounded for element in elements)
            numbers.append(
                self._add_element(_Element(cell, None, contours, contours, rounded))
            )
        union = _Placements(
            np.array(numbers, np.int32), np.zeros((len(numbers), 2), np.int32)
        )
        return _concatenate([placed.select(is_single), union])

    # grid

    def _check_grid(self, report: DrcReport) -> None:
        """Polygons with corners off the grid, counted for each cell by the positions of
        its instances on the grid.
        """
        step = self.rules.grid_nm / self.content.unit_nm
        if step == 1:
            return
        instances: dict[str, dict[tuple[Orientation, float, float], list[int]]] = {
            name: {} for name in self.content.cells
        }
        for name in self.content.tops:
            instances[name][UPRIGHT, 0.0, 0.0] = [1, 0, 0]
        for name in self.content.topological_order():
            for (turn, *phase), (times, x, y) in instances[name].items():
                for child, child_turn, places in self.references(name):
                    xy = np.column_stack(turn.apply(*places.T.astype(np.int64)))
                    phases = np.round(np.mod(xy + phase, step), 6) % step
                    distinct, example, which = _distinct_rows(phases)
                    for row, first, count in zip(
                        distinct, xy[example], np.bincount(which), strict=True
                    ):
                        key = (turn.after(child_turn), *row.tolist())
                        entry = instances[child].setdefault(
                            key, [0, x + int(first[0]), y + int(first[1])]
                        )
                        entry[0] += times * int(count)
                for outline, places in self.polygons(name):
                    corners = np.column_stack(turn.apply(*outline.T)) + phase
                    xy = np.column_stack(turn.apply(*places.T.astype(np.int64)))
                    residue = np.mod(xy[:, None] + corners, step)
                    is_off = (np.minimum(residue, step - residue) > 1e-6).any((1, 2))
                    box = np.array(
                        contour_box(
                            [np.column_stack(turn.apply(*outline.T)).astype(np.int64)]
                        )
                    )
                    boxes = (
                        tuple((box + (u + x, v + y) * 2).tolist())
                        for u, v in xy[is_off].tolist()
                    )
                    report.add_equal(
                        "off-grid",
                        0.0,
                        boxes,
                        count=times * int(is_off.sum()),
                        layer=self.layer,
                        cell=name,
                    )


def _merged_contours(polygons: Sequence[Array]) -> tuple[Array, ...]:
    """Cleaned contours of the union: outer ones counter-clockwise, holes clockwise."""
    if len(polygons) == 1:
        points = clean_contour(polygons[0])
        for one in (points, points[::-1]):
            if len(one) > 2 and is_convex(one):
                return (one,)
    cleaned = (clean_contour(contour) for contour in region.union_contours(polygons))
    return tuple(contour for contour in cleaned if len(contour) > 2)


def _instance_violations(
    rule: str,
    violations: list[RuleViolation],
    turn: Orientation,
    places: Array,
    text: str,
) -> Iterator[RuleViolation]:
    """Violations of a cell where its instances draw them."""
    for (x, y), violation in product(places[:MAX_LISTED].tolist(), violations):
        left, bottom, right, top = _turned_box(violation.box, turn)
        box = (left + x, bottom + y, right + x, top + y)
        yield replace(violation, rule=rule, box=box, text=violation.text + text)


def _turned_box(box: IntBox | None, turn: Orientation) -> IntBox:
    """Box around the box of a cell that draws, in some orientation."""
    if box is None:
        raise ValueError("a cell that draws nothing has no box")
    corners = box_corners(box)
    return contour_box([np.column_stack(turn.apply(*corners.T))])


def _distinct_rows(rows: Array) -> tuple[Array, Array, Array]:
    """Distinct rows of an array.

    Returns:
        (k, columns) distinct rows, (k,) an index of each, and (n,) which of them each
        row equals.
    """
    number_of_row = np.zeros(len(rows), np.int64)
    for column in rows.T:
        values, rank = np.unique(column, return_inverse=True)
        number_of_row = np.unique(
            number_of_row * len(values) + rank, return_inverse=True
        )[1]
    _, example = np.unique(number_of_row, return_index=True)
    return rows[example], example, number_of_row
