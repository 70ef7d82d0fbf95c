"""Cells of straight edges, layers, films and lattices against another Fourier method,
both lights and all of Jones.
"""

import pytest

from metalens import rcwa
from metalens.cell import Cell, Film, Index, Lattice, Layer
from metalens.cell.shapes import Polygon, Rectangle, Square
from tests.referees import boxes as referee

AIR = Index(1.0)
HOOK = Polygon(
    ((-0.5, -0.5), (0.5, -0.5), (0.5, -0.1), (-0.1, -0.1), (-0.1, 0.4), (-0.5, 0.4))
)  # no mirror at all


def hook():
    s = 0.25
    parts = (
        (-s / 2, s / 2, -s / 2, -0.1 * s, 2.35),
        (-s / 2, -0.1 * s, -0.1 * s, 0.4 * s, 2.35),
    )
    made = referee.boxes(0.71, (0.34, 0.34), 1.0, *parts)
    cell = Cell(0.34, 0.71, Index(2.35), Index(1.77), AIR, AIR, shape=HOOK)
    return cell, s, 0.633, [made], (0.34, 0.34)


def layered():
    """Pedestal, coated body that absorbs, residual mask; films under and over it;
    another medium between.
    """
    parts = (
        Layer(0.05, 0.05, Index(1.46)),
        Layer(0.55, coat_um=0.015, coat=Index(1.75)),
        Layer(0.06, -0.02, Index(1.5, 0.01)),
    )
    films = {
        "under": (Film(Index(1.9), 0.07), Film(Index(1.38), 0.03)),
        "over": (Film(Index(1.41), 0.11),),
    }
    cell = Cell(
        0.35,
        0.66,
        Index(3.2, 0.004),
        Index(1.52),
        AIR,
        Index(1.33),
        shape=Square(),
        layers=parts,
        **films,
    )

    def box(width, index):
        return (-width / 2, width / 2, -width / 2, width / 2, index)

    body = box(0.20, 1.75), box(0.17, 3.2 + 0.004j)
    made = [
        (0.07, 1.9),
        (0.03, 1.38),
        referee.boxes(0.05, (0.35, 0.35), 1.33, box(0.22, 1.46)),
        referee.boxes(0.55, (0.35, 0.35), 1.33, *body),
        referee.boxes(0.06, (0.35, 0.35), 1.33, box(0.15, 1.5 + 0.01j)),
        (0.11, 1.41),
    ]
    return cell, 0.17, 0.85, made, (0.35, 0.35)


def hexagonal():
    """Two rectangles in the rectangle of the lattice, one of them cut at its corners."""
    p, wide, deep = 0.38, 0.24, 0.6 * 0.24
    periods = (p, 3**0.5 * p)
    centres = [(0.0, 0.0)] + [
        (i * p / 2, j * periods[1] / 2) for i in (-1, 1) for j in (-1, 1)
    ]
    parts = [
        (x - wide / 2, x + wide / 2, y - deep / 2, y + deep / 2, 2.9)
        for x, y in centres
    ]
    lattice = Lattice("hexagonal")
    cell = Cell(
        p,
        0.6,
        Index(2.9),
        Index(1.45),
        AIR,
        AIR,
        shape=Rectangle(ratio=0.6),
        lattice=lattice,
    )
    return cell, wide, 0.94, [referee.boxes(0.6, periods, 1.0, *parts)], periods


CASES = [
    (hook, 0.0, 0.0, (6, 6)),
    (hook, 0.17, 0.9, (6, 6)),
    pytest.param(layered, 0.3, 0.35, (6, 6), marks=pytest.mark.slow),
    (hexagonal, 0.12, 0.8, (4, 7)),
]


@pytest.mark.parametrize(("case", "angle_rad", "azimuth_rad", "reach"), CASES)
def test_jones_matrices_are_those_of_another_fourier_method_within_the_bar(
    case, angle_rad, azimuth_rad, reach
):
    """The budget: our bar and what the referee still moved from a truncation lower.
    Without a mirror the bar may be
    thirty times the error at the few orders that fit into a second; it was up to eight
    hundred times."""
    cell, size, wavelength, layers, periods = case()
    about = {"angle_rad": angle_rad, "azimuth_rad": azimuth_rad}
    media = cell.substrate.n, cell.cover.n
    before, want = (
        referee.jones(
            layers,
            periods,
            wavelength,
            *media,
            reach=tuple(k - less for k in reach),
            **about,
        )
        for less in (1, 0)
    )
    moved = max(abs(a - b).max() for a, b in zip(before, want, strict=True))
    found = rcwa.jones(cell, size, wavelength, **about)
    error = max(abs(found.t - want[0]).max(), abs(found.r - want[1]).max())
    # of errors that fall as reach^-2, a third or more is left
    assert error < min(found.t_error, 0.02) + 4 * moved
    assert found.t_error < 0.12
    if case is hook:
        assert abs(want[0][0, 1]) > 0.05  # what comes as one light leaves as the other
