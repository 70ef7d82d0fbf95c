"""Verdicts on a cell from curves that are typed in: the stretch of most phase, its
light, its ends, its error.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell import Cell, Index
from metalens.cell.shapes import Circle, Ellipse, Rectangle
from metalens.ground.errors import CellError, ConfigError
from metalens.pillars import converted, study

CELL = Cell(0.36, 0.6, Index(3.2), Index(1.45), Index(1.0), Index(1.0))
ABOUT = SimpleNamespace(least_transmission=0.7, least_half_width_um=0.004)


class Curve:
    """t of phase 30 (D - 0.1) + 200 (D - 0.1)² and |t| of 0.95 - D, from 0.1 to 0.2 um,
    with a narrow resonance.
    """

    nodes = SimpleNamespace(diameter_um=np.array([0.1, 0.14, 0.2]))

    def __init__(self, at=None):
        self.at = at

    def __call__(self, d):
        t = (0.95 - d) * np.exp(1j * (30 * (d - 0.1) + 200 * (d - 0.1) ** 2))
        return np.stack([t, 0 * t], 1), 1e-3 + 0.02 * (d - 0.1)

    def resonances(self, least):
        assert least == 0.004
        return [] if self.at is None else [(self.at, 0.002)]


def turns(low, high):
    return (30 * (high - low) + 200 * ((high - 0.1) ** 2 - (low - 0.1) ** 2)) / (
        2 * math.pi
    )


def test_the_whole_range_of_a_clean_curve_with_its_mean_power_even_in_phase():
    found = study.judge(ABOUT, CELL, 0.85, Curve())
    assert (found.from_um, found.to_um, found.ends) == (0.1, 0.2, "the printable range")
    assert found.turns == pytest.approx(turns(0.1, 0.2), rel=1e-6)
    assert found.least_transmission == pytest.approx(0.75)
    assert found.error == pytest.approx(3e-3)
    d = 0.1 + 0.1 * (np.arange(20000) + 0.5) / 20000
    rate = 30 + 400 * (d - 0.1)
    assert found.mean_power == pytest.approx(
        (rate * (0.95 - d) ** 2).sum() / rate.sum(), rel=1e-4
    )
    assert (found.pitch_um, found.height_um, found.wavelength_um) == (0.36, 0.6, 0.85)


def test_openings_cover_what_their_mirror_image_does():
    """Conjugate t of pillars whose phase rises: the same stretch, turns and power."""

    class Mirrored(Curve):
        def __call__(self, d):
            t, error = super().__call__(d)
            return t.conj(), error

    opening = dataclasses.replace(CELL, shape=Circle(hole=True))
    found, other = (
        study.judge(ABOUT, opening, 0.85, Mirrored(0.175)),
        study.judge(ABOUT, CELL, 0.85, Curve(0.175)),
    )
    assert dataclasses.asdict(found) == pytest.approx(dataclasses.asdict(other))
    assert (
        study.judge(ABOUT, opening, 0.85, Curve()).turns == 0
    )  # rises: no opening does


def test_diameters_whose_bars_are_above_half_of_their_light_end_a_stretch():
    """0.4 at 0.1 um, rising by 1.7 per um, is half of 0.95 - D where 0.4 + 1.7 (D -
    0.1) = 0.425 - (D - 0.1) / 2.
    """

    class Hardly(Curve):
        def __call__(self, d):
            return super().__call__(d)[0], 0.4 + 1.7 * (d - 0.1)

    found = study.judge(ABOUT, CELL, 0.85, Hardly())
    assert found.to_um == pytest.approx(0.1 + 0.025 / 2.2, abs=0.1 / study.SAMPLES)
    assert found.ends == "an error bar above half of |t|"


def test_a_page_tells_of_stretches_whose_bars_lie_above_the_tolerance():
    """Bars of 3e-3 at most, so by a tolerance of 4e-3 none, by one of 2e-3 all, the
    first of both the largest.
    """
    first = dataclasses.replace(study.judge(ABOUT, CELL, 0.85, Curve()), error=3e-3)
    other = dataclasses.replace(first, wavelength_um=0.94, error=2.5e-3)
    none = dataclasses.replace(first, turns=0.0, error=0.7)
    asked = {
        "pitches_um": (0.36,),
        "heights_um": (0.6,),
        "wavelengths_um": (0.85, 0.94),
        "pillar": CELL.pillar,
    }
    loose, close = (
        study.Study(**asked, tolerance=4e-3),
        study.Study(**asked, tolerance=2e-3),
    )
    assert study.unsure(loose, [first, other, none]) == ""
    told = study.unsure(close, [other, first, none])
    assert told.startswith(
        "on 2 of 2 stretches error bars of t lie above the tolerance 0.002, the largest of 0.003 ("
    )
    assert told.endswith("pitch 360 nm, 600 nm high, 850 nm)")
    assert "On 2 of 2 stretches" in study.markdown(
        close, [first, other], command="metalens study"
    )
    assert "stretches error" not in study.markdown(
        loose, [first, other], command="metalens study"
    )


def test_a_study_asks_for_errors_that_a_library_may_have():
    with pytest.raises(
        ConfigError,
        match=r"tolerance = 0\.11: need an error of t above 0 and up to 0\.1",
    ):
        study.Study(tolerance=0.11)


@pytest.mark.parametrize(
    ("at", "low", "high"), [(0.175, 0.1, 0.175 - 0.004), (0.112, 0.112 + 0.004, 0.2)]
)
def test_a_narrow_resonance_ends_a_stretch_two_half_widths_before_it(at, low, high):
    found = study.judge(ABOUT, CELL, 0.85, Curve(at))
    step = 0.1 / (study.SAMPLES - 1)
    assert found.from_um == pytest.approx(low, abs=1.01 * step)
    assert found.to_um == pytest.approx(high, abs=1.01 * step)
    assert found.turns == pytest.approx(turns(found.from_um, found.to_um), rel=1e-6)
    assert found.ends == ("a narrow resonance" if at > 0.15 else "the printable range")


def test_light_that_falls_below_the_least_ends_a_stretch():
    found = study.judge(
        SimpleNamespace(least_transmission=0.78, least_half_width_um=0.004),
        CELL,
        0.85,
        Curve(),
    )
    assert found.to_um == pytest.approx(0.17, abs=0.1 / (study.SAMPLES - 1))
    assert found.ends == "|t| falls"


def test_orders_stay_away_up_to_the_sine_that_is_left():
    """Wavelength over pitch less the denser side: 0.85 / 0.36 - 1.45 = 0.911; 0.85 /
    0.5 - 1.45 = 0.25.
    """
    assert study.max_angle_deg(CELL, 0.85) == pytest.approx(
        math.degrees(math.asin(0.85 / 0.36 - 1.45)), rel=1e-9
    )
    wide = Cell(0.5, 0.6, Index(3.2), Index(1.45), Index(1.0), Index(1.0))
    assert study.max_angle_deg(wide, 0.85) == pytest.approx(
        math.degrees(math.asin(0.25)), rel=1e-9
    )
    assert study.max_angle_deg(wide, 0.6) == 0.0


def library():
    x = np.array([[0.5 + 0.2j, 0.9j, -0.8, 0.1], [0.4, 0.8j, -0.6 + 0.1j, 0.3]])
    y = np.array([[-0.3, -0.5j, 0.9, 0.2j], [-0.2j, -0.7j, 0.9, -0.1]])
    t = np.stack([x, y])[:, None]
    bars = np.full(t.shape, 1e-4)
    bars[0, 0, 1, 2] = 0.02
    return SimpleNamespace(
        t=t,
        t_error=bars,
        diameter_um=np.array([0.1, 0.12, 0.15, 0.2]),
        sweep=SimpleNamespace(bar=1e-3),
    )


def test_light_of_the_other_hand_is_half_the_difference_of_both_axes():
    got = converted.converted(library())
    assert got.shape == (2, 4)
    assert got[0] == pytest.approx(np.array([0.4 + 0.1j, 0.7j, -0.85, 0.05 - 0.1j]))


def test_the_best_size_converts_most_at_its_worst_wavelength_with_sure_bars():
    """0.85 and 0.752 at the third size, which a bar rules out; 0.7 and 0.75 at the
    second.
    """
    some = library()
    assert converted.best_size_um(some) == 0.12
    some.t_error[:] = 0.5
    assert converted.best_size_um(some) == 0.15  # no bar is sure: the most of all


@pytest.mark.parametrize(
    ("shape", "least"),
    [(Rectangle(0.4), 0.2), (Rectangle(2.5), 0.08), (Ellipse(0.5), 0.16)],
)
def test_what_can_be_printed_is_the_least_width_of_a_shape_not_its_size(shape, least):
    """80 nm is the short side: of a rectangle of 0.4 the size along x is 200 nm; of 2.5
    it is the size itself.
    """
    limits = study.Study(pitches_um=(0.4,), min_diameter_um=0.08, min_gap_um=0.07)
    cell = dataclasses.replace(CELL, pitch_um=0.4, shape=shape)
    low, high = study._span(limits, cell)
    assert low == pytest.approx(
        least, rel=2e-3
    )  # an ellipse is measured on a polygon of its area
    assert high == pytest.approx(0.33 / max(1.0, shape.ratio), abs=2e-4)
    with pytest.raises(CellError, match=r"min_diameter_um = 0\.3 takes"):
        study._span(
            dataclasses.replace(limits, min_diameter_um=0.3, min_gap_um=0.09), cell
        )
