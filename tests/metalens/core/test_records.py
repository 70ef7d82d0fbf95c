"""Records go into files and come back: nested ones, absent ones, text and tuples."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import pytest

from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.store import Provenance


@dataclass(frozen=True)
class Settings:
    pitch_um: float = 0.37
    layers: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Part:
    values: Array
    share: float
    note: str = "none"


@dataclass(frozen=True, eq=False)
class Whole:
    part: Part
    flat: Part = field(metadata={"flat": True})
    settings: Settings
    names: tuple[str, ...]
    pairs: tuple[tuple[float, float], ...]
    by_name: dict[str, float]
    curves: dict[str, Array]
    count: int
    missing: Part | None = None
    extra: Array | None = None
    provenance: Provenance = field(default_factory=Provenance)


def whole(**changes):
    made = Whole(
        Part(np.array([[1.5, -2.0], [0.25, 7.0]]), np.float64(0.3), "größer"),
        Part(np.array([3 - 2j]), 0.75),
        Settings(0.41, ("SiO2", "TiO2")),
        ("bias_nm", "Höhe"),
        ((0.1, 0.2), (0.3, 0.45)),
        {"index": -0.02, "wall": 3.0},
        {"a": np.array([1.0, 2.0])},
        7,
    )
    return dataclasses.replace(made, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"names": (), "pairs": (), "by_name": {}, "curves": {}},
        {"missing": Part(np.arange(3), 1.0), "extra": np.array([True, False])},
    ],
    ids=["usual", "empty", "optional"],
)
def test_a_record_comes_back_from_its_file(tmp_path, changes):
    path, made = tmp_path / "a.h5", whole(**changes)
    store.save_record(path, "whole", made)
    back = store.load_record(path, "whole", Whole)
    for name in ("settings", "names", "pairs", "by_name", "count"):
        assert getattr(back, name) == getattr(made, name), name
    assert np.array_equal(back.part.values, made.part.values)
    assert (back.part.share, back.part.note) == (0.3, "größer")
    assert np.array_equal(back.flat.values, made.flat.values)
    assert (back.flat.share, back.flat.note) == (0.75, "none")
    assert back.curves.keys() == made.curves.keys()
    for name in ("missing", "extra"):
        assert (getattr(back, name) is None) == (getattr(made, name) is None)
    if made.missing is not None:
        assert np.array_equal(back.missing.values, np.arange(3))
    names = set(store.load(path, "whole").arrays)
    assert {"part/values", "values"} <= names
