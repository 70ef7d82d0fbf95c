"""The reduced sum over pillars against the plain Rayleigh-Sommerfeld sum, with every
symmetry broken.
"""

import dataclasses

import numpy as np
import pytest
from scipy.special import jv

from layout.study import focus
from layout.study.focus import FocusWindow
from metalens.cell import Cell, Film, Index
from metalens.core.errors import PropagationError
from metalens.lens import DiameterMap, Lens
from metalens.library.proxy import Proxy
from metalens.optics import Layers, Stop
from tests.referees import films, plain_sum

RNG = np.random.default_rng(4)
PROXY = Proxy(
    np.array([[3.0, 2.8, 0.3]]),
    np.array([[0.9, 0.05]]),
    (0.1, 0.3),
    (0.85, 0.85),
    0.0,
    0.0,
)


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
    assert (
        abs(fast - exact).max() < 3e-6 * abs(exact).max()
    )  # float32 sums of 1e4 terms


def needed(turns):
    """Fewest nodes beyond which Chebyshev coefficients of exp(i turns x) are below 1e-4
    and 1e-6 of it.
    """
    order = np.arange(1, 400)
    return [
        int(order[abs(jv(order, turns)) > bound].max()) + 1 for bound in (1e-4, 1e-6)
    ]


@pytest.mark.parametrize(("x_um", "y_um"), [(60.0, 9.0), (-9.0, 60.0)])
def test_nodes_without_margin_are_those_that_a_wide_window_needs(x_um, y_um):
    """One depth: what is left is the way to the window's edge less that to its middle.
    Its turns in closed form.
    """
    lens = random_lens()
    where = FocusWindow(
        np.linspace(0.1, x_um, 3),
        np.linspace(-0.2, y_um, 4),
        150.0,
        0.85,
        np.array([900.0]),
    )
    ready = focus.prepare_focus(lens, where, margin=0)
    for nodes, edge, reach in (
        (ready.nodes_x_um, 24.0, abs(x_um)),
        (ready.nodes_y_um, 17.8, abs(y_um)),
    ):
        x = np.linspace(-edge, edge, 4001)
        slope = abs(
            (x - reach) / np.hypot(x - reach, 150.0) - x / np.hypot(x, 150.0)
        ).max()
        fewest, most = needed(2 * np.pi / 0.85 * edge * slope)
        assert fewest <= len(nodes) <= most


def test_nodes_without_margin_are_those_that_the_farthest_depth_needs():
    """On the axis: from 30 um and from far away, each less the way from the mean
    inverse depth, 1 / 60 um.
    """
    lens = random_lens()
    where = FocusWindow(
        np.array([-1e-6, 1e-6]),
        np.array([-1e-6, 1e-6]),
        150.0,
        0.85,
        np.array([30.0, np.inf]),
    )
    ready = focus.prepare_focus(lens, where, margin=0)
    for nodes, edge in ((ready.nodes_x_um, 24.0), (ready.nodes_y_um, 17.8)):
        fewest, most = needed(2 * np.pi / 0.85 * edge * edge / np.hypot(edge, 60.0))
        assert fewest <= len(nodes) <= most


def test_blocks_add_up_to_the_whole():
    lens = random_lens()
    ready = focus.prepare_focus(lens, window_of(lens, [900.0]))
    t = amplitude(lens)[None]
    whole = ready.project(t)
    parts = [
        ((slice(0, 40), slice(0, 121))),
        (slice(40, 90), slice(0, 50)),
        (slice(40, 90), slice(50, 121)),
    ]
    total = sum(
        ready.project(t[:, rows, columns], rows, columns) for rows, columns in parts
    )
    assert abs(total - whole).max() < 1e-5 * abs(whole).max()


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
    aimed = (
        rough * np.exp(-2j * np.pi / 0.85 * (x**2 + y**2) / (2 * 104.0)) * lit
    )  # near the focus
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


def test_a_window_without_extent_is_refused():
    lens = random_lens()
    with pytest.raises(PropagationError, match="2 samples"):
        focus.prepare_focus(
            lens, FocusWindow(np.zeros(1), np.zeros(3), 150.0, 0.85, np.array([900.0]))
        )


def test_a_lens_behind_a_stop_is_refused_by_what_it_would_need():
    lens = random_lens()
    behind = dataclasses.replace(lens, layers=Layers(stop=Stop(31.0, 40.0)))
    with pytest.raises(
        PropagationError,
        match=r"behind a stop of 62 um is not studied.*lights others at each",
    ):
        focus.prepare_focus(behind, window_of(behind, [900.0]))
