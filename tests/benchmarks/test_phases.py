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
    """outer: 3 s, then inner for 5, then 7 more, twice; the processor works a quarter
    of the time.
    """
    now, made = [0.0], ModuleType("made_up")
    clock = SimpleNamespace(
        perf_counter=lambda: now[0], process_time=lambda: now[0] / 4
    )

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
    monkeypatch.setattr(
        phases, "PHASES", (("whole", "made_up", "outer"), ("part", "made_up", "inner"))
    )
    with phases.timed() as spent:
        assert [made.outer(), made.outer()] == [11, 11]
    assert spent == {"part": (10.0, 2.5), "whole": (20.0, 5.0)}
    assert made.outer is outer


def test_images_and_jacobians_are_counted_in_the_innermost_phase(monkeypatch):
    """Two images and a Jacobian in the inner phase, one image in the outer one after
    it, one outside both.
    """
    made = ModuleType("made_up")

    class Model:
        def images(self, x, wanted=None):
            return x, wanted

    def inner():
        return [
            made.Model().images(1),
            made.Model().images(2),
            made.Model().images(3, ["bias_nm"]),
        ]

    def outer():
        return [*made.inner(), made.Model().images(4)]

    made.Model, made.inner, made.outer = Model, inner, outer
    monkeypatch.setitem(sys.modules, "made_up", made)
    monkeypatch.setattr(phases, "MODEL", ("made_up", "Model"))
    monkeypatch.setattr(
        phases, "PHASES", (("whole", "made_up", "outer"), ("part", "made_up", "inner"))
    )
    with phases.counted() as counts:
        assert made.outer() == [(1, None), (2, None), (3, ["bias_nm"]), (4, None)]
        made.Model().images(5)
    assert counts == {"part": [2, 1], "whole": [1, 0], "": [1, 0]}
    made.outer()
    assert counts["whole"] == [1, 0]
