"""Model code as loops over lanes: run as plain Python in float64, it gives what the
model gives; textures as pairs.
"""

import ast
import math

import numpy as np
import pytest
import torch

from codesign.eye import inline as render_inline
from codesign.eye import kernel as render_kernel
from codesign.eye import model as render_model
from codesign.eye import ops as render_ops
from codesign.eye import textures

LANES = 3
SLOTS = {name: k * LANES for k, name in enumerate(render_kernel.NAMES)}


def _plain(bank):
    """The operations of a pass as plain functions of Python floats; samples are kept
    whole in place of coordinates.
    """
    kept = {}

    def placed(index, u, v, x, at, words, to):
        kept[at] = float(
            render_ops.tex(bank, torch.tensor(index), torch.tensor(u), torch.tensor(v))
        )

    def step(x):
        return float(render_ops.step(torch.tensor(x, dtype=torch.float64)))

    def store(value, x, at):
        x[at] = value

    return {
        "number": float,
        "load": lambda p, k: p[k],
        "fixed": lambda p, k: p[k],
        "fetch": lambda x, at: x[at],
        "store": store,
        "placed": placed,
        "sampled": lambda x, at, words, to: kept[at],
        "look_up": lambda t, words, count: None,
        "sqrt": math.sqrt,
        "unit": lambda x: min(max(x, 0.0), 1.0),
        "above": max,
        "step": step,
    }


def _run(source, x, p, bank):
    scope = _plain(bank)
    exec(render_inline.loops(source, SLOTS, lanes=LANES, dual=False), scope)
    scope["run"](p, None, x, None)


def test_a_pass_computes_what_the_model_computes():
    """Nested calls, reassigned names and two textures, at random arguments."""
    rng = np.random.default_rng(0)
    bank = torch.from_numpy(rng.uniform(-1, 1, (80, 16, 16)))
    p = list(rng.uniform(0.5, 2.0, render_model.COUNT))
    for place in range(render_model.T_IRIS, render_model.T_LASH + 1):
        p[place] = float(place)
    x = list(rng.uniform(0.1, 1.0, len(SLOTS) * LANES))
    sclera = ("gx", "gy", "lower", "mx", "my", "mz", "r", "inside")
    skin = ("s", "gx", "gy", "upper", "lower", "dx", "dy", "dz", "nx", "ny", "nz")
    for source, names, function, out in (
        (render_kernel.WHITE, sclera, render_model.sclera, "white"),
        (f"near = skin(p, t, {', '.join(skin)})", skin, render_model.skin, "near"),
    ):
        _run(source, x, p, bank)
        for lane in range(LANES):
            values = [
                torch.tensor(x[SLOTS[name] + lane], dtype=torch.float64)
                for name in names
            ]
            want = function(
                [torch.tensor(v, dtype=torch.float64) for v in p], bank, *values
            )
            assert x[SLOTS[out] + lane] == pytest.approx(float(want), rel=1e-12)


def test_lines_that_a_loop_can_spare_are_left_out():
    code = render_inline.loops(render_kernel.WHITE, SLOTS, lanes=LANES, dual=False)
    first = code.split("look_up")[0]
    assert (
        "fetch(x, {} + lane)".format(SLOTS["lower"]) not in first
    )  # the tear film needs no texture coordinate
    assert code.count("for lane in range") == 2


def test_every_name_of_a_pass_is_assigned_once():
    code = render_inline.loops(render_kernel.SKIN, SLOTS, lanes=LANES, dual=True)
    loop = ast.parse(code).body[0].body[-1]
    names = [
        ast.unparse(line.targets[0])
        for line in loop.body
        if isinstance(line, ast.Assign)
    ]
    assert len(names) == len(set(names))


def test_pairs_hold_every_texture_pixel_with_its_right_neighbour():
    bank, pairs = (
        textures.texture_bank(0),
        textures.packed_bank(0).reshape(-1, textures.SIZE, textures.SIZE),
    )
    steps = np.round(bank * textures.STEPS)
    np.testing.assert_array_equal((pairs << 16) >> 16, steps)
    np.testing.assert_array_equal(pairs >> 16, np.roll(steps, -1, axis=2))
    assert np.abs(bank).max() <= 1
