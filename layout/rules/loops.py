"""The loops of the design-rule check over all sites of a lattice."""

from layout.process import compiled
from metalens.ground.arrays import Array


@compiled
def pair_histogram(
    block: Array, new: int, kind: Array, offsets: Array, table: Array
) -> None:
    """Count the pairs of neighbours by their kinds.

    Args:
        block: (rows, columns) class numbers; pairs whose lower site stands in row
            ``new`` or below count.
        kind: (classes + 1,) shape number of each class, 0 for none.
        offsets: (m, 2) columns to the right and rows up of the second site; rows up >=
            0.
        table: (m, kinds, kinds) counts, added to.
    """
    rows, columns = block.shape
    for m in range(offsets.shape[0]):
        right, up = offsets[m, 0], offsets[m, 1]
        for row in range(max(new, up), rows):
            for column in range(max(0, -right), min(columns, columns - right)):
                a = kind[block[row, column]]
                b = kind[block[row - up, column + right]]
                table[m, a, b] += 1


@compiled
def find_pairs(
    block: Array,
    new: int,
    kind: Array,
    offsets: Array,
    bad: Array,
    found: Array,
    count: int,
) -> int:
    """Sites (row, column, offset number) of pairs that ``bad`` (m, kinds, kinds) names,
    until ``found`` is full.
    """
    rows, columns = block.shape
    for m in range(offsets.shape[0]):
        right, up = offsets[m, 0], offsets[m, 1]
        for row in range(max(new, up), rows):
            for column in range(max(0, -right), min(columns, columns - right)):
                if bad[
                    m, kind[block[row, column]], kind[block[row - up, column + right]]
                ]:
                    if count == found.shape[0]:
                        return count
                    found[count, 0], found[count, 1], found[count, 2] = row, column, m
                    count += 1
    return count


@compiled
def count_and_cover(
    block: Array,
    first: int,
    area: Array,
    side: tuple[int, int],
    counts: Array,
    cover: Array,
) -> None:
    """Add the pillars of each class to ``counts`` and their area to tiles of ``side``
    (rows, columns).
    """
    for row in range(block.shape[0]):
        tile_row = (first + row) // side[0]
        for column in range(block.shape[1]):
            c = block[row, column]
            counts[c] += 1
            cover[tile_row, column // side[1]] += area[c]
