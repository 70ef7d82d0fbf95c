"""Pieces of a symmetric lens put together again, pillar by pillar."""

import dataclasses

import numpy as np
import pytest

from layout.mask.plan import PillarLattice
from layout.mask.symmetry import is_square_symmetric, least_of_images, symmetry_pieces

PITCH = 350


def symmetric(n, seed=5):
    """(n, n) class numbers, unlike but for the eight symmetries, with empty sites."""
    values = np.random.default_rng(seed).integers(0, 200, (n, n)).astype(np.uint8)
    return least_of_images(values)


def lattice_of(values, pitch=PITCH):
    span = (values.shape[1] - 1) * pitch
    return PillarLattice.of("LENS", values, pitch=pitch, x0=-span // 2, y0=span // 2)


def places(lattice):
    """{(x, y): class} of the pillars."""
    values = lattice.whole()
    return {
        (lattice.x0 + int(c) * lattice.pitch, lattice.y0 - int(r) * lattice.pitch): int(
            values[r, c]
        )
        for r, c in np.argwhere(values)
    }


@pytest.mark.parametrize("n", [4, 5, 8, 9])
def test_pieces_turned_and_mirrored_cover_every_pillar_once(n):
    """Mirrored at the x axis first (y to -y), then turned by quarters
    counter-clockwise.
    """
    whole = lattice_of(symmetric(n))
    assert is_square_symmetric(whole)
    found, count = {}, 0
    for piece in symmetry_pieces(whole):
        for quarter, flip in piece.placed:
            for (x, y), kind in places(piece.lattice).items():
                at = x, -y if flip else y
                for _ in range(quarter):
                    at = -at[1], at[0]
                found[at] = kind
                count += 1
    assert found == places(whole)
    assert count == len(found)
    assert [piece.lattice.name[-2:] for piece in symmetry_pieces(whole)] == [
        "_8",
        "_D",
        *(["_A", "_C"] if n % 2 else []),
    ]


def test_what_is_missing_of_a_piece_is_no_piece():
    values = np.zeros((5, 5), np.uint8)
    values[2, 2] = 7
    (centre,) = symmetry_pieces(lattice_of(values))
    assert centre.placed == ((0, False),)
    assert places(centre.lattice) == {(0, 0): 7}


@pytest.mark.parametrize("at", [(0, 1), (1, 0), (0, 0), (2, 3)])
def test_one_unlike_pillar_breaks_the_symmetry(at):
    values = symmetric(6)
    values[at] += 1
    assert not is_square_symmetric(lattice_of(values))


def test_only_two_of_three_symmetries_are_not_enough():
    """Mirrored along both axes, oblong; and mirrored at the diagonal alone."""
    rows, columns = np.abs(np.indices((6, 6)) * 2 - 5)
    assert not is_square_symmetric(lattice_of((10 * rows + columns).astype(np.uint8)))
    rows, columns = np.indices((6, 6))
    assert not is_square_symmetric(lattice_of((rows * columns + 1).astype(np.uint8)))
    assert not is_square_symmetric(
        lattice_of((np.abs(2 * rows - 5) + 1 + 0 * columns).astype(np.uint8))
    )


def test_lattices_off_the_middle_small_or_of_unlike_rows_are_left_whole():
    whole = lattice_of(symmetric(6))
    assert is_square_symmetric(whole)
    assert not is_square_symmetric(dataclasses.replace(whole, x0=whole.x0 + 1))
    assert not is_square_symmetric(dataclasses.replace(whole, y0=whole.y0 + 1))
    assert not is_square_symmetric(dataclasses.replace(whole, row_pitch=PITCH + 1))
    assert not is_square_symmetric(dataclasses.replace(whole, array=None))
    assert is_square_symmetric(lattice_of(symmetric(4)))
    assert not is_square_symmetric(lattice_of(symmetric(3)))


def test_the_least_of_eight_images():
    values = np.arange(16.0).reshape(4, 4)[::-1]
    found = least_of_images(values)
    assert found == pytest.approx(
        np.array([[0, 1, 1, 0], [1, 5, 5, 1], [1, 5, 5, 1], [0, 1, 1, 0]])
    )
    assert np.array_equal(found, np.rot90(found))
