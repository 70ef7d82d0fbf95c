"""The lens that the simulator predicts, site by site: pillars of its layers, on its
lattice, the lowest row first.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.certify.made_lens import MadeRows
from layout.mask.plan import Lattice, MaskPlan, PillarClass
from metalens.cell import Cell
from metalens.ground.errors import ProcessError
from metalens.lens import DiameterMap, Lens
from metalens.pillars import Proxy

ROWS, COLUMNS, PITCH, X0, Y0 = 4, 6, 205, -512, 301  # units of 2 nm: 0.41 um
DRAW = np.random.default_rng(37)
MADE_NM = np.where(
    DRAW.uniform(size=(ROWS, COLUMNS)) > 0.25,
    DRAW.uniform(110, 330, (ROWS, COLUMNS)),
    0.0,
)
PILLAR, OTHER, DOSE_TEST, WITNESS = 7, 9, 5, 6  # layer numbers


def plan():
    outline = np.array([[-50, -50], [50, -50], [50, 50], [-50, 50]])
    kinds = (
        ("D1", (PILLAR, 0)),
        ("D2", (OTHER, 3)),
        ("T1", (DOSE_TEST, 0)),
        ("W1", (WITNESS, 0)),
    )
    classes = tuple(
        PillarClass(name, 200.0, 100, layer, outline) for name, layer in kinds
    )
    lattice = Lattice.of(
        "LENS", np.ones((ROWS, COLUMNS), np.uint8), pitch=PITCH, x0=X0, y0=Y0
    )
    return MaskPlan("TOP", classes, (lattice,), unit_nm=2.0)


def written(off=(0.0, 0.0)):
    """(x, y) in um and diameters of the pillars of ``MADE_NM``, the last row highest;
    ``off`` in pitches.
    """
    row, column = np.nonzero(MADE_NM)
    x, y = X0 + column * PITCH, Y0 - (ROWS - 1 - row) * PITCH
    return (
        (x + off[0] * PITCH) * 2e-3,
        (y + off[1] * PITCH) * 2e-3,
        MADE_NM[row, column],
    )


def designed():
    proxy = Proxy(
        np.array([[1.3]]), np.array([[0.9]]), (0.1, 0.35), (0.85, 0.85), 0.0, 0.0
    )
    return Lens(
        DiameterMap(np.full((ROWS, COLUMNS), 0.2), 0.41),
        Cell(0.41),
        proxy,
        0.85,
        400.0,
        900.0,
        "map",
    )


def filled(rows, layer=PILLAR, off=(0.0, 0.0)):
    x, y, made = written(off)
    rows.place(x, y, made, np.full(len(x), layer, np.int64))
    return rows


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.009, -0.009)])
def test_every_pillar_stands_on_its_site(off):
    rows = MadeRows(plan())
    x, y, made = written(off)
    half = len(x) // 2  # band by band, pillars of two layer numbers
    rows.take(
        SimpleNamespace(x_um=x[:half], y_um=y[:half], made_nm=made[:half]),
        np.full(half, PILLAR),
    )
    rows.take(
        SimpleNamespace(x_um=x[half:], y_um=y[half:], made_nm=made[half:]),
        np.full(len(x) - half, OTHER),
    )
    found = rows.lens(designed())
    assert found.diameters.diameter_um == pytest.approx(MADE_NM * 1e-3, rel=1e-6)
    assert (found.profile, found.diameters.pitch_um) == ("as-written", 0.41)


@pytest.mark.parametrize("layer", [DOSE_TEST, WITNESS, 4])
def test_what_is_no_pillar_of_the_lens_is_left_out(layer):
    rows = filled(MadeRows(plan()))
    rows.place(np.array([0.0]), np.array([17.0]), np.array([250.0]), np.array([layer]))
    filled(rows, layer, (3.0, 0.2))
    assert rows.lens(designed()).diameters.diameter_um == pytest.approx(
        MADE_NM * 1e-3, rel=1e-6
    )


@pytest.mark.parametrize(
    ("row", "column"),
    [(1, 2.011), (1, 1.989), (2.011, 3), (1.989, 3), (-1, 2), (4, 2), (1, -1), (1, 6)],
)
def test_a_pillar_off_the_lattice_is_refused(row, column):
    rows = MadeRows(plan())
    x, y = (X0 + column * PITCH) * 2e-3, (Y0 - (ROWS - 1 - row) * PITCH) * 2e-3
    with pytest.raises(ProcessError, match="do not stand on the lattice"):
        rows.place(np.array([x]), np.array([y]), np.array([200.0]), np.array([PILLAR]))


@pytest.mark.parametrize(("made_nm", "refused"), [(409.0, False), (411.0, True)])
def test_a_pillar_as_wide_as_the_pitch_is_refused(made_nm, refused):
    rows = MadeRows(plan())
    rows.place(
        np.array([X0 * 2e-3]),
        np.array([Y0 * 2e-3]),
        np.array([made_nm]),
        np.array([PILLAR]),
    )
    if refused:
        with pytest.raises(ProcessError, match=r"0\.411 um wide"):
            rows.lens(designed())
    else:
        made = rows.lens(designed()).diameters.diameter_um
        assert made[ROWS - 1, 0] == pytest.approx(0.409)
        assert np.count_nonzero(made) == 1
