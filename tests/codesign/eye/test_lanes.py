"""Lanes of the renderer's loops in plain Python: samples of textures by hand, dual
numbers by the rules of calculus.
"""

import math

import numpy as np
import pytest

from codesign.eye import lanes
from codesign.eye.textures import SIZE, STEPS

RNG = np.random.default_rng(23)
LANES = 4
STEPPED = RNG.integers(-STEPS, STEPS, (3, SIZE, SIZE))
PAIRS = (
    ((STEPPED & 0xFFFF) | (np.roll(STEPPED, -1, axis=2) << 16)).astype(np.int32).ravel()
)  # each with its right one


@pytest.fixture
def interpreted(monkeypatch):
    """The module without its compiler."""
    for name in ("locate", "look_up", "blend", "smooth"):
        function = getattr(lanes, name)
        monkeypatch.setattr(lanes, name, getattr(function, "py_func", function))
    return lanes


def step(s):
    return s * s * (3 - 2 * s)


def texture(k, u, v):
    """Periodic, by smooth steps between four pixels."""
    i, j = math.floor(u), math.floor(v)
    s, t = step(u - i), step(v - j)
    values = [
        [STEPPED[k, (j + b) % SIZE, (i + a) % SIZE] / STEPS for a in (0, 1)]
        for b in (0, 1)
    ]
    return (1 - t) * ((1 - s) * values[0][0] + s * values[0][1]) + t * (
        (1 - s) * values[1][0] + s * values[1][1]
    )


PLACES = [
    (0, 3.3, 7.9),
    (1, 255.25, 11.6),
    (2, -0.7, 255.4),
    (2, 130.5, -300.2),
    (1, 0.0, 64.0),
]


def looked_up(operations, k, u, v, x):
    """A sample as the loops take it: placed, looked up at once, blended; in lane 2 of
    4, words from 1 on.
    """
    words = np.zeros(3 * LANES, np.int32)
    operations["placed"](k, u, v, x, 2, words, 1)
    lanes.look_up(PAIRS, words, len(words))
    return operations["sampled"](x, 2, words, 1)


@pytest.mark.parametrize(("k", "u", "v"), PLACES)
def test_a_sample_lies_between_the_four_pixels_of_its_texture(interpreted, k, u, v):
    """float32 places of 300 pixels: 3e-5 of a pixel, over which a texture of noise
    changes by 1e-4.
    """
    found = looked_up(
        lanes.plain(LANES),
        k,
        np.float32(u),
        np.float32(v),
        np.zeros(3 * LANES, np.float32),
    )
    assert found == pytest.approx(texture(k, u, v), abs=1e-4)


@pytest.mark.parametrize(("k", "u", "v"), PLACES[:4])
def test_slopes_of_a_sample_are_those_of_the_texture(interpreted, k, u, v):
    du, dv = (0.7, -0.4), (-1.3, 2.1)
    given = [
        tuple(np.float32(n) for n in dual) for dual in ((k, 0, 0), (u, *du), (v, *dv))
    ]
    value, *slopes = looked_up(
        lanes.dual(LANES), *given, np.zeros(7 * LANES, np.float32)
    )
    assert value == pytest.approx(texture(k, u, v), abs=1e-4)
    for slope, along, down in zip(slopes, du, dv, strict=True):
        h = 1e-5
        want = (
            texture(k, u + h * along, v + h * down)
            - texture(k, u - h * along, v - h * down)
        ) / (2 * h)
        assert slope == pytest.approx(
            want, abs=3e-3
        )  # places as above, bends of up to 6 a pixel


SINGLE = {
    "neg": (lambda x: -x, (-0.8, 0.3)),
    "sqrt": (math.sqrt, (0.7, 3.1)),
    "unit": (lambda x: min(max(x, 0.0), 1.0), (-0.3, 0.4, 1.7)),
    "step": (lambda x: step(min(max((1 + x) / 2, 0.0), 1.0)), (-1.4, -0.6, 0.25, 1.2)),
}
DOUBLE = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "above": max,
}


@pytest.mark.parametrize(
    ("name", "at"), [(name, x) for name, (_, places) in SINGLE.items() for x in places]
)
def test_functions_of_one_dual_number_have_their_slope(interpreted, name, at):
    function, h = SINGLE[name][0], 1e-6
    value, *slopes = lanes.dual(LANES)[name]((at, 0.7, -1.9))
    assert value == pytest.approx(function(at), rel=1e-6)
    want = (function(at + h) - function(at - h)) / (2 * h)
    assert slopes == pytest.approx([0.7 * want, -1.9 * want], rel=1e-6, abs=1e-7)
    if name != "neg":
        assert lanes.plain(LANES)[name](at) == pytest.approx(function(at), rel=1e-6)


@pytest.mark.parametrize("name", DOUBLE)
@pytest.mark.parametrize(("a", "b"), [(1.7, -0.6), (-0.9, 2.3)])
def test_functions_of_two_dual_numbers_have_both_their_slopes(interpreted, name, a, b):
    function, h = DOUBLE[name], 1e-6
    one, two = (
        (a, 0.7, -1.9),
        (b, 0.0 if name == "above" else 1.1, 0.0 if name == "above" else 0.4),
    )
    value, *slopes = lanes.dual(LANES)[name](
        one, two
    )  # the lower bound is a number as it stands
    assert value == pytest.approx(function(a, b), rel=1e-6)
    for slope, da, db in zip(slopes, one[1:], two[1:], strict=True):
        want = (function(a + h * da, b + h * db) - function(a - h * da, b - h * db)) / (
            2 * h
        )
        assert slope == pytest.approx(want, rel=1e-6, abs=1e-7)


def test_numbers_are_kept_in_three_runs_of_lanes(interpreted):
    p = RNG.normal(size=(3, 5)).astype(np.float32)
    dual, x = lanes.dual(LANES), np.zeros(3 * LANES)
    assert dual["load"](p, 3) == tuple(p[:, 3])
    assert dual["fixed"](p, 3) == (p[0, 3], 0, 0)
    assert dual["number"](2.5) == (2.5, 0, 0)
    dual["store"]((1.5, 2.5, 3.5), x, 2)
    assert x.tolist() == [0, 0, 1.5, 0, 0, 0, 2.5, 0, 0, 0, 3.5, 0]
    assert dual["fetch"](x, 2) == (1.5, 2.5, 3.5)
    plain, y = lanes.plain(LANES), np.zeros(LANES)
    plain["store"](1.5, y, 2)
    assert y.tolist() == [0, 0, 1.5, 0]
    assert plain["fetch"](y, 2) == plain["number"](1.5) == 1.5
    assert plain["load"](p[0], 3) == plain["fixed"](p[0], 3) == p[0, 3]
