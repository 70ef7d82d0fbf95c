"""Output of commands: lines, JSON, silence, and progress that passes every item
through.
"""

import json

from metalens.core.console import Console


def test_plain_lines_and_results(capsys):
    console = Console()
    console.say("hello")
    console.result({"a": 1}, "a is 1")
    assert capsys.readouterr().out == "hello\na is 1\n"


def test_json_is_the_only_output(capsys):
    console = Console(json=True)
    console.say("hello")
    assert list(console.track(range(3), total=3, label="work")) == [0, 1, 2]
    console.result({"a": 1.5}, "text")
    assert json.loads(capsys.readouterr().out) == {"a": 1.5}


def test_quiet_says_nothing(capsys):
    console = Console(quiet=True)
    console.say("hello")
    console.result({"a": 1}, "text")
    assert capsys.readouterr().out == ""


def test_a_failed_check_is_told_and_ends_with_1(capsys):
    assert Console().judged({"a": 1}, "a is 1", ["", "b is 3, need 2"]) == 1
    assert capsys.readouterr().out == "a is 1\n  FAILED: b is 3, need 2\n"
    assert Console(json=True).judged({"a": 1}, "a is 1", ["b is 3"]) == 1
    assert json.loads(capsys.readouterr().out) == {"a": 1, "failures": ["b is 3"]}
    assert Console(quiet=True).judged({}, "a is 1", ["b is 3"]) == 1


def test_empty_words_are_no_failure(capsys):
    assert Console().judged({"a": 1}, "a is 1", ["", ""]) == 0
    assert capsys.readouterr().out == "a is 1\n"


def test_progress_without_a_terminal_is_plain_lines_with_rate_and_time_left(
    capsys, monkeypatch
):
    import time

    clock = iter(range(0, 1000, 11))
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))
    assert list(Console().track("abc", total=3, label="solve")) == ["a", "b", "c"]
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "solve: 1/3, 0.0909/s, 22 s left"
    assert len(lines) == 3


def test_progress_on_a_terminal_is_a_bar_that_leaves_nothing(monkeypatch, capsys):
    import sys

    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert list(Console().track(range(4), total=4, label="solve")) == [0, 1, 2, 3]
