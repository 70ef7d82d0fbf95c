"""Rules on a mask made anywhere: pillars at any place and turn, shapes of any outline, checked layer by layer.

Shapes that touch are one shape, as a writer exposes them. Convex ones that stand alone are measured polygon to
polygon, those that can be near each other found through a tree of their places; all others edge against edge.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from layout.files import MaskContent, flat
from layout.process import Rules
from layout.rules import edges as facing
from layout.rules.report import DrcReport, Violation
from layout.shapes import convex, region
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

MOST_SHAPES = 4_000_000  # that are checked or shown at once in less than 1 GB, however small the file
_EACH_BYTE = 4  # more of them for each byte: our densest masks, pillars of few sizes as OASIS arrays, hold 3.8
_MOST_PAIRS = 1 << 22
_STRIP = 1 << 16  # shapes whose neighbours are looked for at once
_AT_ONCE = 1 << 20  # corners


@dataclass(frozen=True, eq=False, slots=True)
class _Layer:
    """Shapes of one layer number: different outlines, and (n,) which each is, with its place."""

    outlines: list[Array]
    cells: list[str]
    kind: Array
    xy: Array

    @property
    def centre(self) -> Array:
        """(n, 2) middles of the boxes around the shapes."""
        middle = np.array([(o.min(0) + o.max(0)) / 2 for o in self.outlines])
        return np.asarray(self.xy + middle[self.kind])

    @property
    def reach(self) -> Array:
        """(outlines,) distance from the middle of the box to the farthest corner."""
        return np.array([np.hypot(*(o - (o.min(0) + o.max(0)) / 2).T).max() for o in self.outlines])

    def points(self, n: int) -> Array:
        """(m, 2) corners of shape ``n``."""
        return np.asarray(self.outlines[self.kind[n]] + self.xy[n])

    def box(self, *members: int) -> tuple[int, int, int, int]:
        """Left, bottom, right, top of some shapes."""
        corners = np.concatenate([self.points(n) for n in members])
        (left, bottom), (right, top) = corners.min(0).tolist(), corners.max(0).tolist()
        return left, bottom, right, top


def most_of(path: Path) -> int:
    """Shapes that a mask file is taken apart to, where its user sets no other limit."""
    return MOST_SHAPES + _EACH_BYTE * path.stat().st_size


def check(content: MaskContent, rules: Rules, *, skip: Sequence[int] = (), most: int = MOST_SHAPES) -> DrcReport:
    """Gap, feature and grid of every shape below the top cells, each layer number (all its datatypes) by itself.

    Args:
        skip: layer numbers that are not drawn in the resist (outlines, write fields).
        most: shapes that are taken apart.

    Raises:
        MaskFileError: no top cell, a hierarchy that is broken, more than ``most`` shapes or 4e6
            pairs of shapes that can be closer than the rule.
    """
    if not content.tops:
        raise MaskFileError("the mask has no top cell: its cells place each other in a circle")
    flat.refuse_beyond(content, most)
    report = DrcReport.empty(content, rules)
    for number, layer in sorted(_layers(content, skip).items()):
        report.pillars += len(layer.kind)
        _off_grid(layer, rules, content.unit_nm, report)
        _check_layer(layer, rules, report, f"layer {number}")
    return report


def _layers(content: MaskContent, skip: Sequence[int]) -> Mapping[int, _Layer]:
    found: dict[int, tuple[dict[bytes, int], list[Array], list[str], list[Array], list[Array]]] = {}
    for top in content.tops:
        for shape in flat.shapes(content, top):
            if shape.layer[0] in skip:
                continue
            known, outlines, cells, kinds, places = found.setdefault(shape.layer[0], ({}, [], [], [], []))
            key = np.ascontiguousarray(shape.outline, np.int64).tobytes()
            if key not in known:
                known[key] = len(outlines)
                outlines.append(_plain(np.asarray(shape.outline, np.int64)))
                cells.append(shape.cell)
            kinds.append(np.full(len(shape.x), known[key], np.int32))
            places.append(np.column_stack([shape.x, shape.y]))
    return {
        number: _Layer(outlines, cells, np.concatenate(kinds), np.concatenate(places))
        for number, (_, outlines, cells, kinds, places) in found.items()
    }


def _plain(points: Array) -> Array:
    """Corners without repeats and without those on a straight line."""
    points = points[(points != np.roll(points, 1, axis=0)).any(1)]
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    return np.asarray(points[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]])


def _is_convex(points: Array) -> bool:
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    if (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]).min() <= 0:
        return False
    turned = np.unwrap(np.arctan2(after[:, 1], after[:, 0]))
    return bool(turned[-1] - turned[0] < 2 * math.pi)


def _check_layer(layer: _Layer, rules: Rules, report: DrcReport, name: str) -> None:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    gap = rules.minimum_gap_nm / report.unit_nm
    one, two, apart = _near(layer, gap)
    count, touch = len(layer.kind), apart <= 0
    graph = coo_matrix((np.ones(int(touch.sum())), (one[touch], two[touch])), (count, count))
    _, joined = connected_components(graph, directed=False)
    straight = np.array([_is_convex(o) for o in layer.outlines])[layer.kind]
    alone = straight & (np.bincount(joined)[joined] == 1)
    _features(layer, np.flatnonzero(alone), rules, report)
    both = alone[one] & alone[two] & (apart < gap - 1e-9) & ~touch
    for a, b, value in zip(one[both].tolist(), two[both].tolist(), apart[both].tolist(), strict=True):
        text = f"{layer.cells[layer.kind[a]]} to {layer.cells[layer.kind[b]]}, {name}"
        value *= report.unit_nm
        report.add("gap", 1, Violation("gap", layer.box(a, b), value, rules.minimum_gap_nm, text))
    least = apart[alone[one] & alone[two]].min(initial=math.inf) * report.unit_nm
    report.minimum_gap_nm = min(report.minimum_gap_nm, float(least))
    near = np.zeros(count, bool)
    near[one[~alone[two]]] = near[two[~alone[one]]] = True
    _by_edges(layer, joined, ~alone, near & alone, rules, report, name)


def _near(layer: _Layer, gap: float) -> tuple[Array, Array, Array]:
    """Pairs of shapes that can be closer than the rule, and their distance: 0 and below where they touch or meet.

    Shapes of unlike size are searched from the larger one, so that one long line does not pair everything.
    """
    from scipy.spatial import cKDTree

    centre, reach = layer.centre, layer.reach[layer.kind]
    size = np.ceil(np.log2(np.maximum(reach, 1))).astype(int)
    ones: list[Array] = [np.empty(0, np.int64)]
    twos: list[Array] = [np.empty(0, np.int64)]
    groups = {s: np.flatnonzero(size == s) for s in np.unique(size).tolist()}
    widest = {s: float(reach[members].max()) for s, members in groups.items()}
    trees = {s: cKDTree(centre[members]) for s, members in groups.items() if len(groups) > 1}
    for s, members in groups.items():
        for pairs in _alike(centre[members], 2 * widest[s] + gap):
            kept = _close(centre, reach, *members[pairs.T]) < gap
            ones.append(members[pairs[kept, 0]])
            twos.append(members[pairs[kept, 1]])
            _refuse_many(sum(map(len, ones)))
        for t in (t for t in groups if t < s):
            far = widest[s] + widest[t] + gap
            _refuse_many(int(trees[t].count_neighbors(trees[s], far)))
            found = trees[t].query_ball_point(centre[members], far)
            twos.append(groups[t][np.concatenate([np.asarray(f, np.int64) for f in found])])
            ones.append(np.repeat(members, [len(f) for f in found]))
    one, two = np.concatenate(ones), np.concatenate(twos)
    kept = _close(centre, reach, one, two) < gap
    one, two = one[kept], two[kept]
    hulls = [o if _is_convex(o) else _hull(o) for o in layer.outlines]
    moves = layer.xy[two] - layer.xy[one]
    known: dict[tuple[int, int, int, int], float] = {}
    apart = np.empty(len(one))
    for n, key in enumerate(zip(layer.kind[one].tolist(), layer.kind[two].tolist(), *moves.T.tolist(), strict=True)):
        if key not in known:
            known[key] = convex.gap(hulls[key[0]], hulls[key[1]], key[2], key[3])
        apart[n] = known[key]
    return one, two, apart


def _close(centre: Array, reach: Array, one: Array, two: Array) -> Array:
    """(n,) distance of the circles around two shapes."""
    return np.asarray(np.hypot(*(centre[one] - centre[two]).T) - reach[one] - reach[two])


def _alike(centre: Array, far: float) -> Iterator[Array]:
    """(n, 2) pairs of places not farther than ``far`` apart, each once, strip by strip in bounded memory.

    Raises:
        MaskFileError: so many in one strip that shapes must lie on each other.
    """
    from scipy.spatial import cKDTree

    order = np.argsort(centre[:, 1], kind="stable")
    y = centre[order, 1]
    for first in range(0, len(order), _STRIP):
        last = min(first + _STRIP, len(order))
        end = int(np.searchsorted(y, y[last - 1] + far, side="right"))
        own, all_of = order[first:last], order[first:end]
        tree = cKDTree(centre[all_of])
        _refuse_many(int(cKDTree(centre[own]).count_neighbors(tree, far)) // 2)
        pairs = np.sort(tree.query_pairs(far, output_type="ndarray"), axis=1)
        yield all_of[pairs[pairs[:, 0] < last - first]]


def _refuse_many(count: int) -> None:
    if count > _MOST_PAIRS:
        raise MaskFileError(
            f"{count:,} pairs of shapes can be closer than the rule, at most {_MOST_PAIRS:,} are measured; shapes lie "
            "on each other, or the rule's gap is far wider than they are"
        )


def _hull(points: Array) -> Array:
    from scipy.spatial import ConvexHull

    return np.asarray(points[ConvexHull(points).vertices])


def _features(layer: _Layer, members: Array, rules: Rules, report: DrcReport) -> None:
    """Widths of convex shapes that stand alone."""
    for kind in np.unique(layer.kind[members]).tolist():
        width = convex.width(layer.outlines[kind]) * report.unit_nm
        report.minimum_feature_nm = min(report.minimum_feature_nm, width)
        if width < rules.minimum_feature_nm - 1e-9:
            for n in members[layer.kind[members] == kind].tolist():
                text = layer.cells[kind]
                report.add("feature", 1, Violation("feature", layer.box(n), width, rules.minimum_feature_nm, text))


def _by_edges(
    layer: _Layer, joined: Array, other: Array, near: Array, rules: Rules, report: DrcReport, name: str
) -> None:
    """Everything that is not convex or not alone, as merged contours, with the convex shapes beside it."""
    if not other.any():
        return
    lines, owner = [], []
    groups = np.flatnonzero(other)[np.argsort(joined[other], kind="stable")]
    starts = np.flatnonzero(np.diff(joined[groups], prepend=-1))
    pieces: list[list[int]] = [p.tolist() for p in np.split(groups, starts[1:])]
    pieces += [[n] for n in np.flatnonzero(near).tolist()]
    for number, members in enumerate(pieces):
        shapes = [layer.points(n) for n in members]
        contours = region.union(shapes) if len(shapes) > 1 or not _is_convex(shapes[0]) else shapes
        for contour in map(_plain, contours):
            lines.append(np.hstack([contour, np.roll(contour, -1, axis=0)]))
            owner.append(np.full(len(contour), number))
    edge, shape = np.concatenate(lines), np.concatenate(owner)
    feature, gap = (v / report.unit_nm for v in (rules.minimum_feature_nm, rules.minimum_gap_nm))
    for a, b, kind, away in facing.facing(edge, shape, feature, gap).tolist():
        corners = np.concatenate([edge[int(a)].reshape(2, 2), edge[int(b)].reshape(2, 2)])
        box = (*corners.min(0).tolist(), *corners.max(0).tolist())
        rule, limit = ("feature", rules.minimum_feature_nm) if kind == facing.WIDTH else ("gap", rules.minimum_gap_nm)
        value = away * report.unit_nm
        report.add(rule, 1, Violation(rule, box, value, limit, f"edges of {name}"))
        if kind == facing.WIDTH:
            report.minimum_feature_nm = min(report.minimum_feature_nm, value)
        else:
            report.minimum_gap_nm = min(report.minimum_gap_nm, value)


def _off_grid(layer: _Layer, rules: Rules, unit_nm: float, report: DrcReport) -> None:
    """Corners that do not lie on the grid of the process."""
    step = rules.grid_nm / unit_nm
    places = np.mod(layer.xy, step)
    for kind, outline in enumerate(layer.outlines):
        at = np.flatnonzero(layer.kind == kind)
        for some in np.array_split(at, -(-len(at) * len(outline) // _AT_ONCE)):
            off = np.mod(outline[None] + places[some][:, None], step)
            for n in some[(np.minimum(off, step - off) > 1e-6).any((1, 2))].tolist():
                violation = Violation("off-grid", layer.box(n), 0.0, float(rules.grid_nm), layer.cells[kind])
                report.add("off-grid", 1, violation)
