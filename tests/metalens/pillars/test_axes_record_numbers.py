"""A library over two sizes as a record: which entries are usable, which wavelength is
held, what is refused.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Circle, Ellipse, Rectangle
from metalens.ground.errors import CellError, ConfigError, DomainError
from metalens.pillars import Sweep
from metalens.pillars.axes import record
from metalens.pillars.axes.record import AxesLibrary

CELL = Cell(0.35, 0.4, Index(1.7), substrate=Index(1.45), shape=Rectangle())
SETTINGS = Sweep(
    (0.7, 0.83),
    diameters_um=(0.1, 0.2),
    lengths_um=(0.12, 0.27),
    samples=30,
    tolerance=0.02,
)
X, Y = np.array([0.1, 0.15, 0.2]), np.array([0.12, 0.17, 0.22, 0.27])


def library(**other):
    t = np.arange(96.0).reshape(2, 3, 4, 2, 2) * (0.01 + 0.002j)
    error = 0.019 + 0.0005 * np.arange(24.0).reshape(2, 3, 4)
    held = np.array(
        [
            [0, 0.12, 0.2, 0.03, 0.02],
            [1, 0.13, 0.2, 0.01, 0.02],
            [0, 0.13, 0.2, 0.05, 0.02],
            [1, 0.14, 0.2, 0.02, 0.02],
        ]
    )
    made = AxesLibrary(
        CELL, SETTINGS, np.array([0.7, 0.83]), X, Y, t, error, held, 77, 9
    )
    return dataclasses.replace(made, **other)


def test_entries_are_usable_up_to_the_tolerance_and_held_out_pairs_miss_above_their_bar():
    """Bars of 0.019, 0.0195, 0.02, 0.0205 ...: the first three are within 0.02."""
    error = np.full((2, 3, 4), 0.03)
    error[1, 0, 3], error[0, 2, 1], error[0, 1, 1] = 0.019, 0.02, 0.0201
    usable = library(t_error=error).usable
    assert np.argwhere(usable).tolist() == [[0, 2, 1], [1, 0, 3]]
    assert library().missed == 2  # 0.03 and 0.05 of 0.02; one on its bar has not
    plain = dataclasses.replace(SETTINGS, tolerance=None)  # that of round pillars, 1e-3
    assert library(sweep=plain, t_error=error / 20).usable.sum() == 2


def test_a_wavelength_is_held_to_a_billionth():
    assert [library().at(w) for w in (0.7, 0.83, 0.83 + 0.9e-9, 0.7 - 0.9e-9)] == [
        0,
        1,
        1,
        0,
    ]
    for wave in (0.83 + 1.2e-9, 0.7 - 1.2e-9, 0.77):
        with pytest.raises(DomainError, match=r"holds 0\.7, 0\.83 um"):
            library().at(wave)


def test_arrays_that_do_not_fit_or_are_not_finite_are_refused():
    one = library()
    wrong = (
        one.t[:1],
        one.t[:, :2],
        one.t[:, :, :3],
        one.t[..., :1],
        one.t.swapaxes(1, 2),
    )
    for t in wrong:
        with pytest.raises(DomainError, match="2 x 2"):
            library(t=t)
    with pytest.raises(DomainError, match="2 x 2"):
        library(t_error=one.t_error[:, :, :3])
    for name in ("t", "t_error"):
        spoilt = np.array(getattr(one, name))
        spoilt.flat[5] = np.nan
        with pytest.raises(DomainError, match=f"library {name} holds"):
            library(**{name: spoilt})


def test_the_ratio_of_a_pillar_is_its_second_size_over_the_first():
    for shape in (Rectangle(), Ellipse()):
        made = record.sized(dataclasses.replace(CELL, shape=shape), 0.15, 0.24)
        assert made.shape == dataclasses.replace(shape, ratio=0.24 / 0.15)
    with pytest.raises(CellError, match="circle has one size"):
        record.sized(dataclasses.replace(CELL, shape=Circle()), 0.15, 0.24)


def test_a_sweep_is_refused_where_a_pair_of_its_ends_cannot_be():
    record.check(CELL, SETTINGS)
    thin = dataclasses.replace(CELL, pitch_um=0.41)
    with pytest.raises(
        CellError, match=r"0\.36 by 0\.27 um touches|0\.36 by 0\.12 um touches"
    ):
        record.check(CELL, dataclasses.replace(SETTINGS, diameters_um=(0.1, 0.36)))
    with pytest.raises(CellError, match=r"by 0\.35 um touches"):
        record.check(
            CELL, dataclasses.replace(SETTINGS, lengths_um=(0.12, 0.35))
        )  # 0 between two of them
    with pytest.raises(CellError, match="both sizes are swept"):
        record.check(dataclasses.replace(CELL, shape=Rectangle(0.7)), SETTINGS)
    assert record.ranges(SETTINGS) == ((0.1, 0.2), (0.12, 0.27))
    with pytest.raises(ConfigError, match="needs diameters_um"):
        record.check(CELL, Sweep((0.7,)))
    record.check(
        thin,
        dataclasses.replace(
            SETTINGS, diameters_um=(0.004, 0.2), lengths_um=(0.01, 0.39)
        ),
    )
    for x, y in (
        ((0.0038, 0.2), (0.01, 0.39)),
        ((0.01, 0.39), (0.0038, 0.2)),
    ):  # 97.5 times, and 102.6
        with pytest.raises(CellError, match="factor of 100"):
            record.check(
                thin, dataclasses.replace(SETTINGS, diameters_um=x, lengths_um=y)
            )


@pytest.mark.parametrize(
    ("kind", "lengths", "angle", "same"),
    [
        ("square", (0.1, 0.2), 0.0, True),
        ("square", (0.1, 0.2), math.pi / 2, True),
        ("square", (0.1, 0.2), math.pi, True),
        ("square", (0.1, 0.2), math.pi / 4, False),
        ("square", (0.1, 0.2), 0.1, False),
        ("square", (0.1, 0.21), 0.0, False),
        ("rectangular", (0.1, 0.2), 0.0, False),
    ],
)
def test_sizes_exchange_on_a_square_lattice_without_a_turn(kind, lengths, angle, same):
    lattice = Lattice(kind, 1.1) if kind == "rectangular" else Lattice(kind)
    cell = dataclasses.replace(CELL, lattice=lattice, shape=Rectangle(1.0, angle))
    assert record.swaps(cell, dataclasses.replace(SETTINGS, lengths_um=lengths)) is same


def test_a_library_comes_back_from_its_file(tmp_path):
    record.save(tmp_path / "a.h5", library())
    back = record.load(tmp_path / "a.h5")
    for name in ("wavelength_um", "x_um", "y_um", "t", "t_error", "held_out"):
        assert np.array_equal(getattr(back, name), getattr(library(), name))
    assert (back.cell, back.sweep, back.solves, back.harmonics) == (
        CELL,
        SETTINGS,
        77,
        9,
    )
