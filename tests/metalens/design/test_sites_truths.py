"""Sites of lattices in a round aperture, against all lattice points looked at one by
one.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.core.errors import LensError
from metalens.design import sites

PITCH, GRID_NM = 0.43, 3.0
ROW_UM = 0.372  # sqrt(3)/2 of the pitch, 0.37239, on the grid of 3 nm
LATTICES = {
    "square": Lattice(),
    "rectangular": Lattice("rectangular", 1.31),
    "hexagonal": Lattice("hexagonal"),
}


def cell(kind):
    return Cell(PITCH, 0.7, Index(2.4), Index(1.45), lattice=LATTICES[kind])


def phase(x, y):
    """Of no symmetry."""
    return (
        0.3 * x[None]
        + 0.07 * x[None] ** 2
        - 0.9 * y[:, None]
        + 0.011 * x[None] * y[:, None]
    )


def points(kind, aperture_um):
    """All points of a lattice with one at its middle (or around it, of an even count)
    that lie half a pitch inside.
    """
    reach, found = aperture_um / 2 - PITCH / 2 + 1e-9, set()
    if kind == "hexagonal":
        every = (
            (i * PITCH + (j % 2) * PITCH / 2, j * ROW_UM)
            for i in range(-60, 61)
            for j in range(-60, 61)
        )
    else:
        step = PITCH, PITCH * LATTICES[kind].ratio
        off = [(int(aperture_um / s) - 1) % 2 * s / 2 for s in step]
        every = (
            (off[0] + i * step[0], off[1] + j * step[1])
            for i in range(-60, 61)
            for j in range(-60, 61)
        )
    for x, y in every:
        if math.hypot(x, y) <= reach:
            found.add((round(x, 6), round(y, 6)))
    return found


@pytest.mark.parametrize("kind", LATTICES)
@pytest.mark.parametrize("aperture_um", [9.9, 10.4, 11.17])
@pytest.mark.parametrize("block", [40, 1 << 21])
def test_every_site_that_lies_half_a_pitch_inside_is_taken_once(
    monkeypatch, kind, aperture_um, block
):
    monkeypatch.setattr(sites, "_BLOCK_SITES", block)
    made = sites.lattice_sites(cell(kind), aperture_um, grid_nm=GRID_NM)
    steps = {
        "square": (PITCH, PITCH),
        "rectangular": (PITCH, 1.31 * PITCH),
        "hexagonal": (PITCH / 2, ROW_UM),
    }[kind]
    assert made.steps_um == pytest.approx(steps, rel=1e-12)
    x, y = (
        (np.arange(n) - (n - 1) / 2) * s
        for n, s in zip(made.shape[::-1], steps, strict=True)
    )
    found, wanted = [], []
    for rows, inside, phases in made.blocks(phase):
        row, column = np.nonzero(inside)
        found += zip(x[column], y[rows][row], strict=True)
        wanted += phases.tolist()
    assert len(found) == len(points(kind, aperture_um)) > 250
    assert {(round(float(a), 6), round(float(b), 6)) for a, b in found} == points(
        kind, aperture_um
    )
    for (a, b), value in zip(found, wanted, strict=True):
        assert value == pytest.approx(
            0.3 * a + 0.07 * a**2 - 0.9 * b + 0.011 * a * b, abs=1e-9
        )
    filled = np.zeros(made.shape)
    filled[made.shape[0] // 2, made.shape[1] // 2] = 0.2
    laid = made.map(filled)
    assert (laid.pitch_um, laid.lattice) == (PITCH, LATTICES[kind])
    assert np.diff(laid.y_um) == pytest.approx(steps[1])
    assert np.diff(laid.x_um) == pytest.approx(steps[0])


@pytest.mark.parametrize("kind", LATTICES)
def test_an_aperture_of_one_pitch_holds_one_pillar(kind):
    made = sites.lattice_sites(cell(kind), PITCH, grid_nm=GRID_NM)
    assert made.shape == (1, 1)
    ((_, inside, _),) = made.blocks(phase)
    assert inside.tolist() == [[True]]
    with pytest.raises(LensError, match="holds no cell"):
        sites.lattice_sites(cell(kind), 0.99 * PITCH, grid_nm=GRID_NM)


def test_a_phase_of_another_shape_is_refused():
    made = sites.lattice_sites(cell("square"), 5.0, grid_nm=GRID_NM)
    with pytest.raises(LensError, match="phase of shape"):
        next(iter(made.blocks(lambda x, y: x)))


@pytest.mark.parametrize(
    ("kind", "want"),
    [
        ("square", PITCH),
        ("rectangular", 1.31 * PITCH),
        ("hexagonal", math.sqrt(3) / 2 * PITCH),
    ],
)
def test_the_shortest_period_is_that_of_the_shortest_reciprocal_vector(kind, want):
    """Of all whole combinations of the reciprocal vectors of two steps of the lattice."""
    a = np.array(
        {"square": [[1, 0], [0, 1]], "rectangular": [[1, 0], [0, 1.31]]}.get(
            kind, [[1, 0], [0.5, 0.75**0.5]]
        )
    )
    back = np.linalg.inv(a * PITCH).T
    lengths = [
        math.hypot(*(i * back[0] + j * back[1]))
        for i in range(-2, 3)
        for j in range(-2, 3)
        if i or j
    ]
    assert 1 / min(lengths) == pytest.approx(want, rel=1e-12)
    assert sites.least_period_um(cell(kind)) == pytest.approx(want, rel=1e-12)
