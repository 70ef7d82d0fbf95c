"""Compiled loops use the threads that are theirs, with torch and without it."""

import os
import platform
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

from metalens.ground import threads

# a mask shop has no torch: a lens is designed and its focus checked all the same
WITHOUT_TORCH = """
import sys
import threading
sys.modules["torch"] = None
import numpy as np
from metalens.cell import Cell, Index
from metalens.design import check_focus, make
from metalens.ground.threads import threads
from metalens.profiles import Focus
from metalens.proxy import Proxy

phase = np.polynomial.Chebyshev.interpolate(lambda d: 55 * d, 2, domain=[0.08, 0.21]).coef[None]
proxy = Proxy(phase, np.array([[0.83]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0)
focus = Focus(0.85, 60.0, 900.0)
flat = lambda x, y: -np.pi / 0.85 * (1 / 60 + 1 / 900) * (x**2 + y[:, None] ** 2)
lens, _ = make(flat, focus, aperture_um=17.0, cell=Cell(pitch_um=0.30, pillar=Index(3.6)), proxy=proxy)
print(threads(), check_focus(lens).strehl > 0.9)
"""


@pytest.mark.parametrize(
    ("told", "count"), [("3", 3), ("0", 1), ("", len(os.sched_getaffinity(0)))]
)
def test_a_lens_is_designed_and_checked_where_there_is_no_torch(told, count):
    told_here = {**os.environ, "OMP_NUM_THREADS": told}
    words = [sys.executable, "-c", WITHOUT_TORCH]
    done = subprocess.run(
        words, capture_output=True, text=True, env=told_here, check=False
    )
    assert done.stdout.split() == [str(count), "True"], done.stderr[-2000:]


def test_every_part_is_done_once_by_torchs_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert threads.threads() == 3
        seen = np.zeros(11, int)

        def work(start, stop):
            seen[start:stop] += 1

        threads.split(11, work)
    finally:
        torch.set_num_threads(before)
    assert seen.tolist() == [1] * 11


@pytest.mark.parametrize("count", [1, 2, 5])
def test_calls_side_by_side_give_their_results_in_order(count):
    """Where there are threads, two calls wait for each other: one after the other they
    would not end.
    """
    before, gate = (
        torch.get_num_threads(),
        threading.Barrier(2 if count > 1 else 1, timeout=20),
    )
    torch.set_num_threads(count)
    try:
        made = threads.beside(
            lambda: (gate.wait(), 7)[1], lambda: (gate.wait(), "wide")[1]
        )
    finally:
        torch.set_num_threads(before)
    assert made == [7, "wide"]


def test_parts_that_stay_apart_have_one_thread_of_torch_each_and_give_them_back():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    seen, inside = np.zeros(11, int), []

    def work(start, stop):
        seen[start:stop] += 1
        inside.append(torch.get_num_threads())

    def broken(start, stop):
        raise ArithmeticError("of a part")

    try:
        threads.apart(11, work)
        assert (torch.get_num_threads(), inside, seen.tolist()) == (
            3,
            [1] * 3,
            [1] * 11,
        )
        with pytest.raises(ArithmeticError, match="of a part"):
            threads.apart(11, broken)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


@pytest.fixture
def three():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three")
def test_items_side_by_side_come_back_in_order_and_split_into_one_part_each():
    together, parts = threading.Barrier(3), []

    def work(item):
        together.wait(60)  # none ends before all three have begun
        threads.split(5, lambda start, stop: parts.append((start, stop)))
        return item**2

    assert threads.each(work, iter([7, 3, 5])) == [49, 9, 25]
    assert parts == [(0, 5)] * 3
    assert threads.threads() == 3


@pytest.mark.usefixtures("three")
@pytest.mark.parametrize("cause", [ArithmeticError, KeyboardInterrupt])
def test_a_failure_or_an_interrupt_stops_what_is_beside_it_at_its_next_part(cause):
    """The others would go on for ever; what had not begun never does."""
    begun = []

    def work(item):
        begun.append(item)
        if item == 0 and cause is KeyboardInterrupt:
            signal.pthread_kill(
                threading.main_thread().ident, signal.SIGINT
            )  # which wakes it, unlike a mere flag
        elif item == 0:
            raise cause
        while True:
            threads.split(1, lambda *_: None)

    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # what runs in the background may ignore it
    try:
        with pytest.raises(cause):
            threads.each(work, range(40))
    finally:
        signal.signal(signal.SIGINT, before)
    assert set(begun) <= {0, 1, 2, 3}
    assert threads.each(str, [4, 2]) == ["4", "2"]


def test_one_thread_does_one_item_after_another():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        assert (
            threads.each(lambda _: threading.current_thread(), range(2))
            == [threading.current_thread()] * 2
        )
    finally:
        torch.set_num_threads(before)


# MiB that the process holds after an array of 48 was made and let go
HELD = """
import resource
import sys
from pathlib import Path
import numpy as np
from metalens.ground.threads import keep_memory

def held():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() >> 20

told = keep_memory() if sys.argv[1] == "kept" else None
before = held()
np.ones(6 << 20)
print(told, held() - before)
"""


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="what is tuned is glibc's"
)
@pytest.mark.parametrize(
    ("word", "told", "least", "most"),
    [("kept", "True", 47, 56), ("given back", "None", -8, 8)],
)
def test_memory_that_is_kept_is_there_for_the_next_array(word, told, least, most):
    done = subprocess.run(
        [sys.executable, "-c", HELD, word], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said, held = done.stdout.split()
    assert said == told
    assert (
        least <= int(held) <= most
    )  # MiB; 8 for what Python itself takes or gives meanwhile
