"""A few designs of the soak: what it calls a fault, and that there is none."""

import json
import math

import pytest

from benchmarks import soak
from metalens.ground import store


def test_faults_are_told_from_honest_ends(tmp_path):
    good, absent = {"a": 1.0, "rows": [{"b": 2.0}]}, tmp_path / "x"
    assert list(soak._faults("psf", 0, good, "", absent)) == []
    assert (
        list(soak._faults("fit", 1, {"chi2": math.nan}, "fails its check", absent))
        == []
    )  # said so by its status
    assert list(soak._faults("psf", 0, {"rows": [{"b": math.nan}]}, "", absent)) == [
        "psf: result.rows.b is not finite"
    ]
    assert list(soak._faults("psf", 2, None, "", absent)) == ["refused without a word"]
    assert list(soak._faults("psf", "ValueError: x", None, "", absent)) == [
        "crash: ValueError: x"
    ]
    store.save(tmp_path / "y.h5", "psf", {"image": [1.0, math.inf]})
    assert list(soak._faults("psf", 0, good, "", tmp_path / "y.h5")) == [
        f"{tmp_path / 'y.h5'}: image is not finite"
    ]
    assert "is there" in next(soak._faults("psf", 2, None, "no", tmp_path / "y.h5"))


def test_a_seed_gives_the_same_design(tmp_path, monkeypatch):
    monkeypatch.setattr(soak, "library", lambda work, kind: work / f"{kind}.h5")
    assert soak.files(tmp_path, 3, 5) == soak.files(tmp_path, 3, 5)
    assert soak.files(tmp_path, 3, 5) != soak.files(tmp_path, 3, 6)


@pytest.mark.slow
def test_random_designs_go_through_the_chain(tmp_path):
    soak.soak(tmp_path, 4, seed=1)
    lines = [
        json.loads(line)
        for line in (tmp_path / "soak_1.jsonl").read_text().splitlines()
    ]
    assert [f for line in lines for end in line["ends"] for f in end["faults"]] == []
    assert any(
        end["verb"] == "fit" and end["status"] == 0
        for line in lines
        for end in line["ends"]
    )
