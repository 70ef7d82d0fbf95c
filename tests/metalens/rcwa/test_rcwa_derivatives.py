"""Derivatives of the Jones matrix beside closed forms of films and matched media."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell, Index
from metalens.core.errors import CellError

PLAIN = Cell(0.4, 0.7, pillar=Index(3.6), substrate=Index(1.4525))
DIFFERENCES = (4 / 5, -1 / 5, 4 / 105, -1 / 280)


def slope(value, at, step):
    """Central difference of eighth order: error step^8 of the ninth derivative, and
    rounding / step.
    """
    parts = [
        w * (value(at + i * step) - value(at - i * step))
        for i, w in enumerate(DIFFERENCES, 1)
    ]
    return sum(parts) / step


def film(n, height, wavelength=0.85, below=1.4525):
    """Slab of index n between ``below`` and air: Airy's sum."""
    enter, leave = 2 * below / (below + n), 2 * n / (n + 1)
    down, up = (n - below) / (n + below), (n - 1) / (n + 1)
    phase = cmath.exp(2j * math.pi * n * height / wavelength)
    return enter * leave * phase / (1 - down * up * phase**2) / math.sqrt(below)


def derived(cell, diameter_um, *names, harmonics=3):
    """t along x, and its derivatives."""
    found = rcwa.jones_derivatives(
        cell, diameter_um, 0.85, harmonics=harmonics, by=names
    )
    return found.jones.t[0, 0], *(found.by[name].t[0, 0] for name in names)


@pytest.mark.parametrize("diameter_um", [0.02, 0.2, 0.38])
def test_degenerate_modes_of_a_homogeneous_layer(diameter_um):
    n, height = 1.7, 0.7
    cell = replace(PLAIN, pillar=Index(n), between=Index(n))
    t, by_height, by_size = derived(cell, diameter_um, "height_um", "size_um")
    assert abs(t - film(n, height)) < 1e-12
    assert abs(by_height - slope(lambda h: film(n, h), height, 1e-4)) < 1e-9
    assert abs(by_size) < 1e-12


def test_a_weak_disc_changes_the_film_by_its_share_of_the_cell():
    n, diameter = 1.7, 0.02
    cell = replace(PLAIN, pillar=Index(n), between=Index(n))
    _, by_index = derived(cell, diameter, "pillar.n", harmonics=1)
    whole = slope(lambda n: film(n, 0.7), n, 1e-4)
    assert abs(by_index - whole * math.pi * diameter**2 / 4 / 0.16) < 1e-10


def test_height_only_turns_the_phase_where_one_mode_travels_alone():
    n = 1.4525
    cell = replace(PLAIN, pillar=Index(n), between=Index(n), cover=Index(n))
    t, by_height = derived(cell, 0.2, "height_um")
    assert abs(by_height - 2j * math.pi * n / 0.85 * t) < 1e-11


@pytest.mark.parametrize("tilt", [0.12, -0.07])
def test_a_tilted_wall_counts_with_its_mean_area_where_nothing_is_reflected(tilt):
    """Index-matched: t = exp(i k n h), and dt/dn = i k h s t, s the mean of pi D(z)²/4
    over the cell's area. The collocation of the wall is asked for 1e-3 and leaves 1e-7.
    """
    n, diameter, height = 1.7, 0.21, 0.6
    matched = dict.fromkeys(("pillar", "between", "substrate", "cover"), Index(n))
    cell = replace(PLAIN, **matched, height_um=height, sidewall_rad=tilt)
    t, by_index = derived(cell, diameter, "pillar.n", harmonics=2)
    k, spread = 2 * math.pi / 0.85, 2 * height * math.tan(tilt)
    share = math.pi / 4 * (diameter**2 + spread**2 / 12) / cell.pitch_um**2
    assert abs(t - cmath.exp(1j * k * n * height)) < 1e-5
    assert abs(by_index - 1j * k * height * share * t) < 1e-5
    _, upright = derived(
        replace(cell, sidewall_rad=0.0), diameter, "pillar.n", harmonics=2
    )
    assert abs(by_index - upright) > 1e-2 * abs(by_index)  # the tilt does matter


@pytest.mark.parametrize("harmonics", [2, 4])
def test_derivatives_of_a_lossless_pillar_keep_its_power(harmonics):
    """|t|² + |r|² = 1 whatever the height and index."""
    found = rcwa.jones_derivatives(
        PLAIN, 0.21, 0.85, harmonics=harmonics, by=["height_um", "pillar.n"]
    )
    for rate in found.by.values():
        change = found.jones.t.conj() * rate.t + found.jones.r.conj() * rate.r
        assert abs(change.sum(0).real).max() < 1e-8 * np.abs(rate.t).max()
        assert np.abs(rate.t).max() > 1


def test_a_number_that_the_cell_has_not_is_named():
    with pytest.raises(CellError, match="no number 'corner'"):
        rcwa.jones_derivatives(PLAIN, 0.2, 0.85, by=["corner"])
