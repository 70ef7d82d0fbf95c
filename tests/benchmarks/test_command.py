"""``python -m benchmarks``: what it is asked is what it runs."""

import importlib

import pytest

from benchmarks import Row
from benchmarks.__main__ import LONG, main, table


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
        [Row("case", "method", 0.0123, 2.5e-4, "exact sum", 2, 17.6, "<= 1"), Row("b", "c", 1.0, float("nan"), "-")]
    )
    head, one, other = told.splitlines()
    assert one.endswith(" <= 1")
    assert [one[head.index(word) :].split()[0] for word in ("threads", "time/ms", "peak/MB", "error")] == [
        "2",
        "12.3",
        "18",
        "0.00025",
    ]
    assert other[head.index("error") :].split() == ["-", "-"]
