"""Compiled loops give the same bytes in the process that compiles them and in those
that find them in the cache.

A function that a loop calls is optimised by itself, and once more inside the library of
the loop. The process that
compiles both runs the first, one that loads the library the second; with sums in any
order they round otherwise.
"""

import importlib
import re
from pathlib import Path

import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

ROOT = Path(__file__).parents[1]
PLACES = ("metalens", "layout", "characterize", "codesign")
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for place in PLACES
    for path in sorted((ROOT / place).rglob("*.py"))
    if re.search(r"^\s*@.*njit\(.*cache=True", path.read_text(encoding="utf-8"), re.M)
]


def loops(module):
    """Functions of a module that are compiled, kept in the cache, and may sum in any
    order.
    """
    for name, value in vars(importlib.import_module(module)).items():
        kept = isinstance(value, Dispatcher) and not isinstance(value._cache, NullCache)
        if kept and value.targetoptions.get("fastmath"):
            yield name, value


def called(loop):
    """Compiled functions that a loop calls, by name."""
    known = loop.py_func.__globals__
    return {
        name: known[name]
        for name in loop.py_func.__code__.co_names
        if isinstance(known.get(name), Dispatcher)
    }


@pytest.mark.parametrize("module", MODULES)
def test_what_a_cached_loop_calls_is_put_into_it(module):
    for name, loop in loops(module):
        for callee, function in called(loop).items():
            put = function.targetoptions
            assert put.get("forceinline") or put.get("inline") == "always", (
                f"{module}.{name} calls {callee}"
            )


def test_the_loops_are_found():
    assert MODULES
    assert "render_strips" in dict(loops("codesign.eye.kernel"))
