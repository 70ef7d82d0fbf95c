"""Where the rays of a map meet: of ideal lenses known in closed form, of maps without a
focus nowhere.
"""

import numpy as np
import pytest

from metalens import design
from metalens.cell.record import Cell, Film, Index
from metalens.design import Focus, focusing, meeting_um
from metalens.lens import Layers
from metalens.pillars.proxy import Proxy

K = 2 * np.pi / 1.31
ABOUT = {"radius_um": 130.0, "pitch_um": 0.6}


def lens(focal_um, source_um, aside_um=0.0):
    """An ideal lens whose middle lies ``aside_um`` along x; phase of paper Eq. 1 on
    both sides.
    """

    def phase(x, y):
        x, y = np.meshgrid(x, y)
        before = (
            np.hypot(np.hypot(x, y), source_um) - source_um
            if np.isfinite(source_um)
            else 0.0
        )
        return -K * (np.hypot(np.hypot(x - aside_um, y), focal_um) + before)

    return phase


@pytest.mark.parametrize("told_um", [700.0, 2000.0])
@pytest.mark.parametrize(
    ("focal_um", "source_um", "aside_um"), [(900.0, np.inf, 0.0), (1100.0, 7e3, 17.0)]
)
def test_rays_of_an_ideal_lens_meet_in_its_focus(
    focal_um, source_um, aside_um, told_um
):
    found = meeting_um(
        lens(focal_um, source_um, aside_um), Focus(1.31, told_um, source_um), **ABOUT
    )
    # the difference over one pitch p misses the slope by p² / 24 of its second
    # derivative: 0.015 um² / (900 um)²
    assert found is not None
    assert found == pytest.approx((aside_um, 0.0, focal_um), rel=1e-6, abs=1e-3)


@pytest.mark.parametrize(
    ("inner_um", "outer_um", "brings"), [(900.0, 300.0, False), (300.0, 900.0, True)]
)
def test_rays_from_all_over_a_lens_say_whether_it_focuses(inner_um, outer_um, brings):
    """A fifth of the radius, 4 % of the light, has a third of the focal length, or all
    but that.
    """

    def phase(x, y):
        middle = np.hypot(*np.meshgrid(x, y)) < 0.2 * ABOUT["radius_um"]
        return np.where(
            middle, lens(inner_um, np.inf)(x, y), lens(outer_um, np.inf)(x, y)
        )

    assert focusing.focuses(phase, Focus(1.31, 900.0, np.inf), **ABOUT) is brings


def test_no_meeting_of_rays_that_spread_or_part():
    focus = Focus(1.31, 800.0)
    diverging = lambda x, y: -lens(900.0, np.inf)(x, y)  # noqa: E731
    axicon = lambda x, y: -0.1 * K * np.hypot(x, y[:, None])  # noqa: E731
    for phase in (diverging, axicon, lambda x, y: 0.03 * K * x + 0 * y[:, None]):
        assert meeting_um(phase, focus, **ABOUT) is None


def test_rays_through_a_film_meet_in_the_middle_of_the_sensor_s_spot():
    """A film of index n and thickness t sets the focus back by t (1 - 1/n) and moves
    nothing aside.
    """
    film = Layers(behind=(Film(Index(1.5), 60.0),))
    behind = Focus(1.31, 920.0, np.inf, film)
    found = meeting_um(lens(900.0, np.inf, 23.0), behind, **ABOUT)
    assert found is not None
    assert found[0] == pytest.approx(23.0, abs=0.05)  # third order: 60 um (r/f)^3 / 2
    assert found[1:] == pytest.approx((0.0, 920.0), abs=1e-3)
    spread = Focus(1.31, 500.0, np.inf, film)
    assert meeting_um(lens(900.0, np.inf), spread, **ABOUT) is None


TURNS = Proxy(
    np.array([[0.0, 3 * np.pi]]),
    np.array([[1.0]]),
    (0.1, 0.5),
    (1.31, 1.31),
    1e-6,
    1e-6,
)
CELL = Cell(pitch_um=0.6, pillar=Index(3.4), substrate=Index(1.45))


@pytest.mark.parametrize(
    ("added", "focused"),
    [
        (lambda x, y: 0.0 * x * y, True),
        (lambda x, y: 0.03 * K * x + 0.0 * y, True),  # the same lens aside
        (lambda x, y: 2 * np.arctan2(y, x), False),  # dark in the middle
        (
            lambda x, y: K * np.hypot(x, y) ** 2 / 600.0 + 0.1 * K * x,
            False,
        ),  # a deflector without power
        (lambda x, y: K * (x * x - y * y) / 500.0, False),  # a line
    ],
)
def test_pillars_focus_as_the_phase_that_they_were_made_for(added, focused):
    focus = Focus(1.31, 300.0, np.inf)

    def phase(x, y):
        ideal = -K * (x**2 + y[:, None] ** 2) / 600.0
        return ideal + added(*np.meshgrid(x, y))

    made, _ = design.make(phase, focus, aperture_um=52.0, cell=CELL, proxy=TURNS)
    assert design.focused(made) is focused
