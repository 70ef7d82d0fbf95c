"""Eighths of a lens that looks the same from all sides, placed again: every site once,
with its own pillar.
"""

import numpy as np
import pytest

from layout.mask import PillarLattice, symmetry


def lens(count, *, x0=None):
    """(count, count) classes that depend on |x| and |y| alike, some empty, centred at (0, 0)."""
    across = np.abs(2 * np.arange(count) - (count - 1))
    kinds = np.random.default_rng(count).integers(0, 9, (count + 1, count + 1))
    kinds = np.maximum(kinds, kinds.T)
    classes = kinds[across[:, None], across].astype(np.uint8)
    half = (count - 1) * 430 // 2
    return PillarLattice.of(
        "LENS", classes, pitch=430, x0=-half if x0 is None else x0, y0=half
    )


def sites(lattice):
    """{(x, y): class} of the filled sites."""
    found = lattice.whole()
    y, x = np.nonzero(found)
    places = zip(
        lattice.x0 + x * lattice.pitch, lattice.y0 - y * lattice.pitch, strict=True
    )
    return {
        (int(a), int(b)): int(k) for (a, b), k in zip(places, found[y, x], strict=True)
    }


@pytest.mark.parametrize("count", [4, 5, 8, 11])
def test_the_placed_pieces_are_the_lens(count):
    """A placement mirrors at the x axis first, then turns by quarters to the left: (x,
    y) to (x, -y), then (-y, x).
    """
    whole = lens(count)
    assert symmetry.is_square_symmetric(whole)
    made = symmetry.symmetry_pieces(whole)
    placed = []
    for piece in made:
        for quarters, mirrored in piece.placed:
            for (x, y), kind in sites(piece.lattice).items():
                turned = complex(x, -y if mirrored else y) * 1j**quarters
                placed.append(((round(turned.real), round(turned.imag)), kind))
    assert len(placed) == len(dict(placed))  # none twice
    assert dict(placed) == sites(whole)
    stored = sum(len(sites(piece.lattice)) for piece in made)
    assert stored <= (count + 2) ** 2 / 8 + 1  # an eighth, and what lies on its borders


def test_what_is_moved_or_turned_or_mirrored_into_something_else_is_no_such_lens():
    good = lens(8)
    assert not symmetry.is_square_symmetric(lens(8, x0=good.x0 + 430))
    assert not symmetry.is_square_symmetric(
        PillarLattice.of("LENS", good.whole(), pitch=430, x0=good.x0, y0=good.y0 - 430)
    )
    for change in (
        (0, 1),
        (1, 0),
        (2, 5),
        (5, 2),
    ):  # one pillar and its mirror images at both axes, not at diagonals
        classes = good.whole().copy()
        y, x = change
        for row in (y, 7 - y):
            for column in (x, 7 - x):
                classes[row, column] = 9
        moved = PillarLattice.of("LENS", classes, pitch=430, x0=good.x0, y0=good.y0)
        assert symmetry.is_square_symmetric(moved) is (x == y or 7 - y == x)
    for half in (np.s_[:4], np.s_[:, :4]):  # other above than below, or left than right
        classes = good.whole().copy()
        classes[half] = 0
        assert not symmetry.is_square_symmetric(
            PillarLattice.of("LENS", classes, pitch=430, x0=good.x0, y0=good.y0)
        )
