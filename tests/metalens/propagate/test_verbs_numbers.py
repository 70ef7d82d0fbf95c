"""Geometry of a propagation from its words: places, cells, slopes and films, each by
hand, and what is refused.
"""

import math

import numpy as np
import pytest
import torch

from metalens.cell import Film, Index
from metalens.core.errors import PropagationError
from metalens.lens import Layers, Stop
from metalens.propagate import verbs

PLAIN = {
    "pitch_um": 0.41,
    "wavelength_um": 0.83,
    "sensor_distance_um": 900.0,
    "depths_um": (3e3, math.inf, 5e3),
}
WINDOW = {"window_um": (21.0, 33.0), "samples": (7, 11)}


def test_every_number_has_its_place():
    found = verbs.make_case(
        (5, 301, 203),
        **PLAIN,
        **WINDOW,
        angle_rad=(0.2, -0.1),
        offset_um=(3.0, -7.0),
        row_um=0.37,
    )
    assert found.shape == (301, 203)
    assert (found.pitch_um, found.wavelength_um, found.sensor_distance_um) == (
        0.41,
        0.83,
        900.0,
    )
    assert found.tangents == pytest.approx((math.tan(0.2), -math.tan(0.1)))
    assert found.inverse_depths_per_um == pytest.approx((1 / 3e3, 0.0, 1 / 5e3))
    assert found.centre_um == pytest.approx(
        (900 * math.tan(0.2) + 3, -900 * math.tan(0.1) - 7)
    )
    assert (found.step_um, found.samples) == (3.0, (11, 7))
    assert (found.row_um, found.site_um2) == (0.37, 0.0)
    assert (found.front, found.behind) == ((), None)
    assert verbs.make_case((9, 7), **PLAIN, **WINDOW, site_um2=0.15).site_um2 == 0.15
    plain = verbs.make_case(
        (9, 7), **PLAIN | {"depths_um": 4e3}, **WINDOW, angle_rad=0.3
    )
    assert plain.inverse_depths_per_um == (1 / 4e3,)
    assert plain.tangents == pytest.approx((math.tan(0.3), 0.0))
    assert plain.centre_um == pytest.approx((900 * math.tan(0.3), 0.0))


def test_windows_are_numbers_or_pairs_of_square_cells():
    assert verbs.window_of(21.0, 7) == (3.0, (7, 7))
    assert verbs.window_of((21.0, 33.0), (7, 11)) == (3.0, (11, 7))
    assert verbs.window_of((21.0, 33.0 * (1 + 0.8e-6)), (7, 11))[0] == 3.0
    for wrong in (
        ((21.0, 33.0 * (1 + 1.2e-6)), (7, 11)),
        ((21.0, 33.0 * (1 - 1.2e-6)), (7, 11)),
        ((21, 33), 7),
    ):
        with pytest.raises(PropagationError, match="need square ones"):
            verbs.window_of(*wrong)
    for wrong in (((1, 2, 3), 4), (4, (1, 2, 3)), (4, 2.5), (4, (2, 2.5)), ((), 4)):
        with pytest.raises(PropagationError, match="need a number or a pair"):
            verbs.window_of(*wrong)
    assert verbs.window_of(21.0, 0) == (21.0, (0, 0))  # which a case refuses


@pytest.mark.parametrize(
    "wrong", [math.pi / 2, -math.pi / 2, (0.1, math.nan), (0.1, 0.2, 0.3), [[0.1, 0.2]]]
)
def test_an_angle_is_one_or_two_below_a_right_one(wrong):
    assert verbs.to_angle_pair((0.3, -1.57)) == (0.3, -1.57)
    assert verbs.to_angle_pair(-0.4) == (-0.4, 0.0)
    with pytest.raises(PropagationError, match="need one angle or a pair"):
        verbs.to_angle_pair(wrong)


@pytest.mark.parametrize(
    ("depths", "offset", "told"),
    [
        (0.0, (0, 0), "above 0"),
        ((3e3, -1.0), (0, 0), "above 0"),
        ([[3e3]], (0, 0), "need"),
        (3e3, (0, 0, 0), "need"),
        (3e3, 1.0, "need"),
    ],
)
def test_depths_below_0_and_odd_offsets_are_refused(depths, offset, told):
    with pytest.raises(PropagationError, match=told):
        verbs.make_case(
            (9, 7), **PLAIN | {"depths_um": depths}, **WINDOW, offset_um=offset
        )


FILMS = Layers(
    front=(Film(Index(1.5), 40.0),),
    behind=(Film(Index(2.1), 300.0), Film(Index(1.4), 120.0)),
)


def snell(tangent, gap=480.0, films=((2.1, 300.0), (1.4, 120.0))):
    """Sideways way of a ray of this tangent in air, through each film by its own angle."""
    sine = math.sin(math.atan(tangent))
    return gap * tangent + sum(t * math.tan(math.asin(sine / n)) for n, t in films)


def test_the_chief_ray_goes_through_films_by_snell():
    found = verbs.make_case(
        (9, 7),
        **PLAIN,
        **WINDOW,
        angle_rad=(0.4, 0.0),
        layers=FILMS,
        offset_um=(2.0, -3.0),
    )
    assert found.front == ((1.5, 40.0),)
    assert (found.behind.index, found.behind.thickness_um) == (
        (1.0, 2.1, 1.4),
        (480.0, 300.0, 120.0),
    )
    assert found.centre_um == pytest.approx((snell(math.tan(0.4)) + 2, -3.0))
    aside = verbs.make_case(
        (9, 7), **PLAIN, **WINDOW, angle_rad=(-0.3, 0.25), layers=FILMS
    )
    x, y = math.tan(-0.3), math.tan(0.25)
    way = snell(math.hypot(x, y)) / math.hypot(x, y)
    assert aside.centre_um == pytest.approx((way * x, way * y))


def test_the_chief_rays_place_grows_with_the_gap_alone():
    """d place / d distance is the tangent in the gap, whatever films follow."""
    behind = verbs.make_case((9, 7), **PLAIN, **WINDOW, layers=FILMS).behind
    distance = torch.tensor(900.0, dtype=torch.float64, requires_grad=True)
    for axis, slope in ((0, 0.5), (1, -0.2)):
        place = verbs.chief_ray_offset(behind, distance, (0.5, -0.2), axis)
        way = snell(math.hypot(0.5, 0.2)) / math.hypot(0.5, 0.2)
        assert float(place.detach()) == pytest.approx(way * slope)
        assert float(torch.autograd.grad(place, distance)[0]) == pytest.approx(slope)
        assert verbs.chief_ray_offset(None, 900.0, (0.5, -0.2), axis) == pytest.approx(
            900 * slope
        )


def test_films_of_no_thickness_count_for_nothing_and_a_stop_is_refused():
    empty = Layers(front=(Film(Index(1.5), 0.0),))
    assert verbs.film_settings(empty, 900.0, 0.83)["front"] == ()
    assert verbs.make_case((9, 7), **PLAIN, **WINDOW, layers=Layers()).behind is None
    with pytest.raises(PropagationError, match="a stop is no part"):
        verbs.make_case(
            (9, 7), **PLAIN, **WINDOW, layers=Layers(stop=Stop(100.0, 50.0))
        )


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("along", [0, 1])
def test_films_that_fill_the_gap_let_through_what_their_face_does(along, sign):
    """Air holds n sin θ below 1: in 30 um of index 2 that is a way of 30 / √3 = 17.32
    um from the lens's rim to the
    window's far corner. 20 x 12 pillars 0.5 um apart fill an ellipse, the window is 4 x
    2.4 um."""
    full = Layers(behind=(Film(Index(2.0), 30.0),))
    given = {"pitch_um": 0.5, "wavelength_um": 0.83, "sensor_distance_um": 30.0, "depths_um": math.inf,
             "window_um": (4.0, 2.4), "samples": (5, 3), "layers": full}  # fmt: skip
    bare = verbs.make_case((20, 12), **given)
    (high, wide), (down, across) = bare.half_size_um, bare.half_window_um
    turn = np.linspace(0, math.pi / 2, 4001)

    def way(off):
        """Farthest, over the rim, of the corner that lies beyond."""
        x, y = across + wide * np.cos(turn), down + high * np.sin(turn)
        return np.hypot(x + (off if along == 0 else 0), y + (off if along else 0)).max()

    off = float(
        np.interp(30 / math.sqrt(3), [way(a) for a in (8.0, 16.0)], [8.0, 16.0])
    )
    for _ in range(20):  # the way grows nearly as the offset
        off += 30 / math.sqrt(3) - way(off)
    for beside, passes in (
        (-0.1, True),
        (0.1, False),
    ):  # 64 places of the rim miss its farthest by 0.02 um
        offset = [0.0, 0.0]
        offset[along] = sign * (off + beside)
        if passes:
            verbs.make_case((20, 12), **given, offset_um=tuple(offset))
        else:
            with pytest.raises(
                PropagationError, match="do not leave the cover of index 1"
            ):
                verbs.make_case((20, 12), **given, offset_um=tuple(offset))


GEOMETRY = {"pitch_um": 0.5, "wavelength_um": 0.7, "sensor_distance_um": 31.0, "depths_um": (95.0, math.inf),
            "window_um": (4.0, 6.0), "samples": (2, 3), "angle_rad": (0.1, -0.2)}  # fmt: skip


def by_hand(phase, level):
    """Rayleigh-Sommerfeld, pillar by pillar: what comes in has amplitude 1, and phase 0
    at the lens's middle.
    """
    k, d, out = 2 * math.pi / 0.7, 31.0, np.zeros((2, 3, 2), complex)
    tx, ty = math.tan(0.1), math.tan(-0.2)
    long = math.sqrt(1 + tx * tx + ty * ty)
    for m in range(3):
        for n in range(2):
            u, v = d * tx + (n - 0.5) * 2.0, d * ty + (m - 1) * 2.0
            for (row, column), turn in np.ndenumerate(phase):
                x, y = (
                    (column - (phase.shape[1] - 1) / 2) * 0.5,
                    (row - (phase.shape[0] - 1) / 2) * 0.5,
                )
                far = (x * tx + y * ty) / long
                near = (
                    math.sqrt((x + 95 * tx) ** 2 + (y + 95 * ty) ** 2 + 95**2)
                    - 95 * long
                )
                r = math.sqrt((u - x) ** 2 + (v - y) ** 2 + d * d)
                spread = (
                    d
                    / (2 * math.pi * r * r)
                    * (1 / r - 1j * k)
                    * np.exp(1j * k * r)
                    * 0.25
                )
                pillar = level[row, column] * np.exp(1j * turn) * spread
                out[0, m, n] += pillar * np.exp(1j * k * near)
                out[1, m, n] += pillar * np.exp(1j * k * far)
    return out


def test_the_exact_sum_and_the_windowed_one_are_the_sum_over_pillars():
    rng = np.random.default_rng(4)
    phase, level = rng.uniform(-3, 3, (6, 5)), rng.uniform(0.2, 1, (6, 5))
    want = by_hand(phase, level)
    found = verbs.exact(phase, level, **GEOMETRY)
    assert found.shape == (2, 3, 2)
    assert (
        np.abs(found - want).max() < 1e-10 * np.abs(want).max()
    )  # rounding of phases of some 300 rad
    near = verbs.windowed(phase, level, tolerance=1e-6, **GEOMETRY)
    assert isinstance(near, np.ndarray)
    assert np.abs(near - want).max() < 3e-6 * np.abs(want).max()
    single = verbs.windowed(
        torch.tensor(phase, dtype=torch.float32), torch.tensor(level), **GEOMETRY
    )
    assert single.dtype == torch.complex64
    for tolerance in (0.0, 1.0, -1e-3):
        with pytest.raises(PropagationError, match="tolerance is"):
            verbs.windowed(phase, level, tolerance=tolerance, **GEOMETRY)
