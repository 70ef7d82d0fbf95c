"""Times of phases by a clock that the test moves."""

import sys
from importlib import import_module
from types import ModuleType, SimpleNamespace

import pytest

from benchmarks import _phases as phases


@pytest.mark.parametrize("phase", phases.PHASES, ids=lambda phase: phase[0])
def test_a_phase_is_something_that_the_fit_calls(phase):
    _, home, name = phase
    assert callable(getattr(import_module(home), name))


def test_time_inside_another_phase_is_counted_once(monkeypatch):
    """outer: 3 s, then inner for 5, then 7 more, twice; the processor works a quarter of the time."""
    now, made = [0.0], ModuleType("made_up")
    clock = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: now[0] / 4)

    def passes(seconds):
        now[0] += seconds

    def outer():
        passes(3.0)
        made.inner()
        passes(7.0)
        return 11

    made.inner, made.outer = lambda: passes(5.0), outer
    monkeypatch.setitem(sys.modules, "made_up", made)
    monkeypatch.setattr(phases, "time", clock)
    monkeypatch.setattr(phases, "PHASES", (("whole", "made_up", "outer"), ("part", "made_up", "inner")))
    with phases.timed() as spent:
        assert [made.outer(), made.outer()] == [11, 11]
    assert spent == {"part": (10.0, 2.5), "whole": (20.0, 5.0)}
    assert made.outer is outer
