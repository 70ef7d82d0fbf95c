"""Stretches of a library without resonances, from t and error bars that are typed in."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.ground.errors import DomainError
from metalens.pillars.stretch import stretch

D = 0.1 + 0.005 * np.arange(60)
ASKED = {"least_transmission": 0.5, "least_half_width_um": 1e-3}


def library(level=None, phase=None, *, error=0.0, resonances=(), hole=False):
    """(2 polarisations, 2 angles, 3 wavelengths, d); phases rise by 0.2 rad an entry
    unless told otherwise.
    """
    rising = 0.2 * np.arange(len(D)) * (-1 if hole else 1)
    shift = np.arange(12.0).reshape(2, 2, 3, 1) * 0.7
    t = (
        np.ones((2, 2, 3, 1))
        * (0.8 if level is None else level)
        * np.exp(1j * (shift + rising))
    )
    if phase is not None:
        t = t * np.exp(1j * phase)
    return SimpleNamespace(
        diameter_um=D, t=t, t_error=np.zeros(t.shape) + error, resonances=resonances,
        cell=SimpleNamespace(shape=SimpleNamespace(hole=hole)),
    )  # fmt: skip


def at(index, value, rest):
    """``rest`` but for one polarisation, angle and wavelength at one entry."""
    out = np.full((2, 2, 3, len(D)), rest)
    out[1, 0, 2, index] = value
    return out


def test_the_whole_library_where_nothing_is_in_the_way():
    found = stretch(library(), **ASKED)
    assert found.diameter_um == pytest.approx(D)
    assert found.notes == ()
    gap = 6 * 0.7  # from one polarisation to the other; t is their mean
    assert found.polarization_spread == pytest.approx(0.8 * abs(math.sin(gap / 2)))
    assert found.level == pytest.approx(
        np.full((2, 3, 60), 0.8 * abs(math.cos(gap / 2)))
    )
    assert np.diff(found.phase, axis=-1) == pytest.approx(np.full((2, 3, 59), 0.2))
    assert np.diff(found.phase, axis=1) == pytest.approx(np.full((2, 2, 60), 0.7))
    assert np.diff(found.phase, axis=0) == pytest.approx(np.full((1, 3, 60), 2.1))


def test_what_is_dark_is_cut_at_any_angle_and_wavelength():
    for value, cut in ((0.49, True), (0.51, False)):
        found = stretch(library(at(20, value, 0.8)), **ASKED)
        assert found.diameter_um == pytest.approx(
            D[21:] if cut else D
        )  # the longer part has more phase
        assert len(found.notes) == cut
    assert (
        stretch(library(at(20, 0.49, 0.8)), **ASKED).notes[0]
        == "cut at 0.2050 um: |t| falls to 0.49, below 0.5"
    )
    assert stretch(library(at(40, 0.3, 0.8)), **ASKED).diameter_um == pytest.approx(
        D[:40]
    )
    assert (
        stretch(library(at(40, 0.3, 0.8)), **ASKED)
        .notes[0]
        .startswith("cut at 0.2950 um: |t| falls to 0.30")
    )


def test_entries_whose_bar_is_above_half_of_t_are_not_known():
    for bar, cut in ((0.41, True), (0.39, False)):
        found = stretch(library(error=at(25, bar, 0.0)), **ASKED)
        assert found.diameter_um == pytest.approx(D[26:] if cut else D)
    assert stretch(library(error=at(25, 0.41, 0.0)), **ASKED).notes == (
        "cut at 0.2300 um: error bars reach 0.41, above half of |t|",
    )


@pytest.mark.parametrize("hole", [False, True])
def test_a_phase_that_turns_back_cuts_both_its_entries(hole):
    """By 0.3 rad at one entry, of openings the other way: the next step goes back."""
    sign = -1 if hole else 1
    found = stretch(library(phase=at(30, 0.3 * sign, 0.0), hole=hole), **ASKED)
    assert found.diameter_um == pytest.approx(D[:30])
    words = (
        "the phase rises with the size of the opening"
        if hole
        else "the phase falls with the diameter"
    )
    assert found.notes == (f"cut at {D[29]:.4f} um: {words}",)
    found = stretch(library(phase=at(24, -0.3 * sign, 0.0), hole=hole), **ASKED)
    assert found.diameter_um == pytest.approx(D[25:])


@pytest.mark.parametrize(
    ("centre", "width", "kept"),
    [
        (0.2011, 2e-4, slice(22, 60)),  # both entries beside it
        (0.2011, 9e-4, slice(22, 60)),
        (0.2011, 1e-3, slice(0, 60)),  # as wide as may be
        (D[20], 2e-4, slice(21, 60)),  # 0.2 um: it and the one below
        (0.0999, 2e-4, slice(0, 60)),
        (D[0], 2e-4, slice(1, 60)),
        (0.3962, 2e-4, slice(0, 60)),  # beyond the last
        (0.3912, 2e-4, slice(0, 58)),
    ],
)
def test_narrow_resonances_are_cut_with_the_entries_beside_them(centre, width, kept):
    found = stretch(library(resonances=(("s", 0.0, 0.85, centre, width),)), **ASKED)
    assert found.diameter_um == pytest.approx(D[kept])


def test_a_resonance_reaches_two_half_widths_and_is_told_with_its_angle():
    wide = ASKED | {"least_half_width_um": 0.01}
    found = stretch(
        library(resonances=(("p", math.radians(12), 0.85, 0.2012, 0.0064),)), **wide
    )
    near = np.flatnonzero(np.abs(D - 0.2012) <= 2 * 0.0064)
    assert near.tolist() == [18, 19, 20, 21, 22]
    assert found.diameter_um == pytest.approx(D[23:])
    assert found.notes == (
        "cut at 0.2150 um: resonance at 0.2012 um, half-width 6.4 nm (0.85 um, 12 deg)",
    )
    found = stretch(library(resonances=(("p", 0.0, 0.85, 0.2012, 0.0064),)), **wide)
    assert found.notes[0].endswith("half-width 6.4 nm (0.85 um)")


def test_a_stretch_within_ends_and_of_twelve_entries_at_least():
    found = stretch(library(), **ASKED, within_um=(D[7], D[18]))
    assert found.diameter_um == pytest.approx(D[7:19])
    found = stretch(
        library(), **ASKED, within_um=(D[7] + 5e-10, D[18] - 5e-10)
    )  # rounding of the ends
    assert found.diameter_um == pytest.approx(D[7:19])
    with pytest.raises(DomainError, match="no 12 diameters in a row"):
        stretch(library(), **ASKED, within_um=(D[7], D[17]))
    dark = at(0, 0.8, 0.8)
    dark[..., :49] = 0.1
    with pytest.raises(DomainError, match="no 12 diameters in a row"):
        stretch(library(dark), **ASKED)  # eleven are left at the end
    dark[..., 48] = 0.8
    assert stretch(library(dark), **ASKED).diameter_um == pytest.approx(D[48:])
    assert stretch(library(at(0, 0.1, 0.8)), **ASKED).notes == (
        "cut at 0.1050 um: |t| falls to 0.10, below 0.5",
    )
    with pytest.raises(DomainError, match=r"\(\|t\| falls to 0.20, below 0.5\)"):
        stretch(library(0.2), **ASKED)


def test_phases_are_unwrapped_over_diameters_wavelengths_and_angles():
    """Steps of 2.9 rad from wave to wave and 2.2 from angle to angle, of 0.4 between
    polarisations that grow apart.
    """
    made = library()
    along = np.arange(60)
    phase = 0.4 * np.arange(2).reshape(2, 1, 1, 1) * (1 + along / 60) + 2.2 * np.arange(
        2
    ).reshape(1, 2, 1, 1)
    made.t = 0.8 * np.exp(
        1j * (phase + 2.9 * np.arange(3).reshape(1, 1, 3, 1) + 0.2 * along)
    )
    found = stretch(made, **ASKED)
    mean = 0.2 * along + 0.2 * (1 + along / 60)
    want = (
        mean + 2.2 * np.arange(2).reshape(2, 1, 1) + 2.9 * np.arange(3).reshape(1, 3, 1)
    )
    turns = (found.phase - want) / (2 * math.pi)
    assert turns == pytest.approx(
        np.full(want.shape, np.rint(turns[0, 0, 0])), abs=1e-9
    )
    assert found.polarization_spread == pytest.approx(
        0.8 * math.sin(0.2 * (1 + 59 / 60))
    )
