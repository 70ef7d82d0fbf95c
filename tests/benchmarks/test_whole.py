"""The referee of whole lenses: a uniform square is one cell, a square of equal rows is
a row, energy stays.
"""

import numpy as np
import pytest

from benchmarks import _whole
from metalens.cell import Cell
from metalens.design.neighbours import solve_row

CELL = Cell(0.32, 0.8, "TiO2", "SiO2", "air")
WAVELENGTH_UM = 0.532
ROW_UM = (0.12, 0.2, 0.12)
# the row keeps the imaginary part of TiO2, 1.3e-7, over some 10 rad; the square leaves
# it out
ROUNDING = 1e-6


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_uniform_square_is_one_cell(count: int) -> None:
    light = _whole.solve(
        CELL, np.full((count, count), 0.15), WAVELENGTH_UM, harmonics=2
    )
    axis = int(np.flatnonzero((light.sx == 0) & (light.sy == 0))[0])
    alone = solve_row(CELL, [0.15], WAVELENGTH_UM, polarization="x", harmonics=2).order(
        0
    )
    assert abs(light.ex[axis] - alone) < 5 * ROUNDING
    assert np.abs(np.delete(light.ex, axis)).max(initial=0) < 1e-9
    assert light.energy == pytest.approx(1, abs=1e-10)


@pytest.mark.parametrize(("along", "polarization"), [(0, "x"), (1, "y")])
def test_equal_rows_are_a_row(along: int, polarization: str) -> None:
    sizes = np.repeat(np.expand_dims(ROW_UM, 1 - along), 3, 1 - along)
    light = _whole.solve(CELL, sizes, WAVELENGTH_UM, harmonics=2)
    row = solve_row(CELL, ROW_UM, WAVELENGTH_UM, polarization=polarization, harmonics=2)  # type: ignore[arg-type]
    sines = (light.sx, light.sy)
    straight = np.abs(sines[1 - along]) < 1e-12
    orders = np.rint(sines[along][straight] * 3 * CELL.pitch_um / WAVELENGTH_UM).astype(
        int
    )
    expected = np.array([row.order(int(m)) for m in orders])
    assert len(orders) == 3
    np.testing.assert_allclose(light.ex[straight], expected, atol=5 * ROUNDING)


def test_a_square_is_the_same_from_both_sides() -> None:
    """Three different pillars a side, mirrored: power adds up, and the light keeps the
    mirrors of the square.
    """
    sizes = np.array([[0.1, 0.18, 0.1], [0.14, 0.22, 0.14], [0.1, 0.18, 0.1]])
    light = _whole.solve(CELL, sizes, WAVELENGTH_UM, harmonics=2)
    assert light.energy == pytest.approx(1, abs=1e-10)
    power = np.abs(light.ex) ** 2 + np.abs(light.ey) ** 2
    mirrored = {
        (round(x, 9), round(y, 9)): p
        for x, y, p in zip(light.sx, light.sy, power, strict=True)
    }
    for (x, y), p in mirrored.items():
        assert mirrored[(-x, y)] == pytest.approx(p, rel=1e-9)
        assert mirrored[(x, -y)] == pytest.approx(p, rel=1e-9)


def test_sizes_without_mirrors_are_refused() -> None:
    with pytest.raises(ValueError, match="mirrored in x and y"):
        _whole.solve(CELL, np.array([[0.1, 0.2], [0.2, 0.2]]), WAVELENGTH_UM)
