"""Large cells that are placed again and again, looked at once: what stands near other
shapes is taken out of them.

Shapes that are nearer to each other than the gap form groups, and groups are checked
one by one. A group of a cell that
stays further than the gap from all that is drawn around every copy of the cell is the
same in each copy: it is checked
once. The others are drawn in the cells that hold the copies, and checked there or, by
the same rule, further up.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from layout.rules import near
from layout.rules.copies import ROOT, Copies, Parts, advice
from layout.rules.layer import EMPTY, Layer, joined
from layout.shapes import polygon, rectilinear, squared
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

_AT_ONCE = 1 << 18  # shapes whose boxes are looked at together
# each way, in which a cell is marked where others are near it, or where it draws
_SQUARES = 1024
_MOST_BOXES = 1 << 22  # that are told to copies for what other copies draw


@dataclass(frozen=True, eq=False, slots=True)
class _Held:
    """Copies within one cell that draw anything: which of ``copies`` each is (n,), its
    place and (n, 4) its box.
    """

    copies: list[Copies]
    which: Array
    x: Array
    y: Array
    box: Array


@dataclass(eq=False, slots=True)
class _Work:
    """One layer number. drawn: shapes of each cell; those that are taken out of others
    join them. count: of all these.

    box: (4,) around all of a cell. held: its copies. met: boxes (n, 4) of what is drawn
    around the copies of a cell, as
    they see it. covered: boxes (n, 4) of what a cell draws, in so many squares each
    way.
    """

    parts: Parts
    gap: float
    most: int
    drawn: dict[str, list[Layer]]
    count: int
    box: dict[str, Array] = field(default_factory=dict)
    held: dict[str, _Held] = field(default_factory=dict)
    met: dict[str, list[Array]] = field(default_factory=dict)
    covered: dict[tuple[str, int], Array] = field(default_factory=dict)


def separate(
    parts: Parts, drawn: Mapping[str, Layer], gap: float, most: int
) -> Iterator[tuple[str, Layer]]:
    """(cell, shapes) that are to be checked by themselves, each as often as
    ``parts.times`` tells.

    Args:
        drawn: shapes of each cell of ``parts.times`` without the copies that it holds.
        gap: shapes that are nearer belong together. most: shapes that are taken up.

    Raises:
        MaskFileError: more than these, or shapes beyond 32 bits.
    """
    if len(parts.times) == 1:  # nothing is placed again and again
        yield from ((name, layer) for name, layer in drawn.items() if len(layer.kind))
        return
    every = {name: [drawn.get(name, EMPTY)] for name in parts.times}
    work = _Work(
        parts,
        max(gap, 1.0),
        most,
        every,
        sum(len(layer.kind) for layer in drawn.values()),
    )
    for name in reversed(parts.times):
        _around(work, name)
    if ROOT in work.box and np.abs(work.box[ROOT]).max() > 2**31 - 1:
        raise MaskFileError("the mask draws shapes beyond 32 bits")
    for name in parts.times:
        _meet(work, name)
    for name in reversed(parts.times):
        layer = _taken_out(work, name)
        if len(layer.kind):
            yield name, layer


def _around(work: _Work, name: str) -> None:
    """Boxes of the copies that a cell holds, and around all of it."""
    copies = [some for some in work.parts.placed[name] if some.child in work.box]
    which = np.repeat(np.arange(len(copies)), [len(some.x) for some in copies])
    x, y = (
        np.concatenate(
            [np.empty(0, np.int64), *(getattr(some, axis) for some in copies)]
        )
        for axis in "xy"
    )
    own = np.array(
        [some.turn.boxes(work.box[some.child][None])[0] for some in copies]
    ).reshape(-1, 4)
    boxes = own.astype(np.int64)[which] + np.column_stack([x, y, x, y])
    work.held[name] = _Held(copies, which, x, y, boxes)
    every = np.concatenate([boxes, work.drawn[name][0].around])
    if len(every):
        work.box[name] = np.concatenate([every[:, :2].min(0), every[:, 2:].max(0)])


def _meet(work: _Work, name: str) -> None:
    """Tell every copy that a cell holds what is drawn near it."""
    held, layer = work.held[name], work.drawn[name][0]
    if not len(held.which):
        return
    met = np.unique(
        np.concatenate(work.met.get(name, [np.empty((0, 4), np.int64)])), axis=0
    )
    _enter_each(work, held, np.arange(len(held.which)), met)
    shapes = len(layer.kind)
    for one, two in _near(held, layer, work.gap):
        of_copies = two >= shapes
        _meet_copies(work, held, one[of_copies] - shapes, two[of_copies] - shapes)
        copy, shape = one[~of_copies] - shapes, two[~of_copies]
        touching = _touch(held.box[copy], layer.boxes(shape), work.gap)
        copy, shape = copy[touching], shape[touching]
        for kind in np.unique(layer.kind[shape]).tolist():
            own = layer.kind[shape] == kind
            boxes = _pieces(layer, kind, shape[own])
            _enter(work, held, np.repeat(copy[own], len(boxes) // own.sum()), boxes)


def _meet_copies(work: _Work, held: _Held, one: Array, two: Array) -> None:
    """Tell copies ``one`` what copies ``two`` draw near them: in finer squares, the
    fewer these pairs are.
    """
    touching = _touch(held.box[one], held.box[two], work.gap)
    one, two = one[touching], two[touching]
    squares = _squares(len(two), _SQUARES)
    for n in np.unique(two).tolist():
        some = held.copies[held.which[n]]
        place = np.array([held.x[n], held.y[n]] * 2)
        _enter_each(
            work,
            held,
            one[two == n],
            some.turn.boxes(_covered(work, some.child, squares)) + place,
        )


def _covered(work: _Work, name: str, squares: int) -> Array:
    """(n, 4) boxes that cover all that a cell draws, its own copies included, in
    ``squares`` each way.
    """
    if squares == 1:
        return work.box[name][None]
    if (name, squares) not in work.covered:
        every = _boxes_drawn(work, name, squares)
        work.covered[name, squares] = squared.Squared.of(
            work.box[name], squares, every
        ).boxes()
    return work.covered[name, squares]


def _boxes_drawn(work: _Work, name: str, squares: int) -> Iterator[Array]:
    """Boxes (n, 4) of what a cell draws: of its shapes, those that are wide in pieces,
    and of its copies.
    """
    layer, held = work.drawn[name][0], work.held[name]
    wide = np.array(
        [np.ptp(o, axis=0).max() for o in layer.outlines]
    ) > 4 / squares * np.ptp(work.box[name][[0, 2]])
    for first in range(0, len(layer.kind), _AT_ONCE):
        some = np.arange(first, min(first + _AT_ONCE, len(layer.kind)))
        in_pieces = wide[layer.kind[some]]
        yield layer.boxes(some[~in_pieces])
        for kind in np.unique(layer.kind[some[in_pieces]]).tolist():
            yield _pieces(layer, kind, some[layer.kind[some] == kind])
    inner = _squares(len(held.which), squares)
    for copies in held.copies:
        boxes = copies.turn.boxes(_covered(work, copies.child, inner))
        for x, y in zip(copies.x.tolist(), copies.y.tolist(), strict=True):
            yield boxes + np.array([x, y, x, y])


def _squares(times: int, most: int) -> int:
    """Squares each way of a cell whose boxes are told so many times: as fine as their
    number allows.
    """
    return 1 << int(np.log2(np.clip(_MOST_BOXES // (4 * max(times, 1)), 1, most)))


def _pieces(layer: Layer, kind: int, shapes: Array) -> Array:
    """Boxes (n * m, 4) that cover shapes (n,) of one kind, m for each."""
    place = np.column_stack([layer.x[shapes], layer.y[shapes]] * 2).astype(np.int64)
    return np.asarray((place[:, None] + _covering(layer.outlines[kind])).reshape(-1, 4))


def _near(held: _Held, layer: Layer, gap: float) -> Iterator[tuple[Array, Array]]:
    """(copies, others) that can be nearer than ``gap``: numbers of shapes, and behind
    these of copies.
    """
    wide = np.array([held.box[held.which == n][0] for n in range(len(held.copies))])
    first = np.array(
        [np.flatnonzero(held.which == n)[0] for n in range(len(held.copies))]
    )
    place = np.column_stack([held.x[first], held.y[first]])
    middle, reach = (
        (wide[:, :2] + wide[:, 2:]) / 2 - place,
        np.hypot(*(wide[:, 2:] - wide[:, :2]).T) / 2,
    )
    own, kinds = layer.discs, len(layer.outlines)
    every = near.Discs(
        np.concatenate([own.x, held.x.astype(np.int32)]),
        np.concatenate([own.y, held.y.astype(np.int32)]),
        np.concatenate([own.kind, (held.which + kinds).astype(np.int32)]),
        np.concatenate([own.middle, middle]),
        np.concatenate([own.reach, reach]),
    )
    one, two = near.pairs(every, gap, beside=np.arange(len(every.reach)) >= kinds)
    for a, b in ((one, two), (two, one)):
        copies = a >= len(layer.kind)
        yield a[copies], b[copies]


def _enter_each(work: _Work, held: _Held, copy: Array, boxes: Array) -> None:
    """Each of boxes (m, 4), as it is drawn, beside each of copies (n,)."""
    for some in np.array_split(boxes, max(1, -(-len(boxes) * len(copy) // _AT_ONCE))):
        _enter(work, held, np.tile(copy, len(some)), np.repeat(some, len(copy), axis=0))


def _enter(work: _Work, held: _Held, copy: Array, boxes: Array) -> None:
    """Boxes (n, 4) that are drawn beside copies (n,), where they are near: as the
    copies see them.
    """
    near_by = _touch(held.box[copy], boxes, work.gap)
    copy, boxes = copy[near_by], boxes[near_by]
    for n in np.unique(held.which[copy]).tolist():
        own, some = held.which[copy] == n, held.copies[n]
        place = np.column_stack([held.x[copy[own]], held.y[copy[own]]] * 2)
        seen = some.turn.back.boxes(boxes[own] - place)
        work.met.setdefault(some.child, []).append(np.unique(seen, axis=0))


def _covering(outline: Array) -> Array:
    """Boxes that cover a polygon: the one around it where it overlaps itself."""
    pieces = rectilinear.covering(outline)
    overlapping = ((pieces[:, 2:] - pieces[:, :2]).prod(1)).sum() < abs(
        polygon.twice_area(outline)
    ) / 2
    return np.array([[*outline.min(0), *outline.max(0)]]) if overlapping else pieces


def _taken_out(work: _Work, name: str) -> Layer:
    """The shapes of a cell that are the same in all copies; the others are drawn where
    the copies are.
    """
    layer, met = joined(work.drawn.pop(name)), work.met.pop(name, [])
    if not met or not len(layer.kind):
        return layer
    boxes = np.unique(np.concatenate(met), axis=0) + work.gap * np.array([-1, -1, 1, 1])
    around = squared.Squared.of(work.box[name], _SQUARES, [boxes])
    hit = np.concatenate(
        [
            around.touched(layer.boxes(slice(n, n + _AT_ONCE)))
            for n in range(0, len(layer.kind), _AT_ONCE)
        ]
    )
    if not hit.any():
        return layer
    taken = _with_their_groups(layer, hit, work.gap)
    some = layer.only(taken)
    holding = [
        (above, c)
        for above in work.drawn
        for c in work.parts.placed[above]
        if c.child == name
    ]
    copies = sum(len(c.x) for _, c in holding)
    work.count += len(some.kind) * copies
    if work.count > work.most:
        raise MaskFileError(
            f"copies of cell {name!r} lie on other shapes or nearer to them than the rule; one cannot stand for all: "
            f"{copies:,} times {len(some.kind):,} shapes are to be taken apart, with the others "
            f"{work.count:,} shapes, at most {work.most:,} are taken ({advice(work.count)})"
        )
    for above, c in holding:
        work.drawn[above].append(some.copied(c.turn, c.x, c.y))
    return layer.only(~taken)


def _with_their_groups(layer: Layer, hit: Array, gap: float) -> Array:
    """(n,) shapes that are hit, and all that belong to their groups."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    one, two = near.pairs(layer.discs, gap)
    close = _touch(layer.boxes(one), layer.boxes(two), gap)
    one, two = one[close], two[close]
    close = layer.distances(one, two, gap) < gap
    one, two = one[close], two[close]
    graph = coo_matrix((np.ones(len(one), np.int8), (one, two)), (len(hit), len(hit)))
    count, label = connected_components(graph, directed=False)
    groups = np.zeros(count, bool)
    groups[label[hit]] = True
    return np.asarray(groups[label])


def _touch(one: Array, two: Array, gap: float) -> Array:
    """(n,) whether boxes (n, 4) are as near as ``gap``, along x and along y."""
    return np.asarray(
        ((one[:, :2] - two[:, 2:] <= gap) & (two[:, :2] - one[:, 2:] <= gap)).all(1)
    )
