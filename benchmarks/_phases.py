"""Where a fit's time goes: seconds of each of its phases, found by wrapping the functions that they are."""

import contextlib
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any
from unittest import mock

_HOME = "characterize.inference."
PHASES = (  # what it is, the module that calls it, the name that it calls it by
    ("pillars under change", _HOME + "estimate", "slopes"),
    ("pillars gathered on nodes", _HOME + "estimate", "ForwardModel"),
    ("arrangement of the frames", _HOME + "estimate", "arrange"),
    ("terms that the light asks for", _HOME + "estimate", "quick_enough"),
    ("short fits from the starts", _HOME + "search", "_short"),
    ("fits to the end", _HOME + "search", "_long"),
    ("fits of other valleys", _HOME + "search", "followed"),
    ("walks that look for valleys", _HOME + "walk", "valleys"),
    ("walks along valleys", _HOME + "walk", "walk"),
    ("residual phase", _HOME + "residual", "attempt"),
    ("profiles and draws", _HOME + "explore", "explore"),
    ("causes that are not fitted", _HOME + "missing", "leans"),
    ("frames left out", _HOME + "explore", "left_out"),
    ("predicted error", _HOME + "explore", "predicted_error"),
)


@contextlib.contextmanager
def timed() -> Iterator[dict[str, tuple[float, float]]]:
    """{phase: (seconds, processor seconds)} of the fits inside; a phase inside another is counted by itself only."""
    spent: dict[str, tuple[float, float]] = {}
    inner: list[list[float]] = [[0.0, 0.0]]

    def wrapped(phase: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **named: Any) -> Any:
            start = time.perf_counter(), time.process_time()
            inner.append([0.0, 0.0])
            try:
                return work(*given, **named)
            finally:
                whole = time.perf_counter() - start[0], time.process_time() - start[1]
                under, before = inner.pop(), spent.get(phase, (0.0, 0.0))
                spent[phase] = before[0] + whole[0] - under[0], before[1] + whole[1] - under[1]
                inner[-1] = [inner[-1][0] + whole[0], inner[-1][1] + whole[1]]

        return run

    with contextlib.ExitStack() as stack:
        for phase, home, name in PHASES:
            module = import_module(home)
            stack.enter_context(mock.patch.object(module, name, wrapped(phase, getattr(module, name))))
        yield spent
