"""``python -m benchmarks``: what it is asked is what it runs."""

import importlib
import json
from dataclasses import asdict, replace

import pytest

from benchmarks import Row, modal
from benchmarks.__main__ import LONG, main, table
from benchmarks._stored import compared, machine
from metalens.modal import engine


def test_topics_that_are_not_there_are_refused_before_any_work(capsys):
    for words in (["psfs"], ["--peer-rows"], ["psf", "nothing"]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 2
    assert "invalid choice: 'psfs'" in capsys.readouterr().err


def test_help_runs_nothing(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "chain" in capsys.readouterr().out


def test_what_takes_long_is_a_topic():
    for name in LONG:
        assert importlib.import_module(f"benchmarks.{name}").rows


def test_rows_are_told_with_their_error():
    told = table(
        [
            Row("case", "method", 0.0123, 2.5e-4, "exact sum", 2, 17.6, "<= 1"),
            Row("b", "c", 1.0, float("nan"), "-"),
        ]
    )
    head, one, other = told.splitlines()
    assert one.endswith(" <= 1")
    assert [
        one[head.index(word) :].split()[0]
        for word in ("threads", "time/ms", "peak/MB", "error")
    ] == [
        "2",
        "12.3",
        "18",
        "0.00025",
    ]
    assert other[head.index("error") :].split() == ["-", "-"]


def test_rows_made_anew_are_told_beside_the_stored_ones_of_their_case_and_method(
    tmp_path,
):
    old = [
        Row("lens", "fast", 2.0, 1e-3, "sum"),
        Row("lens", "fast", 4.0, float("nan"), "-"),
        Row("gone", "x", 1.0, 0.0, "-"),
    ]
    path = tmp_path / "topic.json"
    path.write_text(json.dumps({"rows": [asdict(row) for row in old]}))
    new = [
        replace(old[0], seconds=5.0, error=1.5e-3),
        replace(old[1], seconds=3.0),
        replace(old[0], method="slow"),
    ]
    assert compared(path, new).splitlines() == [
        "lens, fast: time x2.5, error x1.5",
        "lens, fast: time x0.75, error -",
        "lens, slow: not stored",
        "gone, x: stored only",
    ]
    assert compared(tmp_path / "none.json", new[:1]) == "lens, fast: not stored"


def test_a_machine_tells_its_speed_by_jobs_of_their_own():
    speed = machine()["speed"]
    assert set(speed) == {"products_gflops", "transform_ms", "loop_ms"}
    assert all(value > 0 for value in speed.values())


def test_solves_of_the_modal_benchmark_find_nothing_of_those_before():
    modal.solve(modal.CELL, 0.1, 0.85, tolerance=1e-2)
    held = engine.geometry, engine.kept, engine.kept_long
    assert any(cache.cache_info().currsize for cache in held)
    modal.forget()
    assert [cache.cache_info().currsize for cache in held] == [0, 0, 0]
