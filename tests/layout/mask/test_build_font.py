"""What stands around a lens on the mask: all of it, its opening alone, or nothing;
labels where they belong.
"""

import numpy as np
import pytest

from layout.mask import build, font
from layout.process.process import Process
from metalens.lens.record import DiameterMap

PROCESS = Process()


def disc():
    x = (np.arange(41) - 20) * 0.4
    d = np.random.default_rng(3).uniform(0.12, 0.28, (41, 41))
    return DiameterMap(np.where(np.hypot(x, x[:, None]) < 8.0, d, 0.0), 0.4)


def layers(furniture):
    made = build.prepare_mask(
        disc(), PROCESS, furniture=furniture, with_doses=False
    ).plan
    return {layer for figure in made.figures for layer in figure.polygons}


def test_an_opening_alone_comes_without_marks_and_nothing_without_an_opening():
    assert layers("none") == set()
    assert layers("aperture") == {PROCESS.layers.aperture}
    assert layers("die") > {PROCESS.layers.aperture, PROCESS.layers.marks}


@pytest.mark.parametrize(("x", "y"), [(30, -700), (-120, 45)])
def test_a_line_of_text_stands_where_it_is_asked_for(x, y):
    """Seven squares high from y, six wide a letter from x: "LI" is 11 wide."""
    every = np.concatenate(font.text_rectangles("LI", x=x, y=y, square=10))
    assert every.min(axis=0).tolist() == [x, y]
    assert every[:, 1].max() == y + 70
    assert x + 60 < every[:, 0].max() <= x + 110
    home = np.concatenate(font.text_rectangles("LI", x=0, y=0, square=10))
    assert np.array_equal(every - [x, y], home)


def test_squares_of_a_letter_meet_along_edges_and_none_lies_on_another():
    """On a grid of quarter squares: no two filled cells meet at a corner alone, none is
    filled twice.
    """
    words = "".join(font._GLYPHS)
    filled = np.zeros((60, 20 + 24 * len(words)), int)
    for box in font.text_rectangles(words, x=8, y=12, square=4):
        (left, bottom), (right, top) = box.min(0), box.max(0)
        filled[bottom:top, left:right] += 1
    assert filled.max() == 1
    a, b, c, d = filled[1:, :-1], filled[1:, 1:], filled[:-1, :-1], filled[:-1, 1:]
    assert not np.any((a == d) & (b == c) & (a != b))
    squares = sum(int(rows, 16).bit_count() for rows in font._GLYPHS.values())
    assert filled.sum() > 16 * squares  # and no square of a letter is lost
