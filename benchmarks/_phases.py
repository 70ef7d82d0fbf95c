"""Where a fit's time goes: seconds, images and Jacobians of each of its phases, found
by wrapping the functions.
"""

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
    ("causes that are not fitted", _HOME + "missing", "look"),
    ("frames left out", _HOME + "verdict", "left_out"),
    ("predicted error", _HOME + "verdict", "predicted_error"),
)
MODEL = "characterize.model.forward", "ForwardModel"


@contextlib.contextmanager
def timed() -> Iterator[dict[str, tuple[float, float]]]:
    """{phase: (seconds, processor seconds)} of the fits inside; a phase inside another
    is counted by itself only.
    """
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
                spent[phase] = (
                    before[0] + whole[0] - under[0],
                    before[1] + whole[1] - under[1],
                )
                inner[-1] = [inner[-1][0] + whole[0], inner[-1][1] + whole[1]]

        return run

    with contextlib.ExitStack() as stack:
        for phase, home, name in PHASES:
            module = import_module(home)
            stack.enter_context(
                mock.patch.object(module, name, wrapped(phase, getattr(module, name)))
            )
        yield spent


@contextlib.contextmanager
def counted() -> Iterator[dict[str, list[int]]]:
    """{phase: [images, Jacobians]} that the forward model of the fits inside computed;
    "" is outside all phases.
    """
    made: dict[str, list[int]] = {}
    where = [""]
    home = import_module(MODEL[0])
    images = getattr(home, MODEL[1]).images

    def wrapped(phase: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **named: Any) -> Any:
            where.append(phase)
            try:
                return work(*given, **named)
            finally:
                where.pop()

        return run

    def one(self: Any, x: Any, wanted: Any = None) -> Any:
        made.setdefault(where[-1], [0, 0])[int(wanted is not None)] += 1
        return images(self, x, wanted)

    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(getattr(home, MODEL[1]), "images", one))
        for phase, module, name in PHASES:
            found = import_module(module)
            stack.enter_context(
                mock.patch.object(found, name, wrapped(phase, getattr(found, name)))
            )
        yield made
