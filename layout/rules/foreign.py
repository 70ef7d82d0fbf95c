"""Rules on a mask made anywhere: pillars at any place and turn, shapes of any outline,
checked layer by layer.

Shapes that touch are one shape, as a writer exposes them. Convex ones that stand alone
are measured polygon to
polygon, wherever they stand, those that can be near each other found by sorting their
places; all others edge against
edge.
"""

import dataclasses
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from layout.files import MaskContent, Turn
from layout.process import Rules, compiled
from layout.rules import copies, near, nested
from layout.rules import edges as facing
from layout.rules import layer as layers
from layout.rules.entered import entered
from layout.rules.layer import Layer
from layout.rules.report import MOST_SHOWN, DrcReport, Violation
from layout.shapes import convex, region
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

# that are checked or shown at once in less than 1 GB, however small the file
MOST_SHAPES = 4_000_000
# more of them for each byte: our lenses, not folded, hold 4 pillars in each, of two
# sizes 17
_EACH_BYTE = 20
_AT_ONCE = 1 << 18  # shapes that are held to the grid at once
_CLEAR = -1  # number of all layers together whose clear areas stay
_ROUNDED = 1e-6  # of a step of a grid that is no whole number of units


def most_of(path: Path) -> int:
    """Shapes that a mask file is taken apart to, where its user sets no other limit."""
    return MOST_SHAPES + _EACH_BYTE * path.stat().st_size


def check(
    content: MaskContent,
    rules: Rules,
    *,
    skip: Sequence[int] = (),
    negative: Collection[int] = (),
    most: int = MOST_SHAPES,
    last: bool = False,
) -> DrcReport:
    """Gap, feature and grid of every shape below the top cells, each layer number (all
    its datatypes) by itself.

    Large cells that are placed again and again are looked at once, but for what stands
    near other shapes: a wafer of
    one die takes little more than the die, and every copy is counted.

    Args:
        skip: layer numbers that are not drawn in the resist (outlines, write fields).
        negative: layer numbers that are exposed together, and what they leave empty
            stays: it is held to the least
            feature, what they draw to the least gap.
        most: shapes that are taken apart.
        last: the cells of ``content`` are let go once their shapes are gathered.

    Raises:
        MaskFileError: no top cell, a hierarchy that is broken, more than ``most``
            shapes or 4e6
            pairs of shapes that can be closer than the rule.
    """
    if not content.tops:
        raise MaskFileError(
            "the mask has no top cell: its cells place each other in a circle"
        )
    parts = copies.found(content)
    copies.refuse_beyond(parts, content, most)
    parts = copies.with_places(parts, content)
    report = DrcReport.empty(content, rules)
    step = rules.grid_nm / content.unit_nm
    whole, offsets = parts.times.keys() - {copies.ROOT}, parts.offsets(step)
    number_of = {number: _CLEAR for number in negative}
    groups = {
        name: layers.groups(content, parts.tops(content, name), skip, whole, number_of)
        for name in parts.times
    }
    if last:
        content.cells.clear()
    for number in sorted({number for some in groups.values() for number in some}):
        drawn = {
            name: layers.gathered(some.pop(number))
            for name, some in groups.items()
            if number in some
        }
        held = _exchanged(rules) if number == _CLEAR else rules
        said = f"layer {number}" if number != _CLEAR else "what is drawn"
        for name, layer in nested.separate(
            parts, drawn, held.minimum_gap_nm / content.unit_nm, most
        ):
            report.pillars += len(layer.kind) * parts.times[name]
            own = DrcReport.empty(content, held)
            _check_layer(layer, held, own, said)
            own = own.exchanged() if number == _CLEAR else own
            _copied(
                report,
                own,
                parts.times[name],
                name,
                partial(parts.copies, name, MOST_SHOWN),
            )
            for offset, times in offsets[name].items():
                own = DrcReport.empty(content, rules)
                _off_grid(layer, rules, own, offset)
                _copied(
                    report,
                    own,
                    times,
                    name,
                    partial(parts.copies, name, MOST_SHOWN, step=step, offset=offset),
                )
    return report


def _exchanged(rules: Rules) -> Rules:
    """Limits of what is drawn, where what is not drawn stays."""
    return dataclasses.replace(
        rules,
        minimum_gap_nm=rules.minimum_feature_nm,
        minimum_feature_nm=rules.minimum_gap_nm,
    )


def _copied(
    report: DrcReport,
    own: DrcReport,
    times: int,
    name: str,
    places: Callable[[], list[tuple[Turn, int, int]]],
) -> None:
    """Enter what was found of a cell for all its copies; it is listed for the first of
    them, as far as lists go.
    """
    for rule, count in own.counts.items():
        report.counts[rule] += times * count
    report.minimum_gap_nm = min(report.minimum_gap_nm, own.minimum_gap_nm)
    report.minimum_feature_nm = min(report.minimum_feature_nm, own.minimum_feature_nm)
    said = f"; in each of {times:,} copies of {name}" if name != copies.ROOT else ""
    for turn, x, y in places() if own.violations else []:
        listed = [v for v in own.violations if report.has_room(v.rule)]
        if not listed:
            return
        boxes = turn.boxes(np.array([v.box for v in listed])) + np.array([x, y, x, y])
        for found, box in zip(listed, boxes.tolist(), strict=True):
            report.add(
                found.rule,
                0,
                dataclasses.replace(found, box=tuple(box), text=found.text + said),
            )


def _check_layer(layer: Layer, rules: Rules, report: DrcReport, name: str) -> None:
    gap = rules.minimum_gap_nm / report.unit_nm
    one, two = near.pairs(layer.discs, gap)
    apart = layer.distances(one, two, gap)
    touch, close = apart <= 0, apart < gap - 1e-9
    alone = np.array([layers.is_convex(o) for o in layer.outlines])[layer.kind]
    alone[one[touch]] = alone[two[touch]] = False
    _features(layer, alone, rules, report)
    both = alone[one] & alone[two] & close
    _too_near(layer, (one[both], two[both], apart[both]), rules, report, name)
    other = np.flatnonzero(~alone)
    if len(other):
        groups = _joined(other, one[touch], two[touch])
        beside = alone[one] != alone[two]
        _beside(
            layer,
            alone,
            groups,
            (one[beside & close], two[beside & close], apart[beside & close]),
            rules,
            report,
        )
        hiding = np.concatenate(
            [one[beside & (apart < gap)], two[beside & (apart < gap)]]
        )
        _by_edges(layer, groups, np.unique(hiding[alone[hiding]]), rules, report, name)


def _too_near(
    layer: Layer,
    pairs: tuple[Array, Array, Array],
    rules: Rules,
    report: DrcReport,
    name: str,
) -> None:
    """Pairs of convex shapes that stand alone: first, second, distance."""
    value = pairs[2] * report.unit_nm

    def shown() -> Iterator[Violation]:
        for a, b, apart in zip(
            pairs[0].tolist(), pairs[1].tolist(), value.tolist(), strict=True
        ):
            text = (
                f"{layer.cells[layer.kind[a]]} to {layer.cells[layer.kind[b]]}, {name}"
            )
            yield Violation("gap", layer.box(a, b), apart, rules.minimum_gap_nm, text)

    report.add_all("gap", len(value), shown())
    report.minimum_gap_nm = min(
        report.minimum_gap_nm, float(value.min(initial=math.inf))
    )


def _beside(
    layer: Layer,
    alone: Array,
    groups: list[list[int]],
    pairs: tuple[Array, Array, Array],
    rules: Rules,
    report: DrcReport,
) -> None:
    """Convex shapes that stand alone, near others: each with each group is one gap, of
    its nearest shape.
    """
    group = np.zeros(len(layer.kind), np.int64)
    for number, members in enumerate(groups):
        group[members] = number
    own, other = np.where(alone[pairs[0]], pairs[:2], pairs[1::-1])
    order = np.lexsort((pairs[2], group[other], own))
    own, other, apart = own[order], other[order], pairs[2][order] * report.unit_nm
    new = (np.diff(own, prepend=-1) != 0) | (np.diff(group[other], prepend=-1) != 0)

    def shown() -> Iterator[Violation]:
        for a, b, value in zip(
            own[new].tolist(), other[new].tolist(), apart[new].tolist(), strict=True
        ):
            left, bottom, right, top = layer.box(a)
            room = math.ceil(value / report.unit_nm)
            text = f"{layer.cells[layer.kind[a]]} to {layer.cells[layer.kind[b]]}"
            box = left - room, bottom - room, right + room, top + room
            yield Violation("gap", box, value, rules.minimum_gap_nm, text)

    report.add_all("gap", int(new.sum()), shown())
    report.minimum_gap_nm = min(
        report.minimum_gap_nm, float(apart.min(initial=math.inf))
    )


def _joined(members: Array, one: Array, two: Array) -> list[list[int]]:
    """Members in groups that touch: pairs ``one`` and ``two`` do."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.searchsorted(members, one), np.searchsorted(members, two)
    graph = coo_matrix((np.ones(len(one), np.int8), ends), (len(members), len(members)))
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order], prepend=-1))
    return [some.tolist() for some in np.split(members[order], starts[1:])]


def _features(layer: Layer, alone: Array, rules: Rules, report: DrcReport) -> None:
    """Widths of convex shapes that stand alone."""
    for kind in np.flatnonzero(
        counted(layer.kind, alone, np.zeros(len(layer.outlines), np.int64))
    ).tolist():
        width = convex.width(layer.outlines[kind]) * report.unit_nm
        report.minimum_feature_nm = min(report.minimum_feature_nm, width)
        if width < rules.minimum_feature_nm - 1e-9:
            some = np.flatnonzero((layer.kind == kind) & alone)
            report.add_all(
                "feature",
                len(some),
                _narrow_ones(layer, some, width, rules.minimum_feature_nm),
            )


def _narrow_ones(
    layer: Layer, some: Array, width: float, limit: float
) -> Iterator[Violation]:
    for n in some.tolist():
        yield Violation(
            "feature", layer.box(n), width, limit, layer.cells[layer.kind[n]]
        )


@compiled
def counted(kind: Array, alone: Array, out: Array) -> Array:
    """Shapes of each kind that stand alone, added to ``out``."""
    for n in range(kind.shape[0]):
        if alone[n]:
            out[kind[n]] += 1
    return out


def _by_edges(
    layer: Layer,
    groups: list[list[int]],
    beside: Array,
    rules: Rules,
    report: DrcReport,
    name: str,
) -> None:
    """Groups of shapes that are not convex or touch, as merged contours; the convex
    shapes beside them hide edges.
    """
    lines: list[Array] = []
    owner: list[Array] = []
    hiding: list[Array] = []
    within: list[Array] = []
    for number, members in enumerate([*groups, *([n] for n in beside.tolist())]):
        shapes = [layer.points(n) for n in members]
        whole = len(shapes) == 1 and layers.is_convex(shapes[0])
        contours = [
            layers.plain(c) for c in (shapes if whole else region.union(shapes))
        ]
        contours = [c for c in contours if len(c) > 2]  # lines draw nothing
        for contour in contours:
            known = layers.is_convex(contour) and (
                whole or not _holds(contour, contours)
            )
            if known and number < len(groups):
                _narrow(contour, rules, report, name)
            open_ = layers.is_convex(contour[::-1])
            if open_:
                _narrow(contour[::-1], rules, report, name, hole=True)
            within.append(np.full(len(contour), len(within) if open_ else -1))
            lines.append(np.hstack([contour, np.roll(contour, -1, axis=0)]))
            owner.append(np.full(len(contour), facing.KNOWN if known else number))
            hiding.append(np.full(len(contour), number >= len(groups)))
    if not lines:
        return
    edge, shape, hides = (
        np.concatenate(lines),
        np.concatenate(owner),
        np.concatenate(hiding),
    )
    feature, gap = (
        v / report.unit_nm for v in (rules.minimum_feature_nm, rules.minimum_gap_nm)
    )
    found = facing.facing(edge, shape, feature, gap, hole=np.concatenate(within))
    found = found[~hides[found[:, :2].astype(np.int64)].any(1)]
    limits = ("feature", rules.minimum_feature_nm), ("gap", rules.minimum_gap_nm)
    entered(report, edge, found, limits, f"edges of {name}")


def _holds(contour: Array, others: list[Array]) -> bool:
    """Whether another contour lies within a convex one: it has a hole."""
    edges = np.roll(contour, -1, axis=0) - contour
    for other in others:
        to = other[0] - contour
        if (
            other is not contour
            and (edges[:, 0] * to[:, 1] >= edges[:, 1] * to[:, 0]).all()
        ):
            return True
    return False


def _narrow(
    contour: Array, rules: Rules, report: DrcReport, name: str, *, hole: bool = False
) -> None:
    """Width of a convex contour that shapes have together, or of a convex hole in them,
    which is a gap.
    """
    width = convex.width(contour) * report.unit_nm
    rule, limit = (
        ("gap", rules.minimum_gap_nm) if hole else ("feature", rules.minimum_feature_nm)
    )
    if hole:
        report.minimum_gap_nm = (
            min(report.minimum_gap_nm, width)
            if width < limit - 1e-9
            else report.minimum_gap_nm
        )
    else:
        report.minimum_feature_nm = min(report.minimum_feature_nm, width)
    if width < limit - 1e-9:
        box = (*contour.min(0).tolist(), *contour.max(0).tolist())
        report.add(
            rule,
            1,
            Violation(
                rule, box, width, limit, f"{'hole' if hole else 'shape'} of {name}"
            ),
        )


def _off_grid(
    layer: Layer, rules: Rules, report: DrcReport, offset: copies.Offset
) -> None:
    """Corners that do not lie on the grid of the process, which the cell lies off by
    ``offset``.
    """
    step = rules.grid_nm / report.unit_nm
    if step == 1:
        return
    whole = step == round(step)
    bad = [_residue(outline, step) for outline in layer.outlines]
    for first in range(0, len(layer.kind), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        kind, place = (
            layer.kind[some],
            np.column_stack([layer.x[some], layer.y[some]]) + np.array(offset),
        )
        off = np.mod(
            place + np.array([r if r is not None else (0.0, 0.0) for r in bad])[kind],
            step,
        )
        apart = (np.minimum(off, step - off) > (0 if whole else _ROUNDED)).any(1)
        apart |= np.array([r is None for r in bad])[kind]
        found, limit = np.flatnonzero(apart) + first, float(rules.grid_nm)
        shown = (
            Violation("off-grid", layer.box(n), 0.0, limit, layer.cells[layer.kind[n]])
            for n in found.tolist()
        )
        report.add_all("off-grid", len(found), shown)


def _residue(outline: Array, step: float) -> tuple[float, float] | None:
    """Where all corners lie on a grid of ``step``, from its points; None where they lie
    on different ones.
    """
    off = np.mod(outline - outline[0] + step / 2, step) - step / 2
    return (
        None
        if np.abs(off).max() > _ROUNDED
        else tuple(np.mod(outline[0], step).tolist())
    )
