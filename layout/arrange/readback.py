"""An assembly that was written and read again: cells, shapes, and every copy at its place."""

import numpy as np

from layout.files import Assembly, CellContent, Copies, Digest, MaskContent, Turn, flat
from metalens.ground.arrays import Array


def differences(made: Assembly, content: MaskContent) -> list[str]:
    """What a file does not hold as it was planned, in words; empty where it holds it all.

    A file without circles (GDSII) has polygons of 64 corners in their place.
    """
    found = []
    if abs(content.unit_nm / made.unit_nm - 1) > 1e-12:
        found.append(f"database unit {content.unit_nm} nm, planned {made.unit_nm}")
    missing = sorted(made.cells.keys() - content.cells.keys())
    strange = sorted(content.cells.keys() - made.cells.keys())
    if missing or strange:
        text = f"{len(missing)} cells are missing, {len(strange)} too many: {', '.join([*missing, *strange][:5])}"
        return [*found, text]
    for name, cell in made.cells.items():
        read = content.cells[name]
        if _shapes(cell) != _shapes(read):
            found.append(f"cell {name}: shapes differ")
        planned, there = _sums(cell, made.copies.get(name, ())), _sums(read, ())
        if planned != there:
            unlike = sorted({child for child, _ in planned.items() ^ there.items()}, key=str)
            found.append(f"cell {name}: copies of {unlike[0][0]} are not all at their places")
    return found


def _shapes(cell: CellContent) -> list[tuple[tuple[int, int], list[tuple[int, ...]]]]:
    """Polygons by layer, circles as polygons, each from its smallest corner on, counter-clockwise."""
    every = {layer: list(shapes) for layer, shapes in cell.polygons.items()}
    for layer, circles in cell.circles.items():
        every.setdefault(layer, []).extend(flat.circle(*one) for one in circles)
    return [(layer, sorted(_canonical(p) for p in every[layer])) for layer in sorted(every) if every[layer]]


def _canonical(points: Array) -> tuple[int, ...]:
    p = np.asarray(points, np.int64)
    after = np.roll(p, -1, axis=0)
    if (p[:, 0] * after[:, 1] - after[:, 0] * p[:, 1]).sum() < 0:
        p = p[::-1]
    first = int(np.lexsort((p[:, 1], p[:, 0]))[0])
    return tuple(np.roll(p, -first, axis=0).ravel().tolist())


def _sums(cell: CellContent, copies: tuple[Copies, ...]) -> dict[tuple[str, Turn], tuple[int, ...]]:
    """{(child, turn): count, sums and hash of its places}."""
    digests: dict[tuple[str, Turn], Digest] = {}
    placed = cell.kept()
    key = placed.child.astype(np.int64) * len(placed.turns) + placed.turn
    order = np.argsort(key, kind="stable")
    edges = np.flatnonzero(np.diff(key[order], prepend=-1, append=-1)) if len(key) else np.empty(0, np.int64)
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        child, turn = divmod(int(key[order[first]]), len(placed.turns))
        some = order[first:end]
        _add(digests, (placed.children[child], _rounded(placed.turns[turn])), placed.x[some], placed.y[some])
    for one in copies:
        _add(digests, (one.child, _rounded(one.turn)), *one.places())
    return {who: _told(digest) for who, digest in digests.items()}


def _add(digests: dict[tuple[str, Turn], Digest], who: tuple[str, Turn], x: Array, y: Array) -> None:
    nothing = np.zeros(len(x), np.uint8)
    digests.setdefault(who, Digest()).take(nothing.astype(np.int64), x, y, nothing)


def _told(digest: Digest) -> tuple[int, ...]:
    return tuple(int(value[0]) for value in digest.of(np.zeros(1, np.int64)))


def _rounded(turn: Turn) -> Turn:
    """As both formats hold it: GDSII has 56 bits of a fraction to the base 16."""
    return Turn(round(turn.angle_deg % 360, 9) % 360, turn.mirrored, float(f"{turn.scale:.12g}"))
