"""Maps on other lattices, and of turned pillars: sites against the lattice written out,
and through a file.
"""

import math

import numpy as np
import pytest

from metalens import lens as lenses
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import Rectangle
from metalens.core.errors import LensError
from metalens.lens import DiameterMap, Lens, export
from tests.proxies import proxy_of

PROXY = proxy_of([3.0, 3.0], [0.93], (0.08, 0.32), 0.94, 0.01)
PITCH = 0.37


def hexagonal(rows=7, columns=11, row_um=0.32):
    d = np.random.default_rng(3).uniform(0.1, 0.3, (rows, columns))
    d[(np.arange(rows)[:, None] + np.arange(columns)) % 2 == 1] = 0
    return DiameterMap(d, PITCH, Lattice("hexagonal"), row_um)


def test_sites_of_a_hexagonal_map_are_those_of_the_lattice():
    made = hexagonal(row_um=0.0)
    rows, columns = np.nonzero(made.diameter_um)
    found = made.x_um[columns] + 1j * made.y_um[rows]
    a, b = PITCH, PITCH * np.exp(1j * np.pi / 3)
    # every site is a whole number of lattice vectors from the first
    steps = np.linalg.solve(
        [[a.real, b.real], [a.imag, b.imag]], np.stack([found.real, found.imag])
    )
    away = steps - steps[:, :1]
    assert abs(away - np.rint(away)).max() < 1e-12
    assert made.site_um2 == pytest.approx(PITCH**2 * math.sqrt(3) / 2)
    assert len(found) == 39  # of 77 places
    nearest = np.sort(abs(found - found[len(found) // 2]))[1:7]
    assert nearest == pytest.approx(6 * [PITCH])


def test_rows_may_lie_on_the_grid_of_a_mask_but_not_elsewhere():
    assert hexagonal(row_um=0.32).steps_um == (PITCH / 2, 0.32)
    with pytest.raises(LensError, match="within 10 %"):
        hexagonal(row_um=0.37)


def test_a_pillar_between_the_sites_and_turns_that_do_not_fit_are_refused():
    d = hexagonal().diameter_um.copy()
    d[3, 4] = 0.2
    with pytest.raises(LensError, match="row \\+ column is odd"):
        DiameterMap(d, PITCH, Lattice("hexagonal"))
    with pytest.raises(LensError, match="angle_rad"):
        DiameterMap(np.full((3, 4), 0.2), PITCH, angle_rad=np.zeros((4, 3)))


def turned(hand="left"):
    rng = np.random.default_rng(8)
    d = np.where(rng.random((6, 9)) < 0.8, 0.21, 0.0)
    angle = rng.uniform(0, np.pi, (6, 9))
    cell = Cell(PITCH, shape=Rectangle(0.6))
    return Lens(
        DiameterMap(d, PITCH, angle_rad=angle),
        cell,
        PROXY,
        0.94,
        77.0,
        math.inf,
        "hyperbolic",
        hand=hand,
    )


def test_turned_pillars_need_a_hand_and_others_have_none():
    with pytest.raises(LensError, match="hand"):
        turned("")
    with pytest.raises(LensError, match="hand"):
        Lens(
            hexagonal(),
            Cell(PITCH),
            PROXY,
            0.94,
            77.0,
            math.inf,
            "hyperbolic",
            hand="left",
        )


@pytest.mark.parametrize(
    "made",
    [turned(), Lens(hexagonal(), Cell(PITCH), PROXY, 0.94, 77.0, math.inf, "cubic")],
)
def test_a_file_keeps_lattice_turns_and_hand(tmp_path, made):
    lenses.save(tmp_path / "lens.h5", made)
    read = lenses.load(tmp_path / "lens.h5")
    assert (read.diameters.lattice, read.diameters.steps_um) == (
        made.diameters.lattice,
        made.diameters.steps_um,
    )
    assert (read.hand, read.cell, read.diameters.site_um2) == (
        made.hand,
        made.cell,
        made.diameters.site_um2,
    )
    assert np.array_equal(read.phase_rad(), made.phase_rad())
    with pytest.raises(LensError, match="square lattice"):
        lenses.load_plain(tmp_path / "lens.h5")
    export.export_lens(tmp_path / "lens.npz", read)
    told = np.load(tmp_path / "lens.npz")
    assert ("angle_rad" in told) == bool(made.hand)
    assert np.allclose(np.exp(1j * told["phase_rad"]), np.exp(1j * made.phase_rad()))
    if not made.hand:
        with pytest.raises(LensError, match="hexagonal"):
            export.export_lens(tmp_path / "lens.dat", read)
