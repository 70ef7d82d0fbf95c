"""How work is cut among threads, by counts: parts, threads side by side, and what the C
library is told.
"""

import os
import sys
import threading
from types import SimpleNamespace

import pytest
import torch

from metalens.ground import threads


@pytest.fixture
def told():
    """Sets torch's threads, and brings them back."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("count", "own", "parts"),
    [
        (11, 3, {(0, 3), (3, 7), (7, 11)}),
        (11, 1, {(0, 11)}),
        (2, 3, {(0, 1), (1, 2)}),
        (1, 3, {(0, 1)}),
        (0, 3, {(0, 0)}),
    ],
)
@pytest.mark.parametrize("way", [threads.split, threads.apart])
def test_parts_are_even_to_one_and_no_more_than_items(told, way, count, own, parts):
    told(own)
    seen = []
    way(count, lambda start, stop: seen.append((start, stop)))
    assert len(seen) == len(parts)
    assert set(seen) == parts


def test_the_first_part_is_done_by_who_asks(told):
    told(3)
    seen = {}
    threads.split(
        7, lambda start, stop: seen.setdefault(start, threading.current_thread())
    )
    assert seen[0] is threading.current_thread()
    assert seen[2] is not seen[0]
    assert set(seen) == {0, 2, 4}


def test_sixteen_items_are_side_by_side_at_the_most(told):
    told(20)
    gate, who = threading.Barrier(16, timeout=60), []

    def work(item):
        gate.wait()  # fewer would wait here for ever
        who.append(threading.current_thread())
        return item * 3

    assert threads.each(work, range(32)) == [3 * n for n in range(32)]
    assert len(set(who)) == 16
    told(3)
    here = threading.current_thread()
    assert threads.each(lambda _: threading.current_thread() is here, [1, 2]) == [
        False,
        False,
    ]
    assert threads.each(lambda _: threading.current_thread() is here, [1]) == [True]
    assert threads.each(str, []) == []


@pytest.mark.parametrize(
    ("words", "count"), [("7", 7), ("0", 1), ("two", None), ("", None), ("-3", None)]
)
def test_without_torch_the_environment_or_the_cores_tell(monkeypatch, words, count):
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setenv("OMP_NUM_THREADS", words)
    assert threads.threads() == (
        len(os.sched_getaffinity(0)) if count is None else count
    )


def test_the_c_library_is_told_to_keep_a_gibibyte_and_all_of_its_heap(monkeypatch):
    """M_MMAP_THRESHOLD is -3 and M_TRIM_THRESHOLD -1 in malloc.h; both are needed."""
    threads.keep_memory.cache_clear()
    for answers, want in (((1, 1), True), ((0, 1), False), ((1, 0), False)):
        asked = []

        def tune(name, value, asked=asked, answers=answers):
            asked.append((name, value))
            return answers[len(asked) - 1]

        monkeypatch.setattr(
            threads.ctypes,
            "CDLL",
            lambda name, tune=tune: SimpleNamespace(mallopt=tune),
        )
        assert threads.keep_memory() is want
        assert asked == [(-3, 1 << 30), (-1, (1 << 31) - 1)][: 1 + answers[0]]
        threads.keep_memory.cache_clear()
    monkeypatch.setattr(threads.ctypes, "CDLL", lambda name: SimpleNamespace())
    assert threads.keep_memory() is False
    threads.keep_memory.cache_clear()
