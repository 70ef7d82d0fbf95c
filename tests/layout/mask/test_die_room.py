"""What stands on a die, where and with how much room about it: sums of lengths typed
here, 10 um between structures.
"""

import re

import numpy as np
import pytest

import layout
from layout.process.process import DieSettings, ExposureSettings, Process
from metalens.cell import Lattice
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap

CLEAR_NM, PITCH_NM, RATIO = 10_000, 400, 1.3
BETWEEN_NM = 520  # of rows: 1.3 pitches


def lens_map():
    """13 rows 0.52 um apart and 15 columns of two sizes, without symmetry."""
    sizes = np.where(np.arange(195).reshape(13, 15) % 2, 0.15, 0.2)
    return DiameterMap(sizes, PITCH_NM * 1e-3, Lattice("rectangular", RATIO))


def process(**die):
    return Process(
        die=DieSettings(verniers=False, **{"size_um": (1300.0, 900.0)} | die),
        exposure=ExposureSettings(correct=False),
    )


def boxes(shapes):
    return np.array([np.r_[shape.min(0), shape.max(0)] for shape in shapes])


def drawn(plan, name, layer):
    return boxes(next(f for f in plan.figures if f.name == name).polygons[layer])


def of_sites(lattice):
    """(left, bottom, right, top) of the middles of the sites."""
    right, bottom = (
        lattice.x0 + (lattice.columns - 1) * PITCH_NM,
        lattice.y0 - (lattice.rows - 1) * BETWEEN_NM,
    )
    return np.array([lattice.x0, bottom, right, lattice.y0])


@pytest.fixture(scope="module")
def plan():
    return layout.plan(lens_map(), process())


def test_test_structures_stand_half_way_between_lens_and_street(plan):
    """Dose test left, witnesses right, about the axis to a step of the grid; pillars as
    far apart as the lens's.
    """
    windows = drawn(plan, "APERTURE", process().layers.aperture)
    aperture = windows[0]
    middle = (aperture[2] + (1300_000 / 2 - 50_000)) / 2
    assert [lattice.name for lattice in plan.lattices[1:]] == ["DOSETEST", "WITNESS"]
    for lattice, side in zip(plan.lattices[1:], (-1, 1), strict=True):
        left, bottom, right, top = of_sites(lattice)
        assert (left + right) / 2 == pytest.approx(
            side * middle, abs=3
        )  # the aperture's vertices, two halves
        assert (bottom + top) / 2 == pytest.approx(0, abs=1)
        assert lattice.down == BETWEEN_NM
        there = lattice.array > 0  # no empty rows or columns at its rims
        assert there[[0, -1]].any(1).all()
        assert there[:, [0, -1]].any(0).all()
        own = next(w for w in windows[1:] if w[0] < left < w[2])
        room = own - of_sites(
            lattice
        )  # half the film's clearance beside the cells of the outermost pillars
        assert np.abs(room) == pytest.approx(
            np.full(4, CLEAR_NM / 2 + BETWEEN_NM / 2), abs=1
        )


def test_witnesses_are_written_with_the_dose_of_the_lens(plan):
    layers = process().layers
    witnesses = [made for made in plan.classes if made.layer == layers.witness]
    assert witnesses
    assert {(made.dose, made.goal) for made in witnesses} == {(1.0, 1.0)}
    assert plan.doses[layers.witness] == 1.0


def test_the_film_opens_half_a_clearance_around_the_label(plan):
    layers = process().layers
    letters = drawn(plan, "LABEL", layers.labels)
    low, high = letters[:, :2].min(0), letters[:, 2:].max(0)
    windows = drawn(plan, "APERTURE", layers.aperture)
    (own,) = [w for w in windows if (w[:2] < low).all() and (w[2:] > high).all()]
    assert low[1] == -450_000 + 50_000 + CLEAR_NM
    assert own[1] == low[1] - CLEAR_NM / 2
    assert own[3] == high[1] + CLEAR_NM / 2
    assert high[1] - low[1] == 35_000  # the highest letters: seven squares of 5 um


@pytest.mark.parametrize(
    "words",
    [
        "THE LENS OF A LONG NAME THAT NEEDS SMALL LETTERS",
        "A LENS OF THIRTY LETTERS OR SO",
    ],
)
def test_letters_of_a_long_label_are_as_large_as_fit_between_the_crosses(words):
    """Six squares a letter, of an even number of steps; 10 um off the street, off the
    crosses by twice that.
    """
    size_um = 700.0
    made = process(size_um=(size_um, 900.0), label=words)
    letters = drawn(layout.plan(lens_map(), made), "LABEL", made.layers.labels)
    square = (letters[:, 3].max() - letters[:, 1].min()) / 7
    room = 1000 * (size_um - 2 * (50 + 10 + 100 + 20))
    assert square % 2 == 0
    assert 6 * len(words) * square <= room < 6 * len(words) * (square + 2)


def test_a_die_is_wide_enough_by_what_is_said_to_be_needed_and_not_by_less():
    """Between the aperture and the edge of the die; said in whole um."""
    about = {"mark_um": 6.0, "label": "L"}
    with pytest.raises(ProcessError, match="too small for WITNESS") as refused:
        layout.plan(lens_map(), process(size_um=(200.0, 900.0), **about))
    need = float(re.search(r"(\d+) um are needed", str(refused.value))[1])
    radius = (
        drawn(
            layout.plan(lens_map(), process()), "APERTURE", process().layers.aperture
        )[0][2]
        * 1e-3
    )
    wide = layout.plan(
        lens_map(), process(size_um=(2 * (radius + need + 0.6), 900.0), **about)
    )
    assert len(wide.lattices) == 3
    with pytest.raises(ProcessError, match="too small for"):
        layout.plan(
            lens_map(), process(size_um=(2 * (radius + need - 0.6), 900.0), **about)
        )
