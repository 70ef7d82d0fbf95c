"""Films and a stop by similar triangles, rays traced through the media one plane at a
time, and Fresnel by hand.
"""

import math

import numpy as np
import pytest

from metalens.cell.record import Film, Index
from metalens.ground.errors import PropagationError
from metalens.lens import Layers, Stop, check_gaps, stop

WAVE = 0.79
GLASS, RESIN = Film(Index(1.7), 120.0), Film(Index(1.3), 50.0)
FAR = Layers(
    front=(RESIN, GLASS), stop=Stop(70.0, 150.0)
)  # 30 um of the resin lie behind the stop


def traced(sine, order, start=(0.0, 0.0)):
    """(x, y) of a ray of this n sin θ (x, y) after plane-parallel media [(index,
    thickness)].
    """
    place = np.array(start, float)
    for n, t in order:
        place += t * np.array(sine) / math.sqrt(n * n - math.hypot(*sine) ** 2)
    return place


def test_the_error_behind_a_stop_counts_the_zones_of_the_blur():
    """In air L = 250 (1900 - 250) / 1900 by similar triangles; zones are R b / (λ d),
    over the fourth root of what of
    the light is looked at."""
    open_, z = Layers(stop=Stop(90.0, 250.0)), 1900.0
    number = 90.0**2 / (WAVE * 250.0 * (z - 250.0) / z)
    zones = 90.0 * 0.013 / WAVE
    for blur, part, seen in (
        (0.0, 0.37, 0.0),
        (0.013, 1.0, zones),
        (0.013, 0.37, zones / 0.37**0.25),
    ):
        got = open_.shadow_error((0.0, 0.0), z, WAVE, blur, part)
        assert got == pytest.approx((stop.BENT + stop.INNER * seen) / number, rel=1e-12)
    assert open_.shadow_error((0.0, 0.0), z, WAVE, 0.013) == open_.shadow_error(
        (0.0, 0.0), z, WAVE, 0.013, 1.0
    )
    assert open_.shadow_error((0.0, 0.0), z, WAVE) == pytest.approx(
        stop.BENT / number, rel=1e-12
    )
    assert open_.open.shadow_error((0.1, 0.2), z, WAVE, 0.013, 0.37) == 0.0


@pytest.mark.parametrize(
    ("distance", "want"),
    [
        (0.0, None),
        (90.0, ((1.7, 90.0),)),
        (120.0, ((1.7, 120.0),)),
        (150.0, ((1.3, 30.0), (1.7, 120.0))),
        (190.0, ((1.0, 20.0), (1.3, 50.0), (1.7, 120.0))),
    ],
)
def test_media_behind_a_stop_are_the_last_of_the_films_and_air_where_they_end(
    distance, want
):
    found = Layers(front=(RESIN, GLASS), stop=Stop(70.0, distance)).from_stop(WAVE)
    assert (found is None) == (want is None)
    if want is not None:
        assert tuple(found.layers) == want
    bare = Layers(stop=Stop(70.0, distance)).from_stop(WAVE)
    assert (bare is None) == (distance == 0)
    assert bare is None or bare.layers == [(1.0, distance)]


@pytest.mark.parametrize("middle", [(0.0, 0.0), (23.0, -41.0)])
def test_the_ray_through_the_middle_of_a_stop_starts_where_the_one_through_the_lens_does(
    middle,
):
    """From one source 2000 um away, traced through air, resin and glass: one ray ends
    on the lens' middle, the other
    at the stop's middle, 150 um before the lens."""
    layers = Layers(front=(RESIN, GLASS), stop=Stop(70.0, 150.0, middle))
    tangents = np.array([[0.21, -0.13], [-0.4, 0.05], [0.0, 0.0]])
    found = layers.through_middle(tangents, 2000.0, WAVE)
    for start, slopes in zip(tangents, found, strict=True):
        source = -traced(
            start / math.hypot(1, *start), [(1.0, 1830.0), (1.3, 50.0), (1.7, 120.0)]
        )
        through = traced(
            slopes / math.hypot(1, *slopes), [(1.0, 1830.0), (1.3, 20.0)], source
        )
        assert through == pytest.approx(np.array(middle), abs=1e-6)
    assert layers.through_middle(tangents, math.inf, WAVE) is tangents
    assert layers.open.through_middle(tangents, 2000.0, WAVE) is tangents


@pytest.mark.parametrize("depth", [2.0, 2000.0])
def test_a_stop_beside_the_axis_on_the_pillars_is_seen_along_a_straight_line(depth):
    """In air alone the source stands at -z t, and the slope to a place c of the lens is
    t + c / z, at any distance.
    """
    at_lens = Layers(stop=Stop(0.2, 0.0, (0.3, -0.7)))
    found = at_lens.through_middle(np.array([[0.21, -0.13]]), depth, WAVE)
    assert found == pytest.approx(
        np.array([[0.21 + 0.3 / depth, -0.13 - 0.7 / depth]]), rel=1e-12
    )
    before = Layers(stop=Stop(0.2, 1.5, (0.3, -0.7))).through_middle(
        np.array([[0.21, -0.13]]), depth, WAVE
    )
    slopes = (0.21 * depth + 0.3) / (depth - 1.5), (-0.13 * depth - 0.7) / (depth - 1.5)
    assert before == pytest.approx(np.array([slopes]), rel=1e-12)


def test_the_largest_ghost_is_of_the_two_faces_that_reflect_most():
    """Fresnel at normal incidence: air to 1.7, 1.7 to 1.3; behind the pillars resin
    1.45 to 3.1 and back to 1.2.
    """
    faces = [((a - b) / (a + b)) ** 2 for a, b in ((1.0, 1.7), (1.7, 1.3))]
    front = Layers(front=(Film(Index(1.7), 80.0), RESIN))
    assert front.ghost(WAVE) == pytest.approx(faces[0] * faces[1], rel=1e-12)
    assert (
        Layers(front=(GLASS,)).ghost(WAVE) == 0.0
    )  # one face alone: there is no second
    assert Layers().ghost(WAVE) == 0.0
    behind = (Film(Index(3.1), 20.0), Film(Index(1.2), 30.0), Film(Index(1.45), 30.0))
    most = sorted(
        (((a - b) / (a + b)) ** 2 for a, b in ((1.45, 3.1), (3.1, 1.2), (1.2, 1.45))),
        reverse=True,
    )[:2]
    both = Layers(front=(GLASS,), behind=behind, cover=Index(1.45))
    assert both.ghost(WAVE) == pytest.approx(math.prod(most), rel=1e-12)
    assert Layers(front=front.front, behind=behind, cover=Index(1.45)).ghost(
        WAVE
    ) == both.ghost(WAVE)


def test_light_of_a_stop_by_similar_triangles():
    assert Layers(stop=Stop(70.0, 250.0)).footprint_um(1900.0, WAVE) == pytest.approx(
        70 * 1900 / 1650, rel=1e-12
    )
    outside = 1830 + 20 / 1.3
    assert FAR.footprint_um(2000.0, WAVE) == pytest.approx(
        70 * (outside + 30 / 1.3 + 120 / 1.7) / outside
    )
    assert FAR.open.footprint_um(2000.0, WAVE) == math.inf
    assert FAR.open.lit((0.1, 0.2), 2000.0, WAVE, (1.0, 2.0), 0.5) == 1.0
    shape = FAR.open.shadow(
        (0.1, 0.2), 2000.0, WAVE, (np.zeros((3, 1)), np.zeros(5)), 0.5
    )
    assert shape.shape == (3, 5)
    assert (shape == 1).all()
    for where in (90.0, 150.0):
        with pytest.raises(
            PropagationError,
            match=f"a source {where:g} um before the pillars lies behind the stop",
        ):
            FAR.lit((0.1, 0.2), where, WAVE, (1.0, 2.0), 0.5)
    assert (
        Layers(stop=Stop(70.0, 0.5)).lit(
            (0.0, 0.0), 0.6, WAVE, (np.array([1.0]), np.array([2.0])), 0.5
        )
        == 1.0
    )


def test_plain_is_what_holds_nothing_but_air():
    thin = Film(Index(1.5), 0.0)
    assert all(
        one.plain
        for one in (
            Layers(),
            Layers(cover=Index(1.0), stop=Stop(3.0, 1.0)),
            Layers((thin,), (thin,)),
        )
    )
    assert not any(
        one.plain
        for one in (Layers(cover=Index(2.0)), Layers((GLASS,)), Layers(behind=(GLASS,)))
    )


def test_a_film_that_absorbs_more_than_two_in_a_hundred_is_refused_and_the_rest_is_air():
    """1 - exp(-4 π k t / λ) = 0.02 at k t / λ = 1.6077e-3; films as thick as the gap
    leave no air.
    """
    least = -math.log(0.98) / (4 * math.pi) * WAVE / 31.0
    lossy = [
        Layers(behind=(Film(Index(1.4, k), 31.0),))
        for k in (0.999 * least, 1.001 * least)
    ]
    assert lossy[0].after(90.0, WAVE).layers == [(1.0, 59.0), (1.4, 31.0)]
    assert lossy[0].after(31.0, WAVE).layers == [(1.4, 31.0)]
    with pytest.raises(PropagationError, match=r"lens to sensor absorb 2\.0%"):
        lossy[1].after(90.0, WAVE)
    with pytest.raises(
        PropagationError, match="films of 31 um in the 30 um from lens to sensor"
    ):
        lossy[0].after(30.0, WAVE)
    check_gaps(FAR, 1.0, 170.0)
    with pytest.raises(
        PropagationError, match="films of 170 um in the 169 um from source to lens"
    ):
        check_gaps(FAR, 1.0, 169.0)
