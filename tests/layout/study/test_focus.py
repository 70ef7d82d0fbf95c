"""The reduced sum over pillars against the plain Rayleigh-Sommerfeld sum, with every
symmetry broken.
"""

import dataclasses

import numpy as np
import pytest

from layout.study import focus
from layout.study.focus import FocusWindow
from metalens.cell import Cell, Film, Index
from metalens.core.errors import PropagationError
from metalens.lens import DiameterMap, Lens
from metalens.optics import Layers, Stop
from tests.proxies import proxy_of
from tests.referees import films, plain_sum

RNG = np.random.default_rng(4)
PROXY = proxy_of([3.0, 2.8, 0.3], [0.9, 0.05], (0.1, 0.3), 0.85)


def random_lens(ny=90, nx=121, distance_um=150.0, source_um=900.0):
    diameter = np.where(RNG.random((ny, nx)) < 0.9, RNG.uniform(0.1, 0.3, (ny, nx)), 0)
    return Lens(
        DiameterMap(diameter, 0.4),
        Cell(0.4),
        PROXY,
        0.85,
        distance_um,
        source_um,
        "random",
    )


def amplitude(lens):
    return lens.transmission() * np.exp(1j * lens.phase_rad())


def window_of(lens, depths):
    return FocusWindow(
        np.linspace(-3, 9, 4),
        np.linspace(-7, 2, 3),
        lens.sensor_distance_um,
        0.85,
        np.array(depths),
    )


def test_the_reduced_sum_is_the_plain_sum_at_all_depths_and_for_a_collimated_beam():
    lens = random_lens()
    where = window_of(lens, [600.0, 900.0, 1500.0, np.inf])
    exact = plain_sum.field(lens, amplitude(lens), where)
    ready = focus.prepare_focus(lens, where)
    fast = ready.light(ready.project(amplitude(lens)[None].astype(np.complex64)))[0]
    # float32 sums of 1e4 terms
    assert abs(fast - exact).max() < 3e-6 * abs(exact).max()


def test_shifted_pillars_send_their_light_from_where_they_are():
    lens = random_lens()
    where = window_of(lens, [900.0])
    ones = np.ones(lens.diameters.diameter_um.shape)
    exact = plain_sum.field(
        lens, amplitude(lens), where, shift_um=(0.05 * ones, -0.03 * ones)
    )
    ready = focus.prepare_focus(lens, where)
    fast = ready.light(ready.project(amplitude(lens)[None]), (0.05, -0.03))[0]
    assert abs(fast - exact).max() < 3e-6 * abs(exact).max()


def test_light_tilted_to_plus_x_and_plus_y_arrives_there():
    lens = random_lens(91, 91, distance_um=200.0, source_um=np.inf)
    x, y = lens.diameters.x_um, lens.diameters.y_um[:, None]
    r = np.sqrt((x - 5) ** 2 + (y - 3) ** 2 + 200**2)
    aimed = np.exp(-2j * np.pi / 0.85 * r)
    where = FocusWindow(
        np.arange(-8, 9.0), np.arange(-8, 9.0), 200.0, 0.85, np.array([np.inf])
    )
    ready = focus.prepare_focus(lens, where)
    psf = abs(ready.light(ready.project(aimed[None]))[0, 0]) ** 2
    row, column = np.unravel_index(psf.argmax(), psf.shape)
    assert (where.x_um[column], where.y_um[row]) == (5, 3)


def test_the_usual_window_holds_the_geometric_blur():
    lens = random_lens(91, 91)
    where = focus.focus_window(lens, depths_um=np.array([600.0, 900.0]))
    blur = lens.diameters.radius_um * 150 * (1 / 600 - 1 / 900)
    assert where.x_um[-1] > blur
    assert (
        where.x_um[1] - where.x_um[0]
        <= 0.85 * 150 / (4 * lens.diameters.radius_um) + 1e-12
    )
    assert (where.x_um == -where.x_um[::-1]).all()


def test_light_behind_films_is_that_of_plane_waves_through_them():
    """Normalised by nothing; budget as in the tests of films: 3e-3 of the field for
    rays and the mean of s and p.
    """
    behind = (Film(Index(1.52), 55.0), Film(Index(2.1), 7.0))
    lens = random_lens(84, 90, source_um=np.inf)
    lens = dataclasses.replace(
        lens, cell=Cell(0.4, cover=Index(1.31)), layers=Layers((), behind)
    )
    x, y = lens.diameters.x_um, lens.diameters.y_um[:, None]
    lit = np.hypot(x + 0.6, 1.1 * y) <= 15.5
    rough = RNG.uniform(0.7, 1.0, lit.shape) * np.exp(
        1j * RNG.normal(0, 0.2, lit.shape)
    )
    # near the focus
    aimed = rough * np.exp(-2j * np.pi / 0.85 * (x**2 + y**2) / (2 * 104.0)) * lit
    media = [(1.31, 150.0 - 62.0), (1.52, 55.0), (2.1, 7.0)]
    stack = films.Stack(media, wavelength=0.85, step=0.4, count=800)
    at = np.array([395, 398, 399, 402, 407])
    axis = (at - 399.5) * 0.4
    want = (np.abs(stack.fields(aimed)) ** 2).mean(0)[np.ix_(at - 3, at)]
    ready = focus.prepare_focus(
        lens, FocusWindow(axis, axis - 1.2, 150.0, 0.85, np.array([np.inf]))
    )
    got = np.abs(ready.light(ready.project(aimed[None]))[0, 0]) ** 2
    assert np.linalg.norm(got - want) < 6e-3 * np.linalg.norm(want)


def test_a_lens_behind_a_stop_is_refused_by_what_it_would_need():
    lens = random_lens()
    behind = dataclasses.replace(lens, layers=Layers(stop=Stop(31.0, 40.0)))
    with pytest.raises(
        PropagationError,
        match=r"behind a stop of 62 um is not studied.*lights others at each",
    ):
        focus.prepare_focus(behind, window_of(behind, [900.0]))
