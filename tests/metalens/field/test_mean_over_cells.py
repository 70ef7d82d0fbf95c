"""The mean of cells over a node by Lanczos's kernel of two lobes, its formula typed
here.
"""

import math

import pytest
import torch

from metalens.field import waves


def kernel(away, width):
    """sinc(x) sinc(x / 2) of x = away / width, 0 from two widths on."""
    x = away / width
    if abs(x) >= 2:
        return 0.0
    return (
        1.0
        if x == 0
        else 2 * math.sin(math.pi * x) * math.sin(math.pi * x / 2) / (math.pi * x) ** 2
    )


@pytest.mark.parametrize("width", [1.7, 2.5])
def test_one_bright_cell_spreads_over_two_widths_of_a_node(width):
    cells = (
        torch.tensor([1.0, -0.3], dtype=torch.float64)[:, None, None]
        .expand(2, 21, 23)
        .clone()
    )
    cells[0, 9, 12] += 0.7
    got = waves._over(cells, width)
    row = {away: kernel(away, width) for away in range(-12, 13)}
    whole = sum(row.values())
    for y, x in ((9, 12), (9, 14), (11, 11), (8, 9), (12, 12), (9, 7), (4, 12)):
        want = 1 + 0.7 * row[y - 9] * row[x - 12] / whole**2
        assert float(got[0, y, x]) == pytest.approx(want, abs=1e-12), (y, x)
    assert got[1].numpy() == pytest.approx(
        -0.3, abs=1e-12
    )  # what is even stays so, out to the rims of the pillars


def test_cells_without_pillars_count_for_nothing():
    """Of waves that no node can tell, a part of the lens alone has the mean of its own
    cells.
    """
    cells = torch.zeros(2, 15, 17, dtype=torch.float64)
    cells[:, 4:, :9] = torch.tensor([0.8, 0.4], dtype=torch.float64)[:, None, None]
    got = waves._over(cells, 2.0)
    assert got[0, 5:, :8].numpy() == pytest.approx(0.8, abs=1e-12)
    assert got[1, 5:, :8].numpy() == pytest.approx(0.4, abs=1e-12)
    assert waves._over(cells, 1.0) is cells
