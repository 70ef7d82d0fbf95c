"""An assembly that was written and read again: cells, shapes, and every copy at its
place.
"""

import numpy as np

from layout.files import (
    QUARTERS,
    Assembly,
    CellContent,
    Copies,
    Digest,
    MaskContent,
    Sites,
    Turn,
    flat,
)
from metalens.ground.arrays import Array


def differences(made: Assembly, content: MaskContent) -> list[str]:
    """What a file does not hold as it was planned, in words; empty where it holds it
    all.

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
        merged = read.sums is not None
        planned = _sums(
            cell, made.copies.get(name, ()), made.sites.get(name), merged=merged
        )
        there = _sums(read, (), None, merged=merged)
        if planned != there:
            unlike = sorted(
                {who for who, _ in planned.items() ^ there.items()}, key=str
            )
            found.append(
                f"cell {name}: copies of {unlike[0][0]} are not all at their places"
            )
    return found


def _shapes(cell: CellContent) -> list[tuple[tuple[int, int], list[tuple[int, ...]]]]:
    """Polygons by layer, circles as polygons, each from its smallest corner on,
    counter-clockwise.
    """
    every = {layer: list(shapes) for layer, shapes in cell.polygons.items()}
    for layer, circles in cell.circles.items():
        every.setdefault(layer, []).extend(flat.circle(*one) for one in circles)
    return [
        (layer, sorted(_canonical(p) for p in every[layer]))
        for layer in sorted(every)
        if every[layer]
    ]


def _canonical(points: Array) -> tuple[int, ...]:
    p = np.asarray(points, np.int64)
    after = np.roll(p, -1, axis=0)
    if (p[:, 0] * after[:, 1] - after[:, 0] * p[:, 1]).sum() < 0:
        p = p[::-1]
    first = int(np.lexsort((p[:, 1], p[:, 0]))[0])
    return tuple(np.roll(p, -first, axis=0).ravel().tolist())


def _sums(
    cell: CellContent, copies: tuple[Copies, ...], sites: Sites | None, *, merged: bool
) -> dict[tuple[str, Turn | None], tuple[int, ...]]:
    """{(child, turn): count, sums and hash of its places}; ``merged``: all turns
    together, as a reader sums them.
    """
    if cell.sums is not None:
        every = zip(cell.placed.children, *(v.tolist() for v in cell.sums), strict=True)
        return {(child, None): tuple(told) for child, *told in every}
    digests: dict[tuple[str, Turn | None], Digest] = {}
    placed = cell.kept()
    key = placed.child.astype(np.int64) * len(placed.turns) + placed.turn
    order = np.argsort(key, kind="stable")
    edges = (
        np.flatnonzero(np.diff(key[order], prepend=-1, append=-1))
        if len(key)
        else np.empty(0, np.int64)
    )
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        child, turn = divmod(int(key[order[first]]), len(placed.turns))
        some = order[first:end]
        _add(
            digests,
            placed.children[child],
            placed.turns[turn],
            (placed.x[some], placed.y[some]),
            merged,
        )
    for one in copies:
        _add(digests, one.child, one.turn, one.places(), merged)
    told = {who: _told(digest) for who, digest in digests.items()}
    of_sites = {} if sites is None else sites.sums()
    return told | {
        (child, None if merged else QUARTERS[0]): sums
        for child, sums in of_sites.items()
    }


def _add(
    digests: dict[tuple[str, Turn | None], Digest],
    child: str,
    turn: Turn,
    place: tuple[Array, Array],
    merged: bool,
) -> None:
    """Take in copies; the turn counts in the sums where it is no part of who they are."""
    who, zeros = _rounded(turn), np.zeros(len(place[0]), np.int64)
    index = QUARTERS.index(who) if who in QUARTERS else len(QUARTERS)
    turned = np.full(len(zeros), index if merged else 0, np.uint8)
    digests.setdefault((child, None if merged else who), Digest()).take(
        zeros, *place, turned
    )


def _told(digest: Digest) -> tuple[int, ...]:
    return tuple(int(value[0]) for value in digest.of(np.zeros(1, np.int64)))


def _rounded(turn: Turn) -> Turn:
    """As both formats hold it: GDSII has 56 bits of a fraction to the base 16."""
    return Turn(
        round(turn.angle_deg % 360, 9) % 360, turn.mirrored, float(f"{turn.scale:.12g}")
    )
