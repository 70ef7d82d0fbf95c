"""Rows of unlike neighbours as a record: their factor by hand, in every azimuth, and as
part of a lens file.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from metalens import lens as lenses
from metalens.cell import Cell, Index
from metalens.core.errors import LensError
from metalens.lens import DiameterMap, Lens, NeighbourRows
from tests.proxies import proxy_of

SINE = np.array([0.5, 0.25, 0.6, 0.35])
ASIDE = np.array([False, False, True, True])
COVER = 1.3
A = np.array([[0.2 - 0.3j, 0.1j], [0.05 - 0.2j, -0.1]])
B = np.array([[-0.4, 0.3], [-0.2j, 0.1 + 0.2j]])
# (along the lattice and its diagonal, field along and across the slope)


def power(sine, aside, field):
    """The factor on amplitudes whose squares are power."""
    return 1 + A[aside, field] * sine + B[aside, field] * sine**2


def rows(**more):
    """Rows whose tangential fields are such that their power follows A and B."""
    given = list(zip(SINE, ASIDE, np.sqrt(1 - (SINE / COVER) ** 2), strict=True))
    factor = np.array(
        [
            [power(s, int(d), field) * c ** (0.5 - field) for s, d, c in given]
            for field in (0, 1)
        ]
    )
    about = dict(
        sine=SINE,
        diagonal=ASIDE,
        factor=factor,
        coarse=0.9 * factor,
        scatter=np.array([0.1, 0.2, 0.3, 0.4]),
    )
    return NeighbourRows(**(about | dict(wavelength_um=0.532, cover=COVER) | more))


def test_the_factor_goes_through_the_rows_of_both_fields_and_azimuths():
    made = rows()
    for field in (0, 1):
        assert made.at(np.array([0.31]), 0.0)[field] == pytest.approx(
            power(0.31, 0, field), rel=1e-12
        )
        assert made.at(np.array([0.31]), 3 * math.pi / 4)[field] == pytest.approx(
            power(0.31, 1, field), rel=1e-12
        )
        # sin² 2α of 30 degrees
        third = 0.25 * power(0.31, 0, field) + 0.75 * power(0.31, 1, field)
        assert made.at(np.array(0.31), math.radians(-60))[field] == pytest.approx(
            third, rel=1e-12
        )
    assert made.at(np.zeros(2)) == pytest.approx(np.ones((2, 2)))
    azimuths = (np.arange(16) + 0.3) * math.pi / 8
    mean = made.at(np.full(16, 0.4), azimuths).mean()
    assert made.mean(np.array([0.4]))[0] == pytest.approx(mean, rel=1e-12)
    # no row is steeper
    assert made.at(np.array([0.9]), 0.7) == pytest.approx(made.at(np.array([0.5]), 0.7))
    # along the diagonal rows end before: what C differs by
    flat = replace(made, sine=np.array([0.5, 0.25, 0.3, 0.2]))
    held = (
        flat.at(np.array(0.45), 0.0)
        + flat.at(np.array(0.3), math.pi / 4)
        - flat.at(np.array(0.3), 0.0)
    )
    assert flat.at(np.array(0.45), math.pi / 4) == pytest.approx(held, rel=1e-12)
    assert flat.steepest == (0.5, 0.3)


def test_a_lens_file_carries_its_rows(tmp_path):
    proxy = proxy_of([6.0, 10.0], [0.9, -0.03], (0.08, 0.32), (0.5, 0.6), 1e-6)
    cell = Cell(pitch_um=0.4, pillar=Index(3.6), substrate=Index(1.45))
    lens = Lens(
        DiameterMap(np.full((3, 4), 0.21), 0.4), cell, proxy, 0.532, 240.0, 6e3, "map"
    )
    lenses.save(tmp_path / "plain.h5", lens)
    assert lenses.load(tmp_path / "plain.h5").neighbours is None
    lenses.save(tmp_path / "lens.h5", replace(lens, neighbours=rows()))
    back = lenses.load(tmp_path / "lens.h5").neighbours
    assert (back.wavelength_um, back.cover, back.diagonal.dtype) == (0.532, COVER, bool)
    for name in ("sine", "diagonal", "factor", "coarse", "scatter"):
        assert np.array_equal(getattr(back, name), getattr(rows(), name))


@pytest.mark.parametrize(
    "more",
    [
        dict(coarse=np.ones((2, 3))),
        dict(diagonal=np.ones(4, bool)),
        dict(sine=np.array([0.5, 0.25, 0.0, 0.35])),
    ],
    ids=["shapes", "only diagonal", "no slope"],
)
def test_rows_that_tell_nothing_are_refused(more):
    with pytest.raises(LensError, match="rows of non-identical pillars"):
        rows(**more)
