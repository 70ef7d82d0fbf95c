"""Predicted pillars on the sites of a map: the lowest row first, nanometres to
micrometres, nothing off its site.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from layout.certify.made_lens import MadeRows
from layout.mask import Lattice
from metalens.cell.record import Cell
from metalens.ground.errors import ProcessError
from metalens.lens.record import DiameterMap, Lens
from metalens.pillars.proxy import Proxy

PROXY = Proxy(
    np.array([[3.3, 3.3, 0.2]]),
    np.array([[0.9, 0.05]]),
    (0.1, 0.3),
    (0.85, 0.85),
    0.0,
    0.0,
)
PITCH, DOWN = 0.41 * 2, 0.3 * 2  # um, of units of 2 nm


def rows():
    """Three rows of four, the first (topmost) at y = 2.018 um; lens pillars on layers 1
    and 9, tests on 5 and 6.
    """
    lattice = Lattice(
        "LENS",
        3,
        4,
        410,
        -7,
        1009,
        lambda a, b: np.ones((b - a, 4), np.uint8),
        row_pitch=300,
    )
    layers = {"D101": (1, 0), "D102": (9, 3), "T001": (5, 0), "W002": (6, 0)}
    classes = [
        SimpleNamespace(name=name, layer=layer) for name, layer in layers.items()
    ]
    return MadeRows(SimpleNamespace(lattices=[lattice], unit_nm=2.0, classes=classes))


def placed(made, column, row, size_nm, layer=1):
    """At (fractional) sites, rows from the top."""
    column, row, size = (
        np.atleast_1d(np.array(v, float)) for v in (column, row, size_nm)
    )
    made.place(
        -0.014 + PITCH * column,
        2.018 - DOWN * row,
        size,
        np.broadcast_to(layer, size.shape).astype(np.uint16),
    )
    return made


def test_diameters_stand_on_their_sites_the_lowest_row_first():
    made = placed(rows(), [0, 3, 2], [0, 0, 2], [123.4, 201.7, 150.2], [1, 9, 1])
    want = np.zeros((3, 4), np.float32)
    want[2, 0], want[2, 3], want[0, 2] = 0.1234, 0.2017, 0.1502
    assert made._diameter_um == pytest.approx(want, rel=1e-6)  # float32
    band = SimpleNamespace(
        x_um=np.array([-0.014 + PITCH]),
        y_um=np.array([2.018 - DOWN]),
        made_nm=np.array([99.0]),
    )
    made.take(band, np.array([9], np.uint16))
    assert made._diameter_um[1, 1] == pytest.approx(0.099, rel=1e-6)


def test_test_structures_are_passed_over_wherever_they_stand():
    made = placed(rows(), [0.5, -7, 1], [0.3, 90, 1], [100.0] * 3, [5, 6, 7])
    assert not made._diameter_um.any()


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_pillar_may_stand_off_its_site_by_a_hundredth_of_a_pitch(sign):
    made = placed(
        rows(), [2 + 0.0099 * sign, 1], [1, 1 + 0.0099 * sign], [100.0, 110.0]
    )
    assert made._diameter_um[1, 1:3] == pytest.approx([0.11, 0.1], rel=1e-6)
    for column, row in ((2 + 0.0101 * sign, 1), (2, 1 + 0.0101 * sign)):
        with pytest.raises(ProcessError, match="do not stand on the lattice"):
            placed(rows(), column, row, 100.0)


@pytest.mark.parametrize(("column", "row"), [(-1, 1), (4, 1), (2, -1), (2, 3)])
def test_a_pillar_beyond_the_lattice_is_refused(column, row):
    with pytest.raises(ProcessError, match="do not stand on the lattice"):
        placed(rows(), column, row, 100.0)
    placed(rows(), [0, 3, 2, 2], [1, 1, 0, 2], [100.0] * 4)


def designed(**more):
    sizes = np.array(
        [[0.2, 0.25, 0.0, 0.3], [0.22, 0.0, 0.27, 0.21], [0.2, 0.2, 0.2, 0.2]]
    )
    return Lens(
        DiameterMap(sizes, 0.82, **more),
        Cell(0.82),
        PROXY,
        0.85,
        200.0,
        2000.0,
        "hyperbolic",
    )


def test_the_predicted_lens_is_the_designed_one_with_its_sizes():
    made = placed(rows(), [0, 1, 2], [2, 2, 1], [210.0, 240.0, 819.0])
    found = made.lens(designed())
    assert found.profile == "as-written"
    assert found.diameters.diameter_um[0].tolist() == pytest.approx(
        [0.21, 0.24, 0, 0], rel=1e-6
    )
    assert found.diameters.length_um is None
    assert found.diameters.pitch_um == 0.82
    wide = placed(rows(), [0], [2], [820.1])
    with pytest.raises(
        ProcessError, match=r"predicted 0\.820 um wide, as wide as the pitch"
    ):
        wide.lens(designed())


@dataclasses.dataclass(frozen=True)
class Designed:
    """Of a lens the sizes alone: one of two sizes needs a table of pillars, which
    nothing here reads.
    """

    diameters: DiameterMap
    profile: str = "hyperbolic"


def test_the_length_of_a_pillar_moves_by_as_much_as_its_width():
    """0.25 um becomes 0.24: a length of 0.31 becomes 0.30; where nothing is predicted
    it is 0.
    """
    base = designed().diameters
    some = Designed(
        dataclasses.replace(base, length_um=np.where(base.diameter_um > 0, 0.31, 0.0))
    )
    found = placed(rows(), [1, 3], [2, 2], [240.0, 325.0]).lens(some)
    assert found.diameters.length_um[0] == pytest.approx([0, 0.30, 0, 0.335], rel=1e-6)
    assert found.diameters.length_um.dtype == np.float32
