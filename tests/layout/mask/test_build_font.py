"""What stands around a lens on the mask: all of it, its opening alone, or nothing; labels where they belong."""

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
    made = build.prepare(disc(), PROCESS, furniture=furniture, with_doses=False).plan
    return {layer for figure in made.figures for layer in figure.polygons}


def test_an_opening_alone_comes_without_marks_and_nothing_without_an_opening():
    assert layers("none") == set()
    assert layers("aperture") == {PROCESS.layers.aperture}
    assert layers("die") > {PROCESS.layers.aperture, PROCESS.layers.marks}


@pytest.mark.parametrize(("x", "y"), [(30, -700), (-120, 45)])
def test_a_line_of_text_stands_where_it_is_asked_for(x, y):
    """Seven squares high from y, six wide a letter from x: "LI" is 11 wide."""
    every = np.concatenate(font.text("LI", x=x, y=y, square=10))
    assert every.min(axis=0).tolist() == [x, y]
    assert every[:, 1].max() == y + 70
    assert x + 60 < every[:, 0].max() <= x + 110
    home = np.concatenate(font.text("LI", x=0, y=0, square=10))
    assert np.array_equal(every - [x, y], home)
