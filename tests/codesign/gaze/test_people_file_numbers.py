"""What people have in common in a file: every number where it was, and every odd one
named.
"""

from dataclasses import replace

import numpy as np
import pytest

from codesign.gaze import people_file
from codesign.gaze.shared import MixedModel, PopulationPrior
from metalens.core.errors import StoreError

RNG = np.random.default_rng(1)
MODEL = MixedModel(
    RNG.normal(size=(36, 2)), RNG.uniform(0.1, 2, (36, 2)), np.array([0.3, 0.7])
)
PEOPLE = PopulationPrior(MODEL, RNG.normal(size=7), RNG.uniform(0.5, 3, 7))


def test_a_file_holds_every_number_in_its_place(tmp_path):
    people_file.save_people(tmp_path / "p.h5", PEOPLE)
    again = people_file.load_people(tmp_path / "p.h5")
    parts = [
        (again.model.mean, MODEL.mean),
        (again.model.variance, MODEL.variance),
        (again.model.noise, MODEL.noise),
    ]
    for got, want in (
        *parts,
        (again.middle, PEOPLE.middle),
        (again.spread, PEOPLE.spread),
    ):
        assert np.array_equal(got, want)


def changed(name, value):
    if name in ("mean", "variance", "noise"):
        return replace(PEOPLE, model=replace(MODEL, **{name: value}))
    return replace(PEOPLE, **{name: value})


@pytest.mark.parametrize("name", ["variance", "noise", "spread"])
@pytest.mark.parametrize(
    ("odd", "read"),
    [(0.0, False), (-0.2, False), (1e-12, True), (np.nan, False), (np.inf, False)],
)
def test_what_spreads_is_above_zero_everywhere(tmp_path, name, odd, read):
    """One number of many, by a picounit above nothing or at it."""
    value = (getattr(MODEL, name) if name != "spread" else PEOPLE.spread).copy()
    value.flat[-1] = odd
    people_file.save_people(tmp_path / "p.h5", changed(name, value))
    if read:
        assert people_file.load_people(tmp_path / "p.h5")
    else:
        with pytest.raises(
            StoreError, match=f"p.h5: {name} of a shape or value that no people have"
        ):
            people_file.load_people(tmp_path / "p.h5")


@pytest.mark.parametrize(
    ("name", "shape"),
    [("mean", (35, 2)), ("mean", (36, 3)), ("variance", (37, 2)), ("variance", (36, 1)), ("noise", (3,)),
     ("noise", (1,)), ("middle", (6,)), ("middle", (8,)), ("spread", (6,)), ("spread", (8,))],
)  # fmt: skip
def test_shapes_are_those_of_seven_readings_and_their_products(tmp_path, name, shape):
    """1 + 7 + 28 terms of 7 readings, two angles."""
    people_file.save_people(tmp_path / "p.h5", changed(name, np.ones(shape)))
    with pytest.raises(StoreError, match=f"{name} of a shape"):
        people_file.load_people(tmp_path / "p.h5")


def test_values_of_any_sign_stand_where_nothing_spreads(tmp_path):
    made = changed("mean", -MODEL.mean)
    people_file.save_people(tmp_path / "p.h5", made)
    assert np.array_equal(
        people_file.load_people(tmp_path / "p.h5").model.mean, -MODEL.mean
    )
    people_file.save_people(tmp_path / "q.h5", changed("middle", np.full(7, -np.inf)))
    with pytest.raises(StoreError, match="middle"):
        people_file.load_people(tmp_path / "q.h5")
