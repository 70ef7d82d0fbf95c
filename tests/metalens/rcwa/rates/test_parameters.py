"""Every number of a pillar by its name: a change of it is a change of that number
alone, and steps are of its kind.
"""

import dataclasses

import pytest

from metalens.cell import Cell, Film, Index, Layer
from metalens.cell.shapes import Polygon
from metalens.rcwa.rates.parameters import pillar_parameters

CELL = Cell(
    0.41, 0.53, Index(2.7, 0.03), Index(1.45), Index(1.0), Index(1.1), 0.02,
    under=(Film(Index(1.9), 0.07), Film(Index(1.6), 0.25)),
    over=(Film(Index(1.3), 0.31),),
    shape=Polygon(((-0.5, -0.3), (0.5, -0.35), (0.1, 0.6)), 0.2),
    layers=(Layer(0.1, 0.03, Index(1.6)), Layer(0.43, between=Index(1.2, 0.01), coat=Index(1.9), coat_um=0.012)),
)  # fmt: skip
SIZE, WAVE = 0.23, 0.73
# times 1e-4: of 1 for angles, coordinates and indices, of the size for widths, of
# itself for lengths
STEPS = {
    "size_um": SIZE, "grow_um": SIZE, "sidewall_rad": 1.0, "shape.angle_rad": 1.0, "pillar.n": 1.0, "between.n": 1.0,
    **{f"shape.corners.{i}.{axis}": 1.0 for i in range(3) for axis in "xy"},
    "layers.0.height_um": 0.1, "layers.0.grow_um": SIZE, "layers.0.material.n": 1.0,
    "layers.1.height_um": 0.43, "layers.1.grow_um": SIZE, "layers.1.between.n": 1.0, "layers.1.coat_um": 0.012,
    "layers.1.coat.n": 1.0,
    # of 0.1 um at least
    "under.0.thickness_um": 0.1, "under.1.thickness_um": 0.25, "over.0.thickness_um": 0.31,
}  # fmt: skip


def flat(value, path=""):
    """{path: number} of a record of records."""
    if isinstance(value, dict | tuple):
        named = value.items() if isinstance(value, dict) else enumerate(value)
        return {
            key: number
            for name, part in named
            for key, number in flat(part, f"{path}.{name}").items()
        }
    return {path[1:]: value}


def test_a_pillar_has_these_numbers_and_no_other():
    assert {
        name: one.step for name, one in pillar_parameters(CELL, SIZE, WAVE).items()
    } == pytest.approx({name: 1e-4 * of for name, of in STEPS.items()}, rel=1e-12)
    plain = dataclasses.replace(CELL, layers=(), under=(Film(Index(1.9), 0.0),))
    assert pillar_parameters(plain, SIZE, WAVE)["height_um"].step == pytest.approx(
        1e-4 * 0.53
    )
    assert pillar_parameters(plain, SIZE, WAVE)["height_um"].moved(
        0.01
    ).cell.height_um == pytest.approx(0.54)


@pytest.mark.parametrize("name", STEPS)
def test_a_number_that_changes_is_that_one_alone(name):
    """The height of a pillar is that of its layers; a film thinner than 0.1 um is
    looked at as if it had that.
    """
    changed = pillar_parameters(CELL, SIZE, WAVE)[name].moved(0.007)
    was, now = flat(dataclasses.asdict(CELL)), flat(dataclasses.asdict(changed.cell))
    assert now.keys() == was.keys()
    apart = {key: now[key] - was[key] for key in was if now[key] != was[key]}
    grown = 0.03 if name == "under.0.thickness_um" else 0.0
    want = {name.replace(".x", ".0").replace(".y", ".1"): 0.007 + grown}
    if name in ("size_um", "grow_um"):
        want = {}
    elif name.endswith("height_um"):
        want["height_um"] = 0.007
    assert apart == pytest.approx(want, rel=1e-9)
    assert changed.size_um == pytest.approx(SIZE + 0.007 * (name == "size_um"))
    assert changed.grow_um == pytest.approx(0.007 * (name == "grow_um"))
